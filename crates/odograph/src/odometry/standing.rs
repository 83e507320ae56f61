//! Rejects poses of a standing camera that come from something fixed in the image, while the ground
//! moves.

use super::Odometry;
use super::last_pose::seen_apart;
use super::tracking::Measurement;
use crate::fixed_pattern::SinceLast;
use crate::geometry::GroundPose;
use crate::image::GrayImage;
use crate::trajectory::LossReason;
use std::sync::Arc;

/// Poses that the tracker gave while the image moved on without them.
#[derive(Debug, Default)]
pub struct Standing {
    /// The pose of the last image that counted as evidence that the ground moves.
    counted: Option<GroundPose>,
    /// Where the tracker says that the camera stands, although it cannot.
    suspected: Option<GroundPose>,
    /// For how many frames yet.
    frames_left: usize,
}

/// Motion below which the image stands still, pixels: cells of four pixels that are no longer
/// recognized have moved further.
pub const STILL_PX: f64 = 1.5;

/// Frames without new evidence after which a camera may stand.
const SUSPICION_FRAMES: usize = 15;

impl Standing {
    /// The image of a frame with this pose counts from now on.
    pub fn counts_from(&mut self, pose: Option<GroundPose>) {
        self.counted = pose;
    }

    /// Whether what is followed is thought to be something that moves along with the camera.
    pub fn is_suspected(&self) -> bool {
        self.suspected.is_some()
    }

    /// The tracker gave this pose, and stands where the ground moves.
    pub fn suspect(&mut self, pose: Option<GroundPose>) {
        if pose.is_some() {
            (self.suspected, self.frames_left) = (pose, SUSPICION_FRAMES);
        }
    }

    fn clear(&mut self) {
        (self.counted, self.suspected) = (None, None);
    }
}

impl Odometry {
    /// Detects in the next image what does not move with the ground, and masks it in the keyframes.
    pub(super) fn look_for_what_is_fixed(&mut self, image: &GrayImage) -> SinceLast {
        let before = self.fixed.mask().cloned();
        let since_last = self.fixed.look(image);
        let Some(mask) = self.fixed.mask() else { return since_last };
        if before.is_none_or(|before| !Arc::ptr_eq(&before, mask)) {
            let detection = &self.config.detection;
            let candidate = self.candidate.iter_mut().map(|candidate| &mut candidate.keyframe);
            for keyframe in self.keyframe.iter_mut().chain(candidate) {
                keyframe.set_mask(mask, detection);
                keyframe.prepare(&self.camera);
            }
            self.memory.set_mask(mask, detection);
            self.standing.clear();
        }
        since_last
    }

    /// Refuses a pose according to which the camera stands although the image has moved.
    pub(super) fn distrust(
        &mut self,
        measurement: Measurement,
        since_last: SinceLast,
    ) -> Result<Measurement, LossReason> {
        let pose = measurement.estimate.pose;
        let focal_px = self.camera.focal_px().0;
        let stands_at = |before: &GroundPose| seen_apart(before, &pose) * focal_px < STILL_PX;
        // What is fixed in the image stays where the keyframe shows it. Corners that have moved
        // since and stand now are of the ground.
        if !self.keyframe.as_ref().is_some_and(|keyframe| stands_at(&keyframe.pose)) {
            self.standing.suspected = None;
            return Ok(measurement);
        }
        let standing = &mut self.standing;
        if since_last == SinceLast::Moved && standing.counted.as_ref().is_some_and(stands_at) {
            (standing.suspected, standing.frames_left) = (Some(pose), SUSPICION_FRAMES);
            return Err(LossReason::Shadow);
        }
        if standing.suspected.as_ref().is_some_and(stands_at) && standing.frames_left > 0 {
            standing.frames_left -= 1;
            return Err(LossReason::Shadow);
        }
        standing.suspected = None;
        Ok(measurement)
    }
}
