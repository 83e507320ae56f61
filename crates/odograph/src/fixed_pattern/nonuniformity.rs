//! Scene-based correction of fixed-pattern noise: what a camera adds to every image, whatever it
//! looks at.
//!
//! Where the scene moves, the temporal mean of a pixel is its pattern and the mean brightness of
//! the scene (J. Harris and Y.-M. Chiang, "Nonuniformity correction of infrared image sequences
//! using the constant-statistics constraint", IEEE Transactions on Image Processing 8 (8), 1999).
//! Of the scene itself, 1/n is left in the mean of n independent images, less where its variance
//! explains the mean (W. James and C. Stein, "Estimation with quadratic loss", 1961). A pixel that
//! does not vary at all is dead, and takes the mean of its neighbours.

use crate::image::GrayImage;

/// A pattern learned as the mean of images of moving ground.
#[derive(Debug, Clone, PartialEq)]
pub struct NonuniformityCorrection {
    samples: u32,
    mean: Vec<f32>,
    /// Temporal mean of the squared sample.
    square: Vec<f32>,
    /// Deviation of each pixel's mean from that of the whole image, gray levels; zero where it is
    /// dead.
    offsets: Vec<i16>,
    dead: Vec<DeadPixel>,
}

/// A pixel that shows the same whatever the camera looks at, between pixels that do not.
#[derive(Debug, Clone, Copy, PartialEq)]
struct DeadPixel {
    index: u32,
    /// Indices of its neighbours on opposite sides.
    beside: [u32; 2],
}

/// The temporal variance of a dead pixel is below this part of the median pixel's. Of twelve
/// samples of noise alone, one in 10^5 is; on plain tiles, where a joint raises the median, one in
/// a thousand was, and was replaced by its neighbours.
const DEAD_VARIANCE: f32 = 0.1;

/// A dead pixel is replaced from neighbours within this distance, pixels: what covers more is a
/// thing, and not a defect of the sensor.
const DEAD_REACH: isize = 2;

/// Memory of the exponential moving average, samples: of the ground's variance, 1/128 is left in
/// the mean.
const MAX_SAMPLES: u32 = 64;

/// The median variance is that of every eleventh pixel.
const MEDIAN_OF_EVERY: usize = 11;

/// The strength of the pattern is estimated from every fourth row.
const STRENGTH_ROWS: usize = 4;

/// A strength of one, in fixed point.
const ONE: i32 = 256;

impl NonuniformityCorrection {
    /// A correction that changes nothing yet, for images of this size.
    pub fn new((width, height): (usize, usize)) -> Self {
        let pixels = width * height;
        Self {
            samples: 0,
            mean: vec![0.0; pixels],
            square: vec![0.0; pixels],
            offsets: vec![0; pixels],
            dead: Vec::new(),
        }
    }

    /// Number of images behind it, up to the memory of the average.
    pub fn samples(&self) -> u32 {
        self.samples
    }

    /// Whether as many images are behind it as the average remembers.
    pub fn is_settled(&self) -> bool {
        self.samples == MAX_SAMPLES
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
        let means = self.mean.iter_mut().zip(&mut self.square);
        for ((mean, square), &sample) in means.zip(image.samples()) {
            let sample = f32::from(sample);
            *mean += weight * (sample - *mean);
            *square += weight * (sample * sample - *square);
            sum += f64::from(*mean);
        }
        let whole = (sum / self.mean.len().max(1) as f64) as f32;
        let means = self.mean.iter().zip(&self.square);
        for (offset, (mean, square)) in self.offsets.iter_mut().zip(means) {
            // Of the ground, its variance over n is left in the square (James–Stein estimator).
            let (own, by_ground) = (mean - whole, weight * (square - mean * mean).max(0.0));
            let known = (1.0 - by_ground / (own * own)).max(0.0); // 0/0 is no pattern either
            *offset = (known * own).round() as i16;
        }
        self.find_dead_pixels(image.width());
    }

    /// Finds the pixels that do not vary, with the nearest that do on both sides.
    fn find_dead_pixels(&mut self, width: usize) {
        let variance = |(mean, square): (&f32, &f32)| (square - mean * mean).max(0.0);
        let variances: Vec<f32> = self.mean.iter().zip(&self.square).map(variance).collect();
        let mut sorted: Vec<f32> = variances.iter().copied().step_by(MEDIAN_OF_EVERY).collect();
        let middle = sorted.len() / 2;
        self.dead.clear();
        if sorted.is_empty() {
            return;
        }
        let limit = DEAD_VARIANCE * *sorted.select_nth_unstable_by(middle, f32::total_cmp).1;
        let is_dead = |index: usize| variances[index] < limit;
        let height = variances.len() / width;
        for index in (0..variances.len()).filter(|&index| is_dead(index)) {
            let (x, y) = ((index % width) as isize, (index / width) as isize);
            let healthy = |(dx, dy): (isize, isize)| {
                let (x, y) = (x + dx, y + dy);
                let is_inside = x >= 0 && y >= 0 && x < width as isize && y < height as isize;
                let at = y * width as isize + x;
                (is_inside && !is_dead(at as usize)).then_some(at as u32)
            };
            // Dead lines are one or two pixels wide, and cross.
            let opposite = |step: isize| {
                let directions = [(step, 0), (0, step), (step, step), (step, -step)];
                let both = |(dx, dy)| Some([healthy((dx, dy))?, healthy((-dx, -dy))?]);
                directions.into_iter().find_map(both)
            };
            let Some(beside) = (1..=DEAD_REACH).find_map(opposite) else { continue };
            self.offsets[index] = 0;
            self.dead.push(DeadPixel { index: index as u32, beside });
        }
    }

    /// Subtracts the pattern from an image of the same camera, as strong as it is there.
    pub fn apply(&self, image: &mut GrayImage) {
        self.replace_dead_pixels(image);
        let strength = (f64::from(ONE) * self.strength_beside_dead(image)).round() as i32;
        for (sample, &offset) in image.samples_mut().iter_mut().zip(&self.offsets) {
            let pattern = (strength * i32::from(offset) + ONE / 2) >> ONE.ilog2();
            *sample = (i32::from(*sample) - pattern).clamp(0, 255) as u8;
        }
    }

    /// How strong the pattern is in an image, 0 to 2: it changes with the exposure, and is zero in
    /// images from before it came up. The regression of the image's horizontal differences on those
    /// of the pattern: ground has nothing in common with it.
    pub fn strength(&self, image: &GrayImage) -> f64 {
        if self.dead.is_empty() {
            return self.strength_beside_dead(image);
        }
        let mut image = image.clone();
        self.replace_dead_pixels(&mut image);
        self.strength_beside_dead(&image)
    }

    fn replace_dead_pixels(&self, image: &mut GrayImage) {
        let samples = image.samples_mut();
        for DeadPixel { index, beside: [a, b] } in &self.dead {
            samples[*index as usize] = samples[*a as usize].midpoint(samples[*b as usize]);
        }
    }

    /// The strength of the pattern in an image whose dead pixels have been replaced.
    fn strength_beside_dead(&self, image: &GrayImage) -> f64 {
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
    fn dead_pixels_take_the_mean_of_their_neighbours() {
        let dead = |x: usize, y: usize| x == 20 || y == 11 || y == 12;
        let broken = |number: u64| {
            let mut image = image(number, 0);
            for (at, sample) in image.samples_mut().iter_mut().enumerate() {
                if dead(at % SIZE.0, at / SIZE.0) {
                    *sample = if at % 2 == 0 { 0 } else { 255 };
                }
            }
            image
        };
        let mut correction = NonuniformityCorrection::new(SIZE);
        (0..MAX_SAMPLES).for_each(|number| correction.learn(&broken(number.into())));
        let mut corrected = broken(900);
        correction.apply(&mut corrected);
        // The ground is between 120 and 140; a pixel's mean is within a few levels of 130, and that
        // of the whole image is moved by the dead ones.
        assert!(corrected.samples().iter().all(|sample| (105..=155).contains(sample)));
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
