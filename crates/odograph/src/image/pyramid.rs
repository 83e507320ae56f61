//! Gaussian pyramid: each level has half the size of the one below; sample (x, y) of level l is at
//! sample (2x, 2y) of level l − 1.

use super::simd::{blur_and_halve, blur_rows};
use super::{GrayImage, noise_variance};
use std::sync::{Mutex, OnceLock, PoisonError};

/// A Gaussian pyramid. Level 0 is the image itself; the coarser levels are computed on first
/// access.
///
/// A level keeps the even samples of the blurred level below, so a point at `p` in level 0 is at `p
/// / 2^l` in level l.
#[derive(Debug)]
pub struct Pyramid {
    base: GrayImage,
    /// Maximum number of levels requested.
    most: usize,
    /// Number of levels, computed or not.
    levels: usize,
    coarser: OnceLock<Vec<GrayImage>>,
    noise_variance: OnceLock<f64>,
    /// Reusable memory of the coarser levels.
    spare: Box<Mutex<Spare>>,
}

#[derive(Debug, Default)]
struct Spare {
    coarser: Vec<GrayImage>,
    column_sums: Vec<u16>,
}

/// Minimum side length of a level, pixels; a patch does not fit into smaller ones.
const SMALLEST_SIDE: usize = 24;

impl Pyramid {
    /// The pyramid of an image with at most `levels` levels (at least one).
    pub fn new(image: GrayImage, levels: usize) -> Self {
        let made = 1 + coarser_sizes(&image, levels).count();
        Self {
            base: image,
            most: levels,
            levels: made,
            coarser: OnceLock::new(),
            noise_variance: OnceLock::new(),
            spare: Box::default(),
        }
    }

    /// Replaces the image and returns the previous one. The memory of the coarser levels is reused.
    pub fn replace(&mut self, image: GrayImage) -> GrayImage {
        if let Some(coarser) = self.coarser.take() {
            self.spare.get_mut().unwrap_or_else(PoisonError::into_inner).coarser = coarser;
        }
        self.levels = 1 + coarser_sizes(&image, self.most).count();
        self.noise_variance = OnceLock::new();
        std::mem::replace(&mut self.base, image)
    }

    /// Number of levels; at least one.
    pub fn levels(&self) -> usize {
        self.levels
    }

    /// The full-resolution image.
    pub fn base(&self) -> &GrayImage {
        &self.base
    }

    /// Upper bound of the noise variance of the full-resolution image, gray levels²; see
    /// [`noise_variance`].
    pub fn noise_variance(&self) -> f64 {
        *self.noise_variance.get_or_init(|| noise_variance(&self.base))
    }

    /// A level; 0 is the full-resolution image. Returns the coarsest level where `level` exceeds
    /// it.
    pub fn level(&self, level: usize) -> &GrayImage {
        match level {
            0 => &self.base,
            level => {
                let coarser = self.coarser();
                coarser.get(level - 1).or(coarser.last()).unwrap_or(&self.base)
            }
        }
    }

    /// The levels coarser than the full-resolution image.
    pub fn coarser(&self) -> &[GrayImage] {
        self.coarser.get_or_init(|| {
            let mut spare = self.spare.lock().unwrap_or_else(PoisonError::into_inner);
            let mut coarser = std::mem::take(&mut spare.coarser);
            coarser.truncate(self.levels - 1);
            for (level, (width, height)) in coarser_sizes(&self.base, self.most).enumerate() {
                if coarser
                    .get(level)
                    .is_none_or(|memory| (memory.width(), memory.height()) != (width, height))
                {
                    coarser.truncate(level);
                    coarser.push(GrayImage::new(width, height));
                }
            }
            let mut below = &self.base;
            for above in &mut coarser {
                halve(below, above, &mut spare.column_sums);
                below = above;
            }
            coarser
        })
    }
}

/// Width and height of the coarser levels of an image with at most `most` levels in total.
fn coarser_sizes(image: &GrayImage, most: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
    let half = |&(width, height): &(usize, usize)| {
        let half = (width.div_ceil(2), height.div_ceil(2));
        (half.0.min(half.1) >= SMALLEST_SIDE).then_some(half)
    };
    std::iter::successors(Some((image.width(), image.height())), half).skip(1).take(most.saturating_sub(1))
}

/// Halves images as the levels of a pyramid are made.
#[derive(Debug, Default)]
pub struct Halving {
    column_sums: Vec<u16>,
}

impl Halving {
    /// Makes `half` the next coarser level of an image.
    pub fn halve(&mut self, image: &GrayImage, half: &mut GrayImage) {
        half.resize(image.width().div_ceil(2), image.height().div_ceil(2));
        halve(image, half, &mut self.column_sums);
    }
}

/// Filters with the binomial kernel 1 4 6 4 1 in both directions and decimates by two (P. Burt and
/// E. Adelson, "The Laplacian pyramid", 1983). Beyond the border the image is mirrored about its
/// outermost samples.
fn halve(below: &GrayImage, above: &mut GrayImage, sums: &mut Vec<u16>) {
    let (width, height) = (below.width(), below.height());
    let mirrored = |i: isize, size: usize| -> usize {
        let last = size as isize - 1;
        let i = i.abs();
        (if i > last { 2 * last - i } else { i }).clamp(0, last) as usize
    };
    // Two extra sums on either side hold the mirrored border, so that the row pass has no special
    // cases.
    sums.resize(width + 4, 0);
    let above_width = above.width();
    for (y, out) in above.samples_mut().chunks_exact_mut(above_width).enumerate() {
        let row = |dy: isize| &below.row(mirrored(2 * y as isize + dy, height))[..width];
        blur_rows(row(-2), row(-1), row(0), row(1), row(2), &mut sums[2..2 + width]);
        sums[1] = sums[2 + mirrored(-1, width)];
        sums[0] = sums[2 + mirrored(-2, width)];
        sums[width + 2] = sums[2 + mirrored(width as isize, width)];
        sums[width + 3] = sums[2 + mirrored(width as isize + 1, width)];
        blur_and_halve(sums, out);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Direct implementation of the definition.
    fn halve_by_definition(image: &GrayImage, x: usize, y: usize) -> u8 {
        let weights = [1i64, 4, 6, 4, 1];
        let mirrored = |i: i64, size: i64| {
            if i < 0 {
                -i
            } else if i >= size {
                2 * size - 2 - i
            } else {
                i
            }
        };
        let mut total = 0;
        for (dy, wy) in weights.iter().enumerate() {
            for (dx, wx) in weights.iter().enumerate() {
                let sx = mirrored(2 * x as i64 + dx as i64 - 2, image.width() as i64);
                let sy = mirrored(2 * y as i64 + dy as i64 - 2, image.height() as i64);
                total += wx * wy * i64::from(image.row(sy as usize)[sx as usize]);
            }
        }
        ((total + 128) >> 8) as u8
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(20))]
        #[test]
        fn levels_are_the_binomial_blur_of_the_level_below(width in 48usize..70, height in 48usize..70, seed in any::<u32>()) {
            let mut state = seed;
            let samples = (0..width * height).map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8
            }).collect();
            let pyramid = Pyramid::new(GrayImage::from_samples(width, height, samples).unwrap(), 2);
            prop_assert_eq!(pyramid.levels(), 2);
            let half = pyramid.level(1);
            for y in 0..half.height() {
                for x in 0..half.width() {
                    prop_assert_eq!(half.row(y)[x], halve_by_definition(pyramid.base(), x, y));
                }
            }
        }
    }

    #[test]
    fn replacing_the_image_rebuilds_the_pyramid() {
        let ramp = |step: usize| {
            GrayImage::from_samples(64, 64, (0..64 * 64).map(|i| (i * step % 251) as u8).collect()).unwrap()
        };
        let mut pyramid = Pyramid::new(ramp(3), 3);
        assert_eq!(pyramid.coarser().len(), 1);
        let before = pyramid.replace(ramp(7));
        assert_eq!(before, ramp(3));
        assert_eq!(pyramid.coarser(), Pyramid::new(ramp(7), 3).coarser());
    }
}
