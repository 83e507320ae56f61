//! Sub-pixel localisation of the centre of a dark disc.

use super::blobs::Blob;
use nalgebra::{SMatrix, SVector};
use odograph::geometry::Pixel;
use odograph::image::GrayImage;

/// The fitted image of a disc.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Disc {
    /// Centre of the ellipse.
    pub pixel: Pixel,
    /// Standard deviation of the blur of the rim, pixels.
    pub blur_px: f64,
    /// Background minus disc, gray levels.
    pub contrast: f64,
    /// RMS residual of the fit, gray levels.
    pub residual: f64,
}

/// Number of unknowns: centre, matrix `[a, b, c]` of the ellipse, half width of the ramp at the
/// rim, background gray level, its gradient along x and y, and contrast.
const UNKNOWNS: usize = 10;
type DiscUnknowns = SVector<f64, UNKNOWNS>;
type DiscNormalMatrix = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

/// Radius of the window, in radii of the disc: about half the distance to the rim of the next disc,
/// which is at three radii or more on usual boards.
const REACH: f64 = 1.55;
const MAX_STEPS: usize = 15;
const CONVERGED_PX: f64 = 1e-4;

/// Half width of the biweight ramp over the standard deviation of its kernel, √7.
const WIDTHS_PER_DEVIATION: f64 = 2.645_751_311_064_590_7;

/// Fits an ellipse with a blurred rim on a background with linear illumination to the samples
/// around a blob, by Levenberg–Marquardt in all ten unknowns. `None` if the contrast is too low or
/// the fit moves away from the blob.
pub(super) fn fit(image: &GrayImage, blob: &Blob) -> Option<Disc> {
    let samples = samples_around(image, blob);
    let mean = |keep: &dyn Fn(f64) -> bool| {
        let (mut sum, mut count) = (0.0, 0.0);
        for sample in samples.iter().filter(|sample| keep(sample[3])) {
            sum += sample[2];
            count += 1.0;
        }
        (count > 0.0).then(|| sum / count)
    };
    let (dark, ground) = (mean(&|square| square < 0.5)?, mean(&|square| square > 1.5)?);
    if ground - dark < 8.0 {
        return None;
    }
    let [a, b, c] = blob.shape;
    let mut unknowns = DiscUnknowns::from([0.0, 0.0, a, b, c, 2.0, ground, 0.0, 0.0, ground - dark]);
    let (mut normal, mut gradient, mut cost) = normal_equations(&samples, &unknowns)?;
    let mut damping = 1e-3;
    for _ in 0..MAX_STEPS {
        let mut damped = normal;
        for i in 0..UNKNOWNS {
            damped[(i, i)] += damping * normal[(i, i)] + 1e-12;
        }
        let mut tried = unknowns + damped.cholesky()?.solve(&gradient);
        tried[5] = tried[5].clamp(0.29 * WIDTHS_PER_DEVIATION, blob.axes_px.1.max(1.0));
        match normal_equations(&samples, &tried) {
            Some(next) if next.2 < cost => {
                let moved = (tried[0] - unknowns[0]).hypot(tried[1] - unknowns[1]);
                unknowns = tried;
                (normal, gradient, cost) = next;
                damping *= 0.2;
                if moved < CONVERGED_PX {
                    break;
                }
            }
            _ => {
                damping *= 10.0;
                if damping > 1e4 {
                    break;
                }
            }
        }
    }
    if unknowns[0].hypot(unknowns[1]) > 0.5 * blob.axes_px.1 {
        return None;
    }
    Some(Disc {
        pixel: Pixel::new(blob.pixel.x + unknowns[0], blob.pixel.y + unknowns[1]),
        blur_px: unknowns[5] / WIDTHS_PER_DEVIATION,
        contrast: unknowns[9],
        residual: (cost / samples.len() as f64).sqrt(),
    })
}

/// Samples of a blob and its surroundings: position from the middle, gray level, and squared
/// distance from the middle in axes of the ellipse.
fn samples_around(image: &GrayImage, blob: &Blob) -> Vec<[f64; 4]> {
    let reach = REACH * blob.axes_px.0 + 2.0;
    let (left, right) = ((blob.pixel.x - reach).ceil().max(0.0), (blob.pixel.x + reach).floor());
    let (top, bottom) = ((blob.pixel.y - reach).ceil().max(0.0), (blob.pixel.y + reach).floor());
    let right = right.min(image.width() as f64 - 1.0);
    let bottom = bottom.min(image.height() as f64 - 1.0);
    // Large discs have enough samples: every second or third one is sufficient.
    let stride = ((blob.axes_px.1 / 12.0) as usize).max(1);
    let [a, b, c] = blob.shape;
    // At least two pixels beyond the rim, so that the window of the smallest discs contains
    // background.
    let margin = 1.0 + 2.0 / blob.axes_px.1.max(1.0);
    let limit = REACH.max(margin).powi(2);
    let mut samples = Vec::new();
    for y in (top as usize..=bottom as usize).step_by(stride) {
        let row = image.row(y);
        for x in (left as usize..=right as usize).step_by(stride) {
            let (dx, dy) = (x as f64 - blob.pixel.x, y as f64 - blob.pixel.y);
            let square = a * dx * dx + 2.0 * b * dx * dy + c * dy * dy;
            if square <= limit {
                samples.push([dx, dy, f64::from(row[x]), square]);
            }
        }
    }
    samples
}

/// JᵀJ, Jᵀr and rᵀr; `None` if the matrix is not that of an ellipse.
fn normal_equations(
    samples: &[[f64; 4]],
    unknowns: &DiscUnknowns,
) -> Option<(DiscNormalMatrix, DiscUnknowns, f64)> {
    let [x0, y0, a, b, c, width, ground, slope_x, slope_y, depth] = (*unknowns).into();
    if a <= 0.0 || a * c - b * b <= 0.0 {
        return None;
    }
    let mut normal = [[0.0; UNKNOWNS]; UNKNOWNS];
    let mut gradient = [0.0; UNKNOWNS];
    let mut cost = 0.0;
    for &[x, y, value, _] in samples {
        let (dx, dy) = (x - x0, y - y0);
        let (mx, my) = (a * dx + b * dy, b * dx + c * dy);
        let radius = (mx * dx + my * dy).sqrt().max(1e-6);
        // First-order distance to the rim. The derivatives neglect the variation of its scale.
        let per_px = (mx.hypot(my) / radius).max(1e-9);
        let u = (radius - 1.0) / per_px / width;
        let (rise, slope) = if u.abs() >= 1.0 {
            (if u > 0.0 { 1.0 } else { 0.0 }, 0.0)
        } else {
            let u2 = u * u;
            (0.5 + 0.5 * u * (1.875 - u2 * (1.25 - 0.375 * u2)), 0.9375 * (1.0 - u2) * (1.0 - u2))
        };
        let residual = value - (ground + slope_x * x + slope_y * y - depth * (1.0 - rise));
        cost += residual * residual;
        let by_distance = depth * slope / width;
        let by_radius = by_distance / per_px;
        let row = [
            -by_radius * mx / radius,
            -by_radius * my / radius,
            by_radius * 0.5 * dx * dx / radius,
            by_radius * dx * dy / radius,
            by_radius * 0.5 * dy * dy / radius,
            -by_distance * u,
            1.0,
            x,
            y,
            rise - 1.0,
        ];
        let first = if slope == 0.0 { 6 } else { 0 };
        for i in first..UNKNOWNS {
            gradient[i] += row[i] * residual;
            for j in i..UNKNOWNS {
                normal[i][j] += row[i] * row[j];
            }
        }
    }
    let normal = DiscNormalMatrix::from_fn(|i, j| normal[i.min(j)][i.max(j)]);
    Some((normal, DiscUnknowns::from(gradient), cost))
}
