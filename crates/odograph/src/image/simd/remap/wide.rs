//! [`Remap::apply`] for AVX2: eight pixels at a time, without gather instructions.
//!
//! The samples of a block lie in few rows and within 16 columns. One load per row therefore covers
//! all of them, and a byte shuffle brings the two neighbours of each pixel together.

use super::{BLOCK, Block, BlockSpread, DROPPED_BITS, LAST_BITS, ONE, ROUNDING, Remap};
use std::arch::x86_64::*;

/// Samples of a row that a block may use.
const WINDOW: usize = 16;

/// Gray images.
#[target_feature(enable = "avx2")]
pub fn gray(remap: &Remap, source: &[u8], result: &mut [u8]) {
    let width = remap.size.0;
    let stride = remap.source.0;
    let rows = remap.blocks.chunks_exact(width.div_ceil(BLOCK));
    for (blocks, row) in rows.zip(result.chunks_exact_mut(width)) {
        let (whole, rest) = row.as_chunks_mut::<BLOCK>();
        if let Some(block) = blocks.get(whole.len()) {
            remap.sample_block::<1>(block, source, rest);
        }
        for (block, pixels) in blocks.iter().zip(whole) {
            let last = block.corner as usize + 3 * stride + WINDOW;
            if block.reach == BlockSpread::Loose || last > source.len() {
                remap.sample_block::<1>(block, source, pixels);
                continue;
            }
            let (upper, lower) = neighbours(block, source, stride);
            let values = weigh(upper, lower, weights(&block.right), weights(&block.down));
            // SAFETY: writes the eight pixels of the block from the low half of the register.
            unsafe { _mm_storel_epi64(pixels.as_mut_ptr().cast(), narrow(values)) };
        }
    }
}

/// Narrows eight 32-bit values to bytes.
#[inline]
#[target_feature(enable = "avx2")]
fn narrow(values: __m256i) -> __m128i {
    let words = _mm_packs_epi32(_mm256_castsi256_si128(values), _mm256_extracti128_si256::<1>(values));
    _mm_packus_epi16(words, words)
}

/// The upper and the lower two samples of each pixel side by side, 16 bits per pair; zeros without
/// a source.
///
/// The block must not be loose, and three rows and [`WINDOW`] samples from its corner on must be
/// inside the source.
#[inline]
#[target_feature(enable = "avx2")]
fn neighbours(block: &Block, source: &[u8], stride: usize) -> (__m256i, __m256i) {
    let corner = &source[block.corner as usize..][..3 * stride + WINDOW];
    let steps = steps(block);
    let left_and_right = _mm_unpacklo_epi8(steps, _mm_add_epi8(steps, _mm_set1_epi8(1)));
    let row = |number: usize| {
        let samples = &corner[number * stride..][..WINDOW];
        // SAFETY: reads 16 bytes from a slice of 16.
        let samples = unsafe { _mm_loadu_si128(samples.as_ptr().cast()) };
        _mm_shuffle_epi8(samples, left_and_right)
    };
    // The bit that adds a row, shifted to the position tested by the blend; bits carried over from
    // a neighbour are irrelevant.
    let doubled = _mm_unpacklo_epi8(steps, steps);
    let one_row = _mm_slli_epi16::<1>(doubled);
    let (first, second, third) = (row(0), row(1), row(2));
    let mut upper = _mm_blendv_epi8(first, second, one_row);
    let mut lower = _mm_blendv_epi8(second, third, one_row);
    if block.reach == BlockSpread::Far {
        let two_rows = _mm_slli_epi16::<2>(doubled);
        upper = _mm_blendv_epi8(upper, third, two_rows);
        lower = _mm_blendv_epi8(lower, row(3), two_rows);
    }
    (_mm256_cvtepu8_epi16(upper), _mm256_cvtepu8_epi16(lower))
}

/// Eight fractions as pairs of weights: the first sample's in the low 16 bits, the second's in the
/// high ones.
#[inline]
#[target_feature(enable = "avx2")]
fn weights(fractions: &[u16; BLOCK]) -> __m256i {
    // SAFETY: reads 16 bytes from an array of eight 16-bit values.
    let fractions = unsafe { _mm_loadu_si128(fractions.as_ptr().cast()) };
    let second = _mm256_cvtepu16_epi32(fractions);
    let first = _mm256_sub_epi32(_mm256_set1_epi32(i32::from(ONE)), second);
    _mm256_or_si256(first, _mm256_slli_epi32::<16>(second))
}

/// Weighted means of four samples, as eight 32-bit values up to 255.
#[inline]
#[target_feature(enable = "avx2")]
fn weigh(upper: __m256i, lower: __m256i, across: __m256i, down: __m256i) -> __m256i {
    let upper = _mm256_madd_epi16(upper, across);
    let lower = _mm256_madd_epi16(lower, across);
    // Both values without the dropped bits, side by side. The lower row's value is shifted into the
    // upper half; the bits below it are replaced by the upper row's value.
    let both = _mm256_blend_epi16::<0xAA>(
        _mm256_srli_epi32::<{ DROPPED_BITS as i32 }>(upper),
        _mm256_slli_epi32::<{ 16 - DROPPED_BITS as i32 }>(lower),
    );
    let sum = _mm256_add_epi32(_mm256_madd_epi16(both, down), _mm256_set1_epi32(ROUNDING as i32));
    _mm256_srli_epi32::<{ LAST_BITS as i32 }>(sum)
}

/// Colour images: the two samples of a channel are three bytes apart, so every pixel is loaded
/// separately, and two are interpolated at a time.
#[target_feature(enable = "avx2")]
pub fn rgb(remap: &Remap, source: &[u8], result: &mut [u8]) {
    let (width, stride) = (remap.size.0, remap.source.0);
    let rows = remap.blocks.chunks_exact(width.div_ceil(BLOCK));
    for (blocks, row) in rows.zip(result.chunks_exact_mut(3 * width)) {
        let (whole, rest) = row.as_chunks_mut::<{ 3 * BLOCK }>();
        if let Some(block) = blocks.get(whole.len()) {
            remap.sample_block::<3>(block, source, rest);
        }
        for (block, pixels) in blocks.iter().zip(whole) {
            // Reads 16 bytes from each pixel on, six of which are its own and its right
            // neighbour's.
            let last = 3 * (block.corner as usize + 3 * stride + WINDOW + 4);
            if block.reach == BlockSpread::Loose || last > source.len() {
                remap.sample_block::<3>(block, source, pixels);
                continue;
            }
            let [first, second] = four_and_four(block, &source[3 * block.corner as usize..last], stride);
            // 24 bytes: twelve of each half.
            let upto = _mm_or_si128(first, _mm_slli_si128::<12>(second));
            // SAFETY: writes 24 bytes: 16 from the first on and eight from the 17th on.
            unsafe {
                _mm_storeu_si128(pixels.as_mut_ptr().cast(), upto);
                _mm_storel_epi64(pixels.as_mut_ptr().add(16).cast(), _mm_srli_si128::<4>(second));
            }
        }
    }
}

/// Red, green and blue of the first and of the last four pixels of a block, in the low twelve
/// bytes. The block must not be loose. `near` are the samples from the block's corner on: three
/// rows, and 20 pixels of a fourth.
#[inline]
#[target_feature(enable = "avx2")]
fn four_and_four(block: &Block, near: &[u8], stride: usize) -> [__m128i; 2] {
    let offsets = offsets(block, stride);
    let across = weights(&block.right);
    let down = with_source(block, weights(&block.down));
    assert!(near.len() >= 3 * (3 * stride + WINDOW + 4));
    let pixel = |number: usize, below: usize| {
        let at = offsets[number] as usize + 3 * below * stride;
        // SAFETY: a pixel is at most 14 columns and two rows from the corner, and one more row is
        // read: 3 · (14 + 3 · stride) + 16 bytes, fewer than the length asserted above.
        unsafe { _mm_loadu_si128(near.as_ptr().add(at).cast()) }
    };
    // The two samples of each channel side by side, 16 bits each; one pixel per half.
    let half = _mm_setr_epi8(0, -1, 3, -1, 1, -1, 4, -1, 2, -1, 5, -1, -1, -1, -1, -1);
    let order = _mm256_set_m128i(half, half);
    let beside = |number: usize, below: usize| {
        let both = _mm256_set_m128i(pixel(number + 4, below), pixel(number, below));
        _mm256_shuffle_epi8(both, order)
    };
    let zero = weigh(
        beside(0, 0),
        beside(0, 1),
        _mm256_shuffle_epi32::<0x00>(across),
        _mm256_shuffle_epi32::<0x00>(down),
    );
    let one = weigh(
        beside(1, 0),
        beside(1, 1),
        _mm256_shuffle_epi32::<0x55>(across),
        _mm256_shuffle_epi32::<0x55>(down),
    );
    let two = weigh(
        beside(2, 0),
        beside(2, 1),
        _mm256_shuffle_epi32::<0xAA>(across),
        _mm256_shuffle_epi32::<0xAA>(down),
    );
    let three = weigh(
        beside(3, 0),
        beside(3, 1),
        _mm256_shuffle_epi32::<0xFF>(across),
        _mm256_shuffle_epi32::<0xFF>(down),
    );
    // Bytes: pixels 0 to 3 in the lower half, 4 to 7 in the upper one, four bytes each with the
    // last unused.
    let bytes = _mm256_packus_epi16(_mm256_packs_epi32(zero, one), _mm256_packs_epi32(two, three));
    let half = _mm_setr_epi8(0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, -1, -1, -1, -1);
    let bytes = _mm256_shuffle_epi8(bytes, _mm256_set_m128i(half, half));
    [_mm256_castsi256_si128(bytes), _mm256_extracti128_si256::<1>(bytes)]
}

/// Offset of each pixel's upper left sample from the corner of its block, bytes of a colour image.
/// The block must not be loose.
#[inline]
#[target_feature(enable = "avx2")]
fn offsets(block: &Block, stride: usize) -> [u32; BLOCK] {
    let steps = _mm256_cvtepu8_epi32(steps(block));
    let one = _mm256_set1_epi32(1);
    let row = |there: __m256i| {
        let there = _mm256_sub_epi32(_mm256_setzero_si256(), _mm256_and_si256(there, one));
        _mm256_and_si256(there, _mm256_set1_epi32(stride as i32))
    };
    let rows = _mm256_add_epi32(row(_mm256_srli_epi32::<6>(steps)), row(_mm256_srli_epi32::<5>(steps)));
    let pixels = _mm256_add_epi32(rows, _mm256_and_si256(steps, _mm256_set1_epi32(15)));
    let bytes = _mm256_add_epi32(pixels, _mm256_add_epi32(pixels, pixels));
    // Two at a time: half as many transfers from the wide registers.
    let pairs = [
        _mm256_extract_epi64::<0>(bytes) as u64,
        _mm256_extract_epi64::<1>(bytes) as u64,
        _mm256_extract_epi64::<2>(bytes) as u64,
        _mm256_extract_epi64::<3>(bytes) as u64,
    ];
    std::array::from_fn(|at| (pairs[at / 2] >> (32 * (at % 2))) as u32)
}

/// The steps of a block in the low eight bytes.
#[inline]
#[target_feature(enable = "avx2")]
fn steps(block: &Block) -> __m128i {
    // SAFETY: reads eight bytes from an array of eight.
    unsafe { _mm_loadl_epi64(block.steps.as_ptr().cast()) }
}

/// Zeroes the weights of pixels without a source.
#[inline]
#[target_feature(enable = "avx2")]
fn with_source(block: &Block, weights: __m256i) -> __m256i {
    // The highest bit of a step marks a pixel without a source.
    _mm256_andnot_si256(_mm256_srai_epi32::<31>(_mm256_cvtepi8_epi32(steps(block))), weights)
}
