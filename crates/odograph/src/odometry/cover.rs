//! What comes between the camera and the ground: the arm of a robot, a hand, a passer-by.
//!
//! A frame in which many corners of its keyframe were not found again may show something else. As a
//! keyframe it is on trial: if the next frame moves against it as predicted, it shows the ground.
//! Otherwise the tracker would follow what covers the ground, and every later keyframe with it: the
//! last keyframe that was not on trial is taken up again. Lost frames are not searched for in
//! keyframes that were on trial, where what covers the ground would be found. Limits:
//! `docs/math/frame-pose.md`.

use super::Odometry;
use super::keyframe_event::Before;
use super::last_pose::LastPose;
use super::standing::STILL_PX;
use super::tracking::Measurement;
use crate::geometry::GroundPose;
use crate::image::Pyramid;
use crate::motion::MotionModel;
use crate::trajectory::LossReason;

/// Something may cover the ground if less than this part of what is usual was found again of the
/// corners in view. Chosen on an arm that covers the view within eight frames; the usual part
/// follows within five.
const COVERED: f64 = 0.7;

/// Motion from frame to frame, pixels, with which a camera does not come to rest unseen. Twice what
/// counts as standing.
const MOVES_PX: f64 = 2.0 * STILL_PX;

/// What makes the present keyframe one of the map once it has stood its trial.
#[derive(Debug)]
pub struct Trial {
    /// Number and time of its frame.
    pub made: (u64, f64),
    pub(super) before: Option<Before>,
}

impl Odometry {
    /// Whether something may cover the ground in a frame in which this part of the corners in view
    /// was found again.
    pub(super) fn may_be_covered(&self, inlier_ratio: Option<f64>) -> bool {
        let least = COVERED * self.learned.usual_inlier_ratio();
        self.config.motion.model != MotionModel::Mean && inlier_ratio.is_some_and(|ratio| ratio < least)
    }

    /// A frame measured against a keyframe on trial: if it has not moved as predicted, it is
    /// measured against the last keyframe that was not on trial.
    pub(super) fn on_trial(
        &mut self,
        measured: Result<Measurement, LossReason>,
        pyramid: &Pyramid,
        time_s: f64,
    ) -> Result<Measurement, LossReason> {
        let stands_trial = |found: &Measurement| !self.contradicts_prediction(&found.estimate.pose, time_s);
        if self.trial.is_none() || measured.as_ref().is_ok_and(stands_trial) {
            return measured;
        }
        let Some(before) = self.memory.take_newest(&self.camera) else {
            self.end_trial();
            return measured;
        };
        self.set_reference(before.id, before.pose);
        (self.keyframe, self.trial) = (Some(before), None);
        let again = self.measure_near(pyramid, time_s);
        again.and_then(|found| match self.contradicts_prediction(&found.estimate.pose, time_s) {
            true => Err(LossReason::NotPlanar),
            false => Ok(found),
        })
    }

    /// Whether what was seen from two poses stands still in the image, although the camera moved
    /// when it was lost: it is fixed to the camera.
    pub(super) fn goes_along(&self, before: &GroundPose, now: &GroundPose) -> bool {
        let step_px = |last: &LastPose| {
            let next = last.extrapolated(last.time_s + last.step_s);
            self.seen_apart_px(&last.pose, &next)
        };
        let moved_px = self.last.as_ref().map_or(0.0, step_px);
        moved_px > MOVES_PX && self.seen_apart_px(before, now) < STILL_PX
    }

    /// A frame has moved as predicted against the keyframe. If that was on trial it is now one of
    /// the map.
    pub(super) fn end_trial(&mut self) {
        let Some(trial) = self.trial.take() else { return };
        if let Some(mut keyframe) = self.keyframe.take() {
            self.number(&mut keyframe, trial.made, trial.before);
            self.keyframe = Some(keyframe);
        }
    }
}
