//! The printed pattern of a board as black rectangles and discs on a white sheet, in metres.

use super::dictionary::bit;
use super::{Board, BoardKind, BoardPoint, Dictionary};
use std::ops::Range;

/// The printed pattern of a board, in the board frame.
///
/// * Chessboard: a black square at the top left, and one more row and column of squares than of
///   inner corners.
/// * ChArUco board: the layout of OpenCV 4.6 and later (not its "legacy pattern"), with a black
///   square at the top left and the markers numbered in row-major order over the white squares.
/// * AprilGrid: the target drawn by `kalibr_create_target_pdf`. Tags have 10x10 cells with a border
///   two cells wide, are oriented as published (rotated by 180° relative to [`Dictionary::marker`])
///   and numbered from the bottom left. Black squares as wide as the gap touch the corners of every
///   tag.
/// * Circle grids: the radius of a disc is a quarter of the distance to the nearest neighbouring
///   centre.
#[derive(Debug, Clone, PartialEq)]
pub struct Drawing {
    pattern: Rectangle,
    quiet_m: f64,
    ink: Ink,
}

/// An axis-aligned rectangle in the board frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rectangle {
    /// The corner with the smallest coordinates: top left as printed.
    pub from: BoardPoint,
    /// The opposite corner: bottom right as printed.
    pub to: BoardPoint,
}

/// A black shape on a board.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// A filled rectangle.
    Rectangle(Rectangle),
    /// A filled disc.
    Disc {
        /// Centre.
        center: BoardPoint,
        /// Radius, metres.
        radius_m: f64,
    },
}

impl Rectangle {
    /// Extent along x, metres.
    pub fn width_m(&self) -> f64 {
        self.to.x_m - self.from.x_m
    }

    /// Extent along y, metres.
    pub fn height_m(&self) -> f64 {
        self.to.y_m - self.from.y_m
    }

    /// Whether a point lies inside. The rectangle is half-open: the sides at `from` are included,
    /// the sides at `to` are not.
    pub fn contains(&self, point: BoardPoint) -> bool {
        (self.from.x_m..self.to.x_m).contains(&point.x_m) && (self.from.y_m..self.to.y_m).contains(&point.y_m)
    }

    /// The rectangle expanded by `by_m` on every side.
    fn widened(&self, by_m: f64) -> Self {
        let moved =
            |point: BoardPoint, by_m: f64| BoardPoint { x_m: point.x_m + by_m, y_m: point.y_m + by_m };
        Self { from: moved(self.from, -by_m), to: moved(self.to, by_m) }
    }
}

#[derive(Debug, Clone, PartialEq)]
enum Ink {
    /// A row-major raster of cells whose edges need not be evenly spaced.
    Cells {
        across: CellAxis,
        down: CellAxis,
        black: Vec<bool>,
    },
    DiscGrid(DiscGrid),
}

impl Drawing {
    /// The printed pattern of `board`.
    pub fn new(board: &Board) -> Self {
        let (columns, rows, spacing_m) = (board.columns(), board.rows(), board.spacing_m());
        match board.kind() {
            BoardKind::Chessboard => Self::of_cells(
                CellAxis::new(-spacing_m, &[0.0], spacing_m, columns + 1, 0.0),
                CellAxis::new(-spacing_m, &[0.0], spacing_m, rows + 1, 0.0),
                spacing_m,
                |column, row| (column + row) % 2 == 0,
            ),
            BoardKind::Charuco { marker_m, dictionary } => Self::charuco(board, marker_m, dictionary),
            BoardKind::AprilGrid { tag_m } => Self::april_grid(board, tag_m),
            BoardKind::Circles => Self::discs(board, false),
            BoardKind::AsymmetricCircles => Self::discs(board, true),
        }
    }

    fn charuco(board: &Board, marker_m: f64, dictionary: Dictionary) -> Self {
        let (columns, rows, spacing_m) = (board.columns(), board.rows(), board.spacing_m());
        let bits = dictionary.bits_per_side();
        let cells = bits + 2;
        let markers: Vec<u64> = (0..).map_while(|id| dictionary.marker(id)).collect();
        let margin_m = (spacing_m - marker_m) / 2.0;
        let edges_m: Vec<f64> = std::iter::once(0.0)
            .chain((0..=cells).map(|cell| margin_m + marker_m * cell as f64 / cells as f64))
            .collect();
        Self::of_cells(
            CellAxis::new(-spacing_m, &edges_m, spacing_m, columns, 0.0),
            CellAxis::new(-spacing_m, &edges_m, spacing_m, rows, 0.0),
            spacing_m,
            |column, row| {
                let (square, place) = (column / edges_m.len(), column % edges_m.len());
                let (square_row, place_row) = (row / edges_m.len(), row % edges_m.len());
                if (square + square_row) % 2 == 0 {
                    return true;
                }
                // Number of white squares before this one. Each pair of rows has `columns` white
                // squares, whether the first row starts black or white.
                let id = (square_row * columns + square) / 2;
                let inside = (1..=cells).contains(&place) && (1..=cells).contains(&place_row);
                inside && is_black_cell(markers[id], bits, 1, place - 1, place_row - 1)
            },
        )
    }

    fn april_grid(board: &Board, tag_m: f64) -> Self {
        let (columns, rows, spacing_m) = (board.columns(), board.rows(), board.spacing_m());
        let gap_m = spacing_m - tag_m;
        let family = Dictionary::AprilTag36h11;
        let bits = family.bits_per_side();
        let markers: Vec<u64> = (0..).map_while(|id| Some(family.turned(family.marker(id)?, 2))).collect();
        let edges_m: Vec<f64> = std::iter::once(0.0)
            .chain((0..TAG_CELLS).map(|cell| gap_m + tag_m * cell as f64 / TAG_CELLS as f64))
            .collect();
        Self::of_cells(
            CellAxis::new(-gap_m, &edges_m, spacing_m, columns, gap_m),
            CellAxis::new(-gap_m, &edges_m, spacing_m, rows, gap_m),
            gap_m.max(tag_m / TAG_CELLS as f64),
            |column, row| {
                let (tag, place) = (column / edges_m.len(), column % edges_m.len());
                let (tag_row, place_row) = (row / edges_m.len(), row % edges_m.len());
                if place == 0 || place_row == 0 {
                    return place == place_row;
                }
                let id = (rows - 1 - tag_row) * columns + tag;
                is_black_cell(markers[id], bits, 2, place - 1, place_row - 1)
            },
        )
    }

    fn discs(board: &Board, shifted: bool) -> Self {
        let (columns, rows, spacing_m) = (board.columns(), board.rows(), board.spacing_m());
        let nearest_m = if shifted { spacing_m * std::f64::consts::SQRT_2 } else { spacing_m };
        let centers = board.points();
        let farthest = |of: fn(&BoardPoint) -> f64| centers.iter().map(of).fold(0.0, f64::max);
        let around = Rectangle {
            from: BoardPoint { x_m: 0.0, y_m: 0.0 },
            to: BoardPoint { x_m: farthest(|point| point.x_m), y_m: farthest(|point| point.y_m) },
        };
        let radius_m = nearest_m / 4.0;
        Self {
            pattern: around.widened(radius_m),
            quiet_m: spacing_m - radius_m,
            ink: Ink::DiscGrid(DiscGrid { centers, columns, rows, spacing_m, shifted, radius_m }),
        }
    }

    fn of_cells(
        across: CellAxis,
        down: CellAxis,
        quiet_m: f64,
        is_black: impl Fn(usize, usize) -> bool,
    ) -> Self {
        let pattern = Rectangle {
            from: BoardPoint { x_m: across.first_m(), y_m: down.first_m() },
            to: BoardPoint { x_m: across.last_m(), y_m: down.last_m() },
        };
        let columns = across.cells();
        let black = (0..columns * down.cells()).map(|at| is_black(at % columns, at / columns)).collect();
        Self { pattern, quiet_m, ink: Ink::Cells { across, down, black } }
    }

    /// Bounding rectangle of all squares, tags or discs, including white squares at the border.
    pub fn pattern(&self) -> Rectangle {
        self.pattern
    }

    /// Minimum width of the white quiet zone around the pattern for reliable detection, metres.
    pub fn quiet_m(&self) -> f64 {
        self.quiet_m
    }

    /// The white sheet: the pattern with its quiet zone.
    pub fn sheet(&self) -> Rectangle {
        self.pattern.widened(self.quiet_m)
    }

    /// All black areas as non-overlapping shapes. Squares of a chessboard touch at their corners,
    /// cells of a marker along their sides.
    pub fn shapes(&self) -> Vec<Shape> {
        match &self.ink {
            Ink::Cells { across, down, black } => {
                let rectangle = |(columns, rows): (Range<usize>, Range<usize>)| {
                    Shape::Rectangle(Rectangle {
                        from: BoardPoint {
                            x_m: across.edges_m[columns.start],
                            y_m: down.edges_m[rows.start],
                        },
                        to: BoardPoint { x_m: across.edges_m[columns.end], y_m: down.edges_m[rows.end] },
                    })
                };
                merged(black, across.cells()).into_iter().map(rectangle).collect()
            }
            Ink::DiscGrid(discs) => {
                let shape = |center| Shape::Disc { center, radius_m: discs.radius_m };
                discs.centers.iter().copied().map(shape).collect()
            }
        }
    }

    /// Whether the board is black at a point; false outside the pattern.
    pub fn is_black(&self, point: BoardPoint) -> bool {
        match &self.ink {
            Ink::Cells { across, down, black } => match (across.cell(point.x_m), down.cell(point.y_m)) {
                (Some(column), Some(row)) => black[row * across.cells() + column],
                _ => false,
            },
            Ink::DiscGrid(discs) => discs.is_black(point),
        }
    }

    /// `Some` if a small rectangle is uniformly black (`true`) or uniformly white (`false`); `None`
    /// if it may be mixed.
    pub fn is_black_all_over(&self, part: Rectangle) -> Option<bool> {
        match &self.ink {
            Ink::Cells { across, down, black } => {
                let columns = (across.cell(part.from.x_m), across.cell(part.to.x_m));
                let rows = (down.cell(part.from.y_m), down.cell(part.to.y_m));
                match (columns, rows) {
                    ((Some(left), Some(right)), (Some(top), Some(bottom))) => {
                        let same = left == right && top == bottom;
                        same.then(|| black[top * across.cells() + left])
                    }
                    _ => {
                        let Rectangle { from, to } = self.pattern;
                        let apart = part.to.x_m < from.x_m
                            || part.to.y_m < from.y_m
                            || part.from.x_m >= to.x_m
                            || part.from.y_m >= to.y_m;
                        apart.then_some(false)
                    }
                }
            }
            Ink::DiscGrid(discs) => discs.is_black_all_over(part),
        }
    }
}

/// Cells along the side of one of Kalibr's tags: six bits and a border of two cells on each side.
const TAG_CELLS: usize = 10;

/// Whether a marker cell is black. Columns and rows are counted from the corner of the border,
/// which is `border` cells wide.
fn is_black_cell(marker: u64, bits: usize, border: usize, column: usize, row: usize) -> bool {
    let inside = border..border + bits;
    !inside.contains(&column)
        || !inside.contains(&row)
        || bit(marker, bits, column - border, row - border) == 0
}

/// Merges the black cells of a raster into rectangles, returned as ranges of columns and rows. Each
/// run of black cells in a row is extended downwards over rows that have the same run.
fn merged(black: &[bool], columns: usize) -> Vec<(Range<usize>, Range<usize>)> {
    let mut rectangles: Vec<(Range<usize>, Range<usize>)> = Vec::new();
    // Rectangles that end at the previous row, in column order.
    let mut open: Vec<usize> = Vec::new();
    for (row, cells) in black.chunks_exact(columns).enumerate() {
        let mut reaching = Vec::new();
        let mut column = 0;
        while column < columns {
            if !cells[column] {
                column += 1;
                continue;
            }
            let end = (column..columns).find(|&at| !cells[at]).unwrap_or(columns);
            let above = open.iter().copied().find(|&at| rectangles[at].0 == (column..end));
            let at = above.unwrap_or_else(|| {
                rectangles.push((column..end, row..row));
                rectangles.len() - 1
            });
            rectangles[at].1.end = row + 1;
            reaching.push(at);
            column = end;
        }
        open = reaching;
    }
    rectangles
}

/// Cell edges along one axis, with a lookup table from position to cell.
#[derive(Debug, Clone, PartialEq)]
struct CellAxis {
    edges_m: Vec<f64>,
    /// For each of the evenly spaced table positions: the last edge at or before it.
    table: Vec<u32>,
    places_per_m: f64,
}

impl CellAxis {
    /// `count` periods of length `period_m` from `start_m`, each with the same edges, followed by a
    /// last cell of length `end_m` if that is positive.
    fn new(start_m: f64, edges_of_a_period_m: &[f64], period_m: f64, count: usize, end_m: f64) -> Self {
        let period = |number: usize| {
            edges_of_a_period_m.iter().map(move |edge_m| start_m + period_m * number as f64 + edge_m)
        };
        let mut edges_m: Vec<f64> = (0..count).flat_map(period).collect();
        let last_m = start_m + period_m * count as f64;
        edges_m.push(last_m);
        if end_m > 0.0 {
            edges_m.push(last_m + end_m);
        }
        let length_m = edges_m[edges_m.len() - 1] - start_m;
        let places = 4 * edges_m.len();
        let places_per_m = places as f64 / length_m;
        let table = (0..places)
            .map(|place| {
                let place_m = start_m + place as f64 / places_per_m;
                edges_m.partition_point(|edge_m| *edge_m <= place_m).saturating_sub(1) as u32
            })
            .collect();
        Self { edges_m, table, places_per_m }
    }

    fn cells(&self) -> usize {
        self.edges_m.len() - 1
    }

    fn first_m(&self) -> f64 {
        self.edges_m[0]
    }

    fn last_m(&self) -> f64 {
        self.edges_m[self.cells()]
    }

    #[inline]
    fn cell(&self, at_m: f64) -> Option<usize> {
        let place = (at_m - self.edges_m[0]) * self.places_per_m;
        if !(place >= 0.0 && at_m < self.edges_m[self.edges_m.len() - 1]) {
            return None;
        }
        // Rounding may select the next table entry, and so a cell too far.
        let mut cell = self.table[(place as usize).min(self.table.len() - 1)] as usize;
        while at_m < self.edges_m[cell] {
            cell -= 1;
        }
        while at_m >= self.edges_m[cell + 1] {
            cell += 1;
        }
        Some(cell)
    }
}

/// A grid of discs.
#[derive(Debug, Clone, PartialEq)]
struct DiscGrid {
    centers: Vec<BoardPoint>,
    columns: usize,
    rows: usize,
    spacing_m: f64,
    /// Whether every second row is shifted by half the distance between neighbours in a row.
    shifted: bool,
    radius_m: f64,
}

impl DiscGrid {
    /// Distance from a point to the nearest disc centre, metres.
    fn distance_m(&self, point: BoardPoint) -> f64 {
        let BoardPoint { x_m, y_m } = point;
        let in_a_row_m = if self.shifted { 2.0 * self.spacing_m } else { self.spacing_m };
        let nearest_row = (y_m / self.spacing_m).floor();
        // The nearest centre is in the row above or in the row below.
        let distances = [nearest_row, nearest_row + 1.0].map(|row| {
            let row = row.clamp(0.0, (self.rows - 1) as f64);
            let start_m = if self.shifted && row % 2.0 == 1.0 { self.spacing_m } else { 0.0 };
            let column = ((x_m - start_m) / in_a_row_m).round().clamp(0.0, (self.columns - 1) as f64);
            (x_m - start_m - column * in_a_row_m).hypot(y_m - row * self.spacing_m)
        });
        distances[0].min(distances[1])
    }

    fn is_black(&self, point: BoardPoint) -> bool {
        self.distance_m(point) < self.radius_m
    }

    fn is_black_all_over(&self, part: Rectangle) -> Option<bool> {
        let middle =
            BoardPoint { x_m: (part.from.x_m + part.to.x_m) / 2.0, y_m: (part.from.y_m + part.to.y_m) / 2.0 };
        let reach_m = part.width_m().hypot(part.height_m()) / 2.0;
        let distance_m = self.distance_m(middle);
        // The distance to the nearest centre is Lipschitz continuous with constant 1, so within the
        // rectangle it differs from the value at the middle by at most `reach_m`.
        ((distance_m - self.radius_m).abs() > reach_m).then_some(distance_m < self.radius_m)
    }
}

#[cfg(test)]
mod tests;
