//! Finding a board in an image.

mod aprilgrid;
mod blobs;
mod charuco;
mod chessboard;
mod circles;
mod disc;
mod lattice;
mod markers;
mod pattern_fit;
mod plane_map;
mod points;
mod response;
pub(crate) mod ring;
pub(crate) mod subpixel;
mod tagged;
#[cfg(test)]
mod tests;

use super::{Board, BoardKind, BoardView};
use crate::image::GrayImage;
use std::fmt;

/// Why no board was found. As text, one clause for people.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum NotFound {
    /// Nothing in the image looks like the corners of a chessboard.
    NoCorners,
    /// A whole chessboard of another size than the one looked for.
    OtherSize {
        /// Columns and rows of inner corners looked for.
        expected: (usize, usize),
        /// Columns and rows of inner corners in the image.
        seen: (usize, usize),
    },
    /// Some of a chessboard's or disc grid's points, or a smaller board.
    Partial {
        /// Columns and rows looked for.
        expected: (usize, usize),
        /// Columns and rows that the seen points span.
        seen: (usize, usize),
        /// How many points were seen.
        points: usize,
    },
    /// Nothing in the image looks like a grid of discs.
    NoDiscs,
    /// No marker of the board was read.
    NoMarkers,
    /// Fewer markers of the board than can be trusted.
    TooFewMarkers {
        /// How many were read and agree.
        found: usize,
        /// How many it takes.
        least: usize,
    },
    /// The markers read only in a mirror.
    Mirrored,
    /// The board is there, but its points cannot be had to a tenth of a pixel.
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
            Self::NoMarkers => f.write_str("no markers of the board"),
            Self::TooFewMarkers { found, least } => {
                write!(f, "only {found} of the board's markers, and it takes {least}")
            }
            Self::Mirrored => f.write_str("markers read mirrored: the image is mirrored"),
            Self::Blurred => f.write_str("the board is too blurred for exact points"),
        }
    }
}

/// Finds a [`Board`] in images: which of its points are seen, and where to a few hundredths of a pixel.
///
/// Holds what can be prepared once for a board. It never finds a board mirrored, and for the same image it gives the same view.
#[derive(Debug, Clone)]
pub struct BoardFinder {
    board: Board,
    /// The markers laid out, for boards that have them.
    tagged: Option<tagged::TaggedBoard>,
}

impl BoardFinder {
    /// A finder for a board.
    pub fn new(board: &Board) -> Self {
        let tagged = match board.kind() {
            BoardKind::Charuco { .. } => charuco::prepare(board),
            BoardKind::AprilGrid { .. } => aprilgrid::prepare(board),
            _ => None,
        };
        Self { board: *board, tagged }
    }

    /// The board that is looked for.
    pub fn board(&self) -> &Board {
        &self.board
    }

    /// The board's points in an image, sorted by their index, or why it was not found.
    ///
    /// Chessboards and disc grids are found whole or not at all; of boards with markers, parts are enough. A chessboard's first point is
    /// the one beside a black corner square, where only one corner square is black; where the board looks the same turned
    /// by 180°, it is the one that makes the rows run right and the columns down in the image as far as possible.
    ///
    /// Takes any image, and time in proportion to its size: 1920x1080 samples of noise take a tenth of a second or less.
    pub fn find(&self, image: &GrayImage) -> Result<BoardView, NotFound> {
        match self.board.kind() {
            BoardKind::Chessboard => chessboard::find(image, &self.board),
            BoardKind::Circles | BoardKind::AsymmetricCircles => circles::find(image, &self.board),
            _ => self.tagged.as_ref().ok_or(NotFound::NoMarkers)?.find(image),
        }
    }
}
