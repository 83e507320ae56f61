//! The mosaic: frames orthorectified and blended into one picture of the ground.
//!
//! Frames arrive one by one and none is kept. The ground is stored as square tiles, only where it
//! was seen, so that a long thin path costs its own area and not that of its bounding box; when the
//! area exceeds its limit, the resolution of the whole mosaic is halved, as often as needed.
//! Overlapping frames are averaged with weights that favour the middle of the image and the steeper
//! view (feathering), after gain compensation of each frame.

mod coverage;
mod footprint;
mod orthorectification;
mod map_mosaic;
mod sampling;
mod tiles;

use crate::camera::Camera;
use crate::fixed_pattern::ImageMask;
use crate::geometry::{GroundPose, Pixel, Placement};
use crate::image::{GrayImage, RgbImage};
pub use coverage::Coverage;
use footprint::{Footprint, GroundCamera};
pub use map_mosaic::{MOSAIC_TILE_PX, MapMosaic, MosaicTile};
use orthorectification::{BLOCK, BlockCorner, Blocks, feather};
use sampling::FrameSamples;
use std::borrow::Cow;
use std::ops::Range;
use std::sync::Arc;
use tiles::{TILE, Tiles};

/// Minimum share of the footprint that is new, or seen at least twice as well as before, for a
/// frame to be used. Lower leaves smaller holes and blurs, higher renders fewer frames.
const WANTED_NEW: f64 = 0.08;
const WANTED_BETTER: f64 = 0.40;
/// Ground pixels farther than this from the origin are not addressed.
const FARTHEST_PIXEL: f64 = 1e12;

/// Resolution and size of a mosaic.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MosaicOptions {
    /// Side of a ground pixel, metres; by default what a pixel in the middle of the first frame
    /// sees. Never finer than a quarter of that, and made coarser by halves when the mosaic
    /// outgrows `max_pixels`.
    pub ground_resolution_m: Option<f64>,
    /// Bound on the stored ground pixels (4 bytes each) and on the pixels of the picture.
    pub max_pixels: usize,
}

impl Default for MosaicOptions {
    fn default() -> Self {
        Self { ground_resolution_m: None, max_pixels: 32_000_000 }
    }
}

/// An image that a mosaic accepts.
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
    /// Red, green, blue and opacity of each pixel in row order. Opacity is 255 where the ground was
    /// seen; elsewhere the pixel is white with opacity 0, so that programs that ignore opacity show
    /// paper, not a hole.
    pub rgba: Vec<u8>,
    /// Its georeference.
    pub placement: Placement,
}

/// A picture of the ground, world x to the right and world y up, as bands of rows from top to
/// bottom: red, green, blue and opacity of each pixel in row order, as in [`MosaicPicture::rgba`].
#[derive(Debug)]
pub struct MosaicBands<'a> {
    /// Columns.
    pub width: usize,
    /// Rows of all bands.
    pub height: usize,
    /// Its georeference.
    pub placement: Placement,
    tiles: Cow<'a, Tiles>,
    columns: Range<i64>,
    /// The remaining rows.
    rows: Range<i64>,
}

impl Iterator for MosaicBands<'_> {
    type Item = Vec<u8>;

    fn next(&mut self) -> Option<Vec<u8>> {
        if self.rows.is_empty() {
            return None;
        }
        let next_tile = (self.rows.start.div_euclid(TILE) + 1) * TILE;
        let band = self.rows.start..self.rows.end.min(next_tile);
        self.rows.start = band.end;
        Some(self.tiles.rgba(&self.columns, &band))
    }
}

/// A square of the stored ground, [`Mosaic::TILE_SIDE_PX`] pixels a side: column and row count from
/// the world's origin, columns along x and rows against y.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct MosaicSquare {
    /// Along x: its left border is at `column · side · resolution`.
    pub column: i64,
    /// Against y: its upper border is at y = `-row · side · resolution`.
    pub row: i64,
}

/// The ground seen so far.
#[derive(Debug, Clone)]
pub struct Mosaic {
    options: MosaicOptions,
    /// Side of a ground pixel, metres; known from the first frame on.
    resolution_m: Option<f64>,
    tiles: Tiles,
    footprint: Option<Footprint>,
    corners: Vec<Option<BlockCorner>>,
    samples: FrameSamples,
    /// Mask of pixels that do not show ground.
    mask: Option<Arc<ImageMask>>,
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
            samples: FrameSamples::default(),
            mask: None,
        }
    }

    /// Leaves out what a mask covers in images that are added from now on: a bumper, dirt on the
    /// lens.
    pub fn set_mask(&mut self, mask: Option<Arc<ImageMask>>) {
        self.mask = mask;
    }

    /// What is left out in the images.
    pub fn mask(&self) -> Option<&Arc<ImageMask>> {
        self.mask.as_ref()
    }

    /// Side of a ground pixel, metres; `None` before the first frame.
    pub fn resolution_m(&self) -> Option<f64> {
        self.resolution_m
    }

    /// Side of a [`MosaicSquare`], ground pixels.
    pub const TILE_SIDE_PX: usize = TILE as usize;

    /// The same ground with ground pixels twice as wide, each the mean of the up to four that were
    /// seen.
    pub fn coarser(&self) -> Self {
        let mut coarser = Self::new(self.options);
        coarser.resolution_m = self.resolution_m.map(|resolution_m| 2.0 * resolution_m);
        coarser.tiles = self.tiles.halved();
        coarser
    }

    /// A counter that grows with every change; for [`Mosaic::changed_since`].
    pub fn revision(&self) -> u64 {
        self.tiles.revision()
    }

    /// The tiles changed after a revision; all of them after a change of resolution.
    pub fn changed_since(&self, revision: u64) -> impl Iterator<Item = MosaicSquare> {
        self.tiles.changed_since(revision).map(|(row, column)| MosaicSquare { column, row })
    }

    /// Red, green, blue and opacity of a tile's pixels in row order, as [`MosaicPicture::rgba`];
    /// `None` where nothing was seen.
    pub fn tile_rgba(&self, tile: MosaicSquare) -> Option<Vec<u8>> {
        self.tiles.contains(tile.row, tile.column).then(|| {
            let (left, top) = (tile.column * TILE, tile.row * TILE);
            self.tiles.rgba(&(left..left + TILE), &(top..top + TILE))
        })
    }

    /// Whether a frame from this pose would show enough new ground, or show it better. Cheap (some
    /// hundred points are looked up), so it can be called for every frame. Also add the last frame
    /// before each gap: no other shows the ground between it and the last wanted frame.
    pub fn wants(&mut self, camera: &Camera, pose: &GroundPose) -> bool {
        let footprint = Footprint::of(&mut self.footprint, camera);
        let Some(view) = GroundCamera::new(camera, pose) else {
            return false;
        };
        let Some(resolution_m) = self.resolution_m else {
            return true;
        };
        let feather = feather(camera);
        let mask = self.mask.as_deref();
        let (mut seen, mut new, mut better) = (0, 0, 0);
        for point in footprint.ground_points(&view) {
            let Some(look) = view.look(point) else { continue };
            if mask.is_some_and(|mask| mask.covers_pixel(Pixel::new(look.x, look.y))) {
                continue;
            }
            seen += 1;
            let weight = feather.weight(look.x as f32, look.y as f32, look.quality() as f32).max(1);
            match self.tiles.weight(address(point.x_m, resolution_m), address(-point.y_m, resolution_m)) {
                0 => new += 1,
                before if 2 * i32::from(before) < weight => better += 1,
                _ => {}
            }
        }
        let share = |count: i32| f64::from(count) / f64::from(seen.max(1));
        share(new) > WANTED_NEW || share(new + better) > WANTED_BETTER
    }

    /// Adds a frame. Returns whether any of it was used: not if the size is not the camera's, the
    /// pose is not finite, or the camera hardly looks at the ground.
    ///
    /// Frames of one mosaic are all gray or all in colour; a gray frame takes the colour of the
    /// ground below it. Only the part of the image is used where a metre of ground has at least a
    /// quarter of the pixels that it has in the middle.
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
        let Some(view) =
            GroundCamera::new(camera, pose).filter(|_| size == (camera.width(), camera.height()))
        else {
            return false;
        };
        let sample_m = view.centre_resolution_m();
        let mut resolution_m = self.resolution_m.unwrap_or_else(|| {
            let wished = self.options.ground_resolution_m.filter(|r| r.is_finite() && *r > 0.0);
            wished.map_or(sample_m, |wished| wished.max(0.25 * sample_m))
        });
        // A camera that has climbed sees less detail: a resolution finer than twice its own would
        // be waste.
        let mut halvings = 0;
        while sample_m > 2.0 * resolution_m {
            resolution_m *= 2.0;
            halvings += 1;
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
        self.tiles.begin_revision();
        (0..halvings).for_each(|_| self.tiles = self.tiles.halved());
        let level = (sample_m.recip() * resolution_m).log2().round().clamp(0.0, 8.0) as u32;
        self.samples.take(image, self.mask.as_ref(), level);
        let columns = block(low.x_m, resolution_m)..block(high.x_m, resolution_m) + 1;
        let rows = block(-high.y_m, resolution_m)..block(-low.y_m, resolution_m) + 1;
        let blocks = Blocks { columns, rows };
        self.find_corners(&blocks, &view, resolution_m);
        let covered = match self.samples.channels() {
            1 => self.orthorectify::<1>(&blocks, &view, resolution_m, camera),
            _ => self.orthorectify::<3>(&blocks, &view, resolution_m, camera),
        };
        self.keep_within_bounds();
        covered
    }

    /// The whole picture at the stored resolution; coarser by halves if its bounding box would have
    /// more than [`MosaicOptions::max_pixels`]. `None` for an empty mosaic.
    pub fn picture(&self) -> Option<MosaicPicture> {
        self.picture_within(usize::MAX)
    }

    /// The picture made coarser by halves until no side is longer than `max_side_px`.
    pub fn picture_within(&self, max_side_px: usize) -> Option<MosaicPicture> {
        let bands = self.bands(max_side_px)?;
        let (width, height, placement) = (bands.width, bands.height, bands.placement);
        let mut rgba = Vec::with_capacity(4 * width * height);
        bands.for_each(|band| rgba.extend(band));
        Some(MosaicPicture { width, height, rgba, placement })
    }

    /// The picture of [`Mosaic::picture_within`] from top to bottom, a band of rows at a time: for
    /// writing it without having it in memory.
    pub fn bands(&self, max_side_px: usize) -> Option<MosaicBands<'_>> {
        let mut resolution_m = self.resolution_m?;
        let mut tiles = Cow::Borrowed(&self.tiles);
        for _ in 0..200 {
            let (columns, rows) = tiles.extent()?;
            let size = |range: &Range<i64>| usize::try_from(range.end - range.start).unwrap_or(usize::MAX);
            let (width, height) = (size(&columns), size(&rows));
            let area = width.saturating_mul(height);
            if width.max(height) <= max_side_px.max(1) && area <= self.options.max_pixels.max(1) {
                let placement = Placement {
                    metres_per_pixel: resolution_m,
                    x_m: (columns.start as f64 + 0.5) * resolution_m,
                    y_m: -(rows.start as f64 + 0.5) * resolution_m,
                };
                return Some(MosaicBands { width, height, placement, tiles, columns, rows });
            }
            tiles = Cow::Owned(tiles.halved());
            resolution_m *= 2.0;
        }
        None
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

/// The ground pixel on one axis that holds a coordinate.
fn address(metres: f64, resolution_m: f64) -> i64 {
    (metres / resolution_m).floor() as i64
}

/// The block on one axis that holds a coordinate.
fn block(metres: f64, resolution_m: f64) -> i64 {
    address(metres, resolution_m).div_euclid(BLOCK)
}

#[cfg(test)]
mod tests;
