//! Which board images show that do not show the expected one.

use super::markers::{self, Codes, Marker, MarkerLayout};
use super::{BoardFinder, NotFound, chessboard, circles, prepare};
use crate::{Board, BoardKind, Dictionary};
use odograph::image::GrayImage;
use std::fmt;

/// A board that was looked for after another one was not found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenInstead {
    /// The board. Its kind and counts are those seen; its lengths follow from the expected board,
    /// because images do not show them.
    pub board: Board,
    /// Number of images that show it.
    pub images: usize,
    /// Number of images looked at.
    pub of: usize,
}

impl fmt::Display for SeenInstead {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { board, images, of } = self;
        match *of {
            1 => write!(f, "it shows {board} instead"),
            of => write!(f, "{images} of {of} that were compared show {board} instead"),
        }
    }
}

/// Maximum number of columns that are guessed.
const MAX_GUESSED: usize = 24;
/// Minimum number of markers of one image that must agree about a guess.
const MIN_AGREEING: usize = 4;
/// Sides of a marker that are tried, in sides of a square, and gaps between tags, in sides of a
/// tag; the first is the default of [`Board`].
const MARKER_SIDES: [f64; 5] = [0.75, 0.8, 0.7, 0.6, 0.5];
const GAPS: [f64; 5] = [0.3, 0.25, 0.2, 0.4, 0.5];
/// Windows of the adaptive threshold, as for the boards with markers.
const WINDOWS: [(usize, f64); 3] = [(2, 0.3), (1, 0.1), (2, 0.7)];

/// The board that `images` show instead of `expected`: a chessboard, a circle grid or a board with
/// markers, of any count and dictionary. `None` if no picture shows one.
///
/// Takes about as long as looking for ten boards in every image: meant for a few images, after a
/// search that has failed.
pub fn seen_instead(expected: &Board, images: &[GrayImage]) -> Option<SeenInstead> {
    let with_markers = || with_markers(expected, images);
    let chessboard = || chessboards(expected, images);
    let discs = || discs(expected, images);
    // The chessboard of a ChArUco board is a chessboard too, so markers come first.
    let guesses: [&dyn Fn() -> Vec<Board>; 3] = [&with_markers, &chessboard, &discs];
    for guesses in guesses {
        let boards = guesses();
        if boards.iter().any(|board| is_same(board, expected)) {
            return None;
        }
        let seen = boards.into_iter().map(|board| {
            let finder = BoardFinder::new(&board);
            let shown = images.iter().filter(|image| finder.find(image).is_ok()).count();
            SeenInstead { board, images: shown, of: images.len() }
        });
        // Of equals the first.
        let best = seen.filter(|seen| seen.images > 0).reduce(|a, b| if b.images > a.images { b } else { a });
        if best.is_some() {
            return best;
        }
    }
    None
}

/// Whether a board that is seen may be the expected one. Of a board with markers the last rows may
/// be hidden, and dictionaries of the same markers begin alike.
fn is_same(seen: &Board, expected: &Board) -> bool {
    let kind = std::mem::discriminant(&seen.kind()) == std::mem::discriminant(&expected.kind());
    let markers = |board: &Board| {
        let dictionary = board.dictionary_and_markers().map(|(dictionary, _)| dictionary);
        dictionary.map(|dictionary| (dictionary.bits_per_side(), dictionary == Dictionary::AprilTag36h11))
    };
    let rows = if expected.may_be_partial() {
        seen.rows() <= expected.rows()
    } else {
        seen.rows() == expected.rows()
    };
    kind && seen.columns() == expected.columns() && rows && markers(seen) == markers(expected)
}

/// The length that a board is stated with, metres.
fn stated_m(board: &Board) -> f64 {
    match board.kind() {
        BoardKind::AprilGrid { tag_m } => tag_m,
        _ => board.spacing_m(),
    }
}

/// Complete chessboards of other counts, the most frequent first; without one the largest part of
/// one.
fn chessboards(expected: &Board, images: &[GrayImage]) -> Vec<Board> {
    let wanted = expected.grid();
    let is_stated = expected.kind() == BoardKind::Chessboard;
    let board = |(columns, rows): (usize, usize)| {
        // Either order is right, and people write the larger number first.
        let (columns, rows) =
            if is_stated { (columns, rows) } else { (columns.max(rows), columns.min(rows)) };
        Board::new(BoardKind::Chessboard, columns, rows, stated_m(expected)).ok()
    };
    let Some(looked_for) = board((wanted.0.max(2), wanted.1.max(2))) else { return vec![] };
    let mut complete: Vec<((usize, usize), usize)> = Vec::new();
    for image in images {
        let counts = match chessboard::find(image, &looked_for) {
            Ok(_) => looked_for.grid(),
            Err(NotFound::OtherSize { seen, .. }) => seen,
            Err(_) => continue,
        };
        match complete.iter_mut().find(|(other, _)| *other == counts) {
            Some((_, count)) => *count += 1,
            None => complete.push((counts, 1)),
        }
    }
    complete.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    complete.into_iter().take(3).filter_map(|(counts, _)| board(counts)).collect()
}

/// Circle grids with the number of discs that are seen, of every shape.
fn discs(expected: &Board, images: &[GrayImage]) -> Vec<Board> {
    let spacing_m = stated_m(expected);
    // A grid that hardly occurs by chance; others are reported with their number of discs.
    let Ok(looked_for) = Board::new(BoardKind::Circles, 9, 2, spacing_m) else { return vec![] };
    let mut numbers: Vec<usize> = Vec::new();
    for image in images {
        let number = match circles::find(image, &looked_for) {
            Ok(view) => view.points.len(),
            Err(NotFound::OtherDiscs { seen, .. }) => seen,
            Err(_) => continue,
        };
        if !numbers.contains(&number) {
            numbers.push(number);
        }
    }
    let mut boards = Vec::new();
    for number in numbers.into_iter().take(3) {
        for columns in (2..=number / 2).filter(|columns| number % columns == 0) {
            let rows = number / columns;
            let board = |kind| Board::new(kind, columns, rows, spacing_m).ok();
            // Rows and columns of a rectangular grid are the same to its finder.
            boards.extend(board(BoardKind::Circles).filter(|_| columns >= rows));
            boards.extend(board(BoardKind::AsymmetricCircles));
        }
    }
    boards
}

/// The board with markers about which most markers agree.
fn with_markers(expected: &Board, images: &[GrayImage]) -> Vec<Board> {
    // Smaller dictionaries are the beginnings of these.
    let families = [
        Dictionary::Aruco4x4_250,
        Dictionary::Aruco5x5_250,
        Dictionary::Aruco6x6_250,
        Dictionary::AprilTag36h11,
    ];
    let mut best: Option<(usize, Board)> = None;
    let mut consider =
        |guess: &dyn Fn(f64, usize, usize) -> Option<Board>, lengths: &[f64], seen: Seen<'_>| {
            let Some(highest) = highest(seen) else { return };
            for &length in lengths {
                let guesses = (1..=MAX_GUESSED).filter_map(|columns| {
                    let agreeing = agreeing(&guess(length, columns, highest)?, seen);
                    // A marker that was misread does not make the board longer.
                    let board = guess(length, columns, agreeing.iter().copied().max()?)?;
                    Some((agreeing.len(), board))
                });
                // The usual length, unless another fits clearly better.
                let found = guesses.reduce(|a, b| if b.0 > a.0 { b } else { a });
                let to_beat = best.map_or(0, |(agreeing, _)| agreeing + agreeing / 10);
                best = found.filter(|(agreeing, _)| *agreeing > to_beat).or(best);
            }
        };
    let stated_m = stated_m(expected);
    for family in families {
        let charuco = |side: f64, columns: usize, highest: usize| {
            // Every second square has a marker, and the last row has one of them.
            let rows = (3..).find(|rows| columns * rows / 2 > highest)?;
            let kind =
                BoardKind::Charuco { marker_m: side * stated_m, dictionary: smallest(family, highest) };
            Board::new(kind, columns, rows, stated_m).ok()
        };
        consider(&charuco, &MARKER_SIDES, &read(images, &family_codes(family, 0, &[1])));
    }
    let aprilgrid = |gap: f64, columns: usize, highest: usize| {
        let kind = BoardKind::AprilGrid { tag_m: stated_m };
        Board::new(kind, columns, highest / columns + 1, stated_m * (1.0 + gap)).ok()
    };
    consider(&aprilgrid, &GAPS, &read(images, &family_codes(Dictionary::AprilTag36h11, 2, &[2, 1])));
    best.map(|(_, board)| board).into_iter().collect()
}

/// The smallest dictionary with the markers of `family` up to `highest`.
fn smallest(family: Dictionary, highest: usize) -> Dictionary {
    let is_tag = |dictionary: Dictionary| dictionary == Dictionary::AprilTag36h11;
    let named = Dictionary::NAMED.iter().map(|(_, dictionary)| *dictionary).filter(|other| {
        other.bits_per_side() == family.bits_per_side()
            && is_tag(*other) == is_tag(family)
            && other.markers() > highest
    });
    named.min_by_key(|other| other.markers()).unwrap_or(family)
}

fn family_codes(family: Dictionary, quarter_turns: usize, borders: &[usize]) -> Codes {
    let bits = (0..).map_while(|id| Some(family.turned(family.marker(id)?, quarter_turns)));
    let side = family.bits_per_side();
    let layouts = borders.iter().map(|&border| MarkerLayout { bits: side, border }).collect();
    Codes::new(&bits.collect::<Vec<u64>>(), layouts, 0.5 * (1.0 / MARKER_SIDES[0] - 1.0), &WINDOWS)
}

/// The markers of each image.
type Seen<'a> = &'a [Vec<Marker>];

fn read(images: &[GrayImage], codes: &Codes) -> Vec<Vec<Marker>> {
    images.iter().map(|image| markers::find(image, codes, markers::MIN_PX).read).collect()
}

/// Numbers of the markers that agree about a board, of all images.
fn agreeing(board: &Board, seen: Seen<'_>) -> Vec<usize> {
    let Some(prepared) = prepare(board) else { return vec![] };
    let numbers = seen.iter().map(|read| prepared.numbers_agreeing(read));
    numbers.filter(|numbers| numbers.len() >= MIN_AGREEING).flatten().collect()
}

/// The highest number of a marker that is seen, if enough markers are.
fn highest(seen: Seen<'_>) -> Option<usize> {
    let enough = seen.iter().filter(|read| read.len() >= MIN_AGREEING);
    enough.flatten().map(|marker| marker.id).max()
}
