//! The mosaic in the map file: a tile pyramid. The finest level is rendered; every coarser level is
//! reduced from the next finer one, tile by tile.

mod pyramid;
pub(crate) mod staleness;
mod tile;

use crate::complaint::WithContext;
use crate::file::MapFile;
use odograph::error::Result;
use odograph::geometry::Placement;
use odograph::ground_map::GroundMap;
use odograph::mosaic::{MOSAIC_TILE_PX, MapMosaic, Mosaic, MosaicPicture, MosaicSquare, MosaicTile};
use pyramid::TilePyramid;
use rusqlite::OptionalExtension;
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

/// Maximum number of pyramid levels: a picture is at most 2³⁰ pixels wide.
const MAX_LEVELS: u32 = 24;
/// Maximum number of tiles along a side of the finest level, for the same picture.
const WIDEST_TILES: i64 = 1 << 22;

/// The mosaic of a map: a pyramid of square tiles of [`MOSAIC_TILE_PX`]² pixels, 2ˡ × 2ˡ tiles at
/// level l.
#[derive(Debug, Clone, PartialEq)]
pub struct MosaicLayer {
    /// Index of the finest level; level 0 is a single tile.
    pub finest: u32,
    /// Ground resolution of the finest level, metres per pixel.
    pub resolution_m: f64,
    /// World x of the left border of the tile square, metres.
    pub left_m: f64,
    /// World y of the upper border of the tile square, metres.
    pub top_m: f64,
    /// Columns of finest-level pixels, counted from the left border, that show ground.
    pub columns: Range<u64>,
    /// Rows of finest-level pixels, counted from the upper border, that show ground.
    pub rows: Range<u64>,
}

impl MosaicLayer {
    /// Width and height of the mosaic at a level, pixels, and its placement in the world.
    pub fn picture_at(&self, level: u32) -> (u64, u64, Placement) {
        let scale = 1_u64 << (self.finest - level.min(self.finest));
        let [columns, rows] =
            [&self.columns, &self.rows].map(|range| range.start / scale..range.end.div_ceil(scale));
        let metres_per_pixel = self.resolution_m * scale as f64;
        let placement = Placement {
            metres_per_pixel,
            x_m: self.left_m + (columns.start as f64 + 0.5) * metres_per_pixel,
            y_m: self.top_m - (rows.start as f64 + 0.5) * metres_per_pixel,
        };
        (columns.end - columns.start, rows.end - rows.start, placement)
    }
}

impl MapFile {
    /// Renders the mosaic of the whole map and replaces the stored one. `ground_resolution_m` is as
    /// in [`MapMosaic::new`]; `progress` is called with the number of patches left and returns
    /// whether to continue. The memory needed does not grow with the map. The stored mosaic is
    /// unchanged until the new one is complete, and also if this fails or is cancelled.
    ///
    /// Returns whether the mosaic was replaced: false if it was cancelled, or if no keyframe sees
    /// the ground.
    pub fn render_mosaic(
        &mut self,
        ground_resolution_m: Option<f64>,
        progress: &mut dyn FnMut(usize) -> bool,
    ) -> Result<bool> {
        let map = self.map()?;
        self.render_mosaic_of(&map, ground_resolution_m, progress)
    }

    /// As [`MapFile::render_mosaic`], of some of the map's keyframes: those in `part`.
    pub fn render_mosaic_of(
        &mut self,
        part: &GroundMap,
        ground_resolution_m: Option<f64>,
        progress: &mut dyn FnMut(usize) -> bool,
    ) -> Result<bool> {
        let Some(rendering) = MapMosaic::new(part, self, ground_resolution_m)? else {
            return Ok(false);
        };
        self.all_or_nothing(|file| file.render_all(rendering, progress))
    }

    /// Replaces the stored mosaic by one that was rendered elsewhere, at its resolution (coarsened
    /// by powers of two if it has more than 2³⁰ pixels along a side), in one transaction. Returns
    /// whether the mosaic shows any ground; if not, the stored one is unchanged.
    pub fn set_mosaic(&mut self, mosaic: &Mosaic) -> Result<bool> {
        let mut mosaic = Cow::Borrowed(mosaic);
        while let Some((tiles, resolution_m)) = tiles_of(&mosaic).zip(mosaic.resolution_m()) {
            if [&tiles.0, &tiles.1].iter().all(|range| range.end - range.start <= WIDEST_TILES) {
                return self.all_or_nothing(|file| file.put_all(&mosaic, tiles, resolution_m));
            }
            mosaic = Cow::Owned(mosaic.coarser());
        }
        Ok(false)
    }

    /// Removes the finest level of the stored mosaic, which then has pixels of twice the side; of a
    /// mosaic of one level nothing is left. Does nothing where there is none.
    pub fn coarsen_mosaic(&mut self) -> Result<()> {
        let Some(layer) = self.mosaic()? else { return Ok(()) };
        self.all_or_nothing(|file| {
            pyramid::remove_finest(&file.connection, &layer).while_writing(&file.complaint)?;
            Ok(true)
        })?;
        Ok(())
    }

    /// Size of the tiles of the mosaic, bytes.
    pub fn mosaic_bytes(&self) -> Result<u64> {
        pyramid::bytes(&self.connection).while_reading(&self.complaint)
    }

    /// Runs `write` in a transaction; rolls back unless it returns true.
    fn all_or_nothing(&mut self, write: impl FnOnce(&mut Self) -> Result<bool>) -> Result<bool> {
        self.connection.execute_batch("BEGIN IMMEDIATE").while_writing(&self.complaint)?;
        let written = write(self);
        let end = if matches!(written, Ok(true)) { "COMMIT" } else { "ROLLBACK" };
        let ended = self.connection.execute_batch(end).while_writing(&self.complaint);
        written.and_then(|written| ended.map(|()| written))
    }

    fn put_all(
        &mut self,
        mosaic: &Mosaic,
        tiles: (Range<i64>, Range<i64>),
        resolution_m: f64,
    ) -> Result<bool> {
        let mut pyramid =
            TilePyramid::begin(&self.connection, tiles, resolution_m).while_writing(&self.complaint)?;
        let first = pyramid.first();
        let mut parents = BTreeSet::new();
        for MosaicSquare { column, row } in mosaic.changed_since(0) {
            let Some(rgba) = mosaic.tile_rgba(MosaicSquare { column, row }).filter(|rgba| shows_ground(rgba))
            else {
                continue;
            };
            parents.insert(((row - first.1) as u64 / 2, (column - first.0) as u64 / 2));
            let png = tile::encode(&rgba)?;
            let tile = MosaicTile { column, row, rgba };
            pyramid.put(&self.connection, &tile, &png).while_writing(&self.complaint)?;
        }
        // The finest level is not buffered: its tiles are requested again to reduce the next level.
        let mut finer: Box<dyn FnMut(u64, u64) -> Option<Vec<u8>>> = Box::new(|row, column| {
            mosaic.tile_rgba(MosaicSquare { column: first.0 + column as i64, row: first.1 + row as i64 })
        });
        for level in (0..pyramid.finest()).rev() {
            let mut tiles = self.put_parents(level, &parents, &mut finer)?;
            finer = Box::new(move |row, column| tiles.remove(&(row, column)));
            parents = parents.iter().map(|(row, column)| (row / 2, column / 2)).collect();
        }
        pyramid.finish(&self.connection).while_writing(&self.complaint)?;
        Ok(pyramid.has_ground())
    }

    /// Reduces the tiles of a level (row and column) from those that `finer` returns, each of which
    /// is requested once; returns the new tiles.
    fn put_parents(
        &self,
        level: u32,
        parents: &BTreeSet<(u64, u64)>,
        finer: &mut dyn FnMut(u64, u64) -> Option<Vec<u8>>,
    ) -> Result<BTreeMap<(u64, u64), Vec<u8>>> {
        let mut tiles = BTreeMap::new();
        for &(row, column) in parents {
            let mut child = |k: u64| finer(2 * row + k / 2, 2 * column + k % 2);
            let rgba = tile::halved([child(0), child(1), child(2), child(3)]);
            let png = tile::encode(&rgba)?;
            pyramid::insert(&self.connection, level, column, row, &png).while_writing(&self.complaint)?;
            tiles.insert((row, column), rgba);
        }
        Ok(tiles)
    }

    fn render_all(
        &mut self,
        mut rendering: MapMosaic,
        progress: &mut dyn FnMut(usize) -> bool,
    ) -> Result<bool> {
        let mut pyramid = TilePyramid::begin(&self.connection, rendering.tiles(), rendering.resolution_m())
            .while_writing(&self.complaint)?;
        while let Some(tiles) = rendering.next_tiles(self)? {
            for tile in &tiles {
                let png = tile::encode(&tile.rgba)?;
                pyramid.put(&self.connection, tile, &png).while_writing(&self.complaint)?;
            }
            if !progress(rendering.patches_left()) {
                return Ok(false);
            }
        }
        for level in (0..pyramid.finest()).rev() {
            self.reduce_to(level)?;
        }
        pyramid.finish(&self.connection).while_writing(&self.complaint)?;
        Ok(pyramid.has_ground())
    }

    /// Reduces a level from the next finer one.
    fn reduce_to(&mut self, level: u32) -> Result<()> {
        for (column, row) in pyramid::parents(&self.connection, level).while_reading(&self.complaint)? {
            let child = |k: u64| self.mosaic_tile(level + 1, 2 * column + k % 2, 2 * row + k / 2);
            let rgba = tile::halved([child(0)?, child(1)?, child(2)?, child(3)?]);
            let png = tile::encode(&rgba)?;
            pyramid::insert(&self.connection, level, column, row, &png).while_writing(&self.complaint)?;
        }
        Ok(())
    }

    /// How far keyframes have moved at most since the mosaic was rendered, metres; `None` while it
    /// is less than half of a pixel, which does not change the mosaic, or if there is none.
    pub fn mosaic_shift_m(&self) -> Result<Option<f64>> {
        let Some(layer) = self.mosaic()? else { return Ok(None) };
        let shift_m = staleness::shift_m(&self.connection).while_reading(&self.complaint)?;
        Ok((shift_m > 0.5 * layer.resolution_m).then_some(shift_m))
    }

    /// Geometry of the mosaic; `None` if there is none.
    pub fn mosaic(&self) -> Result<Option<MosaicLayer>> {
        let Some(layer) = pyramid::layer(&self.connection).optional().while_reading(&self.complaint)? else {
            return Ok(None);
        };
        let finite = [layer.resolution_m, layer.left_m, layer.top_m].iter().all(|value| value.is_finite());
        let side = (MOSAIC_TILE_PX as u64) << layer.finest.min(MAX_LEVELS);
        let inside = |range: &Range<u64>| range.start < range.end && range.end <= side;
        if !finite
            || layer.resolution_m <= 0.0
            || layer.finest > MAX_LEVELS
            || !inside(&layer.columns)
            || !inside(&layer.rows)
        {
            return Err(self
                .complaint
                .damaged_mosaic("the description of the mosaic is not one that a mosaic can have"));
        }
        Ok(Some(layer))
    }

    /// A tile of the mosaic, counted from the upper left corner of the tile square: RGBA,
    /// row-major. `None` if it shows no ground.
    pub fn mosaic_tile(&self, level: u32, column: u64, row: u64) -> Result<Option<Vec<u8>>> {
        let png = pyramid::select(&self.connection, level, column, row)
            .optional()
            .while_reading(&self.complaint)?;
        png.map(|png| {
            tile::decode(&png).map_err(|why| {
                self.complaint
                    .damaged_mosaic(format!("the tile {column}, {row} of level {level} of the mosaic {why}"))
            })
        })
        .transpose()
    }

    /// Tiles of a level that show ground, as (column, row), row by row. If the mapped areas are far
    /// apart, these are few of all tiles.
    pub fn mosaic_tiles(&self, level: u32) -> Result<Vec<(u64, u64)>> {
        pyramid::tiles(&self.connection, level).while_reading(&self.complaint)
    }

    /// The mosaic as one picture, at the finest level with at most `most_pixels` pixels. `None` if
    /// there is no mosaic.
    pub fn mosaic_picture(&self, most_pixels: usize) -> Result<Option<MosaicPicture>> {
        let Some(layer) = self.mosaic()? else { return Ok(None) };
        let fits = |level: &u32| {
            let (width, height, _) = layer.picture_at(*level);
            width.saturating_mul(height) <= most_pixels as u64
        };
        let level = (0..=layer.finest).rev().find(fits).unwrap_or(0);
        let (width, height, placement) = layer.picture_at(level);
        let (width, height) = (width as usize, height as usize);
        let mut rgba = [255, 255, 255, 0].repeat(width * height);
        self.each_tile_row(&layer, level, &mut |first_row, rows| {
            rgba[4 * width * first_row..][..rows.len()].copy_from_slice(rows);
            Ok(())
        })?;
        Ok(Some(MosaicPicture { width, height, rgba, placement }))
    }

    /// Outputs the picture of a level from top to bottom in strips of at most one tile height:
    /// index of the first row, and the rows as RGBA. This allows writing a picture that does not
    /// fit in memory.
    pub fn each_tile_row(
        &self,
        layer: &MosaicLayer,
        level: u32,
        take: &mut dyn FnMut(usize, &[u8]) -> Result<()>,
    ) -> Result<()> {
        let scale = 1_u64 << (layer.finest - level.min(layer.finest));
        let side = MOSAIC_TILE_PX as u64;
        let [columns, rows] =
            [&layer.columns, &layer.rows].map(|range| range.start / scale..range.end.div_ceil(scale));
        let width = (columns.end - columns.start) as usize;
        let mut strip = Vec::new();
        for tile_row in rows.start / side..rows.end.div_ceil(side) {
            let within = rows.start.max(tile_row * side)..rows.end.min((tile_row + 1) * side);
            strip.clear();
            strip.resize(4 * width * (within.end - within.start) as usize, 0);
            strip.chunks_exact_mut(4).for_each(|pixel| pixel.copy_from_slice(&[255, 255, 255, 0]));
            for tile_column in columns.start / side..columns.end.div_ceil(side) {
                let Some(tile) = self.mosaic_tile(level, tile_column, tile_row)? else { continue };
                let across = columns.start.max(tile_column * side)..columns.end.min((tile_column + 1) * side);
                for row in within.clone() {
                    let from =
                        4 * ((row - tile_row * side) * side + across.start - tile_column * side) as usize;
                    let to =
                        4 * ((row - within.start) as usize * width + (across.start - columns.start) as usize);
                    let bytes = 4 * (across.end - across.start) as usize;
                    strip[to..to + bytes].copy_from_slice(&tile[from..from + bytes]);
                }
            }
            take((within.start - rows.start) as usize, &strip)?;
        }
        Ok(())
    }
}

/// Ranges of the columns and rows of tiles of a mosaic; `None` if it is empty.
fn tiles_of(mosaic: &Mosaic) -> Option<(Range<i64>, Range<i64>)> {
    let one = |square: MosaicSquare| (square.column..square.column + 1, square.row..square.row + 1);
    let wide = |a: Range<i64>, b: Range<i64>| a.start.min(b.start)..a.end.max(b.end);
    mosaic.changed_since(0).map(one).reduce(|a, b| (wide(a.0, b.0), wide(a.1, b.1)))
}

fn shows_ground(rgba: &[u8]) -> bool {
    rgba.as_chunks::<4>().0.iter().any(|pixel| pixel[3] > 0)
}
