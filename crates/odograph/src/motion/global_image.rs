//! Rolling-shutter correction of whole images.

use super::{RollingShutter, ViewingPose};
use crate::camera::Camera;
use crate::geometry::{GroundPose, Pixel};
use crate::image::GrayImage;

/// Grid distance at which source pixels are computed; between them they are interpolated. With a
/// lens of 90° the curvature of the shift between grid points is below 0.01 px.
const GRID_STEP: usize = 16;

/// The image of a global shutter at `pose` of level ground. Pixels without a source repeat the
/// border of the image.
pub fn global_image(
    camera: &Camera,
    image: &GrayImage,
    pose: &GroundPose,
    shutter: &RollingShutter,
) -> GrayImage {
    if shutter.is_global() {
        return image.clone();
    }
    let (width, height) = (image.width(), image.height());
    let view = ViewingPose::with_rolling_shutter(*pose, shutter);
    let source = |x: usize, y: usize| {
        let pixel = Pixel::new(x as f64, y as f64);
        let ground = camera.ray_from_pixel(pixel).and_then(|ray| pose.ground_from_ray(ray));
        let at = ground.and_then(|ground| view.pixel(camera, ground, 0.0)).unwrap_or(pixel);
        [(at.x - pixel.x) as f32, (at.y - pixel.y) as f32]
    };
    let columns = width.div_ceil(GRID_STEP) + 1;
    let shifts: Vec<Vec<[f32; 2]>> = (0..height.div_ceil(GRID_STEP) + 1)
        .map(|row| (0..columns).map(|column| source(column * GRID_STEP, row * GRID_STEP)).collect())
        .collect();
    let mut corrected = GrayImage::new(width, height);
    for (y, line) in corrected.samples_mut().chunks_exact_mut(width).enumerate() {
        let (above, below) = (&shifts[y / GRID_STEP], &shifts[y / GRID_STEP + 1]);
        let down = (y % GRID_STEP) as f32 / GRID_STEP as f32;
        let interpolate = |a: [f32; 2], b: [f32; 2], share: f32| {
            [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])]
        };
        for (x, sample) in line.iter_mut().enumerate() {
            let right = (x % GRID_STEP) as f32 / GRID_STEP as f32;
            let column = |i: usize| interpolate(above[i], below[i], down);
            let shift = interpolate(column(x / GRID_STEP), column(x / GRID_STEP + 1), right);
            *sample = cubic(image, x as f32 + shift[0], y as f32 + shift[1]);
        }
    }
    corrected
}

/// Cubic convolution interpolation (R. Keys, 1981; a = −1/2).
fn cubic(image: &GrayImage, x: f32, y: f32) -> u8 {
    let weights = |t: f32| {
        let (t2, t3) = (t * t, t * t * t);
        [
            0.5 * (-t3 + 2.0 * t2 - t),
            0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
            0.5 * (-3.0 * t3 + 4.0 * t2 + t),
            0.5 * (t3 - t2),
        ]
    };
    let (left, top) = (x.floor(), y.floor());
    let (across, along) = (weights(x - left), weights(y - top));
    let within = |at: f32, offset: usize, size: usize| {
        (at as i64 + offset as i64 - 1).clamp(0, size as i64 - 1) as usize
    };
    let columns: [usize; 4] = std::array::from_fn(|i| within(left, i, image.width()));
    let mut sum = 0.0;
    for (i, weight) in along.into_iter().enumerate() {
        let row = image.row(within(top, i, image.height()));
        let line: f32 = columns.iter().zip(across).map(|(&at, weight)| weight * f32::from(row[at])).sum();
        sum += weight * line;
    }
    sum.round().clamp(0.0, 255.0) as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Distortion;
    use crate::motion::PoseRates;

    #[test]
    fn a_slanted_bar_becomes_upright() {
        let camera = Camera::new((320, 240), (250.0, 250.0), (160.0, 120.0), Distortion::None).unwrap();
        // A camera that moves to the right sees an upright bar further left in later rows.
        let pose = GroundPose::level(1.0);
        let shutter = RollingShutter::new(&camera, 0.02, PoseRates::new(0.0, -2.0, 0.0, 0.0, 0.0, 0.0));
        let centre = |y: usize| 160.0 - 250.0 * 2.0 * shutter.row_time_s(y as f64);
        let mut image = GrayImage::new(320, 240);
        for y in 0..240 {
            for x in 0..320 {
                let off = (x as f64 - centre(y)) / 6.0;
                image.samples_mut()[y * 320 + x] = (200.0 * (-off * off).exp()) as u8;
            }
        }
        let corrected = global_image(&camera, &image, &pose, &shutter);
        for y in [10, 60, 120, 180, 230] {
            let row = corrected.row(y);
            let total: f64 = row.iter().map(|&s| f64::from(s)).sum();
            let mean = row.iter().enumerate().map(|(x, &s)| x as f64 * f64::from(s)).sum::<f64>() / total;
            assert!((mean - 160.0).abs() < 0.05, "row {y}: {mean}");
        }
    }
}
