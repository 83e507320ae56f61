//! Square patches of samples: the window of Lucas–Kanade.

use crate::image::GrayImage;
use crate::image::simd::{Grid, TemplateSamples, sample_and_multiply, sample_patch};
use nalgebra::{Matrix2, Vector2};

pub use crate::image::simd::{PATCH_SIDE as SIDE, Patch as Samples};

/// Samples of a patch.
pub const AREA: usize = SIDE * SIDE;

/// From the first sample of a row or column to the centre of the patch.
pub const TO_CENTRE: f64 = (SIDE as f64 - 1.0) / 2.0;

/// Variance of a central difference over that of the samples.
const DIFFERENCE_VARIANCE: f64 = 0.5;

/// Expected contribution of noise with this variance, gray levels², to the sum of the squared
/// gradients of a patch along any direction.
pub fn gradient_noise(variance: f64) -> f64 {
    DIFFERENCE_VARIANCE * AREA as f64 * variance
}

/// Samples `image` bilinearly on a grid of [`SIDE`]² points around `centre`; the steps along its
/// rows and columns are the columns of `linear`. Returns `false` and leaves `samples` unchanged
/// unless the whole grid lies inside the image.
pub fn sample(image: &GrayImage, centre: Vector2<f64>, linear: &Matrix2<f64>, samples: &mut Samples) -> bool {
    grid_inside(image, centre, linear).map(|grid| sample_patch(image, &grid, samples)).is_some()
}

/// [`sample`], and the products of the samples with contrast and gradients. `None` unless the whole
/// grid lies inside the image.
pub fn sample_products(
    image: &GrayImage,
    centre: Vector2<f64>,
    linear: &Matrix2<f64>,
    appearance: &TemplateSamples,
    samples: &mut Samples,
) -> Option<TemplateProducts> {
    let grid = grid_inside(image, centre, linear)?;
    let [contrast, x, y] = sample_and_multiply(image, &grid, appearance, samples);
    Some(TemplateProducts { contrast, gradient: Vector2::new(x, y) })
}

/// Products of samples with a template's contrast and gradients.
pub struct TemplateProducts {
    pub contrast: f64,
    pub gradient: Vector2<f64>,
}

fn grid_inside(image: &GrayImage, centre: Vector2<f64>, linear: &Matrix2<f64>) -> Option<Grid> {
    let extent = TO_CENTRE * Vector2::new(linear.row(0).abs().sum(), linear.row(1).abs().sum());
    let (width, height) = (image.width(), image.height());
    // Also false for NaN.
    let inside = centre.x - extent.x >= 0.0
        && centre.y - extent.y >= 0.0
        && centre.x + extent.x < width as f64 - 1.0
        && centre.y + extent.y < height as f64 - 1.0;
    let first = centre - linear * Vector2::new(TO_CENTRE, TO_CENTRE);
    inside.then(|| Grid {
        first: first.into(),
        along_row: linear.column(0).into_owned().into(),
        along_column: linear.column(1).into_owned().into(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_is_sampled_exactly_under_any_warp() {
        let samples = (0..80 * 60).map(|i| (2 * (i % 80) + (i / 80)) as u8).collect();
        let image = GrayImage::from_samples(80, 60, samples).unwrap();
        let linear = Matrix2::new(0.9, -0.3, 0.25, 1.1);
        let centre = Vector2::new(40.3, 30.7);
        let mut out = [0.0; AREA];
        assert!(sample(&image, centre, &linear, &mut out));
        for j in 0..SIDE {
            for i in 0..SIDE {
                let p = centre + linear * Vector2::new(i as f64 - TO_CENTRE, j as f64 - TO_CENTRE);
                assert!((f64::from(out[j * SIDE + i]) - (2.0 * p.x + p.y)).abs() < 1e-3);
            }
        }
        assert!(!sample(&image, Vector2::new(5.0, 30.0), &linear, &mut out));
        assert!(!sample(&image, Vector2::new(f64::NAN, 30.0), &linear, &mut out));
    }
}
