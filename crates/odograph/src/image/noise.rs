//! Estimation of the image noise.

use super::GrayImage;
use crate::numerics::NORMAL_MEDIAN;

/// Approximate number of rows sampled.
const ROWS: usize = 60;

/// Sum of the squares of the nine mask weights, which are 1, −2 and 4.
const WEIGHTS_SQUARED: f64 = 36.0;

/// Largest magnitude of the mask response: eight times white minus eight times black.
const MOST: usize = 8 * 255;

/// Upper bound of the noise variance of the samples, gray levels².
///
/// The mask of J. Immerkær ("Fast noise variance estimation", 1996), a second difference along rows
/// of second differences along columns, suppresses smooth texture and straight edges along rows and
/// columns. The standard deviation is estimated from the median absolute response, which is robust
/// to edges in up to half of the area. Texture that is fine everywhere biases the estimate upwards.
pub fn noise_variance(image: &GrayImage) -> f64 {
    let mut counts = [0u32; MOST + 1];
    for y in (1..image.height().saturating_sub(1)).step_by((image.height() / ROWS).max(1)) {
        let [above, here, below] = [image.row(y - 1), image.row(y), image.row(y + 1)];
        for ((above, here), below) in above.windows(3).zip(here.windows(3)).zip(below.windows(3)) {
            let bent = |row: &[u8]| i32::from(row[0]) - 2 * i32::from(row[1]) + i32::from(row[2]);
            let left = bent(above) - 2 * bent(here) + bent(below);
            counts[(left.unsigned_abs() as usize).min(MOST)] += 1;
        }
    }
    let half = 0.5 * counts.iter().map(|&count| f64::from(count)).sum::<f64>();
    let mut below = 0.0;
    for (magnitude, &count) in counts.iter().enumerate() {
        let count = f64::from(count);
        if below + count >= half && count > 0.0 {
            // A bin covers the interval of values rounded to it; bin 0 covers half a unit of
            // magnitude.
            let (from, width) = if magnitude == 0 { (0.0, 0.5) } else { (magnitude as f64 - 0.5, 1.0) };
            let median = from + width * (half - below) / count;
            return (median / NORMAL_MEDIAN).powi(2) / WEIGHTS_SQUARED;
        }
        below += count;
    }
    0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Random;

    /// A chessboard with squares of 24 pixels and noise of the given standard deviation, gray
    /// levels.
    fn board(noise_gray: f64) -> GrayImage {
        let mut random = Random::new(3);
        let mut normal = || (0..12).map(|_| random.below(1 << 16) as f64 / 65536.0).sum::<f64>() - 6.0;
        let sample = |at: usize| {
            let (x, y) = (at % 320, at / 320);
            let gray = if (x / 24 + y / 24) % 2 == 0 { 60.0 } else { 190.0 };
            (gray + 0.05 * x as f64 + noise_gray * normal()).round() as u8
        };
        GrayImage::from_samples(320, 240, (0..320 * 240).map(sample).collect()).unwrap()
    }

    #[test]
    fn noise_variance_is_estimated_in_spite_of_edges() {
        for noise_gray in [0.5f64, 1.0, 2.0, 4.0, 8.0] {
            // Quantisation adds a variance of 1/12 squared gray level.
            let (there, found) = (noise_gray * noise_gray + 1.0 / 12.0, noise_variance(&board(noise_gray)));
            // Tolerance of a median of 19,000 responses, a sixth of which lie on edges.
            assert!((found / there - 1.0).abs() < 0.15, "{noise_gray}: {there} {found}");
        }
        assert!(noise_variance(&board(0.0)) < 0.1);
        assert_eq!(noise_variance(&GrayImage::new(1, 1)), 0.0);
    }
}
