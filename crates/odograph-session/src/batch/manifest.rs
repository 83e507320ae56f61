//! What has been run: a file for each attempt at a recording, which is also the claim on it.
//!
//! The attempts at a recording are numbered. An attempt begins when its file is created, which only
//! one worker can do, and ends when that file is replaced by one that says how. Whoever takes over
//! from a worker that was killed creates the next one. No file is removed, so that no claim can be
//! mistaken for an earlier one; and nothing but the creation of files has to be atomic.

use super::hash;
use super::inputs::Inputs;
use crate::files;
use crate::outcome::{RunEnd, RunOutcome};
use odograph::error::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use tempfile::NamedTempFile;

/// One attempt at a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Attempt {
    /// Name of the results.
    pub name: String,
    /// The recording as it was given.
    pub source: String,
    /// From 1.
    pub number: u32,
    /// The worker.
    pub worker: String,
    /// What determines its results.
    pub inputs: Inputs,
    /// How it ended; `None` while it goes on, and forever where its worker was killed.
    pub ended: Option<Ended>,
}

/// How an attempt ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ended {
    /// How, in a word.
    pub how: RunStatus,
    /// Why it failed.
    pub error: Option<String>,
    /// The statistics of the run, as in `stats.json`; `None` if it failed.
    pub statistics: Option<Value>,
}

/// How an attempt ended, in a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RunStatus {
    /// Completed.
    Done,
    /// Completed; most frames have no pose.
    TrackingFailed,
    /// Asked to end early.
    Interrupted,
    /// The recording could not be read, or results not be written.
    Failed,
    /// An option is wrong: another attempt fails as well.
    Refused,
}

impl RunStatus {
    /// The word for it.
    pub fn word(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::TrackingFailed => "tracking-failed",
            Self::Interrupted => "interrupted",
            Self::Failed => "failed",
            Self::Refused => "refused",
        }
    }

    /// Whether the recording was run to its end.
    pub fn is_complete(self) -> bool {
        matches!(self, Self::Done | Self::TrackingFailed)
    }

    /// Whether there is an error.
    pub fn is_failure(self) -> bool {
        matches!(self, Self::Failed | Self::Refused)
    }
}

impl Ended {
    pub(super) fn of(result: &Result<RunOutcome>) -> Self {
        match result {
            Ok(outcome) => Self {
                how: match outcome.end {
                    RunEnd::Completed => RunStatus::Done,
                    RunEnd::TrackingFailed => RunStatus::TrackingFailed,
                    RunEnd::Interrupted => RunStatus::Interrupted,
                },
                error: None,
                statistics: serde_json::to_value(&outcome.statistics).ok(),
            },
            Err(error) => Self::failed(error),
        }
    }

    /// The error, if it failed.
    pub fn to_error(&self) -> Option<Error> {
        let kind = if self.how == RunStatus::Refused { ErrorKind::Usage } else { ErrorKind::Input };
        self.how.is_failure().then(|| Error::new(kind, self.error.clone().unwrap_or_default()))
    }

    pub(super) fn failed(error: &Error) -> Self {
        let how = if error.kind() == ErrorKind::Usage { RunStatus::Refused } else { RunStatus::Failed };
        Self { how, error: Some(error.to_string()), statistics: None }
    }
}

/// The attempts at all recordings.
#[derive(Debug)]
pub(super) struct Manifest {
    folder: PathBuf,
    /// Attempts that have ended, by the names of their files: these do not change any more.
    ended: Mutex<BTreeMap<String, Arc<Attempt>>>,
}

impl Manifest {
    /// The manifest in a folder, which is made.
    pub fn in_folder(folder: PathBuf) -> Result<Self> {
        files::make_folder(&folder)?;
        Ok(Self { folder, ended: Mutex::default() })
    }

    /// The attempts at a recording, in order.
    pub fn of(&self, name: &str) -> Vec<Arc<Attempt>> {
        (1..).map_while(|number| self.read(&file_name(name, number), || unreadable(name, number))).collect()
    }

    /// The number of attempts and the last one, of each recording in the order of their names.
    pub fn last(&self) -> Result<BTreeMap<String, Arc<Attempt>>> {
        let entries = fs::read_dir(&self.folder).map_err(|error| {
            Error::input(format!("{} cannot be read: {error}", self.folder.display())).caused_by(error)
        })?;
        let mut last: BTreeMap<String, Arc<Attempt>> = BTreeMap::new();
        for file in entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned()) {
            if let Some(attempt) = self.read(&file, || unreadable("", 0)).filter(|attempt| attempt.number > 0)
            {
                let known = last.get(&attempt.name).map_or(0, |known| known.number);
                if attempt.number > known {
                    last.insert(attempt.name.clone(), attempt);
                }
            }
        }
        Ok(last)
    }

    /// Begins an attempt; `false` if another worker has begun it.
    pub fn begin(&self, attempt: &Attempt) -> Result<bool> {
        let path = self.path(attempt);
        match written(&self.folder, &json(attempt)?)
            .and_then(|file| file.persist_noclobber(&path).map_err(|failed| failed.error))
        {
            Ok(_) => Ok(true),
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => Ok(false),
            Err(error) => Err(Error::not_written(path.display(), error)),
        }
    }

    /// Records how an attempt ended.
    pub fn end(&self, attempt: &Attempt) -> Result<()> {
        replace(&self.path(attempt), &json(attempt)?)
    }

    /// Whether another worker has taken over from an attempt.
    pub fn is_taken_over(&self, attempt: &Attempt) -> bool {
        self.folder.join(file_name(&attempt.name, attempt.number + 1)).exists()
    }

    fn path(&self, attempt: &Attempt) -> PathBuf {
        self.folder.join(file_name(&attempt.name, attempt.number))
    }

    /// The attempt in a file; `None` if the file does not exist or does not belong to the manifest.
    fn read(&self, file: &str, unreadable: impl FnOnce() -> Attempt) -> Option<Arc<Attempt>> {
        let mut ended = self.ended.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(attempt) = ended.get(file) {
            return Some(attempt.clone());
        }
        if !file.ends_with(".json") {
            return None;
        }
        let bytes = fs::read(self.folder.join(file)).ok()?;
        let attempt = Arc::new(serde_json::from_slice(&bytes).unwrap_or_else(|_| unreadable()));
        if attempt.ended.is_some() {
            ended.insert(file.to_owned(), attempt.clone());
        }
        Some(attempt)
    }
}

/// The name of an attempt's file: a hash, because names may have any length.
fn file_name(name: &str, number: u32) -> String {
    format!("{}-{number}.json", &hash::of_bytes(name.as_bytes())[..32])
}

/// An attempt whose file is damaged, for example by a power failure: no worker has it.
fn unreadable(name: &str, number: u32) -> Attempt {
    let (name, source, worker) = (name.to_owned(), String::new(), String::new());
    Attempt { name, source, number, worker, inputs: Inputs::default(), ended: None }
}

fn json(attempt: &Attempt) -> Result<Vec<u8>> {
    serde_json::to_vec_pretty(attempt).map_err(|error| {
        Error::output(format!("the statistics cannot be written as JSON: {error}")).caused_by(error)
    })
}

/// Replaces a file that several workers write.
pub(super) fn replace(path: &Path, bytes: &[u8]) -> Result<()> {
    written(path.parent().unwrap_or(Path::new("")), bytes)
        .and_then(|file| file.persist(path).map_err(|failed| failed.error))
        .map_err(|error| Error::not_written(path.display(), error))?;
    Ok(())
}

/// A file of a name of its own with these bytes, which are on disk.
fn written(folder: &Path, bytes: &[u8]) -> std::io::Result<NamedTempFile> {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let mut file = new_file(folder, ".new-")?;
    file.write_all(bytes)?;
    file.as_file().sync_data()?;
    Ok(file)
}

/// A new file of a name of its own, with the usual permissions.
pub(super) fn new_file(folder: &Path, beginning: &str) -> std::io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(beginning);
    #[cfg(unix)]
    let mode = <fs::Permissions as std::os::unix::fs::PermissionsExt>::from_mode(0o666);
    #[cfg(unix)]
    builder.permissions(mode);
    builder.tempfile_in(folder)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test fails by panicking
mod tests {
    use super::*;

    #[test]
    fn an_attempt_is_begun_by_one_worker() {
        let place = tempfile::tempdir().unwrap();
        let manifest = || Manifest::in_folder(place.path().to_owned()).unwrap();
        let attempt = |worker: usize| Attempt { worker: worker.to_string(), ..unreadable("hall/one", 1) };
        let begun: Vec<bool> = std::thread::scope(|scope| {
            let begin = |worker| scope.spawn(move || manifest().begin(&attempt(worker)).unwrap());
            let all: Vec<_> = (0..16).map(begin).collect();
            all.into_iter().map(|one| one.join().unwrap()).collect()
        });
        let winner = begun.iter().position(|&begun| begun).unwrap();
        assert_eq!(begun.iter().filter(|&&begun| begun).count(), 1);
        assert_eq!(*manifest().of("hall/one")[0], attempt(winner));
    }

    #[test]
    fn the_last_attempt_counts() {
        let place = tempfile::tempdir().unwrap();
        let (manifest, other) = (
            Manifest::in_folder(place.path().to_owned()).unwrap(),
            Manifest::in_folder(place.path().to_owned()).unwrap(),
        );
        let first = unreadable("one", 1);
        assert!(manifest.begin(&first).unwrap() && manifest.of("one")[0].ended.is_none());
        let ended = Some(Ended::failed(&Error::input("damaged")));
        other.end(&Attempt { ended: ended.clone(), ..first.clone() }).unwrap();
        assert!(!manifest.is_taken_over(&first));
        assert!(other.begin(&Attempt { number: 2, ..first.clone() }).unwrap());
        assert!(manifest.is_taken_over(&first));
        let numbers: Vec<u32> = manifest.of("one").iter().map(|attempt| attempt.number).collect();
        assert_eq!(numbers, [1, 2]);
        assert_eq!((manifest.of("one")[0].ended.clone(), manifest.last().unwrap()["one"].number), (ended, 2));
        // No worker has a damaged one.
        fs::write(place.path().join(file_name("one", 3)), "").unwrap();
        assert_eq!(*manifest.of("one")[2], unreadable("one", 3));
    }
}
