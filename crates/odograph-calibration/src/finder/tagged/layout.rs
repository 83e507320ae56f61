//! The layout of a board: its points, and where its markers are.

use super::TaggedBoard;
use crate::finder::markers::Codes;
use crate::{Board, Drawing};

impl TaggedBoard {
    /// A chessboard without its markers yet. At the upper left inner corner the square to the upper
    /// left is black, as at that of a tag of an AprilGrid: the tag is at the lower right, a black
    /// square at the upper left. The polarity alternates from point to point.
    pub(in crate::finder) fn without_markers(board: &Board, codes: Codes) -> Self {
        let (grid, cells) = (board.grid(), (board.columns(), board.rows()));
        let count = grid.0 * grid.1;
        Self {
            points: board.points(),
            grid,
            cells,
            marker_in_cell: vec![None; cells.0 * cells.1],
            cell_of_marker: Vec::new(),
            corners_of_marker: Vec::new(),
            markers_of_point: vec![Vec::new(); count],
            points_of_marker: Vec::new(),
            black_upper_left: (0..count).map(|i| (i % grid.0 + i / grid.0).is_multiple_of(2)).collect(),
            codes,
            drawing: Drawing::new(board),
            plain_m: 0.0,
            spacing_m: board.spacing_m(),
            reach: 2,
            least_markers: 2,
            is_chessboard: true,
        }
    }

    /// Adds the next marker: its cell, its upper left corner on the board and its side, metres, and
    /// the points adjacent to it.
    pub(in crate::finder) fn add_marker(
        &mut self,
        cell: (usize, usize),
        (left, top): (f64, f64),
        side_m: f64,
        points: Vec<usize>,
    ) {
        let id = self.cell_of_marker.len();
        self.marker_in_cell[cell.1 * self.cells.0 + cell.0] = Some(id);
        self.cell_of_marker.push(cell);
        let (right, bottom) = (left + side_m, top + side_m);
        self.corners_of_marker.push([(left, top), (right, top), (right, bottom), (left, bottom)]);
        points.iter().for_each(|&point| self.markers_of_point[point].push(id));
        self.points_of_marker.push(points);
    }
}
