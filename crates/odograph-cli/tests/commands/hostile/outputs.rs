//! Output folders, full disks, and what a run writes.

use super::recording::{PngPicture, names, picture_folder, y4m};
#[cfg(target_os = "linux")]
use super::run_folder::Mounted;
use super::run_folder::{FILES, HostileFolder, assert_refused, assert_whole};
use std::fs;
use std::path::Path;
use std::process::Command;

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
    // Pictures of a recording and pictures of its results would be one folder.
    picture_folder(&place.path("frames"), 3, PngPicture::gray8);
    let before = names(&place.path("frames"));
    let into_itself = "frames --camera camera.yaml --height 1 --fps 30 -o frames/.";
    place.refused(into_itself, 2, "is the folder of the recording");
    assert_eq!(names(&place.path("frames")), before);
    // A map that is one of the other results would be overwritten at the end of the run.
    for map in ["out/stats.json", "out/../out/report.html"] {
        let arguments = format!("drive.y4m --camera camera.yaml --height 1 -o out --map {map}");
        place.refused(&arguments, 2, "is one of the results of this run and cannot be its map");
    }
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

#[test]
#[cfg(unix)]
fn warnings_of_a_run_that_fails_are_kept() {
    if !Path::new("/dev/full").exists() {
        println!("skipped: dev-full: there is no /dev/full");
        return;
    }
    let place = HostileFolder::new();
    let mut recording = y4m(20);
    recording.truncate(recording.len() - 100);
    fs::write(place.path("drive.y4m"), recording).unwrap();
    std::os::unix::fs::symlink("/dev/full", place.path("poses.mcap.part")).unwrap();
    let done = place.run("drive.y4m --camera camera.yaml --height 1 -o out --bag-out poses.mcap");
    let told = String::from_utf8(done.stderr).unwrap();
    assert_eq!(done.status.code(), Some(3), "{told}");
    let (warning, error) = ("the stream is cut off inside frame 19", "No space left on device");
    assert_eq!(told.matches(error).count(), 1, "{told}");
    let statistics: serde_json::Value = serde_json::from_slice(&place.result("out", "stats.json")).unwrap();
    let kept: Vec<&str> =
        statistics["warnings"].as_array().unwrap().iter().map(|warning| warning.as_str().unwrap()).collect();
    assert!(kept.iter().any(|kept| kept.contains(warning)), "{kept:?}");
    assert!(kept.iter().any(|kept| kept.contains("there is no bag") && kept.contains(error)), "{kept:?}");
}

#[test]
#[cfg(unix)]
fn a_full_disk_costs_the_overlay_video_and_nothing_else() {
    if !Path::new("/dev/full").exists() {
        println!("skipped: dev-full: there is no /dev/full");
        return;
    }
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(20)).unwrap();
    std::os::unix::fs::symlink("/dev/full", place.path("drive.avi.part")).unwrap();
    let done = place.run("drive.y4m --camera camera.yaml --height 1 -o out --video-out drive.avi");
    let told = String::from_utf8(done.stderr).unwrap();
    assert_eq!(done.status.code(), Some(3), "{told}");
    assert!(told.contains("drive.avi cannot be written: No space left on device"), "{told}");
    assert_eq!(told.trim_end().lines().count(), 1, "{told}");
    assert!(!place.path("drive.avi").exists() && !place.path("drive.avi.part").is_symlink());
    assert_whole(&place.path("out"));
}

#[test]
#[cfg(unix)]
fn everything_that_a_full_disk_costs_is_named_and_nothing_stale_is_left() {
    if !Path::new("/dev/full").exists() {
        println!("skipped: dev-full: there is no /dev/full");
        return;
    }
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(20)).unwrap();
    assert!(place.run_usual("drive.y4m").status.success());
    let lost = ["map.png", "mosaic.png", "odometry.tum"];
    for name in lost {
        std::os::unix::fs::symlink("/dev/full", place.path(&format!("out/{name}.part"))).unwrap();
    }
    let done = place.run("drive.y4m --camera camera.yaml --height 1 -o out --force");
    let told = String::from_utf8(done.stderr).unwrap();
    assert_eq!(done.status.code(), Some(3), "{told}");
    for name in lost {
        let there_is_no = format!("out/{name} cannot be written: No space left on device");
        assert_eq!(told.matches(&there_is_no).count(), 1, "{name}: {told}");
    }
    let kept: Vec<&str> = FILES.into_iter().filter(|name| !lost.contains(name)).collect();
    assert_eq!(names(&place.path("out")), kept);
    let statistics: serde_json::Value = serde_json::from_slice(&place.result("out", "stats.json")).unwrap();
    for name in lost {
        assert!(statistics["warnings"].to_string().contains(name), "{statistics}");
    }
    let report = String::from_utf8(place.result("out", "report.html")).unwrap();
    assert!(report.contains("map.svg") && !report.contains("href=\"map.png\""));
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
        // The final trajectory is written to a third file: the growing one beside it must survive
        // a disk that is full at the end.
        let (beside, stay) = match name {
            "trajectory.csv" => ("trajectory.csv.new".to_owned(), vec!["trajectory.csv.part"]),
            "run.toml" => ("run.toml.new".to_owned(), vec![]),
            _ => (format!("{name}.part"), vec![]),
        };
        std::os::unix::fs::symlink("/dev/full", out.join(beside)).unwrap();
        // What runs a recording again is given up where the disk is full, and the path is written
        // once more; a drive on standard input has nothing to give up.
        let mut run = place.command("- --camera camera.yaml --height 1.0 -o out");
        let drive = fs::File::open(place.path("drive.y4m")).unwrap();
        assert_refused(&run.stdin(drive).output().unwrap(), 3, "No space left on device", name);
        assert!(!out.join(name).exists(), "{name}");
        let left = names(&out);
        let halves: Vec<&String> = left.iter().filter(|left| left.ends_with(".part")).collect();
        assert_eq!(halves, stay, "{name}");
        // Without the path there is nothing else; what is made from it is written without the
        // others.
        let made_from_path = !["trajectory.csv", "trajectory.tum", "run.toml"].contains(&name);
        for other in FILES.into_iter().filter(|other| made_from_path && *other != name) {
            let goes_with = other.starts_with("carrier") || other.starts_with("trajectory-smoothed");
            assert!(left.iter().any(|left| left == other) || goes_with, "{other} without {name}");
        }
        if let Some(grown) = stay.first() {
            // The header and one line for each of the forty frames.
            assert_eq!(fs::read_to_string(out.join(grown)).unwrap().lines().count(), 41);
        }
        fs::remove_dir_all(&out).unwrap();
    }
    let full = fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let mut to_full_disk = place.command("drive.y4m --camera camera.yaml --height 1 -o told --json");
    assert_refused(
        &to_full_disk.stdout(full).output().unwrap(),
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
    let Some(small) = Mounted::new(&mounted, "size=20k") else { return };
    let done = place.run("drive.y4m --camera camera.yaml --height 1 -o small/out");
    let left = if mounted.join("out").exists() { names(&mounted.join("out")) } else { Vec::new() };
    drop(small);
    let told = String::from_utf8(done.stderr).unwrap();
    assert_eq!(done.status.code(), Some(3), "{told}");
    // One line for each file that is missing.
    assert!(
        told.lines().count() > 0 && told.lines().all(|line| line.contains("cannot be written")),
        "{told}"
    );
    assert!(left.iter().all(|name| !name.ends_with(".part")), "{left:?}");
}

#[test]
fn the_reason_of_a_loss_is_printed_and_is_in_the_map() {
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
    let message = String::from_utf8_lossy(&done.stderr).into_owned();
    let note = message.lines().find_map(|line| line.strip_prefix("note: "));
    let note = note.filter(|note| note.starts_with("lost from ")).unwrap_or_else(|| panic!("{message}"));
    assert!(note.contains("too dark to see anything"), "{message}");
    // The map says the same, and so does what is saved of it.
    let map = |arguments: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
        command.current_dir(place.path("")).arg("map").args(arguments.split(' '));
        String::from_utf8(command.output().unwrap().stdout).unwrap()
    };
    map("repair out/map.gpkg -o repaired.gpkg");
    for file in ["out/map.gpkg", "repaired.gpkg"] {
        let shown = map(&format!("info {file} --check"));
        assert!(shown.lines().any(|line| line.trim() == note), "{file}: {shown}");
    }
    let facts: serde_json::Value = serde_json::from_str(&map("info out/map.gpkg --json")).unwrap();
    let loss = &facts["sessions"][0]["losses"][0];
    assert_eq!((loss["frames"].as_u64(), loss["reasons"][0].as_str()), (Some(15), Some("dark")), "{loss}");
    let [start_s, end_s] = ["start_s", "end_s"].map(|name| loss[name].as_f64().unwrap());
    assert!((start_s - 1.0).abs() < 1e-6 && (end_s - 1.5).abs() < 0.2, "{loss}");
}

#[test]
fn progress_is_printed_as_lines_of_json() {
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
    let message = String::from_utf8(done.stderr).unwrap();
    assert_eq!(done.status.code(), Some(4), "{message}");
    assert!(message.contains("could not be measured in") && message.lines().count() == 2, "{message}");
    assert!(message.contains("note: lost from 0.00 to 0.30 s: too little texture to track"), "{message}");
    // Without poses there is no mosaic and no map; all other files exist.
    let wanted: Vec<&str> =
        FILES.into_iter().filter(|&name| !(name.starts_with("mosaic") || name == "map.gpkg")).collect();
    assert_eq!(names(&place.path("out")), wanted);
    // And no files of an earlier run remain.
    assert!(place.run("drive.y4m --camera camera.yaml --height 1 -o over").status.success());
    assert_eq!(place.run("blank.y4m --camera camera.yaml --height 1 -o over --force").status.code(), Some(4));
    assert_eq!(names(&place.path("over")), wanted);
}

#[test]
fn a_demo_overwrites_no_foreign_files() {
    let place = HostileFolder::new();
    fs::create_dir(place.path("mine")).unwrap();
    fs::write(place.path("mine/trajectory.tum"), "mine").unwrap();
    let mut demo = Command::new(env!("CARGO_BIN_EXE_odograph"));
    let done = demo.current_dir(place.path("")).args(["demo", "-o", "mine"]).output().unwrap();
    assert_refused(&done, 2, "mine/trajectory.tum is already there", "demo -o mine");
    assert_eq!(names(&place.path("mine")), ["trajectory.tum"]);
    // Nor over an input that somebody has changed, nor over a demo before it.
    fs::create_dir_all(place.path("changed/input")).unwrap();
    fs::write(place.path("changed/input/camera.yaml"), "mine").unwrap();
    let mut demo = Command::new(env!("CARGO_BIN_EXE_odograph"));
    let done = demo.current_dir(place.path("")).args(["demo", "-o", "changed"]).output().unwrap();
    assert_refused(&done, 2, "changed/input/camera.yaml is already there", "demo -o changed");
    assert_eq!(fs::read(place.path("changed/input/camera.yaml")).unwrap(), b"mine");
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
