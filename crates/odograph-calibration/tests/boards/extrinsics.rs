//! The rig from rendered pictures of a board on the floor.

use nalgebra::Vector3;
use odograph::camera::{Camera, Distortion, Rig};
use odograph::geometry::GroundPose;
use odograph::motion::Random;
use odograph_calibration::{BoardDirection, BoardFinder, FloorBoard, rig_from_boards};
use odograph_simulation::{BoardEffects, BoardScene};

/// The rig of all views.
const RIG: Rig = Rig { height_m: 0.75, roll_rad: 0.06, pitch_rad: -0.09, yaw_rad: 0.4, lever_arm: None };

/// Three rendered images of a floor with the board at different places, and the corner finder.
#[test]
fn rendered_pictures_give_what_is_asked() {
    let distortion = Distortion::from_opencv(&[-0.2, 0.05, 0.0005, -0.0003]).unwrap();
    let camera = Camera::new((640, 480), (520.0, 521.0), (322.0, 238.0), distortion).unwrap();
    let board = "chessboard:12x9:35mm".parse().unwrap();
    let floor = FloorBoard { board, thickness_m: 0.0, forward: Some(BoardDirection::X) };
    let scene = BoardScene::new(&floor.board, &camera, 3);
    let mut random = Random::new(11);
    let mut views = Vec::new();
    for seed in 0..3 {
        // Images that show the whole board.
        let mut aside_m = || (random.below(1000) as f64 / 1000.0 - 0.5) * 0.04;
        let (x_m, y_m) = (0.125 + aside_m(), -0.185 + aside_m());
        let pose = GroundPose { x_m, y_m, heading_rad: RIG.yaw_rad, ..RIG.first_pose() };
        // The board's frame has y down the print and z into the paper: a half turn about its x
        // axis.
        let half_turn = nalgebra::UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        let world_from_board = nalgebra::Isometry3::from_parts(nalgebra::Translation3::identity(), half_turn);
        let camera_from_board = pose.world_from_camera().inverse() * world_from_board;
        let effects = BoardEffects { blur_px: 0.6, noise_gray: 2.0, seed, ..BoardEffects::default() };
        let image = scene.render(&camera_from_board, &effects);
        views.push(BoardFinder::new(&floor.board).find(&image).unwrap_or_else(|why| panic!("{why}")));
    }
    let found = rig_from_boards(&camera, None, &floor, &views).unwrap();
    let rig = &found.measured.rig;
    let off = [rig.height_m - RIG.height_m, rig.roll_rad - RIG.roll_rad, rig.pitch_rad - RIG.pitch_rad];
    println!(
        "height {:+.3} % tilt {:+.4}° {:+.4}° yaw {:+.4}°",
        100.0 * off[0] / RIG.height_m,
        off[1].to_degrees(),
        off[2].to_degrees(),
        (found.measured.rig.yaw_rad - RIG.yaw_rad).to_degrees()
    );
    assert!(off[0].abs() < 0.001 * RIG.height_m && off[1].hypot(off[2]) < 0.02f64.to_radians(), "{found:?}");
    assert!((found.measured.rig.yaw_rad - RIG.yaw_rad).abs() < 0.02f64.to_radians());
}
