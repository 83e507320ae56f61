//! The ground seen so far as a grid of coarse cells, as navigation wants it.

use crate::followed_tiles::FollowedTiles;
use crate::ground::TiledGround;
use odograph::mosaic::{Mosaic, MosaicSquare};
use std::ops::Range;

/// Side of a cell unless the mosaic is too coarse for it, metres: that of Nav2's maps.
pub const CELL_M: f64 = 0.05;
/// A cell has at least this many pixels of the mosaic along its side.
pub const LEAST_CELL_PX: f64 = 2.0;
/// Share of a cell that must be seen for the cell to be seen.
pub const SEEN_SHARE: f64 = 0.5;

/// Cells along the axes of a ground map, each seen or not.
#[derive(Debug, Clone, PartialEq)]
pub struct SeenCells {
    /// Side of a cell, metres.
    pub cell_m: f64,
    /// Cells along x, counted from the origin.
    pub columns: Range<i64>,
    /// Cells along y, counted from the origin.
    pub rows: Range<i64>,
    /// Whether at least half of a cell is seen; row by row, each along x, that of the least y
    /// first.
    pub seen: Vec<bool>,
}

impl SeenCells {
    /// Number of cells along x.
    pub fn width(&self) -> usize {
        (self.columns.end - self.columns.start) as usize
    }

    /// Number of cells along y.
    pub fn height(&self) -> usize {
        (self.rows.end - self.rows.start) as usize
    }

    /// Corner of least x and y, metres.
    pub fn corner_m(&self) -> [f64; 2] {
        [self.columns.start, self.rows.start].map(|cell| cell as f64 * self.cell_m)
    }
}

/// Follows a ground map, and has its cells by the rules of `odograph map export grid.yaml`.
#[derive(Debug)]
pub struct SeenGrid {
    most_cells: usize,
    tiles: FollowedTiles<TileCells>,
}

/// Numbers of pixels of a tile that show ground, by cell.
#[derive(Debug)]
struct TileCells {
    columns: Range<i64>,
    rows: Range<i64>,
    seen: Vec<u32>,
}

/// Side of the smallest cells for a mosaic, metres.
fn cell_m(metres_per_pixel: f64) -> f64 {
    let mut cell_m = CELL_M;
    while cell_m < LEAST_CELL_PX * metres_per_pixel {
        cell_m *= 2.0;
    }
    cell_m
}

impl TileCells {
    fn new(square: MosaicSquare, metres_per_pixel: f64, rgba: &[u8]) -> Self {
        let side = Mosaic::TILE_SIDE_PX as i64;
        let cell_m = cell_m(metres_per_pixel);
        let cell = |pixel: i64| ((pixel as f64 + 0.5) * metres_per_pixel / cell_m).floor() as i64;
        let (left, top) = (square.column * side, square.row * side);
        // Rows of pixels run against y.
        let cell_up = |row: i64| cell(-1 - row);
        let columns = cell(left)..cell(left + side - 1) + 1;
        let rows = cell_up(top + side - 1)..cell_up(top) + 1;
        let width = (columns.end - columns.start) as usize;
        let mut seen = vec![0; width * (rows.end - rows.start) as usize];
        for (line, y) in rgba.chunks_exact(4 * Mosaic::TILE_SIDE_PX).zip(top..) {
            let row = (cell_up(y) - rows.start) as usize * width;
            for (pixel, x) in line.as_chunks::<4>().0.iter().zip(left..) {
                seen[row + (cell(x) - columns.start) as usize] += u32::from(pixel[3] > 0);
            }
        }
        Self { columns, rows, seen }
    }

    /// Column, row and number of the pixels of each cell of which something is seen.
    fn cells(&self) -> impl Iterator<Item = (i64, i64, u32)> {
        let rows =
            self.seen.chunks_exact((self.columns.end - self.columns.start) as usize).zip(self.rows.start..);
        let cells = rows.flat_map(|(line, row)| {
            line.iter().zip(self.columns.start..).map(move |(&seen, column)| (column, row, seen))
        });
        cells.filter(|(_, _, seen)| *seen > 0)
    }
}

impl SeenGrid {
    /// Follows a ground map with at most `most_cells` cells: where there would be more, they are
    /// doubled in side.
    pub fn new(most_cells: usize) -> Self {
        Self { most_cells: most_cells.max(4), tiles: FollowedTiles::default() }
    }

    /// Takes what has changed; `false` if nothing has.
    pub fn update(&mut self, ground: &dyn TiledGround) -> bool {
        self.tiles.update(ground, TileCells::new)
    }

    /// The cells that hold all ground seen; `None` where there is none.
    pub fn cells(&self) -> Option<SeenCells> {
        let cells = || self.tiles.made.values().flat_map(TileCells::cells);
        let extent = cells().fold(None, |extent, (column, row, _)| {
            let [left, right, low, high] = extent.unwrap_or([column, column, row, row]);
            Some([left.min(column), right.max(column), low.min(row), high.max(row)])
        });
        let [left, right, low, high] = extent?;
        let (columns, rows) = (left..right + 1, low..high + 1);
        let mut halvings = 0;
        let coarse =
            |cells: &Range<i64>, halvings: u32| cells.start >> halvings..((cells.end - 1) >> halvings) + 1;
        let length = |cells: Range<i64>| cells.end.saturating_sub(cells.start);
        let count =
            |halvings| length(coarse(&columns, halvings)).saturating_mul(length(coarse(&rows, halvings)));
        while count(halvings) as u64 > self.most_cells as u64 {
            halvings += 1;
        }
        let (columns, rows) = (coarse(&columns, halvings), coarse(&rows, halvings));
        let cell_m = cell_m(self.tiles.metres_per_pixel) * (1u64 << halvings) as f64;
        let width = (columns.end - columns.start) as usize;
        let mut pixels = vec![0u64; width * (rows.end - rows.start) as usize];
        for (column, row, seen) in cells() {
            let at = ((row >> halvings) - rows.start) as usize * width
                + ((column >> halvings) - columns.start) as usize;
            pixels[at] += u64::from(seen);
        }
        let least = (SEEN_SHARE * (cell_m / self.tiles.metres_per_pixel).powi(2)).ceil() as u64;
        let seen = pixels.into_iter().map(|pixels| pixels >= least).collect();
        Some(SeenCells { cell_m, columns, rows, seen })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use crate::ground::GrowingTiles;

    /// A tile that is seen where `is_seen` says so, by column and row.
    fn tile(is_seen: impl Fn(i64, i64) -> bool) -> Vec<u8> {
        let side = Mosaic::TILE_SIDE_PX as i64;
        let pixel = |at: i64| [7, 7, 7, if is_seen(at % side, at / side) { 255 } else { 0 }];
        (0..side * side).flat_map(pixel).collect()
    }

    #[test]
    fn cells_half_seen_are_seen_and_follow_the_map() {
        let (ground, mut grid) = (GrowingTiles::default(), SeenGrid::new(1 << 20));
        assert!(!grid.update(&ground) && grid.cells().is_none());
        // Pixels of 12.5 mm: a cell is four by four of them, and the tile 64 by 64 cells.
        ground.begin(0.0125);
        let at = |column, row| MosaicSquare { column, row };
        // The lower right of the origin: x from 0 to 3.2 m, y from 0 to −3.2 m.
        ground.put(at(0, 0), tile(|x, y| x < 10 && y < 8));
        assert!(grid.update(&ground));
        let cells = grid.cells().unwrap();
        assert_eq!((cells.cell_m, cells.columns.clone(), cells.rows.clone()), (0.05, 0..3, -2..0));
        assert_eq!((cells.width(), cells.height(), cells.corner_m()), (3, 2, [0.0, -0.1]));
        // Of the third column two of four pixels are seen: half.
        assert_eq!(cells.seen, [true; 6]);
        ground.put(at(0, 0), tile(|x, y| x < 9 && y < 8));
        assert!(grid.update(&ground) && !grid.update(&ground));
        assert_eq!(grid.cells().unwrap().seen, [true, true, false, true, true, false]);
        // The upper left of the origin joins it.
        ground.put(at(-1, -1), tile(|x, y| x >= 252 && y >= 252));
        assert!(grid.update(&ground));
        let cells = grid.cells().unwrap();
        assert_eq!((cells.columns.clone(), cells.rows.clone()), (-1..3, -2..1));
        assert_eq!(cells.seen[8..], [true, false, false, false]);
        // Another sampling distance is another map.
        ground.begin(0.04);
        ground.put(at(0, 0), tile(|x, y| x < 5 && y < 5));
        assert!(grid.update(&ground));
        let cells = grid.cells().unwrap();
        assert_eq!((cells.cell_m, cells.width(), cells.seen.len()), (0.1, 2, 4));
    }

    #[test]
    fn many_cells_become_coarser_ones_with_the_same_ground() {
        let ground = GrowingTiles::default();
        ground.begin(0.025);
        // A strip of 44.8 m by 6.4 m with a gap of 19.2 m.
        for column in (0..7).filter(|column| !(2..5).contains(column)) {
            ground.put(MosaicSquare { column, row: -1 }, tile(|_, _| true));
        }
        let cells_of = |most| {
            let mut grid = SeenGrid::new(most);
            assert!(grid.update(&ground));
            grid.cells().unwrap()
        };
        let (fine, coarse) = (cells_of(usize::MAX), cells_of(10_000));
        assert_eq!((fine.cell_m, fine.width(), fine.height()), (0.05, 896, 128));
        assert_eq!((coarse.cell_m, coarse.width(), coarse.height()), (0.2, 224, 32));
        let area = |cells: &SeenCells| {
            let seen = cells.seen.iter().filter(|seen| **seen).count();
            seen as f64 * cells.cell_m * cells.cell_m
        };
        assert!((area(&fine) - 4.0 * 6.4 * 6.4).abs() < 1e-9, "{}", area(&fine));
        assert!((area(&coarse) - area(&fine)).abs() < 1e-9);
    }
}
