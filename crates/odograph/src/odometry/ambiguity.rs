//! Ambiguous measurements, which may not be of the ground: they are searched for again over all
//! known ground.

use super::Odometry;
use super::recovery::Lost;
use super::texture::TextureClass;
use super::tracking::{Measurement, Tracker};
use crate::image::Pyramid;
use crate::motion::{MotionModel, Random};
use crate::trajectory::LossReason;

/// A pose with a smaller inlier ratio among the corners in view may be that of something else.
const AMBIGUOUS_INLIER_RATIO: f64 = 0.55;

/// Where a smaller part of the corners in view agrees, what agrees does so by chance.
pub const CHANCE_INLIER_RATIO: f64 = 0.25;

/// Distance from the prediction, pixels, above which a joint of the floor may have been taken for
/// its neighbour.
const SURPRISE_PX: f64 = 12.0;

/// Where a smaller part of the corners in view agrees with a surprise, it may be something else.
const SURPRISING_INLIER_RATIO: f64 = 0.7;

/// A pose this near to its prediction, pixels, is not searched for elsewhere if tracks agree on it
/// so closely that this decimal logarithm of the number of false alarms is not exceeded.
/// Overlapping patches are not independent, hence far less than one. Chosen on tiles in falling
/// snow, where a fifth of the corners is of the ground; an image blurred over 200 pixels has a
/// twentieth.
const EXPECTED_PX: f64 = 4.0;
const MOST_FALSE_ALARMS: f64 = -6.0;
const EXPECTED_INLIER_RATIO: f64 = 0.1;

/// Number of frames after a loss in which a standing image is not taken for a camera that came to
/// rest exactly at its keyframe.
const MOST_SHADOWED: usize = 15;

impl Odometry {
    /// Whether a measurement may have tracked something beside the ground, such as a moving shadow,
    /// or another part of the ground that looks alike: few corners in view are inliers, or less
    /// than most although the pose is far from the prediction.
    pub(super) fn is_ambiguous(&self, measurement: &Measurement, time_s: f64) -> bool {
        let found = &measurement.estimate.pose;
        let expected = self.expected(time_s).unwrap_or(measurement.prediction);
        let off_m = found.distance_m(&expected);
        let off_px = off_m * self.camera.focal_px().0 / found.height_m;
        let is_expected = off_px < EXPECTED_PX
            && measurement.false_alarms(self.config.motion.inlier_px) < MOST_FALSE_ALARMS;
        let wanted = self.learned.usual_inlier_ratio()
            * match off_px > SURPRISE_PX {
                true => SURPRISING_INLIER_RATIO,
                false if is_expected => EXPECTED_INLIER_RATIO,
                false => AMBIGUOUS_INLIER_RATIO,
            };
        // The support also counts corners out of view, so it never exceeds the inlier ratio.
        measurement.support < wanted
            && self
                .keyframe
                .as_ref()
                .is_some_and(|keyframe| measurement.inlier_ratio(keyframe, &self.camera) < wanted)
    }

    /// The pose of a frame anywhere over known ground. Takes up the keyframe in which it was found.
    pub(super) fn recover(
        &mut self,
        pyramid: &Pyramid,
        time_s: f64,
        near: std::result::Result<Measurement, LossReason>,
    ) -> std::result::Result<Measurement, LossReason> {
        let (Some(keyframe), Some(last)) = (&self.keyframe, &self.last) else {
            return near;
        };
        if self.config.motion.model == MotionModel::Mean {
            return near;
        }
        let (camera, config, learned) = (&self.camera, &self.config, &self.learned);
        let tracker = Tracker { keyframe, pyramid, camera, config, learned };
        let usual = learned.usual_inlier_ratio();
        let (least, surprising) = (CHANCE_INLIER_RATIO * usual, SURPRISING_INLIER_RATIO * usual);
        let (expected, gap_s) = (last.extrapolated(time_s), time_s - last.time_s);
        let near = near.and_then(|measurement| {
            let inlier_ratio = measurement.inlier_ratio(keyframe, camera);
            if inlier_ratio < surprising && measurement.stands_still(keyframe, camera, &expected) {
                return Err(LossReason::Shadow);
            }
            if inlier_ratio >= least {
                return Ok(measurement);
            }
            let Measurement { found, prediction, .. } = &measurement;
            Err(tracker.reason_of_loss(found, prediction))
        });
        if TextureClass::of(pyramid, self.fixed.mask()) == TextureClass::Faint {
            return near;
        }
        let reason = near.as_ref().err().copied().unwrap_or(LossReason::NotPlanar);
        let frames = self.lost_frames;
        let lost = Lost { tracker, last, expected, gap_s, frames, ambiguous: near.ok() };
        let random = &mut Random::new(self.frames);
        let found = self.recovery.find(lost, &mut self.memory, random).ok_or(reason)?;
        let shadow = self.lost_frames < MOST_SHADOWED
            && found.remembered.is_none()
            && found.measurement.inlier_ratio(keyframe, camera) < surprising
            && found.measurement.stands_still(keyframe, camera, &expected);
        if shadow {
            return Err(LossReason::Shadow);
        }
        if let Some(old) = found.remembered.and_then(|index| self.memory.take(index, camera)) {
            self.replace_keyframe(old);
        }
        Ok(found.measurement)
    }

    /// Checks the tracks of a frame on which others may be built.
    pub(super) fn confirm(&self, pyramid: &Pyramid, measurement: Measurement) -> Measurement {
        match &self.keyframe {
            Some(keyframe) if measurement.support < self.enough_support() => {
                self.tracker(keyframe, pyramid).confirm(measurement, &mut Random::new(self.frames))
            }
            _ => measurement,
        }
    }
}
