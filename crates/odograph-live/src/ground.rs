//! The ground map below the trajectory, in tiles that a page fetches when they change.

use odograph::error::{Error, Result};
use odograph::geometry::Placement;
use odograph::mosaic::{Mosaic, MosaicSquare};
use odograph_video::png_from_rgba;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// State of a ground map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundState {
    /// Ground sampling distance, metres per pixel. When it changes, all tiles have changed.
    pub metres_per_pixel: f64,
    /// Revision number; increases with every change.
    pub revision: u64,
}

/// A ground map in tiles of [`Mosaic::TILE_SIDE_PX`] × [`Mosaic::TILE_SIDE_PX`] pixels.
pub trait TiledGround: Send + Sync {
    /// The current state; `None` while the map is empty.
    fn state(&self) -> Option<GroundState>;
    /// The tiles that changed after `revision`.
    fn changed_since(&self, revision: u64) -> Vec<MosaicSquare>;
    /// RGBA samples of a tile in row order; `None` where the ground has not been observed.
    fn tile_rgba(&self, tile: MosaicSquare) -> Option<Vec<u8>>;
}

/// The mosaic of a running odometry.
impl TiledGround for Mutex<Mosaic> {
    fn state(&self) -> Option<GroundState> {
        let mosaic = self.lock().unwrap_or_else(PoisonError::into_inner);
        let metres_per_pixel = mosaic.resolution_m()?;
        Some(GroundState { metres_per_pixel, revision: mosaic.revision() })
    }

    fn changed_since(&self, revision: u64) -> Vec<MosaicSquare> {
        self.lock().unwrap_or_else(PoisonError::into_inner).changed_since(revision).collect()
    }

    fn tile_rgba(&self, tile: MosaicSquare) -> Option<Vec<u8>> {
        self.lock().unwrap_or_else(PoisonError::into_inner).tile_rgba(tile)
    }
}

/// A ground map whose tiles arrive one by one, each complete.
#[derive(Debug, Default)]
pub struct GrowingTiles(Mutex<GroundTiles>);

#[derive(Debug, Default)]
struct GroundTiles {
    metres_per_pixel: Option<f64>,
    revision: u64,
    squares: BTreeMap<MosaicSquare, (u64, Vec<u8>)>,
}

impl GrowingTiles {
    fn tiles(&self) -> MutexGuard<'_, GroundTiles> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Clears the map and sets its ground sampling distance, metres per pixel.
    pub fn begin(&self, metres_per_pixel: f64) {
        let mut tiles = self.tiles();
        tiles.metres_per_pixel = Some(metres_per_pixel);
        tiles.squares.clear();
    }

    /// Inserts or replaces a tile, given as RGBA samples in row order. Ignored if the number of
    /// samples is not that of a tile.
    pub fn put(&self, square: MosaicSquare, rgba: Vec<u8>) {
        if rgba.len() == 4 * Mosaic::TILE_SIDE_PX * Mosaic::TILE_SIDE_PX {
            let mut tiles = self.tiles();
            tiles.revision += 1;
            let revision = tiles.revision;
            tiles.squares.insert(square, (revision, rgba));
        }
    }

    /// Number of tiles.
    pub fn count(&self) -> usize {
        self.tiles().squares.len()
    }
}

impl TiledGround for GrowingTiles {
    fn state(&self) -> Option<GroundState> {
        let tiles = self.tiles();
        Some(GroundState { metres_per_pixel: tiles.metres_per_pixel?, revision: tiles.revision })
    }

    fn changed_since(&self, revision: u64) -> Vec<MosaicSquare> {
        let tiles = self.tiles();
        tiles
            .squares
            .iter()
            .filter(|(_, (changed, _))| *changed > revision)
            .map(|(square, _)| *square)
            .collect()
    }

    fn tile_rgba(&self, tile: MosaicSquare) -> Option<Vec<u8>> {
        self.tiles().squares.get(&tile).map(|(_, rgba)| rgba.clone())
    }
}

/// The ground map of a finished run: a single image that does not change.
#[derive(Debug)]
pub struct GroundPicture {
    rgba: Vec<u8>,
    width: i64,
    height: i64,
    placement: Placement,
}

impl GroundPicture {
    /// Creates a map from RGBA samples in row order and the georeference of the image.
    ///
    /// # Errors
    /// If the number of samples does not match the size, or the georeference is not finite or its
    /// pixel size not positive.
    pub fn new(rgba: Vec<u8>, width: usize, height: usize, placement: Placement) -> Result<Self> {
        let placed = [placement.metres_per_pixel, placement.x_m, placement.y_m].iter().all(|v| v.is_finite());
        if rgba.len() != 4 * width * height || !placed || placement.metres_per_pixel <= 0.0 {
            return Err(Error::input("the mosaic's picture and its world file do not belong together"));
        }
        Ok(Self { rgba, width: width as i64, height: height as i64, placement })
    }

    /// The mosaic in the folder of a run; `None` where there is none.
    ///
    /// # Errors
    /// If it cannot be read, is not one of this program, or has more pixels than `max_pixels`.
    pub fn of_run(folder: &Path, max_pixels: usize) -> Result<Option<Self>> {
        let (picture, world) = (folder.join("mosaic.png"), folder.join("mosaic.pgw"));
        if !picture.is_file() || !world.is_file() {
            return Ok(None);
        }
        let damaged = |why: String| Error::input(format!("{} cannot be shown: {why}", picture.display()));
        let mut text = String::new();
        // Six numbers.
        const MAX_TEXT: u64 = 1 << 12;
        File::open(&world)
            .and_then(|file| file.take(MAX_TEXT).read_to_string(&mut text))
            .map_err(|error| Error::input(format!("{}: {error}", world.display())))?;
        let numbers: Vec<f64> = text.lines().filter_map(|line| line.trim().parse().ok()).collect();
        let [metres_per_pixel, _, _, _, x_m, y_m] = numbers[..] else {
            return Err(Error::input(format!("{} is not a world file of six numbers", world.display())));
        };
        let file = File::open(&picture).map_err(|error| damaged(error.to_string()))?;
        let mut decoder = png::Decoder::new(BufReader::new(file));
        decoder.set_limits(png::Limits { bytes: 8 * max_pixels });
        let mut reader = decoder.read_info().map_err(|error| damaged(error.to_string()))?;
        let size = reader.output_buffer_size().filter(|size| *size <= 4 * max_pixels);
        let (color, depth) = reader.output_color_type();
        if color != png::ColorType::Rgba || depth != png::BitDepth::Eight {
            return Err(damaged("it is not a mosaic of this program".to_owned()));
        }
        let mut rgba = vec![0; size.ok_or_else(|| damaged("it is too large".to_owned()))?];
        let info = reader.next_frame(&mut rgba).map_err(|error| damaged(error.to_string()))?;
        let placement = Placement { metres_per_pixel, x_m, y_m };
        Self::new(rgba, info.width as usize, info.height as usize, placement).map(Some)
    }

    /// Column and row of the top-left pixel, counted from the world origin.
    fn corner(&self) -> (i64, i64) {
        let at = |metres: f64| (metres / self.placement.metres_per_pixel - 0.5).round() as i64;
        (at(self.placement.x_m), at(-self.placement.y_m))
    }
}

impl TiledGround for GroundPicture {
    fn state(&self) -> Option<GroundState> {
        Some(GroundState { metres_per_pixel: self.placement.metres_per_pixel, revision: 1 })
    }

    fn changed_since(&self, revision: u64) -> Vec<MosaicSquare> {
        if revision >= 1 {
            return Vec::new();
        }
        let side = Mosaic::TILE_SIDE_PX as i64;
        let (left, top) = self.corner();
        let rows = top.div_euclid(side)..=(top + self.height - 1).div_euclid(side);
        let columns = left.div_euclid(side)..=(left + self.width - 1).div_euclid(side);
        let tiles = rows.flat_map(|row| columns.clone().map(move |column| MosaicSquare { column, row }));
        tiles.filter(|&tile| self.tile_rgba(tile).is_some()).collect()
    }

    fn tile_rgba(&self, tile: MosaicSquare) -> Option<Vec<u8>> {
        let side = Mosaic::TILE_SIDE_PX as i64;
        let (left, top) = self.corner();
        // Position of the tile in the image, pixels.
        let first_x = tile.column.checked_mul(side)?.checked_sub(left)?;
        let first_y = tile.row.checked_mul(side)?.checked_sub(top)?;
        let columns = first_x.max(0)..first_x.checked_add(side)?.min(self.width);
        let rows = first_y.max(0)..first_y.checked_add(side)?.min(self.height);
        let mut rgba = [255, 255, 255, 0].repeat((side * side) as usize);
        let mut seen = false;
        for y in rows {
            if columns.is_empty() {
                break;
            }
            let from = 4 * (y * self.width + columns.start) as usize;
            let row = &self.rgba[from..from + 4 * (columns.end - columns.start) as usize];
            let to = 4 * ((y - first_y) * side + columns.start - first_x) as usize;
            rgba[to..to + row.len()].copy_from_slice(row);
            seen |= row.chunks_exact(4).any(|pixel| pixel[3] > 0);
        }
        seen.then_some(rgba)
    }
}

/// Encodes the RGBA samples of a tile as PNG.
pub(crate) fn tile_png(rgba: &[u8]) -> Option<Vec<u8>> {
    png_from_rgba(Mosaic::TILE_SIDE_PX, Mosaic::TILE_SIDE_PX, rgba).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_new_tile_is_reported_once_and_replaced_whole() {
        let tiles = GrowingTiles::default();
        assert!(tiles.state().is_none());
        tiles.begin(0.01);
        let square = |shade: u8| vec![shade; 4 * Mosaic::TILE_SIDE_PX * Mosaic::TILE_SIDE_PX];
        let at = |column| MosaicSquare { column, row: -2 };
        tiles.put(at(1), square(1));
        tiles.put(at(2), square(2));
        tiles.put(at(3), vec![0; 7]);
        let revision = tiles.state().unwrap().revision;
        assert_eq!((tiles.count(), tiles.changed_since(0)), (2, vec![at(1), at(2)]));
        tiles.put(at(1), square(3));
        assert_eq!(tiles.changed_since(revision), [at(1)]);
        assert_eq!((tiles.tile_rgba(at(1)).unwrap()[0], tiles.tile_rgba(at(3))), (3, None));
        tiles.begin(0.02);
        assert_eq!((tiles.count(), tiles.state().unwrap().metres_per_pixel), (0, 0.02));
    }

    #[test]
    fn tiles_of_an_image_reassemble_to_the_image() {
        // 300 × 2 pixels across the origin, so that tiles on both sides of it are needed.
        let (width, height) = (300usize, 2usize);
        let rgba: Vec<u8> = (0..width * height).flat_map(|k| [k as u8, (k / 256) as u8, 7, 255]).collect();
        let placement = Placement { metres_per_pixel: 0.01, x_m: -0.995, y_m: 0.005 };
        let ground = GroundPicture::new(rgba.clone(), width, height, placement).unwrap();
        let tiles = ground.changed_since(0);
        let at = |column, row| MosaicSquare { column, row };
        assert_eq!(tiles, [at(-1, -1), at(0, -1), at(-1, 0), at(0, 0)]);
        assert!(ground.changed_since(1).is_empty());
        let side = Mosaic::TILE_SIDE_PX as i64;
        for y in 0..height as i64 {
            for x in 0..width as i64 {
                let (column, row) = (x - 100, y - 1);
                let tile = at(column.div_euclid(side), row.div_euclid(side));
                let pixels = ground.tile_rgba(tile).unwrap();
                let inside = 4 * (row.rem_euclid(side) * side + column.rem_euclid(side)) as usize;
                let outside = 4 * (y * width as i64 + x) as usize;
                assert_eq!(pixels[inside..inside + 4], rgba[outside..outside + 4], "{x} {y}");
            }
        }
        for nowhere in [at(5, 0), at(i64::MAX, 3), at(i64::MIN, i64::MIN)] {
            assert!(ground.tile_rgba(nowhere).is_none());
        }
        assert!(GroundPicture::new(rgba, 299, 2, placement).is_err());
    }
}
