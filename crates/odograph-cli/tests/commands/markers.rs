//! Black-box tests of markers on the ground.

use super::program::{done, odograph, printed};
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
    assert!(message.contains("the camera is probably 0.900"), "{message}");
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

#[test]
fn live_finds_the_markers_that_run_finds() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    done(
        here,
        "simulate -o sim --path eight --length 4 --speed 1 --fps 20 --size 320x240 --format y4m --quiet \
         --markers aruco:4x4_50:100mm:2m --seed 5",
    );
    let options = "sim/sim.y4m --camera sim/camera.yaml --rig sim/rig.toml --readout-ms 0 --quiet \
                   --markers aruco:4x4_50:100mm";
    for more in ["", " --control sim/markers.csv"] {
        done(here, &format!("run {options}{more} -o run --force"));
        done(here, &format!("live {options}{more} -o live --force"));
        for name in ["trajectory.tum", "trajectory.csv", "map.svg"] {
            let [run, live] = ["run", "live"].map(|folder| fs::read(here.join(folder).join(name)).unwrap());
            assert!(run == live, "{name} differs{more}");
        }
        let [run, live] = ["run", "live"].map(|folder| statistics(here, folder)["markers"].clone());
        assert!(live["sightings"].as_u64().unwrap() > 4 && live["ties"].as_u64().unwrap() > 0, "{live}");
        for key in ["sightings", "ties", "side_ratio", "surveyed", "scale", "landmarks"] {
            assert_eq!(run[key], live[key], "{key}");
        }
        assert_eq!(live["surveyed"], !more.is_empty());
    }
    let output = odograph(here, &format!("live {} -o bad", options.replace("4x4_50", "4x4_51")));
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2) && message.contains("there is no family"), "{message}");
}

/// Root mean square distance of a run's path from the truth of another drive, without alignment,
/// metres.
fn rmse_to_m(here: &Path, truth: &str, run: &str) -> f64 {
    let (truth, found) = (path(here, truth), path(here, &format!("{run}/trajectory.tum")));
    assert!(found.poses.len() > 40, "{run}");
    let squares = found.poses.iter().map(|pose| {
        let same = truth.poses.iter().find(|other| (other.time_s - pose.time_s).abs() < 1e-5).unwrap();
        let off = pose.world_from_camera.translation.vector - same.world_from_camera.translation.vector;
        off.x * off.x + off.y * off.y
    });
    (squares.sum::<f64>() / found.poses.len() as f64).sqrt()
}

#[test]
fn a_second_session_is_tied_by_the_markers_of_the_map() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    // The same markers on other ground, which nothing but them can recognise.
    for (name, seed) in [("monday", 5), ("tuesday", 6)] {
        done(
            here,
            &format!(
                "simulate -o {name} --path eight --length 4 --speed 1 --fps 20 --size 320x240 --format y4m --quiet \
                 --markers apriltag:36h11:100mm:2m --seed {seed}"
            ),
        );
    }
    let markers = |name: &str| fs::read_to_string(here.join(name).join("markers.csv")).unwrap();
    assert_eq!(markers("monday"), markers("tuesday"));
    let run = |name: &str, options: &str| {
        done(here, &format!("run {name}/sim.y4m --camera {name}/camera.yaml --rig {name}/rig.toml {options}"))
    };
    let family = "--markers apriltag:36h11:100mm";
    run("monday", &format!("{family} --map hall.gpkg -o first --quiet"));
    for copy in ["other.gpkg", "monday.gpkg"] {
        fs::copy(here.join("hall.gpkg"), here.join(copy)).unwrap();
    }
    let info = printed(here, "map info hall.gpkg");
    assert!(info.contains("marker 0   apriltag:36h11:100mm at x "), "{info}");

    // It begins elsewhere, and its path is in the frame of the map all the same.
    let messages = run("tuesday", &format!("{family} --start 1.5 --map hall.gpkg -o second"));
    assert!(!messages.contains("was recognised"), "{messages}");
    let off_m = rmse_to_m(here, "tuesday/truth.tum", "second");
    assert!(off_m < 0.005, "{off_m} m");
    let found = statistics(here, "second");
    // Every marker that it passes ties it, not the first alone.
    assert!(found["markers"]["ties"].as_u64().unwrap() > 5, "{}", found["markers"]);
    let info: Value = serde_json::from_str(&printed(here, "map info hall.gpkg --json --check")).unwrap();
    assert_eq!(info["pieces"], 1);
    let known = info["markers"].as_array().unwrap();
    let truth = control_file::parse(&markers("monday")).unwrap();
    assert_eq!(known.len(), truth.len(), "{known:?}");
    for (known, truth) in known.iter().zip(&truth) {
        let at = |name: &str| known[name].as_f64().unwrap();
        let off_m = (at("x_m") - truth.x_m).hypot(at("y_m") - truth.y_m);
        assert!(off_m < 0.005 && at("sigma_m") < 0.02, "{known} {truth:?}");
        assert_eq!(known["number"], truth.number);
    }
    assert!(known.iter().any(|known| known["sessions"] == serde_json::json!([0, 1])), "{known:?}");

    // Markers of another size are others, and so the map is not recognised.
    let messages = run("tuesday", "--markers apriltag:36h11:110mm --start 1.5 --map other.gpkg -o third");
    assert!(messages.contains("nothing of other.gpkg was recognised"), "{messages}");

    // Two maps of the same hall are joined by their markers.
    run("tuesday", &format!("{family} --start 1.5 -o alone --quiet"));
    let joined = printed(here, "map merge monday.gpkg alone/map.gpkg -o joined.gpkg");
    assert!(joined.contains("seen again in 0 places, tied "), "{joined}");
    let info: Value = serde_json::from_str(&printed(here, "map info joined.gpkg --json --check")).unwrap();
    let known = info["markers"].as_array().unwrap();
    assert!(known.len() == truth.len() && info["pieces"] == 1, "{known:?}");
    for (known, truth) in known.iter().zip(&truth) {
        let at = |name: &str| known[name].as_f64().unwrap();
        assert!((at("x_m") - truth.x_m).hypot(at("y_m") - truth.y_m) < 0.005, "{known} {truth:?}");
    }
}
