//! Calibration files of rendered calibrations.

use odograph::camera::{Camera, Distortion};
use odograph::formats::camera_file;
use odograph_calibration::{Board, CalibrationConfig, LensModel, calibrate, calibration_file};
use odograph_simulation::{BoardScene, Framing};

#[test]
fn calibration_files_round_trip_the_camera_and_list_its_quality() {
    let distortion = Distortion::from_opencv(&[-0.15, 0.03, 0.0, 0.0]).unwrap();
    let truth = Camera::new((320, 240), (300.0, 300.0), (162.0, 118.0), distortion).unwrap();
    let board: Board = "chessboard:7x5:30mm".parse().unwrap();
    let scene = BoardScene::new(&board, &truth, 1);
    let views: Vec<_> = scene.poses(12, Framing::Whole, 2).iter().map(|pose| scene.true_view(pose)).collect();
    let config = CalibrationConfig { model: Some(LensModel::BrownConrady4), ..Default::default() };
    let calibration = calibrate(&board, &views, &config).unwrap();
    let text = calibration_file::write(&calibration, &board);
    assert_eq!(camera_file::parse(&text, None).unwrap(), calibration.camera);
    assert_eq!(text, calibration_file::write(&calibration, &board), "the same text twice");
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
