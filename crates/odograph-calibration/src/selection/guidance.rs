//! Coverage of the image by the selected views, and guidance for the user.

use super::WeightedSighting;
use crate::Board;
use odograph::geometry::Pixel;
use std::fmt;

/// Coverage of the image by board points, in [`ViewCoverage::COLUMNS`] by [`ViewCoverage::ROWS`]
/// equal cells.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ViewCoverage {
    /// Number of points per cell in the selected views, in row-major order from the top left.
    pub points: Vec<usize>,
}

impl ViewCoverage {
    /// Number of cells along a row.
    pub const COLUMNS: usize = 9;
    /// Number of cells along a column.
    pub const ROWS: usize = 6;
    /// Total number of cells.
    pub const CELLS: usize = Self::COLUMNS * Self::ROWS;

    /// Share of cells with at least one point, 0 to 1.
    pub fn share(&self) -> f64 {
        self.points.iter().filter(|&&points| points > 0).count() as f64 / Self::CELLS as f64
    }

    /// The cells that contain the given pixels of an image of `size`, sorted and without
    /// duplicates.
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

/// A ninth of the image as `(column, row)`, each 0 to 2 from the top left. The text form is for
/// users: `the top left`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Region {
    /// 0 left, 1 centre, 2 right.
    pub column: usize,
    /// 0 top, 1 centre, 2 bottom.
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

/// Axis of a tilt of the board, in the camera's view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// The left or the right side is nearer to the camera.
    Sideways,
    /// The upper or the lower side is nearer to the camera.
    UpAndDown,
}

/// Advice that would improve the calibration. The text form is an imperative sentence without a
/// full stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Hint {
    /// The board is nearly parallel to the image plane in this direction in too many views, so
    /// focal length and distance are ambiguous.
    Tilt(Direction),
    /// This part of the image is not covered.
    GoTo(Region),
    /// The board is small in every view.
    ComeCloser,
    /// The distance of the board hardly varies.
    GoFurtherAway,
    /// The board was moving in most of the views.
    HoldStill,
    /// This many more distinct views are needed.
    MoreViews(usize),
}

impl fmt::Display for Hint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tilt(Direction::Sideways) => f.write_str("turn the board more to the left and right"),
            Self::Tilt(Direction::UpAndDown) => f.write_str("tilt the board more up and down"),
            Self::GoTo(region) => write!(f, "hold the board at {region} of the image"),
            Self::ComeCloser => f.write_str("come closer, until the board fills half of the image"),
            Self::GoFurtherAway => f.write_str("go further away"),
            Self::HoldStill => f.write_str("hold the board still for a moment at each place"),
            Self::MoreViews(1) => f.write_str("show the board at one more place"),
            Self::MoreViews(views) => write!(f, "show the board at {views} more places"),
        }
    }
}

/// What the selected views cover and what is missing.
#[derive(Debug, Clone, PartialEq)]
pub struct Guidance {
    /// Number of selected views.
    pub views: usize,
    /// Coverage of the image by the selected views.
    pub coverage: ViewCoverage,
    /// Advice, most important first; empty if nothing is missing.
    pub missing: Vec<Hint>,
}

/// Minimum number of views for a reliable calibration.
const MIN_VIEWS: usize = 12;
/// Minimum tilt, radians. Zhang (2000, section 5.1) finds 45° optimal and less than 5° useless.
const TILTED_RAD: f64 = 0.35;
/// Minimum number of tilted views for each axis.
const TILTED_VIEWS: usize = 3;
/// Minimum share of the image that the board must fill in at least one view.
const FILLED: f64 = 0.2;
/// Minimum ratio of the largest to the smallest distance of the board.
const DISTANCES: f64 = 1.25;
/// Speed from which a corner counts as moving, pixels per second; its position is then uncertain by
/// a fifth of a pixel.
const MOVES_PX_S: f64 = 100.0;

impl Guidance {
    pub(super) fn new(board: &Board, chosen: &[&WeightedSighting], focal_px: f64) -> Self {
        let mut points = vec![0; ViewCoverage::CELLS];
        for kept in chosen {
            for (_, pixel) in &kept.seen.points {
                points[ViewCoverage::cell_of(kept.seen.size, *pixel)] += 1;
            }
        }
        let coverage = ViewCoverage { points };
        let mut missing = tilts(chosen, focal_px);
        missing.extend(places(&coverage));
        missing.extend(distance(board, chosen, focal_px));
        if chosen.iter().filter(|kept| kept.speed_px_s > MOVES_PX_S).count() * 2 > chosen.len() {
            missing.push(Hint::HoldStill);
        }
        if chosen.len() < MIN_VIEWS {
            missing.push(Hint::MoreViews(MIN_VIEWS - chosen.len()));
        }
        Self { views: chosen.len(), coverage, missing }
    }
}

/// Focal length and distance are only distinguishable if the board is tilted against the image
/// plane.
fn tilts(chosen: &[&WeightedSighting], focal_px: f64) -> Vec<Hint> {
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

/// The ninths of the image with less than half of their cells covered, the emptiest first. Corners
/// win ties, because distortion is strongest there.
fn places(coverage: &ViewCoverage) -> Vec<Hint> {
    let (columns, rows) = (ViewCoverage::COLUMNS / 3, ViewCoverage::ROWS / 3);
    let mut poor: Vec<(usize, bool, Region)> = Vec::new();
    for row in 0..3 {
        for column in 0..3 {
            let seen = (0..columns * rows)
                .map(|cell| {
                    (row * rows + cell / columns) * ViewCoverage::COLUMNS + column * columns + cell % columns
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

fn distance(board: &Board, chosen: &[&WeightedSighting], focal_px: f64) -> Option<Hint> {
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
    // Distance to the middle of the board: the distance to its origin varies with the tilt.
    let middle =
        board.points().last().map(|last| nalgebra::Vector3::new(0.5 * last.x_m, 0.5 * last.y_m, 0.0))?;
    let (nearest, furthest) = chosen
        .iter()
        .filter_map(|kept| kept.seen.pose(focal_px))
        .map(|pose| (pose.camera_from_board * middle + pose.translation_m).z)
        .fold((f64::INFINITY, 0.0), |(near, far): (f64, f64), z| (near.min(z), far.max(z)));
    (furthest < DISTANCES * nearest).then_some(Hint::GoFurtherAway)
}
