//! Outputs for the poses of a live run.

use super::mcap::McapLog;
use odograph::error::Result;
use odograph::geometry::Sim2;
use odograph::pose_frame::PoseFrame;
use odograph::trajectory::FrameEstimate;

/// A frame of a live run, as soon as it is known.
#[derive(Debug, Clone, Copy)]
pub struct LiveFrame<'a> {
    /// Tracked or lost; its pose is that of `of` in the odometry frame.
    pub estimate: &'a FrameEstimate,
    /// Whose poses are written.
    pub of: &'a PoseFrame,
    /// Since its capture, milliseconds.
    pub latency_ms: f64,
    /// The correction that loops have made so far. The map may be a few keyframes behind.
    pub map_from_odometry: Sim2,
    /// Whether its place in the map that is continued is known; true where the map is a new one.
    pub is_recognised: bool,
}

/// Receives poses as soon as they are known.
pub trait PoseSink {
    /// Receives a tracked or lost frame.
    ///
    /// # Errors
    /// An error ends the run, which then fails with it once all results are written.
    fn take(&mut self, frame: &LiveFrame<'_>) -> Result<()>;
}

/// Outputs of poses besides folder and hub.
pub struct LiveSinks<'a, 'p> {
    pub poses: Option<&'a mut (dyn PoseSink + 'p)>,
    pub log: Option<&'a McapLog>,
    /// Whether the path is kept in the hub.
    pub shown: bool,
}
