//! How much there is to see in an image.

use crate::detection::{Detection, DetectionConfig};
use crate::fixed_pattern::ImageMask;
use crate::image::{GrayImage, Pyramid};
use std::sync::Arc;

/// How well the corners of an image can be tracked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TextureClass {
    /// They can be followed.
    Clear,
    /// Hardly any corner exceeds the noise: the whole image is registered and, if that fails, its
    /// corners are tracked.
    Drowned,
    /// There are hardly any: the whole image is followed.
    Faint,
}

impl TextureClass {
    /// Classifies an image outside the mask: two pyramid levels up, where the sensor's noise is
    /// averaged, and one level up, where corners of noise compete with those of the ground.
    pub fn of(pyramid: &Pyramid, mask: Option<&Arc<ImageMask>>) -> Self {
        // A mask takes corners of the ground away, not the ground's texture.
        let open = 1.0 - mask.map_or(0.0, |mask| mask.share());
        let enough_corners = ((open * ENOUGH_CORNERS as f64).ceil() as usize).max(ENOUGH_OF_A_PATTERN);
        let strengths = |level: usize| -> Vec<f64> {
            let image = pyramid.level(level);
            let config = DetectionConfig {
                corners: ENOUGH_CORNERS,
                minimum_distance_px: f64::from(20u32 >> level),
                quality: 0.0,
                ..Default::default()
            };
            let sought = Detection::new((image.width(), image.height()), &config, 3);
            let corners = sought.without(mask.cloned(), level as u32).corners(image);
            corners.iter().map(|corner| f64::from(corner.strength)).collect()
        };
        let are = |strengths: &[f64], enough: usize, least: f64| {
            strengths.iter().filter(|strength| **strength >= least).count() >= enough
        };
        let averaged = strengths(2);
        if !are(&averaged, enough_corners, FAINT_STRENGTH) && !are(&averaged, ENOUGH_OF_A_PATTERN, STRONG) {
            return Self::Faint;
        }
        let (noise, near) = (noise_variance(pyramid.base()), strengths(1));
        if are(&near, enough_corners, OVER_NOISE * noise)
            || are(&near, ENOUGH_OF_A_PATTERN, WELL_OVER_NOISE * noise)
        {
            Self::Clear
        } else {
            Self::Drowned
        }
    }
}

/// Least number of corners that make texture, in an image without a mask, and of strong ones such
/// as the crossings of joints between tiles.
const ENOUGH_CORNERS: usize = 20;
const ENOUGH_OF_A_PATTERN: usize = 4;

/// Corner strength, (gray levels per pixel)², two levels up: sensor noise of 5 gray levels leaves
/// about 0.03 there, texture of half a gray level 0.1.
const FAINT_STRENGTH: f64 = 0.25;

/// The strength of corners of which a few are enough, in the same unit: that of a crossing of large
/// squares whose gray levels differ by 11. It grows with the square of the difference.
const STRONG: f64 = 5.0;

/// Least strength of usable corners one level up, in units of the noise variance; those of noise
/// alone have up to 0.07.
const OVER_NOISE: f64 = 0.15;
const WELL_OVER_NOISE: f64 = 1.0;

/// Noise variance of the sensor, (gray levels)²: that of the differences of diagonals in squares of
/// 2x2 pixels. Fine texture adds to it. The thresholds above are in units of this mean, not of the
/// median of `crate::image::noise_variance`.
fn noise_variance(image: &GrayImage) -> f64 {
    const EVERY: usize = 8;
    let (mut squares, mut count) = (0u64, 0usize);
    for y in (0..image.height().saturating_sub(1)).step_by(EVERY) {
        let (above, below) = (image.row(y), image.row(y + 1));
        let last = above.len() - 1;
        let across = |row: &[u8], x: usize| i32::from(row[x]) - i32::from(row[x + 1]);
        // A row's sum is below 2¹⁶ · 510².
        squares += (0..last).map(|x| (across(above, x) - across(below, x)).pow(2) as u64).sum::<u64>();
        count += 4 * last;
    }
    squares as f64 / count.max(1) as f64
}

/// Whether an image shows only noise and smooth illumination: darkness, a hand over the lens, a
/// floor without texture.
///
/// The means of the black and of the white pixels of 4x4 squares, as on a chessboard, are compared:
/// they share the texture and not the noise. In blocks of 64x64 pixels a plane of illumination is
/// subtracted.
pub fn is_bare(image: &GrayImage) -> bool {
    let (columns, rows) = (image.width() / SQUARE, image.height() / SQUARE);
    let (mut common, mut blacks, mut whites, mut count) = (0.0, 0.0, 0.0, 0usize);
    for top in (0..(rows + 1).saturating_sub(BLOCK)).step_by(BLOCK) {
        for left in (0..(columns + 1).saturating_sub(BLOCK)).step_by(BLOCK) {
            let [black, white] = block(image, left, top);
            let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            common += product(&black, &white);
            blacks += product(&black, &black);
            whites += product(&white, &white);
            count += BLOCK * BLOCK;
        }
    }
    let chance = (blacks * whites / count.max(1) as f64).sqrt();
    common < LEAST_TEXTURE_GRAY * LEAST_TEXTURE_GRAY * count as f64 || common <= CERTAIN * chance
}

/// Pixels along the side of a square.
const SQUARE: usize = 4;

/// Squares along the side of a block.
const BLOCK: usize = 16;

/// Least standard deviation of usable texture, gray levels over squares of 4x4 pixels. Illumination
/// that decreases by a third towards the corners leaves 0.1 within a block.
const LEAST_TEXTURE_GRAY: f64 = 0.13;

/// Correlation below this many standard deviations of chance is chance.
const CERTAIN: f64 = 8.0;

/// Whether an image has hardly any light.
pub fn is_dark(image: &GrayImage) -> bool {
    const DARK_GRAY: u64 = 24;
    let sum: u64 = image.samples().iter().map(|&sample| u64::from(sample)).sum();
    sum < DARK_GRAY * image.samples().len() as u64
}

/// Whether an image is so much blurrier than another that little can be found again: in some
/// direction its fine texture is gone.
pub fn is_blurred(image: &Pyramid, beside: &Pyramid) -> bool {
    const BLURRED: f64 = 0.3;
    let (now, before) = (fineness(image), fineness(beside));
    now.iter().zip(before).any(|(now, before)| *now < BLURRED * before)
}

/// Mean squared differences along x, along y and along both diagonals, over the squared mean, which
/// cancels illumination. One level up, where there is less noise.
fn fineness(pyramid: &Pyramid) -> [f64; 4] {
    let image = pyramid.level(1);
    let samples = (image.width() * image.height()) as f64;
    let mean = image.samples().iter().map(|&sample| f64::from(sample)).sum::<f64>() / samples;
    let squares = |(right, down): (usize, isize)| -> f64 {
        let row = |y: usize| {
            let other = &image.row((y as isize + down) as usize)[right..];
            let differences = image.row(y).iter().zip(other).map(|(&a, &b)| f64::from(a) - f64::from(b));
            differences.map(|difference| difference * difference).sum::<f64>()
        };
        (1..image.height().saturating_sub(1)).map(row).sum()
    };
    [(1, 0), (0, 1), (1, 1), (1, -1)].map(|direction| squares(direction) / (samples * mean * mean).max(1e-9))
}

/// Means of the black and of the white pixels of the squares of a block, with the best-fitting
/// plane subtracted.
fn block(image: &GrayImage, left: usize, top: usize) -> [Vec<f64>; 2] {
    let mut means = [Vec::with_capacity(BLOCK * BLOCK), Vec::with_capacity(BLOCK * BLOCK)];
    for at in 0..BLOCK * BLOCK {
        let (x, y) = (SQUARE * (left + at % BLOCK), SQUARE * (top + at / BLOCK));
        let mut sums = [0u32; 2];
        for j in 0..SQUARE {
            let row = &image.row(y + j)[x..x + SQUARE];
            row.iter().enumerate().for_each(|(i, &sample)| sums[(i + j) % 2] += u32::from(sample));
        }
        let half = (SQUARE * SQUARE / 2) as f64;
        means.iter_mut().zip(sums).for_each(|(means, sum)| means.push(f64::from(sum) / half));
    }
    means.each_mut().map(|means| {
        remove_plane(means);
        std::mem::take(means)
    })
}

fn remove_plane(values: &mut [f64]) {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let place = |i: usize| i as f64 - 0.5 * (BLOCK as f64 - 1.0);
    let squares = (BLOCK * BLOCK * (BLOCK * BLOCK - 1)) as f64 / 12.0;
    let slope = |values: &[f64], along: fn(usize) -> usize| {
        values.iter().enumerate().map(|(at, value)| place(along(at)) * value).sum::<f64>() / squares
    };
    let (right, down) = (slope(values, |at| at % BLOCK), slope(values, |at| at / BLOCK));
    for (at, value) in values.iter_mut().enumerate() {
        *value -= mean + right * place(at % BLOCK) + down * place(at / BLOCK);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Random;

    /// Squares of 64 pixels in two gray levels, with sensor noise of 1.4 gray levels.
    fn checkerboard(dark: u8, bright: u8) -> Pyramid {
        let mut random = Random::new(1);
        let mut image = GrayImage::new(320, 240);
        for (index, sample) in image.samples_mut().iter_mut().enumerate() {
            let (column, row) = (index % 320 / 64, index / 320 / 64);
            let gray = if (column + row) % 2 == 0 { dark } else { bright };
            let noise: i32 = (0..3).map(|_| random.below(3) as i32 - 1).sum();
            *sample = (i32::from(gray) + noise) as u8;
        }
        Pyramid::new(image, 3)
    }

    #[test]
    fn a_few_strong_corners_are_texture() {
        assert_eq!(TextureClass::of(&checkerboard(20, 60), None), TextureClass::Clear);
        assert_eq!(TextureClass::of(&checkerboard(20, 24), None), TextureClass::Faint);
    }

    /// A faint dot in every square of 80 pixels: 8 in a row and 6 rows.
    fn dots() -> Pyramid {
        let mut image = GrayImage::new(640, 480);
        for (index, sample) in image.samples_mut().iter_mut().enumerate() {
            let is_dot = |at: usize| (36..44).contains(&(at % 80));
            *sample = if is_dot(index % 640) && is_dot(index / 640) { 95 } else { 100 };
        }
        Pyramid::new(image, 3)
    }

    #[test]
    fn smooth_ground_drowns_in_noise_that_fine_ground_exceeds() {
        // Waves of 160 and of 24 pixels, 40 gray levels high, in noise of 5 gray levels.
        let waves = |length: f64, amplitude: f64| {
            let mut random = Random::new(3);
            let mut image = GrayImage::new(640, 480);
            for (index, sample) in image.samples_mut().iter_mut().enumerate() {
                let wave = |at: usize| (std::f64::consts::TAU * at as f64 / length).sin();
                let noise: f64 = (0..12).map(|_| random.below(1000) as f64 / 1000.0 - 0.5).sum();
                let ground = amplitude * wave(index % 640) * wave(index / 640);
                *sample = (120.0 + ground + 5.0 * noise) as u8;
            }
            Pyramid::new(image, 3)
        };
        assert_eq!(TextureClass::of(&waves(160.0, 20.0), None), TextureClass::Drowned);
        assert_eq!(TextureClass::of(&waves(24.0, 20.0), None), TextureClass::Clear);
    }

    #[test]
    fn a_mask_does_not_make_the_rest_of_the_image_faint() {
        let mut shown = GrayImage::new(640, 480);
        shown.samples_mut().fill(255);
        shown.samples_mut()[640 * 190..].fill(0);
        let mask = Arc::new(ImageMask::from_picture(&shown));
        // Sixteen dots are left: too few for a whole image.
        assert_eq!(TextureClass::of(&dots(), None), TextureClass::Clear);
        assert_eq!(TextureClass::of(&dots(), Some(&mask)), TextureClass::Clear);
    }
}
