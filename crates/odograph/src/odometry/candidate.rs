//! The start of a new segment that has not proved itself yet.

use super::LastPose;
use super::ambiguity::CHANCE_INLIER_RATIO;
use super::keyframe::Keyframe;
use super::tracking::{Measurement, Tracker};
use crate::motion::{MotionEstimate, Random};

/// Consecutive frames that must agree with a candidate before it is accepted, dark ones aside: a
/// hand passes, the floor stays.
pub const CONFIRMATIONS: usize = 3;

/// Number after which it is accepted even though not every remembered keyframe has been looked for.
pub const MOST_CONFIRMATIONS: usize = 8;

/// A keyframe made from an unmeasured frame, and the number of later frames that agreed with it.
#[derive(Debug)]
pub struct SegmentCandidate {
    pub keyframe: Keyframe,
    pub last: LastPose,
    /// Number and time of the keyframe's frame.
    pub made: (u64, f64),
    confirmations: usize,
}

impl SegmentCandidate {
    /// A candidate from the keyframe that an unmeasured frame at the pose of `last` has become.
    pub fn new(keyframe: Keyframe, frame: u64, last: LastPose) -> Self {
        let made = (frame, last.time_s);
        Self { keyframe, last, made, confirmations: 0 }
    }

    /// Measures the next frame by a tracker against the candidate's keyframe; `None` if it does not
    /// agree.
    pub fn measure(&self, tracker: &Tracker<'_>, time_s: f64, random: &mut Random) -> Option<Measurement> {
        let from = [self.last.extrapolated(time_s), self.last.pose];
        let by_corners = from.iter().find_map(|from| {
            let found = tracker.measure(from, random).ok()?;
            let inlier_ratio = found.inlier_ratio(&self.keyframe, tracker.camera);
            (inlier_ratio >= CHANCE_INLIER_RATIO).then_some(found)
        });
        by_corners.or_else(|| tracker.measure_drowned(from.each_ref()))
    }

    /// Follows a frame that agreed.
    pub fn confirm(&mut self, time_s: f64, estimate: &MotionEstimate) {
        let covariance = self.keyframe.covariance + estimate.covariance;
        self.last = self.last.clone().moved(time_s, estimate.pose, covariance);
        self.confirmations += 1;
    }

    /// Whether enough consecutive frames agreed.
    pub fn is_confirmed(&self, needed: usize) -> bool {
        self.confirmations >= needed
    }

    /// The next frame is measured against this one: a fast camera leaves the candidate's ground
    /// before it is accepted.
    pub fn move_on(&mut self, keyframe: Keyframe, frame: u64) {
        self.keyframe = keyframe;
        self.made = (frame, self.last.time_s);
    }
}
