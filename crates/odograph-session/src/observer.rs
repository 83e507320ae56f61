//! Progress of a run, and requests to end it.

use odograph::pose_frame::PoseFrame;
use odograph::trajectory::FrameEstimate;

/// Observes a run. Every method has an empty default, so `()` is an observer that ignores
/// everything.
///
/// Methods are called from the run's threads and should return soon. An observer does not influence
/// results, except by a request to stop.
pub trait Observer: Sync {
    /// The recording is tracked another time from its first frame: because camera or mount turned
    /// out to be different, or before a map is continued, when only its beginning is tracked to
    /// examine it. `why` is a part of a sentence. [`Observer::tracking_begins`] follows.
    fn tracking_again(&self, why: &str) {
        let _ = why;
    }

    /// Tracking begins, at the first frame; `frames` is the number of frames to come, where it is
    /// known. Called once more for each [`Observer::tracking_again`].
    fn tracking_begins(&self, frames: Option<u64>) {
        let _ = frames;
    }

    /// A frame was tracked: its estimate in the odometry frame, before loops and other sensors.
    fn frame(&self, estimate: &FrameEstimate) {
        let _ = estimate;
    }

    /// Tracking has ended; improving, drawing and writing follow.
    fn tracking_ends(&self) {}

    /// The final estimate of a frame, with loops closed and other sensors used, as `trajectory.csv`
    /// has it, and whose pose that is. Called for every frame in order, after the trajectories were
    /// written.
    fn final_frame(&self, estimate: &FrameEstimate, of: &PoseFrame) {
        let _ = (estimate, of);
    }

    /// Something about the input that a person should check before waiting for the result, as a
    /// sentence. Warnings about the result are in the outcome; those of a live run that fails, of
    /// which there is none, come here.
    fn warn(&self, sentence: &str) {
        let _ = sentence;
    }

    /// Something about the input that a person may want to know; nothing is wrong.
    fn note(&self, sentence: &str) {
        let _ = sentence;
    }

    /// Whether the run is asked to end early. Asked before every frame; what there is is then
    /// written, and the run ends as [`RunEnd::Interrupted`](crate::RunEnd::Interrupted).
    fn is_stop_asked(&self) -> bool {
        false
    }
}

impl Observer for () {}
