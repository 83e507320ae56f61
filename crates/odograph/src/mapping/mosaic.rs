//! The mosaic: frames laid on the ground along the path, one picture of the floor.
//!
//! Frames arrive one by one and none is kept. The ground is stored as square tiles where it was seen, so that a long thin path
//! costs its own area, not that of the rectangle around it; when the area outgrows its bound, the whole mosaic is made half as
//! fine, as often as needed. Overlapping frames are averaged with weights that favour the middle of the image and the
//! steeper view (feathering), after each frame's brightness has been fitted to the ground that is already there.

mod footprint;
mod sampling;
mod tiles;

use crate::camera::Camera;
use crate::geometry::{GroundPoint, GroundPose};
use crate::image::{GrayImage, RgbImage};
use crate::mapping::Placement;
use footprint::{Footprint, View};
use sampling::Samples;
use tiles::{Lookup, TILE, Tiles};

/// Side of the blocks, in ground pixels, within which the way from the ground to the image is taken as bilinear. At a
/// strong lens distortion (k1 = −0.3) the error is below 0.02 px.
const BLOCK: i64 = 8;
/// Share of the footprint that must be new, or seen at least twice as well as before, for a frame to be wanted.
const WANTED_NEW: f64 = 0.08;
const WANTED_BETTER: f64 = 0.40;
/// Ground seen this many times as well before is not touched again.
const OUTWEIGHED: u16 = 6;
/// How much of the brightness step to the ground already there is taken out; less than all, so that small errors die out
/// along the path instead of adding up.
const GAIN_SHARE: f64 = 0.95;
/// Ground pixels farther than this from the origin are not addressed.
const FARTHEST_PIXEL: f64 = 1e12;

/// How fine and how large a mosaic becomes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MosaicOptions {
    /// Side of a ground pixel, metres; by default what a pixel in the middle of the first frame sees. Never finer than a
    /// quarter of that, and made coarser by halves when the mosaic outgrows `max_pixels`.
    pub ground_resolution_m: Option<f64>,
    /// Bound on the stored ground pixels (4 bytes each) and on the pixels of the picture.
    pub max_pixels: usize,
}

impl Default for MosaicOptions {
    fn default() -> Self {
        Self { ground_resolution_m: None, max_pixels: 32_000_000 }
    }
}

/// An image that can be laid on the ground.
#[derive(Debug, Clone, Copy)]
pub enum MosaicSource<'a> {
    /// Luminance.
    Gray(&'a GrayImage),
    /// Colour.
    Rgb(&'a RgbImage),
}

impl<'a> From<&'a GrayImage> for MosaicSource<'a> {
    fn from(image: &'a GrayImage) -> Self {
        Self::Gray(image)
    }
}

impl<'a> From<&'a RgbImage> for MosaicSource<'a> {
    fn from(image: &'a RgbImage) -> Self {
        Self::Rgb(image)
    }
}

/// A picture of the ground, world x to the right and world y up.
#[derive(Debug, Clone, PartialEq)]
pub struct MosaicPicture {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Red, green, blue and opacity of each pixel in row order. Opacity is 255 where the ground was seen; elsewhere the pixel is
    /// white with opacity 0, so that programs that ignore opacity show paper, not a hole.
    pub rgba: Vec<u8>,
    /// Where it lies.
    pub placement: Placement,
}

/// The ground seen so far.
#[derive(Debug, Clone)]
pub struct Mosaic {
    options: MosaicOptions,
    /// Side of a ground pixel, metres; known from the first frame on.
    resolution_m: Option<f64>,
    tiles: Tiles,
    footprint: Option<Footprint>,
    corners: Vec<Option<Corner>>,
    samples: Samples,
}

/// What is known at a corner of a block: where it is in the image, and how well the ground is seen there.
#[derive(Debug, Clone, Copy)]
struct Corner {
    x: f32,
    y: f32,
    quality: f32,
}

impl Mosaic {
    /// An empty mosaic.
    pub fn new(options: MosaicOptions) -> Self {
        Self {
            options,
            resolution_m: None,
            tiles: Tiles::default(),
            footprint: None,
            corners: vec![],
            samples: Samples::default(),
        }
    }

    /// Side of a ground pixel, metres; `None` before the first frame.
    pub fn resolution_m(&self) -> Option<f64> {
        self.resolution_m
    }

    /// Whether a frame from this pose would show enough that is new, or shown better than so far. Cheap (some hundred
    /// points are looked up); ask it for every frame and lay those it wants.
    pub fn wants(&mut self, camera: &Camera, pose: &GroundPose) -> bool {
        let footprint = Footprint::of(&mut self.footprint, camera);
        let Some(view) = View::new(camera, pose) else {
            return false;
        };
        let Some(resolution_m) = self.resolution_m else {
            return true;
        };
        let feather = Feather::new(camera);
        let (mut seen, mut new, mut better) = (0, 0, 0);
        for point in footprint.ground_points(&view) {
            let Some(look) = view.look(point) else { continue };
            seen += 1;
            let weight = feather.weight(look.x as f32, look.y as f32, look.quality() as f32).unwrap_or(1);
            match self.tiles.weight(address(point.x_m, resolution_m), address(-point.y_m, resolution_m)) {
                0 => new += 1,
                before if 2 * u16::from(before) < u16::from(weight) => better += 1,
                _ => {}
            }
        }
        let share = |count: i32| f64::from(count) / f64::from(seen.max(1));
        share(new) > WANTED_NEW || share(new + better) > WANTED_BETTER
    }

    /// Lays a frame on the ground. Returns whether any of it could be laid: not where the size is not the camera's, where the
    /// pose is not finite, or where the camera hardly looks at the ground.
    ///
    /// Only the part of the image is used where a metre of ground has at least a quarter of the pixels that it has in the
    /// middle.
    pub fn add<'a>(
        &mut self,
        image: impl Into<MosaicSource<'a>>,
        camera: &Camera,
        pose: &GroundPose,
    ) -> bool {
        let image = image.into();
        let size = match image {
            MosaicSource::Gray(gray) => (gray.width(), gray.height()),
            MosaicSource::Rgb(rgb) => (rgb.width(), rgb.height()),
        };
        let Some(view) = View::new(camera, pose).filter(|_| size == (camera.width(), camera.height())) else {
            return false;
        };
        let sample_m = view.centre_resolution_m();
        let mut resolution_m = self.resolution_m.unwrap_or_else(|| {
            let wished = self.options.ground_resolution_m.filter(|r| r.is_finite() && *r > 0.0);
            wished.map_or(sample_m, |wished| wished.max(0.25 * sample_m))
        });
        // A camera that has climbed sees less detail: storing it finer than twice what it sees would be waste.
        while sample_m > 2.0 * resolution_m {
            resolution_m *= 2.0;
            self.tiles = self.tiles.halved();
        }
        let footprint = Footprint::of(&mut self.footprint, camera);
        let Some((low, high)) = footprint.bounds(&view) else {
            return false;
        };
        let farthest = [low.x_m, low.y_m, high.x_m, high.y_m].iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        let area = (high.x_m - low.x_m) * (high.y_m - low.y_m) / (resolution_m * resolution_m);
        if farthest / resolution_m > FARTHEST_PIXEL || area > 64.0 * (size.0 * size.1) as f64 + 1e6 {
            return false;
        }
        self.resolution_m = Some(resolution_m);
        let level = (sample_m.recip() * resolution_m).log2().round().clamp(0.0, 8.0) as u32;
        self.samples.take(image, level);
        let columns = block(low.x_m, resolution_m)..block(high.x_m, resolution_m) + 1;
        let rows = block(-high.y_m, resolution_m)..block(-low.y_m, resolution_m) + 1;
        let blocks = Blocks { columns, rows };
        self.find_corners(&blocks, &view, resolution_m);
        let laid = match self.samples.channels() {
            1 => self.lay::<1>(&blocks, &view, resolution_m, camera),
            _ => self.lay::<3>(&blocks, &view, resolution_m, camera),
        };
        self.keep_within_bounds();
        laid
    }

    /// The whole picture, as fine as it is stored; coarser by halves where its rectangle would have more than
    /// [`MosaicOptions::max_pixels`]. `None` while nothing has been laid.
    pub fn picture(&self) -> Option<MosaicPicture> {
        self.picture_within(usize::MAX)
    }

    /// The picture made coarser by halves until no side is longer than `max_side_px`.
    pub fn picture_within(&self, max_side_px: usize) -> Option<MosaicPicture> {
        let mut resolution_m = self.resolution_m?;
        let mut coarser: Option<Tiles> = None;
        for _ in 0..200 {
            let tiles = coarser.as_ref().unwrap_or(&self.tiles);
            let (columns, rows) = tiles.extent()?;
            let size =
                |range: &std::ops::Range<i64>| usize::try_from(range.end - range.start).unwrap_or(usize::MAX);
            let (width, height) = (size(&columns), size(&rows));
            let area = width.saturating_mul(height);
            if width.max(height) <= max_side_px.max(1) && area <= self.options.max_pixels.max(1) {
                let placement = Placement {
                    metres_per_pixel: resolution_m,
                    x_m: (columns.start as f64 + 0.5) * resolution_m,
                    y_m: -(rows.start as f64 + 0.5) * resolution_m,
                };
                return Some(MosaicPicture { width, height, rgba: tiles.rgba(&columns, &rows), placement });
            }
            coarser = Some(tiles.halved());
            resolution_m *= 2.0;
        }
        None
    }

    /// Where the corners of all blocks are in the image.
    fn find_corners(&mut self, blocks: &Blocks, view: &View<'_>, resolution_m: f64) {
        self.corners.clear();
        let side = BLOCK as f64 * resolution_m;
        for row in blocks.rows.start..=blocks.rows.end {
            for column in blocks.columns.start..=blocks.columns.end {
                let look = view.look(GroundPoint::new(column as f64 * side, -(row as f64) * side));
                self.corners.push(look.map(|look| Corner {
                    x: look.x as f32,
                    y: look.y as f32,
                    quality: look.quality() as f32,
                }));
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

    fn lay<const N: usize>(
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
                // Outside the image on one side altogether; a margin of one block allows for a curved image border.
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
                                Corner { x: look.x as f32, y: look.y as f32, quality: look.quality() as f32 }
                            }
                        };
                        let Some(weight) = feather.weight(at.x, at.y, at.quality) else { continue };
                        laid = true;
                        // What was seen much better before is left as it is: sharper, and quicker.
                        if u16::from(pixel[3]) >= OUTWEIGHED * u16::from(weight) {
                            continue;
                        }
                        let Some(sample) = self.samples.at::<N>(at.x, at.y) else { continue };
                        blend::<N>(pixel, std::array::from_fn(|c| sample[c] * gains[c]), weight);
                    }
                }
            }
        }
        laid
    }

    fn keep_within_bounds(&mut self) {
        // Four tiles can meet at the origin and never become one.
        let limit = (self.options.max_pixels / (TILE * TILE) as usize).max(4);
        while self.tiles.count() > limit {
            self.tiles = self.tiles.halved();
            self.resolution_m = self.resolution_m.map(|r| 2.0 * r);
        }
    }
}

/// The blocks under a footprint: ranges of block columns (along x) and rows (against y).
struct Blocks {
    columns: std::ops::Range<i64>,
    rows: std::ops::Range<i64>,
}

/// The ground pixel on one axis that holds a coordinate.
fn address(metres: f64, resolution_m: f64) -> i64 {
    (metres / resolution_m).floor() as i64
}

/// The block on one axis that holds a coordinate.
fn block(metres: f64, resolution_m: f64) -> i64 {
    address(metres, resolution_m).div_euclid(BLOCK)
}

/// How much a sample counts by where in the image it is.
struct Feather {
    right: f32,
    bottom: f32,
    /// One over half the shorter side, 1/px.
    by_half: f32,
}

impl Feather {
    fn new(camera: &Camera) -> Self {
        let (width, height) = (camera.width() as f32, camera.height() as f32);
        Self { right: width - 1.0, bottom: height - 1.0, by_half: 2.0 / width.min(height) }
    }

    /// The weight, 1 to 63: greatest in the middle of the image, 1 at its border, less where the ground is seen at a slant.
    /// `None` outside the centres of the outermost pixels.
    #[inline]
    fn weight(&self, x: f32, y: f32, quality: f32) -> Option<u8> {
        let from_border = x.min(self.right - x).min(y.min(self.bottom - y));
        let share = ((from_border + 0.5) * self.by_half).min(1.0);
        (from_border >= 0.0).then(|| (1.0 + 62.0 * share * share * quality) as u8)
    }
}

/// The weighted mean of a stored pixel (colour and weight) and a sample.
#[inline]
fn blend<const N: usize>(pixel: &mut [u8; 4], sample: [f32; N], weight: u8) {
    let before = pixel[3];
    let share = f32::from(weight) / (f32::from(before) + f32::from(weight));
    for channel in 0..3 {
        let old = f32::from(pixel[channel]);
        let new = sample[channel.min(N - 1)].min(255.0);
        pixel[channel] = (old + (new - old) * share + 0.5) as u8;
    }
    pixel[3] = before.saturating_add(weight);
}

impl Corner {
    fn mix(self, other: Self, share: f32) -> Self {
        let mix = |a: f32, b: f32| a + (b - a) * share;
        Self { x: mix(self.x, other.x), y: mix(self.y, other.y), quality: mix(self.quality, other.quality) }
    }

    /// The first pixel centre of row `j` in a block with the corners a b / c d, and the step to the next.
    fn row(a: Self, b: Self, c: Self, d: Self, j: usize) -> (Self, Self) {
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
    fn plus(self, step: Self, times: f32) -> Self {
        Self {
            x: self.x + step.x * times,
            y: self.y + step.y * times,
            quality: self.quality + step.quality * times,
        }
    }
}

#[cfg(test)]
mod tests;
