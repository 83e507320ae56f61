//! Where exactly four squares meet.
//!
//! Two steps. [`orthogonal`] finds the point to which all gradients around it are orthogonal (W. Förstner and E. Gülch, "A fast operator
//! for detection and precise location of distinct points, corners and centres of circular features", 1987): it comes from pixels
//! away and needs no model. [`fit`] then fits the picture of two crossing blurred edges to the samples themselves, least squares in all
//! its nine unknowns, which is the best there is under noise. No sample is interpolated in either.

use super::ring::Ring;
use crate::geometry::Pixel;
use crate::image::GrayImage;
use nalgebra::{SMatrix, SVector};

/// Four squares meeting, as fitted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Saddle {
    /// Where the two edges cross.
    pub pixel: Pixel,
    /// Standard deviation of the blur of the edges, pixels.
    pub blur_px: f64,
    /// Gray levels from black to white.
    pub contrast: f64,
    /// Root mean square of what the model does not explain, gray levels.
    pub residual: f64,
}

/// The sub-pixel place where four squares meet near `start`.
///
/// `half_window_px` says how far around it the image is looked at: at most half the side of the smallest square there, so that no
/// other corner is seen, and not much more than 10, so that a lens's bending of the edges does not matter. `start` may be off by
/// about half of it. `None` where no saddle is near `start`, or the window does not lie in the image (it is made smaller at the
/// border down to 2 pixels).
pub(crate) fn saddle(image: &GrayImage, start: Pixel, half_window_px: f64) -> Option<Pixel> {
    fit(image, start, half_window_px).map(|saddle| saddle.pixel)
}

/// The half window that fits into the image around a point; `None` below [`SMALLEST_WINDOW_PX`].
fn window_inside(image: &GrayImage, centre: Pixel, half_window_px: f64) -> Option<f64> {
    let right = image.width() as f64 - 2.0 - centre.x;
    let below = image.height() as f64 - 2.0 - centre.y;
    let half = half_window_px.min(centre.x - 1.0).min(centre.y - 1.0).min(right).min(below);
    (half >= SMALLEST_WINDOW_PX).then_some(half) // false for NaN
}

/// Fewer samples than within this radius do not hold nine unknowns.
const SMALLEST_WINDOW_PX: f64 = 2.0;

/// The samples of a round window: column, row, offsets from its centre, and a weight that falls to 0 at the rim.
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

/// The point to which the gradients around it are orthogonal, from up to half a window away.
pub(super) fn orthogonal(image: &GrayImage, start: Pixel, half_window_px: f64) -> Option<Pixel> {
    let mut at = start;
    for _ in 0..MOST_STEPS {
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
        // One edge alone leaves the point free along it.
        if determinant <= 1e-3 * (xx + yy) * (xx + yy) {
            return None;
        }
        let step = ((yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant);
        at = Pixel::new(at.x + step.0, at.y + step.1);
        // Not a comparison with `>`: a NaN must end here too.
        if !(at.distance(start) <= half_window_px) {
            return None;
        }
        if step.0.hypot(step.1) < CONVERGED_PX {
            break;
        }
    }
    Some(at)
}

/// Steps of either iteration; both converge in three to six.
const MOST_STEPS: usize = 12;
/// A hundredth of what noise does.
const CONVERGED_PX: f64 = 1e-4;
/// An edge cannot be sharper than a sample: the standard deviation of a box of one pixel.
const SHARPEST_PX: f64 = 0.29;

/// The unknowns of [`fit`]: direction (radians) and distance (pixels) of two edges, half width of their ramp, middle gray, half
/// contrast, slope of the light along x and y.
type Unknowns = SVector<f64, 9>;

/// A blurred step from −1 to 1, `half_width` the distance where the ramp ends, and its derivative: the integral of the biweight
/// kernel, which is a Gaussian's step to within 2 %, but costs a polynomial.
fn step(distance: f64, half_width: f64) -> (f64, f64) {
    let u = distance / half_width;
    if u.abs() >= 1.0 {
        return (u.signum(), 0.0);
    }
    let u2 = u * u;
    (u * (1.875 - u2 * (1.25 - 0.375 * u2)), 1.875 * (1.0 - u2) * (1.0 - u2))
}

/// Half width of the ramp over the standard deviation of the kernel.
const WIDTHS_PER_DEVIATION: f64 = 2.645_751_311_064_590_7; // √7

/// The best picture of two crossing edges around `start`, after [`orthogonal`] has come near.
///
/// The model is `middle + slope · u + half_contrast · step(n₁ · u − c₁) · step(n₂ · u − c₂)`. The slope matters: light that changes over
/// the window correlates with a shift of the corner. Levenberg–Marquardt on the samples, weighted by the round window.
pub(crate) fn fit(image: &GrayImage, start: Pixel, half_window_px: f64) -> Option<Saddle> {
    let centre = orthogonal(image, start, half_window_px)?;
    let half = window_inside(image, centre, half_window_px)?;
    // The ring tells the directions of the edges; nearer than 2 pixels a ring is all blur.
    let ring = Ring::read(image, centre, (0.7 * half).max(2.0).min(half))?;
    fit_from(image, centre, half, &ring)
}

/// [`fit`] where the edges around the `centre` are known already.
fn fit_from(image: &GrayImage, centre: Pixel, half: f64, ring: &Ring) -> Option<Saddle> {
    let [first, second] = ring.lines();
    let sign = if ring.white_where_alike() { 1.0 } else { -1.0 };
    let mut unknowns = Unknowns::from([
        first,
        0.0,
        second,
        0.0,
        WIDTHS_PER_DEVIATION * 0.7,
        ring.middle(),
        0.5 * sign * ring.contrast(),
        0.0,
        0.0,
    ]);
    let samples: Vec<[f64; 4]> = window(image, centre, half)
        .map(|(x, y, dx, dy, weight)| [dx, dy, f64::from(image.row(y)[x]), weight])
        .collect();
    let mut damping = 1e-3;
    let (mut normal, mut gradient, mut cost) = normal_equations(&samples, &unknowns);
    for _ in 0..MOST_STEPS {
        let mut damped = normal;
        for i in 0..9 {
            damped[(i, i)] += damping * normal[(i, i)] + 1e-9;
        }
        let change = damped.cholesky()?.solve(&gradient);
        let mut tried = unknowns + change;
        let least = SHARPEST_PX * WIDTHS_PER_DEVIATION;
        tried[4] = tried[4].clamp(least, half.max(least));
        let (tried_normal, tried_gradient, tried_cost) = normal_equations(&samples, &tried);
        // Not `>=`: a NaN is no improvement.
        if !(tried_cost < cost) {
            damping *= 10.0;
            if damping > 1e3 {
                break;
            }
            continue;
        }
        let before = crossing(&unknowns)?;
        unknowns = tried;
        (normal, gradient, cost) = (tried_normal, tried_gradient, tried_cost);
        damping *= 0.2;
        let after = crossing(&unknowns)?;
        if (after.0 - before.0).hypot(after.1 - before.1) < CONVERGED_PX {
            break;
        }
    }
    let (x, y) = crossing(&unknowns)?;
    if x.hypot(y) > 0.5 * half {
        return None; // the fit ran away from what `orthogonal` found
    }
    let weights: f64 = samples.iter().map(|sample| sample[3]).sum();
    Some(Saddle {
        pixel: Pixel::new(centre.x + x, centre.y + y),
        blur_px: unknowns[4] / WIDTHS_PER_DEVIATION,
        contrast: 2.0 * unknowns[6].abs(),
        residual: (cost / weights).sqrt(),
    })
}

/// Where the edges cross, relative to the window's centre; `None` where they are nearly parallel.
fn crossing(unknowns: &Unknowns) -> Option<(f64, f64)> {
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

/// JᵀWJ, JᵀWr and rᵀWr of the model at the given unknowns.
fn normal_equations(samples: &[[f64; 4]], unknowns: &Unknowns) -> (SMatrix<f64, 9, 9>, Unknowns, f64) {
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
        // Far from both edges only the light's four unknowns see the sample.
        let first = if slope_1 == 0.0 && slope_2 == 0.0 { 5 } else { 0 };
        for i in first..9 {
            let weighted = weight * row[i];
            gradient[i] += weighted * residual;
            for j in i..9 {
                normal[i][j] += weighted * row[j];
            }
        }
    }
    let normal = SMatrix::from_fn(|i, j| normal[i.min(j)][i.max(j)]);
    (normal, Unknowns::from(gradient), cost)
}
