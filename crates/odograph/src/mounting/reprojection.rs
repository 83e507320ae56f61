//! Ground points seen from a pose, with all derivatives.

use crate::camera::Camera;
use crate::geometry::{GroundPoint, GroundPose, Pixel, Ray};
use nalgebra::{Matrix2, Matrix2x3, Matrix3, SMatrix, Vector3};

/// A camera at a pose over the ground, its rotation worked out once for many points.
pub struct PosedCamera<'a> {
    camera: &'a Camera,
    pose: GroundPose,
    camera_from_world: Matrix3<f64>,
    /// The world axes about which heading, roll and pitch turn.
    heading_axis: Vector3<f64>,
    roll_axis: Vector3<f64>,
    pitch_axis: Vector3<f64>,
}

/// Where a ground point is seen, and how that changes.
pub struct Seen {
    pub pixel: Pixel,
    /// By (x, y, heading, height, roll, pitch) of the pose.
    pub by_pose: SMatrix<f64, 2, 6>,
    /// By the ground point.
    pub by_ground: Matrix2<f64>,
}

impl<'a> PosedCamera<'a> {
    pub fn new(camera: &'a Camera, pose: GroundPose) -> Self {
        let (sin_heading, cos_heading) = pose.heading_rad.sin_cos();
        let (sin_pitch, cos_pitch) = pose.pitch_rad.sin_cos();
        Self {
            camera,
            pose,
            camera_from_world: pose.world_from_camera_rotation().transpose(),
            heading_axis: Vector3::z(),
            pitch_axis: Vector3::new(-sin_heading, cos_heading, 0.0),
            roll_axis: Vector3::new(cos_heading * cos_pitch, sin_heading * cos_pitch, -sin_pitch),
        }
    }

    /// `None` where the point is not in front of the lens.
    pub fn see(&self, point: GroundPoint) -> Option<Seen> {
        let from_camera =
            Vector3::new(point.x_m - self.pose.x_m, point.y_m - self.pose.y_m, -self.pose.height_m);
        let p = self.camera_from_world * from_camera;
        if p.z <= 1e-9 {
            return None;
        }
        let (pixel, pixel_by_ray) = self.camera.pixel_and_derivative(Ray::new(p.x / p.z, p.y / p.z))?;
        let ray_by_point =
            Matrix2x3::new(1.0 / p.z, 0.0, -p.x / (p.z * p.z), 0.0, 1.0 / p.z, -p.y / (p.z * p.z));
        let by_point = pixel_by_ray * ray_by_point * self.camera_from_world;
        // The point moves against the camera; a turn of the camera about a world axis a moves it by −(a × d).
        let mut by_pose = SMatrix::<f64, 2, 6>::zeros();
        by_pose.set_column(0, &-by_point.column(0));
        by_pose.set_column(1, &-by_point.column(1));
        by_pose.set_column(3, &-by_point.column(2));
        for (column, axis) in [(2, &self.heading_axis), (4, &self.roll_axis), (5, &self.pitch_axis)] {
            by_pose.set_column(column, &-(by_point * axis.cross(&from_camera)));
        }
        let by_ground = by_point.fixed_columns::<2>(0).into_owned();
        Some(Seen { pixel, by_pose, by_ground })
    }

    /// Where a ray meets the ground, and the derivative of that by roll and pitch. `None` where the ray does not go downwards.
    pub fn ground(&self, ray: Ray) -> Option<(GroundPoint, Matrix2<f64>)> {
        let direction = self.camera_from_world.transpose() * ray.vector();
        if direction.z >= -1e-9 {
            return None;
        }
        let reach = -self.pose.height_m / direction.z;
        let point =
            GroundPoint::new(self.pose.x_m + reach * direction.x, self.pose.y_m + reach * direction.y);
        let mut by_tilt = Matrix2::zeros();
        for (column, axis) in [(0, &self.roll_axis), (1, &self.pitch_axis)] {
            let turned = axis.cross(&direction);
            let slide = turned.z / direction.z;
            by_tilt[(0, column)] = reach * (turned.x - slide * direction.x);
            by_tilt[(1, column)] = reach * (turned.y - slide * direction.y);
        }
        Some((point, by_tilt))
    }
}
