//! The mosaic as a PNG with a world file.

use super::coarser;
use crate::{files, interrupt};
use odograph::error::{Error, Result};
use odograph_map::{MapFile, MosaicLayer};
use std::path::Path;

/// Longest side: no viewer shows more, and a strip of that width fits into memory.
const LONGEST_SIDE_PX: u64 = 60_000;
/// Largest number of pixels.
const MAX_PIXELS: u64 = 1_000_000_000;

/// Writes the picture from top to bottom, as fine as possible, and reports what was written.
pub fn write(file: &MapFile, layer: &MosaicLayer, path: &Path) -> Result<String> {
    let fits = |level: &u32| {
        let (width, height, _) = layer.picture_at(*level);
        width.max(height) <= LONGEST_SIDE_PX && width.saturating_mul(height) <= MAX_PIXELS
    };
    let level = (0..=layer.finest).rev().find(fits).unwrap_or(0);
    let (width, height, placement) = layer.picture_at(level);
    files::write_with(path, |output| {
        let broken = |error: png::EncodingError| match error {
            png::EncodingError::IoError(error) => Error::not_written(path.display(), error),
            error => Error::output(format!("{} cannot be written: {error}", path.display())),
        };
        let mut encoder = png::Encoder::new(output, width as u32, height as u32);
        encoder.set_color(png::ColorType::Rgba);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_compression(png::Compression::Fast);
        let mut writer = encoder.write_header().map_err(broken)?;
        let mut stream = writer.stream_writer().map_err(broken)?;
        file.each_tile_row(layer, level, &mut |_, rows| {
            interrupt::check()?;
            std::io::Write::write_all(&mut stream, rows)
                .map_err(|error| Error::not_written(path.display(), error))
        })?;
        stream.finish().map_err(broken)
    })?;
    files::write(&path.with_extension("pgw"), placement.world_file().as_bytes())?;
    Ok(format!(
        "{width}x{height} px of {:.2} mm, with a world file{}",
        1000.0 * placement.metres_per_pixel,
        coarser(layer, level)
    ))
}
