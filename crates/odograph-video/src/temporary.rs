//! Folders for temporary files, which the next program removes if the one that made them was
//! killed.

use odograph::error::{Error, ErrorKind, Result};
use std::fs::{self, DirBuilder, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Names are this, the id of the process and a number.
const PREFIX: &str = "odograph-temporary-";
/// Folders that one process can have at the same time, with those of killed processes of its id.
const MAX_FOLDERS: u32 = 1000;

/// The folders of this process.
static MADE: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// A folder for temporary files in the one that `TMPDIR` names, removed with all that is in it when
/// this is dropped.
///
/// It is locked as long as its process lives, so that a folder without a lock was left by a killed
/// process. The id of the process would not do: another process may have it now, and in another
/// container it means nothing.
#[derive(Debug)]
pub struct TemporaryFolder {
    path: PathBuf,
    /// Kept open to hold the lock; `None` where folders cannot be locked.
    _lock: Option<File>,
}

impl TemporaryFolder {
    /// A new empty one, which only this user can read. Removes those that killed processes have
    /// left.
    ///
    /// # Errors
    /// If none can be made; the message says where, and how to choose another place.
    pub fn new() -> Result<Self> {
        Self::within(&std::env::temp_dir())
    }

    fn within(place: &Path) -> Result<Self> {
        remove_abandoned(place);
        let failed = |error: io::Error| {
            let shown = place.display();
            let remedy = match error.kind() {
                io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => remedy(place),
                _ => "set TMPDIR to a folder where you may write".to_owned(),
            };
            Error::output(format!(
                "a folder for temporary files cannot be made in {shown}: {error}; {remedy}"
            ))
            .caused_by(error)
        };
        for number in 0..MAX_FOLDERS {
            let path = place.join(format!("{PREFIX}{}-{number}", std::process::id()));
            match make(&path) {
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => continue,
                made => made.map_err(failed)?,
            }
            let lock = locked(&path);
            // Before it was locked, another program may have taken it for abandoned.
            if path.is_dir() {
                made().push(path.clone());
                return Ok(Self { path, _lock: lock });
            }
        }
        Err(failed(io::ErrorKind::AlreadyExists.into()))
    }

    /// The path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The same error, if it is of a file in this folder that could not be written, with what to do
    /// about it: the folder was not chosen by a person, and is gone when the error is read.
    #[must_use]
    pub fn explain(&self, error: Error) -> Error {
        let (sentence, _) = error.sentence_and_list();
        let (Some(place), true) = (self.path.parent(), error.kind() == ErrorKind::Output) else {
            return error;
        };
        if !sentence.contains(&*self.path.to_string_lossy()) {
            return error;
        }
        let what = sentence.rsplit_once("; ").map_or(sentence, |(what, _)| what);
        Error::output(format!("{what}; {}", remedy(place)))
    }

    /// Removes all folders of this process, before it ends without dropping them.
    pub fn remove_all() {
        made().drain(..).for_each(|path| drop(fs::remove_dir_all(path)));
    }
}

impl Drop for TemporaryFolder {
    fn drop(&mut self) {
        made().retain(|path| *path != self.path);
        // Removed while it is still locked, so that nobody else removes it.
        let _ = fs::remove_dir_all(&self.path);
    }
}

fn made() -> std::sync::MutexGuard<'static, Vec<PathBuf>> {
    MADE.lock().unwrap_or_else(PoisonError::into_inner)
}

fn remedy(place: &Path) -> String {
    format!("free some space in {}, or set TMPDIR to another folder", place.display())
}

fn make(path: &Path) -> io::Result<()> {
    #[cfg_attr(not(unix), allow(unused_mut))]
    let mut builder = DirBuilder::new();
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.create(path)
}

/// The lock of a new folder. Waits for a program that looks whether it is abandoned.
fn locked(path: &Path) -> Option<File> {
    let folder = File::open(path).ok()?;
    folder.lock().ok()?;
    Some(folder)
}

/// Removes the folders in `place` that no process has locked.
fn remove_abandoned(place: &Path) {
    let Ok(entries) = fs::read_dir(place) else { return };
    for entry in entries.flatten() {
        let is_folder = entry.file_type().is_ok_and(|kind| kind.is_dir());
        if !is_folder || !entry.file_name().to_str().is_some_and(is_name) {
            continue;
        }
        let path = entry.path();
        // Where folders cannot be locked, nothing is removed.
        let Ok(folder) = File::open(&path) else { continue };
        if folder.try_lock().is_ok() {
            let _ = fs::remove_dir_all(&path);
        }
    }
}

/// Whether a folder of this name is a temporary one.
fn is_name(name: &str) -> bool {
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let numbers = name.strip_prefix(PREFIX).and_then(|rest| rest.split_once('-'));
    numbers.is_some_and(|(process, number)| is_number(process) && is_number(number))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    fn names(place: &Path) -> Vec<String> {
        let names = fs::read_dir(place).unwrap().map(|entry| entry.unwrap().file_name());
        let mut names: Vec<String> = names.map(|name| name.into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_folder_and_its_files_are_removed() {
        let place = tempfile::tempdir().unwrap();
        let (first, second) =
            (TemporaryFolder::within(place.path()).unwrap(), TemporaryFolder::within(place.path()).unwrap());
        assert_eq!(names(place.path()).len(), 2);
        fs::write(first.path().join("map.gpkg"), "map").unwrap();
        drop(first);
        assert_eq!(names(place.path()), [second.path().file_name().unwrap().to_str().unwrap()]);
        drop(second);
        assert!(names(place.path()).is_empty());
    }

    #[test]
    #[cfg(unix)]
    fn only_abandoned_folders_of_this_name_are_removed() {
        let place = tempfile::tempdir().unwrap();
        let abandoned = place.path().join("odograph-temporary-4000000-0");
        fs::create_dir(&abandoned).unwrap();
        fs::write(abandoned.join("map.gpkg"), "map").unwrap();
        for name in ["odograph-temporary-7", "odograph-temporary-7-0a", "odograph-temporary-", "odograph-7-0"]
        {
            fs::create_dir(place.path().join(name)).unwrap();
        }
        fs::write(place.path().join("odograph-temporary-7-1"), "a file").unwrap();
        std::os::unix::fs::symlink("odograph-7-0", place.path().join("odograph-temporary-7-2")).unwrap();
        let before = names(place.path());
        let living = TemporaryFolder::within(place.path()).unwrap();
        drop(TemporaryFolder::within(place.path()).unwrap());
        assert!(living.path().is_dir());
        drop(living);
        assert!(!abandoned.exists());
        assert_eq!(
            names(place.path()),
            before[..].iter().filter(|name| !name.contains("4000000")).cloned().collect::<Vec<_>>()
        );
    }

    #[test]
    fn errors_name_the_place_and_what_to_do() {
        let place = tempfile::tempdir().unwrap();
        let missing = place.path().join("missing");
        let shown = missing.display();
        let error = TemporaryFolder::within(&missing).unwrap_err().to_string();
        assert!(
            error.starts_with(&format!("a folder for temporary files cannot be made in {shown}: ")),
            "{error}"
        );
        assert!(error.ends_with("; set TMPDIR to a folder where you may write"), "{error}");

        let folder = TemporaryFolder::within(place.path()).unwrap();
        let map = folder.path().join("map.svg");
        let full =
            folder.explain(Error::not_written(map.display(), io::ErrorKind::StorageFull.into())).to_string();
        assert!(full.starts_with(&format!("{} cannot be written: ", map.display())), "{full}");
        let end = format!("; free some space in {}, or set TMPDIR to another folder", place.path().display());
        assert!(full.ends_with(&end) && full.matches("; ").count() == 1, "{full}");
        for other in
            [Error::output("drive.mcap cannot be written; choose"), Error::input(map.display().to_string())]
        {
            let sentence = other.to_string();
            assert_eq!(folder.explain(other).to_string(), sentence);
        }
    }
}
