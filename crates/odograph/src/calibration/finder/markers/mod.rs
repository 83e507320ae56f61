//! Square markers (ArUco, AprilTag) in an image: where they are, which they are, and how they are turned.
//!
//! The way of S. Garrido-Jurado et al., "Automatic generation and detection of highly reliable fiducial markers under occlusion", 2014:
//! dark areas by a local threshold, their outlines, those that are quadrangles, the bits within. What is looked up afterwards is only
//! what the board has.

mod bits;
mod blurred;
mod outlines;
mod quadrangles;
mod threshold;

pub(super) use bits::{Layout, interpolated, read};

use super::plane_map::{PlaneMap, least_width};
use crate::geometry::Pixel;
use crate::image::GrayImage;
use bits::Reading;
use blurred::Blurred;
use threshold::Dark;

/// The markers of a board, as they are to be looked up.
#[derive(Debug, Clone)]
pub(super) struct Codes {
    /// How they are drawn; where more than one way is in use, the first that reads is taken.
    pub layouts: Vec<Layout>,
    /// White around a marker, in its sides.
    pub quiet: f64,
    /// Each marker turned clockwise by 0 to 3 quarter turns.
    turned: Vec<[u64; 4]>,
    /// Wrong bits that are forgiven.
    pub most_wrong: u32,
    /// What they look like when blurred.
    blurred: Blurred,
    /// The windows of the threshold, in tiles around the middle one, and how far below the mean it lies, in standard deviations.
    windows: Vec<(usize, f64)>,
}

/// A marker that was read.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Marker {
    /// Which of [`Codes`].
    pub id: usize,
    /// Its corners, from its top left clockwise as printed.
    pub corners: [Pixel; 4],
    /// Which of [`Codes::layouts`] it was read by.
    pub layout: usize,
}

/// What was read in an image.
#[derive(Debug, Clone, Default)]
pub(super) struct Markers {
    /// Markers of the board, in the order they were met.
    pub read: Vec<Marker>,
    /// What reads as a marker of the board in a mirror, and not otherwise.
    pub mirrored: Vec<Marker>,
    /// The dark quadrangles, clockwise.
    pub quadrangles: Vec<[Pixel; 4]>,
}

/// Dark areas less wide or high than this hold no marker that can be read, pixels.
const LEAST_PX: usize = 6;
/// Most quadrangles that are read, a bound on time: a full board has some hundred.
const MOST_QUADRANGLES: usize = 20_000;

impl Codes {
    /// The codes of markers of `bits` by `bits`; bit errors are forgiven as far as these markers' distances allow and one less.
    pub fn new(markers: &[u64], layouts: Vec<Layout>, quiet: f64, windows: &[(usize, f64)]) -> Self {
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
        let most_wrong = (least.saturating_sub(1) / 2).saturating_sub(1).min(MOST_FORGIVEN);
        let blurred = Blurred::new(&turned, bits);
        Self { layouts, quiet, turned, most_wrong, blurred, windows: windows.to_vec() }
    }

    /// The marker with the fewest wrong bits, and how often it is turned clockwise by a quarter.
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

    /// Whether a reading looks like a marker, upright, that is expected there: most of its bits are right, or its grays are much like the
    /// marker blurred. Unrelated grays correlate by chance the less, the more bits there are.
    pub fn looks_like(&self, id: usize, reading: &Reading) -> bool {
        let side = self.layouts.first().map_or(1, |layout| layout.bits) as f64;
        let wrong = (self.turned[id][0] ^ reading.bits).count_ones();
        f64::from(wrong) <= MOST_WRONG_EXPECTED * side * side
            || self.blurred.likeness(id, &reading.grays) >= 0.4 + 1.4 / side
    }
}

/// The part of the bits of an expected marker that may be wrong.
const MOST_WRONG_EXPECTED: f64 = 0.15;
/// Bits larger than this read without regard to blur, or not at all, pixels.
const BLURRED_BIT_PX: f64 = 6.0;
/// With more, markers are found in texture.
const MOST_FORGIVEN: u32 = 3;

/// Bits after a clockwise quarter turn.
fn turned_once(bits: u64, side: usize) -> u64 {
    let bit = |column: usize, row: usize| bits >> (side * side - 1 - row * side - column) & 1;
    (0..side * side).fold(0, |turned, at| turned << 1 | bit(at / side, side - 1 - at % side))
}

/// Bits as a mirror shows them, left and right exchanged.
fn in_mirror(bits: u64, side: usize) -> u64 {
    let bit = |column: usize, row: usize| bits >> (side * side - 1 - row * side - column) & 1;
    (0..side * side).fold(0, |turned, at| turned << 1 | bit(side - 1 - at % side, at / side))
}

/// All markers of the board that can be read in an image. One may be met more than once: under each window, and where a picture shows it
/// several times.
pub(super) fn find(image: &GrayImage, codes: &Codes) -> Markers {
    let mut markers = Markers::default();
    for (reach, below) in codes.windows.iter().copied() {
        let dark = Dark::new(image, reach, below);
        for outline in outlines::outlines(image, &dark, LEAST_PX) {
            let Some(corners) = quadrangles::quadrangle(&outline) else { continue };
            let Some(corners) = quadrangles::moved_to_edges(image, &corners) else { continue };
            if markers.quadrangles.len() == MOST_QUADRANGLES {
                return markers;
            }
            markers.quadrangles.push(corners);
            identify(image, codes, corners, &mut markers);
        }
    }
    markers
}

/// The markers of a chessboard's white squares, looked for between its black squares.
///
/// Where bits are small, blur breaks a marker's narrow border and its outline is no quadrangle, but the black squares beside it still
/// are. Each tells where its four white neighbours are; their far corners are those of further black squares, if there are any near.
pub(super) fn find_between(image: &GrayImage, codes: &Codes, markers: &mut Markers) {
    let squares = std::mem::take(&mut markers.quadrangles);
    let mut corners: Vec<Pixel> = squares.iter().flatten().copied().collect();
    corners.sort_by(|a, b| a.x.total_cmp(&b.x));
    let nearest = |to: Pixel, within: f64| {
        let first = corners.partition_point(|corner| corner.x < to.x - within);
        let near = corners[first..].iter().take(MOST_NEAR).take_while(|corner| corner.x <= to.x + within);
        near.min_by(|a, b| a.distance(to).total_cmp(&b.distance(to)))
            .filter(|corner| corner.distance(to) < within)
    };
    let inset = codes.quiet / (1.0 + 2.0 * codes.quiet);
    for square in &squares {
        let Some(map) = map_of_square(square) else { continue };
        for side in 0..4 {
            let (from, to) = (SQUARE[side], SQUARE[(side + 1) % 4]);
            // Outwards of a clockwise side is to its left.
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

/// Corners in one column of the image that are looked through for the nearest, a bound on time.
const MOST_NEAR: usize = 400;

const SQUARE: [(f64, f64); 4] = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];

/// The homography from the unit square to a quadrangle.
fn map_of_square(corners: &[Pixel; 4]) -> Option<PlaneMap> {
    // Heavy, so that nothing holds the perspective back.
    let pairs = [0, 1, 2, 3].map(|i| (SQUARE[i], corners[i], 1e6));
    PlaneMap::fit(&pairs, (0.5, 0.5), 1.0)
}

/// Reads a quadrangle and notes the marker it is, if any.
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
            // Turned clockwise once, the marker's top left corner is the quadrangle's second.
            let corners = [0, 1, 2, 3].map(|i| corners[(i + turn) % 4]);
            markers.read.push(Marker { id, corners, layout: drawn });
            return;
        }
        let mirrored = codes.look_up(in_mirror(reading.bits, layout.bits));
        if let Some((id, turn)) = mirrored {
            // Seen in a mirror, the corners run the other way round, from the second.
            let corners = [1, 0, 3, 2].map(|i| corners[i]);
            let corners = [0, 1, 2, 3].map(|i| corners[(i + turn) % 4]);
            markers.mirrored.push(Marker { id, corners, layout: drawn });
        }
        if mirrored.is_some() {
            return;
        }
    }
}
