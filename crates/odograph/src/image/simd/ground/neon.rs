//! [`super::orthorectify_eight`] for NEON.

use super::super::neon::{between, unsigned};
use super::{LANES, OUTWEIGHED, Places, UnrectifiedFrame};
use std::arch::aarch64::*;

/// Eight floating-point values.
type EightFloats = [float32x4_t; 2];

/// See [`super::orthorectify_eight`].
#[target_feature(enable = "neon")]
pub fn orthorectify_eight<const N: usize>(
    frame: &UnrectifiedFrame<'_, N>,
    places: &Places,
    pixels: &mut [[u8; 4]; LANES],
) -> bool {
    let (x, y) = (load(&places.x), load(&places.y));
    let weight = weights(frame, x, y, load(&places.quality));
    let seen = vmaxvq_s32(vmaxq_s32(weight[0], weight[1])) > 0;
    let (scale, offset) = (vdupq_n_f32(frame.scale), vdupq_n_f32(0.5 * frame.scale - 0.5));
    let place = |place: EightFloats| place.map(|place| vaddq_f32(vmulq_f32(place, scale), offset));
    let (x, y) = (place(x), place(y));
    let pixels = pixels.as_flattened_mut();
    // SAFETY: reads the 32 bytes of eight pixels of four bytes.
    let stored = unsafe { vld4_u8(pixels.as_ptr()) };
    let before = [stored.0, stored.1, stored.2, stored.3].map(|bytes| vmovl_u8(bytes));
    let [red, green, blue, old_weight] = before;
    let before = wide(old_weight);
    let wanted = narrow(std::array::from_fn(|i| {
        let enough = vmulq_n_s32(weight[i], OUTWEIGHED);
        let inside = vandq_u32(within(x[i], frame.right), within(y[i], frame.bottom));
        vandq_u32(vcgtq_s32(enough, before[i]), inside)
    }));
    if vmaxv_u8(wanted) == 0 {
        return seen;
    }
    let share: EightFloats = std::array::from_fn(|i| {
        let (old, new) = (vcvtq_f32_s32(before[i]), vcvtq_f32_s32(weight[i]));
        vdivq_f32(new, vaddq_f32(old, new))
    });
    let samples = sample(frame, x, y);
    let blended = |old: uint16x8_t, channel: usize| {
        let from = channel.min(N - 1);
        let (old, new) = (unsigned(old), samples[from]);
        narrow(std::array::from_fn(|i| {
            let new = vminnmq_f32(vmulq_n_f32(new[i], frame.gains[from]), vdupq_n_f32(255.0));
            let mixed = vaddq_f32(old[i], vmulq_f32(vsubq_f32(new, old[i]), share[i]));
            vreinterpretq_u32_s32(vcvtq_s32_f32(vaddq_f32(mixed, vdupq_n_f32(0.5))))
        }))
    };
    let total = narrow(std::array::from_fn(|i| {
        vreinterpretq_u32_s32(vminq_s32(vaddq_s32(before[i], weight[i]), vdupq_n_s32(255)))
    }));
    let result = uint8x8x4_t(
        vbsl_u8(wanted, blended(red, 0), stored.0),
        vbsl_u8(wanted, blended(green, 1), stored.1),
        vbsl_u8(wanted, blended(blue, 2), stored.2),
        vbsl_u8(wanted, total, stored.3),
    );
    // SAFETY: writes the 32 bytes of eight pixels of four bytes.
    unsafe { vst4_u8(pixels.as_mut_ptr(), result) };
    seen
}

/// [`super::Feather::weight`] of eight positions.
#[inline]
#[target_feature(enable = "neon")]
fn weights<const N: usize>(
    frame: &UnrectifiedFrame<'_, N>,
    x: EightFloats,
    y: EightFloats,
    quality: EightFloats,
) -> [int32x4_t; 2] {
    let feather = &frame.feather;
    let nearest = |place, last: f32| vminnmq_f32(place, vsubq_f32(vdupq_n_f32(last), place));
    std::array::from_fn(|i| {
        let from_border = vminnmq_f32(nearest(x[i], feather.right), nearest(y[i], feather.bottom));
        let share = vmulq_n_f32(vaddq_f32(from_border, vdupq_n_f32(0.5)), feather.by_half);
        let share = vminnmq_f32(share, vdupq_n_f32(1.0));
        let weight = vmulq_f32(vmulq_f32(vmulq_n_f32(share, 62.0), share), quality[i]);
        let weight = vcvtq_s32_f32(vaddq_f32(vdupq_n_f32(1.0), weight));
        vandq_s32(weight, vreinterpretq_s32_u32(vcgezq_f32(from_border)))
    })
}

/// Mask of the coordinates in 0 to `last`.
#[inline]
#[target_feature(enable = "neon")]
fn within(place: float32x4_t, last: f32) -> uint32x4_t {
    vandq_u32(vcgezq_f32(place), vcleq_f32(place, vdupq_n_f32(last)))
}

/// Bilinear samples of each channel at eight positions; unspecified outside the frame.
#[inline]
#[target_feature(enable = "neon")]
fn sample<const N: usize>(
    frame: &UnrectifiedFrame<'_, N>,
    x: EightFloats,
    y: EightFloats,
) -> [EightFloats; N] {
    // NaN and negative values become 0.
    let whole = |place: EightFloats, last: f32| {
        let last = vdupq_n_u32(last as u32 - 1);
        place.map(|place| vminq_u32(vcvtq_u32_f32(place), last))
    };
    let (left, top) = (whole(x, frame.right), whole(y, frame.bottom));
    let beyond = |place: EightFloats, whole: [uint32x4_t; 2]| -> EightFloats {
        std::array::from_fn(|i| vsubq_f32(place[i], vcvtq_f32_u32(whole[i])))
    };
    let (dx, dy) = (beyond(x, left), beyond(y, top));
    let mut at = [0; LANES];
    for (i, at) in at.as_chunks_mut::<4>().0.iter_mut().enumerate() {
        let pixel = vmlaq_n_u32(left[i], top[i], frame.width as u32);
        // SAFETY: writes four values over four.
        unsafe { vst1q_u32(at.as_mut_ptr(), vmulq_n_u32(pixel, N as u32)) };
    }
    let stride = N * frame.width;
    assert!((N == 1 || N == 3) && frame.width >= 2 && frame.samples.len() >= 2 * stride);
    let start = frame.samples.as_ptr();
    let mut samples = [[vdupq_n_f32(0.0); 2]; N];
    if N == 1 {
        let pairs = |below: usize| {
            let pairs: [u16; LANES] = std::array::from_fn(|i| {
                // SAFETY: `at` is a pixel outside the last column and the last row, so its own and
                // its right neighbour's sample and those below exist.
                unsafe { start.add(at[i] as usize + below).cast::<u16>().read_unaligned() }
            });
            // SAFETY: reads eight values from an array of eight.
            vreinterpretq_u8_u16(unsafe { vld1q_u16(pairs.as_ptr()) })
        };
        let (upper, lower) = (pairs(0), pairs(stride));
        samples[0] = between(vuzp1q_u8(upper, lower), vuzp2q_u8(upper, lower), dx, dy);
        return samples;
    }
    // Per pixel eight bytes that contain the six of the pixel and its right neighbour: first for
    // the upper row, last for the lower row.
    let eights = |offset: usize| {
        let eights: [u64; LANES] = std::array::from_fn(|i| {
            // SAFETY: `at` is the first byte of a pixel outside the last column and the last row.
            // That pixel, its right neighbour and the two below therefore end at at + stride + 6 at
            // most, and a row has at least 6 bytes. Eight bytes are read from at on, and from at +
            // stride − 2 on.
            unsafe { start.add(at[i] as usize + offset).cast::<u64>().read_unaligned() }
        });
        let pair =
            |i: usize| vreinterpretq_u8_u64(vcombine_u64(vcreate_u64(eights[i]), vcreate_u64(eights[i + 1])));
        uint8x16x4_t(pair(0), pair(2), pair(4), pair(6))
    };
    let (upper, lower) = (eights(0), eights(stride - 2));
    for (channel, sample) in samples.iter_mut().enumerate() {
        // The left samples of eight pixels, then the right ones.
        let all = |first: usize| {
            let places: [u8; 16] =
                std::array::from_fn(|i| (8 * (i % 8) + 3 * (i / 8) + first + channel) as u8);
            // SAFETY: reads 16 bytes from an array of 16.
            unsafe { vld1q_u8(places.as_ptr()) }
        };
        let (upper, lower) = (vqtbl4q_u8(upper, all(0)), vqtbl4q_u8(lower, all(2)));
        let left = vcombine_u8(vget_low_u8(upper), vget_low_u8(lower));
        let right = vcombine_u8(vget_high_u8(upper), vget_high_u8(lower));
        *sample = between(left, right, dx, dy);
    }
    samples
}

/// Widens eight 16-bit integers to 32 bits.
#[inline]
#[target_feature(enable = "neon")]
fn wide(words: uint16x8_t) -> [int32x4_t; 2] {
    [vmovl_u16(vget_low_u16(words)), vmovl_high_u16(words)].map(|four| vreinterpretq_s32_u32(four))
}

/// The lowest bytes of eight integers.
#[inline]
#[target_feature(enable = "neon")]
fn narrow([first, last]: [uint32x4_t; 2]) -> uint8x8_t {
    vmovn_u16(vcombine_u16(vmovn_u32(first), vmovn_u32(last)))
}

#[inline]
#[target_feature(enable = "neon")]
fn load(from: &[f32; LANES]) -> EightFloats {
    // SAFETY: reads four values each from the first and from the fifth of eight.
    [0, 4].map(|first| unsafe { vld1q_f32(from.as_ptr().add(first)) })
}
