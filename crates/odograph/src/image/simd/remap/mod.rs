//! Remapping of a whole image by a precomputed table: bilinear interpolation in fixed point.

#[cfg(target_arch = "aarch64")]
mod neon;
#[cfg(target_arch = "x86_64")]
mod wide;

/// Number of fractional bits of a sub-pixel position.
pub const FRACTION_BITS: u32 = 11;
/// One pixel in fixed point.
pub const ONE: u16 = 1 << FRACTION_BITS;
/// Pixels per [`Block`].
pub const BLOCK: usize = 8;

/// Source positions of eight neighbouring pixels of a row: for each the upper left of four samples
/// and the fractional offsets to the right and down. Six bytes per pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(C, align(16))]
pub struct Block {
    /// Fractional offset of each position to the right of its sample, 0 to [`ONE`].
    right: [u16; BLOCK],
    /// Fractional offset down, 0 to [`ONE`].
    down: [u16; BLOCK],
    /// Offsets of the samples from the corner: columns in the low four bits, rows as [`ONE_ROW`]
    /// and [`TWO_ROWS`], or [`NO_SOURCE`].
    steps: [u8; BLOCK],
    /// Index of the corner sample, or of the block's first entry in [`Remap::loose`].
    corner: u32,
    reach: BlockSpread,
}

/// Spread of the upper left samples of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
enum BlockSpread {
    /// At most two rows.
    Near,
    /// Three rows.
    Far,
    /// Beyond the range of the steps.
    Loose,
}

/// The encoding suits the byte shuffle, which uses the low four bits as index and writes zero where
/// the highest bit is set.
const ONE_ROW: u8 = 1 << 6;
const TWO_ROWS: u8 = ONE_ROW | 1 << 5;
const NO_SOURCE: u8 = 1 << 7;
/// Both neighbours in a row must be among 16 samples.
const MAX_COLUMNS: usize = 14;

/// The source position of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SourcePosition {
    /// Column of the upper left of the four samples.
    pub column: usize,
    /// Row of the upper left of the four samples.
    pub row: usize,
    /// Fractional offset to the right, 0 to [`ONE`].
    pub right: u16,
    /// Fractional offset down, 0 to [`ONE`].
    pub down: u16,
}

/// A remap table: the source position of every pixel of an image.
#[derive(Debug, Clone)]
pub struct Remap {
    /// Width and height of the source, pixels.
    source: (usize, usize),
    /// Width and height of the result, pixels.
    size: (usize, usize),
    /// Blocks in row order; the last block of a row is padded with pixels without a source.
    blocks: Vec<Block>,
    /// Indices of the upper left samples of the blocks that are [`BlockSpread::Loose`].
    loose: Vec<u32>,
}

impl Remap {
    /// Builds the table of a result of `size`. `place` is called for every pixel in row order;
    /// `None` is black.
    ///
    /// # Panics
    ///
    /// Panics where the four samples of a position are not in the source (in a source of one column
    /// or row there are only two, or one), or where the source has more than 2^32 samples.
    pub fn new(
        source: (usize, usize),
        size: (usize, usize),
        mut place: impl FnMut(usize, usize) -> Option<SourcePosition>,
    ) -> Self {
        assert!(u32::try_from(source.0 * source.1).is_ok(), "a source of at most 2^32 samples");
        let mut remap = Self { source, size, blocks: Vec::new(), loose: Vec::new() };
        for row in 0..size.1 {
            for first in (0..size.0).step_by(BLOCK) {
                let places = std::array::from_fn(|at| {
                    let place = if first + at < size.0 { place(first + at, row) } else { None };
                    if let Some(SourcePosition { column, row, right, down }) = place {
                        let last = (source.0.saturating_sub(2), source.1.saturating_sub(2));
                        assert!(column <= last.0 && row <= last.1 && right <= ONE && down <= ONE);
                    }
                    place
                });
                remap.push(&places);
            }
        }
        remap
    }

    fn push(&mut self, places: &[Option<SourcePosition>; BLOCK]) {
        let there = || places.iter().flatten();
        let least = |of: fn(&SourcePosition) -> usize| there().map(of).min().unwrap_or(0);
        let most = |of: fn(&SourcePosition) -> usize| there().map(of).max().unwrap_or(0);
        let (column, row) = (least(|place| place.column), least(|place| place.row));
        let reach = match (most(|place| place.column) - column, most(|place| place.row) - row) {
            (0..=MAX_COLUMNS, 0..=1) => BlockSpread::Near,
            (0..=MAX_COLUMNS, 2) => BlockSpread::Far,
            _ => BlockSpread::Loose,
        };
        let index = |column: usize, row: usize| (row * self.source.0 + column) as u32;
        let corner = match reach {
            BlockSpread::Loose => self.loose.len() as u32,
            _ => index(column, row),
        };
        let mut block =
            Block { right: [0; BLOCK], down: [0; BLOCK], steps: [NO_SOURCE; BLOCK], corner, reach };
        for (at, place) in places.iter().enumerate() {
            let Some(place) = place else { continue };
            block.right[at] = place.right;
            block.down[at] = place.down;
            block.steps[at] = match reach {
                BlockSpread::Loose => 0,
                _ => (place.column - column) as u8 | [0, ONE_ROW, TWO_ROWS][place.row - row],
            };
        }
        if reach == BlockSpread::Loose {
            let indices = places.map(|place| place.map_or(0, |place| index(place.column, place.row)));
            self.loose.extend(indices);
        }
        self.blocks.push(block);
    }

    /// Number of pixels of the result without a source.
    pub fn without_source(&self) -> usize {
        let empty = |block: &Block| block.steps.iter().filter(|step| **step == NO_SOURCE).count();
        let filled_up = self.size.0.next_multiple_of(BLOCK) - self.size.0;
        self.blocks.iter().map(empty).sum::<usize>() - filled_up * self.size.1
    }

    /// Remaps an image of `CHANNELS` interleaved channels; 1 and 3 channels use AVX2 or NEON where
    /// available.
    ///
    /// # Panics
    ///
    /// Panics where a number of samples does not match the sizes.
    pub fn apply<const CHANNELS: usize>(&self, source: &[u8], result: &mut [u8]) {
        assert_eq!(source.len(), CHANNELS * self.source.0 * self.source.1, "one sample a channel and pixel");
        assert_eq!(result.len(), CHANNELS * self.size.0 * self.size.1, "one sample a channel and pixel");
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && self.source.0 > 1 && self.source.1 > 1 {
            if CHANNELS == 1 {
                // SAFETY: the processor has AVX2.
                return unsafe { wide::gray(self, source, result) };
            }
            if CHANNELS == 3 {
                // SAFETY: the processor has AVX2.
                return unsafe { wide::rgb(self, source, result) };
            }
        }
        #[cfg(target_arch = "aarch64")]
        if std::arch::is_aarch64_feature_detected!("neon") && self.source.0 > 1 && self.source.1 > 1 {
            if CHANNELS == 1 {
                // SAFETY: the processor has NEON.
                return unsafe { neon::gray(self, source, result) };
            }
            if CHANNELS == 3 {
                // SAFETY: the processor has NEON.
                return unsafe { neon::rgb(self, source, result) };
            }
        }
        self.apply_scalar::<CHANNELS>(source, result);
    }

    /// The scalar reference of [`Remap::apply`].
    fn apply_scalar<const CHANNELS: usize>(&self, source: &[u8], result: &mut [u8]) {
        let rows = self.blocks.chunks_exact(self.size.0.div_ceil(BLOCK));
        for (blocks, row) in rows.zip(result.chunks_exact_mut(CHANNELS * self.size.0)) {
            for (block, pixels) in blocks.iter().zip(row.chunks_mut(CHANNELS * BLOCK)) {
                self.sample_block::<CHANNELS>(block, source, pixels);
            }
        }
    }

    /// Indices of the upper left samples of a block's pixels; unspecified for pixels without a
    /// source.
    #[inline(always)]
    fn indices(&self, block: &Block) -> [usize; BLOCK] {
        let corner = block.corner as usize;
        std::array::from_fn(|at| match block.reach {
            BlockSpread::Loose => self.loose[corner + at] as usize,
            _ => {
                let step = block.steps[at];
                let rows = usize::from(step >> 6 & 1) + usize::from(step >> 5 & 1);
                corner + usize::from(step & 15) + rows * self.source.0
            }
        })
    }

    #[inline(always)]
    fn sample_block<const CHANNELS: usize>(&self, block: &Block, source: &[u8], pixels: &mut [u8]) {
        // An image of one column or row has no second sample; the fraction towards it is 0.
        let right = if self.source.0 > 1 { CHANNELS } else { 0 };
        let below = if self.source.1 > 1 { CHANNELS * self.source.0 } else { 0 };
        let indices = self.indices(block);
        for (at, pixel) in pixels.chunks_exact_mut(CHANNELS).enumerate() {
            if block.steps[at] == NO_SOURCE {
                pixel.fill(0);
                continue;
            }
            let near = &source[CHANNELS * indices[at]..];
            let (upper, lower) = (&near[..right + CHANNELS], &near[below..below + right + CHANNELS]);
            let (x, y) = (u32::from(block.right[at]), u32::from(block.down[at]));
            let one = u32::from(ONE);
            for channel in 0..CHANNELS {
                // A row's value is truncated to 15 bits, at most 255 · 128, so that the second step
                // also has 16-bit operands.
                let between = |row: &[u8]| {
                    let sum = u32::from(row[channel]) * (one - x) + u32::from(row[right + channel]) * x;
                    sum >> DROPPED_BITS
                };
                let sum = between(upper) * (one - y) + between(lower) * y;
                pixel[channel] = ((sum + ROUNDING) >> LAST_BITS) as u8;
            }
        }
    }
}

/// Bits truncated from the interpolation along a row, and fractional bits of the final result.
const DROPPED_BITS: u32 = 4;
const LAST_BITS: u32 = 2 * FRACTION_BITS - DROPPED_BITS;
/// Half a gray level, plus the mean loss by truncation: half of the last bit kept, times weights
/// that sum to [`ONE`].
const ROUNDING: u32 = (1 << (LAST_BITS - 1)) + (1 << (FRACTION_BITS - 1));

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn samples(count: usize, seed: u32) -> Vec<u8> {
        let mut state = seed;
        let next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        std::iter::repeat_with(next).take(count).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]

        #[test]
        fn an_image_is_sampled_as_the_reference_samples_it(
            source in (1usize..60, 1usize..40), size in (1usize..50, 1usize..20), seed in any::<u32>(),
            linear in prop::array::uniform4(-1.5..2.5f64), shift in prop::array::uniform2(-20.0..60.0f64),
        ) {
            let remap = Remap::new(source, size, |x, y| {
                let (x, y) = (x as f64, y as f64);
                let at = [
                    linear[0] * x + 0.3 * linear[1] * y + shift[0],
                    0.3 * linear[2] * x + linear[3] * y + shift[1],
                ];
                let split = |at: f64, size: usize| {
                    let first = (at.max(0.0) as usize).min(size.saturating_sub(2));
                    let fraction = ((at - first as f64) * f64::from(ONE)).round();
                    (0.0..=(size as f64 - 1.0)).contains(&at).then_some((first, fraction as u16))
                };
                let ((column, right), (row, down)) = (split(at[0], source.0)?, split(at[1], source.1)?);
                Some(SourcePosition { column, row, right, down })
            });
            fn both<const CHANNELS: usize>(remap: &Remap, seed: u32) -> (Vec<u8>, Vec<u8>) {
                let image = samples(CHANNELS * remap.source.0 * remap.source.1, seed);
                let mut expected = vec![1; CHANNELS * remap.size.0 * remap.size.1];
                let mut found = vec![2; expected.len()];
                remap.apply_scalar::<CHANNELS>(&image, &mut expected);
                remap.apply::<CHANNELS>(&image, &mut found);
                (expected, found)
            }
            let (expected, found) = both::<1>(&remap, seed);
            prop_assert_eq!(expected, found);
            let (expected, found) = both::<3>(&remap, seed);
            prop_assert_eq!(expected, found);
        }
    }

    #[test]
    fn blocks_of_every_spread_match_the_reference() {
        // Slopes that spread eight pixels over two, three and more rows, and strides of up to three
        // columns.
        let source = (200, 160);
        for (slope, stride) in [(0.0, 1.0), (0.15, 1.0), (0.28, 1.2), (0.6, 0.9), (0.1, 1.9), (0.0, 3.0)] {
            let size = (60, 40);
            let remap = Remap::new(source, size, |x, y| {
                let (at_x, at_y) = (stride * x as f64, slope * x as f64 + y as f64);
                let fraction = |at: f64| (at.fract() * f64::from(ONE)).round() as u16;
                Some(SourcePosition {
                    column: at_x as usize,
                    row: at_y as usize,
                    right: fraction(at_x),
                    down: fraction(at_y),
                })
            });
            let image = samples(200 * 160, 7);
            let (mut expected, mut found) = (vec![0; 2400], vec![0; 2400]);
            remap.apply_scalar::<1>(&image, &mut expected);
            remap.apply::<1>(&image, &mut found);
            assert_eq!(expected, found);
            let image = samples(3 * 200 * 160, 8);
            let (mut expected, mut found) = (vec![0; 7200], vec![0; 7200]);
            remap.apply_scalar::<3>(&image, &mut expected);
            remap.apply::<3>(&image, &mut found);
            assert_eq!(expected, found);
            assert_eq!(remap.without_source(), 0);
            let loose = remap.blocks.iter().filter(|block| block.reach == BlockSpread::Loose).count();
            assert_eq!(loose == 0, slope < 0.5 && stride < 2.0);
        }
    }
}
