//! What has been seen of the lens, and what a person should show next.

use super::Kept;
use crate::calibration::Board;
use crate::geometry::Pixel;
use std::fmt;

/// Which cells of the image have seen the board: [`Coverage::COLUMNS`] by [`Coverage::ROWS`] equal cells.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Coverage {
    /// How many points each cell has seen in the chosen views, row after row from the top left.
    pub points: Vec<usize>,
}

impl Coverage {
    /// Cells side by side.
    pub const COLUMNS: usize = 9;
    /// Cells one above the other.
    pub const ROWS: usize = 6;
    /// All of them.
    pub const CELLS: usize = Self::COLUMNS * Self::ROWS;

    /// The share of the image's cells that have seen a point, 0 to 1.
    pub fn share(&self) -> f64 {
        self.points.iter().filter(|&&points| points > 0).count() as f64 / Self::CELLS as f64
    }

    /// The cells, without repetition and in order, in which the pixels of an image of the given size lie.
    pub(super) fn cells_of(size: (usize, usize), pixels: impl Iterator<Item = Pixel>) -> Vec<usize> {
        let mut cells: Vec<usize> = pixels.map(|pixel| Self::cell_of(size, pixel)).collect();
        cells.sort_unstable();
        cells.dedup();
        cells
    }

    fn cell_of(size: (usize, usize), pixel: Pixel) -> usize {
        let along = |at: f64, length: usize, cells: usize| {
            let cell = (at + 0.5) / length as f64 * cells as f64;
            (cell.max(0.0) as usize).min(cells - 1)
        };
        along(pixel.y, size.1, Self::ROWS) * Self::COLUMNS + along(pixel.x, size.0, Self::COLUMNS)
    }
}

/// A ninth of the image: `(column, row)`, each 0 to 2 from the top left. Its text is for people: `the top left`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Region {
    /// 0 left, 1 middle, 2 right.
    pub column: usize,
    /// 0 top, 1 middle, 2 bottom.
    pub row: usize,
}

impl fmt::Display for Region {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match (self.row, self.column) {
            (0, 0) => "the top left",
            (0, 1) => "the top",
            (0, _) => "the top right",
            (1, 0) => "the left",
            (1, 1) => "the middle",
            (1, _) => "the right",
            (_, 0) => "the bottom left",
            (_, 1) => "the bottom",
            _ => "the bottom right",
        })
    }
}

/// A way to tilt the board, as the camera sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// The left or the right side comes nearer.
    Sideways,
    /// The upper or the lower side comes nearer.
    UpAndDown,
}

/// One thing that would make the calibration better. Its text is an imperative sentence without its full stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Hint {
    /// The board is always parallel to the image in this direction: focal length and distance cannot be told apart.
    Tilt(Direction),
    /// This part of the image has not seen the board.
    GoTo(Region),
    /// The board is small in every view.
    ComeCloser,
    /// The board is always at the same distance.
    GoFurtherAway,
    /// The board moved in most of the views.
    HoldStill,
    /// So many different views are still wanted.
    MoreViews(usize),
}

impl fmt::Display for Hint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tilt(Direction::Sideways) => f.write_str("turn the board more to the left and right"),
            Self::Tilt(Direction::UpAndDown) => f.write_str("tilt the board more up and down"),
            Self::GoTo(region) => write!(f, "go to {region} of the image"),
            Self::ComeCloser => f.write_str("come closer, until the board fills half of the image"),
            Self::GoFurtherAway => f.write_str("go further away"),
            Self::HoldStill => f.write_str("hold the board still for a moment at each place"),
            Self::MoreViews(1) => f.write_str("show the board at one more place"),
            Self::MoreViews(views) => write!(f, "show the board at {views} more places"),
        }
    }
}

/// What the chosen views show of the lens, and what is missing.
#[derive(Debug, Clone, PartialEq)]
pub struct Guidance {
    /// How many views are chosen.
    pub views: usize,
    /// Where in the image the board was seen.
    pub coverage: Coverage,
    /// What to do next, most important first; empty where nothing is missing.
    pub missing: Vec<Hint>,
}

/// With fewer views no calibration is to be trusted.
const LEAST_VIEWS: usize = 12;
/// The board is tilted from here on, radians. Zhang (2000, section 5.1) finds 45° best and less than 5° useless.
const TILTED_RAD: f64 = 0.35;
/// So many views must be tilted in each direction.
const TILTED_VIEWS: usize = 3;
/// In one view at least the board must fill this share of the image …
const FILLED: f64 = 0.2;
/// … and its distance must vary by this factor.
const DISTANCES: f64 = 1.25;
/// A corner moves when it is this fast, pixels a second: then its position is unsure by a fifth of a pixel.
const MOVES_PX_S: f64 = 100.0;

impl Guidance {
    pub(super) fn new(board: &Board, chosen: &[&Kept], focal_px: f64) -> Self {
        let mut points = vec![0; Coverage::CELLS];
        for kept in chosen {
            for (_, pixel) in &kept.seen.points {
                points[Coverage::cell_of(kept.seen.size, *pixel)] += 1;
            }
        }
        let coverage = Coverage { points };
        let mut missing = tilts(chosen, focal_px);
        missing.extend(places(&coverage));
        missing.extend(distance(board, chosen, focal_px));
        if chosen.iter().filter(|kept| kept.speed_px_s > MOVES_PX_S).count() * 2 > chosen.len() {
            missing.push(Hint::HoldStill);
        }
        if chosen.len() < LEAST_VIEWS {
            missing.push(Hint::MoreViews(LEAST_VIEWS - chosen.len()));
        }
        Self { views: chosen.len(), coverage, missing }
    }
}

/// Focal length and distance are told apart only by boards that are not parallel to the image.
fn tilts(chosen: &[&Kept], focal_px: f64) -> Vec<Hint> {
    let normals: Vec<_> = chosen.iter().filter_map(|kept| Some(kept.seen.pose(focal_px)?.normal())).collect();
    let few = |tilted: &dyn Fn(&nalgebra::Vector3<f64>) -> f64| {
        normals.iter().filter(|normal| tilted(normal).abs() > TILTED_RAD).count() < TILTED_VIEWS
    };
    let mut missing = Vec::new();
    if few(&|normal| normal.x.atan2(normal.z)) {
        missing.push(Hint::Tilt(Direction::Sideways));
    }
    if few(&|normal| normal.y.atan2(normal.z)) {
        missing.push(Hint::Tilt(Direction::UpAndDown));
    }
    missing
}

/// The ninths of the image of which less than half was seen, the emptiest first and of equals the corners: there distortion is
/// strongest.
fn places(coverage: &Coverage) -> Vec<Hint> {
    let (columns, rows) = (Coverage::COLUMNS / 3, Coverage::ROWS / 3);
    let mut poor: Vec<(usize, bool, Region)> = Vec::new();
    for row in 0..3 {
        for column in 0..3 {
            let seen = (0..columns * rows)
                .map(|cell| {
                    (row * rows + cell / columns) * Coverage::COLUMNS + column * columns + cell % columns
                })
                .filter(|&cell| coverage.points[cell] > 0)
                .count();
            if 2 * seen < columns * rows {
                poor.push((seen, row == 1 || column == 1, Region { column, row }));
            }
        }
    }
    poor.sort_by_key(|&(seen, no_corner, _)| (seen, no_corner));
    poor.into_iter().map(|(_, _, region)| Hint::GoTo(region)).collect()
}

fn distance(board: &Board, chosen: &[&Kept], focal_px: f64) -> Option<Hint> {
    let filled = chosen.iter().map(|kept| {
        let (width, height) = kept.seen.size;
        let pixels = || kept.seen.points.iter().map(|(_, pixel)| pixel);
        let span = |at: fn(&Pixel) -> f64| {
            pixels().map(at).fold(f64::NEG_INFINITY, f64::max)
                - pixels().map(at).fold(f64::INFINITY, f64::min)
        };
        span(|pixel| pixel.x) * span(|pixel| pixel.y) / (width * height) as f64
    });
    if filled.fold(0.0, f64::max) < FILLED {
        return Some(Hint::ComeCloser);
    }
    // To the middle of the board: its origin comes and goes as it is tilted.
    let middle =
        board.points().last().map(|last| nalgebra::Vector3::new(0.5 * last.x_m, 0.5 * last.y_m, 0.0))?;
    let (nearest, furthest) = chosen
        .iter()
        .filter_map(|kept| kept.seen.pose(focal_px))
        .map(|pose| (pose.camera_from_board * middle + pose.translation_m).z)
        .fold((f64::INFINITY, 0.0), |(near, far): (f64, f64), z| (near.min(z), far.max(z)));
    (furthest < DISTANCES * nearest).then_some(Hint::GoFurtherAway)
}
