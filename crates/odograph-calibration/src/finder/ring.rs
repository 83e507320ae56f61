//! Samples on a small circle around a point. Around a chessboard corner, black and white alternate
//! twice.

use odograph::geometry::Pixel;
use odograph::image::GrayImage;
use std::f64::consts::{PI, TAU};
use std::sync::LazyLock;

/// Radius of the circle for the edges of a corner, pixels of the pyramid level.
pub(super) const RING_PX: f64 = 4.0;

/// Number of samples on the circle.
const SAMPLES: usize = 32;

/// Cosine and sine of the angle of each sample.
static DIRECTIONS: LazyLock<[(f64, f64); SAMPLES]> = LazyLock::new(|| {
    std::array::from_fn(|i| {
        let (sine, cosine) = (TAU * i as f64 / SAMPLES as f64).sin_cos();
        (cosine, sine)
    })
});

/// The four edges that meet in a chessboard corner, detected on a circle around it.
///
/// Angles run from x to y, which is clockwise in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Ring {
    /// Outward direction of each edge, radians in 0..2π, ascending.
    pub edges: [f64; 4],
    /// Whether the arc after the first edge (towards larger angles) is white.
    pub white_after_first: bool,
    /// Mean of the black arcs and of the white arcs, gray levels.
    black: f64,
    white: f64,
}

/// Minimum contrast between black and white, gray levels; below it, the print is indistinguishable
/// from noise.
const MIN_CONTRAST: f64 = 8.0;
/// Maximum deviation of two opposite edges from a straight line, radians. It is large because the
/// centre of the circle may be off by a good part of a pixel.
const BEND: f64 = 0.7;
/// Minimum angle between the two lines, radians; reached by a very oblique board.
const SHARPEST_CROSSING: f64 = 0.3;

impl Ring {
    /// Samples the circle of `radius_px` around `centre`. `None` unless black and white alternate
    /// exactly twice, opposite arcs are of similar brightness, and the four edges form two nearly
    /// straight lines. Also `None` if the circle is not inside the image.
    pub fn read(image: &GrayImage, centre: Pixel, radius_px: f64) -> Option<Self> {
        let inside = centre.x - radius_px >= 0.0
            && centre.y - radius_px >= 0.0
            && centre.x + radius_px < image.width() as f64 - 1.0
            && centre.y + radius_px < image.height() as f64 - 1.0;
        if !inside {
            return None;
        }
        let mut samples = [0.0; SAMPLES];
        for (sample, (cosine, sine)) in samples.iter_mut().zip(DIRECTIONS.iter()) {
            *sample = bilinear(image, centre.x + radius_px * cosine, centre.y + radius_px * sine);
        }
        Self::of_samples(&samples)
    }

    fn of_samples(samples: &[f64; SAMPLES]) -> Option<Self> {
        let (mut least, mut most) = (f64::MAX, f64::MIN);
        for &sample in samples {
            least = least.min(sample);
            most = most.max(sample);
        }
        if most - least < MIN_CONTRAST {
            return None;
        }
        // The threshold is the mid-range, not the mean: black and white arcs are only of equal
        // length for a corner seen without foreshortening.
        let middle = 0.5 * (least + most);
        let mut edges = [0.0; 4];
        let mut rises = [false; 4];
        let mut found = 0;
        for i in 0..SAMPLES {
            let (here, next) = (samples[i] - middle, samples[(i + 1) % SAMPLES] - middle);
            if (here < 0.0) != (next < 0.0) {
                if found == 4 {
                    return None;
                }
                edges[found] = TAU * (i as f64 + here / (here - next)) / SAMPLES as f64;
                rises[found] = here < 0.0;
                found += 1;
            }
        }
        if found < 4 {
            return None;
        }
        for (edge, opposite) in [(0, 2), (1, 3)] {
            if (edges[opposite] - edges[edge] - PI).abs() > BEND {
                return None;
            }
        }
        for i in 0..4 {
            let arc = (edges[(i + 1) % 4] - edges[i]).rem_euclid(TAU);
            if !(SHARPEST_CROSSING..=PI - SHARPEST_CROSSING).contains(&arc) {
                return None;
            }
        }
        // The mean of each arc.
        let mut sums = [(0.0, 0.0); 4];
        for (i, &sample) in samples.iter().enumerate() {
            let angle = TAU * i as f64 / SAMPLES as f64;
            let arc = edges.iter().rposition(|&edge| edge <= angle).unwrap_or(3);
            sums[arc].0 += sample;
            sums[arc].1 += 1.0;
        }
        let means = sums.map(|(sum, count)| sum / f64::max(count, 1.0));
        let white_after_first = rises[0];
        let (pair_0, pair_1) = ([means[0], means[2]], [means[1], means[3]]);
        let (white, black) = if white_after_first { (pair_0, pair_1) } else { (pair_1, pair_0) };
        let contrast = 0.5 * (white[0] + white[1] - black[0] - black[1]);
        // Illumination varies slowly, so opposite squares are more similar than adjacent ones.
        if contrast < MIN_CONTRAST * 0.75
            || (white[0] - white[1]).abs() > 0.6 * contrast
            || (black[0] - black[1]).abs() > 0.6 * contrast
        {
            return None;
        }
        Some(Self {
            edges,
            white_after_first,
            black: 0.5 * (black[0] + black[1]),
            white: 0.5 * (white[0] + white[1]),
        })
    }

    /// Whether the arc after an edge is white.
    pub fn white_after(&self, edge: usize) -> bool {
        self.white_after_first == edge.is_multiple_of(2)
    }

    /// White minus black, gray levels.
    pub fn contrast(&self) -> f64 {
        self.white - self.black
    }

    /// Mean of black and white, gray levels.
    pub fn middle(&self) -> f64 {
        0.5 * (self.white + self.black)
    }

    /// Directions of the two lines through the corner, radians; the first one contains the first
    /// edge.
    pub fn lines(&self) -> [f64; 2] {
        [0, 1].map(|i| 0.5 * (self.edges[i] + self.edges[i + 2] - PI))
    }
    /// Whether the image is white where the signed distances from both lines (positive towards
    /// `(−sin, cos)`) have the same sign.
    pub fn white_where_alike(&self) -> bool {
        // Between the first and the second edge, a point is on the positive side of the first line
        // and on the negative side of the second.
        !self.white_after_first
    }
}

/// Bilinear interpolation; `None` outside the image.
pub(super) fn interpolated(image: &GrayImage, at: Pixel) -> Option<f64> {
    // False for NaN too.
    let inside =
        at.x >= 0.0 && at.y >= 0.0 && at.x < image.width() as f64 - 1.0 && at.y < image.height() as f64 - 1.0;
    inside.then(|| bilinear(image, at.x, at.y))
}

/// Bilinear interpolation. The point must be inside the image, as [`Ring::read`] ensures.
fn bilinear(image: &GrayImage, x: f64, y: f64) -> f64 {
    let (left, top) = (x as usize, y as usize);
    let (fx, fy) = (x - left as f64, y - top as f64);
    let (upper, lower) = (&image.row(top)[left..left + 2], &image.row(top + 1)[left..left + 2]);
    let across = |row: &[u8]| f64::from(row[0]) + fx * (f64::from(row[1]) - f64::from(row[0]));
    let (upper, lower) = (across(upper), across(lower));
    upper + fy * (lower - upper)
}
