//! Black-box tests of the robot's frame: a camera on a lever arm.

use super::program::{done, done_once, odograph, printed};
use nalgebra::Isometry3;
use odograph::camera::{LeverArm, Rig};
use odograph::formats::rig_file;
use odograph::formats::trajectory_file::{Trajectory, parse_tum};
use std::fs;
use std::path::Path;

/// A drive in bends, filmed by a camera whose image is turned on the robot, and its rig with a
/// lever arm.
fn recorded(folder: &Path) -> Rig {
    done_once(
        folder,
        "simulate -o sim --path eight --length 1.5 --speed 0.5 --duration 4 --fps 20 --size 240x180 --height 0.75 --yaw 90 \
         --seed 4 --quiet",
    );
    let rig = rig_file::parse(&fs::read_to_string(folder.join("sim/rig.toml")).unwrap()).unwrap();
    let rig = Rig { lever_arm: Some(LeverArm { x_m: 0.3, y_m: 0.05, z_m: 0.6 }), ..rig };
    fs::write(folder.join("armed.toml"), rig_file::write(&rig)).unwrap();
    rig
}

const DRIVE: &str = "sim/frames --timestamps sim/frames.txt --camera sim/camera.yaml --quiet";

fn trajectory(path: &Path) -> Trajectory {
    parse_tum(&fs::read_to_string(path).unwrap()).unwrap()
}

/// Largest distances of a trajectory from poses that are fixed to the true camera: metres and
/// radians.
fn worst(estimate: &Trajectory, truth: &Trajectory, camera_from_frame: &Isometry3<f64>) -> (f64, f64) {
    assert!(estimate.poses.len() > 70, "{} poses", estimate.poses.len());
    let mut worst = (0.0f64, 0.0f64);
    for pose in &estimate.poses {
        let same = truth.poses.iter().find(|other| (other.time_s - pose.time_s).abs() < 1e-6).unwrap();
        let there = same.world_from_camera * camera_from_frame;
        let off = there.inverse() * pose.world_from_camera;
        worst = (worst.0.max(off.translation.vector.norm()), worst.1.max(off.rotation.angle()));
    }
    worst
}

#[test]
fn a_rig_that_cannot_be_is_refused() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    recorded(folder);
    for (rig, words) in [
        ("height_m = 0.75\nz_m = 0.8\n", "z_m is 0.8 and height_m 0.75"),
        ("height_m = 0.75\nroll_deviation_deg = -0.1\n", "roll_deviation_deg is -0.1"),
    ] {
        fs::write(folder.join("wrong.toml"), rig).unwrap();
        let refused = odograph(folder, &format!("run {DRIVE} --rig wrong.toml -o wrong"));
        let told = String::from_utf8(refused.stderr).unwrap();
        assert!(refused.status.code() == Some(3) && told.contains(words), "{told}");
    }
}

#[test]
fn with_a_lever_arm_the_poses_are_those_of_the_robot() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    let rig = recorded(here);
    printed(here, &format!("run {DRIVE} --rig armed.toml -o robot"));
    let truth = trajectory(&here.join("sim/truth.tum"));
    let camera_from_base = rig.base_from_camera().unwrap().inverse();
    for name in ["trajectory.tum", "odometry.tum", "trajectory-smoothed.tum", "carrier.tum"] {
        let text = fs::read_to_string(here.join("robot").join(name)).unwrap();
        assert!(text.contains("(world_from_base_link)"), "{name}");
        let (metres, radians) = worst(&trajectory(&here.join("robot").join(name)), &truth, &camera_from_base);
        // The low-pass filter of carrier.tum rounds bends a little.
        assert!(metres < 4e-3 && radians < 8e-3, "{name}: {metres} m {radians} rad");
    }
    // Heading and speed are the robot's, and the first pose is known exactly.
    let csv = fs::read_to_string(here.join("robot/trajectory.csv")).unwrap();
    let cells = |line: &str| line.split(',').map(str::to_owned).collect::<Vec<_>>();
    let (names, first) = (cells(csv.lines().next().unwrap()), cells(csv.lines().nth(1).unwrap()));
    let value =
        |name: &str| first[names.iter().position(|other| other == name).unwrap()].parse::<f64>().unwrap();
    assert!(
        (value("heading_deg") + 90.0).abs() < 1e-6 && (value("height_m") - 0.15).abs() < 1e-6,
        "{first:?}"
    );
    assert!((value("x_m") + 0.05).abs() < 1e-6 && (value("y_m") - 0.3).abs() < 1e-6, "{first:?}");
    assert!(value("sigma_x_m") < 1e-9 && value("roll_deg").abs() < 1e-6, "{first:?}");

    // The estimate is that of a run without a lever arm, which is also what --frame camera writes.
    printed(here, &format!("run {DRIVE} --rig armed.toml --frame camera -o camera"));
    printed(here, &format!("run {DRIVE} --rig sim/rig.toml -o plain"));
    for name in ["trajectory.tum", "trajectory.csv", "trajectory-smoothed.csv", "mosaic.png", "map.svg"] {
        let [camera, plain] =
            ["camera", "plain"].map(|folder| fs::read(here.join(folder).join(name)).unwrap());
        assert!(camera == plain, "{name}");
    }
    assert!(!fs::read_to_string(here.join("plain/run.toml")).unwrap().contains("frame ="));
    // run.toml repeats it.
    for folder in ["robot", "camera"] {
        printed(here, &format!("run {folder}/run.toml -o again --force --quiet"));
        for name in ["trajectory.tum", "trajectory.csv", "carrier.tum", "run.toml"] {
            let [first, again] =
                [folder, "again"].map(|folder| fs::read(here.join(folder).join(name)).unwrap());
            assert!(first == again, "{folder} {name}");
        }
    }
    // A map remembers the lever arm.
    let found = printed(here, "localize sim/frames --timestamps sim/frames.txt --map robot/map.gpkg --json");
    let place: serde_json::Value = serde_json::from_str(&found).unwrap();
    let last = trajectory(&here.join("robot/trajectory.tum")).poses.last().unwrap().world_from_camera;
    let off = ["x_m", "y_m"].map(|name| place["place"][name].as_f64().unwrap());
    let off_m = (off[0] - last.translation.x).hypot(off[1] - last.translation.y);
    assert!(off_m < 5e-3, "{found} {last}");
}

#[test]
fn a_height_alone_keeps_the_rest_of_the_mount_of_a_map() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    recorded(here);
    printed(here, &format!("run {DRIVE} --rig armed.toml -o robot --max-frames 40"));
    let drive = DRIVE.replace(" --camera sim/camera.yaml --quiet", "");
    for (camera, folder) in [("", "again"), ("--camera sim/camera.yaml ", "with-camera")] {
        let arguments = format!("run {drive} {camera}--height 0.75 --map robot/map.gpkg -o {folder}");
        let told = done(here, &arguments);
        let note = "the rest of the mount that of the map: x 0.300 m, y 0.050 m, z 0.600 m, roll 0.0°, \
                    pitch 0.0°, yaw 90.0°";
        assert!(told.contains(note), "{told}");
        let text = fs::read_to_string(here.join(folder).join("trajectory.tum")).unwrap();
        assert!(text.contains("(world_from_base_link)"), "{camera}");
    }
}

#[test]
fn what_is_told_while_driving_is_the_robots() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    recorded(here);
    let live = format!("live {DRIVE} --rig armed.toml").replace("--timestamps sim/frames.txt", "--fps 20");
    let printed = printed(here, &format!("{live} --print poses --mcap drive.mcap -o robot"));
    let first: serde_json::Value = serde_json::from_str(printed.lines().next().unwrap()).unwrap();
    assert!((first["pose"]["y_m"].as_f64().unwrap() - 0.3).abs() < 1e-6, "{first}");
    let log = fs::read(here.join("drive.mcap")).unwrap();
    let transforms: Vec<serde_json::Value> = mcap::MessageStream::new(&log)
        .unwrap()
        .map(|message| message.unwrap())
        .filter(|message| message.channel.topic == "/tf")
        .map(|message| serde_json::from_slice(&message.data).unwrap())
        .collect();
    let frames = |at: usize| [&transforms[at]["parent_frame_id"], &transforms[at]["child_frame_id"]];
    assert_eq!(frames(0), ["odom", "base_link"]);
    assert_eq!(frames(1), ["base_link", "camera"]);
    assert!((transforms[1]["translation"]["z"].as_f64().unwrap() - 0.6).abs() < 1e-9);
}

#[test]
fn a_frame_that_is_not_known_is_refused() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    recorded(here);
    fs::write(here.join("far.toml"), "height_m = 0.75\nx_m = 300").unwrap();
    fs::write(here.join("wrong.toml"), "height_m = 0.75\nx_meter = 3").unwrap();
    for (arguments, words, code) in [
        ("--height 75cm --frame base_link", "where the camera is on the robot is not known", 2),
        ("--rig far.toml", "the lever arm's x is 300.0 m", 3),
        ("--rig wrong.toml", "unknown key `x_meter`", 3),
        ("--height 75cm --frame robot", "base_link", 2),
    ] {
        let output = odograph(here, &format!("run {DRIVE} {arguments} -o out"));
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(message.contains(words) && output.status.code() == Some(code), "{arguments}: {message}");
        assert!(!here.join("out").exists());
    }
}

/// Greatest tilt of the robot, radians, and greatest distance of its height from the true one,
/// metres, in the second half of a path.
fn off_level(path: &Trajectory, height_m: f64) -> (f64, f64) {
    let later = &path.poses[path.poses.len() / 2..];
    later.iter().fold((0.0f64, 0.0f64), |(tilt, off), pose| {
        let up = pose.world_from_camera.rotation * nalgebra::Vector3::z();
        let height = pose.world_from_camera.translation.z;
        (tilt.max(up.z.clamp(-1.0, 1.0).acos()), off.max((height - height_m).abs()))
    })
}

/// A camera 0.2 m above `base_link` whose rig file is wrong by 1° of roll. With the file's tilt the
/// robot leans by 1° and is 3.5 mm beside its place.
#[test]
fn a_tilt_that_is_found_while_driving_is_that_of_the_robots_poses() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    printed(
        here,
        "simulate -o sim --path eight --length 1.7 --speed 0.6 --fps 15 --size 320x240 --height 0.75 --roll 1 --seed 4 --quiet",
    );
    let rig = rig_file::parse(&fs::read_to_string(here.join("sim/rig.toml")).unwrap()).unwrap();
    let rig = Rig { lever_arm: Some(LeverArm { x_m: 0.0, y_m: 0.0, z_m: 0.2 }), ..rig };
    fs::write(here.join("armed.toml"), rig_file::write(&Rig { roll_rad: 0.0, ..rig })).unwrap();
    printed(here, &format!("run {DRIVE} --rig armed.toml -o recorded"));
    let live = format!("live {DRIVE} --rig armed.toml").replace("--timestamps sim/frames.txt", "--fps 15");
    let printed = printed(here, &format!("{live} --print poses --mcap drive.mcap -o live"));
    for folder in ["recorded", "live"] {
        let mount = fs::read_to_string(here.join(folder).join("stats.json")).unwrap();
        let mount: serde_json::Value = serde_json::from_str(&mount).unwrap();
        assert!((mount["mount"]["roll_deg"].as_f64().unwrap() - 1.0).abs() < 0.1, "{folder}: {mount}");
        for name in ["trajectory.tum", "odometry.tum", "trajectory-smoothed.tum"] {
            let (tilt, off_m) = off_level(&trajectory(&here.join(folder).join(name)), 0.55);
            assert!(tilt.to_degrees() < 0.1 && off_m < 1e-3, "{folder} {name}: {tilt} rad, {off_m} m");
        }
    }
    // A recording is tracked again, and right from its first metre on.
    let truth = trajectory(&here.join("sim/truth.tum"));
    let camera_from_base = rig.base_from_camera().unwrap().inverse();
    let recorded = trajectory(&here.join("recorded/trajectory.tum"));
    let (metres, radians) = worst(&recorded, &truth, &camera_from_base);
    assert!(metres < 4e-3 && radians < 4e-3, "{metres} m {radians} rad");
    // A live run keeps the bend of its beginning; each motion after it is right.
    let moved = |path: &Trajectory, from: usize, to: usize| {
        path.poses[from].world_from_camera.inverse() * path.poses[to].world_from_camera
    };
    let live = trajectory(&here.join("live/odometry.tum"));
    let robot = Trajectory {
        poses: truth
            .poses
            .iter()
            .map(|pose| odograph::trajectory::StampedPose {
                world_from_camera: pose.world_from_camera * camera_from_base,
                ..*pose
            })
            .collect(),
    };
    assert_eq!(live.poses.len(), robot.poses.len());
    let half = live.poses.len() / 2;
    for to in half..live.poses.len() {
        let off = moved(&robot, half, to).inverse() * moved(&live, half, to);
        let (metres, radians) = (off.translation.vector.norm(), off.rotation.angle());
        assert!(metres < 4e-3 && radians < 4e-3, "frame {to}: {metres} m {radians} rad");
    }
    // So is what was printed and recorded meanwhile.
    let last: serde_json::Value = serde_json::from_str(printed.lines().last().unwrap()).unwrap();
    assert!(last["pose"]["roll_rad"].as_f64().unwrap().abs() < 2e-3, "{last}");
    let log = fs::read(here.join("drive.mcap")).unwrap();
    let on_robot: Vec<serde_json::Value> = mcap::MessageStream::new(&log)
        .unwrap()
        .map(|message| message.unwrap())
        .filter(|message| message.channel.topic == "/tf")
        .map(|message| serde_json::from_slice(&message.data).unwrap())
        .filter(|transform: &serde_json::Value| transform["child_frame_id"] == "camera")
        .collect();
    let [first, last] = [on_robot.first(), on_robot.last()].map(|transform| &transform.unwrap()["rotation"]);
    assert_ne!(first, last, "the mount of the rig file and the one that was found");
}
