//! Scene-based correction of fixed-pattern noise: what a camera adds to every image, whatever it
//! looks at.
//!
//! Where the scene moves, the temporal mean of a pixel is its pattern and the mean brightness of
//! the scene (J. Harris and Y.-M. Chiang, "Nonuniformity correction of infrared image sequences
//! using the constant-statistics constraint", IEEE Transactions on Image Processing 8 (8), 1999).
//! Of the scene itself, 1/n is left in the mean of n independent images.

use crate::image::GrayImage;

/// A pattern learned as the mean of images of moving ground.
#[derive(Debug, Clone, PartialEq)]
pub struct NonuniformityCorrection {
    samples: u32,
    mean: Vec<f32>,
    /// Deviation of each pixel's mean from that of the whole image, gray levels.
    offsets: Vec<i16>,
}

/// Memory of the exponential moving average, samples: of the ground's variance, 1/128 is left in
/// the mean.
const MAX_SAMPLES: u32 = 64;

/// The strength of the pattern is estimated from every fourth row.
const STRENGTH_ROWS: usize = 4;

/// A strength of one, in fixed point.
const ONE: i32 = 256;

impl NonuniformityCorrection {
    /// A correction that changes nothing yet, for images of this size.
    pub fn new((width, height): (usize, usize)) -> Self {
        let pixels = width * height;
        Self { samples: 0, mean: vec![0.0; pixels], offsets: vec![0; pixels] }
    }

    /// Number of images behind it, up to the memory of the average.
    pub fn samples(&self) -> u32 {
        self.samples
    }

    /// Root mean square of the pattern, gray levels.
    pub fn rms_gray(&self) -> f64 {
        let squares: f64 = self.offsets.iter().map(|&offset| f64::from(offset).powi(2)).sum();
        (squares / self.offsets.len().max(1) as f64).sqrt()
    }

    /// Adds an image of ground that has moved since the last one.
    pub fn learn(&mut self, image: &GrayImage) {
        self.samples = (self.samples + 1).min(MAX_SAMPLES);
        let weight = 1.0 / self.samples as f32;
        let mut sum = 0.0f64;
        for (mean, &sample) in self.mean.iter_mut().zip(image.samples()) {
            *mean += weight * (f32::from(sample) - *mean);
            sum += f64::from(*mean);
        }
        let whole = (sum / self.mean.len().max(1) as f64) as f32;
        for (offset, mean) in self.offsets.iter_mut().zip(&self.mean) {
            *offset = (mean - whole).round() as i16;
        }
    }

    /// Subtracts the pattern from an image of the same camera, as strong as it is there.
    pub fn apply(&self, image: &mut GrayImage) {
        let strength = (f64::from(ONE) * self.strength(image)).round() as i32;
        for (sample, &offset) in image.samples_mut().iter_mut().zip(&self.offsets) {
            let pattern = (strength * i32::from(offset) + ONE / 2) >> ONE.ilog2();
            *sample = (i32::from(*sample) - pattern).clamp(0, 255) as u8;
        }
    }

    /// How strong the pattern is in an image, 0 to 2: it changes with the exposure, and is zero in
    /// images from before it came up. The regression of the image's horizontal differences on those
    /// of the pattern: ground has nothing in common with it.
    pub fn strength(&self, image: &GrayImage) -> f64 {
        let (mut common, mut squares) = (0i64, 0i64);
        let rows = self.offsets.chunks_exact(image.width().max(1)).enumerate().step_by(STRENGTH_ROWS);
        for (y, pattern) in rows {
            let differences = image.row(y).windows(2).map(|two| i64::from(two[1]) - i64::from(two[0]));
            for (own, two) in differences.zip(pattern.windows(2)) {
                let pattern = i64::from(two[1]) - i64::from(two[0]);
                common += own * pattern;
                squares += pattern * pattern;
            }
        }
        (common as f64 / squares.max(1) as f64).clamp(0.0, 2.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Random;

    const SIZE: (usize, usize) = (64, 48);

    /// Random ground, other in each image, and a pattern of columns.
    fn image(number: u64, pattern: i32) -> GrayImage {
        let mut random = Random::new(number);
        let mut image = GrayImage::new(SIZE.0, SIZE.1);
        for (at, sample) in image.samples_mut().iter_mut().enumerate() {
            let column = (at % SIZE.0 * 7) as i32 % 11 - 5;
            *sample = (120 + random.below(21) as i32 + pattern * column) as u8;
        }
        image
    }

    fn learned() -> NonuniformityCorrection {
        let mut correction = NonuniformityCorrection::new(SIZE);
        (0..MAX_SAMPLES).for_each(|number| correction.learn(&image(number.into(), 4)));
        correction
    }

    #[test]
    fn what_every_image_has_is_subtracted() {
        let correction = learned();
        let (mut corrected, clean) = (image(900, 4), image(900, 0));
        correction.apply(&mut corrected);
        let off = corrected.samples().iter().zip(clean.samples()).map(|(a, b)| f64::from(a.abs_diff(*b)));
        // The ground has a deviation of 6 gray levels, of which an eighth is left in the mean.
        assert!(off.sum::<f64>() / (SIZE.0 * SIZE.1) as f64 <= 1.0);
    }

    #[test]
    fn the_strength_follows_the_pattern() {
        let correction = learned();
        for (pattern, expected) in [(0, 0.0), (2, 0.5), (4, 1.0), (6, 1.5)] {
            let strength = correction.strength(&image(901, pattern));
            assert!((strength - expected).abs() < 0.1, "{pattern}: {strength}");
        }
        let mut clean = image(902, 0);
        correction.apply(&mut clean);
        let off = clean.samples().iter().zip(image(902, 0).into_samples()).map(|(a, b)| a.abs_diff(b));
        assert!(off.max() <= Some(3), "an image without the pattern stays as it is");
    }
}
