//! Patches of an image that lie on the ground: where, and in which shape, another camera sees them.

use super::planar_pose::{Axes, ray_by_pose};
use super::rolling_shutter::RollingShutter;
use crate::camera::Camera;
use crate::flow::Warp;
use crate::geometry::{GroundPoint, GroundPose, Pixel, Ray};
use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

/// Five points this far around the centre of a patch of 16x16 samples, a fifth of a turn apart, show where and in which shape it is expected,
/// samples. In their mean a curvature of the warp (a lens is never straight) shifts as much as in the mean of the whole patch, of
/// which the samples are (16² − 1) / 12 from the middle along either side: their squared distance is twice that of both.
const RING: f64 = 6.519_202_405_202_649;

/// How many points. Five tell all that is linear and quadratic about the warp: the first two harmonics around the ring.
const POINTS: usize = 5;

/// Of the ring's points, (right, down) in units of its radius.
const AROUND: [(f64, f64); POINTS] = [
    (1.0, 0.0),
    (0.309_016_994_374_947_45, 0.951_056_516_295_153_5),
    (-0.809_016_994_374_947_5, 0.587_785_252_292_473_1),
    (-0.809_016_994_374_947_5, -0.587_785_252_292_473_1),
    (0.309_016_994_374_947_45, -0.951_056_516_295_153_5),
];

/// A square patch of 16x16 samples on the ground.
#[derive(Debug, Clone, Copy)]
pub struct GroundPatch {
    /// Where its centre lies.
    pub ground: GroundPoint,
    /// How high above the plane z = 0, metres.
    pub elevation_m: f64,
    /// Where the points of the ring around the centre lie.
    ring: [GroundPoint; POINTS],
    /// Pixels from one sample to the next.
    pixels_per_sample: f64,
    /// How the place of its centre changes with the readout time of the image it was taken from,
    /// metres per second.
    pub by_readout: [f64; 2],
}

/// How a patch is expected in an image.
#[derive(Debug, Clone, Copy)]
pub struct PatchWarp {
    /// Of the patch as a whole.
    pub warp: Warp,
    /// How far the patch as a whole is from where its centre is, pixels: Lucas–Kanade finds the whole patch, and what lies on the ground is its
    /// centre. Left out, a lens that bends lines makes every way as much longer as its curvature changes along it.
    pub bend: Vector2<f64>,
    /// The second derivatives of the warp by (right, right), (right, down) and (down, down), pixels by samples².
    pub curvature: [Vector2<f64>; 3],
}

impl GroundPatch {
    /// The patch about `centre` of the image of a camera, its samples `pixels_per_sample` apart. `None` where that is not ground.
    pub fn new(
        camera: &Camera,
        from: &GroundFromRay<'_>,
        centre: Pixel,
        pixels_per_sample: f64,
    ) -> Option<Self> {
        let (ray, around) = rays_about(camera, centre, RING * pixels_per_sample)?;
        let [a, b, c, d, e] = around.map(|ray| from.of(ray));
        let ring = [a?, b?, c?, d?, e?];
        let (ground, elevation_m) = (from.of(ray)?, from.elevation_m);
        Some(Self { ground, elevation_m, ring, pixels_per_sample, by_readout: [0.0; 2] })
    }

    /// The patch about `centre` of an image that a rolling shutter exposed while the middle row was at
    /// `pose`, on ground at an elevation, metres; `axes` are those of that pose.
    pub fn behind_shutter(
        camera: &Camera,
        (pose, axes): (&GroundPose, &Axes),
        shutter: &RollingShutter,
        elevation_m: f64,
        centre: Pixel,
    ) -> Option<Self> {
        let at_row = shutter.pose_at(pose, centre.y);
        let from_ray = GroundFromRay::new(&at_row).at_elevation(elevation_m);
        let mut patch = Self::new(camera, &from_ray, centre, 1.0)?;
        // Above and below the centre the camera was elsewhere; over a patch that is linear.
        let rate = |ground: &GroundPoint| {
            let by_pose = ray_by_pose(ground, elevation_m, pose, axes);
            by_pose.map(|row| row.iter().zip(&shutter.rates).map(|(by, rate)| by * rate).sum::<f64>())
        };
        let seconds_per_row = shutter.readout_s / shutter.rows as f64;
        for (point, (_, down)) in patch.ring.iter_mut().zip(AROUND) {
            let [x_m_s, y_m_s] = rate(point);
            let later_s = seconds_per_row * RING * down;
            *point = GroundPoint::new(point.x_m + later_s * x_m_s, point.y_m + later_s * y_m_s);
        }
        let row_fraction = shutter.row_fraction(centre.y);
        patch.by_readout = rate(&patch.ground).map(|rate| row_fraction * rate);
        Some(patch)
    }

    /// Where a camera at `pose` sees its centre.
    pub fn pixel(&self, camera: &Camera, pose: &ViewingPose) -> Option<Pixel> {
        pose.pixel(camera, self.ground, self.elevation_m)
    }

    /// Where and in which shape a camera at `pose` sees the patch; `None` where it would be out of sight.
    pub fn warp(&self, camera: &Camera, pose: &ViewingPose) -> Option<PatchWarp> {
        let centre = pose.pixel(camera, self.ground, self.elevation_m)?;
        let mut mean = Vector2::zeros();
        let (mut right_left, mut down_up) = (Vector2::zeros(), Vector2::zeros());
        let (mut stretch, mut shear) = (Vector2::zeros(), Vector2::zeros());
        // The harmonics of the ring: least squares.
        for (point, (right, down)) in self.ring.iter().zip(AROUND) {
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
        let per_pixel = 2.0 / (points * RING * self.pixels_per_sample);
        let linear = Matrix2::from_columns(&[right_left * per_pixel, down_up * per_pixel]);
        // Around the ring half of the curvature is constant, the other half turns twice.
        let per_sample2 = 4.0 / (RING * RING);
        let (both, apart) = (mean * (0.5 * per_sample2), stretch * (per_sample2 / points));
        let curvature = [both + apart, shear * (per_sample2 / points), both - apart];
        let position = Pixel::new(centre.x + mean.x, centre.y + mean.y);
        Some(PatchWarp { warp: Warp { position, linear }, bend: mean, curvature })
    }
}

/// The rays of a pixel and of the points a radius around it (pixels): the others by one step of Newton's method from where the derivative at the
/// first puts them, exact to far less than a thousandth of a pixel near the centre.
fn rays_about(camera: &Camera, pixel: Pixel, radius_px: f64) -> Option<(Ray, [Ray; POINTS])> {
    let ray = camera.ray_from_pixel(pixel)?;
    let (_, pixel_by_ray) = camera.pixel_and_derivative(ray)?;
    let ray_by_pixel = pixel_by_ray.try_inverse()?;
    let beside = |(right, down): (f64, f64)| {
        let offset = radius_px * Vector2::new(right, down);
        let guess = ray_by_pixel * offset;
        let guess = Ray::new(ray.x + guess.x, ray.y + guess.y);
        let seen = camera.pixel_from_ray(guess)?;
        let left = ray_by_pixel * Vector2::new(pixel.x + offset.x - seen.x, pixel.y + offset.y - seen.y);
        Some(Ray::new(guess.x + left.x, guess.y + left.y))
    };
    let [a, b, c, d, e] = AROUND.map(beside);
    Some((ray, [a?, b?, c?, d?, e?]))
}

/// A pose with its rotation worked out once for many ground points.
#[derive(Debug, Clone, Copy)]
pub struct ViewingPose {
    pose: GroundPose,
    camera_from_world: Matrix3<f64>,
    shutter: Option<MovingCamera>,
}

/// How points move past a camera while its shutter rolls, in the camera's axes.
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
    /// Where a point at `p` of the camera at the middle row is when its own row is exposed, from the
    /// row and the derivative of its pixel at the middle row's time.
    fn point_at_its_row(&self, p: &Vector3<f64>, (pixel, by_ray): (Pixel, Matrix2<f64>)) -> Vector3<f64> {
        let rate = -self.velocity - self.angular_velocity.cross(p);
        let (x, y) = (rate.x - p.x / p.z * rate.z, rate.y - p.y / p.z * rate.z);
        let rows_per_s = (by_ray[(1, 0)] * x + by_ray[(1, 1)] * y) / p.z;
        // The point moves on while rows are read: later by τ it is τ · rows_per_s rows further down.
        let per_row = self.seconds_per_row / (1.0 - self.seconds_per_row * rows_per_s).max(0.1);
        p + rate * (per_row * (pixel.y - self.middle_row))
    }
}

impl ViewingPose {
    /// Ready to see points.
    pub fn new(pose: GroundPose) -> Self {
        Self { pose, camera_from_world: pose.world_from_camera_rotation().transpose(), shutter: None }
    }

    /// Ready to see points through a rolling shutter; `pose` is that of the middle row.
    pub fn behind_shutter(pose: GroundPose, shutter: &RollingShutter) -> Self {
        let still = Self::new(pose);
        if shutter.is_global() {
            return still;
        }
        let axes = Axes::new(&pose);
        let rates = &shutter.rates;
        let turning = Vector3::z() * rates[2] + axes.roll * rates[4] + axes.pitch * rates[5];
        let velocity = Vector3::new(rates[0], rates[1], rates[3]);
        let moving = MovingCamera {
            velocity: still.camera_from_world * velocity,
            angular_velocity: still.camera_from_world * turning,
            seconds_per_row: shutter.readout_s / shutter.rows as f64,
            middle_row: 0.5 * shutter.rows as f64 - 0.5,
        };
        Self { shutter: Some(moving), ..still }
    }

    /// Where a ground point at an elevation, metres, is seen; may lie outside the image. `None` where
    /// it is not in front of the lens.
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
            Some(moving) => seen(&moving.point_at_its_row(&p, at_middle)).map(|(pixel, _)| pixel),
        }
    }
}

/// [`GroundPose::ground_from_ray`] with the rotation worked out once for many rays.
#[derive(Debug, Clone, Copy)]
pub struct GroundFromRay<'a> {
    pose: &'a GroundPose,
    world_from_camera: Matrix3<f64>,
    elevation_m: f64,
}

impl<'a> GroundFromRay<'a> {
    /// For the rays of a camera at `pose`.
    pub fn new(pose: &'a GroundPose) -> Self {
        Self { pose, world_from_camera: pose.world_from_camera_rotation(), elevation_m: 0.0 }
    }

    /// The same for ground at another elevation above the plane z = 0, metres.
    pub fn at_elevation(self, elevation_m: f64) -> Self {
        Self { elevation_m, ..self }
    }

    /// The ground point that a ray meets; `None` where it does not go downwards.
    pub fn of(&self, ray: Ray) -> Option<GroundPoint> {
        let direction = self.world_from_camera * ray.vector();
        (direction.z < -1e-9).then(|| {
            let reach = (self.elevation_m - self.pose.height_m) / direction.z;
            GroundPoint::new(self.pose.x_m + reach * direction.x, self.pose.y_m + reach * direction.y)
        })
    }
}
