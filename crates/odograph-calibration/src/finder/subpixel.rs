//! Sub-pixel localisation of chessboard corners (saddle points).
//!
//! There are two steps. [`orthogonal`] finds the point to which all surrounding gradients are
//! orthogonal (W. Förstner and E. Gülch, "A fast operator for detection and precise location of
//! distinct points, corners and centres of circular features", 1987). It converges from several
//! pixels away and needs no model. [`fit`] then fits a model of two crossing blurred edges to the
//! image samples, by least squares in all nine unknowns, which is optimal under Gaussian noise.
//! Neither step interpolates the image.

use super::ring::Ring;
use nalgebra::{SMatrix, SVector};
use odograph::geometry::Pixel;
use odograph::image::GrayImage;

/// A fitted saddle point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Saddle {
    /// Intersection of the two edges.
    pub pixel: Pixel,
    /// Standard deviation of the edge blur, pixels.
    pub blur_px: f64,
    /// Difference between white and black, gray levels.
    pub contrast: f64,
    /// RMS residual of the fit, gray levels.
    pub residual: f64,
}

/// The half window, reduced so that it lies inside the image; `None` below [`SMALLEST_WINDOW_PX`].
fn window_inside(image: &GrayImage, centre: Pixel, half_window_px: f64) -> Option<f64> {
    let right = image.width() as f64 - 2.0 - centre.x;
    let below = image.height() as f64 - 2.0 - centre.y;
    let half = half_window_px.min(centre.x - 1.0).min(centre.y - 1.0).min(right).min(below);
    (half >= SMALLEST_WINDOW_PX).then_some(half) // false for NaN
}

/// Minimum half window, pixels; fewer samples do not constrain the nine unknowns.
const SMALLEST_WINDOW_PX: f64 = 2.0;

/// The samples of a circular window: column, row, offset from its centre in x and y, and a weight
/// that decreases to 0 at the rim.
fn window(
    image: &GrayImage,
    centre: Pixel,
    half: f64,
) -> impl Iterator<Item = (usize, usize, f64, f64, f64)> {
    let rows = (centre.y - half).ceil().max(1.0) as usize
        ..=((centre.y + half).floor() as usize).min(image.height().saturating_sub(2));
    let last_column = image.width().saturating_sub(2);
    rows.flat_map(move |y| {
        let dy = y as f64 - centre.y;
        let chord = (half * half - dy * dy).max(0.0).sqrt();
        let columns = (centre.x - chord).ceil().max(1.0) as usize
            ..=((centre.x + chord).floor().max(0.0) as usize).min(last_column);
        columns.map(move |x| {
            let dx = x as f64 - centre.x;
            (x, y, dx, dy, 1.0 - (dx * dx + dy * dy) / (half * half))
        })
    })
}

/// The point to which the surrounding gradients are orthogonal (Förstner). Converges from up to
/// half a window away.
pub(super) fn orthogonal(image: &GrayImage, start: Pixel, half_window_px: f64) -> Option<Pixel> {
    orthogonal_to_within(image, start, half_window_px, CONVERGED_PX)
}

/// [`orthogonal`], stopped when a step is shorter than `enough_px`.
pub(super) fn orthogonal_to_within(
    image: &GrayImage,
    start: Pixel,
    half_window_px: f64,
    enough_px: f64,
) -> Option<Pixel> {
    let mut at = start;
    for _ in 0..MAX_STEPS {
        let half = window_inside(image, at, half_window_px)?;
        let (mut xx, mut xy, mut yy, mut bx, mut by) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (x, y, dx, dy, weight) in window(image, at, half) {
            let (above, here, below) = (image.row(y - 1), image.row(y), image.row(y + 1));
            let gx = f64::from(here[x + 1]) - f64::from(here[x - 1]);
            let gy = f64::from(below[x]) - f64::from(above[x]);
            let weight = weight * weight;
            xx += weight * gx * gx;
            xy += weight * gx * gy;
            yy += weight * gy * gy;
            bx += weight * gx * (gx * dx + gy * dy);
            by += weight * gy * (gx * dx + gy * dy);
        }
        let determinant = xx * yy - xy * xy;
        // Rank deficient: a single edge leaves the position along it undetermined.
        if determinant <= 1e-3 * (xx + yy) * (xx + yy) {
            return None;
        }
        let step = ((yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant);
        at = Pixel::new(at.x + step.0, at.y + step.1);
        if at.distance(start).is_nan() || at.distance(start) > half_window_px {
            return None;
        }
        if step.0.hypot(step.1) < enough_px {
            break;
        }
    }
    Some(at)
}

/// Maximum number of iterations; both methods converge in three to six.
const MAX_STEPS: usize = 12;
/// Convergence threshold of a step, far below the noise. The next step would be an order of
/// magnitude smaller.
const CONVERGED_PX: f64 = 5e-4;
/// Length of a step above which the matrix of the normal equations is updated, pixels.
const CHANGES_MATRIX_PX: f64 = 0.03;
/// Accuracy of the start of the model fit, pixels.
const NEAR_PX: f64 = 0.1;
/// Initial blur of the model fit: standard deviation of a sharp camera, pixels.
pub(super) const USUAL_BLUR_PX: f64 = 0.7;
/// Minimum blur, pixels: each sample integrates over a pixel, a box with this standard deviation.
const SHARPEST_PX: f64 = 0.29;

/// The unknowns of [`fit`]: direction (radians) and distance (pixels) of two edges, half width of
/// their ramp, mean gray level, half contrast, gradient of the illumination along x and y.
type CornerUnknowns = SVector<f64, 9>;

/// A blurred step from −1 to 1 and its derivative; the ramp ends at `half_width`. It is the
/// integral of the biweight kernel, which approximates a Gaussian step to within 2 % but only costs
/// a polynomial.
fn step(distance: f64, half_width: f64) -> (f64, f64) {
    let u = (distance / half_width).clamp(-1.0, 1.0);
    let u2 = u * u;
    (u * (1.875 - u2 * (1.25 - 0.375 * u2)), 1.875 * (1.0 - u2) * (1.0 - u2))
}

/// Half width of the ramp over the standard deviation of the biweight kernel.
const WIDTHS_PER_DEVIATION: f64 = 2.645_751_311_064_590_7; // √7

/// Locates a saddle point near `start` with sub-pixel accuracy.
///
/// `half_window_px` is the radius of the window. It should be at most half the side of the smallest
/// adjacent square, so that no other corner is included, and not much more than 10, so that lens
/// distortion does not bend the edges. `start` may be off by about half of it. `None` if there is
/// no saddle point near `start`, or if the window does not fit in the image. Near the border the
/// window is reduced, down to 2 pixels.
///
/// The model is `middle + slope · u + half_contrast · step(n₁ · u − c₁) · step(n₂ · u − c₂)`. The
/// slope is needed because an illumination gradient correlates with the position of the corner. The
/// samples are weighted by the circular window and fitted by Levenberg–Marquardt.
pub(crate) fn fit(image: &GrayImage, start: Pixel, half_window_px: f64) -> Option<Saddle> {
    fit_from(image, start, half_window_px, USUAL_BLUR_PX)
}

/// [`fit`] with an approximately known blur, which saves iterations.
pub(super) fn fit_from(image: &GrayImage, start: Pixel, half_window_px: f64, blur_px: f64) -> Option<Saddle> {
    let centre = orthogonal_to_within(image, start, half_window_px, NEAR_PX)?;
    let half = window_inside(image, centre, half_window_px)?;
    // The ring provides the initial edge directions. A ring of less than 2 pixels only measures
    // blur.
    let ring = Ring::read(image, centre, (0.7 * half).max(2.0).min(half))?;
    fit_edges(image, centre, half, &ring, blur_px)
}

/// The model fit from approximately known edges.
fn fit_edges(image: &GrayImage, centre: Pixel, half: f64, ring: &Ring, blur_px: f64) -> Option<Saddle> {
    let [first, second] = ring.lines();
    let sign = if ring.white_where_alike() { 1.0 } else { -1.0 };
    let mut unknowns = CornerUnknowns::from([
        first,
        0.0,
        second,
        0.0,
        (WIDTHS_PER_DEVIATION * blur_px).min(half),
        ring.middle(),
        0.5 * sign * ring.contrast(),
        0.0,
        0.0,
    ]);
    let samples: Vec<[f64; 4]> = window(image, centre, half)
        .map(|(x, y, dx, dy, weight)| [dx, dy, f64::from(image.row(y)[x]), weight])
        .collect();
    let mut damping = 1e-3;
    let (mut normal, mut gradient, mut cost) = normal_equations::<true>(&samples, &unknowns);
    for _ in 0..MAX_STEPS {
        let mut damped = normal;
        for i in 0..9 {
            damped[(i, i)] += damping * normal[(i, i)] + 1e-9;
        }
        let change = damped.cholesky()?.solve(&gradient);
        let mut tried = unknowns + change;
        let least = SHARPEST_PX * WIDTHS_PER_DEVIATION;
        tried[4] = tried[4].clamp(least, half.max(least));
        let (_, tried_gradient, tried_cost) = normal_equations::<false>(&samples, &tried);
        if tried_cost.is_nan() || tried_cost >= cost {
            damping *= 10.0;
            if damping > 1e3 {
                break;
            }
            continue;
        }
        let (before, after) = (crossing(&unknowns)?, crossing(&tried)?);
        (unknowns, gradient, cost) = (tried, tried_gradient, tried_cost);
        damping *= 0.2;
        let moved_px = (after.0 - before.0).hypot(after.1 - before.1);
        if moved_px < CONVERGED_PX {
            break;
        }
        // Near convergence the matrix is almost constant, and it dominates the cost.
        if moved_px > CHANGES_MATRIX_PX {
            normal = normal_equations::<true>(&samples, &unknowns).0;
        }
    }
    let (x, y) = crossing(&unknowns)?;
    if x.hypot(y) > 0.5 * half {
        return None; // the fit diverged from the result of `orthogonal`
    }
    let weights: f64 = samples.iter().map(|sample| sample[3]).sum();
    Some(Saddle {
        pixel: Pixel::new(centre.x + x, centre.y + y),
        blur_px: unknowns[4] / WIDTHS_PER_DEVIATION,
        contrast: 2.0 * unknowns[6].abs(),
        residual: (cost / weights).sqrt(),
    })
}

/// Intersection of the edges relative to the centre of the window; `None` if they are nearly
/// parallel.
fn crossing(unknowns: &CornerUnknowns) -> Option<(f64, f64)> {
    let (s1, c1) = unknowns[0].sin_cos();
    let (s2, c2) = unknowns[2].sin_cos();
    // n = (−sin, cos): n · u = distance.
    let determinant = s2 * c1 - s1 * c2;
    if determinant.abs() < 0.1 {
        return None;
    }
    let (d1, d2) = (unknowns[1], unknowns[3]);
    Some(((d1 * c2 - d2 * c1) / determinant, (d1 * s2 - d2 * s1) / determinant))
}

/// JᵀWJ (zero unless `MATRIX`), JᵀWr and rᵀWr of the model.
fn normal_equations<const MATRIX: bool>(
    samples: &[[f64; 4]],
    unknowns: &CornerUnknowns,
) -> (SMatrix<f64, 9, 9>, CornerUnknowns, f64) {
    let (s1, c1) = unknowns[0].sin_cos();
    let (s2, c2) = unknowns[2].sin_cos();
    let (offset_1, offset_2, width) = (unknowns[1], unknowns[3], unknowns[4]);
    let (middle, half_contrast, slope_x, slope_y) = (unknowns[5], unknowns[6], unknowns[7], unknowns[8]);
    let mut normal = [[0.0; 9]; 9];
    let mut gradient = [0.0; 9];
    let mut cost = 0.0;
    for &[x, y, value, weight] in samples {
        let distance_1 = c1 * y - s1 * x - offset_1;
        let distance_2 = c2 * y - s2 * x - offset_2;
        let (step_1, slope_1) = step(distance_1, width);
        let (step_2, slope_2) = step(distance_2, width);
        let pattern = step_1 * step_2;
        let residual = value - (middle + half_contrast * pattern + slope_x * x + slope_y * y);
        cost += weight * residual * residual;
        let by_1 = half_contrast * slope_1 * step_2 / width;
        let by_2 = half_contrast * slope_2 * step_1 / width;
        let along_1 = -(s1 * y + c1 * x);
        let along_2 = -(s2 * y + c2 * x);
        let by_width = -(by_1 * distance_1 + by_2 * distance_2) / width;
        let row = [by_1 * along_1, -by_1, by_2 * along_2, -by_2, by_width, 1.0, pattern, x, y];
        // Far from both edges, a sample only constrains the four unknowns of the illumination.
        let first = if slope_1 == 0.0 && slope_2 == 0.0 { 5 } else { 0 };
        for i in first..9 {
            let weighted = weight * row[i];
            gradient[i] += weighted * residual;
            if MATRIX {
                for j in i..9 {
                    normal[i][j] += weighted * row[j];
                }
            }
        }
    }
    let normal = SMatrix::from_fn(|i, j| normal[i.min(j)][i.max(j)]);
    (normal, CornerUnknowns::from(gradient), cost)
}
