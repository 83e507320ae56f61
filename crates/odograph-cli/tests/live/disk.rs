//! A disk that is soon full.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A file system in memory, of a size, over a folder; taken away with this value.
pub struct SmallDisk {
    path: PathBuf,
}

impl SmallDisk {
    /// Says why where none can be had: mounting is for root, and not everywhere for him.
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
