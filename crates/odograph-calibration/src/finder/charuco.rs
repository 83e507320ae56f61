//! ChArUco boards: chessboards with markers in the white squares.

use super::markers::{Codes, MarkerLayout};
use super::tagged::TaggedBoard;
use crate::{Board, BoardKind};

/// Windows of the adaptive threshold: radius in tiles of 4 pixels, and offset below the local mean
/// in standard deviations. The small window separates small markers from the squares around them.
const WINDOWS: [(usize, f64); 2] = [(2, 0.3), (1, 0.1)];

/// The board with the marker layout of OpenCV 4.6 and later: the square at the top left is black,
/// and markers are numbered in row-major order over the white squares. `None` for other kinds of
/// boards.
pub(super) fn prepare(board: &Board) -> Option<TaggedBoard> {
    let BoardKind::Charuco { marker_m, dictionary } = board.kind() else { return None };
    let (columns, rows) = (board.columns(), board.rows());
    let grid = board.grid();
    let spacing_m = board.spacing_m();
    let gap_m = 0.5 * (spacing_m - marker_m);
    let cells = (0..columns * rows).map(|cell| (cell % columns, cell / columns));
    let white: Vec<(usize, usize)> = cells.filter(|(x, y)| (x + y) % 2 == 1).collect();
    let bits: Option<Vec<u64>> = (0..white.len()).map(|id| dictionary.marker(id)).collect();
    let layouts = vec![MarkerLayout { bits: dictionary.bits_per_side(), border: 1 }];
    let codes = Codes::new(&bits?, layouts, gap_m / marker_m, &WINDOWS);
    let mut prepared = TaggedBoard::without_markers(board, codes);
    prepared.plain_m = gap_m;
    for (x, y) in white {
        // The origin is the first inner corner, one square right of and below the corner of the
        // board.
        let [left, top] = [x, y].map(|at| (at as f64 - 1.0) * spacing_m + gap_m);
        let columns = x.saturating_sub(1)..(x + 1).min(grid.0);
        let rows = y.saturating_sub(1)..(y + 1).min(grid.1);
        let touched = rows.flat_map(|row| columns.clone().map(move |column| row * grid.0 + column));
        prepared.add_marker((x, y), (left, top), marker_m, touched.collect());
    }
    Some(prepared)
}
