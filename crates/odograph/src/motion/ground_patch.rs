//! Image patches on the ground plane: their warp into another camera's image.

use super::elevation::along_ray;
use super::residual::{Axes, ray_by_pose};
use super::rolling_shutter::RollingShutter;
use crate::camera::Camera;
use crate::flow::Warp;
use crate::geometry::{GroundPoint, GroundPose, Pixel, Ray};
use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

/// Radius of a ring of five points around the centre of a patch of 16×16 samples, which give its
/// warp, samples. Derived: the mean squared distance of the ring from the centre is that of the
/// samples, 2 (16² − 1) / 12, so that a curvature of the warp shifts the mean of both equally.
const RING_RADIUS: f64 = 6.519_202_405_202_649;

/// Number of points. Five determine the linear and quadratic parts of the warp: the first two
/// harmonics around the ring.
const POINTS: usize = 5;

/// Directions of the points, (right, down).
const RING_DIRECTIONS: [(f64, f64); POINTS] = [
    (1.0, 0.0),
    (0.309_016_994_374_947_45, 0.951_056_516_295_153_5),
    (-0.809_016_994_374_947_5, 0.587_785_252_292_473_1),
    (-0.809_016_994_374_947_5, -0.587_785_252_292_473_1),
    (0.309_016_994_374_947_45, -0.951_056_516_295_153_5),
];

/// A square patch of 16x16 samples on the ground.
#[derive(Debug, Clone, Copy)]
pub struct GroundPatch {
    /// The ground point of its centre.
    pub ground: GroundPoint,
    /// Elevation of the centre above the plane z = 0, metres.
    pub elevation_m: f64,
    /// Position of the camera when the row of the centre was exposed, metres.
    pub centre_of_projection: Vector3<f64>,
    /// Ground points of the ring.
    ring: [GroundPoint; POINTS],
    /// Sampling distance, pixels.
    pixels_per_sample: f64,
    /// Derivative of the centre's ground point by the readout time of its image, metres per second.
    pub by_readout: [f64; 2],
}

/// Predicted warp of a patch into an image.
#[derive(Debug, Clone, Copy)]
pub struct PatchWarp {
    /// Affine warp; its position is that of the mean of the patch.
    pub warp: Warp,
    /// Mean displacement of the patch by the curvature of the warp, pixels. Lucas–Kanade finds the
    /// mean of the patch, but the ground point is that of its centre; without this correction a
    /// distorting lens would make distances wrong.
    pub curvature_offset: Vector2<f64>,
    /// Second derivatives of the warp by (right, right), (right, down) and (down, down), pixels per
    /// sample².
    pub curvature: [Vector2<f64>; 3],
}

impl GroundPatch {
    /// The patch around `centre` with samples `pixels_per_sample` apart. `None` where that is not
    /// ground.
    pub fn new(
        camera: &Camera,
        from: &GroundFromRay<'_>,
        centre: Pixel,
        pixels_per_sample: f64,
    ) -> Option<Self> {
        let (ray, around) = rays_about(camera, centre, RING_RADIUS * pixels_per_sample)?;
        let [a, b, c, d, e] = around.map(|ray| from.of(ray));
        let ring = [a?, b?, c?, d?, e?];
        let GroundPose { x_m, y_m, height_m, .. } = *from.pose;
        Some(Self {
            ground: from.of(ray)?,
            elevation_m: from.elevation_m,
            centre_of_projection: Vector3::new(x_m, y_m, height_m),
            ring,
            pixels_per_sample,
            by_readout: [0.0; 2],
        })
    }

    /// The patch around `centre` of a rolling-shutter image whose middle row was exposed at `pose`,
    /// on ground at an elevation, metres; `axes` are those of that pose.
    pub fn with_rolling_shutter(
        camera: &Camera,
        (pose, axes): (&GroundPose, &Axes),
        shutter: &RollingShutter,
        elevation_m: f64,
        centre: Pixel,
    ) -> Option<Self> {
        let at_row = shutter.pose_at(pose, centre.y);
        let from_ray = GroundFromRay::new(&at_row).at_elevation(elevation_m);
        let mut patch = Self::new(camera, &from_ray, centre, 1.0)?;
        // Rows above and below the centre were exposed at other poses; over a patch the change is
        // linear.
        let rate = |ground: &GroundPoint| {
            let by_pose = ray_by_pose(ground, elevation_m, pose, axes);
            by_pose.map(|row| row.iter().zip(&shutter.rates).map(|(by, rate)| by * rate).sum::<f64>())
        };
        let seconds_per_row = shutter.readout_s / shutter.rows as f64;
        for (point, (_, down)) in patch.ring.iter_mut().zip(RING_DIRECTIONS) {
            let [x_m_s, y_m_s] = rate(point);
            let dt_s = seconds_per_row * RING_RADIUS * down;
            *point = GroundPoint::new(point.x_m + dt_s * x_m_s, point.y_m + dt_s * y_m_s);
        }
        let row_fraction = shutter.row_fraction(centre.y);
        patch.by_readout = rate(&patch.ground).map(|rate| row_fraction * rate);
        Some(patch)
    }

    /// The centre's ground point at another elevation, metres, on the same ray.
    pub fn at_elevation(&self, to_m: f64) -> GroundPoint {
        along_ray(&self.centre_of_projection, self.ground, self.elevation_m, to_m)
    }

    /// Pixel of the centre for a camera at `pose`.
    pub fn pixel(&self, camera: &Camera, pose: &ViewingPose) -> Option<Pixel> {
        pose.pixel(camera, self.ground, self.elevation_m)
    }

    /// Warp of the patch into the image of a camera at `pose`; `None` where it is behind the
    /// camera.
    pub fn warp(&self, camera: &Camera, pose: &ViewingPose) -> Option<PatchWarp> {
        let centre = pose.pixel(camera, self.ground, self.elevation_m)?;
        let mut mean = Vector2::zeros();
        let (mut right_left, mut down_up) = (Vector2::zeros(), Vector2::zeros());
        let (mut stretch, mut shear) = (Vector2::zeros(), Vector2::zeros());
        // Harmonics of the ring: least squares.
        for (point, (right, down)) in self.ring.iter().zip(RING_DIRECTIONS) {
            let pixel = pose.pixel(camera, *point, self.elevation_m)?;
            let from_centre = Vector2::new(pixel.x - centre.x, pixel.y - centre.y);
            mean += from_centre;
            right_left += from_centre * right;
            down_up += from_centre * down;
            stretch += from_centre * (right * right - down * down);
            shear += from_centre * (2.0 * right * down);
        }
        let points = POINTS as f64;
        mean /= points;
        let per_pixel = 2.0 / (points * RING_RADIUS * self.pixels_per_sample);
        let linear = Matrix2::from_columns(&[right_left * per_pixel, down_up * per_pixel]);
        // Half of the curvature is the zeroth harmonic of the ring, the other half the second.
        let per_sample2 = 4.0 / (RING_RADIUS * RING_RADIUS);
        let (isotropic, anisotropic) = (mean * (0.5 * per_sample2), stretch * (per_sample2 / points));
        let curvature = [isotropic + anisotropic, shear * (per_sample2 / points), isotropic - anisotropic];
        let position = Pixel::new(centre.x + mean.x, centre.y + mean.y);
        Some(PatchWarp { warp: Warp { position, linear }, curvature_offset: mean, curvature })
    }
}

/// Rays of a pixel and of the points at a radius around it (pixels), by one step of Newton's method
/// from the linear prediction: exact to far less than 0.001 px near the centre.
fn rays_about(camera: &Camera, pixel: Pixel, radius_px: f64) -> Option<(Ray, [Ray; POINTS])> {
    let ray = camera.ray_from_pixel(pixel)?;
    let (_, pixel_by_ray) = camera.pixel_and_derivative(ray)?;
    let ray_by_pixel = pixel_by_ray.try_inverse()?;
    let ray_at = |(right, down): (f64, f64)| {
        let offset = radius_px * Vector2::new(right, down);
        let initial = ray_by_pixel * offset;
        let initial = Ray::new(ray.x + initial.x, ray.y + initial.y);
        let seen = camera.pixel_from_ray(initial)?;
        let remaining = ray_by_pixel * Vector2::new(pixel.x + offset.x - seen.x, pixel.y + offset.y - seen.y);
        Some(Ray::new(initial.x + remaining.x, initial.y + remaining.y))
    };
    let [a, b, c, d, e] = RING_DIRECTIONS.map(ray_at);
    Some((ray, [a?, b?, c?, d?, e?]))
}

/// A pose with precomputed rotation, for projecting many ground points.
#[derive(Debug, Clone, Copy)]
pub struct ViewingPose {
    pose: GroundPose,
    camera_from_world: Matrix3<f64>,
    shutter: Option<MovingCamera>,
}

/// Motion of a camera with a rolling shutter, in the camera's axes.
#[derive(Debug, Clone, Copy)]
struct MovingCamera {
    /// Velocity of the camera, metres per second.
    velocity: Vector3<f64>,
    /// Angular velocity of the camera, radians per second.
    angular_velocity: Vector3<f64>,
    seconds_per_row: f64,
    middle_row: f64,
}

impl MovingCamera {
    /// Position of a point when its own row is exposed, from its position `p` when the middle row
    /// is, and the pixel and its derivative there.
    fn point_at_its_row(&self, p: &Vector3<f64>, (pixel, by_ray): (Pixel, Matrix2<f64>)) -> Vector3<f64> {
        let rate = -self.velocity - self.angular_velocity.cross(p);
        let (x, y) = (rate.x - p.x / p.z * rate.z, rate.y - p.y / p.z * rate.z);
        let rows_per_s = (by_ray[(1, 0)] * x + by_ray[(1, 1)] * y) / p.z;
        // The point moves while rows are read: after τ seconds it is τ · rows_per_s rows further
        // down.
        let per_row = self.seconds_per_row / (1.0 - self.seconds_per_row * rows_per_s).max(0.1);
        p + rate * (per_row * (pixel.y - self.middle_row))
    }
}

impl ViewingPose {
    /// For a global shutter.
    pub fn new(pose: GroundPose) -> Self {
        Self { pose, camera_from_world: pose.world_from_camera_rotation().transpose(), shutter: None }
    }

    /// For a rolling shutter; `pose` is that of the middle row.
    pub fn with_rolling_shutter(pose: GroundPose, shutter: &RollingShutter) -> Self {
        let global = Self::new(pose);
        if shutter.is_global() {
            return global;
        }
        let axes = Axes::new(&pose);
        let rates = &shutter.rates;
        let angular_velocity = Vector3::z() * rates[2] + axes.roll * rates[4] + axes.pitch * rates[5];
        let velocity = Vector3::new(rates[0], rates[1], rates[3]);
        let rolling = MovingCamera {
            velocity: global.camera_from_world * velocity,
            angular_velocity: global.camera_from_world * angular_velocity,
            seconds_per_row: shutter.readout_s / shutter.rows as f64,
            middle_row: 0.5 * shutter.rows as f64 - 0.5,
        };
        Self { shutter: Some(rolling), ..global }
    }

    /// Pixel of a ground point at an elevation, metres; may lie outside the image. `None` where the
    /// point is not in front of the lens.
    pub fn pixel(&self, camera: &Camera, point: GroundPoint, elevation_m: f64) -> Option<Pixel> {
        let from_camera = Vector3::new(
            point.x_m - self.pose.x_m,
            point.y_m - self.pose.y_m,
            elevation_m - self.pose.height_m,
        );
        let p = self.camera_from_world * from_camera;
        let seen = |p: &Vector3<f64>| {
            (p.z > 1e-9).then(|| camera.pixel_and_derivative(Ray::new(p.x / p.z, p.y / p.z)))?
        };
        let at_middle = seen(&p)?;
        match &self.shutter {
            None => Some(at_middle.0),
            Some(rolling) => seen(&rolling.point_at_its_row(&p, at_middle)).map(|(pixel, _)| pixel),
        }
    }
}

/// [`GroundPose::ground_from_ray`] with precomputed rotation, for many rays.
#[derive(Debug, Clone, Copy)]
pub struct GroundFromRay<'a> {
    pose: &'a GroundPose,
    world_from_camera: Matrix3<f64>,
    elevation_m: f64,
}

impl<'a> GroundFromRay<'a> {
    /// For the rays of a camera at `pose`, on the plane z = 0.
    pub fn new(pose: &'a GroundPose) -> Self {
        Self { pose, world_from_camera: pose.world_from_camera_rotation(), elevation_m: 0.0 }
    }

    /// For ground at another elevation above the plane z = 0, metres.
    pub fn at_elevation(self, elevation_m: f64) -> Self {
        Self { elevation_m, ..self }
    }

    /// The ground point that a ray meets; `None` where it does not go downwards.
    pub fn of(&self, ray: Ray) -> Option<GroundPoint> {
        let direction = self.world_from_camera * ray.vector();
        (direction.z < -1e-9).then(|| {
            let distance = (self.elevation_m - self.pose.height_m) / direction.z;
            GroundPoint::new(self.pose.x_m + distance * direction.x, self.pose.y_m + distance * direction.y)
        })
    }
}
