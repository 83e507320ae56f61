//! Linking of chessboard corners to lattices.
//!
//! Lattices are grown from neighbour to neighbour as in A. Geiger, F. Moosmann, Ö. Car and B.
//! Schuster, "Automatic camera and range sensor calibration using a single shot", 2012, but along
//! image edges: two corners are linked if an edge leaves one, arrives at the other, and separates
//! black from white with the same polarity along its whole length. Nothing is assumed about
//! perspective or lens distortion beyond one square.

use super::ring::{Ring, interpolated};
use odograph::geometry::Pixel;
use odograph::image::GrayImage;
use std::collections::{BTreeMap, VecDeque};
use std::f64::consts::{PI, TAU};

/// A chessboard corner in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LatticeCorner {
    pub pixel: Pixel,
    pub ring: Ring,
}

/// Corners by lattice coordinates (column, row). The rotation from rows to columns is clockwise in
/// the image, so a lattice is never mirrored.
pub(super) type Lattice = BTreeMap<(i32, i32), LatticeCorner>;

/// Maximum angle between an edge and the direction to the neighbour, radians.
const TURN: f64 = 0.45;
/// Minimum ratio of the contrasts of two neighbours.
const MIN_CONTRAST_RATIO: f64 = 0.35;
/// Number of nearest corners considered as neighbours.
const NEAREST: usize = 40;

/// Wraps `angle` to −π..π.
fn wrapped(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}

/// The edge of a ring closest to a direction, and the angle between them, radians.
pub(super) fn nearest_edge(ring: &Ring, direction: f64) -> (usize, f64) {
    let mut best = (0, f64::MAX);
    for (edge, &angle) in ring.edges.iter().enumerate() {
        let turn = wrapped(angle - direction).abs();
        if turn < best.1 {
            best = (edge, turn);
        }
    }
    best
}

/// Whether an edge of constant polarity connects `from` and `to`. The right side along its
/// direction (clockwise) is white if `white_right`.
pub(super) fn edge_between(
    image: &GrayImage,
    from: Pixel,
    to: Pixel,
    white_right: bool,
    contrast: f64,
) -> bool {
    let length = from.distance(to);
    if length.is_nan() || length < 2.0 {
        return false;
    }
    let (ux, uy) = ((to.x - from.x) / length, (to.y - from.y) / length);
    // Far enough from the edge to avoid its blur, and close enough to stay inside a narrow square.
    let aside = (0.15 * length).clamp(1.0, 6.0);
    let (sx, sy) = if white_right { (-uy * aside, ux * aside) } else { (uy * aside, -ux * aside) };
    let sample = |x: f64, y: f64| interpolated(image, Pixel::new(x, y));
    [0.2, 0.35, 0.5, 0.65, 0.8].iter().all(|t| {
        let (x, y) = (from.x + t * length * ux, from.y + t * length * uy);
        match (sample(x + sx, y + sy), sample(x - sx, y - sy)) {
            (Some(white), Some(black)) => white - black > 0.35 * contrast,
            _ => false,
        }
    })
}

/// For each edge of each corner, the neighbour in that direction and the index of the neighbour's
/// edge that points back.
fn links(image: &GrayImage, corners: &[LatticeCorner]) -> Vec<[Option<(usize, usize)>; 4]> {
    let mut nearest: Vec<(f64, usize)> = Vec::new();
    let mut links = vec![[None; 4]; corners.len()];
    for (index, corner) in corners.iter().enumerate() {
        nearest.clear();
        let contrast = corner.ring.contrast();
        nearest.extend(corners.iter().enumerate().filter(|(other, _)| *other != index).filter_map(
            |(other, candidate)| {
                let ratio = candidate.ring.contrast() / contrast;
                let (dx, dy) = (candidate.pixel.x - corner.pixel.x, candidate.pixel.y - corner.pixel.y);
                (MIN_CONTRAST_RATIO..=1.0 / MIN_CONTRAST_RATIO)
                    .contains(&ratio)
                    .then_some((dx * dx + dy * dy, other))
            },
        ));
        let order = |a: &(f64, usize), b: &(f64, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
        if nearest.len() > NEAREST {
            nearest.select_nth_unstable_by(NEAREST, order);
            nearest.truncate(NEAREST);
        }
        let mut best = [f64::MAX; 4];
        for &(squared, other) in &nearest {
            let candidate = &corners[other];
            let direction = (candidate.pixel.y - corner.pixel.y).atan2(candidate.pixel.x - corner.pixel.x);
            let (edge, turn) = nearest_edge(&corner.ring, direction);
            let (back, back_turn) = nearest_edge(&candidate.ring, direction + PI);
            let cost = squared.sqrt() * (1.0 + 2.0 * (turn + back_turn));
            // In the opposite direction, white is on the other side.
            let white = corner.ring.white_after(edge);
            if turn > TURN
                || back_turn > TURN
                || cost >= best[edge]
                || white == candidate.ring.white_after(back)
            {
                continue;
            }
            let contrast = contrast.min(candidate.ring.contrast());
            if edge_between(image, corner.pixel, candidate.pixel, white, contrast) {
                best[edge] = cost;
                links[index][edge] = Some((other, back));
            }
        }
    }
    links
}

/// All lattices of the linked corners, largest first. Every corner belongs to at least one complete
/// square of its lattice.
pub(super) fn lattices(image: &GrayImage, corners: &[LatticeCorner]) -> Vec<Lattice> {
    let links = links(image, corners);
    let mutual = |corner: usize, edge: usize| {
        links[corner][edge].filter(|&(other, back)| links[other][back] == Some((corner, edge)))
    };
    let mut taken = vec![false; corners.len()];
    let mut lattices = Vec::new();
    for seed in 0..corners.len() {
        if taken[seed] {
            continue;
        }
        // Lattice coordinates of the corners; the queue also holds the index of the edge along the
        // rows.
        let mut places: BTreeMap<(i32, i32), usize> = BTreeMap::new();
        let mut queue = VecDeque::from([(seed, (0, 0), 0)]);
        taken[seed] = true;
        places.insert((0, 0), seed);
        while let Some((corner, place, along_rows)) = queue.pop_front() {
            for edge in 0..4 {
                let Some((other, back)) = mutual(corner, edge) else { continue };
                let heading = (edge + 4 - along_rows) % 4;
                let step = [(1, 0), (0, 1), (-1, 0), (0, -1)][heading];
                let there = (place.0 + step.0, place.1 + step.1);
                if taken[other] || places.contains_key(&there) {
                    continue;
                }
                taken[other] = true;
                places.insert(there, other);
                // The neighbour's edge `back` points opposite to the heading.
                queue.push_back((other, there, (back + 4 - (heading + 2) % 4) % 4));
            }
        }
        let whole = |&(i, j): &(i32, i32)| {
            [(0, 0), (-1, 0), (0, -1), (-1, -1)].iter().any(|&(di, dj)| {
                [(0, 0), (1, 0), (0, 1), (1, 1)]
                    .iter()
                    .all(|&(a, b)| places.contains_key(&(i + di + a, j + dj + b)))
            })
        };
        let lattice: Lattice = places
            .iter()
            .filter(|(place, _)| whole(place))
            .map(|(place, &index)| (*place, corners[index]))
            .collect();
        if !lattice.is_empty() {
            lattices.push(lattice);
        }
    }
    lattices.sort_by_key(|lattice| std::cmp::Reverse(lattice.len()));
    lattices
}

/// Minimum and maximum lattice coordinates: columns, then rows.
pub(super) fn extent(lattice: &Lattice) -> ((i32, i32), (i32, i32)) {
    let range = |coordinate: fn(&(i32, i32)) -> i32| {
        let all = || lattice.keys().map(coordinate);
        (all().min().unwrap_or(0), all().max().unwrap_or(-1))
    };
    (range(|place| place.0), range(|place| place.1))
}
