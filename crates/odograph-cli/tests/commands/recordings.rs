//! The program on real recordings with ground truth. They are not part of the repository: they are
//! read from the folder in `ODOGRAPH_DATA`, by default `../shared/data` beside the checkout, and
//! the tests report if they are missing.

use nalgebra::{Isometry3, Rotation3, Translation3, UnitQuaternion, Vector3};
use odograph::evaluation::{Alignment, EvaluationOptions, evaluate};
use odograph::formats::trajectory_file::{StampedPose, Trajectory, parse_tum};
use odograph::geometry::GroundPose;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

fn recording(name: &str) -> Option<PathBuf> {
    let data = std::env::var_os("ODOGRAPH_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"), PathBuf::from);
    let folder = data.join(name);
    if !folder.is_dir() {
        println!("skipped: data: the recording {} is not here", folder.display());
        return None;
    }
    Some(folder)
}

fn camera_file(size: (usize, usize), f: (f64, f64), c: (f64, f64), d: [f64; 4]) -> String {
    format!(
        "%YAML:1.0\n---\nimage_width: {}\nimage_height: {}\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   \
         data: [ {}, 0., {}, 0., {}, {}, 0., 0., 1. ]\ndistortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n   dt: d\n   \
         data: [ {}, {}, {}, {} ]\n",
        size.0, size.1, f.0, c.0, f.1, c.1, d[0], d[1], d[2], d[3]
    )
}

/// Runs the program and returns its trajectory.
fn run(source: &Path, work: &Path, extra: &[&str]) -> Trajectory {
    let out = work.join("run");
    let done = Command::new(env!("CARGO_BIN_EXE_odograph"))
        .arg("run")
        .arg(source)
        .arg("--camera")
        .arg(work.join("camera.yaml"))
        .arg("--rig")
        .arg(work.join("rig.toml"))
        .args(extra)
        .arg("-o")
        .arg(&out)
        .arg("--quiet")
        .output()
        .expect("the program runs");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    parse_tum(&fs::read_to_string(out.join("trajectory.tum")).unwrap()).unwrap()
}

/// The poses of the checkerboard recording: `X_camera = R X_world + t` with the world's z axis into
/// the board.
fn checkerboard_truth(folder: &Path) -> Trajectory {
    let text = fs::read_to_string(folder.join("poses_omega_t.txt")).unwrap();
    let flip = Isometry3::rotation(Vector3::x() * std::f64::consts::PI);
    let poses = text.lines().enumerate().filter_map(|(number, line)| {
        let v: Vec<f64> = line.split_whitespace().map(|word| word.parse().unwrap()).collect();
        let [wx, wy, wz, tx, ty, tz] = v[..] else { return None };
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::new(Vector3::new(wx, wy, wz)));
        let world_from_camera = Isometry3::from_parts(Translation3::new(tx, ty, tz), rotation).inverse();
        let upright =
            if world_from_camera.translation.z < 0.0 { flip * world_from_camera } else { world_from_camera };
        Some(StampedPose { time_s: number as f64 / 30.0, world_from_camera: upright })
    });
    Trajectory { poses: poses.collect() }
}

#[test]
fn a_hand_held_camera_over_a_checkerboard_is_tracked_throughout() {
    let Some(folder) = recording("planar_checker_a") else { return };
    let truth = checkerboard_truth(&folder);
    let work = tempfile::tempdir().unwrap();
    let camera = camera_file((752, 480), (419.97, 419.31), (353.93, 250.78), [-0.31418, 0.10884, 0.0, 0.0]);
    fs::write(work.path().join("camera.yaml"), camera).unwrap();
    let first = GroundPose::from_world_from_camera(&truth.poses[0].world_from_camera);
    let rig = format!(
        "height_m = {}\nroll_rad = {}\npitch_rad = {}\n",
        first.height_m, first.roll_rad, first.pitch_rad
    );
    fs::write(work.path().join("rig.toml"), rig).unwrap();
    for model in ["free", "auto"] {
        let found = run(&folder.join("images"), work.path(), &["--fps", "30", "--motion", model, "--force"]);
        assert_eq!(found.poses.len(), 400, "{model}");
        let rmse = |alignment| {
            let options = EvaluationOptions { alignment, ..EvaluationOptions::default() };
            evaluate(&found, &truth, &options).unwrap().absolute.translation.rmse
        };
        // 1.3 and 1.5 mm at the time of writing; the ground truth itself has a reprojection error
        // of 0.23 px, about 0.2 mm.
        assert!(rmse(Alignment::Sim3) < 3e-3, "{model}: {}", rmse(Alignment::Sim3));
        assert!(rmse(Alignment::Se3) < 3e-3, "{model}: {}", rmse(Alignment::Se3));
    }
}

#[test]
fn a_stationary_camera_has_a_constant_pose() {
    let Some(folder) = recording("static_euroc_v101") else { return };
    let work = tempfile::tempdir().unwrap();
    fs::copy(folder.join("sensor.yaml"), work.path().join("camera.yaml")).unwrap();
    fs::write(work.path().join("rig.toml"), "height_m = 1.0\n").unwrap();
    let found = run(&folder.join("cam0"), work.path(), &[]);
    assert!(found.poses.len() >= 60);
    let start = found.poses[0].world_from_camera.translation.vector;
    for pose in &found.poses {
        // The drone's own pose varies by 2.4 mm; 0.4 mm at the time of writing.
        assert!((pose.world_from_camera.translation.vector - start).norm() < 1e-3);
    }
}

#[test]
fn large_steps_are_tracked_despite_a_moving_shadow() {
    let Some(folder) = recording("kylehart_ground") else { return };
    let work = tempfile::tempdir().unwrap();
    let frames = work.path().join("frames");
    fs::create_dir(&frames).unwrap();
    let mut truth = Trajectory::default();
    for number in 0..41 {
        let name = format!("{number:06}");
        fs::copy(folder.join(&name).with_extension("png"), frames.join(&name).with_extension("png")).unwrap();
        let text = fs::read_to_string(folder.join(&name).with_extension("txt")).unwrap();
        let v: Vec<f64> = text.split([',', ' ', '\n']).filter_map(|word| word.parse().ok()).collect();
        let pose = GroundPose { x_m: v[0], y_m: v[1], heading_rad: v[5], ..GroundPose::level(0.25) };
        truth.poses.push(StampedPose { time_s: number as f64, world_from_camera: pose.world_from_camera() });
    }
    let camera = camera_file((1280, 960), (1108.7, 1108.7), (640.0, 480.0), [0.0; 4]);
    fs::write(work.path().join("camera.yaml"), camera).unwrap();
    fs::write(work.path().join("rig.toml"), "height_m = 0.25\n").unwrap();
    let found = run(&frames, work.path(), &["--fps", "1"]);
    assert_eq!(found.poses.len(), 41);
    let options = EvaluationOptions { alignment: Alignment::Origin, ..EvaluationOptions::default() };
    let errors = evaluate(&found, &truth, &options).unwrap().absolute;
    // At most 0.33 mm and 0.007° at the time of writing.
    assert!(errors.translation.max < 1e-3, "{}", errors.translation.max);
    assert!(errors.rotation.max < 0.05f64.to_radians(), "{}", errors.rotation.max);
}
