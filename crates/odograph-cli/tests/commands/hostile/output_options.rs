//! Every option that names an output, with places that cannot be written to.

use super::super::calibrate::boards;
use super::recording::{names, y4m};
use super::run_folder::{HostileFolder, Mounted, assert_refused};
use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::os::unix::fs::symlink;
use std::process::{Command, Stdio};

/// What an option names.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Named {
    Folder,
    /// A file with this ending.
    File(&'static str),
    /// A file that is written while the run goes on, whose folder must be there.
    Record(&'static str),
}

/// Calls with the output as `@`.
const CALLS: [(Named, &str); 29] = [
    (Named::Folder, "run drive.y4m --camera camera.yaml --height 1 -o @"),
    (Named::Folder, "live drive.y4m --camera camera.yaml --height 1 -o @"),
    (Named::Folder, "localize drive.y4m --map map.gpkg -o @"),
    (Named::Folder, "simulate --duration 0.1 --size 64x48 -o @"),
    (Named::Folder, "simulate --duration 0.1 --size 64x48 --format y4m -o @"),
    (Named::Folder, "simulate --duration 0.1 --size 64x48 --format mjpeg -o @"),
    (Named::Folder, "simulate --board chessboard:7x5:30mm --duration 0.1 --size 64x48 -o @"),
    (Named::Folder, "undistort drive.y4m --camera camera.yaml -o @"),
    (Named::Folder, "undistort drive.y4m --camera camera.yaml --format y4m -o @"),
    (Named::Folder, "demo -o @"),
    (Named::Folder, "completions man -o @"),
    (Named::Folder, "map export map.gpkg -o @"),
    (Named::Folder, "calibrate board --board chessboard:7x5:30mm -o new.yaml --report @"),
    (Named::File("yaml"), "calibrate board --board chessboard:7x5:30mm -o @"),
    (Named::File("toml"), "ground board/board00.png --board chessboard:7x5:30mm --camera lens.yaml -o @"),
    (Named::File("html"), "doctor drive.y4m --camera camera.yaml -q -o @"),
    (Named::File("pdf"), "board --board chessboard:9x6:25mm -o @"),
    (Named::File("yaml"), "camera convert camera.yaml --to ros -o @"),
    (Named::File("svg"), "evaluate ran/trajectory.tum ran/trajectory.tum --plot @"),
    (Named::File("gpkg"), "map merge map.gpkg other.gpkg -o @"),
    (Named::File("tif"), "map export map.gpkg -o @"),
    (Named::File("png"), "map mosaic map.gpkg -o @"),
    (Named::File("ply"), "map export map.gpkg -o @"),
    (Named::File("tum"), "map export map.gpkg -o @"),
    (Named::File("gpkg"), "map optimize map.gpkg -o @"),
    (Named::File("gpkg"), "map repair map.gpkg -o @"),
    (Named::Record("mcap"), "run drive.y4m --camera camera.yaml --height 1 -o new --bag-out @"),
    (Named::Record("avi"), "run drive.y4m --camera camera.yaml --height 1 -o new --video-out @"),
    (Named::Record("mcap"), "live drive.y4m --camera camera.yaml --height 1 -o new --mcap @"),
];

/// Options without `--force`.
const WITHOUT_FORCE: [&str; 1] = ["completions"];

/// The files that the calls name.
fn fill(place: &HostileFolder) {
    fs::write(place.path("drive.y4m"), y4m(12)).unwrap();
    assert!(place.run("drive.y4m --camera camera.yaml --height 1 -o ran").status.success());
    for map in ["map.gpkg", "other.gpkg"] {
        fs::copy(place.path("ran/map.gpkg"), place.path(map)).unwrap();
    }
    boards::folder(&place.path("board"), &boards::pictures(&boards::scene(), 20));
    let lens = odograph::formats::camera_file::write(&boards::camera());
    fs::write(place.path("lens.yaml"), lens).unwrap();
}

/// One that has no byte left, and one that is read-only.
fn unwritable(place: &HostileFolder) -> Option<[Mounted; 2]> {
    let (full, read_only) = (place.path("full"), place.path("read-only"));
    let mounted = Mounted::new(&full, "size=16k,nr_inodes=100")?;
    let mut filler = fs::File::create(full.join("filler")).unwrap();
    while filler.write_all(&[0; 512]).is_ok() {}
    let other = Mounted::new(&read_only, "ro")?;
    Some([mounted, other])
}

#[test]
fn every_output_that_cannot_be_written_is_refused_in_one_sentence() {
    let place = HostileFolder::new();
    fill(&place);
    fs::write(place.path("plain"), "mine").unwrap();
    let mounted = unwritable(&place);
    let mut wrong = String::new();
    for (named, call) in CALLS {
        let ending = match named {
            Named::Folder => String::new(),
            Named::File(ending) | Named::Record(ending) => format!(".{ending}"),
        };
        let (taken, device) = (format!("taken{ending}"), format!("device{ending}"));
        match named {
            Named::Folder => fs::write(place.path(&taken), "mine").unwrap(),
            _ => fs::create_dir(place.path(&taken)).unwrap(),
        }
        symlink("/dev/full", place.path(&device)).unwrap();
        let force =
            if WITHOUT_FORCE.iter().any(|command| call.starts_with(command)) { "" } else { " --force" };
        let below = if matches!(named, Named::Record(_)) { 2 } else { 3 };
        let mut places = vec![
            (2, taken.clone()),
            (2, taken.clone() + force),
            (2, device.clone()),
            (2, device.clone() + force),
            (below, format!("plain/new{ending}")),
        ];
        if mounted.is_some() {
            places.extend([(3, format!("read-only/new{ending}")), (3, format!("full/new{ending}"))]);
        }
        let before = names(&place.path(""));
        for (code, output) in places {
            let call = call.replace('@', &output);
            let mut program = Command::new(env!("CARGO_BIN_EXE_odograph"));
            program.args(call.split_whitespace()).current_dir(place.path("")).stdin(Stdio::null());
            let done = program.env("ODOGRAPH_FFMPEG", "").output().unwrap();
            let message = String::from_utf8_lossy(&done.stderr);
            let sentences = message.lines().filter(|line| line.starts_with("error: ")).count();
            let others = message.lines().filter(|line| !line.starts_with("warning: ")).count();
            let names_place = ["taken", "device", "plain", "new"].iter().any(|name| message.contains(name));
            if done.status.code() != Some(code) || (sentences, others) != (1, 1) || !names_place {
                let _ = writeln!(wrong, "{call}: {}, not {code}: {message}", done.status);
            }
            // The results of a run whose bag does not fit on the disk.
            if code == 3 && matches!(named, Named::Record(_)) {
                let _ = fs::remove_dir_all(place.path("new"));
            }
            if names(&place.path("")) != before {
                let _ = writeln!(wrong, "{call}: left {:?}", names(&place.path("")));
                let _ = fs::remove_dir_all(place.path("new"));
            }
            let left: Vec<String> = ["full", "read-only"]
                .iter()
                .filter(|folder| place.path(folder).exists())
                .flat_map(|folder| names(&place.path(folder)))
                .filter(|name| name != "filler")
                .collect();
            if !left.is_empty() {
                let _ = writeln!(wrong, "{call}: left {left:?}");
                left.iter().for_each(|name| {
                    let left = place.path("full").join(name);
                    let _ = fs::remove_file(&left).or_else(|_| fs::remove_dir_all(&left));
                });
            }
        }
        for name in [taken, device] {
            let made = place.path(&name);
            let _ = fs::remove_file(&made).or_else(|_| fs::remove_dir(&made));
        }
    }
    assert_eq!(fs::read(place.path("plain")).unwrap(), b"mine");
    assert!(wrong.is_empty(), "{wrong}");
}

#[test]
fn an_output_that_cannot_be_written_is_refused_before_the_work() {
    let place = HostileFolder::new();
    let Some(_mounted) = Mounted::new(&place.path("read-only"), "ro") else { return };
    fs::write(place.path("drive.y4m"), y4m(12)).unwrap();
    let board = "--board chessboard:7x5:30mm";
    // There is no board in the recording, which is found only by looking through it.
    for call in [
        format!("calibrate drive.y4m {board} -o read-only/new.yaml"),
        format!("calibrate drive.y4m {board} -o new.yaml --report read-only"),
        format!("ground drive.y4m {board} --camera camera.yaml -o read-only/new.toml"),
    ] {
        let mut program = Command::new(env!("CARGO_BIN_EXE_odograph"));
        program.args(call.split_whitespace()).current_dir(place.path("")).stdin(Stdio::null());
        assert_refused(&program.output().unwrap(), 3, "read-only", &call);
    }
}
