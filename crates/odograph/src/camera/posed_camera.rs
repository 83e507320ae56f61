//! Ground points seen from a pose, with all derivatives.

use super::Camera;
use crate::geometry::{GroundPoint, GroundPose, Pixel, Ray};
use nalgebra::{Matrix2, Matrix2x3, Matrix3, SMatrix, Vector2, Vector3};

/// A camera at a pose over the ground, with its rotation matrix computed once for many points.
#[derive(Clone, Copy)]
pub struct PosedCamera<'a> {
    camera: &'a Camera,
    pose: GroundPose,
    camera_from_world: Matrix3<f64>,
    /// The world axes about which heading, roll and pitch turn.
    heading_axis: Vector3<f64>,
    roll_axis: Vector3<f64>,
    pitch_axis: Vector3<f64>,
}

/// Intersection of a ray with the ground, with its derivatives.
pub struct GroundIntersection {
    /// The ground point.
    pub point: GroundPoint,
    /// By (x, y, heading, height, roll, pitch) of the pose.
    pub by_pose: SMatrix<f64, 2, 6>,
    /// By the ray.
    pub by_ray: Matrix2<f64>,
}

/// Projection of a ground point, with its derivatives.
pub struct ProjectedPoint {
    /// Its direction in the camera.
    pub ray: Ray,
    /// Its pixel.
    pub pixel: Pixel,
    /// By (x, y, heading, height, roll, pitch) of the pose.
    pub by_pose: SMatrix<f64, 2, 6>,
    /// By the ground point.
    pub by_ground: Matrix2<f64>,
}

impl<'a> PosedCamera<'a> {
    /// A camera at a pose.
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

    /// A ground point in the image; `None` if it is not in front of the lens.
    pub fn see(&self, point: GroundPoint) -> Option<ProjectedPoint> {
        let from_camera =
            Vector3::new(point.x_m - self.pose.x_m, point.y_m - self.pose.y_m, -self.pose.height_m);
        let p = self.camera_from_world * from_camera;
        if p.z <= 1e-9 {
            return None;
        }
        let ray = Ray::new(p.x / p.z, p.y / p.z);
        let (pixel, pixel_by_ray) = self.camera.pixel_and_derivative(ray)?;
        let ray_by_point =
            Matrix2x3::new(1.0 / p.z, 0.0, -p.x / (p.z * p.z), 0.0, 1.0 / p.z, -p.y / (p.z * p.z));
        let by_point = pixel_by_ray * ray_by_point * self.camera_from_world;
        // A camera translation moves the point by the opposite; a rotation about a world axis a by
        // −(a × d).
        let mut by_pose = SMatrix::<f64, 2, 6>::zeros();
        by_pose.set_column(0, &-by_point.column(0));
        by_pose.set_column(1, &-by_point.column(1));
        by_pose.set_column(3, &-by_point.column(2));
        for (column, axis) in [(2, &self.heading_axis), (4, &self.roll_axis), (5, &self.pitch_axis)] {
            by_pose.set_column(column, &-(by_point * axis.cross(&from_camera)));
        }
        let by_ground = by_point.fixed_columns::<2>(0).into_owned();
        Some(ProjectedPoint { ray, pixel, by_pose, by_ground })
    }

    /// A ray on the ground; `None` if it does not go downwards.
    pub fn ground(&self, ray: Ray) -> Option<GroundIntersection> {
        let world_from_camera = self.camera_from_world.transpose();
        let direction = world_from_camera * ray.vector();
        if direction.z >= -1e-9 {
            return None;
        }
        let reach = -self.pose.height_m / direction.z;
        let point =
            GroundPoint::new(self.pose.x_m + reach * direction.x, self.pose.y_m + reach * direction.y);
        let slides = |turned: Vector3<f64>| {
            let slide = turned.z / direction.z;
            Vector2::new(reach * (turned.x - slide * direction.x), reach * (turned.y - slide * direction.y))
        };
        let [by_roll, by_pitch] =
            [&self.roll_axis, &self.pitch_axis].map(|axis| slides(axis.cross(&direction)));
        let [by_x, by_y] = [0, 1].map(|k| slides(world_from_camera.column(k).into_owned()));
        let (x, y) = (point.x_m - self.pose.x_m, point.y_m - self.pose.y_m);
        let by_height = Vector2::new(x, y) / self.pose.height_m;
        let by_heading = Vector2::new(-y, x);
        let along = [Vector2::x(), Vector2::y(), by_heading, by_height, by_roll, by_pitch];
        Some(GroundIntersection {
            point,
            by_pose: SMatrix::from_columns(&along),
            by_ray: Matrix2::from_columns(&[by_x, by_y]),
        })
    }
}
