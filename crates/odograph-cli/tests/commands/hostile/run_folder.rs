//! A temporary folder in which `odograph run` is tried.

use super::recording::{CAMERA, names};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use tempfile::TempDir;

/// All output files of a complete run.
pub const FILES: [&str; 14] = [
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
pub struct HostileFolder {
    temporary: TempDir,
}

impl HostileFolder {
    pub fn new() -> Self {
        let temporary = tempfile::tempdir().unwrap();
        fs::write(temporary.path().join("camera.yaml"), CAMERA).unwrap();
        Self { temporary }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.temporary.path().join(name)
    }

    /// Runs `odograph run` in this folder, with these arguments only.
    pub fn run(&self, arguments: &str) -> Output {
        self.command(arguments).output().unwrap()
    }

    pub fn command(&self, arguments: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
        command.current_dir(self.temporary.path()).env("ODOGRAPH_FFMPEG", "");
        command.arg("run").args(arguments.split_whitespace()).stdin(Stdio::null());
        command
    }

    /// [`HostileFolder::run`] with the camera, a height and the output folder `out`.
    pub fn run_usual(&self, source: &str) -> Output {
        self.run(&format!("{source} --camera camera.yaml --height 1.0 -o out"))
    }

    /// Asserts that a run is refused with `code` and one sentence that contains `words`, and leaves
    /// no files.
    pub fn refused(&self, arguments: &str, code: i32, words: &str) {
        let before = names(self.temporary.path());
        let done = self.run(arguments);
        assert_refused(&done, code, words, arguments);
        assert_eq!(names(self.temporary.path()), before, "`{arguments}` left something behind");
    }

    pub fn refused_usual(&self, source: &str, code: i32, words: &str) {
        self.refused(&format!("{source} --camera camera.yaml --height 1.0 -o out"), code, words);
    }

    /// The content of a result file.
    pub fn result(&self, folder: &str, name: &str) -> Vec<u8> {
        fs::read(self.path(folder).join(name)).unwrap()
    }
}

/// Asserts that standard error is one sentence and not the message of a panic.
pub fn assert_refused(done: &Output, code: i32, words: &str, what: &str) {
    let message = String::from_utf8(done.stderr.clone()).unwrap();
    assert_eq!(done.status.code(), Some(code), "`{what}` printed: {message}");
    assert!(
        !message.contains("panicked") && !message.contains("RUST_BACKTRACE"),
        "`{what}` printed: {message}"
    );
    assert!(message.contains(words), "`{what}` did not print \"{words}\" but: {message}");
    assert_eq!(message.lines().count(), 1, "`{what}` printed: {message}");
    assert!(done.stdout.is_empty(), "`{what}` printed {:?}", String::from_utf8_lossy(&done.stdout));
}

/// Asserts that the folder contains exactly the results, and no partial files.
pub fn assert_whole(folder: &Path) {
    assert_eq!(names(folder), FILES, "in {}", folder.display());
}

/// A small file system mounted for a test, which is unmounted when this is dropped.
#[cfg(target_os = "linux")]
pub struct Mounted(PathBuf);

#[cfg(target_os = "linux")]
impl Mounted {
    /// Makes the folder `at` and mounts one there; `None` where that is not allowed.
    pub fn new(at: &Path, options: &str) -> Option<Self> {
        fs::create_dir(at).unwrap();
        let mut mount = Command::new("mount");
        let done = mount.args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(at).stderr(Stdio::null()).status();
        if done.is_ok_and(|status| status.success()) {
            return Some(Self(at.to_owned()));
        }
        println!("skipped: mount: a small file system cannot be mounted here");
        None
    }

    /// Nothing can be written into it from now on.
    pub fn make_read_only(&self) {
        let done = Command::new("mount").args(["-o", "remount,ro"]).arg(&self.0).status().unwrap();
        assert!(done.success());
    }
}

#[cfg(target_os = "linux")]
impl Drop for Mounted {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(&self.0).status();
    }
}
