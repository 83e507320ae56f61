//! Which of a keyframe's corners a camera should see, and which part of them agrees.

use super::super::found_corner::FoundCorner;
use super::super::keyframe::{KeyCorner, Keyframe};
use super::{Measurement, Tracker};
use crate::buffer::Buffer;
use crate::camera::Camera;
use crate::geometry::GroundPose;
use crate::motion::ViewingPose;
use crate::trajectory::LossReason;

impl Measurement {
    /// The same where other corners are fixed in the image and do not count.
    pub fn beside(self, fixed: Buffer<usize>, keyframe: &Keyframe) -> Self {
        let corners = keyframe.corners_at_first.saturating_sub(fixed.len());
        let support = self.estimate.inlier_count() as f64 / corners.max(1) as f64;
        Self { fixed, support, ..self }
    }

    /// Inlier ratio among the keyframe's corners that a camera at the measured pose should see, 0
    /// to 1: low if only something beside the ground was tracked.
    pub fn inlier_ratio(&self, keyframe: &Keyframe, camera: &Camera) -> f64 {
        let estimate = &self.estimate;
        self.agreement.unwrap_or_else(|| {
            let count = |corners: &mut dyn Iterator<Item = &KeyCorner>| {
                in_view(keyframe, corners, camera, &estimate.pose)
            };
            let fixed = count(&mut self.fixed.iter().map(|&corner| &keyframe.corners[corner]));
            let expected = count(&mut keyframe.corners.iter()) - fixed;
            estimate.inlier_count() as f64 / expected.max(1) as f64
        })
    }

    /// Decimal logarithm of the number of false alarms: how often as many tracks would agree
    /// as closely by chance, if they ended anywhere within twice `inlier_px` of their predictions
    /// (L. Moisan and B. Stival, "A probabilistic criterion to detect rigid point matches", 2004).
    /// Tracks begin at their predictions and end near them even where the ground is another.
    pub fn false_alarms(&self, inlier_px: f64) -> f64 {
        let (tracks, inliers) = (self.found.len(), self.estimate.inlier_count());
        false_alarms(tracks, inliers, self.estimate.residual_px / inlier_px)
    }

    /// Whether the inliers stand still in the image although the camera, expected at `to`, should
    /// have moved since the keyframe, as the shadow of the vehicle does.
    pub fn stands_still(&self, keyframe: &Keyframe, camera: &Camera, to: &GroundPose) -> bool {
        const STILL_PX: f64 = 1.0;
        const MOVED_PX: f64 = 6.0;
        const MOST: f64 = 0.6;
        let from = &keyframe.pose;
        let moved_m = to.distance_m(from);
        if moved_m * camera.focal_px().0 < MOVED_PX * to.height_m {
            return false;
        }
        let corner =
            |found: &FoundCorner| (found.warp.position, keyframe.corners[found.corner].template.centre());
        let corners = self.found.iter().map(corner);
        let tiles = self.tiles.iter().map(|tile| (tile.pixel, tile.reference));
        let agree = corners.chain(tiles).zip(&self.estimate.inliers).filter(|(_, agrees)| **agrees);
        // Tiles of a coarse level are found less exactly.
        let still_px = STILL_PX.max(2.0 * self.estimate.residual_px);
        let still = agree.filter(|((now, before), _)| now.distance(*before) < still_px);
        still.count() as f64 > MOST * self.estimate.inlier_count().max(1) as f64
    }
}

/// See [`Measurement::false_alarms`]. `residual` is the root mean square residual over half of the
/// radius within which the tracks end by chance, which it is where they fill that disc evenly.
fn false_alarms(tracks: usize, inliers: usize, residual: f64) -> f64 {
    let chance = residual.powi(2).clamp(1e-9, 1.0);
    let choices: f64 = (1..=inliers).map(|i| ((tracks - inliers + i) as f64 / i as f64).log10()).sum();
    choices + inliers as f64 * chance.log10()
}

impl Tracker<'_> {
    /// Reason of a loss: most of what should be in view was found but does not move as one plane,
    /// or it was found by chance.
    pub fn reason_of_loss(&self, found: &[FoundCorner], prediction: &GroundPose) -> LossReason {
        const MOST: f64 = 0.5;
        let expected = in_view(self.keyframe, self.keyframe.corners.iter(), self.camera, prediction);
        if found.len() as f64 >= MOST * expected as f64 { LossReason::NotPlanar } else { LossReason::Jump }
    }
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
    let tracked = found.iter().map(|found| &keyframe.corners[found.corner]);
    in_view(keyframe, tracked, camera, pose) as f64 / keyframe.corners_at_first.max(1) as f64
}

/// A template nearer to the border than this cannot be found.
const TEMPLATE_REACH_PX: f64 = 10.0;

#[cfg(test)]
mod tests {
    use super::false_alarms;

    #[test]
    fn close_agreement_is_evidence_and_scattered_agreement_is_none() {
        // Certain: all of a few tracks on a point.
        assert!(false_alarms(20, 20, 0.05) < -50.0);
        // Two fifths of the tracks within a quarter of the radius.
        assert!((-20.0..-10.0).contains(&false_alarms(78, 33, 0.285)));
        // Tracks that fill the disc agree by construction, however many they are.
        assert!(false_alarms(118, 51, 1.0) > 0.0);
        assert!(false_alarms(400, 400, 1.2) >= 0.0);
        assert!(false_alarms(0, 0, 0.5) == 0.0);
    }
}
