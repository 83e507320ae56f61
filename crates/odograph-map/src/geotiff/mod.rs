//! The mosaic as a cloud-optimised GeoTIFF (OGC 19-008, OGC 21-026): its directories first, then
//! the overviews, the coarsest first, then the picture. Overviews and their tiles are the levels
//! and the tiles of the mosaic in the map; no more than one tile is in memory.

mod directory;

use crate::file::MapFile;
use crate::mosaic::MosaicLayer;
use directory::Values;
use odograph::error::{Error, Result};
use odograph::georeference::Anchor;
use odograph::mosaic::MOSAIC_TILE_PX;
use std::io::{Seek, SeekFrom, Write};
use tiff::encoder::compression::{CompressionAlgorithm, Deflate, DeflateLevel};
use tiff::tags::Tag;

/// Red, green, blue and opacity.
const CHANNELS: usize = 4;

/// Largest number of tiles of a picture, most of which may be empty: each is 12 bytes in its
/// directory.
const MAX_TILES: u64 = 1 << 22;

/// A picture that was written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GeoTiff {
    /// Columns.
    pub width: u64,
    /// Rows.
    pub height: u64,
    /// Side of a pixel, metres of the map.
    pub pixel_m: f64,
    /// Level of the mosaic: the finest unless that has too many tiles.
    pub level: u32,
}

impl MapFile {
    /// Writes the mosaic as a cloud-optimised GeoTIFF, from the beginning of `output`: in metres of
    /// the map, or with an anchor in its UTM zone. `go_on` is called before each tile.
    ///
    /// # Errors
    /// If the map cannot be read, the picture cannot be written, or `go_on` fails.
    pub fn write_geotiff<W: Write + Seek>(
        &self,
        layer: &MosaicLayer,
        mut output: W,
        anchor: Option<&Anchor>,
        go_on: &mut dyn FnMut() -> Result<()>,
    ) -> Result<GeoTiff> {
        let pictures_from = |level: u32| (0..=level).rev().map(|level| Picture::of(layer, level));
        let fits = |level: &u32| Picture::of(layer, *level).tiles().iter().product::<u64>() <= MAX_TILES;
        let level = (0..=layer.finest).rev().find(fits).unwrap_or(0);
        let whole = Picture::of(layer, level);
        let pixel_m = layer.resolution_m * (1_u64 << (layer.finest - level)) as f64;
        let place = Place::new((layer.left_m, layer.top_m), pixel_m, anchor);
        // Overviews down to one that is a single tile.
        let coarsest = pictures_from(level).find(Picture::is_one_tile).map_or(0, |picture| picture.level);
        let mut pictures: Vec<(Picture, TileIndex)> = pictures_from(level)
            .take_while(|picture| picture.level >= coarsest)
            .map(|picture| (picture, TileIndex::empty(&picture)))
            .collect();
        // How long the directories are does not depend on where the tiles are.
        let first_tile = directories(&pictures, &place).len() as u64;
        output.seek(SeekFrom::Start(first_tile)).map_err(broken)?;
        for (picture, index) in pictures.iter_mut().rev() {
            self.write_tiles(picture, index, &mut output, go_on)?;
        }
        output.rewind().and_then(|()| output.write_all(&directories(&pictures, &place))).map_err(broken)?;
        let [width, height] = whole.size;
        Ok(GeoTiff { width, height, pixel_m, level })
    }

    fn write_tiles<W: Write + Seek>(
        &self,
        picture: &Picture,
        index: &mut TileIndex,
        output: &mut W,
        go_on: &mut dyn FnMut() -> Result<()>,
    ) -> Result<()> {
        let [columns, rows] = picture.tiles();
        for (column, row) in self.mosaic_tiles(picture.level)? {
            go_on()?;
            if column >= columns || row >= rows {
                continue;
            }
            let Some(rgba) = self.mosaic_tile(picture.level, column, row)? else { continue };
            let mut compressed = Vec::new();
            Deflate::with_level(DeflateLevel::Fast)
                .write_to(&mut compressed, &differences(&rgba))
                .map_err(broken)?;
            let at = (row * columns + column) as usize;
            let length = compressed.len() as u32;
            // As the layout says: its length before a tile, its last four bytes again behind it.
            output.write_all(&length.to_le_bytes()).map_err(broken)?;
            index.offsets[at] = output.stream_position().map_err(broken)?;
            index.lengths[at] = length;
            output.write_all(&compressed).map_err(broken)?;
            output.write_all(&compressed[compressed.len().saturating_sub(4)..]).map_err(broken)?;
        }
        Ok(())
    }
}

fn broken(error: impl Into<tiff::TiffError>) -> Error {
    Error::output(format!("the picture cannot be written: {}", error.into()))
}

/// The picture or one of its overviews: a level of the mosaic from the corner of its first tile,
/// whose first columns and rows may show no ground, to the last pixels that show ground.
#[derive(Clone, Copy)]
struct Picture {
    level: u32,
    /// Width and height, pixels.
    size: [u64; 2],
}

impl Picture {
    fn of(layer: &MosaicLayer, level: u32) -> Self {
        let finer = 1_u64 << (layer.finest - level);
        Self { level, size: [&layer.columns, &layer.rows].map(|range| range.end.div_ceil(finer)) }
    }

    /// Columns and rows of tiles.
    fn tiles(&self) -> [u64; 2] {
        self.size.map(|side| side.div_ceil(MOSAIC_TILE_PX as u64))
    }

    fn is_one_tile(&self) -> bool {
        self.tiles() == [1, 1]
    }
}

/// Where the tiles of a picture are in the file, row by row. A tile without an offset is
/// transparent: GDAL's sparse tiles.
struct TileIndex {
    offsets: Vec<u64>,
    lengths: Vec<u32>,
}

impl TileIndex {
    fn empty(picture: &Picture) -> Self {
        let tiles = picture.tiles().iter().product::<u64>() as usize;
        Self { offsets: vec![0; tiles], lengths: vec![0; tiles] }
    }
}

/// Each sample minus its left neighbour: TIFF's horizontal predictor.
fn differences(rgba: &[u8]) -> Vec<u8> {
    let mut samples = rgba.to_vec();
    for row in samples.chunks_exact_mut(CHANNELS * MOSAIC_TILE_PX) {
        for at in (CHANNELS..row.len()).rev() {
            row[at] = row[at].wrapping_sub(row[at - CHANNELS]);
        }
    }
    samples
}

/// The file up to its first tile.
fn directories(pictures: &[(Picture, TileIndex)], place: &Place) -> Vec<u8> {
    const REDUCED: [u32; 1] = [1];
    const DEFLATE: [u16; 1] = [8];
    const RGB: [u16; 1] = [2];
    const HORIZONTAL: [u16; 1] = [2];
    const UNASSOCIATED_OPACITY: [u16; 1] = [2];
    let sizes: Vec<[[u32; 1]; 2]> =
        pictures.iter().map(|(picture, _)| picture.size.map(|side| [side as u32])).collect();
    let directory = |k: usize| {
        let [width, height] = &sizes[k];
        let index = &pictures[k].1;
        let mut entries = vec![
            (Tag::ImageWidth, Values::U32(width)),
            (Tag::ImageLength, Values::U32(height)),
            (Tag::BitsPerSample, Values::U16(&[8; CHANNELS])),
            (Tag::Compression, Values::U16(&DEFLATE)),
            (Tag::PhotometricInterpretation, Values::U16(&RGB)),
            (Tag::SamplesPerPixel, Values::U16(&[CHANNELS as u16])),
            (Tag::PlanarConfiguration, Values::U16(&[1])),
            (Tag::Predictor, Values::U16(&HORIZONTAL)),
            (Tag::TileWidth, Values::U32(&[MOSAIC_TILE_PX as u32])),
            (Tag::TileLength, Values::U32(&[MOSAIC_TILE_PX as u32])),
            (Tag::TileOffsets, Values::U64(&index.offsets)),
            (Tag::TileByteCounts, Values::U32(&index.lengths)),
            (Tag::ExtraSamples, Values::U16(&UNASSOCIATED_OPACITY)),
        ];
        if k == 0 {
            entries.extend(place.model.iter().map(|(tag, values)| (*tag, Values::F64(values))));
            entries.push((Tag::GeoKeyDirectoryTag, Values::U16(&place.keys)));
        } else {
            entries.push((Tag::NewSubfileType, Values::U32(&REDUCED)));
        }
        entries
    };
    directory::beginning((0..pictures.len()).map(directory).collect())
}

/// Where the picture lies: in metres of the map, or, with an anchor, in its UTM zone.
struct Place {
    /// From pixels to metres.
    model: Vec<(Tag, Vec<f64>)>,
    /// The keys that name the system of coordinates.
    keys: Vec<u16>,
}

impl Place {
    fn new((left_m, top_m): (f64, f64), metres_per_pixel: f64, anchor: Option<&Anchor>) -> Self {
        const MODEL: u16 = 1024;
        const RASTER: u16 = 1025;
        const PROJECTED_SYSTEM: u16 = 3072;
        const PROJECTED_UNITS: u16 = 3076;
        const USER_DEFINED: u16 = 32_767;
        const PROJECTED: u16 = 1;
        const PIXEL_IS_AREA: u16 = 1;
        const METRE: u16 = 9001;
        let (model, keys) = match anchor {
            None => (
                vec![
                    (Tag::ModelPixelScaleTag, vec![metres_per_pixel, metres_per_pixel, 0.0]),
                    (Tag::ModelTiepointTag, vec![0.0, 0.0, 0.0, left_m, top_m, 0.0]),
                ],
                [(MODEL, USER_DEFINED), (RASTER, PIXEL_IS_AREA), (PROJECTED_UNITS, METRE)],
            ),
            Some(anchor) => {
                // Over the size of a map the projection is linear: east and north of the
                // corner, and a step along x and y of the map.
                let at = |x_m: f64, y_m: f64| anchor.utm(x_m, y_m);
                let ((east, north), (right, down)) =
                    (at(left_m, top_m), (at(left_m + 1.0, top_m), at(left_m, top_m - 1.0)));
                let step =
                    |to: (f64, f64)| (metres_per_pixel * (to.0 - east), metres_per_pixel * (to.1 - north));
                let (right, down) = (step(right), step(down));
                let transformation = [
                    [right.0, down.0, 0.0, east],
                    [right.1, down.1, 0.0, north],
                    [0.0, 0.0, 0.0, 0.0],
                    [0.0, 0.0, 0.0, 1.0],
                ];
                (
                    vec![(Tag::ModelTransformationTag, transformation.concat())],
                    [(MODEL, PROJECTED), (RASTER, PIXEL_IS_AREA), (PROJECTED_SYSTEM, anchor.utm_code())],
                )
            }
        };
        // Version 1.1.0 and the number of keys, then each key with its value in place.
        let mut directory_of_keys = vec![1, 1, 0, keys.len() as u16];
        keys.iter().for_each(|&(key, value)| directory_of_keys.extend([key, 0, 1, value]));
        Self { model, keys: directory_of_keys }
    }
}
