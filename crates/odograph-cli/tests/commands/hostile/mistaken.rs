//! One thing given as another: the message says which it is, and what to give instead.

use super::recording::{CAMERA, y4m};
use super::run_folder::HostileFolder;
use std::fs;
use std::process::{Command, Stdio};

/// Call, exit code, and what its message contains.
const CALLS: [(&str, i32, &str); 40] = [
    (
        "ground ran --camera camera.yaml --height 1 -o r.toml",
        3,
        "the folder of a run, not of a recording; give its recording, drive.y4m",
    ),
    (
        "ground ran --board chessboard:9x6:25mm --camera camera.yaml -o r.toml",
        3,
        "give its recording, drive.y4m",
    ),
    ("calibrate ran --board chessboard:9x6:25mm -o c.yaml", 3, "give its recording, drive.y4m"),
    ("undistort ran --camera camera.yaml -o u", 3, "give its recording, drive.y4m"),
    ("run ran --camera camera.yaml --height 1 -o out", 3, "give its recording, drive.y4m"),
    ("info ran", 3, "give its recording, drive.y4m"),
    (
        "info killed",
        3,
        "killed is the folder of a run that did not end, not of a recording; give its recording",
    ),
    (
        "run - --camera camera.yaml --height 1 -o out",
        3,
        "standard input: there is nothing in it, not even the header of a Y4M stream",
    ),
    ("map info ran", 3, "this is the folder of a run; its map is ran/map.gpkg"),
    ("localize drive.y4m --map ran", 3, "its map is ran/map.gpkg"),
    ("run drive.y4m --camera camera.yaml --height 1 --map ran -o out", 3, "its map is ran/map.gpkg"),
    ("evaluate ran ran/trajectory.tum", 3, "ran is the folder of a run; its path is ran/trajectory.tum"),
    (
        "evaluate ran/trajectory.csv ran/trajectory.tum",
        3,
        "ran/trajectory.csv is the table of a run; its path is ran/trajectory.tum\n",
    ),
    (
        "run drive.y4m --camera camera.yaml --height 1 --map letter -o out",
        3,
        "not a map file; give the map.gpkg",
    ),
    ("view drive.y4m", 3, "not a map file; give the map.gpkg"),
    ("view films", 3, "odograph run makes both of a recording"),
    (
        "run drive.y4m --camera rig.toml --height 1 -o out",
        3,
        "rig.toml: this is a rig file, not a camera file; give it with --rig",
    ),
    ("undistort drive.y4m --camera rig.toml -o u", 3, "this is a rig file, not a camera file"),
    (
        "run drive.y4m --camera camera.yaml --rig camera.yaml -o out",
        3,
        "this is a camera file, not a rig file; give it with --camera",
    ),
    ("run drive.y4m --camera drive.y4m --height 1 -o out", 3, "drive.y4m is not a text file, as camera, rig"),
    ("run drive.y4m camera.yaml --height 1 -o out", 2, "camera.yaml is no recording; give it with --camera"),
    (
        "run letter --camera camera.yaml --height 1 -o out",
        3,
        "letter: this is a text file, not a recording; give a video",
    ),
    (
        "run drive.y4m --camera camera.yaml --height 1 --mask letter -o out",
        3,
        "letter: this is a text file, not a picture; a mask is one picture (PNG, JPEG, TIFF, PGM or PPM) of the size",
    ),
    (
        "run drive.y4m --camera camera.yaml --height 1 --mask films -o out",
        3,
        "films: this is a folder, not a picture; a mask is one picture",
    ),
    (
        "doctor drive.y4m --camera camera.yaml --height 1 --mask drive.y4m",
        3,
        "drive.y4m: this is not a picture; a mask is one picture",
    ),
    ("run rig.toml", 3, "rig.toml is a rig file, not the run.toml of a run; give it with --rig"),
    ("run dot.y4m --field-of-view 1x1 -o out", 3, "the frames of dot.y4m are 1x1 pixels, too small"),
    ("doctor dot.y4m --field-of-view 1x1", 3, "the frames of dot.y4m are 1x1 pixels, too small"),
    ("doctor films", 3, "give the video drive.mp4 that is in it"),
    ("run drive.y4m --camera camera.yaml --height 1 -o drive.y4m", 2, "drive.y4m is the recording itself"),
    (
        "run drive.y4m --camera none.yaml --height 1 -o out",
        3,
        "none.yaml cannot be read: there is no such file\n",
    ),
    (
        "run http://cart/video --camera camera.yaml --height 1 -o out",
        3,
        "this is an address, and recordings are files; odograph live",
    ),
    // Without -o: the results would go to a folder of that name.
    ("run http://cart/video --camera camera.yaml --height 1", 3, "this is an address, and recordings are"),
    ("run none --camera camera.yaml --height 1", 3, "none: there is no such file or folder\n"),
    (
        "run /dev/video99 --camera camera.yaml --height 1",
        3,
        "/dev/video99: there is no such camera; odograph",
    ),
    (
        "live 0 --camera camera.yaml --height 1 -o out",
        3,
        "odograph cameras lists the cameras of this machine",
    ),
    ("run letter -o out", 3, "letter: this is a text file, not a recording"),
    ("run drive.y4m -o out", 2, "no camera is given; give --camera FILE, as odograph calibrate writes it"),
    (
        "doctor drive.y4m --timestamps two.txt --camera camera.yaml --height 1",
        3,
        "two.txt has 2 times, but there are 12 frames",
    ),
    ("run --resume ran", 2, "odograph run ran/run.toml repeats it"),
];

#[test]
fn a_mistaken_file_is_named_with_what_to_give_instead() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(12)).unwrap();
    assert!(place.run("drive.y4m --camera camera.yaml --height 1 -o ran").status.success());
    for (name, text) in [("letter", "Dear Sir,\n"), ("rig.toml", "height_m = 1\n"), ("two.txt", "0\n1\n")] {
        fs::write(place.path(name), text).unwrap();
    }
    let dot = [&b"YUV4MPEG2 W1 H1 F30:1 Ip A1:1 Cmono\n"[..], &b"FRAME\n\x80".repeat(12)].concat();
    fs::write(place.path("dot.y4m"), dot).unwrap();
    fs::create_dir(place.path("films")).unwrap();
    fs::create_dir(place.path("killed")).unwrap();
    fs::write(place.path("killed/run.toml.part"), "").unwrap();
    fs::write(place.path("films/drive.mp4"), CAMERA).unwrap();
    for (call, code, words) in CALLS {
        let mut program = Command::new(env!("CARGO_BIN_EXE_odograph"));
        let done = program.args(call.split(' ')).current_dir(place.path("")).stdin(Stdio::null()).output();
        let done = done.unwrap();
        let message = String::from_utf8_lossy(&done.stderr);
        assert_eq!(done.status.code(), Some(code), "{call}: {message}");
        assert!(message.contains(words) && message.lines().count() == 1, "{call}: {message}");
        for name in ["out", "u", "c.yaml", "r.toml", "http:", "none"] {
            assert!(!place.path(name).exists(), "{call} left {name}");
        }
    }
}
