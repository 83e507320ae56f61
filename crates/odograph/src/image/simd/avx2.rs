//! Sampling and halving by hand, eight samples at a time.

use super::scalar::{self, row_start, total};
use super::{Appearance, Grid, PATCH_SIDE, Patch};
use crate::image::GrayImage;
use std::arch::x86_64::*;

/// Samples in a register.
const LANES: usize = 8;

/// See [`super::sample_patch`].
#[target_feature(enable = "avx2")]
pub fn sample_patch(image: &GrayImage, grid: &Grid, samples: &mut Patch) {
    let sampler = Sampler::new(image, grid);
    for (j, row) in samples.chunks_exact_mut(PATCH_SIDE).enumerate() {
        let [left, right] = sampler.row(row_start(grid, j));
        store(left, &mut row[..LANES]);
        store(right, &mut row[LANES..]);
    }
}

/// See [`super::sample_and_multiply`]: the samples are multiplied while they are still in registers.
#[target_feature(enable = "avx2")]
pub fn sample_and_multiply(
    image: &GrayImage,
    grid: &Grid,
    appearance: &Appearance,
    samples: &mut Patch,
) -> [f64; 3] {
    let sampler = Sampler::new(image, grid);
    let factors = [&appearance.contrast, &appearance.gradient_x, &appearance.gradient_y];
    let mut sums = [_mm256_setzero_ps(); 3];
    for (j, row) in samples.chunks_exact_mut(PATCH_SIDE).enumerate() {
        let halves = sampler.row(row_start(grid, j));
        for (half, values) in halves.into_iter().enumerate() {
            let at = half * LANES;
            store(values, &mut row[at..at + LANES]);
            for (sum, factor) in sums.iter_mut().zip(factors) {
                let factor = load(&factor[j * PATCH_SIDE + at..][..LANES]);
                *sum = _mm256_add_ps(*sum, _mm256_mul_ps(factor, values));
            }
        }
    }
    let mut totals = [0.0; 3];
    for (sum, result) in sums.into_iter().zip(&mut totals) {
        let mut lanes = [0.0f32; LANES];
        store(sum, &mut lanes);
        *result = total(lanes);
    }
    totals
}

/// An image made ready for being sampled along rows of one direction.
struct Sampler<'a> {
    samples: &'a [u8],
    width: usize,
    /// Steps of a row from its start to its first and last eight samples.
    steps: [[__m256; 2]; 2],
    /// The last place that has a neighbour to the right, below, and right of below.
    last: __m256i,
}

impl<'a> Sampler<'a> {
    #[target_feature(enable = "avx2")]
    fn new(image: &'a GrayImage, grid: &Grid) -> Self {
        let (samples, width) = (image.samples(), image.width());
        let steps = [
            _mm256_setr_ps(0., 1., 2., 3., 4., 5., 6., 7.),
            _mm256_setr_ps(8., 9., 10., 11., 12., 13., 14., 15.),
        ];
        let [dx, dy] = grid.along_row.map(|step| _mm256_set1_ps(step as f32));
        Self {
            samples,
            width,
            steps: steps.map(|i| [_mm256_mul_ps(dx, i), _mm256_mul_ps(dy, i)]),
            last: _mm256_set1_epi32((samples.len() - width - 2) as i32),
        }
    }

    /// The samples of a row that begins at `start`.
    #[target_feature(enable = "avx2")]
    fn row(&self, start: (f32, f32)) -> [__m256; 2] {
        let (x0, y0) = (_mm256_set1_ps(start.0), _mm256_set1_ps(start.1));
        let [left, right] = &self.steps;
        [
            self.eight(_mm256_add_ps(x0, left[0]), _mm256_add_ps(y0, left[1])),
            self.eight(_mm256_add_ps(x0, right[0]), _mm256_add_ps(y0, right[1])),
        ]
    }

    /// The samples at eight places.
    #[target_feature(enable = "avx2")]
    fn eight(&self, x: __m256, y: __m256) -> __m256 {
        let (column, line) = (_mm256_cvttps_epi32(x), _mm256_cvttps_epi32(y));
        let fx = _mm256_sub_ps(x, _mm256_cvtepi32_ps(column));
        let fy = _mm256_sub_ps(y, _mm256_cvtepi32_ps(line));
        let line_start = _mm256_mullo_epi32(line, _mm256_set1_epi32(self.width as i32));
        let at = _mm256_add_epi32(line_start, column);
        let at = _mm256_max_epi32(_mm256_min_epi32(at, self.last), _mm256_setzero_si256());
        let samples = self.samples.as_ptr();
        // SAFETY: `at` is within 0..=length − width − 2 in every lane, and the width is at least 2 (the callers assert it, and that there are two
        // rows, so that `last` is not negative). The first gather reads the bytes at..at + 4, at most up to length − width + 2 ≤ length;
        // the second reads at + width − 2..at + width + 2, from 0 at least, up to the length at most.
        let (upper, lower) = unsafe {
            (
                _mm256_i32gather_epi32::<1>(samples.cast(), at),
                _mm256_i32gather_epi32::<1>(samples.add(self.width - 2).cast(), at),
            )
        };
        let byte = _mm256_set1_epi32(0xff);
        let upper_left = _mm256_and_si256(upper, byte);
        let upper_right = _mm256_and_si256(_mm256_srli_epi32::<8>(upper), byte);
        let lower_left = _mm256_and_si256(_mm256_srli_epi32::<16>(lower), byte);
        let lower_right = _mm256_srli_epi32::<24>(lower);
        let upper = between(upper_left, upper_right, fx);
        let lower = between(lower_left, lower_right, fx);
        _mm256_add_ps(upper, _mm256_mul_ps(fy, _mm256_sub_ps(lower, upper)))
    }
}

/// `left + part · (right − left)`. Differences of bytes are exact in whole numbers as in `f32`.
#[target_feature(enable = "avx2")]
fn between(left: __m256i, right: __m256i, part: __m256) -> __m256 {
    let difference = _mm256_cvtepi32_ps(_mm256_sub_epi32(right, left));
    _mm256_add_ps(_mm256_cvtepi32_ps(left), _mm256_mul_ps(part, difference))
}

#[target_feature(enable = "avx2")]
fn load(from: &[f32]) -> __m256 {
    let from: &[f32; LANES] = from.first_chunk().expect("eight samples");
    // SAFETY: eight samples can be read there.
    unsafe { _mm256_loadu_ps(from.as_ptr()) }
}

#[target_feature(enable = "avx2")]
fn store(values: __m256, to: &mut [f32]) {
    let to: &mut [f32; LANES] = to.first_chunk_mut().expect("eight samples");
    // SAFETY: eight samples can be written there.
    unsafe { _mm256_storeu_ps(to.as_mut_ptr(), values) }
}

/// See [`super::blur_and_halve`].
#[target_feature(enable = "avx2")]
pub fn blur_and_halve(sums: &[u16], out: &mut [u8]) {
    let pair = |first: i16, second: i16| _mm256_set1_epi32(i32::from(first) | (i32::from(second) << 16));
    let weights = [pair(1, 4), pair(6, 4), pair(1, 0)];
    let half = _mm256_set1_epi32(128);
    let mut done = 0;
    for eight in out.chunks_exact_mut(LANES) {
        // The last load reaches one sum beyond the last that counts.
        let Some(from) = sums.get(2 * done..2 * done + 2 * LANES + 4) else { break };
        let mut total = half;
        for (i, weight) in weights.into_iter().enumerate() {
            // Sums are at most 16 · 255, so that they are the same with a sign.
            total = _mm256_add_epi32(total, _mm256_madd_epi16(load_sums(&from[2 * i..]), weight));
        }
        let gray = _mm256_srli_epi32::<8>(total);
        let words = _mm_packus_epi32(_mm256_castsi256_si128(gray), _mm256_extracti128_si256::<1>(gray));
        let bytes = _mm_cvtsi128_si64(_mm_packus_epi16(words, words));
        eight.copy_from_slice(&bytes.to_le_bytes());
        done += LANES;
    }
    scalar::blur_and_halve(&sums[2 * done..], &mut out[done..]);
}

#[target_feature(enable = "avx2")]
fn load_sums(from: &[u16]) -> __m256i {
    let from: &[u16; 2 * LANES] = from.first_chunk().expect("sixteen sums");
    // SAFETY: sixteen sums of 16 bits can be read there.
    unsafe { _mm256_loadu_si256(from.as_ptr().cast()) }
}
