//! What comes between the camera and the ground: the arm of a robot, a hand, a passer-by.
//!
//! A frame in which many corners of its keyframe were not found again may show something else. As a
//! keyframe it is on trial: if the next frame moves against it as predicted, it shows the ground,
//! and later frames may come back to those of its corners that were found on it. Otherwise the
//! tracker would follow what covers the ground, and every later keyframe with it: the keyframe
//! before is taken up again.

use super::Odometry;
use super::found_corner::FoundCorner;
use super::keyframe::{KeyCorner, Keyframe};
use super::keyframe_event::Before;
use super::last_pose::LastPose;
use super::standing::STILL_PX;
use super::tracking::Measurement;
use crate::geometry::GroundPose;
use crate::image::Pyramid;
use crate::motion::{MotionEstimate, MotionModel};
use crate::trajectory::LossReason;

/// Something may cover the ground if less than this part of what is usual was found again of the
/// corners in view. Chosen on an arm that covers the view within eight frames; the usual part
/// follows within five.
const COVERED: f64 = 0.75;

/// Motion from frame to frame, pixels, with which a camera does not come to rest unseen. Twice what
/// counts as standing.
const MOVES_PX: f64 = 2.0 * STILL_PX;

/// What makes a keyframe on trial one of the map.
#[derive(Debug)]
pub(in crate::odometry) struct Trial {
    /// Number and time of its frame.
    pub made: (u64, f64),
    pub before: Option<Before>,
}

impl Keyframe {
    /// Puts it on trial.
    pub(super) fn try_out(&mut self, trial: Trial) {
        self.on_trial = Some(Box::new(trial));
        self.was_on_trial = true;
    }

    /// Corners on which a frame agrees are on the ground.
    fn saw_ground(&mut self, found: &[FoundCorner], frame: &MotionEstimate) {
        if self.was_on_trial {
            let inliers = found.iter().zip(&frame.inliers).filter(|(_, inlier)| **inlier);
            inliers.for_each(|(found, _)| self.corners[found.corner].is_ground = true);
        }
    }

    /// Leaves out the corners of a keyframe that was on trial which no frame has found on the
    /// ground: they may be on what covers it.
    pub(super) fn leave_out_cover(&mut self) {
        let is_ground = |corner: &&KeyCorner| corner.is_ground;
        if self.was_on_trial && self.corners.iter().any(|corner| corner.is_ground) {
            self.places =
                self.corners.iter().filter(is_ground).map(|corner| corner.template.pixel()).collect();
        }
    }
}

impl Odometry {
    /// Whether something may cover the ground in a frame in which this part of the corners in view
    /// was found again.
    pub(super) fn may_be_covered(&self, inlier_ratio: Option<f64>) -> bool {
        let least = COVERED * self.learned.usual_inlier_ratio();
        self.config.motion.model != MotionModel::Mean && inlier_ratio.is_some_and(|ratio| ratio < least)
    }

    /// A frame measured against a keyframe on trial: if it has not moved as predicted, it is
    /// measured against the keyframe before.
    pub(super) fn on_trial(
        &mut self,
        measured: Result<Measurement, LossReason>,
        pyramid: &Pyramid,
        time_s: f64,
    ) -> Result<Measurement, LossReason> {
        let stands_trial = |found: &Measurement| !self.contradicts_prediction(&found.estimate.pose, time_s);
        if self.keyframe.as_ref().is_none_or(|keyframe| keyframe.on_trial.is_none())
            || measured.as_ref().is_ok_and(stands_trial)
        {
            return measured;
        }
        let Some(before) = self.memory.take_newest(&self.camera) else { return measured };
        self.set_reference(before.id, before.pose);
        self.keyframe = Some(before);
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
    pub(super) fn end_trial(&mut self, found: &[FoundCorner], frame: &MotionEstimate) {
        let Some(mut keyframe) = self.keyframe.take() else { return };
        keyframe.saw_ground(found, frame);
        if let Some(trial) = keyframe.on_trial.take() {
            self.number(&mut keyframe, trial.made, trial.before);
        }
        self.keyframe = Some(keyframe);
    }
}
