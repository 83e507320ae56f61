//! Folders for temporary files: removed after an interrupt, after a kill, and where they are full.

use super::interruptions::full_pipe;
use super::recording::{names, y4m};
use super::run_folder::{HostileFolder, Mounted, assert_refused};
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// A folder with a map, a recording of its ground and a place for temporary files.
fn mapped() -> HostileFolder {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(40)).unwrap();
    assert!(place.run("drive.y4m --camera camera.yaml --height 1 -o out -q").status.success());
    fs::create_dir(place.path("temporary")).unwrap();
    place
}

fn localize(place: &HostileFolder, arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
    command.arg("localize").args(arguments.split(' ')).args(["--map", "out/map.gpkg"]);
    command.current_dir(place.path("")).env("TMPDIR", place.path("temporary")).stdin(Stdio::null());
    command
}

/// Starts a localization on standard input, which waits for frames in its temporary folder.
fn waiting(place: &HostileFolder, mut command: Command) -> Child {
    let before = names(&place.path("temporary"));
    let mut child = command.stdin(Stdio::piped()).spawn().unwrap();
    while names(&place.path("temporary")) == before {
        assert!(child.try_wait().unwrap().is_none(), "it ended by itself");
        std::thread::sleep(Duration::from_millis(5));
    }
    child
}

#[test]
fn what_a_killed_localization_leaves_is_removed_by_the_next() {
    let place = mapped();
    let mut killed = waiting(&place, localize(&place, "-"));
    killed.kill().unwrap();
    killed.wait().unwrap();
    let left = names(&place.path("temporary"));
    assert_eq!(left, [format!("odograph-temporary-{}-0", killed.id())]);
    // One that goes on keeps its folder.
    let mut going_on = waiting(&place, localize(&place, "-"));
    let kept = [format!("odograph-temporary-{}-0", going_on.id())];
    assert!(localize(&place, "drive.y4m -q").status().unwrap().success());
    assert_eq!(names(&place.path("temporary")), kept);
    going_on.kill().unwrap();
    going_on.wait().unwrap();
    assert!(localize(&place, "drive.y4m -q").status().unwrap().success());
    assert!(names(&place.path("temporary")).is_empty());
}

#[test]
fn an_interrupted_localization_leaves_no_temporary_folder() {
    let place = mapped();
    // The first signal ends it between two frames, of which there is none; the second one at once,
    // here while its log cannot be written.
    let pipe = full_pipe(&place.path("full"));
    for signal in ["-TERM", "-INT"] {
        let log = fs::OpenOptions::new().write(true).open(place.path("full")).unwrap();
        let mut command = localize(&place, "drive.y4m -vv");
        command.stdout(Stdio::null()).stderr(log);
        let mut child = waiting(&place, command);
        while child.try_wait().unwrap().is_none() {
            let sent = Command::new("kill").args([signal, &child.id().to_string()]).status();
            assert!(sent.is_ok());
            std::thread::sleep(Duration::from_millis(100));
        }
        assert_eq!(child.wait().unwrap().code(), Some(130));
        assert!(names(&place.path("temporary")).is_empty(), "{signal}");
    }
    drop(pipe);
}

#[test]
fn a_full_temporary_folder_is_named_with_the_way_out() {
    let place = mapped();
    let small = place.path("small");
    let run = |temporary: &Path| localize(&place, "drive.y4m").env("TMPDIR", temporary).output().unwrap();
    let missing = run(&place.path("missing"));
    assert_refused(&missing, 3, "a folder for temporary files cannot be made in ", "no such folder");
    let way_out = "; set TMPDIR to a folder where you may write\n";
    assert!(String::from_utf8_lossy(&missing.stderr).ends_with(way_out), "{missing:?}");
    let Some(_mounted) = Mounted::new(&small, "size=20k") else { return };
    let full = run(&small);
    assert_refused(&full, 3, " cannot be written: ", "a small TMPDIR");
    let way_out = format!("; free some space in {}, or set TMPDIR to another folder\n", small.display());
    assert!(String::from_utf8_lossy(&full.stderr).ends_with(&way_out), "{full:?}");
    assert!(names(&small).is_empty());
}
