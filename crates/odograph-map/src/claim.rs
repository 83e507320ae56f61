//! Exclusive write access to a map: a lock file that is held as long as a program writes the map.

use crate::complaint::Complaint;
use odograph::error::{Error, Result};
use std::error::Error as _;
use std::ffi::OsString;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Suffixes of the files that SQLite may leave beside a database.
const BESIDE: [&str; 3] = ["-wal", "-shm", "-journal"];

/// Exclusive write access to a map, as long as any clone exists.
///
/// It is an operating system lock on a file `.lock` beside the map, so it ends with the process,
/// however that ends. The lock cannot be on the database itself: closing a second file descriptor
/// of the database would release SQLite's own locks.
#[derive(Debug, Clone)]
pub struct MapClaim(Arc<Held>);

#[derive(Debug)]
struct Held {
    map: PathBuf,
    lock: PathBuf,
    /// Kept open to hold the lock.
    _file: File,
}

impl MapClaim {
    /// Acquires write access to an existing map or to the path of a new one. Does not block: fails
    /// if another process, or another part of this one, has it.
    pub fn on(map: &Path) -> Result<Self> {
        if map.symlink_metadata().is_ok_and(|metadata| metadata.is_symlink()) && !map.exists() {
            let what = "is a link that leads nowhere; remove it, or name another map";
            return Err(Error::input(format!("{} {what}", map.display())));
        }
        let lock = with_ending(&resolved(map), ".lock");
        let cannot = |error| Error::not_written(map.display(), error);
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
                // A file system without locks offers no better protection.
                Err(TryLockError::Error(error)) if error.kind() == ErrorKind::Unsupported => {}
                Err(TryLockError::Error(error)) => return Err(cannot(error)),
            }
            // The previous holder may have removed the file after it was opened here; then the lock
            // is on a deleted file.
            if is_at(&file, &lock) {
                // The process id is only for information; failing to write it (disk full) is
                // ignored.
                let _ = file.set_len(0).and_then(|()| writeln!(file, "{}", std::process::id()));
                return Ok(Self(Arc::new(Held { map: map.to_owned(), lock, _file: file })));
            }
        }
    }

    /// Keeps others from writing a map while it is read. `None` where nobody may write beside it,
    /// as on a read-only medium: then no program can write the map.
    pub fn while_reading(map: &Path) -> Result<Option<Self>> {
        let is_unwritable = |error: &Error| {
            let cause = error.source().and_then(|cause| cause.downcast_ref::<std::io::Error>());
            let kind = cause.map(std::io::Error::kind);
            matches!(kind, Some(ErrorKind::ReadOnlyFilesystem | ErrorKind::PermissionDenied))
        };
        match Self::on(map) {
            Err(error) if is_unwritable(&error) && !Self::is_held(map) => Ok(None),
            claim => claim.map(Some),
        }
    }

    /// Whether another program, or another part of this one, writes the map. Leaves nothing beside
    /// it.
    pub fn is_held(map: &Path) -> bool {
        let lock = File::open(with_ending(&resolved(map), ".lock"));
        lock.is_ok_and(|lock| matches!(lock.try_lock_shared(), Err(TryLockError::WouldBlock)))
    }

    /// Path of the map.
    pub fn path(&self) -> &Path {
        &self.0.map
    }

    /// Whether the lock is on this map, under any of its names.
    pub fn is_on(&self, map: &Path) -> bool {
        with_ending(&resolved(map), ".lock") == self.0.lock
    }

    /// Removes the map with SQLite's files beside it. Succeeds if there is no map.
    pub fn remove_map(&self) -> Result<()> {
        remove_files(std::iter::once(self.0.map.clone()).chain(files_beside(&self.0.map)))
    }

    /// Removes SQLite's files beside the map.
    pub(crate) fn remove_beside(&self) -> Result<()> {
        remove_files(files_beside(&self.0.map))
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        // Removed while still locked, so that no other process can hold it. Kept on systems where a
        // file cannot be distinguished from its successor of the same name.
        if cfg!(unix) {
            let _ = std::fs::remove_file(&self.lock);
        }
    }
}

fn files_beside(map: &Path) -> impl Iterator<Item = PathBuf> {
    BESIDE.into_iter().map(|ending| with_ending(map, ending))
}

fn remove_files(names: impl Iterator<Item = PathBuf>) -> Result<()> {
    for name in names {
        match std::fs::remove_file(&name) {
            Err(error) if error.kind() != ErrorKind::NotFound => {
                return Err(Error::output(format!("{} cannot be removed: {error}", name.display())));
            }
            _ => {}
        }
    }
    Ok(())
}

/// Whether there is any file of a map to remove.
pub(crate) fn leaves_anything(map: &Path) -> bool {
    let is_there = |path: &Path| path.symlink_metadata().is_ok();
    is_there(map) || files_beside(map).any(|name| is_there(&name))
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

/// Canonical path of a map: resolves links; if the map does not exist, those of its folder.
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
