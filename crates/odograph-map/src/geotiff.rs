//! The mosaic as a GeoTIFF (OGC 19-008): the tiles as they are in the map, so that no more than one
//! is in memory.

use crate::file::MapFile;
use crate::mosaic::MosaicLayer;
use odograph::error::{Error, Result};
use odograph::georeference::Anchor;
use odograph::mosaic::MOSAIC_TILE_PX;
use std::io::{Seek, Write};
use std::ops::Range;
use tiff::TiffError;
use tiff::encoder::compression::{CompressionAlgorithm, Deflate, DeflateLevel};
use tiff::encoder::{DirectoryEncoder, TiffEncoder, TiffKind};
use tiff::tags::Tag;

/// Red, green, blue and opacity.
const CHANNELS: usize = 4;

/// Largest number of tiles of a picture, most of which may be empty: each is 16 bytes in its
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
    /// Writes the mosaic as a GeoTIFF: in metres of the map, or with an anchor in its UTM zone.
    /// `go_on` is called before each tile.
    ///
    /// # Errors
    /// If the map cannot be read, the picture cannot be written, or `go_on` fails.
    pub fn write_geotiff<W: Write + Seek>(
        &self,
        layer: &MosaicLayer,
        output: W,
        anchor: Option<&Anchor>,
        go_on: &mut dyn FnMut() -> Result<()>,
    ) -> Result<GeoTiff> {
        let side = MOSAIC_TILE_PX as u64;
        let tiles_at = |level: u32| {
            let tile = side << (layer.finest - level);
            [&layer.columns, &layer.rows].map(|range| range.start / tile..range.end.div_ceil(tile))
        };
        let count = |range: &Range<u64>| range.end - range.start;
        let fits = |level: &u32| tiles_at(*level).iter().map(count).product::<u64>() <= MAX_TILES;
        let level = (0..=layer.finest).rev().find(fits).unwrap_or(0);
        let [columns, rows] = tiles_at(level);
        let finer = 1_u64 << (layer.finest - level);
        let pixel_m = layer.resolution_m * finer as f64;
        // The picture begins with a tile, whose first columns and rows may show no ground; it ends
        // where the ground does, within its last tiles.
        let last = |range: &Range<u64>, tiles: &Range<u64>| range.end.div_ceil(finer) - tiles.start * side;
        let (width, height) = (last(&layer.columns, &columns), last(&layer.rows, &rows));
        let left_m = layer.left_m + (columns.start * side) as f64 * pixel_m;
        let top_m = layer.top_m - (rows.start * side) as f64 * pixel_m;
        let broken = |error: TiffError| Error::output(format!("the picture cannot be written: {error}"));
        let mut encoder = TiffEncoder::new_big(output).map_err(broken)?;
        let mut directory = encoder.image_directory().map_err(broken)?;
        // A tile without an offset is transparent: GDAL's sparse tiles.
        let tiles = (count(&columns) * count(&rows)) as usize;
        let (mut offsets, mut lengths) = (vec![0; tiles], vec![0; tiles]);
        for (column, row) in self.mosaic_tiles(level)? {
            go_on()?;
            if !columns.contains(&column) || !rows.contains(&row) {
                continue;
            }
            if let Some(rgba) = self.mosaic_tile(level, column, row)? {
                let at = ((row - rows.start) * count(&columns) + column - columns.start) as usize;
                (offsets[at], lengths[at]) = put_tile(&mut directory, &rgba).map_err(broken)?;
            }
        }
        describe(&mut directory, (width, height), &offsets, &lengths)
            .and_then(|()| place(&mut directory, (left_m, top_m), pixel_m, anchor))
            .and_then(|()| directory.finish())
            .map_err(broken)?;
        Ok(GeoTiff { width, height, pixel_m, level })
    }
}

fn put_tile<W: Write + Seek, K: TiffKind>(
    directory: &mut DirectoryEncoder<'_, W, K>,
    rgba: &[u8],
) -> std::result::Result<(u64, u64), TiffError> {
    let mut compressed = Vec::new();
    Deflate::with_level(DeflateLevel::Fast).write_to(&mut compressed, &differences(rgba))?;
    let offset = directory.write_data(compressed.as_slice())?;
    Ok((offset, compressed.len() as u64))
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

fn describe<W: Write + Seek, K: TiffKind>(
    directory: &mut DirectoryEncoder<'_, W, K>,
    (width, height): (u64, u64),
    offsets: &[u64],
    lengths: &[u64],
) -> std::result::Result<(), TiffError> {
    const DEFLATE: u16 = 8;
    const RGB: u16 = 2;
    const HORIZONTAL: u16 = 2;
    const UNASSOCIATED_OPACITY: u16 = 2;
    directory.write_tag(Tag::ImageWidth, width as u32)?;
    directory.write_tag(Tag::ImageLength, height as u32)?;
    directory.write_tag(Tag::BitsPerSample, [8_u16; CHANNELS].as_slice())?;
    directory.write_tag(Tag::Compression, DEFLATE)?;
    directory.write_tag(Tag::PhotometricInterpretation, RGB)?;
    directory.write_tag(Tag::SamplesPerPixel, CHANNELS as u16)?;
    directory.write_tag(Tag::PlanarConfiguration, 1_u16)?;
    directory.write_tag(Tag::Predictor, HORIZONTAL)?;
    directory.write_tag(Tag::TileWidth, MOSAIC_TILE_PX as u32)?;
    directory.write_tag(Tag::TileLength, MOSAIC_TILE_PX as u32)?;
    directory.write_tag(Tag::TileOffsets, offsets)?;
    directory.write_tag(Tag::TileByteCounts, lengths)?;
    directory.write_tag(Tag::ExtraSamples, UNASSOCIATED_OPACITY)
}

/// Where the picture lies: in metres of the map, or, with an anchor, in its UTM zone.
fn place<W: Write + Seek, K: TiffKind>(
    directory: &mut DirectoryEncoder<'_, W, K>,
    (left_m, top_m): (f64, f64),
    metres_per_pixel: f64,
    anchor: Option<&Anchor>,
) -> std::result::Result<(), TiffError> {
    const MODEL: u16 = 1024;
    const RASTER: u16 = 1025;
    const PROJECTED_SYSTEM: u16 = 3072;
    const PROJECTED_UNITS: u16 = 3076;
    const USER_DEFINED: u16 = 32_767;
    const PROJECTED: u16 = 1;
    const PIXEL_IS_AREA: u16 = 1;
    const METRE: u16 = 9001;
    let keys = match anchor {
        None => {
            directory
                .write_tag(Tag::ModelPixelScaleTag, [metres_per_pixel, metres_per_pixel, 0.0].as_slice())?;
            directory.write_tag(Tag::ModelTiepointTag, [0.0, 0.0, 0.0, left_m, top_m, 0.0].as_slice())?;
            [(MODEL, USER_DEFINED), (RASTER, PIXEL_IS_AREA), (PROJECTED_UNITS, METRE)]
        }
        Some(anchor) => {
            // Over the size of a map the projection is linear: east and north of the
            // corner, and a step along x and y of the map.
            let at = |x_m: f64, y_m: f64| anchor.utm(x_m, y_m);
            let ((east, north), (right, down)) =
                (at(left_m, top_m), (at(left_m + 1.0, top_m), at(left_m, top_m - 1.0)));
            let step = |to: (f64, f64)| (metres_per_pixel * (to.0 - east), metres_per_pixel * (to.1 - north));
            let (right, down) = (step(right), step(down));
            let transformation = [
                [right.0, down.0, 0.0, east],
                [right.1, down.1, 0.0, north],
                [0.0, 0.0, 0.0, 0.0],
                [0.0, 0.0, 0.0, 1.0],
            ];
            directory.write_tag(Tag::ModelTransformationTag, transformation.concat().as_slice())?;
            [(MODEL, PROJECTED), (RASTER, PIXEL_IS_AREA), (PROJECTED_SYSTEM, anchor.utm_code())]
        }
    };
    // Version 1.1.0 and the number of keys, then each key with its value in place.
    let mut directory_of_keys = vec![1, 1, 0, keys.len() as u16];
    keys.iter().for_each(|&(key, value)| directory_of_keys.extend([key, 0, 1, value]));
    directory.write_tag(Tag::GeoKeyDirectoryTag, directory_of_keys.as_slice())
}
