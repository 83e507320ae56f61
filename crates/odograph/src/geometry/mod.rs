//! Coordinate frames, points and poses.
//!
//! * **Image**: pixels; `x` right, `y` down; integer coordinates are pixel centres ([`Pixel`]).
//! * **Camera**: x right, y down, z forward along the optical axis, metres. A direction in this
//!   frame is a [`Ray`] `(x, y, 1)`.
//! * **World**: z up, ground plane z = 0, metres. The origin is the ground point below the first
//!   camera position; x is the upward direction of the first image, y points to the left. Heading
//!   is positive counter-clockwise seen from above.
//!
//! Transforms are named `target_from_source`. All conventions are in `docs/math/frames.md`.

mod earth;
mod placement;
mod planar;

pub use earth::{EarthPosition, TangentPlane};
pub use placement::Placement;
pub use planar::{PlaneTransform, Se2, Sim2, WithCovariance, propagated};

use nalgebra::{Isometry3, Matrix3, Matrix6, Rotation3, Translation3, UnitQuaternion, Vector3, Vector6};
use pose_index::{HEIGHT, X, Y};
use serde::{Deserialize, Serialize};

/// A point in the original (distorted) camera image, in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pixel {
    /// Horizontal coordinate, positive to the right; 0 is the centre of the leftmost column.
    pub x: f64,
    /// Vertical coordinate, positive downwards; 0 is the centre of the top row.
    pub y: f64,
}

impl Pixel {
    /// The point (`x`, `y`), in pixels.
    pub fn new(x: f64, y: f64) -> Self {
        Self { x, y }
    }

    /// Euclidean distance to another pixel, in pixels.
    pub fn distance(self, other: Self) -> f64 {
        length(self.x - other.x, self.y - other.y)
    }
}

/// Euclidean length of the vector (`x`, `y`), bit-identical on every machine. `hypot` is not: C
/// libraries round it differently, and no length here needs its protection against overflow and
/// underflow.
pub fn length(x: f64, y: f64) -> f64 {
    (x * x + y * y).sqrt()
}

/// A viewing direction in the camera frame, the vector (`x`, `y`, 1): undistorted normalised image
/// coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Tangent of the horizontal angle from the optical axis, positive to the right.
    pub x: f64,
    /// Tangent of the vertical angle from the optical axis, positive downwards.
    pub y: f64,
}

impl Ray {
    /// The direction (`x`, `y`, 1).
    pub fn new(x: f64, y: f64) -> Self {
        Self { x, y }
    }

    /// The direction as a vector with z = 1.
    pub fn vector(self) -> Vector3<f64> {
        Vector3::new(self.x, self.y, 1.0)
    }
}

/// A point on the ground plane (world z = 0), in metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GroundPoint {
    /// World x: the upward direction of the first image.
    pub x_m: f64,
    /// World y: to the left in the first image.
    pub y_m: f64,
}

impl GroundPoint {
    /// The ground point (`x_m`, `y_m`).
    pub fn new(x_m: f64, y_m: f64) -> Self {
        Self { x_m, y_m }
    }

    /// Distance to another ground point, in metres.
    pub fn distance(self, other: Self) -> f64 {
        length(self.x_m - other.x_m, self.y_m - other.y_m)
    }
}

/// The pose of a camera above the ground plane: six degrees of freedom.
///
/// `world_from_camera` has the translation (x, y, height) and the rotation `Rz(heading) · Ry(pitch)
/// · Rx(roll) · N`, where `N` ([`nadir_from_camera`]) is a camera that looks straight down with the
/// top of its image forward. With roll = pitch = 0 the optical axis is vertical.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GroundPose {
    /// World x of the camera centre, metres.
    pub x_m: f64,
    /// World y of the camera centre, metres.
    pub y_m: f64,
    /// Direction of the image's top, counter-clockwise from world x, radians; not wrapped.
    pub heading_rad: f64,
    /// Height of the camera centre above the ground plane, metres, positive.
    pub height_m: f64,
    /// Rotation about the forward axis, right-handed, radians: positive when the camera's left side
    /// is raised.
    pub roll_rad: f64,
    /// Rotation about the left axis, right-handed, radians: positive when the optical axis meets
    /// the ground behind the camera.
    pub pitch_rad: f64,
}

/// Where each number stands in the vector and the covariance of a [`GroundPose`]. Those of an
/// [`Se2`] are the first three; a [`Sim2`] has the logarithm of its scale in the place of the
/// height.
pub mod pose_index {
    /// World x, metres.
    pub const X: usize = 0;
    /// World y, metres.
    pub const Y: usize = 1;
    /// Heading, radians.
    pub const HEADING: usize = 2;
    /// Height above the ground, metres.
    pub const HEIGHT: usize = 3;
    /// Logarithm of the scale of a [`Sim2`](super::Sim2).
    pub const LN_SCALE: usize = 3;
    /// Roll, radians.
    pub const ROLL: usize = 4;
    /// Pitch, radians.
    pub const PITCH: usize = 5;
}

/// Rotation of a nadir camera: it looks straight down, the top of its image along world x.
pub fn nadir_from_camera() -> Matrix3<f64> {
    Matrix3::new(0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0)
}

impl GroundPose {
    /// The same place and heading at the height and tilt of another pose.
    pub fn with_mount_of(self, mount: &Self) -> Self {
        Self { x_m: self.x_m, y_m: self.y_m, heading_rad: self.heading_rad, ..*mount }
    }

    /// A level camera at `height_m` above the world origin.
    pub fn level(height_m: f64) -> Self {
        Self { x_m: 0.0, y_m: 0.0, heading_rad: 0.0, height_m, roll_rad: 0.0, pitch_rad: 0.0 }
    }

    /// The pose as the vector (x, y, heading, height, roll, pitch), metres and radians.
    pub fn to_vector(&self) -> Vector6<f64> {
        Vector6::new(self.x_m, self.y_m, self.heading_rad, self.height_m, self.roll_rad, self.pitch_rad)
    }

    /// The pose of a vector in the order of [`GroundPose::to_vector`].
    pub fn from_vector(numbers: &Vector6<f64>) -> Self {
        let [x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad] = (*numbers).into();
        Self { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad }
    }

    /// Distance to another pose over the ground, metres.
    pub fn distance_m(&self, other: &Self) -> f64 {
        (self.x_m - other.x_m).hypot(self.y_m - other.y_m)
    }

    /// The rigid transform `world_from_camera` of the plane: position and heading.
    pub fn se2(&self) -> Se2 {
        Se2::new(self.x_m, self.y_m, self.heading_rad)
    }

    /// The similarity of the plane that maps this pose to `to`; its scale is the ratio of the
    /// heights.
    pub fn similarity_to(&self, to: &Self) -> Sim2 {
        let turned = Sim2::about_origin(to.heading_rad - self.heading_rad, to.height_m / self.height_m);
        let (x_m, y_m) = turned.rotate(self.x_m, self.y_m);
        Sim2 { x_m: to.x_m - x_m, y_m: to.y_m - y_m, ..turned }
    }

    /// How a pose that is measured against this one, which is `to`, moves with the six numbers of
    /// this one: its ground is shifted, turned and scaled with its height.
    pub fn lever_arm_to(&self, to: &Self) -> Matrix6<f64> {
        let mut by_self = Matrix6::identity();
        let (dx_m, dy_m) = (to.x_m - self.x_m, to.y_m - self.y_m);
        by_self.fixed_view_mut::<4, 4>(0, 0).copy_from(&Sim2::lever_arm(dx_m, dy_m));
        // By the height, not by its logarithm.
        by_self[(X, HEIGHT)] /= self.height_m;
        by_self[(Y, HEIGHT)] /= self.height_m;
        by_self
    }

    /// The pose at a share of the way to `to`, 0 to 1, by the shorter turn; roll and pitch stay.
    pub fn interpolated(&self, to: &Self, share: f64) -> Self {
        let between = |from: f64, to: f64| from + share * (to - from);
        Self {
            x_m: between(self.x_m, to.x_m),
            y_m: between(self.y_m, to.y_m),
            heading_rad: self.heading_rad + share * wrap_angle(to.heading_rad - self.heading_rad),
            height_m: between(self.height_m, to.height_m),
            ..*self
        }
    }

    /// Rotation matrix from camera to world coordinates.
    pub fn world_from_camera_rotation(&self) -> Matrix3<f64> {
        let turn = Rotation3::from_euler_angles(self.roll_rad, self.pitch_rad, self.heading_rad);
        turn.matrix() * nadir_from_camera()
    }

    /// The camera centre in world coordinates, metres.
    pub fn position(&self) -> Vector3<f64> {
        Vector3::new(self.x_m, self.y_m, self.height_m)
    }

    /// The pose as a rigid transform.
    pub fn world_from_camera(&self) -> Isometry3<f64> {
        let rotation = Rotation3::from_matrix_unchecked(self.world_from_camera_rotation());
        Isometry3::from_parts(
            Translation3::from(self.position()),
            UnitQuaternion::from_rotation_matrix(&rotation),
        )
    }

    /// The same pose in the axes of vehicles, as a rigid transform: x forward (the direction of the
    /// heading), y left, z up (ROS REP-103), so that roll, pitch and heading are the Euler angles
    /// of its rotation.
    pub fn world_from_body(&self) -> Isometry3<f64> {
        let turn = Rotation3::from_euler_angles(self.roll_rad, self.pitch_rad, self.heading_rad);
        Isometry3::from_parts(
            Translation3::from(self.position()),
            UnitQuaternion::from_rotation_matrix(&turn),
        )
    }

    /// The pose of [`GroundPose::world_from_body`], up to full turns of the heading.
    pub fn from_world_from_body(world_from_body: &Isometry3<f64>) -> Self {
        let (roll_rad, pitch_rad, heading_rad) = world_from_body.rotation.euler_angles();
        let t = &world_from_body.translation.vector;
        Self { x_m: t.x, y_m: t.y, heading_rad, height_m: t.z, roll_rad, pitch_rad }
    }

    /// Axes about which heading, roll and pitch turn, in world coordinates, as columns in this
    /// order.
    pub fn rotation_axes(&self) -> Matrix3<f64> {
        let (sin_heading, cos_heading) = self.heading_rad.sin_cos();
        let (sin_pitch, cos_pitch) = self.pitch_rad.sin_cos();
        Matrix3::from_columns(&[
            Vector3::z(),
            Vector3::new(cos_heading * cos_pitch, sin_heading * cos_pitch, -sin_pitch),
            Vector3::new(-sin_heading, cos_heading, 0.0),
        ])
    }

    /// The pose of a rigid transform: the inverse of [`GroundPose::world_from_camera`] up to full
    /// turns of the heading.
    pub fn from_world_from_camera(world_from_camera: &Isometry3<f64>) -> Self {
        let rotation = world_from_camera.rotation.to_rotation_matrix();
        let turn = Rotation3::from_matrix_unchecked(rotation.matrix() * nadir_from_camera().transpose());
        let (roll_rad, pitch_rad, heading_rad) = turn.euler_angles();
        let t = &world_from_camera.translation.vector;
        Self { x_m: t.x, y_m: t.y, heading_rad, height_m: t.z, roll_rad, pitch_rad }
    }

    /// Intersection of a viewing ray with the ground plane; `None` where the ray does not point
    /// downwards.
    pub fn ground_from_ray(&self, ray: Ray) -> Option<GroundPoint> {
        let direction = self.world_from_camera_rotation() * ray.vector();
        (direction.z < -1e-9).then(|| {
            let reach = -self.height_m / direction.z;
            GroundPoint::new(self.x_m + reach * direction.x, self.y_m + reach * direction.y)
        })
    }

    /// The viewing ray towards a ground point; `None` where the point is not in front of the
    /// camera.
    pub fn ray_from_ground(&self, point: GroundPoint) -> Option<Ray> {
        let from_camera = Vector3::new(point.x_m - self.x_m, point.y_m - self.y_m, -self.height_m);
        let in_camera = self.world_from_camera_rotation().transpose() * from_camera;
        (in_camera.z > 1e-9).then(|| Ray::new(in_camera.x / in_camera.z, in_camera.y / in_camera.z))
    }
}

/// The angle wrapped into (−π, π], radians.
pub fn wrap_angle(angle_rad: f64) -> f64 {
    let turn = std::f64::consts::TAU;
    let wrapped = angle_rad.rem_euclid(turn);
    if wrapped > std::f64::consts::PI { wrapped - turn } else { wrapped }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn level_camera_sees_forward_at_top_and_left_at_left() {
        let pose = GroundPose::level(2.0);
        let top = pose.ground_from_ray(Ray::new(0.0, -0.5)).unwrap();
        assert!((top.x_m - 1.0).abs() < 1e-12 && top.y_m.abs() < 1e-12);
        let left = pose.ground_from_ray(Ray::new(-0.5, 0.0)).unwrap();
        assert!(left.x_m.abs() < 1e-12 && (left.y_m - 1.0).abs() < 1e-12);
    }

    #[test]
    fn positive_pitch_looks_backwards_and_positive_roll_looks_left() {
        let back = GroundPose { pitch_rad: 0.1, ..GroundPose::level(1.0) }
            .ground_from_ray(Ray::new(0.0, 0.0))
            .unwrap();
        assert!((back.x_m + 0.1f64.tan()).abs() < 1e-12, "{back:?}");
        let side = GroundPose { roll_rad: 0.1, ..GroundPose::level(1.0) }
            .ground_from_ray(Ray::new(0.0, 0.0))
            .unwrap();
        assert!((side.y_m - 0.1f64.tan()).abs() < 1e-12, "{side:?}");
    }

    prop_compose! {
        fn poses()(x_m in -5.0..5.0, y_m in -5.0..5.0, heading_rad in -3.1..3.1, height_m in 0.1..10.0,
                   roll_rad in -0.6..0.6, pitch_rad in -0.6..0.6) -> GroundPose {
            GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad }
        }
    }

    proptest! {
        #[test]
        fn a_pose_round_trips_through_a_transform(pose in poses()) {
            let back = GroundPose::from_world_from_camera(&pose.world_from_camera());
            for (a, b) in [(pose.x_m, back.x_m), (pose.y_m, back.y_m), (pose.height_m, back.height_m),
                           (pose.heading_rad, back.heading_rad), (pose.roll_rad, back.roll_rad), (pose.pitch_rad, back.pitch_rad)] {
                prop_assert!((a - b).abs() < 1e-9);
            }
        }

        #[test]
        fn a_ray_round_trips_over_the_ground(pose in poses(), x in -0.5..0.5, y in -0.5..0.5) {
            if let Some(point) = pose.ground_from_ray(Ray::new(x, y)) {
                let back = pose.ray_from_ground(point).unwrap();
                prop_assert!((back.x - x).abs() < 1e-9 && (back.y - y).abs() < 1e-9);
            }
        }

        #[test]
        fn wrapped_angles_keep_their_direction(angle in -100.0..100.0f64) {
            let wrapped = wrap_angle(angle);
            prop_assert!(wrapped > -std::f64::consts::PI - 1e-12 && wrapped <= std::f64::consts::PI);
            prop_assert!((wrapped.sin() - angle.sin()).abs() < 1e-9 && (wrapped.cos() - angle.cos()).abs() < 1e-9);
        }
    }
}
