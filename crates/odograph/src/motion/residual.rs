//! Re-projection residual of one ground point, and its derivatives by the poses of frame and
//! keyframe. Derivation: `docs/math/frame-pose.md`.

use super::Observation;
use super::elevation::Parallax;
use crate::buffer::stored;
use crate::camera::Camera;
use crate::geometry::{GroundPoint, GroundPose};
use nalgebra::{Matrix3, Vector3};

/// Whitened re-projection residual of an observation, and its derivatives. The unit is the pixel of
/// a track with median covariance.
#[derive(Debug, Clone, Copy)]
pub struct Residual {
    pub error: [f64; 2],
    /// Length before whitening, pixels.
    pub distance_px: f64,
    pub by_pose: [[f64; 6]; 2],
    /// Derivative by height, roll and pitch of the keyframe, in units of their prior.
    pub by_keyframe: [[f64; 3]; 2],
    /// Derivative by the elevation of the point, pixels per metre.
    pub by_elevation: [f64; 2],
    /// Components along and across the parallax of the point.
    pub parallax: Parallax,
}

stored!(Residual, [f64; 2]);

impl Residual {
    /// Of a point behind the camera: no error and zero derivatives.
    pub const NONE: Self = Self {
        error: [0.0; 2],
        distance_px: f64::INFINITY,
        by_pose: [[0.0; 6]; 2],
        by_keyframe: [[0.0; 3]; 2],
        by_elevation: [0.0; 2],
        parallax: Parallax::NONE,
    };

    pub fn length(&self) -> f64 {
        (self.error[0] * self.error[0] + self.error[1] * self.error[1]).sqrt()
    }
}

/// The residual of an observation at a pose. `None` where the point is not in front of the lens.
#[inline]
pub fn residual(
    camera: &Camera,
    observation: &Observation,
    pose: &GroundPose,
    axes: &Axes,
) -> Option<Residual> {
    let from_camera = Vector3::new(
        observation.ground.x_m - pose.x_m,
        observation.ground.y_m - pose.y_m,
        observation.elevation.mean_m - pose.height_m,
    );
    let p = axes.camera_from_world * from_camera;
    if p.z <= 1e-9 {
        return None;
    }
    let inverse_depth = 1.0 / p.z;
    let ray = crate::geometry::Ray::new(p.x * inverse_depth, p.y * inverse_depth);
    let (pixel, pixel_by_ray) = camera.pixel_and_derivative(ray)?;
    // One row for each pixel coordinate. The point moves against the camera. A rotation of the
    // camera about a world axis a moves the point by −R (a × d), so a coordinate with derivative g
    // by the point, in world axes, changes by −a · (d × g).
    let row = |i: usize| {
        let (by_x, by_y) = (pixel_by_ray[(i, 0)] * inverse_depth, pixel_by_ray[(i, 1)] * inverse_depth);
        let by_point = Vector3::new(by_x, by_y, -(by_x * ray.x + by_y * ray.y));
        let in_world = axes.camera_from_world.tr_mul(&by_point);
        let moment = from_camera.cross(&in_world);
        [-in_world.x, -in_world.y, -moment.z, -in_world.z, -axes.roll.dot(&moment), -axes.pitch.dot(&moment)]
    };
    let [[xx, yx], [xy, yy]] = observation.whitening.data.0; // column-major
    let whitened = |x: f64, y: f64| [xx * x + xy * y, yx * x + yy * y];
    let (first, second) = (row(0), row(1));
    let mut by_pose = [[0.0; 6]; 2];
    for i in 0..6 {
        [by_pose[0][i], by_pose[1][i]] = whitened(first[i], second[i]);
    }
    let (x, y) = (pixel.x - observation.pixel.x, pixel.y - observation.pixel.y);
    let distance_px = (x * x + y * y).sqrt();
    Some(Residual { error: whitened(x, y), distance_px, by_pose, ..Residual::NONE })
}

/// Rotation of a pose, and the world axes of its roll and pitch. The axis of heading is z.
#[derive(Debug, Clone, Copy)]
pub struct Axes {
    camera_from_world: Matrix3<f64>,
    /// Axis of roll.
    pub roll: Vector3<f64>,
    /// Axis of pitch.
    pub pitch: Vector3<f64>,
}

impl Axes {
    /// The axes of a pose.
    pub fn new(pose: &GroundPose) -> Self {
        let axes = pose.rotation_axes();
        Self {
            camera_from_world: pose.world_from_camera_rotation().transpose(),
            roll: axes.column(1).into_owned(),
            pitch: axes.column(2).into_owned(),
        }
    }
}

/// Derivative of the ground point (x, y) that an observed ray meets by the six numbers of the
/// camera's pose.
pub fn ground_by_pose(observation: &Observation, keyframe_pose: &GroundPose, axes: &Axes) -> [[f64; 6]; 2] {
    let Observation { ground, elevation, .. } = observation;
    ray_by_pose(ground, elevation.mean_m, keyframe_pose, axes)
}

/// Derivative of the ground point (x, y) that a ray meets at an elevation, metres, by the six
/// numbers of the camera's pose.
pub fn ray_by_pose(
    ground: &GroundPoint,
    elevation_m: f64,
    keyframe_pose: &GroundPose,
    axes: &Axes,
) -> [[f64; 6]; 2] {
    let height_m = keyframe_pose.height_m - elevation_m;
    let (x, y) = (ground.x_m - keyframe_pose.x_m, ground.y_m - keyframe_pose.y_m);
    // A rotation about an axis moves the point by axis × (x, y, −h); the second term returns it to
    // the ground along the ray.
    let by_rotation = |axis: &Vector3<f64>| {
        let moved = axis.cross(&Vector3::new(x, y, -height_m));
        [moved.x + x * moved.z / height_m, moved.y + y * moved.z / height_m]
    };
    let (roll, pitch) = (by_rotation(&axes.roll), by_rotation(&axes.pitch));
    [[1.0, 0.0, -y, x / height_m, roll[0], pitch[0]], [0.0, 1.0, x, y / height_m, roll[1], pitch[1]]]
}
