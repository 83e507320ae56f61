//! Corners of a keyframe that move by themselves, as grass in wind does.

use super::super::found_corner::FoundCorner;
use super::super::moving_ground::MovingGround;
use super::Keyframe;
use crate::geometry::GroundPoint;
use crate::motion::MotionEstimate;

/// Root mean square motion of the inliers in the image, pixels, below which they may be fixed to
/// the camera. Four times the 1.5 px below which an image counts as standing still; chosen, not
/// derived.
const MIN_FLOW_PX: f64 = 6.0;

impl Keyframe {
    /// Drops corners that move by themselves, as leaves do, once a frame has been measured. Of what
    /// moves, neither motion nor elevation explains where it is found. While the inliers stand
    /// still in the image, they may be fixed to the camera and the ground be what strays.
    pub fn drop_moving(&mut self, found: &[FoundCorner], frame: &MotionEstimate) {
        let moved_px =
            |found: &FoundCorner| found.warp.position.distance(self.corners[found.corner].template.centre());
        let inliers = || found.iter().zip(&frame.inliers).filter(|(_, inlier)| **inlier);
        let sum_px2: f64 = inliers().map(|(found, _)| moved_px(found).powi(2)).sum();
        if sum_px2 < MIN_FLOW_PX.powi(2) * inliers().count() as f64 {
            return;
        }
        for ((found, seen), agrees) in found.iter().zip(&frame.elevations).zip(&frame.inliers) {
            self.corners[found.corner].strays.add(!agrees && !seen.is_plausible);
        }
        let moving = || self.corners.iter().filter(|corner| corner.strays.moves());
        let count = moving().count();
        if self.moving.accepts(count, self.corners.len()) {
            self.moving.extend(moving().map(|corner| corner.patch.ground));
            self.corners.retain(|corner| !corner.strays.moves());
            self.corners_at_first -= count;
        }
    }

    /// Drops corners that do not lie on the ground.
    pub fn drop_corners(&mut self, dropped: &[usize]) {
        let mut index = 0..;
        self.corners.retain(|_| index.next().is_none_or(|index| !dropped.contains(&index)));
        self.corners_at_first -= dropped.len();
    }

    /// What is known of ground that moves by itself, for the next keyframe.
    pub fn moving_ground(&self) -> MovingGround {
        let centre = GroundPoint { x_m: self.pose.x_m, y_m: self.pose.y_m };
        let still = self.corners.iter().filter(|corner| corner.strays.is_still());
        self.moving.next(centre, self.pose.height_m, still.map(|corner| corner.patch.ground))
    }
}
