//! Black-box tests of `odograph simulate`.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

/// Runs the command with a small image and a short recording, unless the options say otherwise.
fn simulate(folder: &Path, options: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
    command.arg("simulate").arg("--output").arg(folder).args(options);
    for (option, value) in [("--size", "96x72"), ("--duration", "0.3")] {
        if !options.contains(&option) {
            command.args([option, value]);
        }
    }
    command.output().unwrap()
}

fn wrote(folder: &Path, options: &[&str]) {
    let output = simulate(folder, options);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// All files below a folder with their contents.
fn contents(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let mut found = vec![];
    let mut folders = vec![folder.to_path_buf()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().display().to_string();
                found.push((name, fs::read(&path).unwrap()));
            }
        }
    }
    found.sort();
    found
}

#[test]
fn a_recording_has_frames_timestamps_truth_camera_and_rig() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path().join("sim");
    wrote(&folder, &["--path", "eight", "--roll", "-2", "--vibration", "2:0.3:8", "--blur", "0.005"]);
    let names: Vec<String> = contents(&folder).into_iter().map(|(name, _)| name).collect();
    let pictures: Vec<String> = (0..10).map(|i| format!("frames/{i:06}.png")).collect();
    let mut wanted: Vec<&str> = vec!["camera.yaml", "frames.txt", "rig.toml", "simulation.toml", "truth.tum"];
    wanted.extend(pictures.iter().map(String::as_str));
    wanted.sort_unstable();
    assert_eq!(names, wanted);
    let text = |name: &str| fs::read_to_string(folder.join(name)).unwrap();
    let lines = |name: &str| -> Vec<String> {
        text(name).lines().filter(|line| !line.starts_with('#')).map(str::to_string).collect()
    };
    let (times, truth) = (lines("frames.txt"), lines("truth.tum"));
    assert_eq!((times.len(), truth.len()), (10, 10));
    for (time, pose) in times.iter().zip(&truth) {
        assert_eq!(time.split(' ').next(), pose.split(' ').next(), "frames and truth tell the same times");
        assert_eq!(pose.split(' ').count(), 8);
    }
    assert!(truth[0].starts_with("0.000000000 0.000000000 0.000000000 0.900000000 "));
    let camera = odograph::formats::camera_file::parse(&text("camera.yaml"), None).unwrap();
    assert_eq!((camera.width(), camera.height()), (96, 72));
    let rig = odograph::formats::rig_file::parse(&text("rig.toml")).unwrap();
    assert!((rig.roll_rad.to_degrees() + 2.0).abs() < 1e-12 && rig.height_m == 0.9);
    assert!(text("simulation.toml").contains("figure-eight"));
}

#[test]
fn realistic_effects_are_deterministic_for_any_thread_count() {
    let scratch = tempfile::tempdir().unwrap();
    let options = "--readout-ms 20 --bumper --dirt --lamp --relief 8 --undulation 4:1.5 --kerb -5:0.2 --ramp 5 --ride \
                   --sway 2 --breathing 1 --vibration 1 --blur 0.005 --object --color";
    let options: Vec<&str> = options.split_whitespace().collect();
    for (name, threads) in [("one", "1"), ("many", "5")] {
        wrote(&scratch.path().join(name), &[options.as_slice(), &["--threads", threads]].concat());
    }
    assert!(contents(&scratch.path().join("one")) == contents(&scratch.path().join("many")));
    let parameters = fs::read_to_string(scratch.path().join("one/simulation.toml")).unwrap();
    for message in
        ["readout_s = 0.02", "[effects.terrain.kerb]", "[effects.bumper]", "[effects.sway]", "ride = true"]
    {
        assert!(parameters.contains(message), "{message} is not in {parameters}");
    }
}

#[test]
fn the_readout_time_is_written_only_on_request() {
    let scratch = tempfile::tempdir().unwrap();
    let camera = |name: &str, options: &[&str]| {
        let folder = scratch.path().join(name);
        wrote(&folder, options);
        fs::read_to_string(folder.join("camera.yaml")).unwrap()
    };
    assert!(!camera("silent", &["--readout-ms", "20"]).contains("readout"));
    let message = camera("message", &["--readout-ms", "20", "--tell-readout"]);
    assert!(message.ends_with("readout_time_s: 0.02\n"), "{message}");
    assert!(odograph::formats::camera_file::parse(&message, None).is_ok());
    let output = simulate(&scratch.path().join("slow"), &["--readout-ms", "40"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("longer than the time between frames"));
}

#[test]
fn recordings_are_deterministic_for_any_thread_count() {
    let scratch = tempfile::tempdir().unwrap();
    let options =
        ["--path", "walk", "--seed", "9", "--noise", "3", "--object", "--shadow", "--lighting", "--color"];
    for (name, threads) in [("one", "1"), ("many", "5")] {
        wrote(&scratch.path().join(name), &[options.as_slice(), &["--threads", threads]].concat());
    }
    let (one, many) = (contents(&scratch.path().join("one")), contents(&scratch.path().join("many")));
    assert_eq!(one.len(), many.len());
    for (a, b) in one.iter().zip(&many) {
        assert!(a == b, "{} differs", a.0);
    }
}

#[test]
fn its_camera_file_can_be_used_as_input() {
    let scratch = tempfile::tempdir().unwrap();
    let (first, second) = (scratch.path().join("first"), scratch.path().join("second"));
    wrote(&first, &[]);
    let camera = first.join("camera.yaml");
    wrote(&second, &["--camera", camera.to_str().unwrap()]);
    assert_eq!(fs::read(&camera).unwrap(), fs::read(second.join("camera.yaml")).unwrap());
    assert_eq!(
        fs::read(first.join("frames/000005.png")).unwrap(),
        fs::read(second.join("frames/000005.png")).unwrap()
    );
    let clash =
        simulate(&scratch.path().join("third"), &["--camera", camera.to_str().unwrap(), "--height", "NaN"]);
    assert_eq!(clash.status.code(), Some(2));
}

#[test]
fn video_files_contain_all_frames() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path().join("sim");
    wrote(&folder, &["--format", "y4m"]);
    let stream = fs::read(folder.join("sim.y4m")).unwrap();
    let header = stream.iter().position(|b| *b == b'\n').unwrap() + 1;
    assert!(stream.starts_with(b"YUV4MPEG2 W96 H72 F30:1 "));
    assert_eq!(stream.len(), header + 10 * (6 + 96 * 72));
    // Another format replaces the first: the folder never contains two recordings.
    wrote(&folder, &["--format", "mjpeg", "--color", "--force", "--quiet"]);
    assert!(!folder.join("sim.y4m").exists());
    let avi = fs::read(folder.join("sim.avi")).unwrap();
    assert_eq!(avi.windows(3).filter(|w| *w == b"\xff\xd8\xff").count(), 10);
    wrote(&folder, &["--force"]);
    assert!(!folder.join("sim.avi").exists() && folder.join("frames/000009.png").exists());
}

#[test]
fn a_photograph_can_be_the_ground() {
    let scratch = tempfile::tempdir().unwrap();
    let first = scratch.path().join("first");
    wrote(&first, &["--color", "--texture", "bricks"]);
    let photograph = first.join("frames/000000.png");
    let folder = scratch.path().join("second");
    let photograph = photograph.to_str().unwrap();
    wrote(
        &folder,
        &["--texture", photograph, "--texture", "grass", "--photo-width", "1.5", "--tiling", "scatter"],
    );
    assert!(folder.join("truth.tum").exists());
}

/// Calibrates with a simulated board; returns the figures that were printed as JSON.
fn calibrated(folder: &Path, options: &str) -> serde_json::Value {
    let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
    let output = command.current_dir(folder).arg("calibrate").args(options.split(' ')).output().unwrap();
    assert!(output.status.success(), "{options}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn a_simulated_board_calibrates_to_the_true_camera() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    for board in ["chessboard:7x5:30mm", "charuco:6x8:30mm", "aprilgrid:4x3:40mm", "circles:7x5:20mm"] {
        let options = ["--board", board, "--size", "480x360", "--fps", "2", "--duration", "24", "--force"];
        let output = simulate(&folder.join("sim"), &options);
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert!(said.contains(&format!("sim/board.avi --board {board}")), "{said}");
        let calibrate = format!("sim/board.avi --board {board} -o found.yaml --model brown4 --json --force");
        let figures = calibrated(folder, &calibrate);
        let camera = |name: &str| {
            let text = fs::read_to_string(folder.join(name)).unwrap();
            odograph::formats::camera_file::parse(&text, None).unwrap()
        };
        let (found, truth) = (camera("found.yaml"), camera("sim/camera.yaml"));
        let deviation = |name: &str| figures["parameters"][name]["deviation"].as_f64().unwrap();
        for (name, found, truth) in
            [("fx", found.focal_px().0, truth.focal_px().0), ("fy", found.focal_px().1, truth.focal_px().1)]
        {
            // The middle of a disc's image is not the image of its middle: a few thousandths.
            let bias = if board.starts_with("circles") { 2e-3 * truth } else { 0.0 };
            assert!((found - truth).abs() < 3.5 * deviation(name) + bias, "{board}: {name} {found} {truth}");
        }
    }
}

#[test]
fn a_simulated_board_replaces_a_drive_and_is_deterministic() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path().join("sim");
    wrote(&folder, &[]);
    let options = ["--board", "chessboard:7x5:30mm", "--format", "png", "--duration", "1", "--fps", "4"];
    wrote(&folder, &[options.as_slice(), &["--force", "--threads", "1"]].concat());
    let names: Vec<String> = contents(&folder).into_iter().map(|(name, _)| name).collect();
    let pictures = (0..5).map(|i| format!("frames/{i:06}.png"));
    let beside = ["camera.yaml", "frames.txt", "simulation.toml", "truth.tum"].map(str::to_owned);
    let mut wanted: Vec<String> = pictures.chain(beside).collect();
    wanted.sort();
    assert_eq!(names, wanted, "rig.toml of the drive is gone");
    let again = scratch.path().join("again");
    wrote(&again, &[options.as_slice(), &["--threads", "3"]].concat());
    assert!(contents(&folder) == contents(&again));
    let poses = fs::read_to_string(folder.join("truth.tum")).unwrap();
    assert_eq!(poses.lines().filter(|line| !line.starts_with('#')).count(), 5);
    assert!(fs::read_to_string(folder.join("simulation.toml")).unwrap().contains("chessboard:7x5:30mm"));
}

#[test]
fn options_without_effect_are_refused_by_name() {
    let scratch = tempfile::tempdir().unwrap();
    for (options, says) in [
        ("--path eight --lanes 3", "--lanes has no effect with --path eight, only with lanes"),
        (
            "--path pivot --speed 1",
            "--speed has no effect with --path pivot, only with straight, square, square-turns, eight, lanes or walk",
        ),
        (
            "--tiling scatter",
            "--tiling has no effect without a photograph as --texture; asphalt is a texture of its own",
        ),
        ("--ride", "--ride has nothing to follow on flat ground; add --undulation, --kerb or --ramp"),
        ("--board chessboard:9x6:25mm --lanes 2", "cannot be used with"),
    ] {
        let folder = scratch.path().join("sim");
        let output = simulate(&folder, &options.split(' ').collect::<Vec<_>>());
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{options}: {message}");
        assert!(message.contains(says) && !folder.exists(), "{options}: {message}");
    }
}

#[test]
fn nothing_is_overwritten_without_force() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path().join("sim");
    wrote(&folder, &[]);
    fs::write(folder.join("frames/mine.txt"), "mine").unwrap();
    let before = contents(&folder);
    let refused = simulate(&folder, &["--seed", "2"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("--force"));
    assert_eq!(contents(&folder), before);
    wrote(&folder, &["--seed", "2", "--duration", "0.1", "--force"]);
    assert_eq!(fs::read_to_string(folder.join("frames/mine.txt")).unwrap(), "mine");
    assert!(!folder.join("frames/000009.png").exists(), "frames of the longer run are gone");
}

#[test]
fn invalid_options_are_refused_and_write_nothing() {
    let scratch = tempfile::tempdir().unwrap();
    let text = scratch.path().join("floor.png");
    fs::write(&text, "not a picture").unwrap();
    let text = text.to_str().unwrap();
    for (options, code, says) in [
        (vec!["--height", "-1"], 2, "height is -1"),
        (vec!["--height", "nan"], 2, "height is NaN"),
        (vec!["--roll", "95"], 2, "does not look at the ground"),
        (vec!["--fps", "0"], 2, "frame rate is 0"),
        (vec!["--noise", "-3"], 2, "noise is -3"),
        (vec!["--speed", "0"], 2, "speed is 0"),
        (vec!["--texture", "lava"], 2, "textures are asphalt"),
        (vec!["--texture", text], 3, "neither PNG nor JPEG"),
        (vec!["--texture", "missing.jpg"], 3, "cannot be read"),
        (vec!["--texture", "bare", "--texture", "grass", "--texture", "tiles"], 2, "two are the limit"),
        (vec!["--camera", "missing.yaml"], 3, "missing.yaml"),
        (vec!["--size", "9x9"], 2, "640x480"),
        (vec!["--blackout", "4:2"], 2, "FROM:TO"),
        (vec!["--format", "y4m", "--dropped", "0.2"], 2, "--format png"),
        (vec!["--path", "pivot", "--pitch", "-75"], 2, "pivot"),
    ] {
        let folder = scratch.path().join("sim");
        let output = simulate(&folder, &options);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{options:?}: {message}");
        assert!(message.contains(says), "{options:?}: {message}");
        assert!(!message.contains("panicked") && !folder.exists(), "{options:?}: {message}");
    }
}

#[test]
fn a_folder_that_cannot_be_created_is_reported() {
    let scratch = tempfile::tempdir().unwrap();
    let file = scratch.path().join("file");
    fs::write(&file, "").unwrap();
    let output = simulate(&file.join("sim"), &[]);
    assert_eq!(output.status.code(), Some(3));
    assert!(String::from_utf8_lossy(&output.stderr).contains("cannot be made"));
}

#[test]
#[cfg(unix)]
fn an_interrupted_simulation_leaves_nothing() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path().join("sim");
    let mut child = Command::new(env!("CARGO_BIN_EXE_odograph"))
        .args(["simulate", "--size", "640x480", "--duration", "600", "--threads", "1", "-o"])
        .arg(&folder)
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let first = folder.join("frames.part/000000.png");
    while !first.exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended before its first frame");
        std::thread::yield_now();
    }
    let sent = Command::new("sh").args(["-c", &format!("kill -INT {}", child.id())]).status().unwrap();
    assert!(sent.success());
    let done = child.wait_with_output().unwrap();
    assert_eq!(done.status.code(), Some(130));
    assert_eq!(String::from_utf8_lossy(&done.stderr), "error: interrupted; nothing was written\n");
    assert!(!folder.exists());
}
