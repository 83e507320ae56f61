//! Hand-written NEON kernels: sampling, sums over patches and decimation. Every 64-bit ARM
//! processor has NEON.

use super::scalar::{self, row_start, rows_about, total};
use super::{Grid, PATCH_SIDE, Patch, PatchSums, TemplateSamples, rows_about_neighbours};
use crate::image::GrayImage;
use std::arch::aarch64::*;

/// Samples processed at a time.
const LANES: usize = 8;

/// Bytes of an image row in one look-up table, right neighbours included.
const CHUNK: usize = 16;

/// Numbers of image rows that eight samples may span, with their neighbours below.
const ROWS: [usize; 3] = [3, 4, 5];

/// Row count for samples at arbitrary positions.
const ANY: usize = 0;

/// A row of a patch.
type PatchRow = [float32x4_t; 4];

/// See [`super::sample_patch`]; for images whose offsets fit 32 bits.
#[target_feature(enable = "neon")]
pub fn sample_patch(image: &GrayImage, grid: &Grid, samples: &mut Patch) {
    let sampler = SamplerNeon::new(image, grid);
    match rows_about_neighbours(image, grid, LANES, CHUNK, &ROWS) {
        Some(3) => sampler.sample::<3>(grid, samples),
        Some(4) => sampler.sample::<4>(grid, samples),
        Some(_) => sampler.sample::<5>(grid, samples),
        None => sampler.sample::<ANY>(grid, samples),
    }
}

/// See [`super::sample_and_multiply`]; for images whose offsets fit 32 bits.
#[target_feature(enable = "neon")]
pub fn sample_and_multiply(
    image: &GrayImage,
    grid: &Grid,
    appearance: &TemplateSamples,
    samples: &mut Patch,
) -> [f64; 3] {
    let sampler = SamplerNeon::new(image, grid);
    match rows_about_neighbours(image, grid, LANES, CHUNK, &ROWS) {
        Some(3) => sampler.multiply::<3>(grid, appearance, samples),
        Some(4) => sampler.multiply::<4>(grid, appearance, samples),
        Some(_) => sampler.multiply::<5>(grid, appearance, samples),
        None => sampler.multiply::<ANY>(grid, appearance, samples),
    }
}

/// Bilinear interpolation of eight samples. The halves of `left` and `right` are the upper and the
/// lower neighbours; `fx` and `fy` are the fractional offsets to the right and down.
#[inline]
#[target_feature(enable = "neon")]
pub fn between(
    left: uint8x16_t,
    right: uint8x16_t,
    fx: [float32x4_t; 2],
    fy: [float32x4_t; 2],
) -> [float32x4_t; 2] {
    // Differences of bytes are exact in integers as in `f32`.
    let upper_step = signed(vsubl_u8(vget_low_u8(right), vget_low_u8(left)));
    let lower_step = signed(vsubl_high_u8(right, left));
    let upper_left = unsigned(vmovl_u8(vget_low_u8(left)));
    let lower_left = unsigned(vmovl_high_u8(left));
    std::array::from_fn(|i| {
        let upper = vaddq_f32(upper_left[i], vmulq_f32(fx[i], upper_step[i]));
        let lower = vaddq_f32(lower_left[i], vmulq_f32(fx[i], lower_step[i]));
        vaddq_f32(upper, vmulq_f32(fy[i], vsubq_f32(lower, upper)))
    })
}

/// Converts eight unsigned 16-bit integers to `f32`.
#[inline]
#[target_feature(enable = "neon")]
pub fn unsigned(words: uint16x8_t) -> [float32x4_t; 2] {
    [vcvtq_f32_u32(vmovl_u16(vget_low_u16(words))), vcvtq_f32_u32(vmovl_high_u16(words))]
}

/// Converts eight signed 16-bit integers to `f32`.
#[inline]
#[target_feature(enable = "neon")]
fn signed(words: uint16x8_t) -> [float32x4_t; 2] {
    let words = vreinterpretq_s16_u16(words);
    [vcvtq_f32_s32(vmovl_s16(vget_low_s16(words))), vcvtq_f32_s32(vmovl_high_s16(words))]
}

/// Partial sums of the products of samples with a template, one per column.
struct ColumnProductsNeon<'a> {
    factors: [&'a [[f32; PATCH_SIDE]]; 3],
    sums: [PatchRow; 3],
}

impl<'a> ColumnProductsNeon<'a> {
    #[inline]
    #[target_feature(enable = "neon")]
    fn new(appearance: &'a TemplateSamples) -> Self {
        let TemplateSamples { contrast, gradient_x, gradient_y } = appearance;
        Self {
            factors: [contrast.as_chunks().0, gradient_x.as_chunks().0, gradient_y.as_chunks().0],
            sums: [[vdupq_n_f32(0.0); 4]; 3],
        }
    }

    /// Adds row `j`.
    #[inline]
    #[target_feature(enable = "neon")]
    fn add(&mut self, j: usize, values: PatchRow) {
        for (sums, factors) in self.sums.iter_mut().zip(self.factors) {
            let factors = load(&factors[j]);
            for i in 0..4 {
                sums[i] = vaddq_f32(sums[i], vmulq_f32(factors[i], values[i]));
            }
        }
    }

    #[inline]
    #[target_feature(enable = "neon")]
    fn totals(&self) -> [f64; 3] {
        let [contrast, x, y] = self.sums;
        [total_of(contrast), total_of(x), total_of(y)]
    }
}

/// Sampler of an image along rows of one direction.
///
/// Eight neighbouring samples of a grid that is not strongly rotated lie on few image rows and
/// within few columns: those are loaded as a whole and the samples looked up in them. Otherwise,
/// and near the end of the image, samples are loaded one by one.
struct SamplerNeon<'a> {
    samples: &'a [u8],
    width: usize,
    /// Offsets of the samples of a row from its first, along x and y.
    steps: [PatchRow; 2],
    /// Offsets of the first column and first row of the image used by the left eight and by the
    /// right eight samples.
    first: [[f32; 2]; 2],
    /// The last index that has a right, a lower and a lower right neighbour.
    last: uint32x4_t,
}

impl<'a> SamplerNeon<'a> {
    #[inline]
    #[target_feature(enable = "neon")]
    fn new(image: &'a GrayImage, grid: &Grid) -> Self {
        let (samples, width) = (image.samples(), image.width());
        let along = grid.along_row.map(|step| step as f32);
        let first = |half: usize, step: f32| {
            let end = if step < 0.0 { LANES - 1 } else { 0 };
            step * (half * LANES + end) as f32
        };
        Self {
            samples,
            width,
            steps: along.map(|step| load(&std::array::from_fn(|i| step * i as f32))),
            first: [0, 1].map(|half| along.map(|step| first(half, step))),
            last: vdupq_n_u32((samples.len() - width - 2) as u32),
        }
    }

    #[inline]
    #[target_feature(enable = "neon")]
    fn sample<const ROWS: usize>(&self, grid: &Grid, samples: &mut Patch) {
        for (j, row) in samples.as_chunks_mut::<PATCH_SIDE>().0.iter_mut().enumerate() {
            store(self.row::<ROWS>(row_start(grid, j)), row);
        }
    }

    #[inline]
    #[target_feature(enable = "neon")]
    fn multiply<const ROWS: usize>(
        &self,
        grid: &Grid,
        appearance: &TemplateSamples,
        samples: &mut Patch,
    ) -> [f64; 3] {
        let mut products = ColumnProductsNeon::new(appearance);
        for (j, row) in samples.as_chunks_mut::<PATCH_SIDE>().0.iter_mut().enumerate() {
            let values = self.row::<ROWS>(row_start(grid, j));
            store(values, row);
            products.add(j, values);
        }
        products.totals()
    }

    /// The samples of a row that begins at `start`.
    #[inline]
    #[target_feature(enable = "neon")]
    fn row<const ROWS: usize>(&self, start: (f32, f32)) -> PatchRow {
        let ([a, b], [c, d]) = (self.eight::<ROWS>(start, 0), self.eight::<ROWS>(start, 1));
        [a, b, c, d]
    }

    /// The left (0) or the right (1) eight samples of a row.
    #[inline]
    #[target_feature(enable = "neon")]
    fn eight<const ROWS: usize>(&self, (x0, y0): (f32, f32), half: usize) -> [float32x4_t; 2] {
        let place = |axis: usize, start: f32| {
            let steps = &self.steps[axis][2 * half..];
            [vaddq_f32(vdupq_n_f32(start), steps[0]), vaddq_f32(vdupq_n_f32(start), steps[1])]
        };
        let (x, y) = (place(0, x0), place(1, y0));
        // A position before the first column or row, by rounding, is clamped to it, as in the
        // reference.
        let (columns, lines) = (x.map(|x| vcvtq_u32_f32(x)), y.map(|y| vcvtq_u32_f32(y)));
        let (upper, lower) = if ROWS == ANY {
            self.one_by_one(columns, lines)
        } else {
            let [to_column, to_line] = self.first[half];
            self.looked_up::<ROWS>(columns, lines, ((x0 + to_column) as usize, (y0 + to_line) as usize))
        };
        let beyond = |place: [float32x4_t; 2], whole: [uint32x4_t; 2]| -> [float32x4_t; 2] {
            std::array::from_fn(|i| vsubq_f32(place[i], vcvtq_f32_u32(whole[i])))
        };
        let (left, right) = (vuzp1q_u8(upper, lower), vuzp2q_u8(upper, lower));
        between(left, right, beyond(x, columns), beyond(y, lines))
    }

    /// The upper and the lower two samples of eight positions side by side. The positions must be
    /// on few rows and within few columns from `first` on.
    #[inline]
    #[target_feature(enable = "neon")]
    fn looked_up<const ROWS: usize>(
        &self,
        columns: [uint32x4_t; 2],
        lines: [uint32x4_t; 2],
        first: (usize, usize),
    ) -> (uint8x16_t, uint8x16_t) {
        let words = |[a, b]: [uint32x4_t; 2]| vuzp1q_u16(vreinterpretq_u16_u32(a), vreinterpretq_u16_u32(b));
        // Only the difference matters, so overflow of 16 bits is harmless.
        let place = vaddq_u16(words(columns), vshlq_n_u16::<4>(words(lines)));
        let place = vsubq_u16(place, vdupq_n_u16((first.0 + CHUNK * first.1) as u16));
        let twice = vreinterpretq_u8_u16(vsliq_n_u16::<8>(place, place));
        let neighbours = vaddq_u8(twice, vreinterpretq_u8_u16(vdupq_n_u16(0x0100)));
        let at = first.1 * self.width + first.0;
        let near = &self.samples[at..][..(ROWS - 1) * self.width + CHUNK];
        // SAFETY: `near` ends with a chunk of the last row, the last one requested.
        let row = |k: usize| unsafe { vld1q_u8(near.as_ptr().add(k * self.width)) };
        // The lower two have the same indices in a table that begins one row later.
        match ROWS {
            3 => {
                let (a, b, c) = (row(0), row(1), row(2));
                (vqtbl2q_u8(uint8x16x2_t(a, b), neighbours), vqtbl2q_u8(uint8x16x2_t(b, c), neighbours))
            }
            4 => {
                let (a, b, c, d) = (row(0), row(1), row(2), row(3));
                (vqtbl3q_u8(uint8x16x3_t(a, b, c), neighbours), vqtbl3q_u8(uint8x16x3_t(b, c, d), neighbours))
            }
            _ => {
                let (a, b, c, d, e) = (row(0), row(1), row(2), row(3), row(4));
                (
                    vqtbl4q_u8(uint8x16x4_t(a, b, c, d), neighbours),
                    vqtbl4q_u8(uint8x16x4_t(b, c, d, e), neighbours),
                )
            }
        }
    }

    /// As [`Self::looked_up`], for arbitrary positions.
    #[inline]
    #[target_feature(enable = "neon")]
    fn one_by_one(&self, columns: [uint32x4_t; 2], lines: [uint32x4_t; 2]) -> (uint8x16_t, uint8x16_t) {
        let mut at = [0; LANES];
        for (at, (column, line)) in at.as_chunks_mut::<4>().0.iter_mut().zip(columns.into_iter().zip(lines)) {
            let places = vmlaq_n_u32(column, line, self.width as u32);
            // SAFETY: writes four values over four.
            unsafe { vst1q_u32(at.as_mut_ptr(), vminq_u32(places, self.last)) };
        }
        let pairs = |below: usize| {
            let pairs: [u16; LANES] = std::array::from_fn(|i| {
                // SAFETY: the index is at most the last one whose neighbours read here exist.
                unsafe { self.samples.as_ptr().add(at[i] as usize + below).cast::<u16>().read_unaligned() }
            });
            // SAFETY: reads eight values from an array of eight.
            vreinterpretq_u8_u16(unsafe { vld1q_u16(pairs.as_ptr()) })
        };
        (pairs(0), pairs(self.width))
    }
}

/// See [`super::dot`].
#[target_feature(enable = "neon")]
pub fn dot(a: &Patch, b: &Patch) -> f64 {
    let mut sums = [vdupq_n_f32(0.0); 4];
    for (a, b) in a.as_chunks().0.iter().zip(b.as_chunks().0) {
        let (a, b) = (load(a), load(b));
        for i in 0..4 {
            sums[i] = vaddq_f32(sums[i], vmulq_f32(a[i], b[i]));
        }
    }
    total_of(sums)
}

/// Total of the partial sums; see [`total`].
#[inline]
#[target_feature(enable = "neon")]
fn total_of(sums: PatchRow) -> f64 {
    let mut lanes = [0.0; PATCH_SIDE];
    store(sums, &mut lanes);
    total(lanes)
}

/// See [`super::patch_sums`]. Integer addition is exact, so the order is irrelevant.
#[target_feature(enable = "neon")]
pub fn patch_sums(image: &GrayImage, left: usize, top: usize) -> PatchSums {
    let mut singles = [vdupq_n_s16(0); 3];
    let mut products = [vdupq_n_s32(0); 6];
    let difference = |a: uint8x16_t, b: uint8x16_t| {
        let halves = [vsubl_u8(vget_low_u8(a), vget_low_u8(b)), vsubl_high_u8(a, b)];
        halves.map(|half| vreinterpretq_s16_u16(half))
    };
    for j in 0..PATCH_SIDE {
        let [above, here, below] = rows_about(image, left, top, j);
        let sample = difference(load_chunk(&here[1..]), vdupq_n_u8(0));
        let x = difference(load_chunk(&here[2..]), load_chunk(here));
        let y = difference(load_chunk(&below[1..]), load_chunk(&above[1..]));
        for half in 0..2 {
            let (sample, x, y) = (sample[half], x[half], y[half]);
            for (sum, term) in singles.iter_mut().zip([sample, x, y]) {
                *sum = vaddq_s16(*sum, term); // at most 32 · 255
            }
            let pairs = [(sample, sample), (sample, x), (sample, y), (x, x), (x, y), (y, y)];
            for (sum, (a, b)) in products.iter_mut().zip(pairs) {
                *sum = vmlal_s16(*sum, vget_low_s16(a), vget_low_s16(b));
                *sum = vmlal_high_s16(*sum, a, b);
            }
        }
    }
    let [sample, x, y] = singles.map(|sum| vaddlvq_s16(sum));
    let [sample_sample, sample_x, sample_y, x_x, x_y, y_y] = products.map(|sum| vaddvq_s32(sum));
    PatchSums { sample, x, y, sample_sample, sample_x, sample_y, x_x, x_y, y_y }
}

/// See [`super::blur_and_halve`].
#[target_feature(enable = "neon")]
pub fn blur_and_halve(sums: &[u16], out: &mut [u8]) {
    let Some(last) = out.len().checked_sub(LANES) else {
        return scalar::blur_and_halve(sums, out);
    };
    for (number, eight) in out.as_chunks_mut().0.iter_mut().enumerate() {
        halve_eight(&sums[2 * LANES * number..], eight);
    }
    // The last eight, which may overlap those already done.
    if let Some(eight) = out[last..].first_chunk_mut() {
        halve_eight(&sums[2 * last..], eight);
    }
}

#[inline]
#[target_feature(enable = "neon")]
fn halve_eight(sums: &[u16], out: &mut [u8; LANES]) {
    let sums: &[u16; 2 * LANES + 3] = sums.first_chunk().expect("as many sums as eight samples are made of");
    // SAFETY: reads sixteen sums from the first on and from the fourth on, of 19.
    let (from_first, from_fourth) = unsafe { (vld2q_u16(sums.as_ptr()), vld2q_u16(sums.as_ptr().add(3))) };
    let (uint16x8x2_t(first, second), uint16x8x2_t(fourth, fifth)) = (from_first, from_fourth);
    // The third sum is the first of the next sample; for the last sample it is the fifth of the
    // last but one.
    let third = vextq_u16::<1>(first, vextq_u16::<6>(fifth, fifth));
    // The largest total, 16 · 16 · 255, plus the half added for rounding just fits 16 bits.
    let total = vmlaq_n_u16(vaddq_u16(first, fifth), vaddq_u16(second, fourth), 4);
    let gray = vrshrn_n_u16::<8>(vmlaq_n_u16(total, third, 6));
    // SAFETY: writes eight samples over eight.
    unsafe { vst1_u8(out.as_mut_ptr(), gray) };
}

#[inline]
#[target_feature(enable = "neon")]
fn load_chunk(from: &[u8]) -> uint8x16_t {
    let from: &[u8; CHUNK] = from.first_chunk().expect("a chunk");
    // SAFETY: reads 16 bytes from an array of 16.
    unsafe { vld1q_u8(from.as_ptr()) }
}

#[inline]
#[target_feature(enable = "neon")]
fn load(from: &[f32; PATCH_SIDE]) -> PatchRow {
    // SAFETY: reads four samples from each multiple of four on, within 16.
    std::array::from_fn(|i| unsafe { vld1q_f32(from.as_ptr().add(4 * i)) })
}

#[inline]
#[target_feature(enable = "neon")]
fn store(values: PatchRow, to: &mut [f32; PATCH_SIDE]) {
    for (i, four) in values.into_iter().enumerate() {
        // SAFETY: writes four samples from each multiple of four on, within 16.
        unsafe { vst1q_f32(to.as_mut_ptr().add(4 * i), four) };
    }
}
