//! Completion of a corner lattice by the corners that the detector missed.

use super::lattice::{Lattice, LatticeCorner, edge_between, extent, nearest_edge};
use super::ring::{RING_PX, Ring};
use super::subpixel;
use odograph::geometry::Pixel;
use odograph::image::GrayImage;

/// Adds corners that the detector missed, at positions extrapolated from their neighbours.
pub(super) fn complete(image: &GrayImage, lattice: &mut Lattice) {
    // Each round extends the lattice by one square; a board has at most 200 along a side.
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

/// The missed corner at an empty lattice position; `None` unless the image confirms it at the
/// position predicted by the neighbours.
fn overlooked(image: &GrayImage, lattice: &Lattice, (i, j): (i32, i32)) -> Option<LatticeCorner> {
    let at = |di: i32, dj: i32| lattice.get(&(i + di, j + dj));
    let mut predictions: Vec<(f64, f64)> = Vec::new();
    let mut sides: Vec<(LatticeCorner, f64)> = Vec::new();
    for (di, dj) in [(1, 0), (0, 1), (-1, 0), (0, -1)] {
        let Some(next) = at(di, dj) else { continue };
        if let Some(after) = at(2 * di, 2 * dj) {
            let (mut x, mut y) = (2.0 * next.pixel.x - after.pixel.x, 2.0 * next.pixel.y - after.pixel.y);
            // A third corner allows quadratic extrapolation, which follows perspective and
            // distortion.
            if let Some(third) = at(3 * di, 3 * dj) {
                x += next.pixel.x - 2.0 * after.pixel.x + third.pixel.x;
                y += next.pixel.y - 2.0 * after.pixel.y + third.pixel.y;
            }
            predictions.push((x, y));
            sides.push((*next, next.pixel.distance(after.pixel)));
        } else {
            // The fourth corner of a parallelogram with an adjacent square.
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
    // An edge must connect the corner to every neighbour used for the prediction.
    let corner = LatticeCorner { pixel, ring };
    sides.iter().all(|(neighbour, _)| joined(image, &corner, neighbour)).then_some(corner)
}

/// Whether an image edge connects two corners.
fn joined(image: &GrayImage, one: &LatticeCorner, other: &LatticeCorner) -> bool {
    let direction = (other.pixel.y - one.pixel.y).atan2(other.pixel.x - one.pixel.x);
    let (edge, turn) = nearest_edge(&one.ring, direction);
    let (back, back_turn) = nearest_edge(&other.ring, direction + std::f64::consts::PI);
    let white = one.ring.white_after(edge);
    turn < 0.5
        && back_turn < 0.5
        && white != other.ring.white_after(back)
        && edge_between(image, one.pixel, other.pixel, white, one.ring.contrast().min(other.ring.contrast()))
}
