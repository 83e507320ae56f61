//! Black-box tests of additional sensors: darkness while driving, inconsistent data, and invalid
//! files.

use super::program::{done, odograph, printed};
use odograph::formats::trajectory_file::{Trajectory, parse_tum};
use std::fs;
use std::path::Path;

/// A figure eight at 0.5 m/s with two seconds of darkness, and four sensors.
fn recorded(folder: &Path) {
    done(
        folder,
        "simulate -o sim --path eight --length 3 --speed 0.5 --duration 8 --fps 20 --blackout 4.5:6.5 --size 240x180 --height 0.75 --seed 4 --sensors \
         --quiet",
    );
}

const SENSORS: &str =
    "--gyro sim/gyro.csv --heading sim/heading.csv --wheel sim/wheel.csv --range sim/range.csv";

fn run(folder: &Path, extra: &str) -> String {
    let usual = "run sim/frames --timestamps sim/frames.txt --camera sim/camera.yaml --rig sim/rig.toml";
    done(folder, &format!("{usual} {extra}"))
}

fn trajectory(path: &Path) -> Trajectory {
    parse_tum(&fs::read_to_string(path).unwrap()).unwrap()
}

/// Maximum distance of a trajectory from the ground truth, metres, over the times for which `when`
/// holds; both have the same timestamps.
fn worst_m(estimate: &Trajectory, truth: &Trajectory, when: impl Fn(f64) -> bool) -> f64 {
    let mut worst_m = 0.0f64;
    let mut compared = 0;
    for pose in estimate.poses.iter().filter(|pose| when(pose.time_s)) {
        let same = truth.poses.iter().find(|other| (other.time_s - pose.time_s).abs() < 1e-6).unwrap();
        let off = pose.world_from_camera.translation.vector - same.world_from_camera.translation.vector;
        worst_m = worst_m.max(off.xy().norm());
        compared += 1;
    }
    assert!(compared > 20, "{compared} poses compared");
    worst_m
}

#[test]
fn the_path_does_not_jump_after_a_gap() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    done(here, "simulate -o sim --path eight --fps 10 --size 320x240 --blackout 5:7 --seed 1 --quiet");
    run(here, "-o out --quiet");
    let truth = trajectory(&here.join("sim/truth.tum"));
    let found = trajectory(&here.join("out/trajectory.tum"));
    let position = |poses: &Trajectory, time_s: f64| {
        let pose = poses.poses.iter().find(|pose| (pose.time_s - time_s).abs() < 1e-6).unwrap();
        pose.world_from_camera.translation.vector
    };
    for pair in found.poses.windows(2).filter(|pair| pair[1].time_s - pair[0].time_s < 0.15) {
        let [before_s, time_s] = [pair[0].time_s, pair[1].time_s];
        let [step, true_step] =
            [&found, &truth].map(|poses| (position(poses, time_s) - position(poses, before_s)).norm());
        // The truth moves by 50 mm a frame, and is followed to 0.05 mm.
        assert!((step - true_step).abs() < 0.001, "{step} m instead of {true_step} m at {time_s} s");
    }
    assert!(found.poses.last().unwrap().time_s > 24.0);
}

#[test]
fn a_wheel_that_goes_farther_than_the_camera_is_a_warning() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    done(
        here,
        "simulate -o sim --path eight --length 2 --duration 8 --fps 10 --size 160x120 --height 0.9 --sensors --quiet",
    );
    let run = "run sim/frames --timestamps sim/frames.txt --camera sim/camera.yaml --wheel sim/wheel.csv";
    let right = done(here, &format!("{run} --height 0.9 -o right"));
    assert!(!right.contains("by the wheel the path is"), "{right}");
    // The wheel of the simulation is up to some percent off.
    let wrong = done(here, &format!("{run} --height 0.72 -o wrong"));
    let found = wrong.split("multiply --height (or --field-of-view) by ").nth(1);
    let factor: f64 = found.and_then(|rest| rest.split(',').next()?.parse().ok()).expect(&wrong);
    assert!((factor / 1.25 - 1.0).abs() < 0.05, "{wrong}");
    assert!(fs::read_to_string(here.join("wrong/report.html")).unwrap().contains("by the wheel the path is"));
}

#[test]
fn a_recognised_loss_has_no_length() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    done(here, "simulate -o sim --path straight --length 2 --fps 20 --size 240x180 --blackout 2:3 --quiet");
    run(here, "-o out --quiet");
    let statistics: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(here.join("out/stats.json")).unwrap()).unwrap();
    let distance_m = statistics["distance_m"].as_f64().unwrap();
    let poses = trajectory(&here.join("out/trajectory.tum")).poses;
    let steps = poses.windows(2).filter(|two| two[1].time_s - two[0].time_s < 0.06);
    let measured_m: f64 = steps
        .map(|two| {
            let [a, b] = [0, 1].map(|k: usize| two[k].world_from_camera.translation.vector);
            (b - a).xy().norm()
        })
        .sum();
    // A metre in the dark, without which half a metre is left.
    assert!((distance_m - measured_m).abs() < 0.002, "{distance_m} m, not {measured_m} m");
    let listed = printed(here, "map info out/map.gpkg");
    assert!(listed.contains(&format!("{distance_m:.2} m")), "{listed}");
}

#[test]
fn two_dark_seconds_are_bridged_and_the_run_is_deterministic() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    recorded(here);
    run(here, "-o alone --quiet");
    let message = run(here, &format!("{SENSORS} -o out"));
    assert!(!message.contains("not used"), "{message}");
    let truth = trajectory(&here.join("sim/truth.tum"));
    // The camera alone continues with a predicted position; with the sensors the error is below 3
    // cm after 1 m of darkness, and until the end.
    let alone_m = worst_m(&trajectory(&here.join("alone/trajectory.tum")), &truth, |t| t > 6.5);
    let fused_m = worst_m(&trajectory(&here.join("out/trajectory.tum")), &truth, |t| t > 6.5);
    assert!(alone_m > 0.03 && fused_m < 0.03, "{alone_m} {fused_m}");
    // The dark frames have a pose in the smoothed trajectory, and only there.
    let smoothed = trajectory(&here.join("out/trajectory-smoothed.tum"));
    let dark = |t: f64| (4.5..6.49).contains(&t);
    assert!(worst_m(&smoothed, &truth, dark) < 0.03);
    assert!(!trajectory(&here.join("out/trajectory.tum")).poses.iter().any(|pose| dark(pose.time_s)));
    assert!(fs::read_to_string(here.join("out/trajectory-smoothed.csv")).unwrap().contains(",sensors\n"));
    assert_eq!(trajectory(&here.join("out/carrier.tum")).poses.len(), smoothed.poses.len());
    // Page and drawing show it.
    let page = fs::read_to_string(here.join("out/report.html")).unwrap();
    assert!(page.contains("the dashed path there is that of the other sensors"));
    assert!(page.contains("camera ahead of its axle by") && !page.contains("camera_ahead_m"));
    assert!(fs::read_to_string(here.join("out/map.svg")).unwrap().contains("lost: path by other sensors"));
    assert!(fs::read_to_string(here.join("alone/map.svg")).unwrap().contains("lost: path unknown"));
    let statistics = fs::read_to_string(here.join("out/stats.json")).unwrap();
    assert_eq!(statistics.matches("\"used\": true").count(), 4, "{statistics}");
    assert!(!fs::read_to_string(here.join("alone/stats.json")).unwrap().contains("sensors"));
    assert!(!fs::read_to_string(here.join("alone/run.toml")).unwrap().contains("sensors"));
    done(here, "run out/run.toml -o again --quiet");
    for name in
        ["trajectory.tum", "trajectory-smoothed.csv", "carrier.tum", "mosaic.png", "report.html", "run.toml"]
    {
        assert!(
            fs::read(here.join("out").join(name)).unwrap()
                == fs::read(here.join("again").join(name)).unwrap(),
            "{name}"
        );
    }

    // A gyroscope in degrees that claims radians does not fit this drive.
    let gyro = fs::read_to_string(here.join("sim/gyro.csv")).unwrap();
    let lie = gyro.lines().map(|line| match line.split_once(',') {
        Some((time, rate)) if rate.parse::<f64>().is_ok() => {
            format!("{time},{}\n", 57.3 * rate.parse::<f64>().unwrap())
        }
        _ => format!("{line}\n"),
    });
    fs::write(here.join("liar.csv"), lie.collect::<String>()).unwrap();
    let message = run(here, "--gyro liar.csv -o lied");
    assert!(
        message.contains("gyro liar.csv is not used: it contradicts what the camera saw in"),
        "{message}"
    );
    let statistics = fs::read_to_string(here.join("lied/stats.json")).unwrap();
    assert!(statistics.contains("\"used\": false") && statistics.contains("contradicts"), "{statistics}");
    for name in ["trajectory.tum", "trajectory.csv", "trajectory-smoothed.csv", "map.svg", "mosaic.png"] {
        assert!(
            fs::read(here.join("lied").join(name)).unwrap()
                == fs::read(here.join("alone").join(name)).unwrap(),
            "{name}"
        );
    }

    // Clocks without a common time base.
    let late = gyro.lines().map(|line| match line.split_once(',') {
        Some((time, rate)) if rate.parse::<f64>().is_ok() => {
            format!("{},{rate}\n", time.parse::<f64>().unwrap() + 1.7e9)
        }
        _ => format!("{line}\n"),
    });
    fs::write(here.join("late.csv"), late.collect::<String>()).unwrap();
    let message = run(here, "--gyro late.csv --max-frames 20 -o late");
    assert!(message.contains("its clock must count from the same moment"), "{message}");
}

#[test]
fn invalid_sensor_files_are_refused() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    done(here, "simulate -o sim --size 96x72 --duration 0.2 --quiet");
    assert!(!here.join("sim/gyro.csv").exists());
    let many = format!("time_s,rate_rad_s\n{}", "0,1\n".repeat(1000));
    for (text, says) in [
        ("", "nothing in the file"),
        ("0.1 0.2\n", "line 1 is \"0.1 0.2\"; it must name the columns"),
        ("time_s,rate_rad_s\n0,1\n0.1,nan\n", "line 3: \"nan\""),
        (many.as_str(), "line 3: the time 0 s is not later"),
    ] {
        fs::write(here.join("bad.csv"), text).unwrap();
        let usual = "run sim/frames --timestamps sim/frames.txt --camera sim/camera.yaml --rig sim/rig.toml --gyro bad.csv -o out";
        let output = odograph(here, usual);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(3), "{message}");
        assert!(
            message.contains(says) && message.contains("bad.csv") && message.lines().count() == 1,
            "{message}"
        );
        assert!(!here.join("out").exists());
    }
    done(here, "simulate -o sim --size 96x72 --duration 0.2 --sensors --force --quiet");
    let parameters = fs::read_to_string(here.join("sim/simulation.toml")).unwrap();
    assert!(parameters.contains("[sensors.gyro]") && here.join("sim/range.csv").exists(), "{parameters}");
    // Sensor files of an earlier recording are removed.
    done(here, "simulate -o sim --size 96x72 --duration 0.2 --seed 2 --force --quiet");
    assert!(!here.join("sim/gyro.csv").exists());
}
