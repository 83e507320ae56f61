//! Detection of square fiducial markers (ArUco, AprilTag): position, identity and orientation.
//!
//! The method is that of S. Garrido-Jurado et al., "Automatic generation and detection of highly
//! reliable fiducial markers under occlusion", 2014: adaptive threshold, outlines of dark regions,
//! selection of quadrangles, decoding of the bits. Only the markers of the board are looked up.

mod bits;
mod blurred;
mod outlines;
mod quadrangles;
mod threshold;

pub(super) use bits::{MarkerLayout, read};

use super::plane_map::{PlaneMap, least_width};
use crate::dictionary::{bit, turned_once};
use bits::Reading;
use blurred::Blurred;
use odograph::geometry::Pixel;
use odograph::image::GrayImage;
use threshold::Dark;

/// The codes of a board's markers, prepared for decoding.
#[derive(Debug, Clone)]
pub(super) struct Codes {
    /// Possible layouts of the printed markers; the first one that can be decoded is used.
    pub layouts: Vec<MarkerLayout>,
    /// Width of the white quiet zone around a marker, in sides of the marker.
    pub quiet: f64,
    /// The code of each marker, rotated clockwise by 0 to 3 quarter turns.
    turned: Vec<[u64; 4]>,
    /// Maximum number of corrected bit errors.
    pub most_wrong: u32,
    /// Templates of the blurred markers.
    blurred: Blurred,
    /// Windows of the adaptive threshold: radius in tiles, and offset below the local mean in
    /// standard deviations.
    windows: Vec<(usize, f64)>,
}

/// A decoded marker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Marker {
    /// Index into the markers of [`Codes`].
    pub id: usize,
    /// Corners in the image, clockwise from the marker's top left as printed.
    pub corners: [Pixel; 4],
    /// Index into [`Codes::layouts`].
    pub layout: usize,
}

/// Detections in an image.
#[derive(Debug, Clone, Default)]
pub(super) struct Markers {
    /// Decoded markers of the board, in the order of detection.
    pub read: Vec<Marker>,
    /// Quadrangles that can only be decoded as mirrored markers of the board.
    pub mirrored: Vec<Marker>,
    /// Dark quadrangles, with clockwise corners.
    pub quadrangles: Vec<[Pixel; 4]>,
}

/// Minimum width and height of a dark region with a decodable marker, pixels.
pub(super) const MIN_PX: usize = 6;
/// Maximum number of decoded quadrangles, to bound the run time; a full board has some hundred.
const MAX_QUADRANGLES: usize = 4000;

impl Codes {
    /// Codes for markers of `bits` by `bits`. The number of corrected bit errors is one less than
    /// the minimum Hamming distance of these markers permits.
    pub fn new(markers: &[u64], layouts: Vec<MarkerLayout>, quiet: f64, windows: &[(usize, f64)]) -> Self {
        let bits = layouts.first().map_or(0, |layout| layout.bits);
        let turned: Vec<[u64; 4]> = markers
            .iter()
            .map(|&marker| {
                let mut turns = [marker; 4];
                for turn in 1..4 {
                    turns[turn] = turned_once(turns[turn - 1], bits);
                }
                turns
            })
            .collect();
        let mut least = (bits * bits) as u32;
        for (i, turns) in turned.iter().enumerate() {
            for turn in 1..4 {
                least = least.min((turns[0] ^ turns[turn]).count_ones());
            }
            for other in &turned[..i] {
                for &turned in other {
                    least = least.min((turns[0] ^ turned).count_ones());
                }
            }
        }
        let most_wrong = (least.saturating_sub(1) / 2).saturating_sub(1).min(MAX_FORGIVEN);
        let blurred = Blurred::new(&turned, bits);
        Self { layouts, quiet, turned, most_wrong, blurred, windows: windows.to_vec() }
    }

    /// The marker with the smallest Hamming distance, and the number of clockwise quarter turns;
    /// `None` with too many bit errors.
    fn look_up(&self, bits: u64) -> Option<(usize, usize)> {
        let mut best = (self.most_wrong + 1, None);
        for (id, turns) in self.turned.iter().enumerate() {
            for (turn, &code) in turns.iter().enumerate() {
                let wrong = (code ^ bits).count_ones();
                if wrong < best.0 {
                    best = (wrong, Some((id, turn)));
                }
            }
        }
        best.1
    }

    /// Whether a reading matches an expected upright marker: either most bits are right, or the
    /// gray levels correlate with the blurred marker. The more bits there are, the lower is the
    /// correlation by chance, and the lower the threshold.
    pub fn looks_like(&self, id: usize, reading: &Reading) -> bool {
        let side = self.layouts.first().map_or(1, |layout| layout.bits) as f64;
        let wrong = (self.turned[id][0] ^ reading.bits).count_ones();
        f64::from(wrong) <= MAX_WRONG_EXPECTED * side * side
            || self.blurred.likeness(id, &reading.grays) >= 0.4 + 1.4 / side
    }
}

/// Maximum share of wrong bits of an expected marker.
const MAX_WRONG_EXPECTED: f64 = 0.15;
/// Maximum bit size for matching blurred templates, pixels; larger bits are only decoded one by
/// one.
const BLURRED_BIT_PX: f64 = 6.0;
/// Maximum number of corrected bit errors; with more, texture is decoded as markers.
const MAX_FORGIVEN: u32 = 3;

/// The bits mirrored left to right.
fn in_mirror(bits: u64, side: usize) -> u64 {
    (0..side * side).fold(0, |turned, at| turned << 1 | bit(bits, side, side - 1 - at % side, at / side))
}

/// All decodable markers of the board in an image. A marker may be detected several times: once for
/// each window, and for each copy in the image. Dark regions narrower or lower than `least_px` are
/// not looked at.
pub(super) fn find(image: &GrayImage, codes: &Codes, least_px: usize) -> Markers {
    let mut markers = Markers::default();
    for (reach, below) in codes.windows.iter().copied() {
        let dark = Dark::new(image, reach, below);
        for outline in outlines::outlines(image, &dark, least_px) {
            let Some(corners) = quadrangles::quadrangle(&outline) else { continue };
            let Some(corners) = quadrangles::moved_to_edges(image, &corners) else { continue };
            if markers.quadrangles.len() == MAX_QUADRANGLES {
                return markers;
            }
            markers.quadrangles.push(corners);
            identify(image, codes, corners, &mut markers);
        }
    }
    markers
}

/// Searches for the markers in the white squares of a chessboard, starting from its black squares.
///
/// If bits are small, blur breaks the narrow border of a marker, so that its outline is not a
/// quadrangle; the outlines of the black squares still are. Each black square predicts its four
/// white neighbours. Their far corners are taken from further black squares if there are any
/// nearby.
pub(super) fn find_between(image: &GrayImage, codes: &Codes, markers: &mut Markers) {
    let squares = std::mem::take(&mut markers.quadrangles);
    let mut corners: Vec<Pixel> = squares.iter().flatten().copied().collect();
    corners.sort_by(|a, b| a.x.total_cmp(&b.x));
    let nearest = |to: Pixel, within: f64| {
        let first = corners.partition_point(|corner| corner.x < to.x - within);
        let near = corners[first..].iter().take(MAX_NEAR).take_while(|corner| corner.x <= to.x + within);
        near.min_by(|a, b| a.distance(to).total_cmp(&b.distance(to)))
            .filter(|corner| corner.distance(to) < within)
    };
    let inset = codes.quiet / (1.0 + 2.0 * codes.quiet);
    for square in squares.iter().take(MAX_SQUARES) {
        let Some(map) = map_of_square(square) else { continue };
        for side in 0..4 {
            let (from, to) = (SQUARE[side], SQUARE[(side + 1) % 4]);
            // With clockwise corners, the outside is to the left of a side.
            let outwards = (to.1 - from.1, from.0 - to.0);
            let far = |from: (f64, f64)| {
                let predicted = map.pixel((from.0 + outwards.0, from.1 + outwards.1))?;
                let within = 0.25 * square[side].distance(square[(side + 1) % 4]);
                Some(nearest(predicted, within).copied().unwrap_or(predicted))
            };
            let (Some(beyond_from), Some(beyond_to)) = (far(from), far(to)) else { continue };
            let cell = [square[(side + 1) % 4], square[side], beyond_from, beyond_to];
            let Some(map) = map_of_square(&cell) else { continue };
            let place =
                |(x, y): (f64, f64)| (inset + (1.0 - 2.0 * inset) * x, inset + (1.0 - 2.0 * inset) * y);
            let [a, b, c, d] = SQUARE.map(|corner| map.pixel(place(corner)));
            if let (Some(a), Some(b), Some(c), Some(d)) = (a, b, c, d) {
                identify(image, codes, [a, b, c, d], markers);
            }
        }
    }
    markers.quadrangles = squares;
}

/// Maximum number of quadrangles whose neighbours are decoded, to bound the run time.
const MAX_SQUARES: usize = 1500;
/// Maximum number of corners searched for the nearest one within a range of x, to bound the run
/// time.
const MAX_NEAR: usize = 400;

const SQUARE: [(f64, f64); 4] = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];

/// The homography from the unit square to a quadrangle.
fn map_of_square(corners: &[Pixel; 4]) -> Option<PlaneMap> {
    // The weight is large so that the perspective prior is negligible.
    let pairs = [0, 1, 2, 3].map(|i| (SQUARE[i], corners[i], 1e6));
    PlaneMap::fit(&pairs, (0.5, 0.5), 1.0)
}

/// Decodes a quadrangle and stores the marker, if any.
fn identify(image: &GrayImage, codes: &Codes, corners: [Pixel; 4], markers: &mut Markers) {
    let Some(map) = map_of_square(&corners) else { return };
    let Some(width) = map.steps((0.5, 0.5), 1.0).map(least_width) else { return };
    for (drawn, &layout) in codes.layouts.iter().enumerate() {
        let bit_px = width / layout.side() as f64;
        let Some(reading) = read(image, layout, codes.quiet, bit_px, &|x, y| map.pixel((x, y))) else {
            continue;
        };
        let known = codes
            .look_up(reading.bits)
            .or_else(|| (bit_px < BLURRED_BIT_PX).then(|| codes.blurred.look_up(&reading.grays)).flatten());
        if let Some((id, turn)) = known {
            // After one clockwise quarter turn, the marker's top left corner is the second of the
            // quadrangle.
            let corners = [0, 1, 2, 3].map(|i| corners[(i + turn) % 4]);
            markers.read.push(Marker { id, corners, layout: drawn });
            return;
        }
        if let Some((id, turn)) = codes.look_up(in_mirror(reading.bits, layout.bits)) {
            // In a mirrored image the corners are in reverse order, starting from the second.
            let corners = [1, 0, 3, 2].map(|i| corners[i]);
            let corners = [0, 1, 2, 3].map(|i| corners[(i + turn) % 4]);
            markers.mirrored.push(Marker { id, corners, layout: drawn });
            return;
        }
    }
}
