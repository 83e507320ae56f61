//! What stands on a small circle around a point: around a corner of four squares, black and white take turns twice.

use crate::geometry::Pixel;
use crate::image::GrayImage;
use std::f64::consts::{PI, TAU};
use std::sync::LazyLock;

/// Samples on the circle.
const SAMPLES: usize = 32;

/// Cosine and sine of each sample's angle.
static DIRECTIONS: LazyLock<[(f64, f64); SAMPLES]> = LazyLock::new(|| {
    std::array::from_fn(|i| {
        let (sine, cosine) = (TAU * i as f64 / SAMPLES as f64).sin_cos();
        (cosine, sine)
    })
});

/// The four edges that leave a corner of squares, read on a circle around it.
///
/// Angles run from x to y, which is clockwise as an image is looked at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Ring {
    /// Direction of each edge outwards, radians in 0..2π, ascending.
    pub edges: [f64; 4],
    /// Whether the arc after the first edge (towards larger angles) is white.
    pub white_after_first: bool,
    /// Mean of the black and of the white arcs, gray levels.
    black: f64,
    white: f64,
}

/// The least difference of black and white, gray levels; below, print and noise are not told apart.
const LEAST_CONTRAST: f64 = 8.0;
/// How far the two halves of a line may be from straight, radians: the circle's centre may be off by a good part of a pixel.
const BEND: f64 = 0.7;
/// The sharpest angle at which two lines cross, radians: a board seen very obliquely.
const SHARPEST_CROSSING: f64 = 0.3;

impl Ring {
    /// Reads the circle of `radius_px` around `centre`; `None` unless black and white take turns exactly twice, each twice about as
    /// dark or bright as its opposite, divided by two fairly straight lines. The circle must lie in the image.
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
        if most - least < LEAST_CONTRAST {
            return None;
        }
        // Halfway, with the centre held between: on a corner, as much of the circle is black as is white only if it is seen squarely.
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
        // Light changes slowly: opposite squares look more alike than neighbours do.
        if contrast < LEAST_CONTRAST * 0.75
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

    /// Whether the arc that follows an edge is white.
    pub fn white_after(&self, edge: usize) -> bool {
        self.white_after_first == (edge % 2 == 0)
    }

    /// White less black, gray levels.
    pub fn contrast(&self) -> f64 {
        self.white - self.black
    }

    /// The gray halfway.
    pub fn middle(&self) -> f64 {
        0.5 * (self.white + self.black)
    }

    /// Directions of the two lines through the corner, radians; the first is the one of the first edge.
    pub fn lines(&self) -> [f64; 2] {
        [0, 1].map(|i| 0.5 * (self.edges[i] + self.edges[i + 2] - PI))
    }
    /// Whether it is white where the distances from both lines (to the side of `(−sin, cos)`) have the same sign.
    pub fn white_where_alike(&self) -> bool {
        // Past the first edge but before the second, a point is on the plus side of the first line and the minus side of the second.
        !self.white_after_first
    }
}

/// The image between its samples. The point must lie inside, as [`Ring::read`] has seen to.
pub(super) fn bilinear(image: &GrayImage, x: f64, y: f64) -> f64 {
    let (left, top) = (x as usize, y as usize);
    let (fx, fy) = (x - left as f64, y - top as f64);
    let (upper, lower) = (&image.row(top)[left..left + 2], &image.row(top + 1)[left..left + 2]);
    let across = |row: &[u8]| f64::from(row[0]) + fx * (f64::from(row[1]) - f64::from(row[0]));
    let (upper, lower) = (across(upper), across(lower));
    upper + fy * (lower - upper)
}
