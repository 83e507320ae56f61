//! What a newcomer meets: defaults, addresses, and a demo whose commands can be pasted.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Output, Stdio};

fn odograph(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_odograph")).args(arguments).current_dir(folder).output().unwrap()
}

fn message(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn done(folder: &Path, arguments: &[&str]) -> String {
    let output = odograph(folder, arguments);
    assert!(output.status.success(), "{arguments:?}: {}", message(&output));
    String::from_utf8(output.stdout).unwrap()
}

/// A short drive in `sim/`.
fn drive(folder: &Path) {
    let simulate = "simulate --path straight --length 40cm --speed 1 --size 160x120 --height 50cm -q -o sim";
    done(folder, &simulate.split(' ').collect::<Vec<_>>());
}

#[test]
fn results_go_beside_the_recording_and_replace_nothing() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    drive(folder);
    let run = ["run", "sim/frames", "--camera", "sim/camera.yaml", "--rig", "sim/rig.toml", "--fps", "30"];
    let first = odograph(folder, &run);
    assert!(
        first.status.success() && message(&first).contains("the results go to sim/frames-run"),
        "{first:?}"
    );
    let before = fs::read(folder.join("sim/frames-run/trajectory.tum")).unwrap();
    done(folder, &run);
    let second = fs::read(folder.join("sim/frames-run-2/trajectory.tum")).unwrap();
    assert!(before == second, "the second run is the first");
    done(folder, &["run", "sim/frames-run/run.toml", "-q"]);
    assert!(before == fs::read(folder.join("sim/frames-run-again/trajectory.tum")).unwrap());

    for expected in ["board.pdf", "board-2.pdf"] {
        done(folder, &["board", "--board", "chessboard:9x6:25mm", "-q"]);
        assert!(folder.join(expected).is_file(), "{expected}");
    }
    done(folder, &["board", "--board", "chessboard:9x6:25mm", "-q", "-o", "new/folder/board.svg"]);
    assert!(folder.join("new/folder/board.svg").is_file());
    done(folder, &["undistort", "sim/frames", "--camera", "sim/camera.yaml", "-q", "--fps", "30"]);
    assert!(folder.join("sim/frames-undistorted/camera.yaml").is_file());
}

#[test]
fn a_page_is_served_at_what_people_type() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    drive(folder);
    let run = "run sim/frames --camera sim/camera.yaml --rig sim/rig.toml --fps 30 -q -o drive";
    done(folder, &run.split(' ').collect::<Vec<_>>());
    for (address, begins) in [
        (":0", "note: look at http://127.0.0.1:"),
        ("localhost:0", "note: look at http://127.0.0.1:"),
        ("0.0.0.0:0", "note: look at http://"),
    ] {
        let mut view = Command::new(env!("CARGO_BIN_EXE_odograph"))
            .args(["view", "drive", "--serve", address])
            .current_dir(folder)
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(view.stderr.take().unwrap()).read_line(&mut line).unwrap();
        view.kill().unwrap();
        view.wait().unwrap();
        assert!(line.starts_with(begins) && !line.contains("0.0.0.0"), "{address}: {line}");
    }
    // A file of a run stands for the run.
    for file in ["report.html", "run.toml", "mosaic.png"] {
        let mut view = Command::new(env!("CARGO_BIN_EXE_odograph"))
            .args(["view", file, "--serve", ":0"])
            .current_dir(folder.join("drive"))
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let lines: Vec<String> =
            BufReader::new(view.stderr.take().unwrap()).lines().take(2).map(Result::unwrap).collect();
        view.kill().unwrap();
        view.wait().unwrap();
        assert!(lines[0].starts_with(&format!("note: {file} is a file of a run")), "{lines:?}");
        assert!(lines[1].starts_with("note: look at http://127.0.0.1:"), "{lines:?}");
    }
    for address in ["hello", "99999", "http://localhost:8080"] {
        let refused = odograph(folder, &["view", "drive", "--serve", address]);
        let message = message(&refused);
        assert_eq!(refused.status.code(), Some(2), "{message}");
        assert!(message.contains("is no address to serve at; give a port as 8080"), "{message}");
    }
}

#[test]
fn the_command_that_the_demo_prints_can_be_pasted() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    // Results that are there already are replaced only if that is asked for.
    fs::create_dir(folder.join("odograph-demo")).unwrap();
    fs::write(folder.join("odograph-demo/stats.json"), "of another run").unwrap();
    let refused = odograph(folder, &["demo"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(
        message(&refused).contains("is already there; choose another folder with -o, or --force"),
        "{refused:?}"
    );
    let said = done(folder, &["demo", "--force"]);
    let command = said.lines().find(|line| line.contains(" run ")).unwrap().trim();
    let pasted = Command::new("sh").args(["-c", command]).current_dir(folder).output().unwrap();
    assert!(pasted.status.success(), "{command}: {}", message(&pasted));
    let path = |run: &str| fs::read(folder.join(run).join("trajectory.tum")).unwrap();
    assert!(path("odograph-demo") == path("odograph-demo-again"));
    assert!(fs::read_to_string(folder.join("odograph-demo/stats.json")).unwrap().starts_with('{'));
}

#[test]
fn help_fits_the_terminal_and_groups_commands_and_options() {
    let temporary = tempfile::tempdir().unwrap();
    let lines = |arguments: &[&str], columns: &str| {
        let mut help = Command::new(env!("CARGO_BIN_EXE_odograph"));
        let output = help.args(arguments).env("COLUMNS", columns).output().unwrap();
        String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect::<Vec<_>>()
    };
    for heading in ["Follow a camera:", "Use maps:", "Set up a camera:"] {
        assert!(lines(&["--help"], "80").iter().any(|line| line == heading), "{heading}");
    }
    for command in ["run", "live", "localize", "ground", "calibrate", "undistort", "simulate", "view"] {
        let help = lines(&[command, "-h"], "80");
        let examples = help.iter().position(|line| line == "Examples:").unwrap_or(help.len());
        let long = help[..examples].iter().find(|line| line.chars().count() > 80);
        assert!(long.is_none(), "{command}: {long:?}");
        assert!(command == "view" || help.iter().any(|line| line == "Results:"), "{command}");
    }

    done(temporary.path(), &["completions", "man"]);
    let page = fs::read_to_string(temporary.path().join("man/odograph-run.1")).unwrap();
    assert!(page.contains("an earlier run.toml"));
    assert!(temporary.path().join("man/odograph-map-merge.1").is_file());
    assert!(done(temporary.path(), &["completions", "bash"]).contains("--field-of-view"));
}

#[test]
fn the_log_is_on_standard_error_and_changes_no_result() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    let simulate = "simulate -o sim --format y4m --size 160x120 --duration 1.5 --blackout 0.8:1.1";
    done(folder, &simulate.split(' ').collect::<Vec<_>>());
    let run = |options: &[&str], results: &str| {
        let run = ["run", "sim/sim.y4m", "--camera", "sim/camera.yaml", "--height", "0.9", "-o", results];
        let output = odograph(folder, &[&run[..], options].concat());
        (
            output.status.code(),
            message(&output),
            fs::read(folder.join(results).join("trajectory.csv")).unwrap(),
        )
    };
    let (_, plain, path) = run(&[], "plain");
    assert!(!plain.contains(" s] "), "{plain}");
    let (_, events, same) = run(&["-v"], "events");
    assert!(path == same);
    for line in [
        "s] source sim/sim.y4m: Y4M (mono), 160x120, 46 frames",
        "s] camera: 160x120, focal length ",
        "s] mount: height 0.9 m",
        ": lost:dark",
        ": tracked",
        "s] track: ",
    ] {
        assert!(events.contains(line), "{line}: {events}");
    }
    assert!(!events.contains("frame 3 at"), "{events}");
    let (_, frames, same) = run(&["-vv"], "frames");
    assert!(path == same);
    assert!(frames.contains("frame 3 at 0.100 s: tracked, ") && frames.contains("tracks agree"), "{frames}");
    assert_eq!(odograph(folder, &["run", "sim/sim.y4m", "-v", "-q"]).status.code(), Some(2));
}

#[test]
fn info_says_what_to_type() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    done(
        folder,
        &"simulate -o sim --format y4m --size 160x120 --duration 0.2".split(' ').collect::<Vec<_>>(),
    );
    let said = done(folder, &["info", "sim/sim.y4m"]);
    assert!(said.contains("odograph run sim/sim.y4m --camera FILE --height LENGTH\n"), "{said}");
    let said = done(folder, &["info", "sim/sim.y4m", "--camera", "sim/camera.yaml"]);
    assert!(said.contains("odograph run sim/sim.y4m --camera sim/camera.yaml --height LENGTH\n"), "{said}");
}

#[test]
fn a_terminal_without_a_width_gets_lines_of_help() {
    let help = |columns: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
        let output = command.arg("--help").env("COLUMNS", columns).output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    };
    for columns in ["0", "1"] {
        assert!(
            help(columns).contains("One video camera in, a metric trajectory and map out\n"),
            "{columns}"
        );
    }
}

#[test]
#[cfg(unix)]
fn a_name_that_is_no_text_is_named() {
    use std::os::unix::ffi::OsStrExt;
    let name = std::ffi::OsStr::from_bytes(b"dr\xffve.mp4");
    let output = Command::new(env!("CARGO_BIN_EXE_odograph")).arg("info").arg(name).output().unwrap();
    let said = message(&output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("the name dr\u{fffd}ve.mp4 is not UTF-8 text; rename the file"), "{said}");
}

/// Without the feature `ros2`, everything of ROS 2 is refused with how to have it.
#[cfg(not(feature = "ros2"))]
#[test]
fn ros_2_is_another_build_of_the_program() {
    let temporary = tempfile::tempdir().unwrap();
    for (source, option) in
        [("ros2:/camera/image_raw", ""), ("/dev/video0", "--ros2"), ("/dev/video0", "--gyro-topic=/imu")]
    {
        let arguments = ["live", source, "--height", "1", option];
        let arguments: Vec<&str> = arguments.into_iter().filter(|argument| !argument.is_empty()).collect();
        let refused = odograph(temporary.path(), &arguments);
        let asked = if option.is_empty() { source } else { option.split('=').next().unwrap() };
        let sentence = format!(
            "error: {asked}: this program is built without ROS 2; `cargo install --locked --path crates/odograph-cli \
             --features ros2` builds it with ROS 2\n"
        );
        assert_eq!((refused.status.code(), message(&refused)), (Some(2), sentence));
    }
}

#[test]
fn help_that_cannot_be_written_is_an_error() {
    let Ok(full) = fs::OpenOptions::new().write(true).open("/dev/full") else {
        println!("skipped: dev-full: there is no /dev/full");
        return;
    };
    for arguments in [&["--help"][..], &["run", "--help"], &["--version"]] {
        let output = Command::new(env!("CARGO_BIN_EXE_odograph"))
            .args(arguments)
            .stdout(full.try_clone().unwrap())
            .stderr(Stdio::piped())
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(3), "{arguments:?}");
        let message = message(&output);
        assert!(message.starts_with("error: standard output cannot be written: "), "{message}");
        assert_eq!(message.lines().count(), 1, "{message}");
    }
}

#[test]
#[cfg(unix)]
fn a_limit_of_the_file_size_is_an_error_of_the_write() {
    let place = tempfile::tempdir().unwrap();
    let program = env!("CARGO_BIN_EXE_odograph");
    let limited = format!("ulimit -f 20; exec '{program}' simulate --path still --duration 0.1 -o sim");
    let output = Command::new("sh").args(["-c", &limited]).current_dir(place.path()).output().unwrap();
    let message = message(&output);
    assert_eq!(output.status.code(), Some(3), "{message}");
    assert!(
        message.contains("cannot be written: File too large") && message.contains("ulimit -f"),
        "{message}"
    );
    assert!(!place.path().join("sim").exists(), "{message}");
}
