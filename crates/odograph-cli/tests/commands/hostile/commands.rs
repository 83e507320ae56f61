//! Every command with wrong arguments and unusable files: `commands.txt` has one call in a line,
//! after the exit code that it must end with.

use super::recording::{CAMERA, PngPicture, names, picture_folder, y4m};
use super::run_folder::HostileFolder;
use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

const CALLS: &str = include_str!("commands.txt");
/// What `USUAL` in a call stands for.
const USUAL: &str = "--camera camera.yaml --height 1 -o out";

/// A trajectory of `count` poses, metres and seconds, from the x coordinate of each.
fn trajectory(count: usize, x_m: impl Fn(usize) -> f64) -> String {
    (0..count).fold(String::new(), |mut text, number| {
        let _ = writeln!(text, "{number} {} 0 0 0 0 0 1", x_m(number));
        text
    })
}

/// The files that the calls name.
fn fill(place: &HostileFolder) {
    let write = |name: &str, bytes: &[u8]| fs::write(place.path(name), bytes).unwrap();
    fs::write(place.path("drive.y4m"), y4m(12)).unwrap();
    assert!(place.run("drive.y4m --camera camera.yaml --height 1 -o made").status.success());
    fs::rename(place.path("made/map.gpkg"), place.path("map.gpkg")).unwrap();
    fs::rename(place.path("made"), place.path("ran")).unwrap();
    write("far.csv", b"marker,x_m,y_m\n1,1e300,0\n");
    let map = fs::read(place.path("map.gpkg")).unwrap();
    write("cut.gpkg", &map[..map.len() / 2]);
    for folder in ["folder", "folder.ply", "folder.pdf", "folder.toml"] {
        fs::create_dir(place.path(folder)).unwrap();
    }
    for empty in ["empty", "empty.toml"] {
        write(empty, b"");
    }
    write("text", &b"this is a letter\n".repeat(20));
    let mut state = 1_u32;
    let mut noise = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    };
    write("noise", &(0..100_000).map(|_| noise()).collect::<Vec<_>>());
    write("cut.mp4", &fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/demo/drive.mp4")).unwrap()[..3000]);
    write("huge.toml", b"height_m = 1e300\n");
    write("nan.yaml", CAMERA.replace("300.0", ".nan").as_bytes());
    write("nan.csv", b"time_s,rate_rad_s\n0,nan\n1,2\n");
    write("back.txt", b"5\n4\n3\n2\n1\n0\n");
    picture_folder(&place.path("pictures"), 1, |number| PngPicture::gray8(number).without_last_rows(232));
    fs::rename(place.path("pictures/000000.png"), place.path("small.png")).unwrap();
    fs::remove_dir(place.path("pictures")).unwrap();
    picture_folder(&place.path("pictures"), 12, PngPicture::gray8);
    picture_folder(&place.path("tiny"), 2, |number| PngPicture::gray8(number).without_last_rows(238));
    fs::rename(place.path("tiny/000000.png"), place.path("tiny/0.png")).unwrap();
    picture_folder(&place.path("dark"), 1, PngPicture::black);
    fs::rename(place.path("dark/000000.png"), place.path("black.png")).unwrap();
    fs::remove_dir(place.path("dark")).unwrap();
    let made = Command::new("mkfifo").arg(place.path("pipe")).status().unwrap();
    assert!(made.success());
    std::os::unix::fs::symlink("endless", place.path("endless")).unwrap();
    std::os::unix::fs::symlink("nowhere/x", place.path("dangling")).unwrap();
    drop(std::os::unix::net::UnixListener::bind(place.path("socket")).unwrap());
    fill_foreign_texts(place);
    fill_videos(place);
    fill_cameras(place);
    fill_times(place);
    write("truth.tum", trajectory(10, |number| 0.1 * number as f64).as_bytes());
    write("nan.tum", b"0 0 0 0 0 0 0 1\n1 nan 0 0 0 0 0 1\n");
    write("inf.tum", b"0 inf 0 0 0 0 0 1\n1 inf 0 0 0 0 0 1\n");
    write("far.tum", b"1000 1 1 0 0 0 0 1\n1001 1 1 0 0 0 0 1\n");
    write("back.tum", b"2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n");
    write("zeroq.tum", b"0 1 1 0 0 0 0 0\n1 1 1 0 0 0 0 0\n");
    write("big.tum", trajectory(10, |number| 1e300 * (number % 2) as f64).as_bytes());
    write("other.db", &renamed_tables(&map));
}

/// Streams of one frame, and of sizes that cannot be.
fn fill_videos(place: &HostileFolder) {
    fs::write(place.path("one.y4m"), y4m(1)).unwrap();
    for (name, size) in
        [("zero.y4m", "W0 H0"), ("minus.y4m", "W-320 H240"), ("wide.y4m", "W99999999999 H240")]
    {
        fs::write(place.path(name), format!("YUV4MPEG2 {size} F30:1 Cmono\nFRAME\n")).unwrap();
    }
}

/// Camera and rig files with one wrong number each.
fn fill_cameras(place: &HostileFolder) {
    let with_readout = |seconds: &str| format!("{CAMERA}readout_time_s: {seconds}\n");
    for (name, text) in [
        ("lens_nan.yaml", CAMERA.replacen("[ 0.0", "[ .nan", 1)),
        ("lens_huge.yaml", CAMERA.replacen("[ 0.0", "[ 1e308", 1)),
        ("focal_0.yaml", CAMERA.replace("300.0", "0.0")),
        ("focal_tiny.yaml", CAMERA.replace("300.0", "1e-300")),
        ("focal_huge.yaml", CAMERA.replace("300.0", "1e300")),
        ("middle_far.yaml", CAMERA.replace("159.5", "1e9")),
        ("size_0.yaml", CAMERA.replace("width: 320", "width: 0")),
        ("size_minus.yaml", CAMERA.replace("width: 320", "width: -320")),
        ("size_huge.yaml", CAMERA.replace("width: 320", "width: 99999999999999999999")),
        ("size_other.yaml", CAMERA.replace("width: 320", "width: 640")),
        ("readout_minus.yaml", with_readout("-0.01")),
        ("readout_long.yaml", with_readout("0.5")),
        ("readout_nan.yaml", with_readout(".nan")),
        ("numbers_few.yaml", CAMERA.replace("300.0, 0.0, 159.5, 0.0,", "300.0,")),
        ("tiny.toml", "height_m = 1e-310".to_owned()),
        ("sideways.toml", "height_m = 1\nroll_deg = 89".to_owned()),
        ("far_arm.toml", "height_m = 1\nx_m = 1e200".to_owned()),
        ("twice.toml", "height_m = 1\nheight_m = 2".to_owned()),
    ] {
        fs::write(place.path(name), text).unwrap();
    }
}

/// Texts of other programs and countries, and texts that take memory to read.
fn fill_foreign_texts(place: &HostileFolder) {
    let utf16 = |text: &str| text.encode_utf16().flat_map(u16::to_le_bytes).collect::<Vec<u8>>();
    let aliases = (0..9).fold("a0: &a0 [x, x]\n".to_owned(), |text, number| {
        text + &format!("a{}: &a{0} [{}]\n", number + 1, vec![format!("*a{number}"); 9].join(", "))
    });
    for (name, bytes) in [
        ("utf16.yaml", utf16(CAMERA)),
        ("utf16.toml", utf16("height_m = 1\n")),
        ("comma.toml", b"height_m = 0,9\n".to_vec()),
        ("comma.csv", b"time_s;rate_rad_s\n0,0;0,01\n0,5;0,02\n".to_vec()),
        ("comma_fixes.csv", b"time_s;latitude_deg;longitude_deg\n0,0;48,2;16,3\n".to_vec()),
        ("comma.tum", b"0,0 0,0 0 0 0 0 0 1\n1,0 1,0 0 0 0 0 0 1\n".to_vec()),
        ("aliases.yaml", aliases.into_bytes()),
        ("deep.yaml", vec![b'['; 100_000]),
        ("deep.toml", [b"height_m = ".to_vec(), vec![b'['; 100_000]].concat()),
    ] {
        fs::write(place.path(name), bytes).unwrap();
    }
}

/// Times for 12 pictures that stand still, are too few, too many, too far or too close.
fn fill_times(place: &HostileFolder) {
    let write = |name: &str, count: usize, time: &dyn Fn(usize) -> String| {
        let lines: Vec<String> = (0..count).map(time).collect();
        fs::write(place.path(name), lines.join("\n")).unwrap();
    };
    write("same.txt", 12, &|_| "1.0".to_owned());
    write("few.txt", 7, &|number| format!("{number}"));
    write("many.txt", 30, &|number| format!("{number}"));
    write("nan.txt", 12, &|_| "nan".to_owned());
    write("far.txt", 12, &|number| format!("{number}e300"));
    write("close.txt", 12, &|number| format!("{number}e-310"));
}

/// A map whose tables have other names: a database of another program.
fn renamed_tables(map: &[u8]) -> Vec<u8> {
    let mut bytes = map.to_vec();
    let (own, other) = (b"odograph_map", b"somebody_map");
    let named = map.windows(own.len()).enumerate().filter(|(_, window)| window == own);
    named.for_each(|(at, _)| bytes[at..at + other.len()].copy_from_slice(other));
    bytes
}

/// What a map contains, but not its size: a refused `map thin` may have compacted it.
fn content(map: &Path) -> String {
    let info = Command::new(env!("CARGO_BIN_EXE_odograph")).args(["map", "info"]).arg(map).output().unwrap();
    assert!(info.status.success(), "{info:?}");
    String::from_utf8_lossy(&info.stdout).lines().skip(1).fold(String::new(), |all, line| all + line + "\n")
}

#[test]
#[cfg(unix)]
fn every_command_refuses_wrong_input_in_one_sentence() {
    let place = HostileFolder::new();
    fill(&place);
    let before = names(&place.path(""));
    let map = content(&place.path("map.gpkg"));
    let mut wrong = String::new();
    let mut calls = 0;
    for line in CALLS.lines() {
        let (code, call) = line.split_once(' ').unwrap();
        let call = call.replace("USUAL", USUAL);
        let done = Command::new(env!("CARGO_BIN_EXE_odograph"))
            .args(call.split_whitespace())
            .current_dir(place.path(""))
            .env("ODOGRAPH_FFMPEG", "")
            .env("XDG_CONFIG_HOME", place.path("profiles"))
            .stdin(Stdio::null())
            .output()
            .unwrap();
        calls += 1;
        let message = String::from_utf8_lossy(&done.stderr);
        // The option parser's own messages have several lines.
        let of_parser = message.contains("For more information, try '--help'");
        let sentences = message.lines().filter(|line| line.starts_with("error: ")).count();
        let others = message.lines().filter(|line| !line.starts_with("warning: ")).count() - sentences;
        if done.status.code() != code.parse().ok()
            || message.contains("panicked")
            || sentences != 1
            || (others > 0 && !of_parser)
        {
            let _ = writeln!(wrong, "{line}: {}, {message}", done.status);
        }
        if names(&place.path("")) != before || content(&place.path("map.gpkg")) != map {
            let _ = writeln!(wrong, "{line}: changed what is there: {:?}", names(&place.path("")));
            break;
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
    assert!(calls > 300, "{calls} calls");
}

#[test]
fn the_documents_state_the_number_of_calls() {
    let document = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/reliability.md");
    let stated = format!(
        "`crates/odograph-cli/tests/commands/hostile/commands.txt` has {} calls",
        CALLS.lines().count()
    );
    assert!(fs::read_to_string(document).unwrap().contains(&stated), "{stated}");
}
