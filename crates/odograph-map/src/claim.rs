//! One writer per map: the claim that a program holds for as long as it writes a map.

use crate::complaint::Complaint;
use odograph::error::{Error, Result};
use std::ffi::OsString;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Files that SQLite may leave beside a database.
const BESIDE: [&str; 3] = ["-wal", "-shm", "-journal"];

/// The right to write one map, which nobody else has while any clone of this lives.
///
/// It is a lock of the operating system on a file `.lock` beside the map, so that it ends with the
/// program, however that ends. The database itself cannot carry it: closing a second descriptor of
/// it would drop SQLite's own locks.
#[derive(Debug, Clone)]
pub struct MapClaim(Arc<Held>);

#[derive(Debug)]
struct Held {
    map: PathBuf,
    lock: PathBuf,
    /// Open for as long as the lock is held.
    _file: File,
}

impl MapClaim {
    /// Claims a map that is there, or a name under which one is to be made. Fails at once where
    /// another program, or another part of this one, writes it.
    pub fn on(map: &Path) -> Result<Self> {
        let lock = with_ending(&resolved(map), ".lock");
        let cannot =
            |error: std::io::Error| Error::output(format!("{} cannot be written: {error}", lock.display()));
        loop {
            let mut file = OpenOptions::new()
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .open(&lock)
                .map_err(cannot)?;
            match file.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => return Err(taken(map, &mut file)),
                // A file system without locks has no better protection to offer.
                Err(TryLockError::Error(error)) if error.kind() == ErrorKind::Unsupported => {}
                Err(TryLockError::Error(error)) => return Err(cannot(error)),
            }
            // The holder before may have removed the file after it was opened here: that lock is on
            // nothing.
            if is_at(&file, &lock) {
                // Who holds it is a courtesy; a disk that is full does not stop the claim.
                let _ = file.set_len(0).and_then(|()| writeln!(file, "{}", std::process::id()));
                return Ok(Self(Arc::new(Held { map: map.to_owned(), lock, _file: file })));
            }
        }
    }

    /// The map that is claimed.
    pub fn path(&self) -> &Path {
        &self.0.map
    }

    /// Whether the claim is on this map, by whatever name.
    pub fn is_on(&self, map: &Path) -> bool {
        with_ending(&resolved(map), ".lock") == self.0.lock
    }

    /// Removes the map with what SQLite left beside it. No map is no failure.
    pub fn remove_map(&self) -> Result<()> {
        remove(&self.0.map)
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        // Removed while it is still locked, so that no other claim can be on it. Where a file
        // cannot be told from its successor under the same name, it stays.
        if cfg!(unix) {
            let _ = std::fs::remove_file(&self.lock);
        }
    }
}

pub(crate) fn remove(map: &Path) -> Result<()> {
    for name in std::iter::once(map.to_owned()).chain(BESIDE.map(|ending| with_ending(map, ending))) {
        match std::fs::remove_file(&name) {
            Err(error) if error.kind() != ErrorKind::NotFound => {
                return Err(Error::output(format!("{} cannot be removed: {error}", name.display())));
            }
            _ => {}
        }
    }
    Ok(())
}

/// Whether there is anything of a map to remove.
pub(crate) fn leaves_anything(map: &Path) -> bool {
    let is_there = |path: &Path| path.symlink_metadata().is_ok();
    is_there(map) || BESIDE.iter().any(|ending| is_there(&with_ending(map, ending)))
}

fn taken(map: &Path, lock: &mut File) -> Error {
    let mut holder = String::new();
    let _ = lock.take(20).read_to_string(&mut holder);
    let holder = match holder.trim().parse::<u32>() {
        Ok(process) => format!("another program (process {process})"),
        Err(_) => "another program".to_owned(),
    };
    Complaint::about(map)
        .input(format!("the map is being written by {holder}; wait until that has ended, or use another map"))
}

/// One name for a map that has several: links are followed, of a map that is not there as far as
/// its folder.
fn resolved(map: &Path) -> PathBuf {
    map.canonicalize().unwrap_or_else(|_| {
        let folder = map.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        match (folder.canonicalize(), map.file_name()) {
            (Ok(folder), Some(name)) => folder.join(name),
            _ => map.to_owned(),
        }
    })
}

fn with_ending(path: &Path, ending: &str) -> PathBuf {
    let mut name: OsString = path.as_os_str().to_owned();
    name.push(ending);
    name.into()
}

#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let place = |metadata: std::fs::Metadata| (metadata.dev(), metadata.ino());
    let (here, there) = (file.metadata().map(place), path.metadata().map(place));
    matches!((here, there), (Ok(here), Ok(there)) if here == there)
}

#[cfg(not(unix))]
fn is_at(_: &File, _: &Path) -> bool {
    true
}
