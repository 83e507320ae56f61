//! Square patches of samples: the window of Lucas–Kanade.

use crate::image::GrayImage;
use nalgebra::{Matrix2, Vector2};

/// Side of a patch in samples. Even, so that a row fills whole SIMD registers; its centre lies between the middle samples.
pub const SIDE: usize = 16;

/// Samples of a patch.
pub const AREA: usize = SIDE * SIDE;

/// From the first sample of a row or column to the centre of the patch.
pub const TO_CENTRE: f64 = (SIDE as f64 - 1.0) / 2.0;

/// The samples of a patch, row by row, in gray levels.
pub type Samples = [f32; AREA];

/// Samples `image` bilinearly on a grid of [`SIDE`]² points around `centre` whose steps along its rows and columns are the columns
/// of `linear`. `false`, with `samples` unspecified, unless the whole grid lies inside the image.
pub fn sample(image: &GrayImage, centre: Vector2<f64>, linear: &Matrix2<f64>, samples: &mut Samples) -> bool {
    let extent = TO_CENTRE * Vector2::new(linear.row(0).abs().sum(), linear.row(1).abs().sum());
    let (width, height) = (image.width(), image.height());
    let inside = centre.x - extent.x >= 0.0
        && centre.y - extent.y >= 0.0
        && centre.x + extent.x < width as f64 - 1.0
        && centre.y + extent.y < height as f64 - 1.0;
    if !inside {
        return false; // also where the centre is not a number
    }
    let first = centre - linear * Vector2::new(TO_CENTRE, TO_CENTRE);
    let all = image.samples();
    for (j, row) in samples.chunks_exact_mut(SIDE).enumerate() {
        let start = first + linear.column(1) * j as f64;
        let (x0, y0) = (start.x as f32, start.y as f32);
        let (dx, dy) = (linear[(0, 0)] as f32, linear[(1, 0)] as f32);
        for (i, sample) in row.iter_mut().enumerate() {
            let (x, y) = (x0 + dx * i as f32, y0 + dy * i as f32);
            let (column, line) = (x as usize, y as usize);
            let (fx, fy) = (x - column as f32, y - line as f32);
            let at = (line * width + column).min(all.len() - width - 2);
            let upper = f32::from(all[at]) + fx * (f32::from(all[at + 1]) - f32::from(all[at]));
            let lower = f32::from(all[at + width])
                + fx * (f32::from(all[at + width + 1]) - f32::from(all[at + width]));
            *sample = upper + fy * (lower - upper);
        }
    }
    true
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
