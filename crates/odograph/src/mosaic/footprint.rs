//! The footprint: the ground that a camera sees at a usable resolution from a pose.

use crate::camera::Camera;
use crate::geometry::{GroundPoint, GroundPose, Pixel, Ray};
use nalgebra::{Matrix2, Matrix2x3, Matrix3, Vector3};

/// Cells of the grid that stands for an image, on each side: more follow the outline better and
/// take longer.
const GRID: usize = 20;
/// Minimum pixels per metre of ground, as a share of that at the image centre: lower shows more
/// ground towards the horizon, blurred.
const MIN_DENSITY: f64 = 0.25;

/// The rays of a grid of pixels, from border to border of the image; they cost an iteration each
/// and change only with the camera.
#[derive(Debug, Clone)]
pub(super) struct Footprint {
    camera: Camera,
    rays: Vec<Option<Ray>>,
}

impl Footprint {
    /// The footprint of this camera, kept in `cache` as long as the camera stays the same.
    pub fn of<'a>(cache: &'a mut Option<Self>, camera: &Camera) -> &'a Self {
        if cache.as_ref().is_some_and(|known| known.camera != *camera) {
            *cache = None;
        }
        cache.get_or_insert_with(|| {
            let at = |index: usize, size: usize| index as f64 * (size as f64 - 1.0) / GRID as f64;
            let ray = |k: usize| {
                let (column, row) = (k % (GRID + 1), k / (GRID + 1));
                camera.ray_from_pixel(Pixel::new(at(column, camera.width()), at(row, camera.height())))
            };
            Self { camera: camera.clone(), rays: (0..(GRID + 1) * (GRID + 1)).map(ray).collect() }
        })
    }

    /// Where the grid meets the ground, `None` where it does not or is seen too coarsely.
    fn grid(&self, view: &GroundCamera<'_>) -> Vec<Option<GroundPoint>> {
        let ground = |ray: &Option<Ray>| {
            let point = view.pose.ground_from_ray((*ray)?)?;
            view.look(point).map(|_| point)
        };
        self.rays.iter().map(ground).collect()
    }

    /// The ground points of the grid.
    pub fn ground_points(&self, view: &GroundCamera<'_>) -> impl Iterator<Item = GroundPoint> + use<> {
        self.grid(view).into_iter().flatten()
    }

    /// The least and the greatest x and y of the footprint, with a margin of the widest mesh of the
    /// grid.
    pub fn bounds(&self, view: &GroundCamera<'_>) -> Option<(GroundPoint, GroundPoint)> {
        let grid = self.grid(view);
        let mut widest: f64 = 0.0;
        for (k, point) in grid.iter().enumerate() {
            let right = grid.get(k + 1).filter(|_| k % (GRID + 1) != GRID);
            for neighbour in [right, grid.get(k + GRID + 1)].into_iter().flatten() {
                if let (Some(a), Some(b)) = (point, neighbour) {
                    widest = widest.max(a.distance(*b));
                }
            }
        }
        grid.into_iter()
            .flatten()
            .map(|p| (p, p))
            .reduce(|(low, high), (p, _)| {
                (
                    GroundPoint::new(low.x_m.min(p.x_m), low.y_m.min(p.y_m)),
                    GroundPoint::new(high.x_m.max(p.x_m), high.y_m.max(p.y_m)),
                )
            })
            .map(|(low, high)| {
                (
                    GroundPoint::new(low.x_m - widest, low.y_m - widest),
                    GroundPoint::new(high.x_m + widest, high.y_m + widest),
                )
            })
    }
}

/// A camera at a pose, which projects ground points with the resolution at which it sees them.
pub(super) struct GroundCamera<'a> {
    camera: &'a Camera,
    pose: &'a GroundPose,
    camera_from_world: Matrix3<f64>,
    position: Vector3<f64>,
    /// Pixels a metre in the middle of the image: in the direction where there are fewest, and the
    /// geometric mean of both.
    centre_density: (f64, f64),
}

/// Where a ground point is in the image and how finely it is seen.
#[derive(Debug, Clone, Copy)]
pub(super) struct GroundSample {
    /// Pixel coordinates; may lie outside the image.
    pub x: f64,
    pub y: f64,
    /// Pixels a metre in the direction where there are fewest, as a share of that in the middle.
    density: f64,
}

impl GroundSample {
    /// Weight of this view of the point, up to 1.
    pub fn quality(&self) -> f64 {
        self.density.min(1.0).powi(2)
    }
}

impl<'a> GroundCamera<'a> {
    /// `None` where the pose is not finite or the middle of the image does not look at the ground.
    pub fn new(camera: &'a Camera, pose: &'a GroundPose) -> Option<Self> {
        let GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad } = *pose;
        let finite = [x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad].iter().all(|v| v.is_finite());
        if !finite || height_m <= 0.0 {
            return None;
        }
        let mut view = Self {
            camera,
            pose,
            camera_from_world: pose.world_from_camera_rotation().transpose(),
            position: pose.position(),
            centre_density: (0.0, 0.0),
        };
        let middle = Pixel::new(0.5 * (camera.width() as f64 - 1.0), 0.5 * (camera.height() as f64 - 1.0));
        let point = pose.ground_from_ray(camera.ray_from_pixel(middle)?)?;
        let (_, derivative) = view.project(point)?;
        let centre = (least_stretch(&derivative), derivative.determinant().abs().sqrt());
        // The ratio is the square root of the cosine of the tilt: beyond 85° from plumb nothing
        // useful is seen.
        let usable =
            centre.0.is_finite() && centre.1.is_finite() && centre.0 > 0.29 * centre.1 && centre.1 > 1e-9;
        view.centre_density = centre;
        usable.then_some(view)
    }

    /// Side of the ground that a pixel in the middle of the image sees, metres.
    pub fn centre_resolution_m(&self) -> f64 {
        self.centre_density.1.recip()
    }

    /// Where a ground point is seen; `None` where it is not in front of the lens or is seen too
    /// coarsely.
    pub fn look(&self, point: GroundPoint) -> Option<GroundSample> {
        let (pixel, derivative) = self.project(point)?;
        let density = least_stretch(&derivative) / self.centre_density.0;
        (density >= MIN_DENSITY).then_some(GroundSample { x: pixel.x, y: pixel.y, density })
    }

    /// The pixel of a ground point and its derivative by the point, pixels a metre.
    fn project(&self, point: GroundPoint) -> Option<(Pixel, Matrix2<f64>)> {
        let from_camera = Vector3::new(point.x_m, point.y_m, 0.0) - self.position;
        let v = self.camera_from_world * from_camera;
        if v.z <= 1e-9 * self.position.z {
            return None;
        }
        let ray = Ray::new(v.x / v.z, v.y / v.z);
        let (pixel, pixel_by_ray) = self.camera.pixel_and_derivative(ray)?;
        let ray_by_vector = Matrix2x3::new(1.0, 0.0, -ray.x, 0.0, 1.0, -ray.y) / v.z;
        let vector_by_ground = self.camera_from_world.fixed_columns::<2>(0);
        Some((pixel, pixel_by_ray * ray_by_vector * vector_by_ground))
    }
}

/// The smaller singular value of a 2 × 2 matrix.
fn least_stretch(m: &Matrix2<f64>) -> f64 {
    let (sum, determinant) = (m.norm_squared(), m.determinant().abs());
    let largest = (0.5 * (sum + (sum * sum - 4.0 * determinant * determinant).max(0.0).sqrt())).sqrt();
    if largest > 0.0 { determinant / largest } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_smaller_singular_value_is_that_of_the_decomposition() {
        let m = Matrix2::new(3.0, -1.0, 0.5, 0.25);
        assert!((least_stretch(&m) - m.singular_values().min()).abs() < 1e-12);
    }

    #[test]
    fn a_level_camera_sees_its_field_of_view() {
        let camera = Camera::from_field_of_view((640, 480), (1.2, 0.9), 1.0).unwrap();
        let pose = GroundPose::level(1.0);
        let view = GroundCamera::new(&camera, &pose).unwrap();
        assert!((view.centre_resolution_m() - 1.2 / 640.0).abs() < 1e-9);
        let mut cache = None;
        let (low, high) = Footprint::of(&mut cache, &camera).bounds(&view).unwrap();
        assert!(low.x_m < -0.44 && low.x_m > -0.6 && high.y_m > 0.59 && high.y_m < 0.7);
    }

    #[test]
    fn a_tilted_camera_does_not_reach_for_the_horizon() {
        let camera = Camera::from_field_of_view((640, 480), (1.2, 0.9), 1.0).unwrap();
        let pose = GroundPose { pitch_rad: -1.2, ..GroundPose::level(1.0) };
        let view = GroundCamera::new(&camera, &pose).unwrap();
        let (_, high) = Footprint::of(&mut None, &camera).bounds(&view).unwrap();
        assert!(high.x_m < 12.0, "{high:?}");
        assert!(GroundCamera::new(&camera, &GroundPose { pitch_rad: -1.6, ..pose }).is_none());
    }
}
