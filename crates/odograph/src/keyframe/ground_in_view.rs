//! The ground that a keyframe sees, where it is not the plane z = 0.

use crate::geometry::GroundPose;
use nalgebra::{Isometry3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// The plane that fits the ground in view best, and how far the ground is off it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundInView {
    /// Height, roll and pitch of the camera over that plane, at its origin.
    pub camera: GroundPose,
    /// Standard deviation of elevations about that plane, metres.
    pub relief_m: f64,
}

impl GroundInView {
    /// Below a camera at `pose`, with the elevation of the plane there, metres, and its slopes
    /// along x and y of the world.
    pub fn new(pose: &GroundPose, elevation_m: f64, (by_x, by_y): (f64, f64), relief_m: f64) -> Self {
        let normal = Vector3::new(-by_x, -by_y, 1.0).normalize();
        let levelled = Rotation3::rotation_between(&normal, &Vector3::z()).unwrap_or_default();
        let turn =
            Isometry3::from_parts(Translation3::identity(), UnitQuaternion::from_rotation_matrix(&levelled));
        let turned = GroundPose::from_world_from_camera(&(turn * pose.world_from_camera()));
        let height_m = (pose.height_m - elevation_m) * normal.z;
        let camera = GroundPose { x_m: 0.0, y_m: 0.0, heading_rad: 0.0, height_m, ..turned };
        Self { camera, relief_m }
    }

    /// The transform to the frame of the plane from that of the ground below a camera at `pose`,
    /// whose x axis is forward.
    pub fn plane_from_ground(&self, pose: &GroundPose) -> Isometry3<f64> {
        let at_origin = GroundPose { x_m: 0.0, y_m: 0.0, heading_rad: 0.0, ..*pose };
        self.camera.world_from_camera() * at_origin.world_from_camera().inverse()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_that_rides_on_a_slope_is_upright_over_it() {
        // 8 % up along its heading, which is across the world's axes: nose up.
        let (slope, heading_rad) = (0.08f64, 0.7f64);
        let pose = GroundPose { x_m: 3.0, y_m: -1.0, heading_rad, ..GroundPose::level(1.0) };
        let pitched = GroundPose { pitch_rad: -slope.atan(), ..pose };
        let slopes = (slope * heading_rad.cos(), slope * heading_rad.sin());
        let ground = GroundInView::new(&pitched, 0.2, slopes, 0.001);
        assert!(ground.camera.roll_rad.abs() < 1e-12 && ground.camera.pitch_rad.abs() < 1e-12);
        assert!((ground.camera.height_m - 0.8 * slope.atan().cos()).abs() < 1e-12);
        // A metre on along the slope.
        let along = ground.plane_from_ground(&pitched);
        let ahead = Vector3::new(slope.atan().cos(), 0.0, 1.0 + slope.atan().sin());
        let there = along * nalgebra::Point3::from(ahead);
        assert!((there.coords - Vector3::new(1.0, 0.0, ground.camera.height_m)).norm() < 1e-9, "{there}");
    }
}
