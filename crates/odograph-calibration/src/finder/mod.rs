//! Detection of boards in images.

mod aprilgrid;
mod blobs;
mod charuco;
mod chessboard;
mod circles;
mod completion;
mod disc;
mod lattice;
mod markers;
mod pattern_fit;
mod plane_map;
mod points;
mod response;
pub(crate) mod ring;
mod seen_instead;
mod single;
pub(crate) mod subpixel;
mod tagged;
#[cfg(test)]
mod tests;

pub use seen_instead::{SeenInstead, seen_instead};
pub use single::{MarkerFinder, SeenMarker};

use super::{Board, BoardKind, BoardView};
use odograph::error::Error;
use odograph::image::GrayImage;
use std::fmt;

/// Why no board was detected. The text form is one clause for users.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum NotFound {
    /// No chessboard corners were detected.
    NoCorners,
    /// A complete chessboard with a different number of corners was detected.
    OtherSize {
        /// Expected columns and rows of inner corners.
        expected: (usize, usize),
        /// Detected columns and rows of inner corners.
        seen: (usize, usize),
    },
    /// Only a part of a chessboard was detected.
    Partial {
        /// Expected columns and rows.
        expected: (usize, usize),
        /// Columns and rows spanned by the detected points.
        seen: (usize, usize),
        /// Number of detected points.
        points: usize,
    },
    /// No grid of discs was detected.
    NoDiscs,
    /// A grid of discs was detected that is a different board or only a part of this one.
    OtherDiscs {
        /// Number of discs on the board.
        expected: usize,
        /// Number of discs in the detected grid.
        seen: usize,
    },
    /// No marker of the board was decoded.
    NoMarkers,
    /// Too few consistent markers of the board were decoded.
    TooFewMarkers {
        /// Number of consistent decoded markers.
        found: usize,
        /// Minimum number of markers.
        least: usize,
    },
    /// The markers can only be decoded in the mirrored image.
    Mirrored,
    /// The board was detected, but is too blurred to locate its points to a tenth of a pixel.
    Blurred,
}

impl fmt::Display for NotFound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::NoCorners => f.write_str("no chessboard corners"),
            Self::OtherSize { expected, seen } => {
                write!(
                    f,
                    "{}x{} corners expected, the board seen has {}x{}",
                    expected.0, expected.1, seen.0, seen.1
                )
            }
            Self::Partial { expected, seen, points } => write!(
                f,
                "{points} points of a grid of {}x{} seen where {}x{} were expected: part of the board is hidden or the count is wrong",
                seen.0, seen.1, expected.0, expected.1
            ),
            Self::NoDiscs => f.write_str("no grid of discs"),
            Self::OtherDiscs { expected, seen } => write!(
                f,
                "a grid of {seen} discs seen where {expected} in other lines were expected: part of the board is hidden or the count is wrong"
            ),
            Self::NoMarkers => f.write_str("no markers of the board"),
            Self::TooFewMarkers { found, least } => {
                write!(f, "only {found} of the board's markers, and it takes {least}")
            }
            Self::Mirrored => f.write_str("markers read mirrored: the image is mirrored"),
            Self::Blurred => f.write_str("the board is too blurred for exact points"),
        }
    }
}

/// Detects a [`Board`] in images and locates its points to a few hundredths of a pixel.
///
/// It holds data precomputed for the board. A mirrored board is never detected, and the same image
/// always has the same result.
#[derive(Debug, Clone)]
pub struct BoardFinder {
    board: Board,
    /// Marker layout, for boards with markers.
    tagged: Option<tagged::TaggedBoard>,
}

impl BoardFinder {
    /// A finder for a board.
    pub fn new(board: &Board) -> Self {
        Self { board: *board, tagged: prepare(board) }
    }

    /// The board to detect.
    pub fn board(&self) -> &Board {
        &self.board
    }

    /// The board's points in an image, sorted by index, or the reason why no board was detected.
    ///
    /// Chessboards and circle grids are only detected as a whole; boards with markers may be partly
    /// visible. If exactly one corner square of a chessboard is black, the first point is the one
    /// next to it. If the board is symmetric under a rotation by 180°, the orientation is chosen
    /// for which the rows run as far as possible to the right in the image and the columns
    /// downwards.
    ///
    /// Accepts images of any size and content. The run time is proportional to the number of
    /// pixels: 1920x1080 samples of noise take a tenth of a second or less.
    pub fn find(&self, image: &GrayImage) -> Result<BoardView, NotFound> {
        match self.board.kind() {
            BoardKind::Chessboard => chessboard::find(image, &self.board),
            BoardKind::Circles | BoardKind::AsymmetricCircles => circles::find(image, &self.board),
            _ => self.tagged.as_ref().ok_or(NotFound::NoMarkers)?.find(image),
        }
    }
}

/// The marker layout of a board; `None` for boards without markers.
fn prepare(board: &Board) -> Option<tagged::TaggedBoard> {
    charuco::prepare(board).or_else(|| aprilgrid::prepare(board))
}

/// The error that a board was found nowhere, and what to do: of so many frames or `pictures` that
/// were looked at, with the most frequent reason and its count, and the board that they show
/// `instead`.
pub fn nothing_found(
    board: &Board,
    looked_at: u64,
    pictures: bool,
    mostly: Option<(&dyn fmt::Display, u64)>,
    instead: Option<&SeenInstead>,
) -> Error {
    let of = match looked_at {
        0 => return Error::input("it has no frame in the chosen range"),
        1 => "the one picture".to_owned(),
        n if pictures => format!("any of {n} pictures"),
        n => format!("any of {n} frames"),
    };
    let why = mostly.map_or_else(String::new, |(reason, count)| {
        if count == looked_at { format!(" ({reason})") } else { format!(" (mostly: {reason})") }
    });
    if let Some(instead) = instead {
        return Error::input(format!(
            "the board {board} was not found in {of}{why}; {instead}: state that board, with the lengths of your print"
        ));
    }
    let check = match board.kind() {
        BoardKind::Chessboard => {
            "count its inner corners, one less than squares, and keep the whole board in the image"
        }
        BoardKind::Circles | BoardKind::AsymmetricCircles => {
            "count its discs again and keep the whole board in the image"
        }
        BoardKind::Charuco { .. } => "count its squares again and check the dictionary of its markers",
        _ => "count its tags again and check that they are of the family 36h11",
    };
    Error::input(format!("the board {board} was not found in {of}{why}; {check}"))
}
