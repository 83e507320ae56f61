//! How much noise an image has.

use super::GrayImage;

/// Every so many rows are looked at.
const EVERY: usize = 8;

/// The median of the magnitude of normal noise, in standard deviations.
const MEDIAN: f64 = 0.6745;

/// At most how much noise the samples of an image have: a variance, gray levels².
///
/// It is told by what is left of squares of two by two pixels where one diagonal is subtracted from the other, of which neither soft light nor straight edges along rows and
/// columns leave anything. The median of its magnitude is taken: what has edges in less than half of its area tells its noise, and texture that is fine everywhere
/// tells more than there is.
pub fn noise_variance(image: &GrayImage) -> f64 {
    let mut counts = [0u32; 511];
    for y in (0..image.height().saturating_sub(1)).step_by(EVERY) {
        let (above, below) = (image.row(y), image.row(y + 1));
        let across = |row: &[u8], x: usize| i32::from(row[x]) - i32::from(row[x + 1]);
        for x in 0..above.len().saturating_sub(1) {
            counts[((across(above, x) - across(below, x)).unsigned_abs() as usize).min(510)] += 1;
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
            // Four samples have four times the variance of one.
            return 0.25 * (median / MEDIAN).powi(2);
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
            // The median of a third of 9600 squares, which are rounded, too.
            assert!((found / there - 1.0).abs() < 0.15, "{noise_gray}: {there} {found}");
        }
        assert!(noise_variance(&board(0.0)) < 0.1);
        assert_eq!(noise_variance(&GrayImage::new(1, 1)), 0.0);
    }
}
