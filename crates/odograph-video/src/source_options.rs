//! Selection of frames, and timestamps.

use odograph::error::{Error, Result};
use std::path::PathBuf;

/// No camera is faster, frames per second.
const MAX_FRAMES_PER_SECOND: f64 = 1e6;
/// A frame in twelve days.
const MIN_FRAMES_PER_SECOND: f64 = 1e-6;

/// Selection of frames, and timestamps for a source without them.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceOptions {
    /// A timestamps file with lines of `seconds name` (as in TUM's `rgb.txt`), `name seconds`,
    /// EuRoC's `nanoseconds,name`, or one number per line in the order of the frames; `#` starts a
    /// comment. Takes precedence over all other timestamps.
    pub timestamps: Option<PathBuf>,
    /// Frames per second, > 0 and at most a million: frame `n` is at `n / fps` seconds, whatever
    /// the container has.
    pub fps: Option<f64>,
    /// Excludes frames earlier than this many seconds after the first frame.
    pub start_s: Option<f64>,
    /// Excludes frames later than this many seconds after the first frame.
    pub end_s: Option<f64>,
    /// Yields every n-th frame from the start; at least 1.
    pub every: u64,
    /// Maximum number of frames to yield.
    pub max_frames: Option<u64>,
    /// Keeps the colour in addition to the gray image, for [`crate::Frame::rgb`].
    pub color: bool,
    /// Topic of a robot recording to take the images from; needed only if it has several.
    pub topic: Option<String>,
}

impl Default for SourceOptions {
    fn default() -> Self {
        Self {
            timestamps: None,
            fps: None,
            start_s: None,
            end_s: None,
            every: 1,
            max_frames: None,
            color: false,
            topic: None,
        }
    }
}

impl SourceOptions {
    /// Fails if an option is out of its range.
    pub(crate) fn check(&self) -> Result<()> {
        if self.every == 0 {
            return Err(Error::usage("every 0th frame was asked for; 1 gives every frame"));
        }
        if self.fps.is_some_and(|fps| !(MIN_FRAMES_PER_SECOND..=MAX_FRAMES_PER_SECOND).contains(&fps)) {
            return Err(Error::usage(format!(
                "the frames a second must be between {MIN_FRAMES_PER_SECOND} and {MAX_FRAMES_PER_SECOND}"
            )));
        }
        let (start, end) = (self.start_s.unwrap_or(0.0), self.end_s.unwrap_or(f64::MAX));
        if !(start.is_finite() && start >= 0.0 && end.is_finite() && end >= 0.0) {
            return Err(Error::usage("start and end must be seconds from zero on"));
        }
        if end < start {
            return Err(Error::usage(format!("the end ({end} s) lies before the start ({start} s)")));
        }
        Ok(())
    }
}
