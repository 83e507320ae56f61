//! The mosaic as coloured points (PLY, binary): the seen ground, and the cameras above it.

use crate::{files, interrupt};
use odograph::error::{Error, Result};
use odograph::mosaic::MOSAIC_TILE_PX;
use odograph_map::{MapFile, MosaicLayer};
use std::io::Write;
use std::path::Path;

/// The colour of the points that are cameras.
const CAMERA: [u8; 3] = [255, 0, 0];

/// Writes at most this many points of ground, and one for each keyframe, and reports what was
/// written.
pub fn write(file: &MapFile, path: &Path, most_points: usize) -> Result<String> {
    let keyframes = file.map()?.keyframes;
    let layer = file.mosaic()?;
    let level = layer.as_ref().map(|layer| chosen(file, layer, most_points)).transpose()?;
    // If even the coarsest level has too many points, every n-th of them.
    let every = level.map_or(1, |(_, points)| points.div_ceil(most_points as u64).max(1));
    let ground = level.map_or(0, |(_, points)| points.div_ceil(every));
    if ground == 0 && keyframes.is_empty() {
        return Err(Error::input(format!(
            "{} has no mosaic and no keyframe to write",
            file.path().display()
        )));
    }
    files::write_with(path, |output| {
        let broken = |error| Error::not_written(path.display(), error);
        write!(
            output,
            "ply\nformat binary_little_endian 1.0\ncomment metres; the ground is z = 0, cameras are red\nelement vertex {}\n\
             property double x\nproperty double y\nproperty double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n\
             end_header\n",
            ground + keyframes.len() as u64
        )
        .map_err(broken)?;
        if let (Some(layer), Some((level, _))) = (&layer, level) {
            let pixel_m = layer.picture_at(level).2.metres_per_pixel;
            let side = MOSAIC_TILE_PX as u64;
            let mut shown = 0;
            each_tile(file, level, |tile_column, tile_row, rgba| {
                for (k, pixel) in rgba.chunks_exact(4).enumerate().filter(|(_, pixel)| pixel[3] > 0) {
                    shown += 1;
                    if !(shown - 1u64).is_multiple_of(every) {
                        continue;
                    }
                    let column = tile_column * side + k as u64 % side;
                    let row = tile_row * side + k as u64 / side;
                    let x_m = layer.left_m + (column as f64 + 0.5) * pixel_m;
                    let y_m = layer.top_m - (row as f64 + 0.5) * pixel_m;
                    output.write_all(&vertex([x_m, y_m, 0.0], &pixel[..3])).map_err(broken)?;
                }
                Ok(())
            })?;
        }
        keyframes.iter().try_for_each(|keyframe| {
            let pose = &keyframe.pose;
            output.write_all(&vertex([pose.x_m, pose.y_m, pose.height_m], &CAMERA)).map_err(broken)
        })
    })?;
    Ok(format!("{ground} points of ground, {} cameras", keyframes.len()))
}

fn vertex(position: [f64; 3], color: &[u8]) -> Vec<u8> {
    position.iter().flat_map(|value| value.to_le_bytes()).chain(color.iter().copied()).collect()
}

/// Visits every tile of a level: its column, its row, and its pixels. Fails after an interruption.
fn each_tile(file: &MapFile, level: u32, mut take: impl FnMut(u64, u64, &[u8]) -> Result<()>) -> Result<()> {
    for (column, row) in file.mosaic_tiles(level)? {
        interrupt::check()?;
        if let Some(rgba) = file.mosaic_tile(level, column, row)? {
            take(column, row, &rgba)?;
        }
    }
    Ok(())
}

/// The finest level with few enough pixels of ground, and their number.
fn chosen(file: &MapFile, layer: &MosaicLayer, most_points: usize) -> Result<(u32, u64)> {
    for level in (0..=layer.finest).rev() {
        let mut points = 0;
        each_tile(file, level, |_, _, rgba| {
            points += rgba.chunks_exact(4).filter(|pixel| pixel[3] > 0).count() as u64;
            Ok(())
        })?;
        if points <= most_points as u64 || level == 0 {
            return Ok((level, points));
        }
    }
    Ok((0, 0))
}
