//! Detection of complete circle grids, rectangular and asymmetric.
//!
//! Dark elliptical blobs are linked to lattices from neighbour to neighbour, in an arbitrary one of
//! the lattice's bases. Then a change of basis is searched for that maps the lattice to the board.
//!
//! The detected point is the centre of the disc's image, which is not the image of the disc's
//! centre (J. Heikkilä, "Geometric camera calibration using circular control points", 2000).
//! Perspective causes a bias towards the near side of about r² / f · sin(tilt) cos(tilt), with the
//! image radius r of the disc and the focal length f in pixels: some hundredths to tenths of a
//! pixel for large, near and oblique discs. Chessboards do not have this bias and are preferable.

use super::blobs::{Blob, blobs};
use super::{NotFound, disc};
use crate::{Board, BoardKind, BoardView, SeenPoint};
use odograph::geometry::Pixel;
use odograph::image::{GrayImage, Pyramid};
use odograph::numerics::median;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Blob indices by coordinates in some basis of their lattice.
type Spots = BTreeMap<(i32, i32), usize>;

/// Maximum distance of a blob from its predicted position, as a share of the distance to its
/// neighbour.
const STRAY: f64 = 0.25;
/// Maximum ratio of the semi-axes of neighbouring blobs.
const MAX_UNLIKE_SIZES: f64 = 1.7;
/// Maximum number of blobs, in addition to four times those of the board; texture produces any
/// number.
const MAX_SPOTS: usize = 1000;
/// Maximum residual of a disc fit relative to its contrast (median over all discs), and minimum
/// ratio of the lowest to the highest contrast. They reject pebbles and letters.
const MAX_UNEXPLAINED: f64 = 0.12;
const MIN_CONTRAST_RATIO: f64 = 0.25;
/// Maximum blur of the rim, standard deviation in pixels.
const MAX_BLUR_PX: f64 = 6.0;

/// Detects a complete circle grid.
pub(super) fn find(image: &GrayImage, board: &Board) -> Result<BoardView, NotFound> {
    let pyramid = Pyramid::new(image.clone(), 2);
    let mut best = NotFound::NoDiscs;
    // The higher resolution is only needed for small discs.
    for level in (0..pyramid.levels()).rev() {
        let scale = f64::from(1u32 << level);
        let short_side = pyramid.level(level).width().min(pyramid.level(level).height());
        // The window of the local mean must be larger than a disc, but small enough for uniform
        // illumination.
        for part in [5, 12, 30] {
            let window = short_side / part;
            if window < 5 {
                continue;
            }
            let most = MAX_SPOTS + 4 * board.columns() * board.rows();
            let spots = Spotted::new(blobs(pyramid.level(level), window, most));
            match in_spots(&spots, board) {
                Ok(grid) => {
                    let grid: Vec<Blob> = grid.iter().map(|blob| scaled(blob, scale)).collect();
                    match refine(image, &grid) {
                        Ok(points) => {
                            return Ok(BoardView { size: (image.width(), image.height()), points });
                        }
                        Err(why) => best = why,
                    }
                }
                Err(why) => {
                    let points = |why: &NotFound| match *why {
                        NotFound::OtherDiscs { seen, .. } => seen,
                        NotFound::Blurred => usize::MAX,
                        _ => 0,
                    };
                    if points(&why) > points(&best) {
                        best = why;
                    }
                }
            }
        }
    }
    Err(best)
}

/// A blob of a pyramid level, scaled to full resolution.
fn scaled(blob: &Blob, scale: f64) -> Blob {
    Blob {
        pixel: Pixel::new(blob.pixel.x * scale, blob.pixel.y * scale),
        shape: blob.shape.map(|entry| entry / (scale * scale)),
        axes_px: (blob.axes_px.0 * scale, blob.axes_px.1 * scale),
    }
}

/// Refines every disc at full resolution.
fn refine(image: &GrayImage, grid: &[Blob]) -> Result<Vec<SeenPoint>, NotFound> {
    let discs: Vec<disc::Disc> =
        grid.iter().map(|blob| disc::fit(image, blob)).collect::<Option<_>>().ok_or(NotFound::NoDiscs)?;
    let middle = |value: fn(&disc::Disc) -> f64| {
        let mut values: Vec<f64> = discs.iter().map(value).collect();
        median(&mut values).unwrap_or(0.0)
    };
    let contrasts = || discs.iter().map(|disc| disc.contrast);
    let (faintest, strongest) = (contrasts().fold(f64::MAX, f64::min), contrasts().fold(0.0, f64::max));
    if middle(|disc| disc.residual / disc.contrast) > MAX_UNEXPLAINED
        || faintest < MIN_CONTRAST_RATIO * strongest
    {
        return Err(NotFound::NoDiscs);
    }
    if middle(|disc| disc.blur_px) > MAX_BLUR_PX {
        return Err(NotFound::Blurred);
    }
    let points = discs.iter().enumerate().map(|(index, disc)| SeenPoint { index, pixel: disc.pixel });
    Ok(points.collect())
}

/// Minimum number of discs for a statement about a board; smaller lattices occur by chance.
const MIN_PART: usize = 6;

/// Lattice coordinates of the board's points: a rectangle, or every second position of it for the
/// asymmetric grid.
fn places_of(board: &Board) -> Vec<(i32, i32)> {
    let (columns, rows) = (board.columns() as i32, board.rows() as i32);
    let asymmetric = board.kind() == BoardKind::AsymmetricCircles;
    let place = |column: i32, row: i32| (if asymmetric { 2 * column + row % 2 } else { column }, row);
    (0..rows).flat_map(|row| (0..columns).map(move |column| place(column, row))).collect()
}

/// The blobs of the board in the order of its points.
fn in_spots(spots: &Spotted, board: &Board) -> Result<Vec<Blob>, NotFound> {
    let places = places_of(board);
    let mut best = NotFound::NoDiscs;
    let mut taken = vec![false; spots.blobs.len()];
    for seed in 0..spots.blobs.len() {
        if taken[seed] {
            continue;
        }
        let Some(lattice) = grown(spots, seed) else { continue };
        lattice.values().for_each(|&spot| taken[spot] = true);
        if lattice.len() >= places.len()
            && let Some(grid) = as_board(&lattice, &spots.blobs, board, &places)
        {
            return Ok(grid);
        }
        let reported = match best {
            NotFound::OtherDiscs { seen, .. } => seen,
            _ => MIN_PART.max(places.len() / 3), // smaller ones occur by chance
        };
        // Lattices of pebbles have more gaps than complete squares.
        let whole = |&&(i, j): &&(i32, i32)| {
            [(1, 0), (0, 1), (1, 1)].iter().all(|(di, dj)| lattice.contains_key(&(i + di, j + dj)))
        };
        if lattice.len() > reported && 2 * lattice.keys().filter(whole).count() >= lattice.len() {
            best = NotFound::OtherDiscs { expected: places.len(), seen: lattice.len() };
        }
    }
    Err(best)
}

/// Whether two blobs are similar enough in size to be neighbouring discs of one board.
fn alike(one: &Blob, other: &Blob) -> bool {
    let ratio = |a: f64, b: f64| a.max(b) < MAX_UNLIKE_SIZES * a.min(b);
    ratio(one.axes_px.0, other.axes_px.0) && ratio(one.axes_px.1, other.axes_px.1)
}

/// Blobs with a grid of buckets for nearest-neighbour search.
struct Spotted {
    blobs: Vec<Blob>,
    cells: BTreeMap<(i32, i32), Vec<usize>>,
    cell_px: f64,
}

impl Spotted {
    fn new(blobs: Vec<Blob>) -> Self {
        let reach = blobs.iter().map(|blob| blob.pixel.x.max(blob.pixel.y)).fold(1.0, f64::max);
        // About one blob per bucket.
        let cell_px = (reach / (blobs.len() as f64).sqrt().max(1.0)).max(4.0);
        let mut spotted = Self { blobs: Vec::new(), cells: BTreeMap::new(), cell_px };
        for (index, blob) in blobs.iter().enumerate() {
            spotted.cells.entry(spotted.cell(blob.pixel)).or_default().push(index);
        }
        spotted.blobs = blobs;
        spotted
    }

    fn cell(&self, at: Pixel) -> (i32, i32) {
        ((at.x / self.cell_px).floor() as i32, (at.y / self.cell_px).floor() as i32)
    }

    /// The nearest blob within `reach_px` that satisfies `wanted`.
    fn nearest(&self, place: Pixel, reach_px: f64, wanted: impl Fn(usize) -> bool) -> Option<usize> {
        let (left, top) = self.cell(Pixel::new(place.x - reach_px, place.y - reach_px));
        let (right, bottom) = self.cell(Pixel::new(place.x + reach_px, place.y + reach_px));
        (top..=bottom)
            .flat_map(|row| (left..=right).filter_map(move |column| self.cells.get(&(column, row))))
            .flatten()
            .filter(|&&spot| wanted(spot))
            .map(|&spot| (place.distance(self.blobs[spot].pixel), spot))
            .filter(|(distance, _)| *distance < reach_px)
            .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))
            .map(|(_, spot)| spot)
    }

    /// The nearest blobs of similar size, nearest first.
    fn nearest_alike(&self, spot: usize, count: usize) -> Vec<usize> {
        let own = &self.blobs[spot];
        let mut near: Vec<(f64, usize)> = (0..self.blobs.len())
            .filter(|&other| other != spot && alike(&self.blobs[other], own))
            .map(|other| (self.blobs[other].pixel.distance(own.pixel), other))
            .collect();
        let order = |a: &(f64, usize), b: &(f64, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
        if near.len() > count {
            near.select_nth_unstable_by(count, order);
            near.truncate(count);
        }
        near.sort_by(order);
        near.into_iter().map(|(_, other)| other).collect()
    }
}

/// Grows a lattice from a blob, with its nearest neighbours in two different directions as the
/// basis.
fn grown(spots: &Spotted, seed: usize) -> Option<Spots> {
    let at = |spot: usize| spots.blobs[spot].pixel;
    let step = |from: usize, to: usize| (at(to).x - at(from).x, at(to).y - at(from).y);
    let near = spots.nearest_alike(seed, 8);
    let first = *near.first()?;
    let along = step(seed, first);
    let across = near.iter().map(|&other| step(seed, other)).find(|other| {
        let sine = along.0 * other.1 - along.1 * other.0;
        sine.abs() > 0.4 * along.0.hypot(along.1) * other.0.hypot(other.1)
    })?;
    // The basis has the orientation of the image axes, so the lattice is never mirrored.
    let across = if along.0 * across.1 - along.1 * across.0 > 0.0 { across } else { (-across.0, -across.1) };
    let mut lattice = Spots::from([((0, 0), seed)]);
    let mut used = BTreeSet::from([seed]);
    let mut queue = VecDeque::from([((0, 0), along, across)]);
    while let Some((place, along, across)) = queue.pop_front() {
        let spot = lattice[&place];
        for (di, dj) in [(1, 0), (0, 1), (-1, 0), (0, -1)] {
            let there = (place.0 + di, place.1 + dj);
            if lattice.contains_key(&there) {
                continue;
            }
            let heading = if di != 0 { along } else { across };
            let sign = f64::from(di + dj);
            // Extrapolation along the line is more accurate than the local basis.
            let expected = match lattice.get(&(place.0 - di, place.1 - dj)) {
                Some(&before) => step(before, spot),
                None => (sign * heading.0, sign * heading.1),
            };
            let guess = Pixel::new(at(spot).x + expected.0, at(spot).y + expected.1);
            let reach = STRAY * expected.0.hypot(expected.1);
            let wanted = |other| !used.contains(&other) && alike(&spots.blobs[other], &spots.blobs[spot]);
            let Some(other) = spots.nearest(guess, reach, wanted) else { continue };
            lattice.insert(there, other);
            used.insert(other);
            let measured = step(spot, other);
            let measured = (sign * measured.0, sign * measured.1);
            let (along, across) = if di != 0 { (measured, across) } else { (along, measured) };
            queue.push_back((there, along, across));
        }
    }
    (lattice.len() >= 4).then_some(lattice)
}

/// The blobs in the order of the board's points, if some basis maps the lattice to the board. If
/// several do, the one whose rows run most to the right and whose columns most downwards.
fn as_board(lattice: &Spots, spots: &[Blob], board: &Board, places: &[(i32, i32)]) -> Option<Vec<Blob>> {
    let asymmetric = board.kind() == BoardKind::AsymmetricCircles;
    // Neighbours in the asymmetric grid are one step right and one down, so their basis has a
    // determinant of two.
    let area = if asymmetric { 2 } else { 1 };
    let entries = -3..=3;
    let mut best: Option<(f64, Vec<Blob>)> = None;
    for p in entries.clone() {
        for q in entries.clone() {
            for r in entries.clone() {
                for s in entries.clone() {
                    if p * s - q * r != area {
                        continue;
                    }
                    let turned: Spots = lattice
                        .iter()
                        .map(|((i, j), &spot)| ((p * i + q * j, r * i + s * j), spot))
                        .collect();
                    let Some(found) = exactly(turned, places) else { continue };
                    let at = |place: usize| spots[found[place]].pixel;
                    let step = |to: Pixel, x: bool| {
                        let (dx, dy) = (to.x - at(0).x, to.y - at(0).y);
                        (if x { dx } else { dy }) / dx.hypot(dy).max(1e-9)
                    };
                    let (last_in_row, last_row) = (
                        board.columns() - 1,
                        board.columns()
                            * (board.rows()
                                - 1
                                - usize::from(asymmetric && board.rows() > 2) * ((board.rows() + 1) % 2)),
                    );
                    let upright = step(at(last_in_row), true) + step(at(last_row), false);
                    if best.as_ref().is_none_or(|(rank, _)| upright > *rank) {
                        best = Some((upright, found.iter().map(|&spot| spots[spot]).collect()));
                    }
                }
            }
        }
    }
    best.map(|(_, grid)| grid)
}

/// The blobs at the board's positions, if the lattice without sparse outer lines is exactly the
/// board, up to a translation.
fn exactly(mut lattice: Spots, places: &[(i32, i32)]) -> Option<Vec<usize>> {
    let range = |keys: &mut dyn Iterator<Item = i32>| {
        keys.fold((i32::MAX, i32::MIN), |(least, most), key| (least.min(key), most.max(key)))
    };
    let wide = places.iter().map(|place| place.0).max()?;
    let high = places.iter().map(|place| place.1).max()?;
    loop {
        let (left, right) = range(&mut lattice.keys().map(|place| place.0));
        let (top, bottom) = range(&mut lattice.keys().map(|place| place.1));
        if (right - left, bottom - top) == (wide, high) {
            if lattice.len() != places.len() {
                return None;
            }
            return places
                .iter()
                .map(|place| lattice.get(&(place.0 + left, place.1 + top)).copied())
                .collect();
        }
        if lattice.len() <= places.len() || right - left < wide || bottom - top < high {
            return None;
        }
        // The sparsest outer line along an axis on which the lattice is too long.
        let count = |on: &dyn Fn(&(i32, i32)) -> bool| lattice.keys().filter(|place| on(place)).count();
        let mut lines = Vec::new();
        if right - left > wide {
            lines.push((count(&|place| place.0 == left), true, left));
            lines.push((count(&|place| place.0 == right), true, right));
        }
        if bottom - top > high {
            lines.push((count(&|place| place.1 == top), false, top));
            lines.push((count(&|place| place.1 == bottom), false, bottom));
        }
        let (spots, column, line) = lines.into_iter().min_by_key(|line| line.0)?;
        let full = if column { high + 1 } else { wide + 1 };
        // A line of the asymmetric grid only has every second position.
        if 4 * spots as i32 > full {
            return None;
        }
        lattice.retain(|place, _| if column { place.0 != line } else { place.1 != line });
    }
}
