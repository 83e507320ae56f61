//! Sub-pixel localisation of a board point by template matching with the printed pattern.
//!
//! In a small square, the two crossing edges end at the border of a marker after a few pixels,
//! which are too few to constrain a corner. The printed pattern is known, however: it is rendered
//! as the camera would image it, and registered to the image.

use super::plane_map::PlaneMap;
use crate::{BoardPoint, Drawing};
use nalgebra::{SMatrix, SVector};
use odograph::geometry::Pixel;
use odograph::image::GrayImage;

/// A pattern registered to the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PatternFit {
    pub pixel: Pixel,
    /// RMS residual of the registration, gray levels.
    pub residual: f64,
    /// Difference between white and black, gray levels.
    pub contrast: f64,
    /// Standard deviation of the position along its less certain direction, from the residual,
    /// pixels.
    pub deviation_px: f64,
}

/// Samples of the rendered pattern per pixel.
const FINE: usize = 3;
/// Maximum radius of the window, pixels.
const LARGEST_WINDOW_PX: f64 = 8.0;
/// Margin of the rendered pattern beyond the window, pixels; bounds the shift during registration.
const MARGIN_PX: f64 = 1.5;
/// Maximum number of iterations; the registration converges in two to four.
const MAX_STEPS: usize = 8;
const CONVERGED_PX: f64 = 1e-3;

/// The rendered pattern around a board point.
pub(super) struct Pattern {
    /// Brightness, 0 black to 1 white, of the fine samples. The board point is at the middle
    /// sample.
    white: Vec<f32>,
    side: usize,
    window_px: f64,
}

impl Pattern {
    /// Renders the surroundings of `place`, mapped by `map` and blurred by `blur_px`, for a window
    /// of radius `window_px`.
    pub fn new(
        drawing: &Drawing,
        map: &PlaneMap,
        place: (f64, f64),
        window_px: f64,
        blur_px: f64,
    ) -> Option<Self> {
        let window_px = window_px.min(LARGEST_WINDOW_PX);
        let board_from_image = map.inverse()?;
        let middle = map.pixel(place)?;
        // The integration over a square pixel adds 1/12 to the variance of the blur.
        let deviation = (blur_px * blur_px + 1.0 / 12.0).sqrt() * FINE as f64;
        let taps = gaussian(deviation);
        let reach = taps.len() - 1;
        let half = ((window_px + MARGIN_PX) * FINE as f64).ceil() as usize;
        let side = 2 * half + 1;
        let wide = side + 2 * reach;
        let mut ink = vec![0.0f32; wide * wide];
        for (row, ink) in ink.chunks_exact_mut(wide).enumerate() {
            for (column, ink) in ink.iter_mut().enumerate() {
                let offset = |n: usize| (n as f64 - (half + reach) as f64) / FINE as f64;
                let at =
                    board_from_image.at(Pixel::new(middle.x + offset(column), middle.y + offset(row)))?;
                *ink = f32::from(u8::from(!drawing.is_black(BoardPoint { x_m: at.0, y_m: at.1 })));
            }
        }
        let mut across = vec![0.0f32; wide * side];
        for (out, ink) in across.chunks_exact_mut(side).zip(ink.chunks_exact(wide)) {
            blur_into(out, |at, shift| ink[at + shift], &taps);
        }
        let mut white = vec![0.0f32; side * side];
        for (row, out) in white.chunks_exact_mut(side).enumerate() {
            for (tap, weight) in (0..=2 * reach).map(|n| (n, taps[n.abs_diff(reach)])) {
                let from = &across[(row + tap) * side..][..side];
                out.iter_mut().zip(from).for_each(|(out, from)| *out += weight * from);
            }
        }
        Some(Self { white, side, window_px })
    }

    /// Brightness at an offset from the board point (pixels), and its derivatives along x and y;
    /// `None` outside the rendered area.
    fn at(&self, x: f64, y: f64) -> Option<(f64, f64, f64)> {
        let half = (self.side / 2) as f64;
        let (fx, fy) = (x * FINE as f64 + half, y * FINE as f64 + half);
        let most = (self.side - 2) as f64;
        if !(fx >= 0.0 && fy >= 0.0 && fx < most && fy < most) {
            return None;
        }
        let (column, row) = (fx as usize, fy as usize);
        let (u, v) = (fx - column as f64, fy - row as f64);
        let sample = |x: usize, y: usize| f64::from(self.white[y * self.side + x]);
        let (a, b) = (sample(column, row), sample(column + 1, row));
        let (c, d) = (sample(column, row + 1), sample(column + 1, row + 1));
        let (upper, lower) = (a + u * (b - a), c + u * (d - c));
        let by_x = ((b - a) + v * ((d - c) - (b - a))) * FINE as f64;
        Some((upper + v * (lower - upper), by_x, (lower - upper) * FINE as f64))
    }

    /// Registers the pattern to the image from `start`: least squares in position, black level,
    /// white level and illumination gradient, weighted by a circular window (Lucas–Kanade with a
    /// rendered template). `None` if it diverges, leaves the image, or finds black not darker than
    /// white.
    pub fn fit(&self, image: &GrayImage, start: Pixel) -> Option<PatternFit> {
        let mut at = start;
        let mut result = None;
        for _ in 0..MAX_STEPS {
            let (step, fit) = self.step(image, at)?;
            at = Pixel::new(at.x + step.0, at.y + step.1);
            let moved_px = at.distance(start);
            if moved_px.is_nan() || moved_px > MAX_MOVED_PX {
                return None;
            }
            result = Some(PatternFit { pixel: at, ..fit });
            if step.0.hypot(step.1) < CONVERGED_PX {
                break;
            }
        }
        result
    }

    fn step(&self, image: &GrayImage, at: Pixel) -> Option<((f64, f64), PatternFit)> {
        let radius = self.window_px;
        let inside = at.x >= radius
            && at.y >= radius
            && at.x + radius + 1.0 < image.width() as f64
            && at.y + radius + 1.0 < image.height() as f64;
        if !inside {
            return None;
        }
        let mut normal = SMatrix::<f64, 6, 6>::zeros();
        let mut right = SVector::<f64, 6>::zeros();
        let (mut squares, mut weights) = (0.0, 0.0);
        for y in (at.y - radius).ceil() as usize..=(at.y + radius).floor() as usize {
            let row = image.row(y);
            let (first, last) = ((at.x - radius).ceil() as usize, (at.x + radius).floor() as usize);
            for (x, &sample) in row.iter().enumerate().take(last + 1).skip(first) {
                let (dx, dy) = (x as f64 - at.x, y as f64 - at.y);
                let weight = 1.0 - (dx * dx + dy * dy) / (radius * radius);
                if weight <= 0.0 {
                    continue;
                }
                let (white, by_x, by_y) = self.at(dx, dy)?;
                let unknowns = SVector::from([1.0, white, by_x, by_y, dx / radius, dy / radius]);
                let value = f64::from(sample);
                normal.syger(weight, &unknowns, &unknowns, 1.0);
                right.axpy(weight * value, &unknowns, 1.0);
                squares += weight * value * value;
                weights += weight;
            }
        }
        // `syger` fills the lower triangle, which is the one that the Cholesky factorisation reads.
        let cholesky = normal.cholesky()?;
        let solution = cholesky.solve(&right);
        let contrast = solution[1];
        if contrast.is_nan() || contrast <= MIN_CONTRAST {
            return None;
        }
        let residual = ((squares - solution.dot(&right)).max(0.0) / weights).sqrt();
        let inverse = cholesky.inverse();
        let (xx, xy, yy) = (inverse[(2, 2)], inverse[(2, 3)], inverse[(3, 3)]);
        let worse = 0.5 * (xx + yy) + (0.25 * (xx - yy).powi(2) + xy * xy).sqrt();
        let fit = PatternFit {
            pixel: at,
            residual,
            contrast,
            deviation_px: residual * (WEIGHING * worse).sqrt() / contrast,
        };
        // A shift by (x, y) changes the pattern by −x and −y times its derivatives.
        Some(((-solution[2] / contrast, -solution[3] / contrast), fit))
    }
}

/// Σw² / Σw for a circular window whose weight decreases to zero: correction of the covariance from
/// the weighted normal equations.
const WEIGHING: f64 = 0.7;
/// Minimum contrast, gray levels.
const MIN_CONTRAST: f64 = 8.0;
/// Maximum shift from the start, pixels; the start is accurate to about a pixel.
const MAX_MOVED_PX: f64 = 2.5;

/// Half of a Gaussian kernel, central tap first. The full kernel sums to one.
fn gaussian(deviation: f64) -> Vec<f32> {
    let reach = (2.6 * deviation).ceil() as usize;
    let taps: Vec<f64> = (0..=reach).map(|n| (-0.5 * (n as f64 / deviation).powi(2)).exp()).collect();
    let sum = 2.0 * taps.iter().sum::<f64>() - taps[0];
    taps.iter().map(|tap| (tap / sum) as f32).collect()
}

fn blur_into(out: &mut [f32], input: impl Fn(usize, usize) -> f32, taps: &[f32]) {
    let reach = taps.len() - 1;
    for tap in 0..=2 * reach {
        let weight = taps[tap.abs_diff(reach)];
        for (at, out) in out.iter_mut().enumerate() {
            *out += weight * input(at, tap);
        }
    }
}
