//! A patch of ground, blended from all keyframes that show it.
//!
//! Each view of a ground pixel is split into a low-frequency part (the mean over a cell some tens
//! of pixels wide) and the rest. Low frequencies are averaged with weights that fall off softly
//! towards the image border, so a remaining difference in brightness is spread over the whole
//! overlap. High frequencies come almost only from the best view, so that a pattern displaced by a
//! pixel is neither doubled nor blurred.

use super::super::footprint::GroundCamera;
use super::super::sampling::FrameSamples;
use super::super::tiles::TILE;
use super::super::{BLOCK, MosaicSource};
use super::exposure::Darkening;
use super::{MosaicTile, PATCH, PlacedKeyframe};
use crate::geometry::GroundPoint;
use crate::ground_map::KeyframeImage;
use crate::mosaic::orthorectification::BlockCorner;

/// Side of the patch, ground pixels.
const SIDE: usize = (PATCH * TILE) as usize;
/// Blocks on a side of the patch.
const BLOCKS: usize = SIDE / BLOCK as usize;
/// Exponent of the weights of fine detail: where one view weighs 10 % more than another, two thirds
/// of the detail are its. Higher is sharper, lower hides seams better.
const SHARPNESS: i32 = 8;

/// Accumulated views of a ground pixel: weighted sums, and the weights.
#[derive(Debug, Clone, Copy, Default)]
struct PixelSums {
    coarse: [f32; 3],
    coarse_weight: f32,
    fine: [f32; 3],
    fine_weight: f32,
}

/// The patch.
#[derive(Debug, Default)]
pub(super) struct MosaicPatch {
    /// First tile column and row.
    first: (i64, i64),
    resolution_m: f64,
    sums: Vec<PixelSums>,
    samples: FrameSamples,
    coarse: FrameSamples,
    corners: Vec<Option<BlockCorner>>,
}

impl MosaicPatch {
    /// Begins an empty patch whose first tile is this one.
    pub fn begin(&mut self, column: i64, row: i64, resolution_m: f64) {
        self.first = (column, row);
        self.resolution_m = resolution_m;
        self.sums.clear();
        self.sums.resize(SIDE * SIDE, PixelSums::default());
    }

    /// Adds the image of a keyframe, with a gain for each channel and its vignetting corrected.
    pub fn orthorectify(
        &mut self,
        image: &KeyframeImage,
        view: &GroundCamera<'_>,
        placed: &PlacedKeyframe,
        gains: [f32; 3],
        darkening: Darkening,
    ) {
        let level = (self.resolution_m / view.centre_resolution_m()).log2().round().clamp(0.0, 8.0) as u32;
        let source = match &image.color {
            Some(color) => MosaicSource::Rgb(color),
            None => MosaicSource::Gray(&image.gray),
        };
        let mask = placed.mask.as_ref();
        self.samples.take(source, mask, level);
        let shorter = image.gray.width().min(image.gray.height());
        // Cells of about a twelfth of the image's shorter side.
        let cells = (shorter as f64 / 12.0).log2().round().max(0.0) as u32;
        self.coarse.take(source, mask, cells.max(level));
        let blocks = self.blocks_within(placed.bounds);
        self.find_corners(view, &blocks);
        match self.samples.channels() {
            1 => self.orthorectify_channels::<1>(view, &blocks, gains, darkening),
            _ => self.orthorectify_channels::<3>(view, &blocks, gains, darkening),
        }
    }

    /// The blocks of the patch that bounds touch: first and last column and row, the last not
    /// included.
    fn blocks_within(&self, [left, bottom, right, top]: [f64; 4]) -> [usize; 4] {
        let side_m = BLOCK as f64 * self.resolution_m;
        let tile_m = TILE as f64 * self.resolution_m;
        let (from_x, from_y) = (self.first.0 as f64 * tile_m, self.first.1 as f64 * tile_m);
        let at = |metres: f64| (metres / side_m).floor().clamp(-1.0, BLOCKS as f64) as i64;
        let from = |metres: f64| at(metres).max(0) as usize;
        let to = |metres: f64| ((at(metres) + 1).max(0) as usize).min(BLOCKS);
        [from(left - from_x), to(right - from_x), from(-top - from_y), to(-bottom - from_y)]
    }

    fn ground(&self, x: f64, y: f64) -> GroundPoint {
        let x = (self.first.0 * TILE) as f64 + x;
        let y = (self.first.1 * TILE) as f64 + y;
        GroundPoint::new(x * self.resolution_m, -y * self.resolution_m)
    }

    fn find_corners(&mut self, view: &GroundCamera<'_>, &[left, right, top, bottom]: &[usize; 4]) {
        self.corners.clear();
        for row in top..=bottom {
            for column in left..=right {
                let point = self.ground((column * BLOCK as usize) as f64, (row * BLOCK as usize) as f64);
                self.corners.push(view.look(point).map(BlockCorner::from));
            }
        }
    }

    fn orthorectify_channels<const N: usize>(
        &mut self,
        view: &GroundCamera<'_>,
        blocks: &[usize; 4],
        gains: [f32; 3],
        darkening: Darkening,
    ) {
        let [left, right, top, bottom] = *blocks;
        let stride = right.saturating_sub(left) + 1;
        let (width, height) = self.samples.full_size();
        let border = Border { right: width as f32 - 1.0, bottom: height as f32 - 1.0 };
        for row in top..bottom {
            for column in left..right {
                let at = (row - top) * stride + column - left;
                let corners = [
                    self.corners[at],
                    self.corners[at + 1],
                    self.corners[at + stride],
                    self.corners[at + stride + 1],
                ];
                if border.outside(&corners) {
                    continue;
                }
                let (x, y) = (column * BLOCK as usize, row * BLOCK as usize);
                for j in 0..BLOCK as usize {
                    let whole = match corners {
                        [Some(a), Some(b), Some(c), Some(d)] => Some(BlockCorner::row(a, b, c, d, j)),
                        _ => None,
                    };
                    for i in 0..BLOCK as usize {
                        let seen = match whole {
                            Some((first, step)) => first.plus(step, i as f32),
                            None => {
                                let point = self.ground((x + i) as f64 + 0.5, (y + j) as f64 + 0.5);
                                let Some(look) = view.look(point) else { continue };
                                BlockCorner::from(look)
                            }
                        };
                        let Some(weight) = border.weight(seen) else { continue };
                        let Some(sample) = self.samples.at::<N>(seen.x, seen.y) else { continue };
                        let coarse = self.coarse.nearest_at::<N>(seen.x, seen.y);
                        let lens = darkening.gain(seen.x, seen.y);
                        self.sums[(y + j) * SIDE + x + i].add(
                            sample,
                            coarse,
                            weight,
                            &gains.map(|gain| gain * lens),
                        );
                    }
                }
            }
        }
    }

    /// The tiles of the patch that show any ground.
    pub fn tiles(&self) -> Vec<MosaicTile> {
        let tile = TILE as usize;
        let mut tiles = Vec::new();
        for row in 0..PATCH as usize {
            for column in 0..PATCH as usize {
                let mut rgba = Vec::with_capacity(4 * tile * tile);
                for y in 0..tile {
                    let start = (row * tile + y) * SIDE + column * tile;
                    self.sums[start..start + tile]
                        .iter()
                        .for_each(|sums| rgba.extend_from_slice(&sums.pixel()));
                }
                if rgba.chunks_exact(4).any(|pixel| pixel[3] > 0) {
                    let (column, row) = (self.first.0 + column as i64, self.first.1 + row as i64);
                    tiles.push(MosaicTile { column, row, rgba });
                }
            }
        }
        tiles
    }
}

/// The border of the image.
struct Border {
    right: f32,
    bottom: f32,
}

impl Border {
    /// Whether a block is outside the image on one side altogether, or has no corner that is seen
    /// well.
    fn outside(&self, corners: &[Option<BlockCorner>; 4]) -> bool {
        let known = || corners.iter().flatten();
        known().all(|c| c.x < 0.0)
            || known().all(|c| c.y < 0.0)
            || known().all(|c| c.x > self.right)
            || known().all(|c| c.y > self.bottom)
    }

    /// Weight of a view: 1 in the middle of the image, almost nothing at its border, less
    /// where the ground is seen at a slant. `None` outside.
    #[inline]
    fn weight(&self, seen: BlockCorner) -> Option<f32> {
        let from_border = seen.x.min(self.right - seen.x).min(seen.y.min(self.bottom - seen.y));
        let share = ((from_border + 0.5) / (0.5 * self.right.min(self.bottom) + 0.5)).min(1.0);
        (from_border >= 0.0).then_some((share * share * seen.quality).max(1e-4))
    }
}

impl PixelSums {
    #[inline]
    fn add<const N: usize>(&mut self, sample: [f32; N], coarse: [f32; N], weight: f32, gains: &[f32; 3]) {
        let sharp = weight.powi(SHARPNESS).max(1e-30);
        for (channel, gain) in gains.iter().enumerate() {
            let from = channel.min(N - 1);
            self.coarse[channel] += weight * gain * coarse[from];
            self.fine[channel] += sharp * gain * (sample[from] - coarse[from]);
        }
        self.coarse_weight += weight;
        self.fine_weight += sharp;
    }

    /// Red, green, blue and opacity; white where nothing was seen.
    fn pixel(&self) -> [u8; 4] {
        if self.coarse_weight <= 0.0 {
            return [255, 255, 255, 0];
        }
        let value = |k: usize| {
            let value = self.coarse[k] / self.coarse_weight + self.fine[k] / self.fine_weight;
            (value + 0.5).clamp(0.0, 255.0) as u8
        };
        [value(0), value(1), value(2), 255]
    }
}
