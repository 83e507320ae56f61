//! Kalibr's AprilGrid boards.

use super::markers::{Codes, MarkerLayout};
use super::tagged::TaggedBoard;
use crate::{Board, BoardKind, Dictionary};

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
    let gap_m = spacing_m - tag_m;
    let count = columns * rows;
    // The dictionary has OpenCV's orientation, rotated by 180°.
    let bits: Option<Vec<u64>> =
        (0..count).map(|id| Some(dictionary.turned(dictionary.marker(id)?, 2))).collect();
    let side = dictionary.bits_per_side();
    let layouts = [2, 1].map(|border| MarkerLayout { bits: side, border }).to_vec();
    let codes = Codes::new(&bits?, layouts, gap_m / tag_m, &WINDOWS);
    let mut prepared = TaggedBoard::without_markers(board, codes);
    prepared.plain_m = gap_m.min(0.125 * tag_m);
    prepared.reach = 3;
    prepared.least_markers = 1;
    prepared.is_chessboard = false;
    for id in 0..count {
        let (x, y) = (id % columns, rows - 1 - id / columns);
        let upper_left_m = (x as f64 * spacing_m, y as f64 * spacing_m);
        let first = 2 * y * grid.0 + 2 * x;
        let touched = vec![first, first + 1, first + grid.0, first + grid.0 + 1];
        prepared.add_marker((x, y), upper_left_m, tag_m, touched);
    }
    Some(prepared)
}
