//! Which of a keyframe's corners a camera should see, and which part of them agrees.

use super::super::found_corner::FoundCorner;
use super::super::keyframe::{KeyCorner, Keyframe};
use super::Measurement;
use crate::camera::Camera;
use crate::geometry::GroundPose;
use crate::motion::ViewingPose;
use crate::trajectory::LossReason;

impl Measurement {
    /// Inlier ratio among the keyframe's corners that a camera at the measured pose should see, 0
    /// to 1: low if only something beside the ground was tracked.
    pub fn inlier_ratio(&self, keyframe: &Keyframe, camera: &Camera) -> f64 {
        let estimate = &self.estimate;
        self.agreement.unwrap_or_else(|| {
            let expected = in_view(keyframe, keyframe.corners.iter(), camera, &estimate.pose);
            estimate.inlier_count() as f64 / expected.max(1) as f64
        })
    }

    /// Whether the inliers stand still in the image although the camera should have moved since the
    /// keyframe, as the shadow of the vehicle does.
    pub fn stands_still(&self, keyframe: &Keyframe, camera: &Camera) -> bool {
        const STILL_PX: f64 = 1.0;
        const MOVED_PX: f64 = 6.0;
        const MOST: f64 = 0.6;
        let (from, to) = (&keyframe.pose, &self.prediction);
        let moved_m = (to.x_m - from.x_m).hypot(to.y_m - from.y_m);
        if moved_m * camera.focal_px().0 < MOVED_PX * to.height_m {
            return false;
        }
        let agree = self.found.iter().zip(&self.estimate.inliers).filter(|(_, agrees)| **agrees);
        let still = agree.filter(|(found, _)| {
            found.warp.position.distance(keyframe.corners[found.corner].template.centre()) < STILL_PX
        });
        still.count() as f64 > MOST * self.estimate.inlier_count().max(1) as f64
    }
}

/// Reason of a loss: most of what should be in view was found but does not move as one plane, or it
/// was found by chance.
pub fn reason_of_loss(
    keyframe: &Keyframe,
    camera: &Camera,
    found: &[FoundCorner],
    prediction: &GroundPose,
) -> LossReason {
    const MOST: f64 = 0.5;
    let expected = in_view(keyframe, keyframe.corners.iter(), camera, prediction);
    if found.len() as f64 >= MOST * expected as f64 { LossReason::NotPlanar } else { LossReason::Jump }
}

/// How many of the corners a camera at `pose` should see.
pub(super) fn in_view<'a>(
    keyframe: &Keyframe,
    corners: impl Iterator<Item = &'a KeyCorner>,
    camera: &Camera,
    pose: &GroundPose,
) -> usize {
    let pose = ViewingPose::new(*pose);
    let seen = |corner: &&KeyCorner| {
        let pixel = corner.patch.pixel(camera, &pose);
        pixel.is_some_and(|pixel| camera.contains(pixel, TEMPLATE_REACH_PX) && !keyframe.is_masked(pixel))
    };
    corners.filter(seen).count()
}

/// Fraction of the keyframe's tracked corners that a camera at `pose` would still see.
pub fn still_seen(keyframe: &Keyframe, camera: &Camera, found: &[FoundCorner], pose: &GroundPose) -> f64 {
    if found.is_empty() {
        return keyframe.dense(camera).overlap(camera, pose);
    }
    let pose = ViewingPose::new(*pose);
    let seen = |found: &&FoundCorner| {
        let pixel = keyframe.corners[found.corner].patch.pixel(camera, &pose);
        pixel.is_some_and(|pixel| camera.contains(pixel, TEMPLATE_REACH_PX) && !keyframe.is_masked(pixel))
    };
    found.iter().filter(seen).count() as f64 / keyframe.corners_at_first.max(1) as f64
}

/// A template nearer to the border than this cannot be found.
const TEMPLATE_REACH_PX: f64 = 10.0;
