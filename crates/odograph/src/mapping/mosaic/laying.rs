//! How a frame is laid on the ground: block by block, levelled in brightness, feathered.

use super::Mosaic;
use super::footprint::{Look, View};
use super::tiles::{Lookup, TILE};
use crate::camera::Camera;
use crate::geometry::GroundPoint;
use std::ops::Range;

/// Side of the blocks, in ground pixels, within which the way from the ground to the image is taken as bilinear. At a
/// strong lens distortion (k1 = −0.3) the error is below 0.02 px.
pub(super) const BLOCK: i64 = 8;
/// Ground seen this many times as well before is not touched again.
const OUTWEIGHED: u16 = 6;
/// How much of the brightness step to the ground already there is taken out; less than all, so that small errors die out
/// along the path instead of adding up.
const GAIN_SHARE: f64 = 0.95;

/// What is known at a corner of a block: where it is in the image, and how well the ground is seen there.
#[derive(Debug, Clone, Copy)]
pub(super) struct Corner {
    pub x: f32,
    pub y: f32,
    pub quality: f32,
}

impl From<Look> for Corner {
    fn from(look: Look) -> Self {
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
    pub(super) fn find_corners(&mut self, blocks: &Blocks, view: &View<'_>, resolution_m: f64) {
        self.corners.clear();
        let side = BLOCK as f64 * resolution_m;
        for row in blocks.rows.start..=blocks.rows.end {
            for column in blocks.columns.start..=blocks.columns.end {
                let look = view.look(GroundPoint::new(column as f64 * side, -(row as f64) * side));
                self.corners.push(look.map(Corner::from));
            }
        }
    }

    fn corners_of(&self, blocks: &Blocks, column: i64, row: i64) -> [Option<Corner>; 4] {
        let stride = (blocks.columns.end - blocks.columns.start + 1) as usize;
        let at = (row - blocks.rows.start) as usize * stride + (column - blocks.columns.start) as usize;
        [self.corners[at], self.corners[at + 1], self.corners[at + stride], self.corners[at + stride + 1]]
    }

    /// The gain of each channel that brings the frame to the brightness of the ground already there: the median ratio in the
    /// middle of all blocks that have been seen before.
    fn gains<const N: usize>(&self, blocks: &Blocks) -> [f32; N] {
        let mut ratios: [Vec<f32>; N] = std::array::from_fn(|_| vec![]);
        for row in blocks.rows.clone() {
            for column in blocks.columns.clone() {
                let [Some(a), Some(b), Some(c), Some(d)] = self.corners_of(blocks, column, row) else {
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
                        ratios[channel].push(old / new);
                    }
                }
            }
        }
        ratios.map(|mut ratios| {
            let middle = ratios.len() / 2;
            if ratios.len() < 24 {
                return 1.0;
            }
            let (_, median, _) = ratios.select_nth_unstable_by(middle, f32::total_cmp);
            f64::from(*median).powf(GAIN_SHARE).clamp(0.5, 2.0) as f32
        })
    }

    /// Lays the frame on all blocks. Returns whether any of it came to lie on the ground.
    pub(super) fn lay<const N: usize>(
        &mut self,
        blocks: &Blocks,
        view: &View<'_>,
        resolution_m: f64,
        camera: &Camera,
    ) -> bool {
        let gains = self.gains::<N>(blocks);
        let feather = Feather::new(camera);
        let mut lookup = Lookup::new();
        let mut laid = false;
        for row in blocks.rows.clone() {
            for column in blocks.columns.clone() {
                let corners = self.corners_of(blocks, column, row);
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
                    let pixels = &mut tile[(in_y + j) * TILE as usize + in_x..][..BLOCK as usize];
                    let whole = match corners {
                        [Some(a), Some(b), Some(c), Some(d)] => Some(Corner::row(a, b, c, d, j)),
                        _ => None,
                    };
                    for (i, pixel) in pixels.iter_mut().enumerate() {
                        let at = match whole {
                            Some((first, step)) => first.plus(step, i as f32),
                            None => {
                                let x_m = (left as f64 + i as f64 + 0.5) * resolution_m;
                                let y_m = -(top as f64 + j as f64 + 0.5) * resolution_m;
                                let Some(look) = view.look(GroundPoint::new(x_m, y_m)) else { continue };
                                Corner::from(look)
                            }
                        };
                        let Some(weight) = feather.weight(at.x, at.y, at.quality) else { continue };
                        laid = true;
                        // What was seen much better before is left as it is: sharper, and quicker.
                        if u16::from(pixel[3]) >= OUTWEIGHED * u16::from(weight) {
                            continue;
                        }
                        let Some(mut sample) = self.samples.at::<N>(at.x, at.y) else { continue };
                        sample.iter_mut().zip(gains).for_each(|(value, gain)| *value *= gain);
                        blend(pixel, sample, weight);
                    }
                }
            }
        }
        laid
    }
}

/// How much a sample counts by where in the image it is.
pub(super) struct Feather {
    right: f32,
    bottom: f32,
    /// One over half the shorter side, 1/px.
    by_half: f32,
}

impl Feather {
    pub fn new(camera: &Camera) -> Self {
        let (width, height) = (camera.width() as f32, camera.height() as f32);
        Self { right: width - 1.0, bottom: height - 1.0, by_half: 2.0 / width.min(height) }
    }

    /// The weight, 1 to 63: greatest in the middle of the image, 1 at its border, less where the ground is seen at a slant.
    /// `None` outside the centres of the outermost pixels.
    #[inline]
    pub fn weight(&self, x: f32, y: f32, quality: f32) -> Option<u8> {
        let from_border = x.min(self.right - x).min(y.min(self.bottom - y));
        let share = ((from_border + 0.5) * self.by_half).min(1.0);
        (from_border >= 0.0).then_some((1.0 + 62.0 * share * share * quality) as u8)
    }
}

/// The weighted mean of a stored pixel (colour and weight) and a sample.
#[inline]
fn blend<const N: usize>(pixel: &mut [u8; 4], sample: [f32; N], weight: u8) {
    let before = pixel[3];
    let share = f32::from(weight) / (f32::from(before) + f32::from(weight));
    for channel in 0..N {
        let old = f32::from(pixel[channel]);
        let new = sample[channel].min(255.0);
        pixel[channel] = (old + (new - old) * share + 0.5) as u8;
    }
    for channel in N..3 {
        pixel[channel] = pixel[0];
    }
    pixel[3] = before.saturating_add(weight);
}

impl Corner {
    fn mix(self, other: Self, share: f32) -> Self {
        let mix = |a: f32, b: f32| a + (b - a) * share;
        Self { x: mix(self.x, other.x), y: mix(self.y, other.y), quality: mix(self.quality, other.quality) }
    }

    /// The first pixel centre of row `j` in a block with the corners a b / c d, and the step to the next.
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
}
