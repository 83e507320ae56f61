//! Decoding of the bits of a marker at a known position.

use crate::finder::ring::interpolated;
use nalgebra::{Matrix3, Vector3};
use odograph::geometry::Pixel;
use odograph::image::GrayImage;

/// The printed layout of a marker family.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MarkerLayout {
    /// Number of bits along a side, without the border.
    pub bits: usize,
    /// Width of the black border, in bits.
    pub border: usize,
}

impl MarkerLayout {
    /// Number of bits along a side, including the border.
    pub fn side(self) -> usize {
        self.bits + 2 * self.border
    }
}

/// The decoded bits and gray levels of a marker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Reading {
    /// The bits in row-major order from the top left, the first one most significant; 1 is white.
    pub bits: u64,
    /// Gray level of each bit in the same order, without sharpening: −0.5 black, 0 the midpoint,
    /// 0.5 white.
    pub grays: [f64; MAX_BITS * MAX_BITS],
}

/// Minimum contrast, gray levels.
const MIN_CONTRAST: f64 = 10.0;
/// Maximum share of white samples on the border, and of black samples in the surroundings.
const MAX_WRONG_BORDER: f64 = 0.12;
const MAX_WRONG_SURROUNDINGS: f64 = 0.25;
/// Smaller bits are blurred into each other and are sharpened, pixels.
const SMALL_BIT_PX: f64 = 5.0;

/// Decodes a marker; `pixel` maps its unit square to the image (x to the right of the marker, y
/// down), and `quiet` is the width of the white quiet zone in sides of the marker.
///
/// The black and white levels are planes fitted to the samples on the border and around it, so the
/// illumination may vary over the marker. Small bits are sharpened against their four neighbours,
/// as in AprilTag 3 (M. Krogius et al., "Flexible layouts for fiducial tags", 2019). `None` if the
/// marker is not inside the image, or if its border and surroundings do not match a marker.
pub(crate) fn read(
    image: &GrayImage,
    layout: MarkerLayout,
    quiet: f64,
    bit_px: f64,
    pixel: &impl Fn(f64, f64) -> Option<Pixel>,
) -> Option<Reading> {
    let side = layout.side();
    let step = 1.0 / side as f64;
    let at = |i: usize| (i as f64 + 0.5) * step;
    let sample = |x: f64, y: f64| interpolated(image, pixel(x, y)?);
    // Four samples per bit. In small bits all of them are close to the middle, away from the
    // neighbours.
    let reach = if bit_px < 3.0 { 0.12 * step } else { 0.2 * step };
    let of_bit = |x: f64, y: f64| {
        Some(
            0.25 * (sample(x - reach, y - reach)?
                + sample(x + reach, y - reach)?
                + sample(x - reach, y + reach)?
                + sample(x + reach, y + reach)?),
        )
    };
    let mut grid = [0.0; MAX_SIDE * MAX_SIDE];
    let (mut black, mut white) = (GraySamples::default(), GraySamples::default());
    for row in 0..side {
        for column in 0..side {
            let value = of_bit(at(column), at(row))?;
            grid[row * MAX_SIDE + column] = value;
            let outermost = row == 0 || column == 0 || row + 1 == side || column + 1 == side;
            if outermost {
                black.add(at(column), at(row), value);
            }
        }
    }
    let outside = 0.5 * quiet.min(step);
    // The ends are skipped, because the squares of an AprilGrid touch there.
    for i in 1..side - 1 {
        for (x, y) in [(at(i), -outside), (at(i), 1.0 + outside), (-outside, at(i)), (1.0 + outside, at(i))] {
            // Parts of the surroundings may be outside the image.
            if let Some(value) = sample(x, y) {
                white.add(x, y, value);
            }
        }
    }
    let (black_plane, white_plane) = (black.plane()?, white.plane()?);
    let level = |plane: &Vector3<f64>, x: f64, y: f64| plane.x * x + plane.y * y + plane.z;
    let contrast = level(&white_plane, 0.5, 0.5) - level(&black_plane, 0.5, 0.5);
    let middle = |x: f64, y: f64| 0.5 * (level(&white_plane, x, y) + level(&black_plane, x, y));
    if contrast < MIN_CONTRAST
        || black.share(|x, y, value| value > middle(x, y)) > MAX_WRONG_BORDER
        || white.share(|x, y, value| value < middle(x, y)) > MAX_WRONG_SURROUNDINGS
    {
        return None;
    }
    let mut bits = 0;
    let mut grays = [0.0; MAX_BITS * MAX_BITS];
    let mut next = 0;
    for row in layout.border..layout.border + layout.bits {
        for column in layout.border..layout.border + layout.bits {
            let here = row * MAX_SIDE + column;
            let mut value = grid[here];
            grays[next] = (value - middle(at(column), at(row))) / contrast;
            next += 1;
            if bit_px < SMALL_BIT_PX {
                let around = grid[here - 1] + grid[here + 1] + grid[here - MAX_SIDE] + grid[here + MAX_SIDE];
                value += value - 0.25 * around;
                // Sharpening has no effect in uniform areas, so the threshold remains valid.
            }
            let is_white = value > middle(at(column), at(row));
            bits = bits << 1 | u64::from(is_white);
        }
    }
    Some(Reading { bits, grays })
}

/// Maximum number of bits along a side, without the border.
pub(super) const MAX_BITS: usize = 6;
/// Maximum number of bits along a side, including the border: an AprilTag with a border of two
/// bits.
const MAX_SIDE: usize = 10;

/// Gray level samples at positions on the marker.
#[derive(Default)]
struct GraySamples {
    samples: Vec<(f64, f64, f64)>,
}

impl GraySamples {
    fn add(&mut self, x: f64, y: f64, value: f64) {
        self.samples.push((x, y, value));
    }

    /// Least-squares plane through the samples: coefficients of x, y and 1.
    fn plane(&self) -> Option<Vector3<f64>> {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for &(x, y, value) in &self.samples {
            let row = Vector3::new(x, y, 1.0);
            normal += row * row.transpose();
            right += value * row;
        }
        normal.cholesky().map(|cholesky| cholesky.solve(&right))
    }

    fn share(&self, is: impl Fn(f64, f64, f64) -> bool) -> f64 {
        let count = self.samples.iter().filter(|&&(x, y, value)| is(x, y, value)).count();
        count as f64 / self.samples.len().max(1) as f64
    }
}
