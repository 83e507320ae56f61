//! The start of a new segment that has not proved itself yet.

use super::ambiguity::CHANCE_INLIER_RATIO;
use super::keyframe::Keyframe;
use super::learned::Learned;
use super::tracking::{self, Measurement};
use super::{LastPose, OdometryConfig};
use crate::camera::Camera;
use crate::fixed_pattern::ImageMask;
use crate::image::Pyramid;
use crate::motion::Random;
use std::sync::Arc;

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
    /// A candidate from an unmeasured frame at the pose of `last`. `None` if the frame has too
    /// little texture.
    pub fn new(
        pyramid: Pyramid,
        frame: u64,
        last: LastPose,
        mask: Option<&Arc<ImageMask>>,
        camera: &Camera,
        config: &OdometryConfig,
    ) -> Option<Self> {
        let (pose, covariance) = (last.pose, last.covariance);
        let mut keyframe = Keyframe::new(pyramid, pose, covariance, mask, camera, &config.detection);
        let made = (frame, last.time_s);
        let enough = keyframe.can_be_followed(2 * config.motion.minimum_inliers);
        enough.then_some(Self { keyframe, last, made, confirmations: 0 })
    }

    /// Measures the next frame against the candidate; `None` if it does not agree.
    pub fn confirm(
        &mut self,
        pyramid: &Pyramid,
        time_s: f64,
        camera: &Camera,
        config: &OdometryConfig,
        learned: &Learned,
        random: &mut Random,
    ) -> Option<Measurement> {
        let from = [self.last.extrapolated(time_s), self.last.pose];
        let keyframe = &self.keyframe;
        let whole = || tracking::measure_drowned(keyframe, pyramid, camera, from.each_ref(), config, learned);
        let by_corners = from.iter().find_map(|from| {
            let found = tracking::measure(keyframe, pyramid, camera, from, config, learned, random).ok()?;
            let inlier_ratio = found.inlier_ratio(keyframe, camera);
            (inlier_ratio >= CHANCE_INLIER_RATIO).then_some(found)
        });
        let measurement = by_corners.or_else(whole)?;
        let (pose, covariance) = (measurement.estimate.pose, self.keyframe.covariance);
        self.last = self.last.clone().moved(time_s, pose, covariance + measurement.estimate.covariance);
        self.confirmations += 1;
        Some(measurement)
    }

    /// Whether enough consecutive frames agreed.
    pub fn is_confirmed(&self, needed: usize) -> bool {
        self.confirmations >= needed
    }

    /// A fast camera leaves the candidate's ground before it is accepted: the next frame is
    /// measured against this one, if it has enough texture.
    pub fn move_on(&mut self, pyramid: Pyramid, frame: u64, camera: &Camera, config: &OdometryConfig) {
        let (pose, covariance, mask) = (self.last.pose, self.last.covariance, self.keyframe.mask.as_ref());
        let mut next = Keyframe::new(pyramid, pose, covariance, mask, camera, &config.detection);
        if next.can_be_followed(2 * config.motion.minimum_inliers) {
            self.keyframe = next;
            self.made = (frame, self.last.time_s);
        }
    }
}
