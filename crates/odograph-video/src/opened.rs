//! What every kind of source is opened as: its frames, read sequentially.

use crate::frame::Picture;
use odograph::error::Result;

/// Frames of a source of any kind.
pub(crate) trait Frames: Send {
    /// Advances to the next frame and returns its time in seconds (its index if the source has no
    /// timestamps); `None` at the end.
    fn advance(&mut self) -> Result<Option<f64>>;
    /// The current frame, upright; can be taken once. `None` if it is damaged and left out, which
    /// [`take_warnings`](Self::take_warnings) reports.
    fn picture(&mut self) -> Result<Option<Picture>>;
    /// File name of the current image; `None` for a video.
    fn name(&self) -> Option<String> {
        None
    }
    /// Drains the warnings about defects of the source, one sentence each.
    fn take_warnings(&mut self) -> Vec<String>;
    /// The times of all remaining frames, which are not decoded if that can be avoided.
    fn times(&mut self) -> Result<Vec<f64>> {
        let mut times = Vec::new();
        while let Some(time_s) = self.advance()? {
            times.push(time_s);
        }
        Ok(times)
    }
}

/// An opened source of any kind.
pub(crate) struct Opened {
    pub frames: Box<dyn Frames>,
    pub frame_count: Option<u64>,
    /// The least and the greatest number of frames; `None` if the source does not state it reliably
    /// or is cut off.
    pub frames_within: Option<(u64, u64)>,
    pub description: String,
    pub times_known: bool,
    /// Whether the times are those of [`crate::SourceOptions::timestamps`].
    pub timestamps_used: bool,
    pub frames_per_second: Option<f64>,
}
