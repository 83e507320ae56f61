//! A run as an MCAP file, written beside tracking.

use odograph::error::{Error, Result};
use odograph::pose_frame::PoseFrame;
use odograph::trajectory::FrameEstimate;
use odograph_live::McapFile;
use odograph_live::capture::{Newest, Policy, Taken};
use odograph_live::foxglove::Picture;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// Frames that wait to be written: a disk may pause for two seconds.
const QUEUE: usize = 64;
/// A picture every so often, seconds of the recording: each takes some 50 kB, so ten a second are 2
/// GB an hour.
const PICTURE_EVERY_S: f64 = 0.1;

/// The file of a run, if one was asked for.
pub struct McapLog {
    path: PathBuf,
    file: Mutex<Option<McapFile>>,
    queue: Newest<Entry>,
    next_picture_s: Mutex<Option<f64>>,
    failure: Mutex<Option<String>>,
}

struct Entry {
    frame: FrameEstimate,
    latency_ms: f64,
    picture: Option<Picture>,
}

impl McapLog {
    /// A file at `path` with the path of `of`, of a run over a source that is described in words.
    pub fn new(path: &Path, source: &str, of: PoseFrame, policy: Policy) -> Result<Self> {
        let file = McapFile::create(path, source, of).map_err(|error| Error::usage(error.to_string()))?;
        Ok(Self {
            path: path.to_owned(),
            file: Mutex::new(Some(file)),
            queue: Newest::new(policy, QUEUE),
            next_picture_s: Mutex::new(None),
            failure: Mutex::new(None),
        })
    }

    /// Whether a file may be written there; told before anything else is
    /// begun.
    pub fn check(path: &Path, force: bool) -> Result<()> {
        if path.exists() && !force {
            return Err(Error::usage(format!(
                "{} is already there; choose another name, or --force to overwrite it",
                path.display()
            )));
        }
        Ok(())
    }

    /// Takes a frame without waiting longer than the run's policy allows; `picture` is asked only
    /// where one is due.
    pub fn give(&self, frame: &FrameEstimate, latency_ms: f64, picture: impl FnOnce() -> Picture) {
        let mut next_s = self.next_picture_s.lock().unwrap_or_else(PoisonError::into_inner);
        // Frames do not come evenly: one that is nearly due is due.
        let due = next_s.is_none_or(|next_s| frame.time_s >= next_s - 0.2 * PICTURE_EVERY_S);
        if due {
            *next_s = Some(
                next_s.map_or(frame.time_s, |next_s| next_s.max(frame.time_s - PICTURE_EVERY_S))
                    + PICTURE_EVERY_S,
            );
        }
        drop(next_s);
        let picture = due.then(picture);
        self.queue.give(Entry { frame: frame.clone(), latency_ms, picture });
    }

    /// No more frames will come.
    pub fn close(&self) {
        self.queue.close();
    }

    /// Writes what comes until no more does, then ends the file. Where the disk is full it stops,
    /// and tracking goes on.
    pub fn write_all(&self) {
        let Some(mut file) = self.file.lock().unwrap_or_else(PoisonError::into_inner).take() else { return };
        loop {
            match self.queue.take(Duration::from_secs(1)) {
                Taken::Item(Entry { frame, latency_ms, picture }) => {
                    if let Err(error) = file.add(&frame, latency_ms, picture.as_ref()) {
                        self.fail(&error);
                        // Who gives is not kept waiting for who has stopped.
                        self.queue.close();
                        return;
                    }
                }
                Taken::Nothing => {}
                Taken::End => break,
            }
        }
        let empty = file.frames() == 0;
        if let Err(error) = file.finish() {
            self.fail(&error);
        }
        if empty {
            let _ = std::fs::remove_file(&self.path);
        }
    }

    fn fail(&self, error: &Error) {
        let told = format!("{error}; tracking goes on without it");
        *self.failure.lock().unwrap_or_else(PoisonError::into_inner) = Some(told);
    }

    /// What a person should know of it.
    pub fn message(&self) -> Option<String> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// What a person should know of it when all is over.
    pub fn warnings(&self) -> Vec<String> {
        let dropped = match self.queue.counts().1 {
            0 => None,
            dropped => Some(format!(
                "{dropped} frames are not in {}: it could not be written fast enough",
                self.path.display()
            )),
        };
        self.message().into_iter().chain(dropped).collect()
    }
}
