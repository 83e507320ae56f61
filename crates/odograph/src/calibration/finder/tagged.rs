//! Boards with markers: parts of them are enough, for each marker says where on the board it is.
//!
//! Markers that are read are only the beginning. Those that agree with each other about where the board is predict the points around
//! them; each point is then found in the image by itself, and found points predict further ones, with their markers checked bit by bit
//! where they must be. Predictions go through homographies of a few squares' size, so lenses may bend the board as a whole.

use super::NotFound;
use super::markers::{self, Codes, Layout, Marker};
use super::plane_map::{Pair, PlaneMap, least_width};
use super::points::{Expected, PointLook, look_at};
use crate::calibration::{BoardPoint, BoardView, Drawing, SeenPoint};
use crate::geometry::Pixel;
use crate::image::GrayImage;
use crate::numerics::median;
use std::collections::VecDeque;

/// A board with markers, prepared for finding.
#[derive(Debug, Clone)]
pub(super) struct TaggedBoard {
    pub(super) points: Vec<BoardPoint>,
    /// Points in a row, and rows of points.
    pub(super) grid: (usize, usize),
    /// Cells that markers stand in, across and down, and which marker stands in each.
    pub(super) cells: (usize, usize),
    pub(super) marker_in_cell: Vec<Option<usize>>,
    /// The cell of each marker, and where its corners are, from its top left clockwise as printed, metres.
    pub(super) cell_of_marker: Vec<(usize, usize)>,
    pub(super) corners_of_marker: Vec<[(f64, f64); 4]>,
    /// The markers whose cells a point touches, and the points that a marker's cell touches.
    pub(super) markers_of_point: Vec<Vec<usize>>,
    pub(super) points_of_marker: Vec<Vec<usize>>,
    /// Whether a point's upper left and lower right are black (then the other two are white).
    pub(super) black_upper_left: Vec<bool>,
    pub(super) codes: Codes,
    pub(super) drawing: Drawing,
    /// How far from a point the four squares around it are plain, metres.
    pub(super) plain_m: f64,
    /// The unit of distance for predictions, metres, and how many points away in the grid help to predict.
    pub(super) spacing_m: f64,
    pub(super) reach: usize,
    /// Fewer markers than this that agree are no board.
    pub(super) least_markers: usize,
    /// Whether the markers stand in a chessboard's white squares.
    pub(super) is_chessboard: bool,
}

/// Fewer points are no view: a homography must be told from a wrong one.
const LEAST_POINTS: usize = 4;
/// Markers agree when one's corners are where another predicts them, in sides of the marker: near ones, and as far as the prediction of
/// one small marker carries.
const AGREE_SIDES: f64 = 0.4;
/// How far a point may lie from where it is predicted, in least widths of a spacing, and in pixels in addition.
const OFF_SPACINGS: f64 = 0.12;
const OFF_PX: f64 = 1.0;

/// What is known of a view as it grows.
struct View<'a> {
    image: &'a GrayImage,
    board: &'a TaggedBoard,
    seen: Vec<Option<Pixel>>,
    /// Where markers were read, and whether they have been checked bit by bit.
    marker_corners: Vec<Option<[Pixel; 4]>>,
    agrees: Vec<bool>,
    /// Whether the markers are drawn as the board's drawing has them.
    is_as_drawn: bool,
    /// The blur that the points seen first speak for, each.
    blurs: Vec<f64>,
    blur_px: f64,
}

impl TaggedBoard {
    /// Finds the board; it may be seen in part.
    pub fn find(&self, image: &GrayImage) -> Result<BoardView, NotFound> {
        let mut found = markers::find(image, &self.codes);
        let mut agreeing = self.agreeing(&found.read);
        if agreeing.len() < self.least_markers && self.is_chessboard {
            markers::find_between(image, &self.codes, &mut found);
            agreeing = self.agreeing(&found.read);
        }
        // A few markers look like others in a mirror.
        let mirrored = self.agreeing(&found.mirrored);
        if mirrored.len() >= self.least_markers.max(2) && mirrored.len() > agreeing.len() {
            return Err(NotFound::Mirrored);
        }
        if agreeing.len() < self.least_markers {
            return Err(match agreeing.len() {
                0 => NotFound::NoMarkers,
                found => NotFound::TooFewMarkers { found, least: self.least_markers },
            });
        }
        let mut view = View {
            image,
            board: self,
            seen: vec![None; self.points.len()],
            marker_corners: vec![None; self.cell_of_marker.len()],
            agrees: vec![false; self.cell_of_marker.len()],
            is_as_drawn: 2 * agreeing.iter().filter(|marker| marker.layout == 0).count() > agreeing.len(),
            blurs: Vec::new(),
            blur_px: BLURS_PX[1],
        };
        for marker in &agreeing {
            view.marker_corners[marker.id] = Some(marker.corners);
            view.agrees[marker.id] = true;
        }
        view.grow();
        view.drop_outliers();
        view.refine();
        if !view.is_plausible() {
            return Err(NotFound::TooFewMarkers { found: 1, least: self.least_markers.max(2) });
        }
        view.into_board_view()
    }

    /// The largest set of markers that agree about where the board is, each marker once.
    fn agreeing(&self, read: &[Marker]) -> Vec<Marker> {
        // The same marker under two windows of the threshold is met once.
        let mut seeds: Vec<Marker> = Vec::new();
        let mut in_cell: Vec<Vec<usize>> = vec![Vec::new(); self.marker_in_cell.len()];
        for marker in read {
            let (x, y) = self.cell_of_marker[marker.id];
            let here = &mut in_cell[y * self.cells.0 + x];
            let side = marker.corners[0].distance(marker.corners[2]);
            if here.len() < MOST_COPIES
                && here.iter().all(|&i| seeds[i].corners[0].distance(marker.corners[0]) > 0.2 * side)
            {
                here.push(seeds.len());
                seeds.push(*marker);
            }
        }
        let maps: Vec<Option<PlaneMap>> = seeds
            .iter()
            .map(|seed| {
                let places = self.corners_of_marker[seed.id];
                let pairs: Vec<Pair> = (0..4).map(|i| (places[i], seed.corners[i], 1.0)).collect();
                PlaneMap::fit(&pairs, places[0], self.spacing_m)
            })
            .collect();
        let agree = |a: usize, b: usize| {
            let Some(map) = &maps[a] else { return false };
            let seen = &seeds[b].corners;
            let side = (0..4).map(|i| seen[i].distance(seen[(i + 1) % 4])).fold(f64::MAX, f64::min);
            (0..4).all(|i| {
                map.pixel(self.corners_of_marker[seeds[b].id][i])
                    .is_some_and(|pixel| pixel.distance(seen[i]) < AGREE_SIDES * side + 1.0)
            })
        };
        let mut group: Vec<usize> = (0..seeds.len()).collect();
        let mut supporters = vec![0; seeds.len()];
        for a in 0..seeds.len() {
            let (x, y) = self.cell_of_marker[seeds[a].id];
            for cell_y in y.saturating_sub(2)..(y + 3).min(self.cells.1) {
                for cell_x in x.saturating_sub(2)..(x + 3).min(self.cells.0) {
                    for &b in &in_cell[cell_y * self.cells.0 + cell_x] {
                        if b > a && seeds[a].id != seeds[b].id && agree(a, b) && agree(b, a) {
                            supporters[a] += 1;
                            supporters[b] += 1;
                            let (from, to) = (group[a].max(group[b]), group[a].min(group[b]));
                            group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
                        }
                    }
                }
            }
        }
        let mut sizes = vec![0; seeds.len()];
        group.iter().for_each(|&g| sizes[g] += 1);
        let Some(largest) = (0..seeds.len()).rev().max_by_key(|&g| sizes[g]) else { return Vec::new() };
        let mut best: Vec<Option<usize>> = vec![None; self.cell_of_marker.len()];
        for (i, seed) in seeds.iter().enumerate().filter(|(i, _)| group[*i] == largest) {
            let place = &mut best[seed.id];
            if place.is_none_or(|other| supporters[i] > supporters[other]) {
                *place = Some(i);
            }
        }
        best.into_iter().flatten().map(|i| seeds[i]).collect()
    }
}

/// A picture may show a board several times; so many copies of one marker are looked at.
const MOST_COPIES: usize = 24;

impl View<'_> {
    /// Finds points from those that are known already until no more are met.
    fn grow(&mut self) {
        let board = self.board;
        let mut waiting: VecDeque<usize> = VecDeque::new();
        let mut is_waiting = vec![false; board.points.len()];
        let mut tries = vec![0u8; board.points.len()];
        // Points with the most markers around them first: they are predicted best.
        let mut first: Vec<usize> = (0..board.points.len()).collect();
        let known = |point: usize| board.markers_of_point[point].iter().filter(|&&m| self.agrees[m]).count();
        first.retain(|&point| known(point) > 0);
        first.sort_by_key(|&point| std::cmp::Reverse(known(point)));
        for point in first {
            is_waiting[point] = true;
            waiting.push_back(point);
        }
        while let Some(point) = waiting.pop_front() {
            is_waiting[point] = false;
            if self.seen[point].is_some() || tries[point] >= MOST_TRIES {
                continue;
            }
            tries[point] += 1;
            let (columns, rows) = board.grid;
            for met in self.try_point(point) {
                let (column, row) = (met % columns, met / columns);
                for y in row.saturating_sub(2)..(row + 3).min(rows) {
                    for x in column.saturating_sub(2)..(column + 3).min(columns) {
                        let next = y * columns + x;
                        if self.seen[next].is_none() && !is_waiting[next] && tries[next] < MOST_TRIES {
                            is_waiting[next] = true;
                            waiting.push_back(next);
                        }
                    }
                }
            }
        }
    }

    /// The map of the board around a place, from the points seen near it, and from markers where those are few.
    fn map_around(
        &self,
        place: (f64, f64),
        column: usize,
        row: usize,
        without: Option<usize>,
    ) -> Option<PlaneMap> {
        let board = self.board;
        let (columns, rows) = board.grid;
        let mut pairs: Vec<Pair> = Vec::with_capacity(64);
        let weight = |at: (f64, f64)| {
            let distance = (at.0 - place.0).hypot(at.1 - place.1) / board.spacing_m;
            (-0.5 * (distance / 1.5).powi(2)).exp()
        };
        let reach = board.reach;
        for y in row.saturating_sub(reach)..(row + reach + 1).min(rows) {
            for x in column.saturating_sub(reach)..(column + reach + 1).min(columns) {
                let other = y * columns + x;
                if let Some(pixel) = self.seen[other]
                    && without != Some(other)
                {
                    let at = (board.points[other].x_m, board.points[other].y_m);
                    pairs.push((at, pixel, weight(at)));
                }
            }
        }
        if pairs.len() < 6 && without.is_none() {
            let (cell_x, cell_y) = (column * board.cells.0 / columns, row * board.cells.1 / rows);
            for y in cell_y.saturating_sub(2)..(cell_y + 3).min(board.cells.1) {
                for x in cell_x.saturating_sub(2)..(cell_x + 3).min(board.cells.0) {
                    let Some(marker) = board.marker_in_cell[y * board.cells.0 + x] else { continue };
                    let Some(corners) = self.marker_corners[marker] else { continue };
                    for (at, pixel) in board.corners_of_marker[marker].iter().zip(corners) {
                        // Outlines are coarser than points.
                        pairs.push((*at, pixel, MARKER_WEIGHT * weight(*at)));
                    }
                }
            }
        }
        PlaneMap::fit(&pairs, place, board.spacing_m)
    }

    /// Looks for a point where it must be, and notes it where it is really there and one of its markers too. What was noted: nothing, the point,
    /// or with it others of the same marker.
    fn try_point(&mut self, point: usize) -> Vec<usize> {
        let board = self.board;
        let Some(look) = self.look_from_around(point) else { return Vec::new() };
        self.seen[point] = Some(look.pixel);
        let mut met = vec![point];
        let markers = &board.markers_of_point[point];
        if markers.iter().any(|&marker| self.agrees[marker]) {
            return met;
        }
        // One of its markers at least must be there, as far as the new point makes it known where.
        for &marker in markers {
            if !board.is_chessboard {
                // No other marker shares its points, so they are to be found together.
                for &other in &board.points_of_marker[marker] {
                    if self.seen[other].is_none()
                        && let Some(look) = self.look_from_around(other)
                    {
                        self.seen[other] = Some(look.pixel);
                        met.push(other);
                    }
                }
            }
            if self.marker_is_there(marker) == Some(true) {
                self.agrees[marker] = true;
                return met;
            }
        }
        for met in met {
            self.seen[met] = None;
        }
        Vec::new()
    }

    /// Looks for a point where what is known around it has it.
    fn look_from_around(&mut self, point: usize) -> Option<PointLook> {
        let board = self.board;
        let place = (board.points[point].x_m, board.points[point].y_m);
        let map = self.map_around(place, point % board.grid.0, point / board.grid.0, None)?;
        self.look(point, &map)
    }

    /// Looks for a point where a map has it.
    fn look(&mut self, point: usize, map: &PlaneMap) -> Option<PointLook> {
        let board = self.board;
        let place = (board.points[point].x_m, board.points[point].y_m);
        let width = least_width(map.steps(place, 1.0)?) * board.spacing_m;
        if !(LEAST_SPACING_PX..1e4).contains(&width) {
            return None;
        }
        let look = |blur_px: f64| {
            let expected = Expected {
                map,
                place,
                plain_m: board.plain_m,
                spacing_m: board.spacing_m,
                black_upper_left: board.black_upper_left[point],
                most_off_px: OFF_PX + OFF_SPACINGS * width,
                drawing: self.is_as_drawn.then_some((&board.drawing, blur_px)),
            };
            look_at(self.image, &expected)
        };
        if !self.is_as_drawn || self.blurs.len() >= POINTS_FOR_BLUR {
            return look(self.blur_px);
        }
        // The first points tell how blurred the image is: the blur that explains them best.
        let tried = BLURS_PX.into_iter().filter_map(|blur_px| Some((blur_px, look(blur_px)?)));
        let (blur_px, best) = tried.min_by(|a, b| a.1.residual.total_cmp(&b.1.residual))?;
        self.blurs.push(blur_px);
        self.blur_px = median(&mut self.blurs).unwrap_or(blur_px);
        Some(best)
    }

    /// Whether a marker is where the points around it tell; `None` where they are too few, or nothing like any marker is there.
    fn marker_is_there(&self, marker: usize) -> Option<bool> {
        let board = self.board;
        let known =
            board.points_of_marker[marker].iter().filter(|&&point| self.seen[point].is_some()).count();
        if known < 2 {
            return None;
        }
        let [a, b, _, d] = board.corners_of_marker[marker];
        let (right, down) = ((b.0 - a.0, b.1 - a.1), (d.0 - a.0, d.1 - a.1));
        let at = |x: f64, y: f64| (a.0 + x * right.0 + y * down.0, a.1 + x * right.1 + y * down.1);
        let &nearest = board.points_of_marker[marker].first()?;
        let (column, row) = (nearest % board.grid.0, nearest / board.grid.0);
        let map = self.map_around(at(0.5, 0.5), column, row, None)?;
        let side = (b.0 - a.0).hypot(b.1 - a.1);
        let width = least_width(map.steps(at(0.5, 0.5), side)?);
        let readings = board.codes.layouts.iter().filter_map(|&layout: &Layout| {
            let bit_px = width / layout.side() as f64;
            markers::read(self.image, layout, board.codes.quiet, bit_px, &|x, y| map.pixel(at(x, y)))
        });
        readings.map(|reading| board.codes.looks_like(marker, &reading)).reduce(|a, b| a || b)
    }

    /// Whether among the markers that the points hold in place, those that look as they must outnumber those that look otherwise.
    fn is_plausible(&self) -> bool {
        let readings = (0..self.agrees.len()).filter_map(|marker| self.marker_is_there(marker));
        let (right, wrong) =
            readings.fold(
                (0, 0),
                |(right, wrong), is_there| {
                    if is_there { (right + 1, wrong) } else { (right, wrong + 1) }
                },
            );
        right >= self.board.least_markers && right > wrong
    }

    /// Forgets points that are not where their neighbours have them.
    fn drop_outliers(&mut self) {
        let board = self.board;
        let mut wrong = Vec::new();
        for point in 0..board.points.len() {
            let Some(pixel) = self.seen[point] else { continue };
            let place = (board.points[point].x_m, board.points[point].y_m);
            let (column, row) = (point % board.grid.0, point / board.grid.0);
            let Some(map) = self.map_around(place, column, row, Some(point)) else { continue };
            let (Some(predicted), Some(steps)) = (map.pixel(place), map.steps(place, board.spacing_m)) else {
                wrong.push(point);
                continue;
            };
            if pixel.distance(predicted) > 0.5 + 0.08 * least_width(steps) {
                wrong.push(point);
            }
        }
        for point in wrong {
            self.seen[point] = None;
        }
    }

    /// Finds all points anew, now that the map around each is known from all sides; those that are not found again are forgotten.
    fn refine(&mut self) {
        let before = self.seen.clone();
        let mut after = vec![None; before.len()];
        for point in (0..before.len()).filter(|&point| before[point].is_some()) {
            after[point] = self.look_from_around(point).map(|look| look.pixel);
        }
        self.seen = after;
    }

    fn into_board_view(self) -> Result<BoardView, NotFound> {
        let points: Vec<SeenPoint> = self
            .seen
            .iter()
            .enumerate()
            .filter_map(|(index, pixel)| pixel.map(|pixel| SeenPoint { index, pixel }))
            .collect();
        if points.len() < LEAST_POINTS {
            return Err(NotFound::Blurred);
        }
        // Points in one row tell no pose.
        let (columns, rows) = self.board.grid;
        let span = |of: &dyn Fn(usize) -> usize| {
            let values = points.iter().map(|point| of(point.index));
            values.clone().max().unwrap_or(0) + 1 - values.min().unwrap_or(0)
        };
        let seen = (span(&|index| index % columns), span(&|index| index / columns));
        if seen.0 < 2 || seen.1 < 2 {
            return Err(NotFound::Partial { expected: (columns, rows), seen, points: points.len() });
        }
        Ok(BoardView { size: (self.image.width(), self.image.height()), points })
    }
}

/// The blurs that are tried, standard deviations in pixels, and how many points choose.
const BLURS_PX: [f64; 6] = [0.35, 0.6, 0.85, 1.1, 1.4, 1.8];
const POINTS_FOR_BLUR: usize = 5;
/// How often a point is looked for; each time more is known around it.
const MOST_TRIES: u8 = 4;
/// Weight of a marker's corner against that of a point.
const MARKER_WEIGHT: f64 = 0.02;
/// Where squares are smaller, their corners run into each other, pixels.
const LEAST_SPACING_PX: f64 = 6.0;

#[cfg(test)]
mod tests;
