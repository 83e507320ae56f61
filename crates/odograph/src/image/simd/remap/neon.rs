//! [`Remap::apply`] for NEON: eight pixels at a time, without gathered loads.
//!
//! The samples of a block lie in few rows and within 16 columns. One load per row therefore covers
//! all of them, and table look-ups over the rows select both neighbours of every pixel.

use super::{BLOCK, Block, BlockSpread, DROPPED_BITS, FRACTION_BITS, LAST_BITS, ONE_ROW, ROUNDING, Remap};
use std::arch::aarch64::*;

/// Samples of a row that a block may use.
const WINDOW: usize = 16;

/// Offset of the next row in the look-up table.
const NEXT_ROW: u8 = WINDOW as u8;

/// Rows of samples from the corner of a block on; the last is used only for blocks that are
/// [`BlockSpread::Far`].
type Rows = [uint8x16_t; 4];

/// Gray images.
#[target_feature(enable = "neon")]
pub fn gray(remap: &Remap, source: &[u8], result: &mut [u8]) {
    let (width, stride) = (remap.size.0, remap.source.0);
    let rows = remap.blocks.chunks_exact(width.div_ceil(BLOCK));
    for (blocks, row) in rows.zip(result.chunks_exact_mut(width)) {
        let (whole, rest) = row.as_chunks_mut::<BLOCK>();
        if let Some(block) = blocks.get(whole.len()) {
            remap.sample_block::<1>(block, source, rest);
        }
        for (block, pixels) in blocks.iter().zip(whole) {
            let near = near(block, source, stride, 1);
            let Some(near) = near else {
                remap.sample_block::<1>(block, source, pixels);
                continue;
            };
            // SAFETY: `near` contains a window of each of the four rows.
            let rows = std::array::from_fn(|row| unsafe { vld1q_u8(near.as_ptr().add(row * stride)) });
            let values = Weights::new(block).mean(rows);
            // SAFETY: writes eight bytes over eight.
            unsafe { vst1_u8(pixels.as_mut_ptr(), values) };
        }
    }
}

/// Colour images: channels are deinterleaved on load and interleaved on store.
#[target_feature(enable = "neon")]
pub fn rgb(remap: &Remap, source: &[u8], result: &mut [u8]) {
    let (width, stride) = (remap.size.0, remap.source.0);
    let rows = remap.blocks.chunks_exact(width.div_ceil(BLOCK));
    for (blocks, row) in rows.zip(result.chunks_exact_mut(3 * width)) {
        let (whole, rest) = row.as_chunks_mut::<{ 3 * BLOCK }>();
        if let Some(block) = blocks.get(whole.len()) {
            remap.sample_block::<3>(block, source, rest);
        }
        for (block, pixels) in blocks.iter().zip(whole) {
            let near = near(block, source, stride, 3);
            let Some(near) = near else {
                remap.sample_block::<3>(block, source, pixels);
                continue;
            };
            // SAFETY: `near` contains a window of each of the four rows.
            let row = |row: usize| unsafe { vld3q_u8(near.as_ptr().add(3 * row * stride)) };
            let (a, b, c, d) = (row(0), row(1), row(2), row(3));
            let weights = Weights::new(block);
            let values = uint8x8x3_t(
                weights.mean([a.0, b.0, c.0, d.0]),
                weights.mean([a.1, b.1, c.1, d.1]),
                weights.mean([a.2, b.2, c.2, d.2]),
            );
            // SAFETY: writes 24 bytes over 24.
            unsafe { vst3_u8(pixels.as_mut_ptr(), values) };
        }
    }
}

/// The samples from the corner of a block on: three rows, and a window of a fourth. `None` where
/// the block is loose or the source ends before.
#[inline(always)]
fn near<'a>(block: &Block, source: &'a [u8], stride: usize, channels: usize) -> Option<&'a [u8]> {
    let (corner, count) = (block.corner as usize, 3 * stride + WINDOW);
    let near = source.get(channels * corner..channels * (corner + count));
    near.filter(|_| block.reach != BlockSpread::Loose)
}

/// Table indices and interpolation weights of a block's pixels.
struct Weights {
    /// Indices of the eight left neighbours, then of the eight right ones; without a source they
    /// exceed the table, and the look-up returns 0.
    neighbours: uint8x16_t,
    right: int16x8_t,
    down: int16x8_t,
    far: bool,
}

impl Weights {
    /// For a block that is not loose.
    #[inline]
    #[target_feature(enable = "neon")]
    fn new(block: &Block) -> Self {
        // SAFETY: reads eight values each from arrays of eight.
        let (steps, right, down) = unsafe {
            (vld1_u8(block.steps.as_ptr()), vld1q_u16(block.right.as_ptr()), vld1q_u16(block.down.as_ptr()))
        };
        // The bits that add one row and a second one advance the table index by a row each; all
        // other bits are kept.
        let row = vdup_n_u8(NEXT_ROW);
        const { assert!(ONE_ROW >> 2 == NEXT_ROW) };
        let (first, second) = (vand_u8(vshr_n_u8::<2>(steps), row), vand_u8(vshr_n_u8::<1>(steps), row));
        let left = vand_u8(steps, vdup_n_u8(!(super::TWO_ROWS)));
        let left = vadd_u8(left, vadd_u8(first, second));
        Self {
            neighbours: vcombine_u8(left, vadd_u8(left, vdup_n_u8(1))),
            right: vreinterpretq_s16_u16(right),
            down: vreinterpretq_s16_u16(down),
            far: block.reach == BlockSpread::Far,
        }
    }

    /// Weighted means of the four samples of each pixel.
    #[inline]
    #[target_feature(enable = "neon")]
    fn mean(&self, [a, b, c, d]: Rows) -> uint8x8_t {
        // The lower two samples have the same indices in a table that begins one row later.
        let (upper, lower) = if self.far {
            (
                vqtbl3q_u8(uint8x16x3_t(a, b, c), self.neighbours),
                vqtbl3q_u8(uint8x16x3_t(b, c, d), self.neighbours),
            )
        } else {
            (vqtbl2q_u8(uint8x16x2_t(a, b), self.neighbours), vqtbl2q_u8(uint8x16x2_t(b, c), self.neighbours))
        };
        let between_columns = |[left, right]: [uint8x8_t; 2]| {
            let step = vreinterpretq_s16_u16(vsubl_u8(right, left));
            let [first, last] = weighed(vmovl_u8(left), step, self.right);
            const BITS: i32 = DROPPED_BITS as i32;
            vcombine_u16(vshrn_n_u32::<BITS>(first), vshrn_n_u32::<BITS>(last))
        };
        let upper = between_columns([vget_low_u8(upper), vget_high_u8(upper)]);
        let lower = between_columns([vget_low_u8(lower), vget_high_u8(lower)]);
        // Values have 15 bits, so their difference fits 16.
        let step = vreinterpretq_s16_u16(vsubq_u16(lower, upper));
        let [first, last] = weighed(upper, step, self.down);
        let rounding = vdupq_n_u32(ROUNDING);
        let values = vcombine_u16(vaddhn_u32(first, rounding), vaddhn_u32(last, rounding));
        vshrn_n_u16::<{ LAST_BITS as i32 - 16 }>(values)
    }
}

/// `first · (ONE − part) + second · part`, where `step` is `second − first`.
#[inline]
#[target_feature(enable = "neon")]
fn weighed(first: uint16x8_t, step: int16x8_t, part: int16x8_t) -> [uint32x4_t; 2] {
    const BITS: i32 = FRACTION_BITS as i32;
    let low = vreinterpretq_s32_u32(vshll_n_u16::<BITS>(vget_low_u16(first)));
    let high = vreinterpretq_s32_u32(vshll_high_n_u16::<BITS>(first));
    let low = vmlal_s16(low, vget_low_s16(step), vget_low_s16(part));
    let high = vmlal_high_s16(high, step, part);
    [vreinterpretq_u32_s32(low), vreinterpretq_u32_s32(high)]
}
