//! Detection of complete chessboards.
//!
//! The detection runs on the levels of an image pyramid. Most boards are detected at half the
//! resolution for a quarter of the cost. Boards with small squares need the full resolution,
//! blurred ones a lower one. The corners are always refined at full resolution.

use super::completion::complete;
use super::lattice::{Lattice, LatticeCorner, extent, lattices, nearest_edge};
use super::ring::{RING_PX, Ring};
use super::{NotFound, response, subpixel};
use crate::{Board, BoardView, SeenPoint};
use odograph::geometry::Pixel;
use odograph::image::{GrayImage, Pyramid};
use odograph::numerics::median;

/// Maximum number of corner candidates, in addition to eight times the corners of the board; noise
/// and texture produce any number.
const MAX_PEAKS: usize = 1500;
/// Images with a longer side of at least this many pixels are first searched at half the
/// resolution.
const LARGE_PX: usize = 800;
/// Maximum blur (standard deviation) for accurate corners, in pixels and as a share of the side of
/// a square. From about a quarter of the side on, the next corner affects the fit.
const MAX_BLUR_PX: f64 = 6.0;
const MAX_BLUR_OF_SIDE: f64 = 0.22;
/// Half window of the corner fit as a share of the distance to the nearest corner, and its maximum
/// in pixels, because lens distortion bends edges.
const WINDOW_OF_SIDE: f64 = 0.45;
const LARGEST_WINDOW_PX: f64 = 10.0;

/// Minimum number of corners for a statement about a board; smaller lattices occur by chance.
const MIN_PART: usize = 6;

/// Detects a complete chessboard.
pub(super) fn find(image: &GrayImage, board: &Board) -> Result<BoardView, NotFound> {
    let wanted = (board.columns(), board.rows());
    let pyramid = Pyramid::new(image.clone(), 4);
    let large = image.width().max(image.height()) >= LARGE_PX;
    let order: &[usize] = if large { &[1, 0, 2, 3] } else { &[0, 1, 2] };
    let mut best = NotFound::NoCorners;
    for &level in order.iter().filter(|&&level| level < pyramid.levels()) {
        let scale = f64::from(1u32 << level);
        match find_in_level(pyramid.level(level), wanted, scale) {
            Ok(corners) => {
                let pixels: Vec<Pixel> = corners
                    .iter()
                    .map(|corner| Pixel::new(corner.pixel.x * scale, corner.pixel.y * scale))
                    .collect();
                match refine(image, &pixels, wanted, scale) {
                    Ok(points) => {
                        let size = (image.width(), image.height());
                        return Ok(BoardView { size, points });
                    }
                    Err(why) => best = why,
                }
            }
            Err(why) => {
                if seen(&why) > seen(&best) {
                    best = why;
                }
            }
        }
    }
    Err(best)
}

/// Rank of a failure reason by the number of detected corners; the highest one is reported.
fn seen(why: &NotFound) -> usize {
    match *why {
        // Below the rank of a larger partial board that is sharp.
        NotFound::Blurred => MIN_PART,
        NotFound::OtherSize { seen, .. } => seen.0 * seen.1,
        NotFound::Partial { points, .. } => points,
        _ => 0,
    }
}

/// Chessboard corners of one level, strongest first, without duplicates.
pub(super) fn corners_of_squares(image: &GrayImage, most: usize) -> Vec<LatticeCorner> {
    let mut corners: Vec<LatticeCorner> = Vec::new();
    for peak in response::peaks(image, most) {
        let start = Pixel::new(f64::from(peak.x), f64::from(peak.y));
        let corner = Ring::read(image, start, RING_PX)
            .and_then(|_| subpixel::orthogonal_to_within(image, start, RING_PX, 0.05))
            .and_then(|pixel| Some(LatticeCorner { pixel, ring: Ring::read(image, pixel, RING_PX)? }));
        corners.extend(corner);
    }
    // Two response peaks may converge to the same corner.
    let mut by_row: Vec<usize> = (0..corners.len()).collect();
    by_row.sort_by(|&a, &b| corners[a].pixel.y.total_cmp(&corners[b].pixel.y).then(a.cmp(&b)));
    let mut twice = vec![false; corners.len()];
    for (at, &one) in by_row.iter().enumerate() {
        for &other in &by_row[at + 1..] {
            if corners[other].pixel.y - corners[one].pixel.y > 2.0 {
                break;
            }
            if corners[one].pixel.distance(corners[other].pixel) < 2.0 {
                twice[one.max(other)] = true;
            }
        }
    }
    let mut twice = twice.into_iter();
    corners.retain(|_| !twice.next().unwrap_or(false));
    corners
}

/// The corners of the board in the order of its points, detected on one pyramid level.
fn find_in_level(
    image: &GrayImage,
    wanted: (usize, usize),
    scale: f64,
) -> Result<Vec<LatticeCorner>, NotFound> {
    let corners = corners_of_squares(image, MAX_PEAKS + 8 * wanted.0 * wanted.1);
    let mut best = NotFound::NoCorners;
    for seen_lattice in lattices(image, &corners).into_iter().take(4) {
        let mut lattice = seen_lattice.clone();
        // A complete lattice is extended too: the visible board may be larger than the expected
        // one.
        complete(image, &mut lattice);
        if let Some(found) = whole_within(&lattice, wanted) {
            return Ok(in_order(&found, wanted));
        }
        // A lattice that is complete without extrapolation is the more reliable evidence of the
        // board's size.
        let lattice =
            if is_rectangle(&seen_lattice) { seen_lattice } else { without_stray_lines(lattice, wanted) };
        let spans = spans(&lattice);
        // Report the size in the orientation that is closer to the expected one.
        let as_said = spans.0.abs_diff(wanted.0) + spans.1.abs_diff(wanted.1)
            <= spans.1.abs_diff(wanted.0) + spans.0.abs_diff(wanted.1);
        let spans = if as_said { spans } else { (spans.1, spans.0) };
        if lattice.len() <= MIN_PART {
            continue;
        }
        let why = if is_lattice_blurred(image, &lattice, scale) {
            NotFound::Blurred
        } else if lattice.len() == spans.0 * spans.1 {
            NotFound::OtherSize { expected: wanted, seen: spans }
        } else {
            NotFound::Partial { expected: wanted, seen: spans, points: lattice.len() }
        };
        if seen(&why) > seen(&best) {
            best = why;
        }
    }
    Err(best)
}

/// Number of columns and rows spanned by a lattice.
fn spans(lattice: &Lattice) -> (usize, usize) {
    let ((left, right), (top, bottom)) = extent(lattice);
    ((right - left + 1) as usize, (bottom - top + 1) as usize)
}

/// Whether a lattice has no gaps.
fn is_rectangle(lattice: &Lattice) -> bool {
    let (width, height) = spans(lattice);
    lattice.len() == width * height
}

/// Whether a lattice has exactly the wanted size, in either orientation.
fn is_whole(lattice: &Lattice, wanted: (usize, usize)) -> bool {
    let spans = spans(lattice);
    is_rectangle(lattice) && (spans == wanted || spans == (wanted.1, wanted.0))
}

/// The lattice without sparse outer lines, if the result has exactly the wanted size.
fn whole_within(lattice: &Lattice, wanted: (usize, usize)) -> Option<Lattice> {
    let mut lattice = lattice.clone();
    while !is_whole(&lattice, wanted) {
        if lattice.len() <= wanted.0 * wanted.1 || !drop_stray_line(&mut lattice, 0.5) {
            return None;
        }
    }
    Some(lattice)
}

/// Removes sparse outer lines from a lattice. If the result does not have the wanted size,
/// incomplete outer lines are removed too, provided that most of the lattice remains.
fn without_stray_lines(mut lattice: Lattice, wanted: (usize, usize)) -> Lattice {
    while !is_rectangle(&lattice) && drop_stray_line(&mut lattice, 0.5) {}
    let spans = spans(&lattice);
    if spans == wanted || spans == (wanted.1, wanted.0) {
        return lattice;
    }
    let mut whole = lattice.clone();
    while !is_rectangle(&whole) && 4 * whole.len() > 3 * lattice.len() && drop_stray_line(&mut whole, 1.0) {}
    if is_rectangle(&whole) && 4 * whole.len() > 3 * lattice.len() { whole } else { lattice }
}

/// Removes the sparsest outer line if its share of present corners is at most `most`. Returns
/// whether a line was removed.
///
/// Shadows, frames and reflections produce corners in line with those of a board, but no complete
/// lines.
fn drop_stray_line(lattice: &mut Lattice, most: f64) -> bool {
    let ((left, right), (top, bottom)) = extent(lattice);
    let (width, height) = (f64::from(right - left + 1), f64::from(bottom - top + 1));
    let count = |on: &dyn Fn(&(i32, i32)) -> bool| lattice.keys().filter(|place| on(place)).count() as f64;
    let lines = [
        (count(&|place| place.0 == left) / height, true, left),
        (count(&|place| place.0 == right) / height, true, right),
        (count(&|place| place.1 == top) / width, false, top),
        (count(&|place| place.1 == bottom) / width, false, bottom),
    ];
    match lines.into_iter().min_by(|a, b| a.0.total_cmp(&b.0)) {
        Some((part, is_column, at)) if part <= most => {
            lattice.retain(|place, _| at != if is_column { place.0 } else { place.1 });
            true
        }
        _ => false,
    }
}

/// The corners of a complete lattice in the order of the board's points; see
/// [`super::BoardFinder::find`].
fn in_order(lattice: &Lattice, wanted: (usize, usize)) -> Vec<LatticeCorner> {
    let ((left, right), (top, bottom)) = extent(lattice);
    let (columns, rows) = (wanted.0 as i32, wanted.1 as i32);
    let spans = (right - left + 1, bottom - top + 1);
    // The four rotations of a grid: its first corner, and the steps along rows and columns.
    let turns = [
        ((left, top), (1, 0), (0, 1)),
        ((right, top), (0, 1), (-1, 0)),
        ((right, bottom), (-1, 0), (0, -1)),
        ((left, bottom), (0, -1), (1, 0)),
    ];
    let mut best: Option<(f64, Vec<LatticeCorner>)> = None;
    for (first, along, down) in turns {
        let fits = if along.1 == 0 { spans == (columns, rows) } else { spans == (rows, columns) };
        if !fits {
            continue;
        }
        let corners: Vec<LatticeCorner> = (0..rows)
            .flat_map(|row| (0..columns).map(move |column| (column, row)))
            .filter_map(|(column, row)| {
                let place =
                    (first.0 + column * along.0 + row * down.0, first.1 + column * along.1 + row * down.1);
                lattice.get(&place).copied()
            })
            .collect();
        if corners.len() != (columns * rows) as usize {
            continue;
        }
        let (origin, right, below) = (
            &corners[0],
            corners[columns as usize - 1].pixel,
            corners[corners.len() - columns as usize].pixel,
        );
        let step = |to: Pixel| (to.x - origin.pixel.x, to.y - origin.pixel.y);
        // The outer square at the first corner is opposite to the one between the edges along the
        // first row and the first column.
        let next = corners[1].pixel;
        let direction = (next.y - origin.pixel.y).atan2(next.x - origin.pixel.x);
        let black = !origin.ring.white_after(nearest_edge(&origin.ring, direction).0);
        let upright = {
            let (row, column) = (step(right), step(below));
            row.0 / row.0.hypot(row.1).max(1e-9) + column.1 / column.0.hypot(column.1).max(1e-9)
        };
        // A black corner square takes precedence over the orientation, whose rank is at most 2.
        let rank = if black { 10.0 + upright } else { upright };
        if best.as_ref().is_none_or(|(found, _)| rank > *found) {
            best = Some((rank, corners));
        }
    }
    best.map(|(_, corners)| corners).unwrap_or_default()
}

/// Refines every corner at full resolution; `scale` is the pixel size of the pyramid level on which
/// the corners were detected.
fn refine(
    image: &GrayImage,
    corners: &[Pixel],
    (columns, rows): (usize, usize),
    scale: f64,
) -> Result<Vec<SeenPoint>, NotFound> {
    let mut points = Vec::with_capacity(corners.len());
    let mut blurs: Vec<(f64, f64)> = Vec::with_capacity(corners.len());
    for (index, &corner) in corners.iter().enumerate() {
        let (column, row) = (index % columns, index / columns);
        let mut side = f64::MAX;
        let mut beside = |there: usize| side = side.min(corner.distance(corners[there]));
        if column > 0 {
            beside(index - 1);
        }
        if column + 1 < columns {
            beside(index + 1);
        }
        if row > 0 {
            beside(index - columns);
        }
        if row + 1 < rows {
            beside(index + columns);
        }
        let window = (WINDOW_OF_SIDE * side).clamp(2.5, LARGEST_WINDOW_PX.max(3.0 * scale));
        // The blur of the previous corner is a good initial value.
        let blur_px = blurs.last().map_or(subpixel::USUAL_BLUR_PX, |blur| blur.0);
        let saddle = subpixel::fit_from(image, corner, window, blur_px).ok_or(NotFound::Blurred)?;
        if saddle.pixel.distance(corner) > 0.3 * side {
            return Err(NotFound::Blurred);
        }
        blurs.push((saddle.blur_px, saddle.blur_px / side));
        points.push(SeenPoint { index, pixel: saddle.pixel });
    }
    if is_blurred(&blurs) {
        return Err(NotFound::Blurred);
    }
    Ok(points)
}

/// Whether the median blur of the corners is too large, in pixels at full resolution or as a share
/// of the side of a square.
fn is_blurred(blurs: &[(f64, f64)]) -> bool {
    let middle = |value: fn(&(f64, f64)) -> f64| {
        let mut values: Vec<f64> = blurs.iter().map(value).collect();
        median(&mut values).unwrap_or(0.0)
    };
    middle(|blur| blur.0) > MAX_BLUR_PX || middle(|blur| blur.1) > MAX_BLUR_OF_SIDE
}

/// Whether the corners of a partial board, detected on a pyramid level, are too blurred.
fn is_lattice_blurred(image: &GrayImage, lattice: &Lattice, scale: f64) -> bool {
    let blurs: Vec<(f64, f64)> = lattice
        .iter()
        .filter_map(|(&(i, j), corner)| {
            let next = lattice.get(&(i + 1, j)).or_else(|| lattice.get(&(i - 1, j)))?;
            let side = corner.pixel.distance(next.pixel);
            let window = (WINDOW_OF_SIDE * side).clamp(2.5, LARGEST_WINDOW_PX);
            // A failed fit counts as infinite blur.
            let blur_px = subpixel::fit(image, corner.pixel, window).map_or(f64::INFINITY, |fit| fit.blur_px);
            Some((blur_px * scale, blur_px / side))
        })
        .collect();
    is_blurred(&blurs)
}
