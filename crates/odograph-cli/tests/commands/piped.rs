//! Recordings that can be read once.

use super::program::{done, done_once};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

fn odograph(arguments: &str, folder: &Path, input: Stdio) {
    let program = env!("CARGO_BIN_EXE_odograph");
    let mut command = Command::new(program);
    let output = command.args(arguments.split(' ')).current_dir(folder).stdin(input).output().unwrap();
    assert!(output.status.success(), "{arguments}: {output:?}");
}

#[test]
fn a_folder_named_as_standard_input_does_not_hide_it() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    odograph(
        "simulate --path straight --length 0.3 --size 320x240 --fps 15 --format y4m -o drive -q",
        place,
        Stdio::null(),
    );
    // A recording in it would be followed instead.
    fs::create_dir(place.join("-")).unwrap();
    fs::copy(place.join("drive/sim.y4m"), place.join("-/other.y4m")).unwrap();
    let piped = || fs::File::open(place.join("drive/sim.y4m")).unwrap().into();
    odograph("run - --camera drive/camera.yaml --height 0.9 -o out -q", place, piped());
    let plan = fs::read_to_string(place.join("out/run.toml")).unwrap();
    assert!(plan.contains("path = \"-\""), "{plan}");
    // A map of half a metre of asphalt is too small to be sure of a place in it.
    let mut localize = Command::new(env!("CARGO_BIN_EXE_odograph"));
    localize.args("localize - --map out/map.gpkg --extend".split(' ')).current_dir(place).stdin(piped());
    let output = localize.output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(4) && told.contains("standard input looks like"), "{told}");
}

#[test]
fn a_readout_time_longer_than_the_interval_between_frames_is_doubted() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    done_once(
        place,
        "simulate -o sim --path straight --length 0.3 --size 320x240 --fps 15 --format mjpeg -q",
    );
    let run = "run sim/sim.avi --camera sim/camera.yaml --height 0.9";
    let told = done(place, &format!("{run} --readout-ms 67 -o wrong"));
    assert!(told.contains("the readout time is 67.0 ms, longer than the 66.7 ms"), "{told}");
    assert!(!done(place, &format!("{run} --readout-ms 20 -o right")).contains("readout time is 20"));
}

#[test]
fn an_unknown_readout_time_is_found_in_what_is_read_once() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    odograph(
        "simulate --texture asphalt --path eight --length 1.2 --speed 0.6 --size 320x240 --height 0.75 \
         --noise 1 --rolling --readout-ms 20 --fps 30 --format y4m -o drive -q",
        place,
        Stdio::null(),
    );
    let video = fs::read_dir(place.join("drive")).unwrap().map(|entry| entry.unwrap().path());
    let video = video.into_iter().find(|path| path.extension().is_some_and(|end| end == "y4m")).unwrap();
    let piped = fs::File::open(&video).unwrap();
    odograph("run - --camera drive/camera.yaml --height 0.75 -o out -q", place, piped.into());
    let stats: Value =
        serde_json::from_str(&fs::read_to_string(place.join("out/stats.json")).unwrap()).unwrap();
    let readout_ms = stats["readout"]["readout_ms"].as_f64().unwrap();
    assert!((readout_ms - 20.0).abs() < 0.5, "{}", stats["readout"]);
    // The eight is 3.631 m long; taken for a global shutter, 0.2 m more. Measured: 6 mm.
    let distance_m = stats["distance_m"].as_f64().unwrap();
    assert!((distance_m - 3.631).abs() < 0.02, "{distance_m} m");
}
