//! [`super::orthorectify_eight`] for AVX2.

use super::{LANES, OUTWEIGHED, Places, UnrectifiedFrame};
use std::arch::x86_64::*;

/// See [`super::orthorectify_eight`].
#[target_feature(enable = "avx2")]
pub fn orthorectify_eight<const N: usize>(
    frame: &UnrectifiedFrame<'_, N>,
    places: &Places,
    pixels: &mut [[u8; 4]; LANES],
) -> bool {
    let (x, y) = (load(&places.x), load(&places.y));
    let weight = weights(frame, x, y, load(&places.quality));
    let scale = _mm256_set1_ps(frame.scale);
    let offset = _mm256_set1_ps(0.5 * frame.scale - 0.5);
    let between = |place| _mm256_add_ps(_mm256_mul_ps(place, scale), offset);
    let (x, y) = (between(x), between(y));
    // SAFETY: reads the 32 bytes of eight pixels of four bytes.
    let stored = unsafe { _mm256_loadu_si256(pixels.as_ptr().cast()) };
    let before = _mm256_srli_epi32::<24>(stored);
    let enough = _mm256_mullo_epi32(weight, _mm256_set1_epi32(OUTWEIGHED));
    let inside = _mm256_castps_si256(_mm256_and_ps(within(x, frame.right), within(y, frame.bottom)));
    let wanted = _mm256_and_si256(_mm256_cmpgt_epi32(enough, before), inside);
    let seen = _mm256_testz_si256(weight, weight) == 0;
    if _mm256_testz_si256(wanted, wanted) == 1 {
        return seen;
    }
    let (old_weight, new_weight) = (_mm256_cvtepi32_ps(before), _mm256_cvtepi32_ps(weight));
    let share = _mm256_div_ps(new_weight, _mm256_add_ps(old_weight, new_weight));
    let samples = sample(frame, x, y);
    let most = _mm256_set1_epi32(255);
    let total = _mm256_min_epi32(_mm256_add_epi32(before, weight), most);
    let mut blended = _mm256_slli_epi32::<24>(total);
    for channel in 0..3 {
        let from = channel.min(N - 1);
        let place = _mm256_set1_epi32(8 * channel as i32);
        let old = _mm256_cvtepi32_ps(_mm256_and_si256(_mm256_srlv_epi32(stored, place), most));
        let new = _mm256_mul_ps(samples[from], _mm256_set1_ps(frame.gains[from]));
        let new = _mm256_min_ps(new, _mm256_set1_ps(255.0));
        let mixed = _mm256_add_ps(old, _mm256_mul_ps(_mm256_sub_ps(new, old), share));
        let rounded = _mm256_cvttps_epi32(_mm256_add_ps(mixed, _mm256_set1_ps(0.5)));
        blended = _mm256_or_si256(blended, _mm256_sllv_epi32(rounded, place));
    }
    let result = _mm256_blendv_epi8(stored, blended, wanted);
    // SAFETY: writes the 32 bytes of eight pixels of four bytes.
    unsafe { _mm256_storeu_si256(pixels.as_mut_ptr().cast(), result) };
    seen
}

/// [`super::Feather::weight`] of eight positions.
#[inline]
#[target_feature(enable = "avx2")]
fn weights<const N: usize>(
    frame: &UnrectifiedFrame<'_, N>,
    x: __m256,
    y: __m256,
    quality: __m256,
) -> __m256i {
    let feather = &frame.feather;
    let nearest = |place, last: f32| _mm256_min_ps(_mm256_sub_ps(_mm256_set1_ps(last), place), place);
    let from_border = _mm256_min_ps(nearest(y, feather.bottom), nearest(x, feather.right));
    let share = _mm256_add_ps(from_border, _mm256_set1_ps(0.5));
    let share = _mm256_min_ps(_mm256_mul_ps(share, _mm256_set1_ps(feather.by_half)), _mm256_set1_ps(1.0));
    let weight = _mm256_mul_ps(_mm256_mul_ps(_mm256_mul_ps(_mm256_set1_ps(62.0), share), share), quality);
    let weight = _mm256_cvttps_epi32(_mm256_add_ps(_mm256_set1_ps(1.0), weight));
    let inside = _mm256_cmp_ps::<_CMP_GE_OQ>(from_border, _mm256_setzero_ps());
    _mm256_and_si256(weight, _mm256_castps_si256(inside))
}

/// Mask of the coordinates in 0 to `last`.
#[inline]
#[target_feature(enable = "avx2")]
fn within(place: __m256, last: f32) -> __m256 {
    let above = _mm256_cmp_ps::<_CMP_GE_OQ>(place, _mm256_setzero_ps());
    _mm256_and_ps(above, _mm256_cmp_ps::<_CMP_LE_OQ>(place, _mm256_set1_ps(last)))
}

/// Bilinear samples of each channel at eight positions; unspecified outside the frame.
#[inline]
#[target_feature(enable = "avx2")]
fn sample<const N: usize>(frame: &UnrectifiedFrame<'_, N>, x: __m256, y: __m256) -> [__m256; N] {
    // NaN is converted to the most negative integer, which is clamped to the first column or row.
    let whole = |place: __m256, last: f32| {
        let last = _mm256_set1_epi32(last as i32 - 1);
        _mm256_max_epi32(_mm256_min_epi32(_mm256_cvttps_epi32(place), last), _mm256_setzero_si256())
    };
    let (left, top) = (whole(x, frame.right), whole(y, frame.bottom));
    let (dx, dy) = (_mm256_sub_ps(x, _mm256_cvtepi32_ps(left)), _mm256_sub_ps(y, _mm256_cvtepi32_ps(top)));
    let width = _mm256_set1_epi32(frame.width as i32);
    let pixel = _mm256_add_epi32(_mm256_mullo_epi32(top, width), left);
    let at = _mm256_mullo_epi32(pixel, _mm256_set1_epi32(N as i32));
    let stride = N * frame.width;
    assert!((N == 1 || N == 3) && frame.width >= 2 && frame.samples.len() >= 2 * stride);
    let start = frame.samples.as_ptr();
    // SAFETY: `at` is the first byte of a pixel outside the last column and the last row. That
    // pixel, its right neighbour and the two below therefore end at at + stride + 2 N, which is at
    // most the number of samples and fits 31 bits. Four bytes are read from each `offset` on. The
    // offsets are 0, N where that is 3, and those at which the two pixels below end: all at most
    // stride + 2 N − 4, and none negative.
    let gather = |offset: usize| unsafe { _mm256_i32gather_epi32::<1>(start.add(offset).cast(), at) };
    // The loaded word, and the index of its first relevant byte.
    let end = stride + 2 * N;
    let upper_left = (gather(0), 0);
    let upper_right = if N == 1 { (upper_left.0, 1) } else { (gather(N), 0) };
    let lower_right = (gather(end - 4), 4 - N as i32);
    let lower_left = if N == 1 { (lower_right.0, 2) } else { (gather(end - N - 4), 4 - N as i32) };
    let byte = _mm256_set1_epi32(0xff);
    let mut samples = [_mm256_setzero_ps(); N];
    for (channel, sample) in samples.iter_mut().enumerate() {
        let value = |(four, first): (__m256i, i32)| {
            let shifted = _mm256_srlv_epi32(four, _mm256_set1_epi32(8 * (first + channel as i32)));
            _mm256_cvtepi32_ps(_mm256_and_si256(shifted, byte))
        };
        let mix =
            |a: __m256, b: __m256, part: __m256| _mm256_add_ps(a, _mm256_mul_ps(_mm256_sub_ps(b, a), part));
        let up = mix(value(upper_left), value(upper_right), dx);
        let down = mix(value(lower_left), value(lower_right), dx);
        *sample = mix(up, down, dy);
    }
    samples
}

#[inline]
#[target_feature(enable = "avx2")]
fn load(from: &[f32; LANES]) -> __m256 {
    // SAFETY: reads eight values from an array of eight.
    unsafe { _mm256_loadu_ps(from.as_ptr()) }
}
