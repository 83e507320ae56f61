//! Recordings in which the camera does not move, or hardly.

use crate::program::done;
use serde_json::Value;
use std::fs;

const SIMULATE: &str = "simulate --texture carpet --size 320x240 --height 0.6 -q";
const CAMERA: &str = "--camera still/camera.yaml --height 0.6";
const STANDS: &str = "the camera did not move: in 21 of 21 frames";

#[test]
fn a_camera_at_rest_is_told_from_one_that_moves_a_little() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    done(place, &format!("{SIMULATE} --fps 20 --path still --duration 1 -o still"));
    done(place, &format!("{SIMULATE} --fps 20 --path still --duration 1 --noise 0 -o copies"));
    done(
        place,
        &format!("{SIMULATE} --fps 20 --path straight --length 2mm --speed 0.01 --duration 1 -o creep"),
    );
    for (source, stands) in [("still", true), ("copies", true), ("creep", false)] {
        let said = done(place, &format!("run {source}/frames --fps 20 {CAMERA} -o run-{source}"));
        assert_eq!(said.contains(STANDS), stands, "{source}: {said}");
    }
    let said = done(place, &format!("live still/frames --fps 20 {CAMERA} -o live-still"));
    assert!(said.contains(STANDS), "{said}");
    // Who asks for a place may stand there.
    let said = done(place, "localize still/frames --fps 20 --map run-still/map.gpkg");
    assert!(!said.contains("did not move"), "{said}");
}

#[test]
fn a_bumper_that_is_tracked_instead_of_the_ground_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    // At half of the image a bumper is found; with more, not enough moves.
    for (share, texture, named) in [(0.5, "carpet", false), (0.5, "bricks", true)] {
        let drive =
            format!("--path straight --length 1.5 --speed 0.5 --fps 30 --bumper {share} -o drive --force");
        done(place, &format!("simulate --texture {texture} --size 320x240 --height 1 -q {drive}"));
        let said =
            done(place, "run drive/frames --fps 30 --camera drive/camera.yaml --height 1 -o run --force");
        assert_eq!(said.contains("what was tracked stands still in the image in "), named, "{said}");
        let stats = fs::read_to_string(place.join("run/stats.json")).unwrap();
        let distance_m = serde_json::from_str::<Value>(&stats).unwrap()["distance_m"].as_f64().unwrap();
        assert_eq!((distance_m - 1.5).abs() < 0.01, !named, "{texture}: {distance_m} m");
    }
}
