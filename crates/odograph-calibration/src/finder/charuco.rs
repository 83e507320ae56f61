//! ChArUco boards: chessboards with markers in the white squares.

use super::markers::{Codes, MarkerLayout};
use super::tagged::TaggedBoard;
use crate::{Board, BoardKind, Drawing};

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
    let mut marker_in_cell = vec![None; columns * rows];
    let mut cell_of_marker = Vec::new();
    let mut corners_of_marker = Vec::new();
    let mut points_of_marker = Vec::new();
    let mut markers_of_point = vec![Vec::new(); grid.0 * grid.1];
    let mut bits = Vec::new();
    for y in 0..rows {
        for x in (0..columns).filter(|x| (x + y) % 2 == 1) {
            let id = cell_of_marker.len();
            marker_in_cell[y * columns + x] = Some(id);
            cell_of_marker.push((x, y));
            bits.push(dictionary.marker(id)?);
            // The origin is the first inner corner, one square right of and below the corner of the
            // board.
            let left = (x as f64 - 1.0) * spacing_m + gap_m;
            let top = (y as f64 - 1.0) * spacing_m + gap_m;
            corners_of_marker.push([
                (left, top),
                (left + marker_m, top),
                (left + marker_m, top + marker_m),
                (left, top + marker_m),
            ]);
            let mut touched = Vec::new();
            for row in y.saturating_sub(1)..(y + 1).min(grid.1) {
                for column in x.saturating_sub(1)..(x + 1).min(grid.0) {
                    touched.push(row * grid.0 + column);
                    markers_of_point[row * grid.0 + column].push(id);
                }
            }
            points_of_marker.push(touched);
        }
    }
    let layouts = vec![MarkerLayout { bits: dictionary.bits_per_side(), border: 1 }];
    Some(TaggedBoard {
        points: board.points(),
        drawing: Drawing::new(board),
        grid,
        cells: (columns, rows),
        marker_in_cell,
        cell_of_marker,
        corners_of_marker,
        markers_of_point,
        points_of_marker,
        black_upper_left: (0..grid.0 * grid.1).map(|i| (i % grid.0 + i / grid.0).is_multiple_of(2)).collect(),
        codes: Codes::new(&bits, layouts, gap_m / marker_m, &WINDOWS),
        plain_m: gap_m,
        spacing_m,
        reach: 2,
        least_markers: 2,
        is_chessboard: true,
    })
}
