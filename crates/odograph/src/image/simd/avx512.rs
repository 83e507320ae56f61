//! Hand-written AVX-512 sampling, sixteen samples at a time: a whole row of a patch per register.
//!
//! The four neighbours of sixteen samples are 64 bytes. One permutation (AVX-512 VBMI) selects them
//! from four chunks of image rows, two from eight. The arithmetic is that of the reference, in its
//! order.

use super::scalar::{row_start, total};
use super::{Grid, PATCH_SIDE, Patch, Shift, TemplateSamples, rows_about_neighbours};
use crate::image::GrayImage;
use std::arch::x86_64::*;

/// Bytes of an image row that contain a row of the patch with its right neighbours.
const CHUNK: usize = 32;

/// Maximum numbers of image rows that a row of the patch may span, with its neighbours below.
const FEW_ROWS: usize = 4;
const MANY_ROWS: usize = 8;

/// Whether the processor has the required features.
pub fn is_here() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512vbmi")
}

/// Number of image rows spanned by each row of a grid; `None` where that is too many or a chunk
/// would exceed the image. `Some` for patches rotated by at most 0.4 rad, less than twice as wide,
/// and not at the very end of the image.
pub fn rows(image: &GrayImage, grid: &Grid) -> Option<usize> {
    rows_about_neighbours(image, grid, PATCH_SIDE, CHUNK, &[FEW_ROWS, MANY_ROWS])
}

/// See [`super::sample_patch`]; `rows` is the result of [`rows`].
#[target_feature(enable = "avx512f,avx512bw,avx512vbmi")]
pub fn sample_patch(image: &GrayImage, grid: &Grid, rows: usize, samples: &mut Patch) {
    let sampler = Sampler512::new(image, grid);
    for (j, row) in samples.as_chunks_mut::<PATCH_SIDE>().0.iter_mut().enumerate() {
        let start = row_start(grid, j);
        let values =
            if rows == FEW_ROWS { sampler.row::<FEW_ROWS>(start) } else { sampler.row::<MANY_ROWS>(start) };
        store(values, row);
    }
}

/// See [`super::sample_and_multiply`]; `rows` is the result of [`rows`].
#[target_feature(enable = "avx512f,avx512bw,avx512vbmi")]
pub fn sample_and_multiply(
    image: &GrayImage,
    grid: &Grid,
    rows: usize,
    appearance: &TemplateSamples,
    samples: &mut Patch,
) -> [f64; 3] {
    let sampler = Sampler512::new(image, grid);
    if rows == FEW_ROWS {
        sampler.multiply::<FEW_ROWS>(grid, appearance, samples)
    } else {
        sampler.multiply::<MANY_ROWS>(grid, appearance, samples)
    }
}

/// See [`super::multiply_shifted`].
#[target_feature(enable = "avx512f,avx512bw,avx512vbmi")]
pub fn multiply_shifted(
    image: &GrayImage,
    shift: &Shift,
    appearance: &TemplateSamples,
    samples: &mut Patch,
) -> [f64; 3] {
    let (fx, fy) = (_mm512_set1_ps(shift.fx), _mm512_set1_ps(shift.fy));
    let mut products = ColumnProducts512::new(appearance);
    let mut upper = between_columns(&image.row(shift.top)[shift.left..], fx);
    for (j, row) in samples.as_chunks_mut::<PATCH_SIDE>().0.iter_mut().enumerate() {
        let lower = between_columns(&image.row(shift.top + j + 1)[shift.left..], fx);
        let values = _mm512_add_ps(upper, _mm512_mul_ps(fy, _mm512_sub_ps(lower, upper)));
        store(values, row);
        products.add(j, values);
        upper = lower;
    }
    products.totals()
}

/// Interpolates sixteen samples of an image row with their right neighbours.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512vbmi")]
fn between_columns(row: &[u8], fx: __m512) -> __m512 {
    let (left, right) = (load_bytes(row), load_bytes(&row[1..]));
    let step = _mm512_cvtepi32_ps(_mm512_sub_epi32(right, left));
    _mm512_add_ps(_mm512_cvtepi32_ps(left), _mm512_mul_ps(fx, step))
}

/// Partial sums of the products of samples with a template, one per column.
struct ColumnProducts512<'a> {
    contrast: &'a [[f32; PATCH_SIDE]],
    gradient_x: &'a [[f32; PATCH_SIDE]],
    gradient_y: &'a [[f32; PATCH_SIDE]],
    sums: [__m512; 3],
}

impl<'a> ColumnProducts512<'a> {
    #[inline]
    #[target_feature(enable = "avx512f")]
    fn new(appearance: &'a TemplateSamples) -> Self {
        Self {
            contrast: appearance.contrast.as_chunks().0,
            gradient_x: appearance.gradient_x.as_chunks().0,
            gradient_y: appearance.gradient_y.as_chunks().0,
            sums: [_mm512_setzero_ps(); 3],
        }
    }

    /// Adds row `j`.
    #[inline]
    #[target_feature(enable = "avx512f")]
    fn add(&mut self, j: usize, values: __m512) {
        let [contrast, x, y] = &mut self.sums;
        *contrast = _mm512_add_ps(*contrast, _mm512_mul_ps(load(&self.contrast[j]), values));
        *x = _mm512_add_ps(*x, _mm512_mul_ps(load(&self.gradient_x[j]), values));
        *y = _mm512_add_ps(*y, _mm512_mul_ps(load(&self.gradient_y[j]), values));
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn totals(&self) -> [f64; 3] {
        let mut totals = [0.0; 3];
        for (sum, result) in self.sums.iter().zip(&mut totals) {
            let mut lanes = [0.0; PATCH_SIDE];
            store(*sum, &mut lanes);
            *result = total(lanes);
        }
        totals
    }
}

/// Sampler of an image along rows of one direction.
struct Sampler512<'a> {
    samples: &'a [u8],
    width: usize,
    /// Offsets of a row's samples from its first, along x and y, and of its last one.
    steps: [__m512; 2],
    last: [f32; 2],
}

impl<'a> Sampler512<'a> {
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vbmi")]
    fn new(image: &'a GrayImage, grid: &Grid) -> Self {
        let places = _mm512_setr_ps(0., 1., 2., 3., 4., 5., 6., 7., 8., 9., 10., 11., 12., 13., 14., 15.);
        let (dx, dy) = (grid.along_row[0] as f32, grid.along_row[1] as f32);
        let to_last = (PATCH_SIDE - 1) as f32;
        Self {
            samples: image.samples(),
            width: image.width(),
            steps: [_mm512_mul_ps(_mm512_set1_ps(dx), places), _mm512_mul_ps(_mm512_set1_ps(dy), places)],
            last: [dx * to_last, dy * to_last],
        }
    }

    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vbmi")]
    fn multiply<const ROWS: usize>(
        &self,
        grid: &Grid,
        appearance: &TemplateSamples,
        samples: &mut Patch,
    ) -> [f64; 3] {
        let mut products = ColumnProducts512::new(appearance);
        for (j, row) in samples.as_chunks_mut::<PATCH_SIDE>().0.iter_mut().enumerate() {
            let values = self.row::<ROWS>(row_start(grid, j));
            store(values, row);
            products.add(j, values);
        }
        products.totals()
    }

    /// The samples of a row that begins at `start`.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vbmi")]
    fn row<const ROWS: usize>(&self, (x0, y0): (f32, f32)) -> __m512 {
        let x = _mm512_add_ps(_mm512_set1_ps(x0), self.steps[0]);
        let y = _mm512_add_ps(_mm512_set1_ps(y0), self.steps[1]);
        let (column, line) = (_mm512_cvttps_epi32(x), _mm512_cvttps_epi32(y));
        let fx = _mm512_sub_ps(x, _mm512_cvtepi32_ps(column));
        let fy = _mm512_sub_ps(y, _mm512_cvtepi32_ps(line));
        // Positions along a row are monotonic, so the minimum is at one of its ends.
        let left = x0.min(x0 + self.last[0]) as usize;
        let top = y0.min(y0 + self.last[1]) as usize;
        let lines_on = _mm512_sub_epi32(line, _mm512_set1_epi32(top as i32));
        let columns_on = _mm512_sub_epi32(column, _mm512_set1_epi32(left as i32));
        let at = _mm512_add_epi32(_mm512_slli_epi32::<5>(lines_on), columns_on);
        // Four bytes of each sample: itself, its right neighbour, and those of the next row, 32
        // bytes later.
        let every_fourth = _mm512_set4_epi32(0x0c0c_0c0c, 0x0808_0808, 0x0404_0404, 0);
        let at = _mm512_add_epi8(_mm512_shuffle_epi8(at, every_fourth), _mm512_set1_epi32(0x2120_0100));
        let from = top * self.width + left;
        let mut four =
            _mm512_permutex2var_epi8(self.two_rows(from), at, self.two_rows(from + 2 * self.width));
        if ROWS == MANY_ROWS {
            // The permutation ignores the eighth bit of an index: it selects the other four rows.
            let (third, fourth) =
                (self.two_rows(from + 4 * self.width), self.two_rows(from + 6 * self.width));
            let other = _mm512_permutex2var_epi8(third, at, fourth);
            four = _mm512_mask_blend_epi8(_mm512_movepi8_mask(at), four, other);
        }
        let byte = _mm512_set1_epi32(0xff);
        let upper_left = _mm512_cvtepi32_ps(_mm512_and_si512(four, byte));
        let lower_left = _mm512_cvtepi32_ps(_mm512_and_si512(_mm512_srli_epi32::<16>(four), byte));
        // Right minus left, of both rows, 16 bits each. Differences of bytes are exact in integers
        // as in `f32`.
        let steps = _mm512_maddubs_epi16(four, _mm512_set1_epi16(0x01ff));
        let upper_step = _mm512_cvtepi32_ps(_mm512_srai_epi32::<16>(_mm512_slli_epi32::<16>(steps)));
        let lower_step = _mm512_cvtepi32_ps(_mm512_srai_epi32::<16>(steps));
        let upper = _mm512_add_ps(upper_left, _mm512_mul_ps(fx, upper_step));
        let lower = _mm512_add_ps(lower_left, _mm512_mul_ps(fx, lower_step));
        _mm512_add_ps(upper, _mm512_mul_ps(fy, _mm512_sub_ps(lower, upper)))
    }

    /// Chunks of two consecutive image rows from this index on.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512vbmi")]
    fn two_rows(&self, from: usize) -> __m512i {
        let (first, second) =
            (load_chunk(&self.samples[from..]), load_chunk(&self.samples[from + self.width..]));
        _mm512_inserti64x4::<1>(_mm512_castsi256_si512(first), second)
    }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn load_chunk(from: &[u8]) -> __m256i {
    let from: &[u8; CHUNK] = from.first_chunk().expect("a chunk");
    // SAFETY: reads 32 bytes from an array of 32.
    unsafe { _mm256_loadu_si256(from.as_ptr().cast()) }
}

/// Widens sixteen bytes to 32-bit integers.
#[inline]
#[target_feature(enable = "avx512f")]
fn load_bytes(from: &[u8]) -> __m512i {
    let from: &[u8; PATCH_SIDE] = from.first_chunk().expect("sixteen bytes");
    // SAFETY: reads 16 bytes from an array of 16.
    _mm512_cvtepu8_epi32(unsafe { _mm_loadu_si128(from.as_ptr().cast()) })
}

#[inline]
#[target_feature(enable = "avx512f")]
fn load(from: &[f32; PATCH_SIDE]) -> __m512 {
    // SAFETY: reads sixteen samples from an array of sixteen.
    unsafe { _mm512_loadu_ps(from.as_ptr()) }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn store(values: __m512, to: &mut [f32; PATCH_SIDE]) {
    // SAFETY: writes sixteen samples to an array of sixteen.
    unsafe { _mm512_storeu_ps(to.as_mut_ptr(), values) }
}
