//! Black-box tests of `odograph undistort`: its output, and refused input.

use odograph::camera::{Camera, Distortion};
use odograph::correction::{FieldOfViewKept, ImageCorrection};
use odograph::formats::camera_file;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn odograph(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_odograph")).args(arguments).output().unwrap()
}

/// A short rendered drive with lens distortion: `frames`, `frames.txt` and `camera.yaml` in the
/// folder.
fn recording(folder: &Path, more: &[&str]) -> PathBuf {
    let drive = folder.join("drive");
    let mut arguments =
        vec!["simulate", "-q", "--size", "160x120", "--duration", "0.2", "--path", "straight", "-o"];
    arguments.push(drive.to_str().unwrap());
    arguments.extend(more);
    let made = odograph(&arguments);
    assert!(made.status.success(), "{made:?}");
    drive
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

fn gray(path: &Path) -> odograph::image::GrayImage {
    let mut source = odograph_video::open(path, &odograph_video::SourceOptions::default()).unwrap();
    source.next_frame().unwrap().unwrap().gray
}

#[test]
fn undistorted_frames_keep_their_timestamps_and_get_a_camera() {
    let temporary = tempfile::tempdir().unwrap();
    let drive = recording(temporary.path(), &[]);
    let camera_path = drive.join("camera.yaml");
    let camera = camera_file::parse(&fs::read_to_string(&camera_path).unwrap(), None).unwrap();
    for (name, kept) in [
        ("same", FieldOfViewKept::SameFocalLength),
        ("valid", FieldOfViewKept::ValidPixels),
        ("all", FieldOfViewKept::AllPixels),
    ] {
        let clean = temporary.path().join(name);
        let frames_txt = drive.join("frames.txt");
        let done = odograph(&[
            "undistort",
            drive.join("frames").to_str().unwrap(),
            "--timestamps",
            frames_txt.to_str().unwrap(),
            "--camera",
            camera_path.to_str().unwrap(),
            "--field-of-view-kept",
            name,
            "-o",
            clean.to_str().unwrap(),
        ]);
        assert_eq!(done.status.code(), Some(0), "{done:?}");
        assert_eq!(names(&clean), ["before-after.png", "camera.yaml", "frames", "frames.txt"]);
        assert_eq!(names(&clean.join("frames")), names(&drive.join("frames")));
        assert_eq!(fs::read(clean.join("frames.txt")).unwrap(), fs::read(frames_txt).unwrap());
        let correction = ImageCorrection::new(&camera, kept).unwrap();
        let written =
            camera_file::parse(&fs::read_to_string(clean.join("camera.yaml")).unwrap(), None).unwrap();
        assert_eq!(&written, correction.camera());
        assert_eq!(written.distortion(), &Distortion::None);
        let expected = correction.apply(&gray(&drive.join("frames/000003.png"))).unwrap();
        assert_eq!(gray(&clean.join("frames/000003.png")), expected);
        assert_eq!(gray(&clean.join("before-after.png")).width(), 320);
    }
}

#[test]
fn streams_are_identical_for_any_number_of_threads() {
    let temporary = tempfile::tempdir().unwrap();
    let drive = recording(temporary.path(), &["--format", "y4m", "--color", "--fps", "12.5"]);
    let undistort = |name: &str, threads: &str, more: &[&str]| {
        let clean = temporary.path().join(name);
        let mut arguments = vec!["undistort", "-q", "--format", "y4m", "--threads", threads, "--camera"];
        let (camera, source) = (drive.join("camera.yaml"), drive.join("sim.y4m"));
        arguments.extend([camera.to_str().unwrap(), source.to_str().unwrap(), "-o", clean.to_str().unwrap()]);
        arguments.extend(more);
        let done = odograph(&arguments);
        assert!(done.status.success() && done.stdout.is_empty() && done.stderr.is_empty(), "{done:?}");
        assert_eq!(names(&clean), ["before-after.png", "camera.yaml", "frames.txt", "undistorted.y4m"]);
        fs::read(clean.join("undistorted.y4m")).unwrap()
    };
    let one = undistort("one", "1", &[]);
    assert!(one.starts_with(b"YUV4MPEG2 W160 H120 F0012500000:0001000000 "), "{:?}", &one[..60]);
    assert_eq!(undistort("three", "3", &[]), one);
    // Gray, and overwriting existing files.
    let gray_frames = undistort("one", "2", &["--gray", "--force"]);
    assert!(gray_frames.len() < one.len() * 3 / 4);
    let mut stream = odograph_video::open(
        temporary.path().join("one/undistorted.y4m"),
        &odograph_video::SourceOptions::default(),
    )
    .unwrap();
    let mut times = Vec::new();
    while let Some(frame) = stream.next_frame().unwrap() {
        times.push(frame.time_s);
    }
    assert!(times.len() > 2 && (times[1] - 0.08).abs() < 1e-6, "{times:?}");
}

#[test]
fn invalid_usage_is_refused_and_leaves_no_files() {
    let temporary = tempfile::tempdir().unwrap();
    let drive = recording(temporary.path(), &[]);
    let (frames, camera) = (drive.join("frames"), drive.join("camera.yaml"));
    let clean = temporary.path().join("clean");
    let refused = |source: &Path, camera: &Path, output: &Path, more: &[&str], code: i32, sentence: &str| {
        let mut arguments = vec!["undistort", source.to_str().unwrap(), "--camera", camera.to_str().unwrap()];
        arguments.extend(["-o", output.to_str().unwrap()]);
        arguments.extend(more);
        let done = odograph(&arguments);
        let message = String::from_utf8(done.stderr).unwrap();
        assert_eq!(done.status.code(), Some(code), "{message}");
        assert!(message.contains(sentence) && message.lines().count() == 1, "{message}");
        assert!(!clean.exists());
    };
    refused(&drive.join("none"), &camera, &clean, &[], 3, "none");
    refused(&frames, &drive.join("none.yaml"), &clean, &[], 3, "none.yaml cannot be read");
    refused(&frames, &camera, &clean, &["--every", "0"], 2, "every 0th frame");
    refused(&frames, &camera, &clean, &["--start", "99"], 3, "no frame in the chosen range");
    refused(&frames, &camera, &camera, &[], 2, "is a file; the results need a folder");
    refused(&frames, &camera, &camera.join("deeper"), &[], 3, "cannot be made");
    refused(&frames, &camera, &drive, &[], 2, "is already there; choose another folder, or --force");
    let other = temporary.path().join("other.yaml");
    let small = Camera::new((64, 48), (50.0, 50.0), (31.5, 23.5), Distortion::None).unwrap();
    fs::write(&other, camera_file::write(&small)).unwrap();
    refused(&frames, &other, &clean, &[], 3, "calibrated for 64x48");
    assert!(names(&drive).iter().all(|name| !name.ends_with(".part")));
}
