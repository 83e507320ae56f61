//! Orthorectified views of the ground with normalised local contrast.

use crate::camera::Camera;
use crate::fixed_pattern::ImageMask;
use crate::geometry::{GroundPose, Pixel};
use crate::image::{GrayImage, Pyramid};

/// Samples along the longer side of the view of a level camera. Not derived; chosen.
const LONG_SIDE_SAMPLES: f64 = 80.0;

/// Most samples along a side; a tilted camera sees further, and the rest is left out. Not derived;
/// chosen.
const MAX_SAMPLES: usize = 104;

/// Largest distance of ground from the point below the camera, in heights. Not derived; chosen.
const MAX_DISTANCE_IN_HEIGHTS: f64 = 3.0;

/// Standard deviation of the Gaussian for the local mean, samples. Not derived; chosen.
const MEAN_SIGMA: f64 = 3.0;

/// Standard deviation of the Gaussian for the local contrast, samples. Not derived; chosen.
const CONTRAST_SIGMA: f64 = 6.0;

/// Lower bound of the local contrast, gray levels: noise is not amplified beyond it. Not derived;
/// chosen.
const MIN_CONTRAST: f32 = 0.3;

/// Upper bound of a normalised sample, so that single spots do not dominate. Not derived; chosen.
const MAX_NORMALISED: f32 = 2.5;

/// Orthorectified view of the ground with a sample every [`GroundView::pixel_m`]. Rows run along −x
/// (forward is up), columns along −y (left is left).
#[derive(Debug, Clone)]
pub struct GroundView {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Distance between samples, metres.
    pub(super) pixel_m: f64,
    /// Centre of the view in the level frame of the camera, metres.
    pub(super) centre_m: (f64, f64),
    /// Samples in units of the local contrast; zero where nothing is seen.
    pub(super) samples: Vec<f32>,
    /// The same with NaN where nothing is seen.
    pub(super) known: Vec<f32>,
    /// Number of samples that are seen.
    pub(super) area: usize,
}

/// Geometry that all views of a camera share.
#[derive(Debug)]
pub(super) struct ViewGeometry {
    /// Distance between samples over the height.
    pixel_per_height: f64,
    /// Image pixels per sample at the centre.
    image_px: f64,
}

impl ViewGeometry {
    pub fn new(camera: &Camera) -> Self {
        let (fx, fy) = camera.focal_px();
        let (width, height) = (camera.width() as f64, camera.height() as f64);
        let (cx, cy) = camera.principal_px();
        // Of a wide-angle lens only the part that sees the ground from above is used, to a slope of
        // 1.2.
        let extent = |from: Pixel, to: Pixel, straight: f64| {
            let tangent = |pixel| camera.ray_from_pixel(pixel).map(|ray| ray.x.hypot(ray.y).min(1.2));
            tangent(from).zip(tangent(to)).map_or(straight.min(2.4), |(a, b)| a + b)
        };
        let across = extent(Pixel::new(0.0, cy), Pixel::new(width - 1.0, cy), width / fx);
        let along = extent(Pixel::new(cx, 0.0), Pixel::new(cx, height - 1.0), height / fy);
        let pixel_per_height = across.max(along) / LONG_SIDE_SAMPLES;
        Self { pixel_per_height, image_px: pixel_per_height * (fx * fy).sqrt() }
    }

    pub fn view(
        &self,
        camera: &Camera,
        pyramid: &Pyramid,
        mask: Option<&ImageMask>,
        pose: &GroundPose,
    ) -> Option<GroundView> {
        // Computed at height 1: samples scale with the height.
        let pose = GroundPose { x_m: 0.0, y_m: 0.0, heading_rad: 0.0, ..*pose };
        let unit_height = GroundPose { height_m: 1.0, ..pose };
        let step = self.pixel_per_height;
        let (low, high) = footprint(camera, &unit_height)?;
        let samples = |low: f64, high: f64| (((high - low) / step).round() as usize).min(MAX_SAMPLES);
        let (width, height) = (samples(low.1, high.1), samples(low.0, high.0));
        if width < 8 || height < 8 {
            return None;
        }
        let centre = (0.5 * (low.0 + high.0), 0.5 * (low.1 + high.1));
        let camera_from_world = unit_height.world_from_camera_rotation().transpose();
        let (image, scale) = level_for(pyramid, self.image_px);
        let taps = (self.image_px / scale).round().clamp(2.0, 6.0) as usize;
        let gray = |x: f64, y: f64| -> Option<f32> {
            let point = camera_from_world * nalgebra::Vector3::new(x, y, -1.0);
            if point.z <= 1e-6 {
                return None;
            }
            let pixel =
                camera.pixel_from_ray(crate::geometry::Ray::new(point.x / point.z, point.y / point.z))?;
            if mask.is_some_and(|mask| mask.covers_pixel(pixel)) {
                return None;
            }
            bilinear(image, pixel.x / scale, pixel.y / scale)
        };
        let mut values = vec![0.0f32; width * height];
        let mut seen = vec![0.0f32; width * height];
        for j in 0..height {
            for i in 0..width {
                let x = centre.0 + ((height as f64 - 1.0) / 2.0 - j as f64) * step;
                let y = centre.1 + ((width as f64 - 1.0) / 2.0 - i as f64) * step;
                let offset = |tap: usize| ((tap as f64 + 0.5) / taps as f64 - 0.5) * step;
                let mean = (0..taps * taps)
                    .map(|tap| gray(x + offset(tap / taps), y + offset(tap % taps)))
                    .try_fold(0.0, |sum, value| value.map(|value| sum + value));
                if let Some(sum) = mean {
                    values[j * width + i] = sum / (taps * taps) as f32;
                    seen[j * width + i] = 1.0;
                }
            }
        }
        let area = seen.iter().filter(|&&s| s > 0.0).count();
        if area < 64 {
            return None;
        }
        let samples = normalise_contrast(&values, &seen, width);
        let known =
            samples.iter().zip(&seen).map(|(&sample, &seen)| if seen > 0.0 { sample } else { f32::NAN });
        let known = known.collect();
        let height_m = pose.height_m;
        let centre_m = (centre.0 * height_m, centre.1 * height_m);
        Some(GroundView { width, height, pixel_m: step * height_m, centre_m, samples, known, area })
    }
}

/// Bounding rectangle of the ground in the image within the largest distance: lower and upper ends
/// of x and y.
fn footprint(camera: &Camera, pose: &GroundPose) -> Option<((f64, f64), (f64, f64))> {
    const STEPS: usize = 24;
    let (width, height) = (camera.width() as f64 - 1.0, camera.height() as f64 - 1.0);
    let mut low = (f64::INFINITY, f64::INFINITY);
    let mut high = (f64::NEG_INFINITY, f64::NEG_INFINITY);
    for j in 0..=STEPS {
        for i in 0..=STEPS {
            let pixel = Pixel::new(i as f64 / STEPS as f64 * width, j as f64 / STEPS as f64 * height);
            let Some(point) = camera.ray_from_pixel(pixel).and_then(|ray| pose.ground_from_ray(ray)) else {
                continue;
            };
            if point.x_m.hypot(point.y_m) > MAX_DISTANCE_IN_HEIGHTS {
                continue;
            }
            low = (low.0.min(point.x_m), low.1.min(point.y_m));
            high = (high.0.max(point.x_m), high.1.max(point.y_m));
        }
    }
    (low.0 < high.0 && low.1 < high.1).then_some((low, high))
}

/// The pyramid level with two or three pixels per sample, and the width of its pixels in image
/// pixels.
fn level_for(pyramid: &Pyramid, image_px: f64) -> (&GrayImage, f64) {
    let level = ((image_px / 2.0).max(1.0).log2().floor() as usize).min(pyramid.levels() - 1);
    (pyramid.level(level), (1u32 << level) as f64)
}

fn bilinear(image: &GrayImage, x: f64, y: f64) -> Option<f32> {
    let (width, height) = (image.width(), image.height());
    if !(x >= 0.0 && y >= 0.0 && x < width as f64 - 1.0 && y < height as f64 - 1.0) {
        return None;
    }
    let (column, line) = (x as usize, y as usize);
    let (fx, fy) = ((x - column as f64) as f32, (y - line as f64) as f32);
    let at = |column: usize, line: usize| f32::from(image.samples()[line * width + column]);
    let upper = at(column, line) + fx * (at(column + 1, line) - at(column, line));
    let lower = at(column, line + 1) + fx * (at(column + 1, line + 1) - at(column, line + 1));
    Some(upper + fy * (lower - upper))
}

/// Samples minus the local mean, over the local contrast, both of what is seen.
fn normalise_contrast(values: &[f32], seen: &[f32], width: usize) -> Vec<f32> {
    let masked = |values: &[f32]| -> Vec<f32> { values.iter().zip(seen).map(|(v, s)| v * s).collect() };
    let near = blur(seen, width, MEAN_SIGMA);
    let mean = blur(&masked(values), width, MEAN_SIGMA);
    let difference: Vec<f32> =
        (0..values.len()).map(|i| seen[i] * (values[i] - mean[i] / near[i].max(1e-6))).collect();
    let squares: Vec<f32> = difference.iter().map(|d| d * d).collect();
    let (around, energy) = (blur(seen, width, CONTRAST_SIGMA), blur(&squares, width, CONTRAST_SIGMA));
    let normalised = |i: usize| {
        let contrast = (energy[i] / around[i].max(1e-6)).max(0.0).sqrt().max(MIN_CONTRAST);
        (difference[i] / contrast).clamp(-MAX_NORMALISED, MAX_NORMALISED)
    };
    (0..values.len()).map(normalised).collect()
}

/// Gaussian blur; zeros beyond the border.
fn blur(values: &[f32], width: usize, sigma: f64) -> Vec<f32> {
    let radius = (2.5 * sigma).ceil() as isize;
    let weights: Vec<f32> =
        (-radius..=radius).map(|d| (-0.5 * (d as f64 / sigma).powi(2)).exp() as f32).collect();
    let height = values.len() / width;
    let pass = |from: &[f32], along: (isize, isize)| -> Vec<f32> {
        let mut out = vec![0.0; from.len()];
        for j in 0..height as isize {
            for i in 0..width as isize {
                let mut sum = 0.0;
                for (d, weight) in (-radius..=radius).zip(&weights) {
                    let (x, y) = (i + d * along.0, j + d * along.1);
                    if x >= 0 && y >= 0 && x < width as isize && y < height as isize {
                        sum += weight * from[(y * width as isize + x) as usize];
                    }
                }
                out[(j * width as isize + i) as usize] = sum;
            }
        }
        out
    };
    pass(&pass(values, (1, 0)), (0, 1))
}
