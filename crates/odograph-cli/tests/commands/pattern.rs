//! Recordings in which the camera adds a pattern to its images.

use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::Command;

fn odograph(arguments: &str, folder: &Path) {
    let program = env!("CARGO_BIN_EXE_odograph");
    let output = Command::new(program).args(arguments.split(' ')).current_dir(folder).output().unwrap();
    assert!(output.status.success(), "{arguments}: {output:?}");
}

/// Halves the contrast of a Y4M stream of gray images and adds blocks of 3x3 pixels, the same in
/// every image.
fn dirty(stream: &mut [u8], (width, height): (usize, usize)) {
    const FRAME: &[u8] = b"FRAME\n";
    let mut at = stream.iter().position(|&byte| byte == b'\n').unwrap() + 1;
    while at < stream.len() {
        at += FRAME.len();
        for (index, sample) in stream[at..at + width * height].iter_mut().enumerate() {
            let block = (index % width / 3 + 1000 * (index / width / 3)) as u64;
            let dirt = block.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 59;
            *sample = 48 + *sample / 2 + dirt as u8;
        }
        at += width * height;
    }
}

#[test]
fn a_pattern_is_subtracted_from_the_first_frame_on_and_a_map_is_continued_once() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    odograph(
        "simulate --texture concrete --path straight --length 1.2 --speed 0.4 --size 320x240 --height 0.75 \
         --noise 1 --format y4m -o drive -q",
        place,
    );
    let video = fs::read_dir(place.join("drive")).unwrap().map(|entry| entry.unwrap().path());
    let video = video.into_iter().find(|path| path.extension().is_some_and(|end| end == "y4m")).unwrap();
    let mut stream = fs::read(&video).unwrap();
    assert!(stream.windows(5).take(100).any(|word| word == b"Cmono"), "one plane a frame");
    dirty(&mut stream, (320, 240));
    fs::write(place.join("dirty.y4m"), stream).unwrap();
    for run in ["first", "second"] {
        let camera = "--camera drive/camera.yaml --height 0.75 --map map.gpkg";
        odograph(&format!("run dirty.y4m {camera} -o {run} -q"), place);
        let stats = fs::read_to_string(place.join(run).join("stats.json")).unwrap();
        let stats: Value = serde_json::from_str(&stats).unwrap();
        assert_eq!(stats["frames_with_pose"], stats["frames"], "{run}");
        let gray = stats["fixed_in_image"]["pattern_gray"].as_f64().expect("found");
        // Uniform in 32 levels: a standard deviation of 9.2.
        assert!((gray - 9.2).abs() < 1.5, "{run}: {gray}");
        let distance_m = stats["distance_m"].as_f64().unwrap();
        assert!((distance_m - 1.2).abs() < 0.01, "{run}: {distance_m} m");
    }
    // The examination begins again with the pattern, as the run does.
    let program = env!("CARGO_BIN_EXE_odograph");
    let examine = "doctor dirty.y4m --camera drive/camera.yaml --height 0.75 --json";
    let done = Command::new(program).args(examine.split(' ')).current_dir(place).output().unwrap();
    let diagnosis: Value = serde_json::from_slice(&done.stdout).unwrap();
    let finding = |topic: &str| {
        let findings = diagnosis["findings"].as_array().unwrap();
        findings.iter().find(|finding| finding["topic"] == topic).cloned().expect(topic)
    };
    assert!(finding("tracking")["value"] == 0.0, "{}", finding("tracking"));
    assert!((finding("fixed pattern")["value"].as_f64().unwrap() - 9.2).abs() < 1.5, "{diagnosis}");
    // The frames up to where the pattern was found are not in the map twice.
    let info = Command::new(program).args(["map", "info", "map.gpkg"]).current_dir(place).output().unwrap();
    let info = String::from_utf8(info.stdout).unwrap();
    assert_eq!(info.lines().filter(|line| line.starts_with("session ")).count(), 2, "{info}");
}

#[test]
fn a_robot_that_sees_its_bumper_is_found_by_the_ground_alone() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    let drive = "simulate --texture asphalt --path straight --length 2 --speed 0.5 --size 320x240 --height 0.75 \
                 --bumper 0.25 -q";
    odograph(&format!("{drive} -o here"), place);
    odograph("run here/frames --fps 30 --camera here/camera.yaml --height 0.75 -o run -q", place);
    let program = env!("CARGO_BIN_EXE_odograph");
    let truth = fs::read_to_string(place.join("here/truth.tum")).unwrap();
    let truth: Vec<f64> = truth
        .lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| line.split(' ').nth(1).unwrap().parse().unwrap())
        .collect();
    for frame in [10, 47, 100] {
        let picture = format!("localize here/frames/{frame:06}.png --map run/map.gpkg --json");
        let done = Command::new(program).args(picture.split(' ')).current_dir(place).output().unwrap();
        let found: Value = serde_json::from_slice(&done.stdout).unwrap();
        let x_m = found["place"]["x_m"].as_f64().unwrap();
        assert!((x_m - truth[frame]).abs() < 1e-3, "{frame}: {found}");
    }
    // Rendered again from the map, too.
    odograph("map mosaic run/map.gpkg -o mosaic.png", place);
    let info =
        Command::new(program).args(["map", "info", "run/map.gpkg"]).current_dir(place).output().unwrap();
    let info = String::from_utf8(info.stdout).unwrap();
    assert!(info.contains(" % of its images is masked: it does not show the ground"), "{info}");
}
