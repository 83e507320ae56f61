//! Black-box tests of markers on the ground.

use super::program::{done, odograph};
use odograph::formats::control_file;
use odograph::formats::trajectory_file::parse_tum;
use odograph::landmark::ControlPoint;
use odograph::trajectory::Trajectory;
use serde_json::Value;
use std::fs;
use std::path::Path;

fn path(folder: &Path, file: &str) -> Trajectory {
    parse_tum(&fs::read_to_string(folder.join(file)).unwrap()).unwrap()
}

fn statistics(folder: &Path, run: &str) -> Value {
    serde_json::from_str(&fs::read_to_string(folder.join(run).join("stats.json")).unwrap()).unwrap()
}

/// Root mean square distance of a run's path from the truth, without any alignment, metres.
fn rmse_m(folder: &Path, run: &str) -> f64 {
    let truth = path(folder, "sim/truth.tum");
    let found = path(folder, &format!("{run}/trajectory.tum"));
    assert!(found.poses.len() + 5 > truth.poses.len());
    let squares = found.poses.iter().map(|pose| {
        let same = truth.poses.iter().find(|other| (other.time_s - pose.time_s).abs() < 1e-5).unwrap();
        let off = pose.world_from_camera.translation.vector - same.world_from_camera.translation.vector;
        off.x * off.x + off.y * off.y
    });
    (squares.sum::<f64>() / found.poses.len() as f64).sqrt()
}

const RUN: &str = "run sim/sim.y4m --camera sim/camera.yaml --quiet --markers apriltag:36h11:160mm";

#[test]
fn surveyed_markers_hold_a_path_of_a_hundred_metres() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    done(
        here,
        "simulate -o sim --path straight --length 100 --speed 2.5 --fps 25 --size 320x240 --format y4m --quiet \
         --markers apriltag:36h11:160mm:10m --seed 4",
    );
    let control = fs::read_to_string(here.join("sim/markers.csv")).unwrap();
    let points = control_file::parse(&control).unwrap();
    assert_eq!(points.iter().map(|point| point.number).collect::<Vec<_>>(), (0..=10).collect::<Vec<_>>());

    done(here, &format!("{RUN} --rig sim/rig.toml --control sim/markers.csv -o right"));
    let right_m = rmse_m(here, "right");
    let found = statistics(here, "right");
    let markers = &found["markers"];
    assert!(right_m < 0.002, "{right_m} m, {markers}");
    assert!(markers["surveyed"] == true && markers["scale"] == 1.0, "{markers}");
    // The last one comes into view when there is no keyframe any more.
    assert!(markers["landmarks"].as_array().unwrap().len() >= 10, "{markers}");
    assert!(fs::read_to_string(here.join("right/map.svg")).unwrap().contains("class=\"landmark\""));

    // One control point is wrong by 10 cm: it is named, and the path stays.
    let wrong: Vec<ControlPoint> = points
        .iter()
        .map(|point| ControlPoint { y_m: point.y_m + if point.number == 4 { 0.1 } else { 0.0 }, ..*point })
        .collect();
    fs::write(here.join("wrong.csv"), control_file::write(&wrong)).unwrap();
    let run = RUN.replace(" --quiet", "");
    let message = done(here, &format!("{run} --rig sim/rig.toml --control wrong.csv -o wrong"));
    assert!(message.contains("marker 4 contradicts wrong.csv: it is 0."), "{message}");
    let wrong_m = rmse_m(here, "wrong");
    assert!(wrong_m < right_m + 0.001, "{right_m} m, with a wrong control point {wrong_m} m");

    // The height is wrong by 1 %: it is corrected.
    let message = done(here, &format!("{run} --height 0.909 --control sim/markers.csv -o high"));
    assert!(message.contains("the camera is rather 0.900"), "{message}");
    let high_m = rmse_m(here, "high");
    assert!(high_m < 0.002, "{high_m} m");
    let scale = statistics(here, "high")["markers"]["scale"].as_f64().unwrap();
    assert!((scale - 0.9 / 0.909).abs() < 2e-4, "{scale}");

    // What cannot be is refused in one sentence, before anything is tracked.
    let refused = |text: &str, part: &str| {
        fs::write(here.join("bad.csv"), text).unwrap();
        let output = odograph(here, &format!("{RUN} --rig sim/rig.toml --control bad.csv -o bad"));
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(3) && message.contains(part), "{message}");
        assert!(message.trim_end().lines().count() == 1 && !here.join("bad/trajectory.tum").exists());
    };
    refused("marker,x_m,y_m\n1,2,3\n1,2,3\n", "bad.csv: line 3: marker 1 stands in line 2 already");
    refused("marker,x_m,y_m\n1,NaN,3\n", "bad.csv: line 2: \"NaN\"");
    refused("marker,x_m,y_m\n600,1,3\n", "there is no marker 600 in the family apriltag:36h11:160mm");
    let output = odograph(
        here,
        "run sim/sim.y4m --camera sim/camera.yaml --height 90cm --markers apriltag:9:8cm -o bad",
    );
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("there is no family `apriltag:9`"));
}

#[test]
fn markers_close_a_loop_without_control_points() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    done(
        here,
        "simulate -o sim --path eight --length 4 --turns 2 --speed 1 --fps 20 --size 320x240 --format y4m --quiet \
         --markers aruco:4x4_50:100mm:2m --seed 5",
    );
    done(
        here,
        "run sim/sim.y4m --camera sim/camera.yaml --rig sim/rig.toml --quiet --markers aruco:4x4_50:100mm -o run",
    );
    let markers = &statistics(here, "run")["markers"];
    assert_eq!(markers["landmarks"].as_array().unwrap().len(), 6, "{markers}");
    // The middle of the eight is passed four times.
    let visits = markers["landmarks"][0]["visits"].as_u64().unwrap();
    assert!(markers["ties"].as_u64().unwrap() >= 1 && visits > 1, "{markers}");
    let truth = control_file::parse(&fs::read_to_string(here.join("sim/markers.csv")).unwrap()).unwrap();
    for (found, truth) in markers["landmarks"].as_array().unwrap().iter().zip(truth) {
        let at = |name: &str| found[name].as_f64().unwrap();
        assert!((at("x_m") - truth.x_m).hypot(at("y_m") - truth.y_m) < 0.001, "{found} {truth:?}");
        let turned =
            (at("heading_deg") - truth.heading_rad.unwrap().to_degrees() + 540.0).rem_euclid(360.0) - 180.0;
        assert!(turned.abs() < 1.0, "{found} {truth:?}");
    }
    // The plan repeats it.
    done(here, "run run/run.toml --quiet -o again");
    assert_eq!(statistics(here, "again")["markers"]["landmarks"], markers["landmarks"]);
}
