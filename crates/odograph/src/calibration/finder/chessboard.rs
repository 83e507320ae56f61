//! Whole chessboards.
//!
//! From coarse to fine and back: most boards are found in the image of half the size, at a quarter of the cost; boards of small squares
//! need the full image, blurred ones a smaller one. Whatever the level, the corners are then fitted in the full image.

use super::lattice::{Corner, Lattice, edge_between, extent, lattices, nearest_edge};
use super::ring::Ring;
use super::{NotFound, response, subpixel};
use crate::calibration::{Board, BoardView, SeenPoint};
use crate::geometry::Pixel;
use crate::image::{GrayImage, Pyramid};

/// More corners than this, and as many again as the board has eightfold, are not looked at: noise and gravel have any number.
const MOST_PEAKS: usize = 1500;
/// Radius of the circle on which a corner's edges are read, pixels of the level.
const RING_PX: f64 = 4.0;
/// From this many pixels along its longer side, an image is first tried at half its size.
const LARGE_PX: usize = 800;
/// Blur, in standard deviations, that makes corners too uncertain: pixels, and part of a square's side. Within a quarter of the side, what
/// is beyond the next corner is seen as well.
const MOST_BLUR_PX: f64 = 6.0;
const MOST_BLUR_OF_SIDE: f64 = 0.22;
/// Half the window of the fit: part of the distance to the nearest corner, and at most so many pixels, for lenses bend edges.
const WINDOW_OF_SIDE: f64 = 0.45;
const LARGEST_WINDOW_PX: f64 = 12.0;

/// Finds a whole chessboard.
pub(super) fn find(image: &GrayImage, board: &Board) -> Result<BoardView, NotFound> {
    let wanted = (board.columns(), board.rows());
    let pyramid = Pyramid::new(image.clone(), 4);
    let levels = pyramid.levels();
    let large = image.width().max(image.height()) >= LARGE_PX;
    let order: &[usize] = if large { &[1, 0, 2, 3] } else { &[0, 1, 2] };
    let mut best = NotFound::NoCorners;
    for &level in order.iter().filter(|&&level| level < levels.len()) {
        match find_in_level(&levels[level], wanted) {
            Ok(corners) => {
                let scale = f64::from(1u32 << level);
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

/// How much of a board a reason tells of: the one that tells most is the one to be told.
fn seen(why: &NotFound) -> usize {
    match *why {
        NotFound::Blurred => usize::MAX,
        NotFound::OtherSize { seen, .. } => seen.0 * seen.1,
        NotFound::Partial { points, .. } => points,
        _ => 0,
    }
}

/// The corners of one level that look like corners of squares, strongest first, each once.
pub(super) fn corners_of_squares(image: &GrayImage, most: usize) -> Vec<Corner> {
    let mut corners: Vec<Corner> = Vec::new();
    for peak in response::peaks(image, most) {
        let start = Pixel::new(f64::from(peak.x), f64::from(peak.y));
        let corner = Ring::read(image, start, RING_PX)
            .and_then(|_| subpixel::orthogonal(image, start, RING_PX))
            .and_then(|pixel| Some(Corner { pixel, ring: Ring::read(image, pixel, RING_PX)? }));
        let Some(corner) = corner else { continue };
        corners.push(corner);
    }
    // Two peaks may have come to the same corner.
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

/// The board's corners in the order of its points, found in one level of the pyramid.
fn find_in_level(image: &GrayImage, wanted: (usize, usize)) -> Result<Vec<Corner>, NotFound> {
    let corners = corners_of_squares(image, MOST_PEAKS + 8 * wanted.0 * wanted.1);
    let mut best = NotFound::NoCorners;
    for mut lattice in lattices(image, &corners).into_iter().take(4) {
        if !is_whole(&lattice, wanted) {
            complete(image, &mut lattice);
        }
        if let Some(found) = whole_within(&lattice, wanted) {
            return Ok(in_order(&found, wanted));
        }
        let ((left, right), (top, bottom)) = extent(&lattice);
        let spans = ((right - left + 1) as usize, (bottom - top + 1) as usize);
        // Named the way round that is nearer to what was said.
        let as_said = spans.0.abs_diff(wanted.0) + spans.1.abs_diff(wanted.1)
            <= spans.1.abs_diff(wanted.0) + spans.0.abs_diff(wanted.1);
        let spans = if as_said { spans } else { (spans.1, spans.0) };
        let why = if lattice.len() == spans.0 * spans.1 && lattice.len() > 8 {
            NotFound::OtherSize { expected: wanted, seen: spans }
        } else {
            NotFound::Partial { expected: wanted, seen: spans, points: lattice.len() }
        };
        // Four corners of one square say nothing about a board.
        if lattice.len() > 6 && seen(&why) > seen(&best) {
            best = why;
        }
    }
    Err(best)
}

/// Whether a lattice has exactly the wanted corners, one way round or the other.
fn is_whole(lattice: &Lattice, wanted: (usize, usize)) -> bool {
    let ((left, right), (top, bottom)) = extent(lattice);
    let spans = ((right - left + 1) as usize, (bottom - top + 1) as usize);
    lattice.len() == wanted.0 * wanted.1 && (spans == wanted || spans == (wanted.1, wanted.0))
}

/// The lattice, less outer lines that are hardly there, if that is exactly the wanted one.
///
/// Shadows, frames and reflections make corners in line with a board's; they do not make whole lines of them.
fn whole_within(lattice: &Lattice, wanted: (usize, usize)) -> Option<Lattice> {
    let mut lattice = lattice.clone();
    loop {
        if is_whole(&lattice, wanted) {
            return Some(lattice);
        }
        if lattice.len() <= wanted.0 * wanted.1 {
            return None;
        }
        let ((left, right), (top, bottom)) = extent(&lattice);
        let (width, height) = (right - left + 1, bottom - top + 1);
        let count = |on: &dyn Fn(&(i32, i32)) -> bool| lattice.keys().filter(|place| on(place)).count();
        // The emptiest of the four outer lines, by the part of it that is there.
        let lines: [(f64, fn(&(i32, i32), i32) -> bool, i32); 4] = [
            (count(&|p| p.0 == left) as f64 / f64::from(height), |p, at| p.0 == at, left),
            (count(&|p| p.0 == right) as f64 / f64::from(height), |p, at| p.0 == at, right),
            (count(&|p| p.1 == top) as f64 / f64::from(width), |p, at| p.1 == at, top),
            (count(&|p| p.1 == bottom) as f64 / f64::from(width), |p, at| p.1 == at, bottom),
        ];
        let (part, on, at) = lines.into_iter().min_by(|a, b| a.0.total_cmp(&b.0))?;
        if part > 0.5 {
            return None;
        }
        lattice.retain(|place, _| !on(place, at));
    }
}

/// Adds the corners that the detector overlooked, where the neighbours say they must be.
fn complete(image: &GrayImage, lattice: &mut Lattice) {
    // Each round reaches one square further, and a board has at most 200 along a side.
    for _ in 0..200 {
        let ((left, right), (top, bottom)) = extent(lattice);
        let mut added = Vec::new();
        for j in top - 1..=bottom + 1 {
            for i in left - 1..=right + 1 {
                if !lattice.contains_key(&(i, j))
                    && let Some(corner) = overlooked(image, lattice, (i, j))
                {
                    added.push(((i, j), corner));
                }
            }
        }
        if added.is_empty() || lattice.len() > 50_000 {
            return;
        }
        lattice.extend(added);
    }
}

/// The corner at an empty place of a lattice, if there is one where at least two neighbouring lines lead.
fn overlooked(image: &GrayImage, lattice: &Lattice, (i, j): (i32, i32)) -> Option<Corner> {
    let at = |di: i32, dj: i32| lattice.get(&(i + di, j + dj));
    let mut predictions: Vec<(f64, f64)> = Vec::new();
    let mut sides: Vec<(Corner, f64)> = Vec::new();
    for (di, dj) in [(1, 0), (0, 1), (-1, 0), (0, -1)] {
        let Some(next) = at(di, dj) else { continue };
        if let Some(after) = at(2 * di, 2 * dj) {
            let (mut x, mut y) = (2.0 * next.pixel.x - after.pixel.x, 2.0 * next.pixel.y - after.pixel.y);
            // With a third one, perspective and lens are followed to the second order.
            if let Some(third) = at(3 * di, 3 * dj) {
                x += next.pixel.x - 2.0 * after.pixel.x + third.pixel.x;
                y += next.pixel.y - 2.0 * after.pixel.y + third.pixel.y;
            }
            predictions.push((x, y));
            sides.push((*next, next.pixel.distance(after.pixel)));
        } else {
            // A parallelogram with the square beside.
            for (ei, ej) in [(dj, di), (-dj, -di)] {
                if let (Some(beside), Some(across)) = (at(ei, ej), at(di + ei, dj + ej)) {
                    predictions.push((
                        next.pixel.x + beside.pixel.x - across.pixel.x,
                        next.pixel.y + beside.pixel.y - across.pixel.y,
                    ));
                    sides.push((*next, across.pixel.distance(beside.pixel)));
                }
            }
        }
    }
    let count = predictions.len() as f64;
    if predictions.is_empty() {
        return None;
    }
    let guess = Pixel::new(
        predictions.iter().map(|p| p.0).sum::<f64>() / count,
        predictions.iter().map(|p| p.1).sum::<f64>() / count,
    );
    let side = sides.iter().map(|(_, side)| *side).fold(f64::MAX, f64::min);
    let window = (0.35 * side).clamp(2.5, 8.0);
    let pixel = subpixel::orthogonal(image, guess, window)?;
    if pixel.distance(guess) > 0.25 * side {
        return None;
    }
    let ring = Ring::read(image, pixel, RING_PX.min(0.45 * side).max(2.0))?;
    // Every neighbour must be joined by an edge, and there must be one.
    let corner = Corner { pixel, ring };
    sides.iter().all(|(neighbour, _)| joined(image, &corner, neighbour)).then_some(corner)
}

/// Whether an edge of the image joins two corners.
fn joined(image: &GrayImage, one: &Corner, other: &Corner) -> bool {
    let direction = (other.pixel.y - one.pixel.y).atan2(other.pixel.x - one.pixel.x);
    let (edge, turn) = nearest_edge(&one.ring, direction);
    let (back, back_turn) = nearest_edge(&other.ring, direction + std::f64::consts::PI);
    let white = one.ring.white_after(edge);
    turn < 0.5
        && back_turn < 0.5
        && white != other.ring.white_after(back)
        && edge_between(image, one.pixel, other.pixel, white, one.ring.contrast().min(other.ring.contrast()))
}

/// The corners of a whole lattice in the order of the board's points; see [`super::BoardFinder::find`].
fn in_order(lattice: &Lattice, wanted: (usize, usize)) -> Vec<Corner> {
    let ((left, right), (top, bottom)) = extent(lattice);
    let (columns, rows) = (wanted.0 as i32, wanted.1 as i32);
    let spans = (right - left + 1, bottom - top + 1);
    // Four ways to turn a grid: its first corner, and the steps along rows and columns.
    let turns = [
        ((left, top), (1, 0), (0, 1)),
        ((right, top), (0, 1), (-1, 0)),
        ((right, bottom), (-1, 0), (0, -1)),
        ((left, bottom), (0, -1), (1, 0)),
    ];
    let mut best: Option<((bool, f64), Vec<Corner>)> = None;
    for (first, along, down) in turns {
        let fits = if along.1 == 0 { spans == (columns, rows) } else { spans == (rows, columns) };
        if !fits {
            continue;
        }
        let corners: Vec<Corner> = (0..rows)
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
        // The square outside the first corner is across from the one between its edges along the row and down the column.
        let next = corners[1].pixel;
        let direction = (next.y - origin.pixel.y).atan2(next.x - origin.pixel.x);
        let black = !origin.ring.white_after(nearest_edge(&origin.ring, direction).0);
        let upright = {
            let (row, column) = (step(right), step(below));
            row.0 / row.0.hypot(row.1).max(1e-9) + column.1 / column.0.hypot(column.1).max(1e-9)
        };
        let rank = (black, upright);
        if best.as_ref().is_none_or(|(found, _)| rank.0 > found.0 || (rank.0 == found.0 && rank.1 > found.1))
        {
            best = Some((rank, corners));
        }
    }
    best.map(|(_, corners)| corners).unwrap_or_default()
}

/// Fits every corner in the full image; `scale` is how coarsely they are known, pixels.
fn refine(
    image: &GrayImage,
    corners: &[Pixel],
    (columns, rows): (usize, usize),
    scale: f64,
) -> Result<Vec<SeenPoint>, NotFound> {
    let mut points = Vec::with_capacity(corners.len());
    let mut blurs = Vec::with_capacity(corners.len());
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
        let saddle = subpixel::fit(image, corner, window).ok_or(NotFound::Blurred)?;
        if saddle.pixel.distance(corner) > 0.3 * side {
            return Err(NotFound::Blurred);
        }
        blurs.push((saddle.blur_px, saddle.blur_px / side));
        points.push(SeenPoint { index, pixel: saddle.pixel });
    }
    let middle = |value: fn(&(f64, f64)) -> f64| {
        let mut values: Vec<f64> = blurs.iter().map(value).collect();
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    if middle(|blur| blur.0) > MOST_BLUR_PX || middle(|blur| blur.1) > MOST_BLUR_OF_SIDE {
        return Err(NotFound::Blurred);
    }
    Ok(points)
}
