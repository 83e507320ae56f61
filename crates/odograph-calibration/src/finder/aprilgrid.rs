//! Kalibr's AprilGrid boards.

use super::markers::{Codes, MarkerLayout};
use super::tagged::TaggedBoard;
use crate::{Board, BoardKind, Dictionary, Drawing};

/// Windows of the adaptive threshold: radius in tiles of 4 pixels, and offset below the local mean
/// in standard deviations. The offset is large because tags must be separated from the squares that
/// touch them.
const WINDOWS: [(usize, f64); 2] = [(2, 0.7), (2, 0.35)];

/// The board as drawn by Kalibr's `kalibr_create_target_pdf`: tag 0 at the bottom left, a black
/// border of two bits, the first bit of the published code at the top left of each tag, and a black
/// square at each corner of each tag. Tags with a border of one bit, as printed by other programs,
/// are decoded too. `None` for other kinds of boards.
pub(super) fn prepare(board: &Board) -> Option<TaggedBoard> {
    let BoardKind::AprilGrid { tag_m } = board.kind() else { return None };
    let dictionary = Dictionary::AprilTag36h11;
    let (columns, rows) = (board.columns(), board.rows());
    let grid = board.grid();
    let spacing_m = board.spacing_m();
    let mut marker_in_cell = vec![None; columns * rows];
    let mut cell_of_marker = Vec::new();
    let mut corners_of_marker = Vec::new();
    let mut points_of_marker = Vec::new();
    let mut markers_of_point = vec![Vec::new(); grid.0 * grid.1];
    let mut bits = Vec::new();
    for id in 0..columns * rows {
        let (x, y) = (id % columns, rows - 1 - id / columns);
        marker_in_cell[y * columns + x] = Some(id);
        cell_of_marker.push((x, y));
        // The dictionary has OpenCV's orientation, rotated by 180°.
        bits.push(dictionary.turned(dictionary.marker(id)?, 2));
        let (left, top) = (x as f64 * spacing_m, y as f64 * spacing_m);
        corners_of_marker.push([
            (left, top),
            (left + tag_m, top),
            (left + tag_m, top + tag_m),
            (left, top + tag_m),
        ]);
        let first = 2 * y * grid.0 + 2 * x;
        let touched = vec![first, first + 1, first + grid.0, first + grid.0 + 1];
        for &point in &touched {
            markers_of_point[point].push(id);
        }
        points_of_marker.push(touched);
    }
    let side = dictionary.bits_per_side();
    let layouts = [2, 1].map(|border| MarkerLayout { bits: side, border }).to_vec();
    let gap_m = spacing_m - tag_m;
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
        // At the upper left corner of a tag, the tag is at the lower right and a black square at
        // the upper left. The polarity alternates from point to point.
        black_upper_left: (0..grid.0 * grid.1).map(|i| (i % grid.0 + i / grid.0).is_multiple_of(2)).collect(),
        codes: Codes::new(&bits, layouts, gap_m / tag_m, &WINDOWS),
        plain_m: gap_m.min(0.125 * tag_m),
        spacing_m,
        reach: 3,
        least_markers: 1,
        is_chessboard: false,
    })
}
