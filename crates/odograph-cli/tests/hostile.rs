//! `odograph run` on unsuitable input: one sentence, the right exit code, no panic, no partial
//! files.

#![allow(clippy::unwrap_used)] // a test fails by panicking

#[path = "hostile/recording.rs"]
mod recording;

use recording::{CAMERA, PngPicture, names, picture_folder, y4m};
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// All output files of a complete run.
const FILES: [&str; 14] = [
    "carrier.tum",
    "map.gpkg",
    "map.png",
    "map.svg",
    "mosaic.pgw",
    "mosaic.png",
    "odometry.tum",
    "report.html",
    "run.toml",
    "stats.json",
    "trajectory-smoothed.csv",
    "trajectory-smoothed.tum",
    "trajectory.csv",
    "trajectory.tum",
];

/// A temporary folder with a camera file; the output folder does not exist yet.
struct HostileFolder {
    temporary: TempDir,
}

impl HostileFolder {
    fn new() -> Self {
        let temporary = tempfile::tempdir().unwrap();
        fs::write(temporary.path().join("camera.yaml"), CAMERA).unwrap();
        Self { temporary }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.temporary.path().join(name)
    }

    /// Runs `odograph run` in this folder, with these arguments only.
    fn run(&self, arguments: &str) -> Output {
        self.command(arguments).output().unwrap()
    }

    fn command(&self, arguments: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
        command.current_dir(self.temporary.path()).env("ODOGRAPH_FFMPEG", "");
        command.arg("run").args(arguments.split_whitespace()).stdin(Stdio::null());
        command
    }

    /// [`HostileFolder::run`] with the camera, a height and the output folder `out`.
    fn run_usual(&self, source: &str) -> Output {
        self.run(&format!("{source} --camera camera.yaml --height 1.0 -o out"))
    }

    /// Asserts that a run is refused with `code` and one sentence that contains `words`, and leaves
    /// no files.
    fn refused(&self, arguments: &str, code: i32, words: &str) {
        let before = names(self.temporary.path());
        let done = self.run(arguments);
        assert_told(&done, code, words, arguments);
        assert_eq!(names(self.temporary.path()), before, "`{arguments}` left something behind");
    }

    fn refused_usual(&self, source: &str, code: i32, words: &str) {
        self.refused(&format!("{source} --camera camera.yaml --height 1.0 -o out"), code, words);
    }

    /// The content of a result file.
    fn result(&self, folder: &str, name: &str) -> Vec<u8> {
        fs::read(self.path(folder).join(name)).unwrap()
    }
}

/// Asserts that standard error is one sentence and not the message of a panic.
fn assert_told(done: &Output, code: i32, words: &str, what: &str) {
    let told = String::from_utf8(done.stderr.clone()).unwrap();
    assert_eq!(done.status.code(), Some(code), "`{what}` told: {told}");
    assert!(!told.contains("panicked") && !told.contains("RUST_BACKTRACE"), "`{what}` told: {told}");
    assert!(told.contains(words), "`{what}` did not tell \"{words}\" but: {told}");
    assert_eq!(told.lines().count(), 1, "`{what}` told: {told}");
    assert!(done.stdout.is_empty(), "`{what}` printed {:?}", String::from_utf8_lossy(&done.stdout));
}

/// Asserts that the folder contains exactly the results, and no partial files.
fn assert_whole(folder: &Path) {
    assert_eq!(names(folder), FILES, "in {}", folder.display());
}

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
        ("drive.db3", database, "the database cannot be read"),
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
    assert_told(&done, 3, "must have the same size", "mixed");
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
    let told = String::from_utf8(done.stderr).unwrap();
    assert_eq!(done.status.code(), Some(0), "{told}");
    assert!(told.lines().count() == 1 && told.starts_with("warning: cut.mp4: "), "{told}");
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
fn invalid_outputs_are_refused() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    fs::write(place.path("file"), "mine").unwrap();
    place.refused("drive.y4m --camera camera.yaml --height 1 -o file", 2, "file is a file");
    // Below a file, and where even root cannot write.
    place.refused("drive.y4m --camera camera.yaml --height 1 -o file/out", 3, "file/out cannot be made");
    if Path::new("/proc/self").exists() {
        place.refused(
            "drive.y4m --camera camera.yaml --height 1 -o /proc/odograph",
            3,
            "/proc/odograph cannot be made",
        );
    }
    assert_eq!(fs::read(place.path("file")).unwrap(), b"mine");
    // Parent folders created for the run are removed.
    place.refused("none.mp4 --camera camera.yaml --height 1 -o a/b/c", 3, "none.mp4");
    // Existing results are unchanged.
    assert!(place.run_usual("drive.y4m").status.success());
    let before = place.result("out", "stats.json");
    place.refused_usual("drive.y4m", 2, "is already there; choose another folder, or --force");
    place.refused("none.mp4 --camera camera.yaml --height 1 -o out --force", 3, "none.mp4");
    assert_eq!(place.result("out", "stats.json"), before);
    assert_whole(&place.path("out"));
    let again = place.run("drive.y4m --camera camera.yaml --height 1 -o out --force");
    assert!(again.status.success(), "{again:?}");
    assert_whole(&place.path("out"));
}

/// `/dev/full` takes the place of each file in turn.
#[test]
#[cfg(unix)]
fn a_full_disk() {
    if !Path::new("/dev/full").exists() {
        println!("skipped: dev-full: there is no /dev/full");
        return;
    }
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(40)).unwrap();
    // The map file is written incrementally; separate tests cover a full disk for it.
    for name in FILES.into_iter().filter(|&name| name != "map.gpkg") {
        let out = place.path("out");
        fs::create_dir(&out).unwrap();
        // The final trajectory is written to a temporary file beside the growing one, which must
        // survive a disk that is full at the end.
        let (beside, stay) = match name {
            "trajectory.csv" => ("trajectory.csv.new.part".to_owned(), vec!["trajectory.csv.part"]),
            _ => (format!("{name}.part"), vec![]),
        };
        std::os::unix::fs::symlink("/dev/full", out.join(beside)).unwrap();
        assert_told(&place.run_usual("drive.y4m"), 3, "No space left on device", name);
        assert!(!out.join(name).exists(), "{name}");
        let left = names(&out);
        let halves: Vec<&String> = left.iter().filter(|left| left.ends_with(".part")).collect();
        assert_eq!(halves, stay, "{name}");
        if let Some(grown) = stay.first() {
            // The header and one line for each of the forty frames.
            assert_eq!(fs::read_to_string(out.join(grown)).unwrap().lines().count(), 41);
        }
        fs::remove_dir_all(&out).unwrap();
    }
    let full = fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let mut told = place.command("drive.y4m --camera camera.yaml --height 1 -o told --json");
    assert_told(
        &told.stdout(full).output().unwrap(),
        3,
        "standard output cannot be written",
        "--json > /dev/full",
    );
    assert_whole(&place.path("told"));
}

/// A small file system that really runs full.
#[test]
#[cfg(target_os = "linux")]
fn a_full_file_system() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(40)).unwrap();
    let mounted = place.path("small");
    fs::create_dir(&mounted).unwrap();
    let mount = Command::new("mount")
        .args(["-t", "tmpfs", "-o", "size=20k", "tmpfs"])
        .arg(&mounted)
        .stderr(Stdio::null())
        .status();
    if !mount.is_ok_and(|status| status.success()) {
        println!("skipped: mount: a small file system cannot be mounted here");
        return;
    }
    let done = place.run("drive.y4m --camera camera.yaml --height 1 -o small/out");
    let left = if mounted.join("out").exists() { names(&mounted.join("out")) } else { Vec::new() };
    assert!(Command::new("umount").arg(&mounted).status().unwrap().success());
    assert_told(&done, 3, "cannot be written", "a file system of 20 KiB");
    assert!(left.iter().all(|name| !name.ends_with(".part")), "{left:?}");
}

#[test]
fn invalid_plans_are_refused() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(3)).unwrap();
    for (name, text) in [
        ("run.toml", "this is = = no plan"),
        ("empty.toml", ""),
        ("bytes.toml", "\0\0\0"),
        ("other.toml", "[package]\nname = \"odograph\"\n"),
    ] {
        fs::write(place.path(name), text).unwrap();
        place.refused(&format!("{name} -o out"), 3, name);
    }
    place.refused("none.toml -o out", 3, "none.toml cannot be read");
    assert!(place.run_usual("drive.y4m").status.success());
    let plan = String::from_utf8(place.result("out", "run.toml")).unwrap();
    fs::create_dir(place.path("plans")).unwrap();
    let mut number = 0;
    // Replaces each number of a plan in turn by invalid values.
    for (line_number, line) in plan.lines().enumerate() {
        let Some((key, value)) = line.split_once(" = ") else { continue };
        if value.parse::<f64>().is_err() {
            continue;
        }
        for wrong in ["nan", "-1", "0", "9000000000000000000"] {
            let changed: Vec<String> = plan
                .lines()
                .enumerate()
                .map(|(n, line)| if n == line_number { format!("{key} = {wrong}") } else { line.to_owned() })
                .collect();
            number += 1;
            let name = format!("plans/{number}.toml");
            fs::write(place.path(&name), changed.join("\n")).unwrap();
            let done = place.run(&format!("{name} -q -o again --force"));
            let told = String::from_utf8(done.stderr).unwrap();
            let what = format!("{key} = {wrong}");
            assert!(matches!(done.status.code(), Some(0 | 2 | 3 | 4)), "{what}: {:?} {told}", done.status);
            assert!(!told.contains("panicked") && told.lines().count() <= 1, "{what}: {told}");
        }
    }
    assert!(number > 30, "{number} plans tried");
}

#[test]
fn options_beside_a_plan_are_not_ignored() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    assert!(place.run_usual("drive.y4m").status.success());
    for more in [
        "--every 2",
        "--start 1",
        "--end 1",
        "--fps 5",
        "--max-frames 3",
        "--timestamps t",
        "--height 2",
        "--motion mean",
    ] {
        place.refused(&format!("out/run.toml -o again {more}"), 2, "already says");
    }
}

#[test]
fn the_reason_of_a_loss_is_told() {
    let place = HostileFolder::new();
    let mut video = y4m(60);
    let frames: Vec<usize> =
        video.windows(6).enumerate().filter(|(_, it)| it == b"FRAME\n").map(|(at, _)| at + 6).collect();
    // Black from frame 30 to 44.
    for &at in &frames[30..45] {
        let luma = frames[1] - frames[0] - 6;
        video[at..at + luma].fill(16);
    }
    fs::write(place.path("drive.y4m"), video).unwrap();
    let done = place.run("drive.y4m --camera camera.yaml --height 1 --motion rigid -o out");
    let told = String::from_utf8_lossy(&done.stderr).into_owned();
    let note = told.lines().find(|line| line.starts_with("note: lost from "));
    assert!(note.is_some_and(|note| note.contains("too dark to see anything")), "{told}");
}

#[test]
fn progress_is_told_as_lines_of_json() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(40)).unwrap();
    let done =
        place.run("drive.y4m --camera camera.yaml --height 1 --motion rigid -o out -q --progress json");
    assert!(done.status.success(), "{done:?}");
    let lines: Vec<serde_json::Value> = String::from_utf8(done.stderr)
        .unwrap()
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    let frames: Vec<u64> = lines.iter().map(|line| line["frames"].as_u64().unwrap()).collect();
    assert_eq!(frames, [0, 30, 40]);
    assert!(lines.iter().all(|line| line["lost"] == 0 && line.get("of").is_some()), "{lines:?}");
}

#[test]
fn results_are_identical_for_repetitions_and_thread_counts() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(40)).unwrap();
    assert!(place.run_usual("drive.y4m").status.success());
    assert!(place.run("out/run.toml -o again").status.success());
    for threads in ["1", "2", "3"] {
        let done = place.run(&format!(
            "drive.y4m --camera camera.yaml --height 1.0 -o threads{threads} --threads {threads}"
        ));
        assert!(done.status.success(), "{done:?}");
    }
    assert!(String::from_utf8_lossy(&place.result("out", "trajectory.csv")).contains("tracked"));
    for folder in ["again", "threads1", "threads2", "threads3"] {
        assert_whole(&place.path(folder));
        for name in FILES.iter().filter(|&&name| name != "stats.json") {
            assert!(place.result(folder, name) == place.result("out", name), "{folder}/{name} differs");
        }
    }
}

#[test]
fn a_blank_recording_has_results_without_poses() {
    let place = HostileFolder::new();
    let mut blank = y4m(0);
    for _ in 0..10 {
        blank.extend_from_slice(b"FRAME\n");
        blank.extend(vec![90; 320 * 240]);
    }
    fs::write(place.path("blank.y4m"), blank).unwrap();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    let done = place.run_usual("blank.y4m");
    let told = String::from_utf8(done.stderr).unwrap();
    assert_eq!(done.status.code(), Some(4), "{told}");
    assert!(told.contains("could not be measured in") && told.lines().count() == 2, "{told}");
    assert!(told.contains("note: lost from 0.00 to 0.30 s: too little texture to track"), "{told}");
    // Without poses there is no mosaic and no map; all other files exist.
    let wanted: Vec<&str> =
        FILES.into_iter().filter(|&name| !(name.starts_with("mosaic") || name == "map.gpkg")).collect();
    assert_eq!(names(&place.path("out")), wanted);
    // And no files of an earlier run remain.
    assert!(place.run("drive.y4m --camera camera.yaml --height 1 -o over").status.success());
    assert_eq!(place.run("blank.y4m --camera camera.yaml --height 1 -o over --force").status.code(), Some(4));
    assert_eq!(names(&place.path("over")), wanted);
}

/// Starts a run on standard input, sends 40 frames, and waits until a block of them is on disk.
fn begun(place: &HostileFolder, arguments: &str) -> Child {
    let mut command = place.command(&format!("- --camera camera.yaml --height 1 -o out {arguments}"));
    let mut child =
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    child.stdin.as_mut().unwrap().write_all(&y4m(40)).unwrap();
    let part = place.path("out/trajectory.csv.part");
    let patience = Instant::now() + Duration::from_secs(120);
    while fs::metadata(&part).map_or(0, |metadata| metadata.len()) == 0 {
        assert!(Instant::now() < patience, "nothing on disk after two minutes");
        std::thread::sleep(Duration::from_millis(5));
    }
    child
}

#[test]
#[cfg(unix)]
fn an_interrupt_ends_the_run_and_writes_everything() {
    for threads in ["1", "3"] {
        let place = HostileFolder::new();
        let mut child = begun(&place, &format!("--threads {threads}"));
        let sent = Command::new("sh").args(["-c", &format!("kill -INT {}", child.id())]).status().unwrap();
        assert!(sent.success());
        // The interrupt is checked between frames, so the stream stays open until the program ends.
        let mut stream = child.stdin.take().unwrap();
        let header = y4m(0).len();
        let frames = &y4m(2)[header..];
        while child.try_wait().unwrap().is_none() && stream.write_all(frames).is_ok() {}
        drop(stream);
        let done = child.wait_with_output().unwrap();
        assert_eq!(done.status.code(), Some(130), "{}", String::from_utf8_lossy(&done.stderr));
        assert_whole(&place.path("out"));
        let text = |name: &str| String::from_utf8(place.result("out", name)).unwrap();
        assert!(text("stats.json").contains("\"interrupted\": true"));
        let frames = text("trajectory.csv").lines().count() - 1;
        let interruption = format!("interrupted after {frames} frames");
        assert!(String::from_utf8_lossy(&done.stderr).contains(&interruption));
        assert!(text("report.html").contains(&interruption));
    }
}

#[test]
fn a_killed_run_leaves_the_frames_so_far() {
    let place = HostileFolder::new();
    let mut child = begun(&place, "");
    child.kill().unwrap();
    child.wait().unwrap();
    // The map so far, with the log that SQLite merges when the file is next opened.
    let left = ["map.gpkg", "map.gpkg-shm", "map.gpkg-wal", "map.gpkg.lock", "trajectory.csv.part"];
    assert_eq!(names(&place.path("out")), left);
    let text = fs::read_to_string(place.path("out/trajectory.csv.part")).unwrap();
    assert!(text.lines().count() > 30 && text.ends_with('\n'), "{text}");
    // That map is not overwritten without `--force`, but it can be continued. With `--force` the
    // folder is replaced.
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    let told = "out has a run that did not end; odograph view out shows what it has, and --force";
    assert_told(&place.run_usual("drive.y4m"), 2, told, "a second run");
    fs::rename(place.path("out/map.gpkg"), place.path("kept.gpkg")).unwrap();
    for log in ["-shm", "-wal"] {
        fs::rename(place.path(&format!("out/map.gpkg{log}")), place.path(&format!("kept.gpkg{log}")))
            .unwrap();
    }
    let done = place.run("drive.y4m --camera camera.yaml --height 1 -o next --map kept.gpkg -q");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert!(!place.path("next/map.gpkg").exists(), "there is one map");
    // The map contains the camera and its mount.
    let known = |folder: &str| {
        let plan = fs::read_to_string(place.path(&format!("{folder}/run.toml"))).unwrap();
        let table =
            plan.split("[camera]").nth(1).map(|rest| rest.split("[odometry").next().unwrap().to_owned());
        table.expect("the camera")
    };
    let done = place.run("drive.y4m -o without --map kept.gpkg -q");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert_eq!(known("without"), known("next"));
    assert_told(&place.run("drive.y4m -o x --map new.gpkg"), 2, "no camera is given", "a map that is new");
    // Its frames are not overwritten either, where its map was another one.
    assert_eq!(names(&place.path("out")), ["map.gpkg.lock", "trajectory.csv.part"]);
    assert_told(&place.run("drive.y4m -o out --map kept.gpkg"), 2, told, "over the frames");
    assert_eq!(fs::read_to_string(place.path("out/trajectory.csv.part")).unwrap(), text);
    let done = place.run("drive.y4m --camera camera.yaml --height 1 -o out --force");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert_whole(&place.path("out"));
}

#[test]
fn a_plan_is_repeated_from_any_folder() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    assert!(place.run_usual("drive.y4m").status.success());
    let mut there = place.command("run.toml -o ../again");
    let done = there.current_dir(place.path("out")).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert!(place.result("again", "trajectory.csv") == place.result("out", "trajectory.csv"));
    // Moved together with its recording, the plan can still be repeated.
    fs::create_dir(place.path("elsewhere")).unwrap();
    for name in ["drive.y4m", "out"] {
        fs::rename(place.path(name), place.path("elsewhere").join(name)).unwrap();
    }
    let done = place.run("elsewhere/out/run.toml -o third");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
}

#[test]
fn a_demo_overwrites_no_foreign_files() {
    let place = HostileFolder::new();
    fs::create_dir(place.path("mine")).unwrap();
    fs::write(place.path("mine/trajectory.tum"), "mine").unwrap();
    let mut demo = Command::new(env!("CARGO_BIN_EXE_odograph"));
    let done = demo.current_dir(place.path("")).args(["demo", "-o", "mine"]).output().unwrap();
    assert_told(&done, 2, "mine/trajectory.tum is already there", "demo -o mine");
    assert_eq!(names(&place.path("mine")), ["trajectory.tum"]);
    // Nor over an input that somebody has changed, nor over a demo before it.
    fs::create_dir_all(place.path("changed/input")).unwrap();
    fs::write(place.path("changed/input/camera.yaml"), "mine").unwrap();
    let mut demo = Command::new(env!("CARGO_BIN_EXE_odograph"));
    let done = demo.current_dir(place.path("")).args(["demo", "-o", "changed"]).output().unwrap();
    assert_told(&done, 2, "changed/input/camera.yaml is already there", "demo -o changed");
    assert_eq!(fs::read(place.path("changed/input/camera.yaml")).unwrap(), b"mine");
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
        let told = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(done.status.success(), "{told}");
        assert_eq!(
            told.contains("warning: --height 90 is read as 90 metres; if centimetres are meant, write 90cm"),
            doubted
        );
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
    place.refused(with_rig, 3, "no camera over ground is that high");
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
fn a_map_in_use_is_refused_before_any_work() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    let mut other = begun(&place, "--map hall.gpkg");
    let holder = format!("being written by another program (process {})", other.id());
    place.refused("drive.y4m --camera camera.yaml --height 1 -o second --map hall.gpkg", 3, &holder);
    // The folder of a map in use is not overwritten, not even with `--force`.
    place.refused("drive.y4m --camera camera.yaml --height 1 -o out --force", 3, &holder);
    drop(other.stdin.take());
    let done = other.wait_with_output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert!(place.result("out", "trajectory.tum").len() > 1000);
    let again = place.run("drive.y4m --camera camera.yaml --height 1 -o second --map hall.gpkg -q");
    assert!(again.status.success(), "{}", String::from_utf8_lossy(&again.stderr));
}

#[test]
fn an_empty_map_of_a_killed_run_is_replaced() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    fs::write(place.path("hall.gpkg"), "").unwrap();
    fs::create_dir(place.path("out")).unwrap();
    fs::write(place.path("out/map.gpkg"), "").unwrap();
    let done = place.run("drive.y4m --camera camera.yaml --height 1 -o with --map hall.gpkg -q");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert!(fs::metadata(place.path("hall.gpkg")).unwrap().len() > 0);
    assert!(place.run_usual("drive.y4m").status.success());
    assert_whole(&place.path("out"));
}

#[test]
#[cfg(unix)]
fn a_closed_output_pipe_is_no_failure() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let done =
        place.command("drive.y4m --camera camera.yaml --height 1 -o out").stdout(writer).output().unwrap();
    assert!(done.status.success() && done.stderr.is_empty(), "{done:?}");
    assert_whole(&place.path("out"));
}
