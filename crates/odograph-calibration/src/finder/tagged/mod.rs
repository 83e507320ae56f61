//! Detection of boards with markers. Partial views are sufficient, because each marker identifies
//! its position on the board.
//!
//! A consistent set of decoded markers predicts the corners around them. Each corner is then
//! located in the image on its own, and located corners predict further ones, whose markers are
//! verified bit by bit at the predicted position. All predictions use local homographies over a few
//! squares, so they tolerate lens distortion.

mod layout;

use super::NotFound;
use super::markers::{self, Codes, Marker, MarkerLayout};
use super::plane_map::{PlaneMap, WeightedMatch, least_width};
use super::points::{Expected, PointLook, look_at};
use crate::{BoardPoint, BoardView, Drawing, SeenPoint};
use odograph::geometry::Pixel;
use odograph::image::GrayImage;
use odograph::numerics::median;
use std::collections::VecDeque;

/// A board with markers and precomputed data for its detection.
#[derive(Debug, Clone)]
pub(super) struct TaggedBoard {
    points: Vec<BoardPoint>,
    /// Columns and rows of the point grid.
    grid: (usize, usize),
    /// Columns and rows of cells that may hold a marker, and the marker in each cell.
    cells: (usize, usize),
    marker_in_cell: Vec<Option<usize>>,
    /// The cell of each marker, and its corners on the board, clockwise from the top left as
    /// printed, metres.
    cell_of_marker: Vec<(usize, usize)>,
    corners_of_marker: Vec<[(f64, f64); 4]>,
    /// The markers adjacent to each point, and the points adjacent to each marker.
    markers_of_point: Vec<Vec<usize>>,
    points_of_marker: Vec<Vec<usize>>,
    /// Whether the upper left and lower right squares at a point are black; the other two have the
    /// opposite colour.
    black_upper_left: Vec<bool>,
    codes: Codes,
    drawing: Drawing,
    /// Distance from a point within which the four squares around it are uniform, metres.
    pub(super) plain_m: f64,
    /// Unit of distance for predictions (metres), and radius of the neighbourhood used for a
    /// prediction (points of the grid).
    spacing_m: f64,
    pub(super) reach: usize,
    /// Minimum number of consistent markers for a detection.
    pub(super) least_markers: usize,
    /// Whether the markers are in the white squares of a chessboard.
    pub(super) is_chessboard: bool,
}

/// Minimum number of points for a view: fewer do not determine a homography.
const MIN_POINTS: usize = 4;
/// Tolerance for the consistency of two markers, in sides of a marker: the homography of each must
/// predict the corners of the other. Only nearby markers are compared, because the homography of a
/// small marker extrapolates poorly.
const AGREE_SIDES: f64 = 0.4;
/// Maximum distance between prediction and detection of a point: a share of the minimum width of a
/// spacing, plus a constant in pixels.
const OFF_SPACINGS: f64 = 0.12;
const OFF_PX: f64 = 1.0;

/// State of the region growing in one image.
struct GrowingView<'a> {
    image: &'a GrayImage,
    board: &'a TaggedBoard,
    seen: Vec<Option<Pixel>>,
    /// Image corners of the decoded markers, and whether each marker is confirmed.
    marker_corners: Vec<Option<[Pixel; 4]>>,
    agrees: Vec<bool>,
    /// Whether the printed markers match the board's drawing in the width of their border.
    is_as_drawn: bool,
    /// Blur estimates from the first points, pixels.
    blurs: Vec<f64>,
    blur_px: f64,
}

impl TaggedBoard {
    /// Detects the board, which may be partly visible.
    pub fn find(&self, image: &GrayImage) -> Result<BoardView, NotFound> {
        let mut found = markers::find(image, &self.codes, markers::MIN_PX);
        let mut agreeing = self.agreeing(&found.read);
        if agreeing.len() < self.least_markers && self.is_chessboard {
            markers::find_between(image, &self.codes, &mut found);
            agreeing = self.agreeing(&found.read);
        }
        // A few markers resemble others in the mirrored image.
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
        let mut view = GrowingView {
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

    /// Position of a point on the board, metres.
    fn place(&self, point: usize) -> (f64, f64) {
        (self.points[point].x_m, self.points[point].y_m)
    }

    /// Numbers of mutually consistent markers among those of a larger dictionary.
    pub fn numbers_agreeing(&self, read: &[Marker]) -> Vec<usize> {
        let own: Vec<Marker> =
            read.iter().filter(|marker| marker.id < self.cell_of_marker.len()).copied().collect();
        self.agreeing(&own).into_iter().map(|marker| marker.id).collect()
    }

    /// The largest set of mutually consistent markers (a connected component), each marker once.
    fn agreeing(&self, read: &[Marker]) -> Vec<Marker> {
        // A marker may be decoded with several windows of the threshold; duplicates are dropped.
        let mut seeds: Vec<Marker> = Vec::new();
        let mut in_cell: Vec<Vec<usize>> = vec![Vec::new(); self.marker_in_cell.len()];
        for marker in read {
            let (x, y) = self.cell_of_marker[marker.id];
            let here = &mut in_cell[y * self.cells.0 + x];
            let side = marker.corners[0].distance(marker.corners[2]);
            if here.len() < MAX_COPIES
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
                let pairs: Vec<WeightedMatch> = (0..4).map(|i| (places[i], seed.corners[i], 1.0)).collect();
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

/// Maximum number of copies of one marker that are considered; an image may show several boards.
const MAX_COPIES: usize = 24;

impl GrowingView<'_> {
    /// Region growing: locates points from known ones until no more are found.
    fn grow(&mut self) {
        let board = self.board;
        let mut waiting: VecDeque<usize> = VecDeque::new();
        let mut is_waiting = vec![false; board.points.len()];
        let mut tries = vec![0u8; board.points.len()];
        // Points with the most confirmed markers have the best predictions, so they come first.
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
            if self.seen[point].is_some() || tries[point] >= MAX_TRIES {
                continue;
            }
            tries[point] += 1;
            let (columns, rows) = board.grid;
            for met in self.try_point(point) {
                let (column, row) = (met % columns, met / columns);
                for y in row.saturating_sub(2)..(row + 3).min(rows) {
                    for x in column.saturating_sub(2)..(column + 3).min(columns) {
                        let next = y * columns + x;
                        if self.seen[next].is_none() && !is_waiting[next] && tries[next] < MAX_TRIES {
                            is_waiting[next] = true;
                            waiting.push_back(next);
                        }
                    }
                }
            }
        }
    }

    /// The local homography around a position close to a point, from the located points nearby and,
    /// if those are few, from marker corners. The point `without` is excluded.
    fn map_around(&self, place: (f64, f64), point: usize, without: Option<usize>) -> Option<PlaneMap> {
        let board = self.board;
        let (columns, rows) = board.grid;
        let (column, row) = (point % columns, point / columns);
        let mut pairs: Vec<WeightedMatch> = Vec::with_capacity(64);
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
                    let at = board.place(other);
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
                        // Corners from outlines are less accurate than located points.
                        pairs.push((*at, pixel, MARKER_WEIGHT * weight(*at)));
                    }
                }
            }
        }
        PlaneMap::fit(&pairs, place, board.spacing_m)
    }

    /// Locates a point and accepts it if one of its markers is confirmed in the image. Returns the
    /// newly located points: empty, the point, or the point with others of the same marker.
    fn try_point(&mut self, point: usize) -> Vec<usize> {
        let board = self.board;
        let Some(look) = self.look_from_around(point) else { return Vec::new() };
        self.seen[point] = Some(look.pixel);
        let mut met = vec![point];
        let markers = &board.markers_of_point[point];
        if markers.iter().any(|&marker| self.agrees[marker]) {
            return met;
        }
        // At least one of its markers must be confirmed, as far as the new point makes its position
        // known.
        for &marker in markers {
            if !board.is_chessboard {
                // The points of a marker are not shared with other markers, so they must be located
                // together.
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

    /// Locates a point at the position predicted by its neighbourhood.
    fn look_from_around(&mut self, point: usize) -> Option<PointLook> {
        let map = self.map_around(self.board.place(point), point, None)?;
        self.look(point, &map)
    }

    /// Locates a point at the position predicted by a map.
    fn look(&mut self, point: usize, map: &PlaneMap) -> Option<PointLook> {
        let board = self.board;
        let place = board.place(point);
        let width = least_width(map.steps(place, 1.0)?) * board.spacing_m;
        if !(MIN_SPACING_PX..1e4).contains(&width) {
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
        // The first points estimate the blur of the image: the one with the smallest residual.
        let tried = BLURS_PX.into_iter().filter_map(|blur_px| Some((blur_px, look(blur_px)?)));
        let (blur_px, best) = tried.min_by(|a, b| a.1.residual.total_cmp(&b.1.residual))?;
        self.blurs.push(blur_px);
        self.blur_px = median(&mut self.blurs).unwrap_or(blur_px);
        Some(best)
    }

    /// Whether a marker is visible at the position predicted by its points. `None` if too few
    /// points are located, or if nothing there can be decoded as a marker.
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
        let map = self.map_around(at(0.5, 0.5), nearest, None)?;
        let side = (b.0 - a.0).hypot(b.1 - a.1);
        let width = least_width(map.steps(at(0.5, 0.5), side)?);
        let readings = board.codes.layouts.iter().filter_map(|&layout: &MarkerLayout| {
            let bit_px = width / layout.side() as f64;
            markers::read(self.image, layout, board.codes.quiet, bit_px, &|x, y| map.pixel(at(x, y)))
        });
        readings.map(|reading| board.codes.looks_like(marker, &reading)).reduce(|a, b| a || b)
    }

    /// Plausibility check: among all markers whose position is known, those with the expected code
    /// must outnumber those with another one.
    fn is_plausible(&self) -> bool {
        let readings: Vec<bool> =
            (0..self.agrees.len()).filter_map(|marker| self.marker_is_there(marker)).collect();
        let right = readings.iter().filter(|&&is_there| is_there).count();
        right >= self.board.least_markers && 2 * right > readings.len()
    }

    /// Rejects points that are inconsistent with their neighbours.
    fn drop_outliers(&mut self) {
        let board = self.board;
        let mut wrong = Vec::new();
        for point in 0..board.points.len() {
            let Some(pixel) = self.seen[point] else { continue };
            let place = board.place(point);
            let Some(map) = self.map_around(place, point, Some(point)) else { continue };
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

    /// Locates all points again, now that each has neighbours on all sides; points that are not
    /// found again are dropped.
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
        if points.len() < MIN_POINTS {
            return Err(NotFound::Blurred);
        }
        // Points in a single row do not determine a pose.
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

/// Hypotheses of the blur, standard deviation in pixels, and number of points that select among
/// them.
const BLURS_PX: [f64; 6] = [0.35, 0.6, 0.85, 1.1, 1.4, 1.8];
const POINTS_FOR_BLUR: usize = 5;
/// Maximum number of attempts per point; each time more neighbours are known.
const MAX_TRIES: u8 = 4;
/// Weight of a marker corner relative to a located point.
const MARKER_WEIGHT: f64 = 0.02;
/// Minimum spacing in the image, pixels; below it, adjacent corners merge.
const MIN_SPACING_PX: f64 = 6.0;
