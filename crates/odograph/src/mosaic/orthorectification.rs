//! Adding a frame to the mosaic: orthorectified block by block, with gain compensation and
//! feathering.

use super::Mosaic;
use super::footprint::{GroundCamera, GroundSample};
use super::sampling::FrameSamples;
use super::tiles::{Lookup, TILE};
use crate::camera::Camera;
use crate::geometry::GroundPoint;
use crate::image::simd::ground::{Feather, LANES, Places, orthorectify_eight};
use crate::numerics::median;
use std::ops::Range;

/// Side of the blocks, in ground pixels, within which the mapping from the ground to the image is
/// taken as bilinear. At a strong lens distortion (k1 = −0.3) the error is below 0.02 px. A row of
/// a block is orthorectified at a time.
pub(super) const BLOCK: i64 = LANES as i64;
/// Share of the brightness difference to the existing ground that is compensated; below 1, so that
/// small errors decay along the path instead of adding up.
const GAIN_SHARE: f64 = 0.95;

/// A corner of a block: where it is in the image, and how well the ground is seen there.
#[derive(Debug, Clone, Copy)]
pub(super) struct BlockCorner {
    pub x: f32,
    pub y: f32,
    pub quality: f32,
}

impl From<GroundSample> for BlockCorner {
    fn from(look: GroundSample) -> Self {
        Self { x: look.x as f32, y: look.y as f32, quality: look.quality() as f32 }
    }
}

/// The blocks under a footprint: ranges of block columns (along x) and rows (against y).
pub(super) struct Blocks {
    pub columns: Range<i64>,
    pub rows: Range<i64>,
}

impl Mosaic {
    /// Where the corners of all blocks are in the image.
    pub(super) fn find_corners(&mut self, blocks: &Blocks, view: &GroundCamera<'_>, resolution_m: f64) {
        self.corners.clear();
        let side = BLOCK as f64 * resolution_m;
        for row in blocks.rows.start..=blocks.rows.end {
            for column in blocks.columns.start..=blocks.columns.end {
                let look = view.look(GroundPoint::new(column as f64 * side, -(row as f64) * side));
                self.corners.push(look.map(BlockCorner::from));
            }
        }
    }

    /// The gain of each channel that matches the frame to the existing ground: the median ratio at
    /// the centres of all blocks seen before.
    fn gains<const N: usize>(&self, blocks: &Blocks) -> [f32; N] {
        let mut ratios: [Vec<f64>; N] = std::array::from_fn(|_| vec![]);
        for row in blocks.rows.clone() {
            for column in blocks.columns.clone() {
                let [Some(a), Some(b), Some(c), Some(d)] = corners_of(&self.corners, blocks, column, row)
                else {
                    continue;
                };
                let middle = (0.25 * (a.x + b.x + c.x + d.x), 0.25 * (a.y + b.y + c.y + d.y));
                let Some(new) = self.samples.at::<N>(middle.0, middle.1) else { continue };
                let Some(old) = self.tiles.colour(column * BLOCK + BLOCK / 2, row * BLOCK + BLOCK / 2) else {
                    continue;
                };
                for channel in 0..N {
                    let (old, new) = (f32::from(old[channel]), new[channel]);
                    if old.min(new) > 8.0 && old.max(new) < 247.0 {
                        ratios[channel].push(f64::from(old / new));
                    }
                }
            }
        }
        ratios.map(|mut ratios| {
            let usual = median(&mut ratios).filter(|_| ratios.len() >= 24);
            usual.map_or(1.0, |ratio| ratio.powf(GAIN_SHARE).clamp(0.5, 2.0) as f32)
        })
    }

    /// Adds the frame to all blocks. Returns whether any ground was changed.
    pub(super) fn orthorectify<const N: usize>(
        &mut self,
        blocks: &Blocks,
        view: &GroundCamera<'_>,
        resolution_m: f64,
        camera: &Camera,
    ) -> bool {
        let gains = self.gains::<N>(blocks);
        let feather = feather(camera);
        let Some(frame) = self.samples.unrectified(feather, gains) else { return false };
        let corners_of = |column, row| corners_of(&self.corners, blocks, column, row);
        let mut lookup = Lookup::new();
        let mut covered = false;
        for row in blocks.rows.clone() {
            for column in blocks.columns.clone() {
                let corners = corners_of(column, row);
                let known = || corners.iter().flatten();
                // Outside the image on one side altogether, or with no corner that is seen well.
                let outside = known().all(|c| c.x < 0.0)
                    || known().all(|c| c.y < 0.0)
                    || known().all(|c| c.x > feather.right)
                    || known().all(|c| c.y > feather.bottom);
                if outside {
                    continue;
                }
                let (left, top) = (column * BLOCK, row * BLOCK);
                let tile = &mut *self.tiles.at(&mut lookup, left, top);
                let (in_x, in_y) = (left.rem_euclid(TILE) as usize, top.rem_euclid(TILE) as usize);
                for j in 0..BLOCK as usize {
                    let pixels = &mut tile[(in_y + j) * TILE as usize + in_x..];
                    let Some(pixels) = pixels.first_chunk_mut::<{ BLOCK as usize }>() else { continue };
                    let mut places = match corners {
                        [Some(a), Some(b), Some(c), Some(d)] => {
                            BlockCorner::places(BlockCorner::row(a, b, c, d, j))
                        }
                        _ => row_by_itself(view, resolution_m, left, top + j as i64),
                    };
                    if self.samples.has_mask() {
                        leave_out_masked(&self.samples, &mut places);
                    }
                    covered |= orthorectify_eight(&frame, &places, pixels);
                }
            }
        }
        covered
    }
}

/// The feathering weights of this camera's images.
pub(super) fn feather(camera: &Camera) -> Feather {
    Feather::new(camera.width(), camera.height())
}

/// Image coordinates of a row of a block with an unusable corner: each computed on its own.
fn row_by_itself(view: &GroundCamera<'_>, resolution_m: f64, left: i64, row: i64) -> Places {
    let nowhere = [f32::NAN; BLOCK as usize];
    let mut places = Places { x: nowhere, y: nowhere, quality: nowhere };
    for i in 0..BLOCK as usize {
        let x_m = (left as f64 + i as f64 + 0.5) * resolution_m;
        let y_m = -(row as f64 + 0.5) * resolution_m;
        if let Some(look) = view.look(GroundPoint::new(x_m, y_m)) {
            (places.x[i], places.y[i], places.quality[i]) =
                (look.x as f32, look.y as f32, look.quality() as f32);
        }
    }
    places
}

/// Moves the masked places out of the image.
fn leave_out_masked(samples: &FrameSamples, places: &mut Places) {
    for (x, y) in places.x.iter_mut().zip(&places.y) {
        if samples.is_masked(*x, *y) {
            *x = f32::NAN;
        }
    }
}

/// What is known at the four corners of a block.
fn corners_of(
    corners: &[Option<BlockCorner>],
    blocks: &Blocks,
    column: i64,
    row: i64,
) -> [Option<BlockCorner>; 4] {
    let stride = (blocks.columns.end - blocks.columns.start + 1) as usize;
    let at = (row - blocks.rows.start) as usize * stride + (column - blocks.columns.start) as usize;
    [corners[at], corners[at + 1], corners[at + stride], corners[at + stride + 1]]
}

impl BlockCorner {
    fn mix(self, other: Self, share: f32) -> Self {
        let mix = |a: f32, b: f32| a + (b - a) * share;
        Self { x: mix(self.x, other.x), y: mix(self.y, other.y), quality: mix(self.quality, other.quality) }
    }

    /// The first pixel centre of row `j` in a block with the corners a b / c d, and the step to the
    /// next.
    pub fn row(a: Self, b: Self, c: Self, d: Self, j: usize) -> (Self, Self) {
        let down = (j as f32 + 0.5) / BLOCK as f32;
        let (left, right) = (a.mix(c, down), b.mix(d, down));
        let part = |a: f32, b: f32| (b - a) / BLOCK as f32;
        let step = Self {
            x: part(left.x, right.x),
            y: part(left.y, right.y),
            quality: part(left.quality, right.quality),
        };
        (left.plus(step, 0.5), step)
    }

    #[inline]
    pub fn plus(self, step: Self, times: f32) -> Self {
        Self {
            x: self.x + step.x * times,
            y: self.y + step.y * times,
            quality: self.quality + step.quality * times,
        }
    }

    /// The pixels of a row from its first in equal steps.
    fn places((first, step): (Self, Self)) -> Places {
        let along = |first: f32, step: f32| std::array::from_fn(|i| first + step * i as f32);
        Places {
            x: along(first.x, step.x),
            y: along(first.y, step.y),
            quality: along(first.quality, step.quality),
        }
    }
}
