//! Recording of a run as an MCAP file, concurrent with tracking.

use crate::files;
use odograph::error::{Error, Result};
use odograph::pose_frame::PoseFrame;
use odograph::trajectory::FrameEstimate;
use odograph_live::McapFile;
use odograph_live::capture::{Newest, Policy, Taken};
use odograph_live::foxglove::TrackedImage;
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
    file: Mutex<Option<McapFile>>,
    queue: Newest<Entry>,
    next_picture_s: Mutex<Option<f64>>,
    failure: Mutex<Option<String>>,
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
        let file = McapFile::create(path, source)?;
        Ok(Self {
            path: path.to_owned(),
            file: Mutex::new(Some(file)),
            queue: Newest::new(policy, QUEUE),
            next_picture_s: Mutex::new(None),
            failure: Mutex::new(None),
        })
    }

    /// Whether a file may be written there; checked before anything else.
    pub fn check(path: &Path, force: bool) -> Result<()> {
        files::check_output(path, force)
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

    /// Writes all input, then finishes the file. On a full disk it stops, and tracking continues.
    pub fn write_all(&self) {
        let Some(mut file) = self.file.lock().unwrap_or_else(PoisonError::into_inner).take() else { return };
        loop {
            match self.queue.take(Duration::from_secs(1)) {
                Taken::Item(Entry { frame, of, latency_ms, picture }) => {
                    if let Err(error) = file.add(&frame, &of, latency_ms, picture.as_ref()) {
                        self.fail(&error);
                        // The sender must not wait for a stopped writer.
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
        let message = format!("{error}; tracking goes on without it");
        *self.failure.lock().unwrap_or_else(PoisonError::into_inner) = Some(message);
    }

    /// Warning.
    pub fn message(&self) -> Option<String> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).clone()
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
