use super::*;
use crate::calibration::{CalibrationConfig, LensModel, calibrate};
use crate::camera::{Camera, Distortion};
use crate::simulation::{BoardScene, Framing};

#[test]
fn calibration_files_round_trip_the_camera_and_list_its_quality() {
    let distortion = Distortion::from_opencv(&[-0.15, 0.03, 0.0, 0.0]).unwrap();
    let truth = Camera::new((320, 240), (300.0, 300.0), (162.0, 118.0), distortion).unwrap();
    let board: Board = "chessboard:7x5:30mm".parse().unwrap();
    let scene = BoardScene::new(&board, &truth, 1);
    let views: Vec<_> = scene.poses(12, Framing::Whole, 2).iter().map(|pose| scene.true_view(pose)).collect();
    let config = CalibrationConfig { model: Some(LensModel::BrownConrady4), ..Default::default() };
    let calibration = calibrate(&board, &views, &config).unwrap();
    let text = write(&calibration, &board);
    assert_eq!(camera_file::parse(&text, None).unwrap(), calibration.camera);
    assert_eq!(text, write(&calibration, &board), "the same text twice");
    for line in [
        "lens_model: \"brown-conrady4\"",
        "calibration_board: \"chessboard:7x5:30mm\"",
        "views_seen: 12",
        "   - \"fx\"",
        "parameter_covariance: !!opencv-matrix\n   rows: 8\n   cols: 8\n",
    ] {
        assert!(text.contains(line), "{line} in {text}");
    }
}

#[test]
fn non_finite_numbers_and_control_characters_are_escaped() {
    assert_eq!(real(f64::NAN), ".Nan");
    assert_eq!(real(f64::NEG_INFINITY), "-.Inf");
    assert_eq!(real(1e-5), "1.0e-5");
    assert_eq!(quoted("a \"b\"\n\\"), "\"a \\\"b\\\" \\\\\"");
    let mut text = String::new();
    list(&mut text, "reasons", [].into_iter());
    assert_eq!(text, "reasons: []\n");
}
