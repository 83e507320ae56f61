//! How much noise an image has.

use super::GrayImage;
use crate::numerics::NORMAL_MEDIAN;

/// About so many rows are looked at.
const ROWS: usize = 60;

/// The weights of the nine samples are 1, −2 or 4: the sum of their squares.
const WEIGHTS_SQUARED: f64 = 36.0;

/// The largest magnitude: eight times white less eight times black.
const MOST: usize = 8 * 255;

/// At most how much noise the samples of an image have: a variance, gray levels².
///
/// It is told by second differences along rows of second differences along columns (J. Immerkær, "Fast noise variance estimation", 1996), of which neither soft
/// texture nor straight edges along rows and columns leave anything. The median of their magnitude is taken: what has edges in less than half of its area tells its
/// noise, and texture that is fine everywhere tells more than there is.
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
            // A magnitude stands for all that is rounded to it; 0 for what is on both sides of it.
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

    /// A chessboard with squares of 24 pixels and noise of that standard deviation.
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
    fn noise_is_told_whatever_else_is_in_the_image() {
        for noise_gray in [0.5f64, 1.0, 2.0, 4.0, 8.0] {
            // Rounding has a twelfth of a squared gray level.
            let (there, found) = (noise_gray * noise_gray + 1.0 / 12.0, noise_variance(&board(noise_gray)));
            // The median of 19,000 differences, a sixth of which lie on edges.
            assert!((found / there - 1.0).abs() < 0.15, "{noise_gray}: {there} {found}");
        }
        assert!(noise_variance(&board(0.0)) < 0.1);
        assert_eq!(noise_variance(&GrayImage::new(1, 1)), 0.0);
    }
}
