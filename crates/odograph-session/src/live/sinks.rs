//! Outputs for the poses of a live run.

use super::mcap::McapLog;
use odograph::error::Result;
use odograph::trajectory::FrameEstimate;

/// Receives poses as soon as they are known.
pub trait PoseSink {
    /// Receives a tracked or lost frame, with its latency since capture, milliseconds.
    ///
    /// # Errors
    /// An error ends the run, which then fails with it once all results are written.
    fn take(&mut self, frame: &FrameEstimate, latency_ms: f64) -> Result<()>;
}

/// Outputs of poses besides folder and hub.
pub struct LiveSinks<'a, 'p> {
    pub poses: Option<&'a mut (dyn PoseSink + 'p)>,
    pub log: Option<&'a McapLog>,
}
