//! The mapped ground as an occupancy grid for Nav2's map server: a YAML file, and a PGM picture
//! beside it.

use crate::{files, interrupt};
use odograph::error::{Error, Result};
use odograph::mosaic::MOSAIC_TILE_PX;
use odograph_live::{CELL_M, LEAST_CELL_PX, SEEN_SHARE};
use odograph_map::{MapFile, MosaicLayer};
use std::collections::VecDeque;
use std::io::Write;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Pixels along the side of a cell that determine its area well enough: coarser levels of the
/// mosaic are read faster.
const ENOUGH_PX: f64 = 8.0;
/// Largest number of cells: Nav2 holds each in a byte.
const MOST_CELLS: i64 = 1 << 28;

/// Gray values of the map server's own maps.
const FREE: u8 = 254;
const UNKNOWN: u8 = 205;
/// Occupancies 1 − gray / 255 below this are free: between those of both grays, 0.004 and 0.196.
const FREE_THRESHOLD: f64 = 0.1;
const OCCUPIED_THRESHOLD: f64 = 0.65;

/// The picture of a grid.
pub fn picture_of(yaml: &Path) -> PathBuf {
    yaml.with_extension("pgm")
}

/// Writes the grid and reports what was written. Cells of which the mosaic shows at least half are
/// free, others unknown; no cell is occupied.
pub fn write(file: &MapFile, layer: &MosaicLayer, yaml: &Path, cell_m: Option<f64>) -> Result<String> {
    let grid = Grid::of(file, layer, cell_m)?;
    let picture = picture_of(yaml);
    let mut free = 0;
    files::write_with(&picture, |output| {
        free = grid.write_picture(file, output, &picture)?;
        Ok(())
    })?;
    files::write(yaml, grid.description(&picture).as_bytes())?;
    let Grid { columns, rows, cell_m, .. } = &grid;
    let finer = if free == 0 { "; no cell is half seen: give a finer --resolution" } else { "" };
    Ok(format!(
        "{}x{} cells of {cell_m} m: {free} free, {} unknown, none occupied{finer}",
        columns.end - columns.start,
        rows.end - rows.start,
        grid.cells() as u64 - free,
    ))
}

/// Cells along the axes of the map, counted from its origin.
struct Grid {
    cell_m: f64,
    columns: Range<i64>,
    /// Upwards.
    rows: Range<i64>,
    /// The level of the mosaic that it is made of.
    level: u32,
    pixel_m: f64,
    left_m: f64,
    top_m: f64,
}

impl Grid {
    fn of(file: &MapFile, layer: &MosaicLayer, asked_m: Option<f64>) -> Result<Self> {
        let finest_m = layer.resolution_m;
        let too_fine = |cell_m: f64| cell_m < LEAST_CELL_PX * finest_m;
        let mut grid = Self::with_cells(layer, asked_m.unwrap_or(CELL_M));
        while asked_m.is_none() && (too_fine(grid.cell_m) || grid.cells() > MOST_CELLS) {
            grid = Self::with_cells(layer, 2.0 * grid.cell_m);
        }
        if too_fine(grid.cell_m) {
            return Err(Error::usage(format!(
                "--resolution {} m is too fine for a mosaic with pixels of {:.2} mm; give {:.4} or more, or render \
                 a finer mosaic: odograph map mosaic {}",
                grid.cell_m,
                1e3 * finest_m,
                LEAST_CELL_PX * finest_m,
                file.path().display()
            )));
        }
        if grid.cells() > MOST_CELLS {
            return Err(Error::usage(format!(
                "with --resolution {} m the grid would have {} million cells, and at most {} million are written; \
                 give a coarser one",
                grid.cell_m,
                grid.cells() / 1_000_000,
                MOST_CELLS / 1_000_000
            )));
        }
        Ok(grid)
    }

    fn with_cells(layer: &MosaicLayer, cell_m: f64) -> Self {
        let pixel_of = |level: u32| layer.picture_at(level).2.metres_per_pixel;
        let is_enough = |level: &u32| ENOUGH_PX * pixel_of(*level) <= cell_m;
        let level = (0..=layer.finest).find(is_enough).unwrap_or(layer.finest);
        let (width, height, placement) = layer.picture_at(level);
        let pixel_m = placement.metres_per_pixel;
        let cell = |metres: f64| (metres / cell_m).floor() as i64;
        let right_m = placement.x_m + (width - 1) as f64 * pixel_m;
        let bottom_m = placement.y_m - (height - 1) as f64 * pixel_m;
        Self {
            cell_m,
            columns: cell(placement.x_m)..cell(right_m).saturating_add(1),
            rows: cell(bottom_m)..cell(placement.y_m).saturating_add(1),
            level,
            pixel_m,
            left_m: layer.left_m,
            top_m: layer.top_m,
        }
    }

    fn cells(&self) -> i64 {
        (self.columns.end - self.columns.start).saturating_mul(self.rows.end - self.rows.start)
    }

    /// The YAML file of the map server (nav2_map_server, `map_io.cpp`).
    fn description(&self, picture: &Path) -> String {
        let image = picture.file_name().unwrap_or_default().to_string_lossy();
        let image = image.replace('\\', "\\\\").replace('"', "\\\"");
        format!(
            "image: \"{image}\"\nmode: trinary\nresolution: {}\norigin: [{:.6}, {:.6}, 0.0]\nnegate: 0\n\
             occupied_thresh: {OCCUPIED_THRESHOLD}\nfree_thresh: {FREE_THRESHOLD}\n",
            self.cell_m,
            self.columns.start as f64 * self.cell_m,
            self.rows.start as f64 * self.cell_m
        )
    }

    /// Writes the picture from top to bottom, and counts the cells that are free. In memory is one
    /// row of tiles.
    fn write_picture(&self, file: &MapFile, output: &mut impl Write, path: &Path) -> Result<u64> {
        let width = (self.columns.end - self.columns.start) as usize;
        let not_written = |error| Error::not_written(path.display(), error);
        write!(output, "P5\n{width} {}\n255\n", self.rows.end - self.rows.start).map_err(not_written)?;
        let least = (SEEN_SHARE * (self.cell_m / self.pixel_m).powi(2)).ceil() as u32;
        let mut free = 0;
        let mut write_row = |seen: &[u32]| {
            let gray: Vec<u8> = seen.iter().map(|&seen| if seen >= least { FREE } else { UNKNOWN }).collect();
            free += gray.iter().filter(|gray| **gray == FREE).count() as u64;
            output.write_all(&gray).map_err(not_written)
        };
        // Pixels that show ground in each cell of the rows from `next` downwards.
        let mut seen: VecDeque<Vec<u32>> = VecDeque::new();
        let mut next = self.rows.end - 1;
        for (column, row) in file.mosaic_tiles(self.level)? {
            interrupt::check()?;
            let side = MOSAIC_TILE_PX as u64;
            let highest = self.cell_of_row(row * side);
            while next > highest && next >= self.rows.start {
                write_row(&seen.pop_front().unwrap_or_else(|| vec![0; width]))?;
                next -= 1;
            }
            let Some(rgba) = file.mosaic_tile(self.level, column, row)? else { continue };
            let columns: Vec<i64> =
                (0..side).map(|x| self.cell_of_column(column * side + x) - self.columns.start).collect();
            for (y, pixels) in rgba.chunks_exact(4 * MOSAIC_TILE_PX).enumerate() {
                let Ok(below) = usize::try_from(next - self.cell_of_row(row * side + y as u64)) else {
                    continue;
                };
                if next - (below as i64) < self.rows.start {
                    break;
                }
                while seen.len() <= below {
                    seen.push_back(vec![0; width]);
                }
                for (pixel, &cell) in pixels.as_chunks::<4>().0.iter().zip(&columns) {
                    let cell = usize::try_from(cell).ok().filter(|_| pixel[3] > 0);
                    if let Some(count) = cell.and_then(|cell| seen[below].get_mut(cell)) {
                        *count += 1;
                    }
                }
            }
        }
        for _ in self.rows.start..=next {
            write_row(&seen.pop_front().unwrap_or_else(|| vec![0; width]))?;
        }
        Ok(free)
    }

    /// The cell of a column of pixels, counted from the left border of the mosaic.
    fn cell_of_column(&self, column: u64) -> i64 {
        ((self.left_m + (column as f64 + 0.5) * self.pixel_m) / self.cell_m).floor() as i64
    }

    /// The cell of a row of pixels, counted from the upper border of the mosaic.
    fn cell_of_row(&self, row: u64) -> i64 {
        ((self.top_m - (row as f64 + 0.5) * self.pixel_m) / self.cell_m).floor() as i64
    }
}
