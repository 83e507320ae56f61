//! Recording of a run as an MCAP file, concurrent with tracking.

use crate::files;
use odograph::error::{Error, Result};
use odograph::pose_frame::PoseFrame;
use odograph::trajectory::FrameEstimate;
use odograph_live::McapFile;
use odograph_live::capture::{Newest, Policy, Taken};
use odograph_live::foxglove::TrackedImage;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// Length of the queue: a disk may pause for two seconds.
const QUEUE: usize = 64;
/// Interval of images, seconds of the recording: each takes about 50 kB, so ten a second are 2 GB
/// an hour.
const PICTURE_EVERY_S: f64 = 0.1;

/// The file of a run, if requested.
pub struct McapLog {
    path: PathBuf,
    /// Where it grows until it is complete.
    growing: PathBuf,
    file: Mutex<Option<McapFile>>,
    queue: Newest<Entry>,
    next_picture_s: Mutex<Option<f64>>,
    failure: Mutex<Option<Error>>,
}

struct Entry {
    frame: FrameEstimate,
    of: PoseFrame,
    latency_ms: f64,
    picture: Option<TrackedImage>,
}

impl McapLog {
    /// A file at `path`, for a run over a source with this description.
    pub fn new(path: &Path, source: &str, policy: Policy) -> Result<Self> {
        let growing = files::beside(path);
        let file = McapFile::create(&growing, source).inspect_err(|_| {
            let _ = fs::remove_file(&growing);
        })?;
        Ok(Self {
            path: path.to_owned(),
            growing,
            file: Mutex::new(Some(file)),
            queue: Newest::new(policy, QUEUE),
            next_picture_s: Mutex::new(None),
            failure: Mutex::new(None),
        })
    }

    /// Whether a file may be written there; checked before anything else. `results` is the folder
    /// of the results.
    pub fn check(path: &Path, results: Option<&Path>, force: bool) -> Result<()> {
        files::check_output(path, results, force)
    }

    /// Adds a frame of the path of `of` without waiting longer than the run's policy allows;
    /// `picture` is only called where an image is due.
    pub fn give(
        &self,
        frame: &FrameEstimate,
        of: &PoseFrame,
        latency_ms: f64,
        picture: impl FnOnce() -> TrackedImage,
    ) {
        let mut next_s = self.next_picture_s.lock().unwrap_or_else(PoisonError::into_inner);
        // Frame times jitter: a frame that is nearly due is taken.
        let due = next_s.is_none_or(|next_s| frame.time_s >= next_s - 0.2 * PICTURE_EVERY_S);
        if due {
            *next_s = Some(
                next_s.map_or(frame.time_s, |next_s| next_s.max(frame.time_s - PICTURE_EVERY_S))
                    + PICTURE_EVERY_S,
            );
        }
        drop(next_s);
        let picture = due.then(picture);
        self.queue.give(Entry { frame: frame.clone(), of: *of, latency_ms, picture });
    }

    /// Ends the input.
    pub fn close(&self) {
        self.queue.close();
    }

    /// Writes all input, then finishes the file and gives it its name. On a full disk it stops,
    /// what there is keeps the name of a growing file, and tracking continues.
    pub fn write_all(&self) {
        let Some(mut file) = self.file.lock().unwrap_or_else(PoisonError::into_inner).take() else { return };
        loop {
            match self.queue.take(Duration::from_secs(1)) {
                Taken::Item(Entry { frame, of, latency_ms, picture }) => {
                    if let Err(error) = file.add(&frame, &of, latency_ms, picture.as_ref()) {
                        self.fail(error);
                        // The sender must not wait for a stopped writer.
                        self.queue.close();
                        return;
                    }
                }
                Taken::Nothing => {}
                Taken::End => break,
            }
        }
        if file.frames() == 0 {
            drop(file);
            let _ = fs::remove_file(&self.growing);
            return;
        }
        let named = || {
            let renamed = fs::rename(&self.growing, &self.path);
            renamed.map_err(|error| Error::not_written(self.path.display(), error))
        };
        if let Err(error) = file.finish().and_then(|()| named()) {
            self.fail(error);
        }
    }

    fn fail(&self, error: Error) {
        *self.failure.lock().unwrap_or_else(PoisonError::into_inner) = Some(error);
    }

    /// Why the file is not complete. It is taken at the end of the run, which then fails with it.
    pub fn take_failure(&self) -> Option<Error> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Warning.
    pub fn message(&self) -> Option<String> {
        let failure = self.failure.lock().unwrap_or_else(PoisonError::into_inner);
        failure.as_ref().map(|error| format!("{error}; tracking goes on without it"))
    }

    /// Warning at the end.
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
