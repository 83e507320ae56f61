//! Hand-written AVX2 kernels: sampling and decimation, eight samples at a time.

use super::scalar::{self, row_start, rows_about, total};
use super::{Grid, PATCH_SIDE, Patch, PatchSums, TemplateSamples, rows_about_neighbours};
use crate::image::GrayImage;
use std::arch::x86_64::*;

/// Samples per register.
const LANES: usize = 8;

/// See [`super::sample_patch`].
#[target_feature(enable = "avx2")]
pub fn sample_patch(image: &GrayImage, grid: &Grid, samples: &mut Patch) {
    let sampler = Sampler::new(image, grid);
    match sampler.rows {
        3 => sampler.sample::<3>(grid, samples),
        4 => sampler.sample::<4>(grid, samples),
        _ => sampler.sample::<ANY>(grid, samples),
    }
}

/// See [`super::sample_and_multiply`]: the samples are multiplied while they are in registers.
#[target_feature(enable = "avx2")]
pub fn sample_and_multiply(
    image: &GrayImage,
    grid: &Grid,
    appearance: &TemplateSamples,
    samples: &mut Patch,
) -> [f64; 3] {
    let sampler = Sampler::new(image, grid);
    match sampler.rows {
        3 => sampler.multiply::<3>(grid, appearance, samples),
        4 => sampler.multiply::<4>(grid, appearance, samples),
        _ => sampler.multiply::<ANY>(grid, appearance, samples),
    }
}

/// Sampler of an image along rows of one direction.
///
/// Eight neighbouring samples of a grid that is not strongly rotated lie on few image rows and
/// within few columns: those are loaded as a whole and shuffled. Otherwise, and near the end of the
/// image, samples are gathered one by one, which takes three times as long.
struct Sampler<'a> {
    samples: &'a [u8],
    width: usize,
    /// Offsets of a row's first and last eight samples from its first.
    steps: [[__m256; 2]; 2],
    /// The last index that has a right, a lower and a lower right neighbour.
    last: __m256i,
    /// Number of image rows spanned by eight samples and those below them, 3 or 4; [`ANY`] for
    /// arbitrary positions.
    rows: usize,
    /// Lane of the sample on the first row, and of the one in the first column.
    first_line: __m256i,
    first_column: __m256i,
}

/// See [`Sampler::rows`].
const ANY: usize = 0;

/// Bytes per shuffle.
const CHUNK: usize = 16;

impl<'a> Sampler<'a> {
    #[target_feature(enable = "avx2")]
    fn new(image: &'a GrayImage, grid: &Grid) -> Self {
        let (samples, width) = (image.samples(), image.width());
        let steps = [
            _mm256_setr_ps(0., 1., 2., 3., 4., 5., 6., 7.),
            _mm256_setr_ps(8., 9., 10., 11., 12., 13., 14., 15.),
        ];
        let [dx, dy] = grid.along_row.map(|step| _mm256_set1_ps(step as f32));
        let end = |step: f64| _mm256_set1_epi32(if step < 0.0 { LANES as i32 - 1 } else { 0 });
        Self {
            samples,
            width,
            steps: steps.map(|i| [_mm256_mul_ps(dx, i), _mm256_mul_ps(dy, i)]),
            last: _mm256_set1_epi32((samples.len() - width - 2) as i32),
            rows: rows_about_neighbours(image, grid, LANES, CHUNK, &[3, 4]).unwrap_or(ANY),
            first_line: end(grid.along_row[1]),
            first_column: end(grid.along_row[0]),
        }
    }

    #[target_feature(enable = "avx2")]
    fn sample<const ROWS: usize>(&self, grid: &Grid, samples: &mut Patch) {
        for (j, row) in samples.chunks_exact_mut(PATCH_SIDE).enumerate() {
            let [left, right] = self.row::<ROWS>(row_start(grid, j));
            store(left, &mut row[..LANES]);
            store(right, &mut row[LANES..]);
        }
    }

    #[target_feature(enable = "avx2")]
    fn multiply<const ROWS: usize>(
        &self,
        grid: &Grid,
        appearance: &TemplateSamples,
        samples: &mut Patch,
    ) -> [f64; 3] {
        let factors = [&appearance.contrast, &appearance.gradient_x, &appearance.gradient_y];
        let mut sums = [[_mm256_setzero_ps(); 2]; 3];
        for (j, row) in samples.chunks_exact_mut(PATCH_SIDE).enumerate() {
            let halves = self.row::<ROWS>(row_start(grid, j));
            for (half, values) in halves.into_iter().enumerate() {
                let at = half * LANES;
                store(values, &mut row[at..at + LANES]);
                for (sums, factor) in sums.iter_mut().zip(factors) {
                    let factor = load(&factor[j * PATCH_SIDE + at..][..LANES]);
                    sums[half] = _mm256_add_ps(sums[half], _mm256_mul_ps(factor, values));
                }
            }
        }
        let mut totals = [0.0; 3];
        for (sums, result) in sums.into_iter().zip(&mut totals) {
            let mut lanes = [0.0f32; PATCH_SIDE];
            store(sums[0], &mut lanes[..LANES]);
            store(sums[1], &mut lanes[LANES..]);
            *result = total(lanes);
        }
        totals
    }

    /// The samples of a row that begins at `start`.
    #[inline]
    #[target_feature(enable = "avx2")]
    fn row<const ROWS: usize>(&self, start: (f32, f32)) -> [__m256; 2] {
        let (x0, y0) = (_mm256_set1_ps(start.0), _mm256_set1_ps(start.1));
        let [left, right] = &self.steps;
        let left = (_mm256_add_ps(x0, left[0]), _mm256_add_ps(y0, left[1]));
        let right = (_mm256_add_ps(x0, right[0]), _mm256_add_ps(y0, right[1]));
        if ROWS == ANY {
            return [self.eight(left.0, left.1), self.eight(right.0, right.1)];
        }
        self.twice_eight::<ROWS>(left, right)
    }

    /// The samples at two times eight positions; each eight on few rows and within few columns.
    #[inline]
    #[target_feature(enable = "avx2")]
    fn twice_eight<const ROWS: usize>(&self, left: (__m256, __m256), right: (__m256, __m256)) -> [__m256; 2] {
        let left = EightPositions::new(left, self);
        let right = EightPositions::new(right, self);
        // From here the left eight are in the lower half of a register, 16 bits each, and the right
        // eight in the upper half.
        let columns = as_words(left.columns, right.columns);
        let lines = as_words(left.lines, right.lines);
        let twice =
            _mm256_broadcastsi128_si256(_mm_setr_epi8(0, 0, 2, 2, 4, 4, 6, 6, 8, 8, 10, 10, 12, 12, 14, 14));
        let neighbours = _mm256_add_epi8(_mm256_shuffle_epi8(columns, twice), _mm256_set1_epi16(0x0100));
        let row = |k: usize| {
            let chunk = |at: usize| load_chunk(&self.samples[at + k * self.width..]);
            let chunks = _mm256_set_m128i(chunk(right.at), chunk(left.at));
            _mm256_shuffle_epi8(chunks, neighbours)
        };
        let (first, second, third) = (row(0), row(1), row(2));
        let beyond_first = _mm256_cmpgt_epi16(lines, _mm256_setzero_si256());
        let mut upper = _mm256_blendv_epi8(first, second, beyond_first);
        let mut lower = _mm256_blendv_epi8(second, third, beyond_first);
        if ROWS == 4 {
            let beyond_second = _mm256_cmpgt_epi16(lines, _mm256_set1_epi16(1));
            upper = _mm256_blendv_epi8(upper, third, beyond_second);
            lower = _mm256_blendv_epi8(lower, row(3), beyond_second);
        }
        let (upper, lower) = (LeftAndStep::new(upper), LeftAndStep::new(lower));
        let between = |eight: &EightPositions, upper: (__m256, __m256), lower: (__m256, __m256)| {
            let upper = _mm256_add_ps(upper.0, _mm256_mul_ps(eight.fx, upper.1));
            let lower = _mm256_add_ps(lower.0, _mm256_mul_ps(eight.fx, lower.1));
            _mm256_add_ps(upper, _mm256_mul_ps(eight.fy, _mm256_sub_ps(lower, upper)))
        };
        [
            between(&left, upper.lower_half(), lower.lower_half()),
            between(&right, upper.upper_half(), lower.upper_half()),
        ]
    }

    /// The samples at eight arbitrary positions.
    #[inline]
    #[target_feature(enable = "avx2")]
    fn eight(&self, x: __m256, y: __m256) -> __m256 {
        let (column, line) = (_mm256_cvttps_epi32(x), _mm256_cvttps_epi32(y));
        let fx = _mm256_sub_ps(x, _mm256_cvtepi32_ps(column));
        let fy = _mm256_sub_ps(y, _mm256_cvtepi32_ps(line));
        let line_start = _mm256_mullo_epi32(line, _mm256_set1_epi32(self.width as i32));
        let at = _mm256_add_epi32(line_start, column);
        let at = _mm256_max_epi32(_mm256_min_epi32(at, self.last), _mm256_setzero_si256());
        let samples = self.samples.as_ptr();
        // SAFETY: `at` is within 0..=length − width − 2 in every lane. The width is at least 2; the
        // callers assert it, and that there are two rows, so `last` is not negative. The first
        // gather reads the bytes at..at + 4, at most up to length − width + 2 ≤ length. The second
        // reads at + width − 2..at + width + 2, from at least 0 up to at most the length.
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

/// Eight positions relative to `at`, the start of the first chunk of bytes that contains all of
/// them.
struct EightPositions {
    columns: __m256i,
    lines: __m256i,
    fx: __m256,
    fy: __m256,
    at: usize,
}

impl EightPositions {
    #[inline]
    #[target_feature(enable = "avx2")]
    fn new((x, y): (__m256, __m256), sampler: &Sampler<'_>) -> Self {
        let (column, line) = (_mm256_cvttps_epi32(x), _mm256_cvttps_epi32(y));
        let first_column = _mm256_permutevar8x32_epi32(column, sampler.first_column);
        let first_line = _mm256_permutevar8x32_epi32(line, sampler.first_line);
        let at = |first: __m256i| _mm256_cvtsi256_si32(first).max(0) as usize;
        Self {
            columns: _mm256_sub_epi32(column, first_column),
            lines: _mm256_sub_epi32(line, first_line),
            fx: _mm256_sub_ps(x, _mm256_cvtepi32_ps(column)),
            fy: _mm256_sub_ps(y, _mm256_cvtepi32_ps(line)),
            at: at(first_line) * sampler.width + at(first_column),
        }
    }
}

/// Packs two times eight integers to 16 bits, the left eight in the lower half.
#[inline]
#[target_feature(enable = "avx2")]
fn as_words(left: __m256i, right: __m256i) -> __m256i {
    let first = _mm256_permute2x128_si256::<0x20>(left, right);
    let last = _mm256_permute2x128_si256::<0x31>(left, right);
    _mm256_packs_epi32(first, last)
}

/// Left samples of pairs of neighbours, and right minus left. Exact in integers as in `f32`.
struct LeftAndStep {
    left: __m256i,
    step: __m256i,
}

impl LeftAndStep {
    #[inline]
    #[target_feature(enable = "avx2")]
    fn new(pairs: __m256i) -> Self {
        let left = _mm256_and_si256(pairs, _mm256_set1_epi16(0xff));
        Self { left, step: _mm256_maddubs_epi16(pairs, _mm256_set1_epi16(0x01ff)) }
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn lower_half(&self) -> (__m256, __m256) {
        let wide = |words: __m256i| _mm256_cvtepi16_epi32(_mm256_castsi256_si128(words));
        (_mm256_cvtepi32_ps(wide(self.left)), _mm256_cvtepi32_ps(wide(self.step)))
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn upper_half(&self) -> (__m256, __m256) {
        let wide = |words: __m256i| _mm256_cvtepi16_epi32(_mm256_extracti128_si256::<1>(words));
        (_mm256_cvtepi32_ps(wide(self.left)), _mm256_cvtepi32_ps(wide(self.step)))
    }
}

#[inline]
#[target_feature(enable = "avx2")]
fn load_chunk(from: &[u8]) -> __m128i {
    let from: &[u8; CHUNK] = from.first_chunk().expect("a chunk");
    // SAFETY: reads 16 bytes from an array of 16.
    unsafe { _mm_loadu_si128(from.as_ptr().cast()) }
}

/// `left + part · (right − left)`. Differences of bytes are exact in integers as in `f32`.
#[target_feature(enable = "avx2")]
fn between(left: __m256i, right: __m256i, part: __m256) -> __m256 {
    let difference = _mm256_cvtepi32_ps(_mm256_sub_epi32(right, left));
    _mm256_add_ps(_mm256_cvtepi32_ps(left), _mm256_mul_ps(part, difference))
}

#[target_feature(enable = "avx2")]
fn load(from: &[f32]) -> __m256 {
    let from: &[f32; LANES] = from.first_chunk().expect("eight samples");
    // SAFETY: reads eight samples from an array of eight.
    unsafe { _mm256_loadu_ps(from.as_ptr()) }
}

#[target_feature(enable = "avx2")]
fn store(values: __m256, to: &mut [f32]) {
    let to: &mut [f32; LANES] = to.first_chunk_mut().expect("eight samples");
    // SAFETY: writes eight samples to an array of eight.
    unsafe { _mm256_storeu_ps(to.as_mut_ptr(), values) }
}

/// See [`super::patch_sums`]. Integer addition is exact, so the order is irrelevant.
#[target_feature(enable = "avx2")]
pub fn patch_sums(image: &GrayImage, left: usize, top: usize) -> PatchSums {
    let mut singles = [_mm256_setzero_si256(); 3];
    let mut products = [_mm256_setzero_si256(); 6];
    let words = |row: &[u8], at: usize| _mm256_cvtepu8_epi16(load_chunk(&row[at..]));
    for j in 0..PATCH_SIDE {
        let [above, here, below] = rows_about(image, left, top, j);
        let sample = words(here, 1);
        let x = _mm256_sub_epi16(words(here, 2), words(here, 0));
        let y = _mm256_sub_epi16(words(below, 1), words(above, 1));
        for (sum, term) in singles.iter_mut().zip([sample, x, y]) {
            *sum = _mm256_add_epi16(*sum, term); // at most 16 · 255
        }
        let pairs = [(sample, sample), (sample, x), (sample, y), (x, x), (x, y), (y, y)];
        for (sum, (a, b)) in products.iter_mut().zip(pairs) {
            *sum = _mm256_add_epi32(*sum, _mm256_madd_epi16(a, b));
        }
    }
    let one = _mm256_set1_epi16(1);
    let [sample, x, y] = singles.map(|sum| whole_total(_mm256_madd_epi16(sum, one)));
    let [sample_sample, sample_x, sample_y, x_x, x_y, y_y] = products.map(|sum| whole_total(sum));
    PatchSums { sample, x, y, sample_sample, sample_x, sample_y, x_x, x_y, y_y }
}

/// Sum of eight integers.
#[inline]
#[target_feature(enable = "avx2")]
fn whole_total(values: __m256i) -> i32 {
    let four = _mm_add_epi32(_mm256_castsi256_si128(values), _mm256_extracti128_si256::<1>(values));
    let two = _mm_add_epi32(four, _mm_unpackhi_epi64(four, four));
    _mm_cvtsi128_si32(two) + _mm_extract_epi32::<1>(two)
}

/// See [`super::blur_and_halve`].
#[target_feature(enable = "avx2")]
pub fn blur_and_halve(sums: &[u16], out: &mut [u8]) {
    let pair = |first: i16, second: i16| _mm256_set1_epi32(i32::from(first) | (i32::from(second) << 16));
    let weights = [pair(1, 4), pair(6, 4), pair(1, 0)];
    let half = _mm256_set1_epi32(128);
    let mut done = 0;
    for eight in out.chunks_exact_mut(LANES) {
        // The last load reaches one sum beyond the last one used.
        let Some(from) = sums.get(2 * done..2 * done + 2 * LANES + 4) else { break };
        let mut total = half;
        for (i, weight) in weights.into_iter().enumerate() {
            // Sums are at most 16 · 255, so they are valid signed 16-bit integers.
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
    // SAFETY: reads sixteen 16-bit sums from an array of sixteen.
    unsafe { _mm256_loadu_si256(from.as_ptr().cast()) }
}
