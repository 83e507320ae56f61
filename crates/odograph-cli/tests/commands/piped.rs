//! Recordings that can be read once.

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
