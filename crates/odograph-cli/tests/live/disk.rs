//! Tests with a full disk.

#![cfg(target_os = "linux")]

use super::program::{self, DEMO, LiveFolder, statistics, write_uncompressed};
use serde_json::json;
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A file system in memory of a given size, mounted on a folder; unmounted when dropped.
pub struct SmallDisk {
    path: PathBuf,
}

impl SmallDisk {
    /// The error says why it cannot be mounted: only root may, and not everywhere.
    pub fn mount(path: &Path, bytes: u64) -> Result<Self, String> {
        let options = format!("size={bytes}");
        let done = Command::new("mount").args(["-t", "tmpfs", "-o", &options, "small"]).arg(path).output();
        match done {
            Ok(done) if done.status.success() => Ok(Self { path: path.to_owned() }),
            Ok(done) => Err(format!("no small disk: {}", String::from_utf8_lossy(&done.stderr).trim())),
            Err(error) => Err(format!("no small disk: {error}")),
        }
    }

    /// Fills it to the last byte.
    pub fn fill(&self) {
        let mut file = File::create(self.path.join("filling")).unwrap();
        for size in [1 << 20, 1 << 12, 1] {
            while file.write_all(&vec![1; size]).is_ok() {}
        }
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.path).status();
    }
}

#[test]
fn a_nearly_full_disk_stops_recording_but_not_tracking() {
    let place = LiveFolder::new();
    std::fs::create_dir(place.path("disk")).unwrap();
    let disk = match SmallDisk::mount(&place.path("disk"), 32 << 20) {
        Ok(disk) => disk,
        Err(why) => {
            println!("skipped: mount: {why}");
            return;
        }
    };
    let mut live = place.server("live", &format!("{DEMO}/drive.mp4 --realtime 4 --print poses -o disk/out"));
    let mut poses = BufReader::new(live.output()).lines();
    let mut status = |live: &program::ServingProgram| {
        assert!(poses.by_ref().take(20).count() == 20, "the drive ended");
        serde_json::from_str::<serde_json::Value>(&live.get("/state")).unwrap()["status"].clone()
    };
    let mut outcome = status(&live);
    while outcome["message"].is_null() {
        outcome = status(&live);
    }
    let message = outcome["message"].as_str().unwrap();
    assert!(message.contains("nearly full") && message.contains(" MB are left"), "{message}");
    assert_eq!(outcome["recording"], json!(true));
    // A part of the drive must be recorded before the disk is full.
    let recorded = place.path("disk/out/trajectory.csv.part");
    while !std::fs::read_to_string(&recorded).is_ok_and(|table| table.lines().count() > 20) {
        outcome = status(&live);
    }
    disk.fill();
    while outcome["recording"] == json!(true) {
        outcome = status(&live);
    }
    let message = outcome["message"].as_str().unwrap();
    assert!(message.contains("No space left on device") && message.contains("tracking goes on"), "{message}");
    let captured = outcome["captured"].as_u64().unwrap();
    while outcome["captured"].as_u64().unwrap() < captured + 40 {
        outcome = status(&live);
    }
    live.end();
    // The frames recorded before are in the table, line by line; all of them, if closing the map
    // frees enough space.
    let written = ["disk/out/trajectory.csv", "disk/out/trajectory.csv.part"];
    let name = written.into_iter().find(|name| place.path(name).exists()).unwrap();
    let table = String::from_utf8(place.read(name)).unwrap();
    let columns = |line: &str| line.split(',').count();
    let whole = table.lines().filter(|line| columns(line) == columns(table.lines().next().unwrap())).count();
    assert!(whole > 10 && whole + 1 >= table.lines().count(), "{whole}");
}

/// Tracks a drive of four seconds with one output on a disk that is too small for it, which fails
/// the run and costs no trajectory. Returns what the program said; `None` where no disk can
/// be mounted.
fn tracked_onto_a_small_disk(subcommand: &str, option: &str, file: &str) -> Option<String> {
    let place = LiveFolder::new();
    write_uncompressed(&place.path("drive.y4m"));
    std::fs::create_dir(place.path("disk")).unwrap();
    let _disk = match SmallDisk::mount(&place.path("disk"), 300 << 10) {
        Ok(disk) => disk,
        Err(why) => {
            println!("skipped: mount: {why}");
            return None;
        }
    };
    let done =
        place.command(subcommand, &format!("drive.y4m {option} {file} -o out --quiet")).output().unwrap();
    let outcome = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(3), "{outcome}");
    assert!(outcome.contains(file), "{outcome}");
    let table = String::from_utf8(place.read("out/trajectory.csv")).unwrap();
    assert_eq!(json!(table.lines().count() - 1), statistics(&place.path("out"))["frames"]);
    // All 121 frames.
    assert!(table.lines().count() > 120 && place.path("out/report.html").is_file(), "{table}");
    // Nothing half-written has the name that was asked for; what there was is beside it.
    if option == "--mcap" {
        assert!(!place.path(file).exists() && place.path(&format!("{file}.part")).exists());
    }
    Some(outcome)
}

#[test]
fn a_log_too_large_for_its_disk_fails_the_run_and_costs_no_trajectory() {
    let Some(outcome) = tracked_onto_a_small_disk("live", "--mcap", "disk/log.mcap") else { return };
    let errors: Vec<&str> = outcome.lines().filter(|line| line.starts_with("error: ")).collect();
    assert!(errors.len() == 1 && errors[0].contains("disk/log.mcap"), "{outcome}");
    assert!(errors[0].contains("No space left on device"), "{outcome}");
}

#[test]
fn a_map_too_large_for_its_disk_costs_no_trajectory() {
    tracked_onto_a_small_disk("run", "--map", "disk/map.gpkg");
}
