//! Calibration boards and the positions of their points.

use odograph::error::{Error, Result};
use odograph::geometry::Pixel;
use std::fmt;
use std::str::FromStr;

/// A flat calibration board with points at known positions.
///
/// The board frame has its origin at the first point, x along the rows, y down the columns as
/// printed, and z into the paper (right-handed). All points have z = 0. This is the frame of
/// OpenCV's `objectPoints` for the same board.
///
/// The text form is a kind, a count and lengths with units:
///
/// * `chessboard:9x6:25mm`: inner corners, side of a square.
/// * `charuco:8x11:20mm`: squares, side of a square. Optionally the side of a marker (default 0.75
///   of the square) and the dictionary follow: `charuco:8x11:20mm:15mm:4x4_50`.
/// * `aprilgrid:6x6:88mm:26.4mm`: tags, side of a tag, gap between tags (default 0.3 of the side).
///   This is Kalibr's target.
/// * `circles:7x5:20mm` and `asymmetric-circles:4x11:20mm`: OpenCV's circle grids. The length is
///   the distance between neighbouring centres in a row; for the asymmetric grid it is half of that
///   distance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Board {
    kind: BoardKind,
    columns: usize,
    rows: usize,
    spacing_m: f64,
}

/// The pattern printed on a board, with the lengths specific to it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum BoardKind {
    /// A chessboard, counted in inner corners. The spacing is the side of a square. It is only
    /// detected as a whole.
    Chessboard,
    /// A chessboard with an ArUco marker in each white square (OpenCV's `CharucoBoard`), counted in
    /// squares. The spacing is the side of a square. Partial views are usable.
    Charuco {
        /// Side of a marker, metres; less than the side of a square.
        marker_m: f64,
        /// The marker dictionary.
        dictionary: Dictionary,
    },
    /// Kalibr's grid of AprilTags (36h11) with small black squares at the tag corners, counted in
    /// tags. The spacing is the period of the grid: side of a tag plus gap. Partial views are
    /// usable.
    AprilGrid {
        /// Side of a tag's black border, metres.
        tag_m: f64,
    },
    /// A rectangular grid of black discs. The spacing is the distance between neighbouring centres.
    Circles,
    /// OpenCV's asymmetric circle grid: every second row is shifted by one spacing. A row has
    /// `columns` discs two spacings apart.
    AsymmetricCircles,
}

/// A dictionary of square fiducial markers, named as in OpenCV without the prefix `DICT_`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Dictionary {
    /// 50 markers of 4x4 bits.
    Aruco4x4_50,
    /// 100 markers of 4x4 bits.
    Aruco4x4_100,
    /// 250 markers of 4x4 bits.
    Aruco4x4_250,
    /// 50 markers of 5x5 bits.
    Aruco5x5_50,
    /// 100 markers of 5x5 bits.
    Aruco5x5_100,
    /// 250 markers of 5x5 bits.
    Aruco5x5_250,
    /// 50 markers of 6x6 bits.
    Aruco6x6_50,
    /// 250 markers of 6x6 bits.
    Aruco6x6_250,
    /// 587 AprilTags of 6x6 bits.
    AprilTag36h11,
}

impl Dictionary {
    /// All dictionaries with their names.
    pub const NAMED: [(&'static str, Self); 9] = [
        ("4x4_50", Self::Aruco4x4_50),
        ("4x4_100", Self::Aruco4x4_100),
        ("4x4_250", Self::Aruco4x4_250),
        ("5x5_50", Self::Aruco5x5_50),
        ("5x5_100", Self::Aruco5x5_100),
        ("5x5_250", Self::Aruco5x5_250),
        ("6x6_50", Self::Aruco6x6_50),
        ("6x6_250", Self::Aruco6x6_250),
        ("apriltag_36h11", Self::AprilTag36h11),
    ];

    /// Number of markers in the dictionary.
    pub fn markers(self) -> usize {
        match self {
            Self::Aruco4x4_50 | Self::Aruco5x5_50 | Self::Aruco6x6_50 => 50,
            Self::Aruco4x4_100 | Self::Aruco5x5_100 => 100,
            Self::Aruco4x4_250 | Self::Aruco5x5_250 | Self::Aruco6x6_250 => 250,
            Self::AprilTag36h11 => 587,
        }
    }

    /// The name used in the text form of a [`Board`].
    pub fn name(self) -> &'static str {
        Self::NAMED.iter().find(|(_, dictionary)| *dictionary == self).map_or("", |(name, _)| name)
    }
}

/// A point on a board, in the board frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoardPoint {
    /// Coordinate along the rows, metres.
    pub x_m: f64,
    /// Coordinate down the columns, metres.
    pub y_m: f64,
}

/// A board point detected in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenPoint {
    /// Index into [`Board::points`].
    pub index: usize,
    /// Detected position in the image, pixels, without correction of the lens distortion.
    pub pixel: Pixel,
}

/// The board points detected in one image, sorted by index and without duplicates.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardView {
    /// Width and height of the image, pixels.
    pub size: (usize, usize),
    /// The detected points.
    pub points: Vec<SeenPoint>,
}

/// Limits of a valid board: longest side (metres), largest count along a side, smallest spacing
/// (metres).
const LARGEST_M: f64 = 20.0;
const MAX_ALONG_A_SIDE: usize = 200;
const MIN_SPACING_M: f64 = 1e-4;

impl Board {
    /// A board with `columns` by `rows` elements (inner corners, squares, tags or discs, depending
    /// on the kind) and the spacing defined by the kind, metres.
    ///
    /// Fails if a count or a length is out of range, if a marker does not fit its square, or if the
    /// dictionary has too few markers.
    pub fn new(kind: BoardKind, columns: usize, rows: usize, spacing_m: f64) -> Result<Self> {
        let board = Self { kind, columns, rows, spacing_m };
        let least = match kind {
            BoardKind::Charuco { .. } => 3,
            BoardKind::AprilGrid { .. } => 1,
            _ => 2,
        };
        if !(least..=MAX_ALONG_A_SIDE).contains(&columns) || !(least..=MAX_ALONG_A_SIDE).contains(&rows) {
            return Err(Error::usage(format!(
                "a board of {columns}x{rows} is not usable; each count must be {least} to {MAX_ALONG_A_SIDE}"
            )));
        }
        if !spacing_m.is_finite() || spacing_m < MIN_SPACING_M {
            return Err(Error::usage(format!(
                "a spacing of {spacing_m} m is not usable; it must be a positive length such as 25mm"
            )));
        }
        if spacing_m * columns.max(rows) as f64 > LARGEST_M {
            return Err(Error::usage(format!(
                "a board of {columns}x{rows} with a spacing of {spacing_m} m would be longer than {LARGEST_M} m; lengths are \
                 written with their unit, such as 25mm"
            )));
        }
        match kind {
            BoardKind::Charuco { marker_m, .. } if !(marker_m > 0.0 && marker_m < spacing_m) => {
                return Err(Error::usage(format!(
                    "a marker of {} mm does not fit a square of {} mm",
                    marker_m * 1e3,
                    spacing_m * 1e3
                )));
            }
            BoardKind::AprilGrid { tag_m } if !(tag_m > 0.0 && tag_m < spacing_m) => {
                return Err(Error::usage("an AprilGrid needs a tag and a gap of more than 0 mm"));
            }
            _ => {}
        }
        if let Some((dictionary, markers)) = board.dictionary_and_markers()
            && markers > dictionary.markers()
        {
            return Err(Error::usage(format!(
                "a board of {columns}x{rows} needs {markers} markers but {} has {}; take a larger dictionary",
                dictionary.name(),
                dictionary.markers()
            )));
        }
        Ok(board)
    }

    /// The printed pattern.
    pub fn kind(&self) -> BoardKind {
        self.kind
    }

    /// Number of columns, in the elements that the kind counts.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Number of rows, in the elements that the kind counts.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// The spacing as defined by the kind, metres.
    pub fn spacing_m(&self) -> f64 {
        self.spacing_m
    }

    /// The marker dictionary and the number of markers on the board; `None` for boards without
    /// markers.
    pub fn dictionary_and_markers(&self) -> Option<(Dictionary, usize)> {
        let (columns, rows) = (self.columns, self.rows);
        match self.kind {
            BoardKind::Charuco { dictionary, .. } => Some((dictionary, columns * rows / 2)),
            BoardKind::AprilGrid { .. } => Some((Dictionary::AprilTag36h11, columns * rows)),
            _ => None,
        }
    }

    /// Columns and rows of the point grid.
    ///
    /// The points are the inner corners of a chessboard or ChArUco board, the disc centres of a
    /// circle grid, or the tag corners of an AprilGrid (two columns and two rows per tag).
    pub fn grid(&self) -> (usize, usize) {
        match self.kind {
            BoardKind::Charuco { .. } => (self.columns - 1, self.rows - 1),
            BoardKind::AprilGrid { .. } => (2 * self.columns, 2 * self.rows),
            _ => (self.columns, self.rows),
        }
    }

    /// All points in row-major order of the [`Board::grid`]; [`SeenPoint::index`] refers to this
    /// order.
    ///
    /// The corners of the AprilGrid tag in column i and row j, counted from the top left as
    /// printed, are the grid points (2i, 2j) to (2i + 1, 2j + 1). Kalibr numbers its tags from the
    /// bottom left; the number of that tag is `(rows - 1 - j) * columns + i`.
    pub fn points(&self) -> Vec<BoardPoint> {
        let (columns, rows) = self.grid();
        let at = |column: usize, row: usize| {
            let (x, y) = (column as f64, row as f64);
            let (x_m, y_m) = match self.kind {
                BoardKind::AprilGrid { tag_m } => {
                    let place = |n: usize| (n / 2) as f64 * self.spacing_m + (n % 2) as f64 * tag_m;
                    (place(column), place(row))
                }
                BoardKind::AsymmetricCircles => {
                    ((2.0 * x + (row % 2) as f64) * self.spacing_m, y * self.spacing_m)
                }
                _ => (x * self.spacing_m, y * self.spacing_m),
            };
            BoardPoint { x_m, y_m }
        };
        (0..rows).flat_map(|row| (0..columns).map(move |column| at(column, row))).collect()
    }

    /// Whether the points can be identified in a partial view of the board.
    pub fn may_be_partial(&self) -> bool {
        matches!(self.kind, BoardKind::Charuco { .. } | BoardKind::AprilGrid { .. })
    }
}

/// Parses a length with its unit, such as `25mm`, `2.5cm` or `0.025m`; returns metres.
pub(crate) fn length_m(text: &str) -> Result<f64> {
    let units = [("mm", 1e-3), ("cm", 1e-2), ("in", 0.0254), ("m", 1.0)];
    let (number, unit_m) =
        units.iter().find_map(|(unit, m)| Some((text.strip_suffix(unit)?, m))).ok_or_else(|| {
            Error::usage(format!(
                "`{text}` is not a length with its unit; write it like 25mm, 2.5cm or 0.025m"
            ))
        })?;
    match number.trim().parse::<f64>() {
        Ok(number) if number.is_finite() && number > 0.0 => Ok(number * unit_m),
        _ => Err(Error::usage(format!("`{text}` is not a positive length; write it like 25mm"))),
    }
}

impl FromStr for Board {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let refuse = |why: String| {
            Error::usage(format!(
                "board `{text}`: {why}; write it like chessboard:9x6:25mm, charuco:8x11:20mm or aprilgrid:6x6:88mm"
            ))
        };
        let mut parts = text.trim().split(':');
        let (name, count, length) = match (parts.next(), parts.next(), parts.next()) {
            (Some(name), Some(count), Some(length)) => (name, count, length),
            _ => return Err(refuse("it needs a kind, a count and a length".to_owned())),
        };
        let more: Vec<&str> = parts.collect();
        let (columns, rows) = count
            .split_once('x')
            .and_then(|(columns, rows)| Some((columns.parse().ok()?, rows.parse().ok()?)))
            .ok_or_else(|| refuse(format!("`{count}` is not a count such as 9x6")))?;
        let at = |error: Error| error.at(format!("board `{text}`"));
        let length_m_here = |text: &str| length_m(text).map_err(at);
        let spacing_m = length_m_here(length)?;
        let (kind, spacing_m, known) = match name {
            "chessboard" => (BoardKind::Chessboard, spacing_m, 0),
            "circles" => (BoardKind::Circles, spacing_m, 0),
            "asymmetric-circles" => (BoardKind::AsymmetricCircles, spacing_m, 0),
            "charuco" => {
                let marker_m = more.first().map_or(Ok(0.75 * spacing_m), |text| length_m_here(text))?;
                let dictionary = match more.get(1) {
                    None => smallest_dictionary(columns, rows),
                    Some(wanted) => Dictionary::NAMED
                        .iter()
                        .find(|(name, _)| name.eq_ignore_ascii_case(wanted))
                        .map(|(_, dictionary)| *dictionary)
                        .ok_or_else(|| {
                            let names = Dictionary::NAMED.map(|(name, _)| name).join(", ");
                            refuse(format!("there is no dictionary `{wanted}` (there are {names})"))
                        })?,
                };
                (BoardKind::Charuco { marker_m, dictionary }, spacing_m, 2)
            }
            "aprilgrid" => {
                let gap_m = more.first().map_or(Ok(0.3 * spacing_m), |text| length_m_here(text))?;
                (BoardKind::AprilGrid { tag_m: spacing_m }, spacing_m + gap_m, 1)
            }
            _ => return Err(refuse(format!("there is no kind `{name}`"))),
        };
        if more.len() > known {
            return Err(refuse(format!("`{}` is too much", more[known..].join(":"))));
        }
        Self::new(kind, columns, rows, spacing_m).map_err(at)
    }
}

/// The smallest 4x4 dictionary with enough markers for a ChArUco board of this size.
fn smallest_dictionary(columns: usize, rows: usize) -> Dictionary {
    match columns.saturating_mul(rows) / 2 {
        0..=50 => Dictionary::Aruco4x4_50,
        51..=100 => Dictionary::Aruco4x4_100,
        _ => Dictionary::Aruco4x4_250,
    }
}

impl fmt::Display for Board {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Rounding to a thousandth of a millimetre, finer than any printer, prints 26.4 instead of
        // 26.400000000000002.
        let mm = |length_m: f64| format!("{}mm", (length_m * 1e6).round() / 1e3);
        let Self { columns, rows, spacing_m, .. } = *self;
        match self.kind {
            BoardKind::Chessboard => write!(f, "chessboard:{columns}x{rows}:{}", mm(spacing_m)),
            BoardKind::Circles => write!(f, "circles:{columns}x{rows}:{}", mm(spacing_m)),
            BoardKind::AsymmetricCircles => {
                write!(f, "asymmetric-circles:{columns}x{rows}:{}", mm(spacing_m))
            }
            BoardKind::Charuco { marker_m, dictionary } => {
                write!(f, "charuco:{columns}x{rows}:{}:{}:{}", mm(spacing_m), mm(marker_m), dictionary.name())
            }
            BoardKind::AprilGrid { tag_m } => {
                write!(f, "aprilgrid:{columns}x{rows}:{}:{}", mm(tag_m), mm(spacing_m - tag_m))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_form_round_trips() {
        for text in [
            "chessboard:9x6:25mm",
            "charuco:8x11:20mm",
            "charuco:8x11:20mm:14mm:5x5_100",
            "aprilgrid:6x6:88mm",
            "aprilgrid:6x6:88mm:26.4mm",
            "circles:7x5:2cm",
            "asymmetric-circles:4x11:0.02m",
        ] {
            let board: Board = text.parse().unwrap();
            let again: Board = board.to_string().parse().unwrap();
            assert_eq!(board.to_string(), again.to_string());
            assert_eq!(board.points().len(), board.grid().0 * board.grid().1);
        }
        assert_eq!(
            "charuco:8x11:20mm".parse::<Board>().unwrap().to_string(),
            "charuco:8x11:20mm:15mm:4x4_50"
        );
    }

    #[test]
    fn points_match_opencv_and_kalibr() {
        let chessboard: Board = "chessboard:9x6:25mm".parse().unwrap();
        assert_eq!(chessboard.points()[10], BoardPoint { x_m: 0.025, y_m: 0.025 });
        let grid: Board = "aprilgrid:6x5:80mm:20mm".parse().unwrap();
        let points = grid.points();
        assert!((points[3].x_m - 0.18).abs() < 1e-12 && points[3].y_m == 0.0);
        let discs: Board = "asymmetric-circles:4x11:10mm".parse().unwrap();
        assert_eq!(discs.points()[5], BoardPoint { x_m: 0.03, y_m: 0.01 });
    }

    #[test]
    fn invalid_text_is_rejected_with_a_reason() {
        for (text, reason) in [
            ("chessboard:9x6", "needs a kind, a count and a length"),
            ("chessboard:9x6:25", "not a length with its unit"),
            ("chessboard:9x6:-25mm", "not a positive length"),
            ("chessboard:9:25mm", "not a count"),
            ("chessboard:1x6:25mm", "each count must be 2 to 200"),
            ("chessboard:9x6:25m", "longer than 20 m"),
            ("checkers:9x6:25mm", "no kind `checkers`"),
            ("charuco:8x11:20mm:25mm", "does not fit a square"),
            ("charuco:8x11:20mm:15mm:7x7", "no dictionary `7x7`"),
            ("charuco:80x11:20mm:15mm:4x4_50", "needs 440 markers"),
            ("aprilgrid:60x60:10mm", "needs 3600 markers"),
            ("chessboard:9x6:25mm:3", "`3` is too much"),
        ] {
            let error = text.parse::<Board>().unwrap_err().to_string();
            assert!(error.contains(reason), "{text}: {error}");
        }
    }
}
