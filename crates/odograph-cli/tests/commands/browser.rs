//! `--open`: results in the browser of the person at this machine.

use super::program::{done_once, odograph};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

#[test]
fn open_shows_the_report_and_says_where_there_is_no_browser() {
    let place = tempfile::tempdir().unwrap();
    let here = place.path();
    done_once(here, "simulate -o sim --path straight --length 0.3 --size 320x240 --fps 15 --format mjpeg -q");
    let browser = here.join("browser");
    fs::write(&browser, "#!/bin/sh\necho \"$1\" > opened\n").unwrap();
    fs::set_permissions(&browser, fs::Permissions::from_mode(0o755)).unwrap();
    let run = |browser: &std::path::Path, folder: &str| {
        let arguments = "run sim/sim.avi --camera sim/camera.yaml --height 0.9 --open --quiet -o";
        let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
        command.current_dir(here).env("BROWSER", browser).args(arguments.split(' ')).arg(folder);
        let output = command.output().unwrap();
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stderr).unwrap()
    };
    assert_eq!(run(&browser, "seen"), "");
    // The browser is not waited for by the program: it may write after the program has ended.
    let opened = here.join("opened");
    let deadline = Instant::now() + Duration::from_secs(60);
    while fs::read_to_string(&opened).unwrap_or_default().is_empty() && Instant::now() < deadline {
        thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(fs::read_to_string(&opened).unwrap(), "seen/report.html\n");
    let told = run(&here.join("none"), "unseen");
    assert!(told.contains("no browser could be opened"), "{told}");
    assert!(told.contains("open unseen/report.html yourself"), "{told}");
}

#[test]
fn open_needs_a_page() {
    let place = tempfile::tempdir().unwrap();
    let refused = odograph(place.path(), "live drive.mp4 --field-of-view 1x1 --open");
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("--open is for the page"), "{refused:?}");
}
