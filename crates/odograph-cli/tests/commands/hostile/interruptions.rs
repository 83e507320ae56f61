//! Runs that are interrupted or killed, and maps that are in use.

use super::recording::{names, y4m};
use super::run_folder::{HostileFolder, assert_refused, assert_whole};
use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Starts a run on standard input, and sends 40 frames, then more, until a block of more than 30 is
/// on disk: frames are written once in a while, and a slow machine has tracked fewer by then.
fn begun(place: &HostileFolder, arguments: &str) -> Child {
    let mut command = place.command(&format!("- --camera camera.yaml --height 1 -o out {arguments}"));
    let mut child =
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let (header, stream) = (y4m(0).len(), y4m(160));
    let frame = (stream.len() - header) / 160;
    let (first, mut more) = stream.split_at(header + 40 * frame);
    child.stdin.as_mut().unwrap().write_all(first).unwrap();
    let part = place.path("out/trajectory.csv.part");
    let patience = Instant::now() + Duration::from_secs(120);
    let lines = || fs::read_to_string(&part).map_or(0, |text| text.lines().count());
    while lines() <= 30 {
        assert!(Instant::now() < patience, "{} lines on disk after two minutes", lines());
        if lines() > 0 && !more.is_empty() {
            child.stdin.as_mut().unwrap().write_all(&more[..frame]).unwrap();
            more = &more[frame..];
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    child
}

#[test]
#[cfg(unix)]
fn an_interrupt_ends_the_run_and_writes_everything() {
    for threads in ["1", "3"] {
        let place = HostileFolder::new();
        let mut child = begun(&place, &format!("--threads {threads}"));
        // Twice at once, as `timeout` does: that is one request.
        let twice = format!("kill -INT {0} && kill -INT {0}", child.id());
        let sent = Command::new("sh").args(["-c", &twice]).status().unwrap();
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
    let frames = text.lines().count() - 1;
    let message = &format!(
        "out has a run that did not end; {frames} frames are on disk, {frames} with a pose; odograph view out shows \
         what it has, and --force"
    );
    assert_refused(&place.run_usual("drive.y4m"), 2, message, "a second run");
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
    assert_refused(&place.run("drive.y4m -o x --map new.gpkg"), 2, "no camera is given", "a map that is new");
    // Its frames are not overwritten either, where its map was another one.
    assert_eq!(names(&place.path("out")), ["map.gpkg.lock", "trajectory.csv.part"]);
    assert_refused(&place.run("drive.y4m -o out --map kept.gpkg"), 2, message, "over the frames");
    assert_eq!(fs::read_to_string(place.path("out/trajectory.csv.part")).unwrap(), text);
    let done = place.run("drive.y4m --camera camera.yaml --height 1 -o out --force");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert_whole(&place.path("out"));
}

/// Starts a run over `drive.y4m`, and kills it when a block of frames is on disk.
fn kill(place: &HostileFolder, arguments: &str) {
    let usual = format!("drive.y4m --camera camera.yaml --height 1 -o out {arguments}");
    kill_on_disk(place, place.command(&usual));
}

/// Starts a command that writes the folder `out`, and kills it when a block of frames is on disk.
fn kill_on_disk(place: &HostileFolder, mut command: Command) {
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let part = place.path("out/trajectory.csv.part");
    while fs::metadata(&part).map_or(0, |metadata| metadata.len()) == 0 {
        assert!(child.try_wait().unwrap().is_none(), "it ended before it was killed");
        std::thread::sleep(Duration::from_millis(1));
    }
    child.kill().unwrap();
    child.wait().unwrap();
}

#[test]
fn a_killed_run_is_run_again_in_its_folder() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(150)).unwrap();
    let usual = "drive.y4m --camera camera.yaml --height 1";
    assert!(place.run(&format!("{usual} -o whole -q")).status.success());
    kill(&place, "");
    let message = "odograph run --resume out runs it again, to its end; odograph view out shows what it has";
    assert_refused(&place.run(&format!("{usual} -o out")), 2, message, "a second run");
    let away = "--resume runs what was begun in out as it was begun; leave --height away";
    assert_refused(&place.run("--resume out --height 2"), 2, away, "another height");
    let nameless = "the run in out was begun without the name of a robot";
    assert_refused(&place.run("--resume out --site http://127.0.0.1:9/"), 2, nameless, "a site");
    let done = place.run("--resume out -q");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert_whole(&place.path("out"));
    for name in ["trajectory.csv", "trajectory.tum", "run.toml"] {
        assert!(place.result("out", name) == place.result("whole", name), "{name}");
    }
    assert_refused(&place.run("--resume out"), 2, "out has a run that is complete", "a complete run");
    assert_refused(&place.run("--resume none"), 2, "none is not the folder of a run", "no folder");
    fs::create_dir(place.path("empty")).unwrap();
    assert_refused(&place.run("--resume empty"), 2, "empty has no run that was begun", "no run");
}

#[test]
fn a_run_again_replaces_its_half_in_the_map() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(150)).unwrap();
    let sessions = || {
        let info = Command::new(env!("CARGO_BIN_EXE_odograph"))
            .args(["map", "info", "hall.gpkg"])
            .current_dir(place.path(""))
            .output()
            .unwrap();
        let text = String::from_utf8(info.stdout).unwrap();
        text.lines().filter(|line| line.starts_with("session ")).count()
    };
    fs::create_dir(place.path("elsewhere")).unwrap();
    // First into a new map, then into the map that this has made.
    for count in [1, 2] {
        kill(&place, "--map hall.gpkg --force");
        assert_eq!(sessions(), count);
        // From another folder, from which the recording has another name.
        let mut command = place.command("--resume ../out -q");
        let done = command.current_dir(place.path("elsewhere")).output().unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        assert_eq!(sessions(), count, "the killed one is not beside it");
    }
    kill(&place, "--map hall.gpkg --force");
    assert!(place.run("drive.y4m -o other --map hall.gpkg -q").status.success());
    let message = "hall.gpkg has been continued since this run was killed";
    assert_refused(&place.run("--resume out"), 3, message, "a map that others have continued");
}

/// A stream of the same floor, mirrored: other ground.
fn mirrored(frames: usize) -> Vec<u8> {
    let (header, rows) = (y4m(0).len(), 240);
    let mut stream = y4m(frames);
    for frame in stream[header..].chunks_exact_mut("FRAME\n".len() + 320 * rows) {
        let pixels = &mut frame["FRAME\n".len()..];
        let turned: Vec<u8> = pixels.rchunks_exact(320).flatten().copied().collect();
        pixels.copy_from_slice(&turned);
    }
    stream
}

#[test]
fn a_killed_localization_leaves_a_session_that_is_reported_and_removed() {
    let place = HostileFolder::new();
    fs::write(place.path("mapped.y4m"), y4m(40)).unwrap();
    fs::write(place.path("drive.y4m"), mirrored(150)).unwrap();
    assert!(place.run("mapped.y4m --camera camera.yaml --height 1 -o out -q").status.success());
    fs::rename(place.path("out/map.gpkg"), place.path("hall.gpkg")).unwrap();
    fs::remove_dir_all(place.path("out")).unwrap();
    let odograph = |arguments: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
        command.args(arguments.split(' ')).current_dir(place.path("")).stdin(Stdio::null());
        command
    };
    let said = |arguments: &str| {
        let done = odograph(arguments).output().unwrap();
        assert!(done.status.success(), "{arguments}: {}", String::from_utf8_lossy(&done.stderr));
        String::from_utf8([done.stdout, done.stderr].concat()).unwrap()
    };
    let whole = said("map info hall.gpkg");
    kill_on_disk(&place, odograph("localize drive.y4m --map hall.gpkg --extend -o out"));
    let info = said("map info hall.gpkg");
    assert!(info.contains("session 1  drive.y4m") && info.contains("did not end: it has no path"), "{info}");
    let sound = said("map repair hall.gpkg");
    assert!(
        sound.contains("no damage found") && sound.contains("session 1 (drive.y4m) did not end"),
        "{sound}"
    );
    let without = said("map repair hall.gpkg --drop-unfinished");
    assert!(without.contains("of a session that did not end left out\nhall-repaired.gpkg\n"), "{without}");
    let content = |info: &str| info.lines().skip(1).map(str::to_owned).collect::<Vec<_>>();
    assert_eq!(content(&said("map info hall-repaired.gpkg")), content(&whole));
    let nothing = said("map repair hall-repaired.gpkg --drop-unfinished");
    assert!(nothing.contains("every session ended; nothing was written"), "{nothing}");
    // A run that continues the map reports it. Resumed, it leaves the map as it was, where nothing
    // is recognised.
    fs::copy(place.path("hall.gpkg"), place.path("copy.gpkg")).unwrap();
    for log in ["-wal", "-shm"] {
        let _ = fs::copy(place.path(&format!("hall.gpkg{log}")), place.path(&format!("copy.gpkg{log}")));
    }
    let continued = said("run mapped.y4m --map copy.gpkg -o more");
    assert!(continued.contains("note: session 1 of copy.gpkg (drive.y4m) did not end"), "{continued}");
    let again = said("run --resume out");
    assert!(again.contains("was recognised: it stays as it was"), "{again}");
    assert_eq!(content(&said("map info hall.gpkg")), content(&whole));
}

#[test]
fn a_stream_extends_a_map_or_says_why_not() {
    let place = HostileFolder::new();
    fs::write(place.path("mapped.y4m"), y4m(90)).unwrap();
    assert!(place.run("mapped.y4m --camera camera.yaml --height 1 -o out -q").status.success());
    for (frames, code, words) in [
        (y4m(90), 0, "of session "),
        (mirrored(40), 4, "not found: standard input"),
        (y4m(2), 4, "send it again without"),
    ] {
        let mut child = Command::new(env!("CARGO_BIN_EXE_odograph"))
            .args(["localize", "-", "--map", "out/map.gpkg", "--extend"])
            .current_dir(place.path(""))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        child.stdin.take().unwrap().write_all(&frames).unwrap();
        let done = child.wait_with_output().unwrap();
        let said = String::from_utf8([done.stdout, done.stderr].concat()).unwrap();
        assert_eq!(done.status.code(), Some(code), "{said}");
        assert!(said.contains(words), "{said}");
        assert_eq!(said.contains("map.gpkg was not extended"), code == 4, "{said}");
    }
}

/// A full pipe: who writes into it waits.
#[cfg(target_os = "linux")]
pub(super) fn full_pipe(path: &Path) -> fs::File {
    use std::os::unix::fs::OpenOptionsExt;
    const NONBLOCK: i32 = 0o4000;
    assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
    let mut pipe = fs::OpenOptions::new().read(true).write(true).custom_flags(NONBLOCK).open(path).unwrap();
    while pipe.write(&[0; 4096]).is_ok() {}
    pipe
}

/// Whether a process has a file open.
#[cfg(target_os = "linux")]
fn has_open(process: u32, path: &Path) -> bool {
    let Ok(entries) = fs::read_dir(format!("/proc/{process}/fd")) else { return false };
    entries.flatten().any(|entry| fs::read_link(entry.path()).is_ok_and(|open| open == path))
}

#[test]
#[cfg(target_os = "linux")]
fn a_run_killed_while_its_path_is_written_is_run_again() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(40)).unwrap();
    let usual = "drive.y4m --camera camera.yaml --height 1";
    assert!(place.run(&format!("{usual} -o whole -q")).status.success());
    for name in ["trajectory.csv.new", "trajectory.tum.part", "run.toml.new"] {
        // In the place of this file is a pipe in which the program gets stuck.
        fs::create_dir(place.path("out")).unwrap();
        let pipe = fs::canonicalize(place.path("out")).unwrap().join(name);
        let full = full_pipe(&pipe);
        let mut command = place.command(&format!("{usual} -o out -q"));
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        while !has_open(child.id(), &pipe) {
            assert!(child.try_wait().unwrap().is_none(), "it ended before it was killed");
            std::thread::sleep(Duration::from_millis(1));
        }
        child.kill().unwrap();
        child.wait().unwrap();
        drop(full);
        fs::remove_file(&pipe).unwrap();
        let done = place.run("--resume out -q");
        assert!(done.status.success(), "{name}: {}", String::from_utf8_lossy(&done.stderr));
        assert_whole(&place.path("out"));
        assert!(place.result("out", "trajectory.csv") == place.result("whole", "trajectory.csv"), "{name}");
        fs::remove_dir_all(place.path("out")).unwrap();
    }
}

#[test]
fn a_run_again_is_the_same_session_for_a_site() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(150)).unwrap();
    let origins = |map: &str| {
        let map = odograph_map::MapFile::open_read_only(&place.path(map)).unwrap();
        let sessions = map.sessions().unwrap().into_iter();
        sessions.map(|session| (session.origin.unwrap(), session.source)).collect::<Vec<_>>()
    };
    fs::create_dir(place.path("elsewhere")).unwrap();
    for (arguments, map) in [("", "out/map.gpkg"), ("--map hall.gpkg", "hall.gpkg")] {
        kill(&place, &format!("--robot cart --force {arguments}"));
        let begun = origins(map);
        let mut command = place.command("--resume ../out -q");
        let done = command.current_dir(place.path("elsewhere")).output().unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        assert_eq!(origins(map), begun);
    }
    // Another run is another session.
    assert!(place.run("drive.y4m --map hall.gpkg --robot cart -o other -q").status.success());
    let [(first, _), (second, _)] = &origins("hall.gpkg")[..] else { panic!("two sessions") };
    assert_ne!(first, second);
}

#[test]
#[cfg(target_os = "linux")]
fn one_interrupt_ends_the_wait_for_a_pipe() {
    let place = HostileFolder::new();
    assert!(Command::new("mkfifo").arg(place.path("pipe")).status().unwrap().success());
    let usual = "--camera camera.yaml --height 1 -o out";
    // Nobody writes; a writer that writes nothing; one that writes a part of the first frame.
    for (written, arguments) in [(None, "pipe"), (Some(0), "pipe"), (Some(1000), "pipe"), (Some(0), "-")] {
        let before = names(&place.path(""));
        let mut command = place.command(&format!("{arguments} {usual}"));
        let mut child =
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        // It is open once the program has it open.
        let mut writer = written.filter(|_| arguments == "pipe").map(|count| {
            let mut pipe = fs::OpenOptions::new().write(true).open(place.path("pipe")).unwrap();
            pipe.write_all(&y4m(1)[..count]).unwrap();
            pipe
        });
        // Until its handler is in place and it waits for the pipe, which it has a folder for.
        while !place.path("out/trajectory.csv.part").exists() {
            assert!(child.try_wait().unwrap().is_none(), "it ended by itself");
            std::thread::sleep(Duration::from_millis(5));
        }
        let sent = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
        assert!(sent.success());
        let stdin = child.stdin.take();
        let done = child.wait_with_output().unwrap();
        drop((stdin, writer.take()));
        let message = "interrupted while waiting for frames; nothing was written";
        assert_refused(&done, 130, message, arguments);
        assert_eq!(names(&place.path("")), before);
    }
}

#[test]
fn a_run_that_goes_on_is_not_run_again() {
    let place = HostileFolder::new();
    let mut child = begun(&place, "");
    for arguments in ["--resume out", "drive.y4m --camera camera.yaml --height 1 -o out"] {
        assert_refused(&place.run(arguments), 2, "out has a run that goes on", arguments);
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let message = "out does not say how its run began";
    assert_refused(&place.run("--resume out"), 2, message, "standard input");
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
