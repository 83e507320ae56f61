//! Where the poses of a live run go.

use super::mcap::McapLog;
use odograph::error::Result;
use odograph::trajectory::FrameEstimate;

/// Takes poses as soon as they are known.
pub trait PoseSink {
    /// Takes a frame, tracked or lost, so long after its capture, milliseconds.
    ///
    /// # Errors
    /// An error ends the run, which then fails with it once all results are written.
    fn take(&mut self, frame: &FrameEstimate, latency_ms: f64) -> Result<()>;
}

/// Where the poses of a live run go beside folder and hub.
pub struct LiveSinks<'a, 'p> {
    pub poses: Option<&'a mut (dyn PoseSink + 'p)>,
    pub log: Option<&'a McapLog>,
}
