//! How much of an image another camera pose has in view.

use super::MARGIN_PX;
use crate::camera::Camera;
use crate::geometry::{GroundPose, Pixel, Ray};
use crate::motion::{GroundFromRay, ViewingPose};

/// Points of a coarse grid over an image, on a side.
pub const GRID: usize = 8;

/// What the camera sees at the points of a coarse grid over its image.
pub fn image_grid(camera: &Camera) -> [Option<Ray>; GRID * GRID] {
    let (width, height) = (camera.width() as f64, camera.height() as f64);
    std::array::from_fn(|at| {
        let along = |i: usize, size: f64| (i as f64 + 0.5) / GRID as f64 * size - 0.5;
        camera.ray_from_pixel(Pixel::new(along(at % GRID, width), along(at / GRID, height)))
    })
}

/// Fraction of a coarse grid over the image of a camera at `at` that a camera at `pose` sees.
pub fn overlap(
    at: &GroundPose,
    rays: &[Option<Ray>; GRID * GRID],
    camera: &Camera,
    pose: &ViewingPose,
) -> f64 {
    let ground_from_ray = GroundFromRay::new(at);
    let seen = rays.iter().filter(|ray| {
        let ground = ray.and_then(|ray| ground_from_ray.of(ray));
        let back = ground.and_then(|ground| pose.pixel(camera, ground, 0.0));
        back.is_some_and(|pixel| camera.contains(pixel, MARGIN_PX as f64))
    });
    seen.count() as f64 / (GRID * GRID) as f64
}
