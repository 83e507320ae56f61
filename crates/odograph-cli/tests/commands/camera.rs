//! Black-box tests of `odograph camera`: conversions, and refused input.

use odograph::formats::camera_file;
use std::fs;
use std::process::{Command, Output};

fn odograph(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_odograph")).args(arguments).output().unwrap()
}

const FIVE: &str = "image_width: 640\nimage_height: 480\ncamera_matrix: [532.83, 0, 342.49, 0, 532.95, 233.86, 0, 0, 1]\n\
                    distortion_coefficients: [-0.28088, 0.02518, 0.00122, -0.00014, 0.16343]\n";

/// Writes `text` as `camera.yaml` into a temporary folder.
fn folder_with(text: &str) -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("camera.yaml");
    fs::write(&path, text).unwrap();
    let path = path.to_str().unwrap().to_owned();
    (folder, path)
}

#[test]
fn every_format_is_written_and_read_back() {
    let (folder, camera) = folder_with(&FIVE.replace(", 0.16343]", "]"));
    let expected = camera_file::parse(&fs::read_to_string(&camera).unwrap(), None).unwrap();
    for (name, mark) in [
        ("cameras.txt", "1 OPENCV 640 480 532.83 532.95 342.99 234.36 "),
        ("robot-camchain.yaml", "distortion_model: radtan"),
        ("camera_info.yaml", "projection_matrix:"),
        ("intrinsics.yml", "!!opencv-matrix"),
    ] {
        let output = folder.path().join(name);
        let done = odograph(&["camera", "convert", &camera, "-o", output.to_str().unwrap()]);
        assert_eq!(done.status.code(), Some(0), "{done:?}");
        let text = fs::read_to_string(&output).unwrap();
        assert!(text.contains(mark), "{text}");
        let back = camera_file::parse(&text, None).unwrap();
        assert_eq!(back.focal_px(), expected.focal_px());
        assert_eq!(back.distortion(), expected.distortion());
        assert!(
            (back.principal_px().0 - 342.49).abs() < 1e-9 && (back.principal_px().1 - 233.86).abs() < 1e-9
        );
    }
    let printed = odograph(&["camera", "convert", &camera, "--to", "ros"]);
    assert!(String::from_utf8_lossy(&printed.stdout).contains("distortion_model: plumb_bob"));
    let shown = odograph(&["camera", "show", &camera]);
    let shown = String::from_utf8_lossy(&shown.stdout).into_owned();
    assert!(shown.contains("640x480 pixels") && shown.contains("field of view    6"), "{shown}");
}

#[test]
fn impossible_conversions_are_refused_in_one_sentence() {
    let (folder, camera) = folder_with(FIVE);
    let there = folder.path().join("cameras.txt");
    fs::write(&there, "mine").unwrap();
    let there = there.to_str().unwrap();
    let not_a_camera = folder.path().join("notes.yaml");
    fs::write(&not_a_camera, "milk\n").unwrap();
    let not_a_camera = not_a_camera.to_str().unwrap();
    for (arguments, code, part) in [
        (vec![camera.as_str(), "--to", "kalibr"], 2, "the camera's k3 is 0.16343"),
        (vec![camera.as_str()], 2, "no format is given"),
        (vec![camera.as_str(), "-o", "other.yaml"], 2, "does not say which format"),
        (vec![camera.as_str(), "-o", there], 2, "is already there"),
        (vec![camera.as_str(), "--to", "nerf"], 2, "no camera format `nerf`"),
        (vec![camera.as_str(), "--to", "ros", "--size", "big"], 2, "not a size in pixels"),
        (vec![not_a_camera, "--to", "ros"], 3, "instead of keys"),
        (vec!["nowhere.yaml", "--to", "ros"], 3, "nowhere.yaml cannot be read"),
    ] {
        let done = odograph(&[vec!["camera", "convert"], arguments.clone()].concat());
        let said = String::from_utf8_lossy(&done.stderr).into_owned();
        assert_eq!(done.status.code(), Some(code), "{arguments:?}: {said}");
        assert!(said.contains(part), "{arguments:?}: {said}");
    }
    assert_eq!(fs::read_to_string(there).unwrap(), "mine");
    let forced = odograph(&["camera", "convert", &camera, "-o", there, "--force"]);
    assert!(forced.status.success() && fs::read_to_string(there).unwrap().contains("FULL_OPENCV"));
}

#[test]
fn a_file_without_a_size_takes_the_one_given() {
    let text: String = FIVE.lines().skip(2).map(|line| format!("{line}\n")).collect();
    let (_folder, camera) = folder_with(&text);
    let without = odograph(&["camera", "convert", &camera, "--to", "opencv"]);
    assert_eq!(without.status.code(), Some(3));
    let with = odograph(&["camera", "convert", &camera, "--to", "opencv", "--size", "640x480"]);
    assert!(String::from_utf8_lossy(&with.stdout).contains("image_width: 640"), "{with:?}");
}
