//! Ambiguous measurements, which may not be of the ground: they are searched for again over all
//! known ground.

use super::Odometry;
use super::follow::{self, Measurement};
use super::recovery::Lost;
use super::texture::Texture;
use crate::image::Pyramid;
use crate::motion::{MotionModel, Random};
use crate::trajectory::LossReason;

/// A pose with a smaller inlier ratio among the corners in view may be that of something else.
const DOUBTFUL_PRESENCE: f64 = 0.55;

/// Where a smaller part of the corners in view agrees, what agrees does so by chance.
pub const CHANCE_PRESENCE: f64 = 0.25;

/// Distance from the prediction, pixels, above which a joint of the floor may have been taken for
/// its neighbour.
const SURPRISE_PX: f64 = 12.0;

/// Where a smaller part of the corners in view agrees with a surprise, it may be something else.
const SURPRISING_PRESENCE: f64 = 0.7;

/// Number of frames after a loss in which a standing image is not taken for a camera that came to
/// rest exactly at its keyframe.
const MOST_SHADOWED: usize = 15;

impl Odometry {
    /// Whether a measurement may have tracked something beside the ground, such as a moving shadow,
    /// or another part of the ground that looks alike: few corners in view are inliers, or less
    /// than most although the pose is far from the prediction.
    pub(super) fn is_doubtful(&self, measurement: &Measurement) -> bool {
        let (found, expected) = (&measurement.estimate.pose, &measurement.prediction);
        let off_m = (found.x_m - expected.x_m).hypot(found.y_m - expected.y_m);
        let surprising = off_m * self.camera.focal_px().0 > SURPRISE_PX * found.height_m;
        let wanted =
            self.learned.usual_presence() * if surprising { SURPRISING_PRESENCE } else { DOUBTFUL_PRESENCE };
        // The support counts corners out of view too: the presence is never below it.
        measurement.support < wanted
            && self
                .keyframe
                .as_ref()
                .is_some_and(|keyframe| follow::presence(keyframe, &self.camera, measurement) < wanted)
    }

    /// The pose of a frame anywhere over known ground. Takes up the keyframe in which it was found.
    pub(super) fn recover(
        &mut self,
        pyramid: &Pyramid,
        time_s: f64,
        near: std::result::Result<Measurement, LossReason>,
    ) -> std::result::Result<Measurement, LossReason> {
        let (Some(keyframe), Some(last)) = (&mut self.keyframe, &self.last) else {
            return near;
        };
        if self.config.motion.model == MotionModel::Mean {
            return near;
        }
        let least = CHANCE_PRESENCE * self.learned.usual_presence();
        let near = near.and_then(|measurement| {
            let presence = follow::presence(keyframe, &self.camera, &measurement);
            if presence < SURPRISING_PRESENCE * self.learned.usual_presence()
                && follow::stands_still(keyframe, &self.camera, &measurement)
            {
                return Err(LossReason::Shadow);
            }
            if presence >= least {
                return Ok(measurement);
            }
            let Measurement { found, prediction, .. } = &measurement;
            Err(follow::why_not(keyframe, &self.camera, found, prediction))
        });
        if Texture::of(pyramid, self.fixed.mask()) == Texture::Faint {
            return near;
        }
        let reason = near.as_ref().err().copied().unwrap_or(LossReason::NotPlanar);
        let (expected, frames) = (last.extrapolated(time_s), self.lost_frames);
        let lost = Lost { pyramid, last, expected, frames, doubtful: near.ok() };
        let (camera, config, mut random) = (&self.camera, &self.config, Random::new(self.frames));
        let found =
            self.recovery.find(lost, keyframe, &mut self.memory, camera, config, &self.learned, &mut random);
        let found = found.ok_or(reason)?;
        let shadow = self.lost_frames < MOST_SHADOWED
            && found.remembered.is_none()
            && follow::presence(keyframe, camera, &found.measurement)
                < SURPRISING_PRESENCE * self.learned.usual_presence()
            && follow::stands_still(keyframe, camera, &found.measurement);
        if shadow {
            return Err(LossReason::Shadow);
        }
        if let Some(old) = found.remembered.and_then(|index| self.memory.take(index, camera)) {
            self.memory.remember(std::mem::replace(keyframe, old).retire());
        }
        Ok(found.measurement)
    }

    /// Checks the tracks of a frame on which others may be built.
    pub(super) fn confirm(&self, pyramid: &Pyramid, measurement: Measurement) -> Measurement {
        match &self.keyframe {
            Some(keyframe) if measurement.support < self.enough_support() => {
                let mut random = Random::new(self.frames);
                follow::confirm(
                    keyframe,
                    pyramid,
                    &self.camera,
                    measurement,
                    &self.config,
                    &self.learned,
                    &mut random,
                )
            }
            _ => measurement,
        }
    }
}
