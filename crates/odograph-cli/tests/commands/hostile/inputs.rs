//! Recordings, cameras and options that cannot be used.

use super::recording::{CAMERA, PngPicture, picture_folder, y4m};
use super::run_folder::{HostileFolder, assert_refused, assert_whole};
use std::fs;
use std::path::Path;

#[test]
fn invalid_sources_are_refused() {
    let place = HostileFolder::new();
    place.refused_usual("none.mp4", 3, "none.mp4: there is no such file");
    fs::create_dir(place.path("empty")).unwrap();
    place.refused_usual("empty", 3, "empty");
    fs::create_dir(place.path("texts")).unwrap();
    for name in ["a.txt", "b.txt", "notes.md"] {
        fs::write(place.path("texts").join(name), "not a picture").unwrap();
    }
    place.refused_usual("texts", 3, "texts");
    fs::write(place.path("empty.mp4"), "").unwrap();
    place.refused_usual("empty.mp4", 3, "empty.mp4");
    let mut state = 1u32;
    let noise: Vec<u8> = (0..100_000)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        })
        .collect();
    fs::write(place.path("random.mp4"), noise).unwrap();
    place.refused_usual("random.mp4", 3, "random.mp4");
    fs::write(place.path("text.png"), "not a picture").unwrap();
    place.refused_usual("text.png", 3, "text.png");
    fs::create_dir(place.path("broken")).unwrap();
    fs::write(place.path("broken/0.png"), b"\x89PNG\r\n\x1a\nbroken").unwrap();
    fs::write(place.path("broken/1.png"), b"\x89PNG\r\n\x1a\nbroken").unwrap();
    place.refused_usual("broken", 3, "0.png");
}

#[test]
fn damaged_robot_recordings_are_recognised_by_their_content() {
    let place = HostileFolder::new();
    let database = b"SQLite format 3\0 ... CREATE TABLE topics(id) CREATE TABLE messages(id)";
    for (name, bytes, words) in [
        ("drive.mcap", &b"\x89MCAP0\r\n\xff\xd8\xff\xe0"[..], "this is an MCAP file without messages"),
        ("named.mp4", b"\x89MCAP0\r\n", "this is an MCAP file without messages"),
        ("drive.bag", b"#ROSBAG V2.0\n\xff\xd8\xff\xe0", "this is a ROS 1 bag without messages"),
        ("old.bag", b"#ROSBAG V1.2\n\xff\xd8\xff\xe0", "older version than 2.0"),
        ("drive.db3", database, "copy the recording again, or save the rest of it: sqlite3 DAMAGED.db3"),
    ] {
        fs::write(place.path(name), bytes).unwrap();
        place.refused_usual(name, 3, words);
    }
    for (folder, name, bytes, words) in [
        (
            "described",
            "metadata.yaml",
            &b"rosbag2_bagfile_information:\n  version: 5\n"[..],
            "its files are not in this folder",
        ),
        ("bare", "bare_0.db3", database, "the database cannot be read"),
    ] {
        fs::create_dir(place.path(folder)).unwrap();
        fs::write(place.path(folder).join(name), bytes).unwrap();
        place.refused_usual(folder, 3, words);
    }
}

#[test]
fn too_few_frames_are_refused() {
    let place = HostileFolder::new();
    picture_folder(&place.path("one"), 1, PngPicture::gray8);
    place.refused_usual("one", 3, "only one frame");
    place.refused_usual("one/000000.png", 3, "only one frame");
    fs::write(place.path("none.y4m"), y4m(0)).unwrap();
    place.refused_usual("none.y4m", 3, "there is no frame in it");
    fs::write(place.path("one.y4m"), y4m(1)).unwrap();
    place.refused_usual("one.y4m", 3, "only one frame");
    fs::write(place.path("some.y4m"), y4m(4)).unwrap();
    place.refused("some.y4m --camera camera.yaml --height 1 -o out --start 90", 3, "no frame");
    place.refused("some.y4m --camera camera.yaml --height 1 -o out --max-frames 1", 3, "only one frame");
    place.refused("some.y4m --camera camera.yaml --height 1 -o out --max-frames 0", 3, "no frame");
}

#[test]
fn frames_of_different_sizes_are_refused() {
    let place = HostileFolder::new();
    picture_folder(&place.path("mixed"), 6, |number| {
        let picture = PngPicture::gray8(number);
        if number == 3 { picture.without_last_rows(20) } else { picture }
    });
    let done = place.run_usual("mixed");
    assert_refused(&done, 3, "must have the same size", "mixed");
    // Results from before the error are kept.
    if place.path("out").exists() {
        assert_whole(&place.path("out"));
    }
}

#[test]
fn truncated_and_empty_videos_are_handled() {
    let place = HostileFolder::new();
    let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
    let clip = fs::read(demo.join("drive.mp4")).unwrap();
    let boxed = |kind: &[u8; 4], body: &[u8]| {
        let mut whole = (body.len() as u32 + 8).to_be_bytes().to_vec();
        whole.extend_from_slice(kind);
        whole.extend_from_slice(body);
        whole
    };
    let ftyp = boxed(b"ftyp", b"isom\0\0\x02\0isomiso2avc1mp41");
    fs::write(place.path("bare.mp4"), &ftyp).unwrap();
    place.refused_usual("bare.mp4", 3, "bare.mp4");
    fs::write(place.path("empty.mp4"), [ftyp.clone(), boxed(b"moov", b""), boxed(b"mdat", b"")].concat())
        .unwrap();
    place.refused_usual("empty.mp4", 3, "empty.mp4");
    fs::write(place.path("head.mp4"), &clip[..1000]).unwrap();
    place.refused_usual("head.mp4", 3, "head.mp4");
    let data = clip.windows(4).position(|kind| kind == b"mdat").unwrap() + 4;
    fs::write(place.path("nothing.mp4"), &clip[..data]).unwrap();
    place.refused_usual("nothing.mp4", 3, "nothing.mp4");

    fs::write(place.path("cut.mp4"), &clip[..data + 150_000]).unwrap();
    let done =
        place.run(&format!("cut.mp4 --camera {0}/camera.yaml --rig {0}/rig.toml -o out", demo.display()));
    let message = String::from_utf8(done.stderr).unwrap();
    assert_eq!(done.status.code(), Some(0), "{message}");
    assert!(message.lines().count() == 1 && message.starts_with("warning: cut.mp4: "), "{message}");
    assert_whole(&place.path("out"));
    let lines = place.result("out", "trajectory.csv").iter().filter(|&&b| b == b'\n').count();
    assert!((20..400).contains(&lines), "{lines} lines for the frames up to the cut");
}

#[test]
fn images_with_16_bits_or_alpha_are_read() {
    let place = HostileFolder::new();
    for (name, picture) in [
        ("gray8", PngPicture::gray8 as fn(usize) -> PngPicture),
        ("gray16", PngPicture::gray16),
        ("gray_alpha", PngPicture::gray_alpha),
        ("rgba16", PngPicture::rgba16),
    ] {
        picture_folder(&place.path(name), 8, picture);
        let out = format!("{name}-out");
        let done = place.run(&format!("{name} --fps 30 --camera camera.yaml --height 1 -o {out}"));
        assert_eq!(done.status.code(), Some(0), "{name}: {}", String::from_utf8_lossy(&done.stderr));
        assert_whole(&place.path(&out));
        // The same floor, so the same path: 4 px of 1/300 m per frame to the left.
        let path = String::from_utf8(place.result(&out, "trajectory.csv")).unwrap();
        let last: Vec<&str> = path.lines().last().unwrap().split(',').collect();
        let (x_m, y_m): (f64, f64) = (last[2].parse().unwrap(), last[3].parse().unwrap());
        assert!(x_m.abs() < 1e-4 && (y_m + 28.0 / 300.0).abs() < 1e-4, "{name}: {path}");
    }
}

#[test]
fn invalid_cameras_are_refused() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    let with = |name: &str, text: &str, words: &str| {
        fs::write(place.path(name), text).unwrap();
        place.refused(&format!("drive.y4m --camera {name} --height 1 -o out"), 3, words);
    };
    with("nan.yaml", &CAMERA.replace("300.0, 0.0, 159.5", ".nan, 0.0, 79.5"), "nan.yaml: ");
    with("infinite.yaml", &CAMERA.replace("300.0, 0.0, 159.5", ".inf, 0.0, 79.5"), "infinite.yaml: ");
    with("negative.yaml", &CAMERA.replace("300.0, 0.0, 159.5", "-300.0, 0.0, 159.5"), "negative.yaml: ");
    with("other.yaml", &CAMERA.replace("image_width: 320", "image_width: 640"), "calibrated for 640x240");
    let turned = CAMERA.replace("width: 320", "width: 240").replace("height: 240", "height: 320");
    with(
        "turned.yaml",
        &turned,
        "calibrated for 240x320; the recording is turned by 90° against the calibration",
    );
    with("empty.yaml", "", "empty.yaml: the camera file is empty");
    with("text.yaml", "this is no camera", "text.yaml: ");
    with("broken.yaml", "{[", "broken.yaml: ");
    fs::write(place.path("bytes.yaml"), [0xff, 0xfe, 0, 1]).unwrap();
    place.refused("drive.y4m --camera bytes.yaml --height 1 -o out", 3, "bytes.yaml");
    place.refused("drive.y4m --camera none.yaml --height 1 -o out", 3, "none.yaml cannot be read");
    place.refused("drive.y4m --camera . --height 1 -o out", 3, ". cannot be read");
    fs::write(place.path("rig.toml"), "height_m = nan").unwrap();
    let done = place.run("drive.y4m --camera camera.yaml --rig rig.toml -o out");
    assert!(matches!(done.status.code(), Some(2 | 3)) && !place.path("out").exists(), "{done:?}");
    fs::write(place.path("garbage.toml"), "\0\u{1}").unwrap();
    place.refused("drive.y4m --camera camera.yaml --rig garbage.toml -o out", 3, "garbage.toml");
}

#[test]
fn invalid_usage_is_refused() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    let usual = "drive.y4m --camera camera.yaml -o out";
    place.refused(&format!("{usual} --height -1"), 2, "the height is -1 m");
    place.refused(
        &format!("{usual} --height -1m"),
        2,
        "the height is -1 m; it is measured from the ground up",
    );
    place.refused(&format!("{usual} --height -.75"), 2, "so write it without the sign");
    place.refused(&format!("{usual} --height 0"), 2, "the height is 0 m");
    place.refused(&format!("{usual} --height nan"), 2, "the height is NaN m");
    place.refused(&format!("{usual} --height inf"), 2, "the height is inf m");
    place.refused(usual, 2, "--height");
    place.refused("drive.y4m --height 1 -o out", 2, "--camera");
    place.refused(&format!("{usual} --height 1 --every 0"), 2, "every 0th frame");
    place.refused(&format!("{usual} --height 1 --fps 0"), 2, "frames a second");
    place.refused(&format!("{usual} --height 1 --start -1"), 2, "start and end");
    place.refused(&format!("{usual} --height 1 --start 2 --end 1"), 2, "before the start");
    // The option parser has its own messages, which have several lines.
    for wrong in
        ["--height x", "--height 1 --nonsense", "--height 1 --every -1", "--height 1 --threads 0", "--height"]
    {
        let done = place.run(&format!("{usual} {wrong}"));
        assert_eq!(done.status.code(), Some(2), "{wrong}");
        assert!(!place.path("out").exists(), "{wrong}");
    }
    let done = place.run("drive.y4m --field-of-view 0x1 -o out");
    assert!(done.status.code() == Some(2) && !place.path("out").exists());
}

#[test]
fn lengths_have_units_and_implausible_heights_cause_warnings() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    assert!(place.run_usual("drive.y4m").status.success());
    let done = place.run("drive.y4m --camera camera.yaml --height 100cm -o centimetres");
    assert!(done.status.success() && done.stderr.is_empty(), "{done:?}");
    assert!(place.result("centimetres", "trajectory.tum") == place.result("out", "trajectory.tum"));
    for (height, doubted) in [("90", true), ("90m", false)] {
        let done = place.run(&format!("drive.y4m --camera camera.yaml --height {height} -o {height}"));
        let message = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(done.status.success(), "{message}");
        assert_eq!(
            message
                .contains("warning: --height 90 is read as 90 metres; if centimetres are meant, write 90cm"),
            doubted
        );
    }
    for (field, doubted) in [("120x90", true), ("120x90m", false)] {
        let done = place.run(&format!("drive.y4m --field-of-view {field} -o {field}"));
        let message = String::from_utf8_lossy(&done.stderr).into_owned();
        let doubt =
            "warning: --field-of-view 120x90 is read as metres; if centimetres are meant, write 120x90cm";
        assert!(done.status.success() && message.contains(doubt) == doubted, "{message}");
    }
    fs::write(place.path("rig.toml"), "height_m = 1\nroll_dg = 2").unwrap();
    let with_rig = "drive.y4m --camera camera.yaml --rig rig.toml -o rigged";
    place.refused(
        with_rig,
        3,
        "rig.toml: the rig file has an unknown key `roll_dg`; did you mean `roll_deg`?",
    );
    fs::write(place.path("rig.toml"), "height_m = 900").unwrap();
    let questioned = place.run("drive.y4m --camera camera.yaml --rig rig.toml -o questioned");
    assert!(questioned.status.success());
    assert!(String::from_utf8_lossy(&questioned.stderr).contains("are millimetres meant?"));
    fs::write(place.path("rig.toml"), "height_m = 1e300").unwrap();
    place.refused(with_rig, 3, "the height is 1.0e300 m");
}

/// The bundled drive with its camera and rig.
const DEMO: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/demo");

#[test]
#[cfg(unix)]
fn names_are_printed_on_their_line() {
    let place = HostileFolder::new();
    let (breaks, shown) = ("a\nb\u{1b}[2J\u{202e}", "a\\nb\\u001b[2J\\u202e");
    let folder = place.path(breaks);
    fs::create_dir(&folder).unwrap();
    let clip = fs::read_dir(DEMO).unwrap().map(|entry| entry.unwrap().path());
    let clip = clip.into_iter().find(|path| path.extension().is_some_and(|ending| ending == "mp4")).unwrap();
    for (from, name) in [(clip, "drive.mp4"), (format!("{DEMO}/camera.yaml").into(), "camera.yaml")] {
        fs::copy(from, folder.join(name)).unwrap();
    }
    fs::write(folder.join("board.png"), b"no picture").unwrap();
    fs::write(folder.join("short.y4m"), y4m(12)).unwrap();
    fs::write(folder.join("short.yaml"), CAMERA).unwrap();
    let run = "run N/drive.mp4 --camera N/camera.yaml --height 0.3 --max-frames 40 -o N/out";
    // Command, and the exit code that it ends with.
    for (arguments, code) in [
        (run, 0),
        (run, 2),
        ("run N/drive.mp4 N/nothing.mp4 --camera N/camera.yaml --height 0.3 --max-frames 9 -o N/many", 3),
        ("info N/drive.mp4 --camera N/camera.yaml", 0),
        ("info N/nothing.mp4", 3),
        ("doctor N/short.y4m --camera N/short.yaml --height 0.3", 0),
        ("evaluate N/out/trajectory.tum N/out/odometry.tum", 0),
        ("evaluate N/out/trajectory.tum N/camera.yaml", 3),
        ("map info N/out/map.gpkg", 0),
        ("map info N/camera.yaml", 3),
        ("map export N/out/map.gpkg -o N/map.ply", 0),
        ("map export N/out/map.gpkg N/map.ply", 2),
        ("map merge N/out/map.gpkg N/out/map.gpkg -o N/both.gpkg", 2),
        ("map thin N/out/map.gpkg --max-keyframes 3", 0),
        ("map mosaic N/out/map.gpkg", 0),
        ("map repair N/out/map.gpkg", 0),
        ("map optimize N/out/map.gpkg", 0),
        ("localize N/drive.mp4 --map N/out/map.gpkg --max-frames 5", 0),
        ("localize N/board.png --map N/out/map.gpkg", 3),
        ("calibrate N/board.png --board chessboard:9x6:25mm -o N/found.yaml", 3),
        ("ground N/board.png --board chessboard:9x6:25mm --camera N/camera.yaml", 3),
        ("camera show N/camera.yaml", 0),
        ("undistort N/drive.mp4 --camera N/camera.yaml --max-frames 3 -o N/flat", 0),
        ("view N/nowhere", 3),
        ("view N/camera.yaml", 3),
        ("site serve N/camera.yaml", 2),
        ("site serve N/out", 3),
        ("site send N/out/map.gpkg --site http://127.0.0.1:9/ --robot cart", 3),
        ("board --board chessboard:9x6:25mm -o N/board.pdf", 0),
        ("simulate -o N/sim --duration 0.1", 0),
    ] {
        let words = arguments.split(' ').map(|word| word.replace('N', breaks));
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_odograph"));
        command.current_dir(place.path("")).env("ODOGRAPH_FFMPEG", "").args(words);
        let done = command.output().unwrap();
        let [out, err] =
            [&done.stdout, &done.stderr].map(|bytes| String::from_utf8_lossy(bytes).into_owned());
        assert_eq!(done.status.code(), Some(code), "{arguments}: {err}");
        for text in [&out, &err] {
            let raw =
                text.lines().any(|line| line.starts_with('b') && line[1..].starts_with(['\u{1b}', '\\']));
            assert!(!raw && !text.contains(['\u{1b}', '\u{202e}']), "{arguments}: {text:?}");
        }
        assert!(code == 0 || err.contains(shown), "{arguments}: {err}");
    }
}

#[test]
fn control_characters_of_files_do_not_reach_the_terminal() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    let camera = CAMERA.replace("image_width", "\"image\\e[2J\\rwidth\"");
    fs::write(place.path("evil.yaml"), camera).unwrap();
    let done = place.run("drive.y4m --camera evil.yaml --height 1 -o out");
    assert!(!done.stderr.iter().any(|&byte| byte == 0x1b || byte == b'\r'), "{done:?}");
}

#[test]
fn a_wrong_height_over_mapped_ground_is_reported() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(40)).unwrap();
    assert!(place.run("drive.y4m --camera camera.yaml --height 1 -o out -q").status.success());
    let again = place.run("drive.y4m --camera camera.yaml --height 66cm --map out/map.gpkg -o low");
    assert!(again.status.success());
    let message = String::from_utf8_lossy(&again.stderr);
    let found = "its ground is found there if the camera was 1.00 m above it, not 0.66 m: check the height";
    assert!(
        message.contains("nothing of out/map.gpkg was recognised") && message.contains(found),
        "{message}"
    );
}

#[test]
fn texts_with_carriage_returns_and_byte_order_marks_are_read() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(90)).unwrap();
    let of_windows = |text: &str| format!("\u{feff}{}", text.replace('\n', "\r\n"));
    let gyro: String = (0..31).map(|tenth| format!("\"{}\",\"0.0\"\n", f64::from(tenth) / 10.0)).collect();
    let times: String = (0..90).map(|frame| format!("{:.3}\n", f64::from(frame) / 30.0)).collect();
    for (name, text) in [
        ("windows.yaml", CAMERA),
        ("windows.toml", "height_m = 1\n"),
        ("windows.csv", &format!("\"time_s\",\"rate_rad_s\"\n{gyro}")),
        ("windows.txt", &times),
    ] {
        fs::write(place.path(name), of_windows(text)).unwrap();
    }
    let options = "--rig windows.toml --gyro windows.csv --timestamps windows.txt";
    let done = place.run(&format!("drive.y4m --camera windows.yaml {options} -o out"));
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
}

#[test]
fn decimal_commas_and_foreign_names_are_named() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    fs::write(place.path("comma.toml"), "height_m = 0,9\n").unwrap();
    fs::write(place.path("comma.csv"), "time_s;rate_rad_s\n0,0;0,01\n").unwrap();
    let hint = "; write decimals with a point, 0.5 and not 0,5";
    place.refused("drive.y4m --camera camera.yaml --rig comma.toml -o out", 3, hint);
    place.refused_usual("drive.y4m --gyro comma.csv", 3, hint);
    let aliases = (0..9).fold("a0: &a0 [x, x]\n".to_owned(), |text, number| {
        text + &format!("a{}: &a{0} [{}]\n", number + 1, vec![format!("*a{number}"); 9].join(", "))
    });
    fs::write(place.path("aliases.yaml"), aliases).unwrap();
    place.refused("drive.y4m --camera aliases.yaml --height 1 -o out", 3, "larger or nested deeper than");
    #[cfg(unix)]
    {
        use std::os::unix::ffi::OsStrExt;
        std::os::unix::fs::symlink("nowhere", place.path("link.gpkg")).unwrap();
        place.refused_usual("drive.y4m --map link.gpkg", 3, "link.gpkg is a link that leads nowhere");
        let mut command = place.command("drive.y4m --camera camera.yaml --height 1 -o out --map");
        let done = command.arg(std::ffi::OsStr::from_bytes(b"m\xff.gpkg")).output().unwrap();
        assert_refused(
            &done,
            2,
            "m\u{fffd}.gpkg is not UTF-8 text; rename the file",
            "a map of another encoding",
        );
        assert!(!place.path("out").exists());
    }
}
