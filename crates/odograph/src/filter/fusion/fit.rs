//! Robust linear least squares, and the estimation of a clock offset with it.

use crate::numerics::{Loss, median, normal_sigma};
use nalgebra::{Matrix4, Vector4};

/// One linear observation equation of the parameters of a sensor,
///
/// `target = design · parameters + noise`,
///
/// with noise variance proportional to `duration_s` (white noise, integrated).
#[derive(Debug, Clone, Copy)]
pub struct ObservationRow {
    pub design: Vector4<f64>,
    pub target: f64,
    pub duration_s: f64,
    /// Whether it belongs to the second of two directions, which may have a different noise.
    pub second: bool,
}

/// Gaussian prior of the parameters: means and standard deviations.
#[derive(Debug, Clone, Copy)]
pub struct ParameterPrior {
    pub mean: Vector4<f64>,
    pub sigma: Vector4<f64>,
}

/// Estimated parameters with covariance and residuals.
#[derive(Debug, Clone)]
pub struct Fit {
    pub parameters: Vector4<f64>,
    pub covariance: Matrix4<f64>,
    /// Residual of each row, in the row's unit.
    pub residuals: Vec<f64>,
    /// Spectral density of the noise: variance per second.
    pub density: f64,
    /// Mean Huber loss per row, in units of the noise scale of the fit.
    loss: f64,
}

const LOSS: Loss = Loss::Huber(1.5);

/// Iteratively reweighted least squares with Huber weights. `scale` is the square root of the noise
/// density; if `None`, it is estimated from the median absolute residual.
pub fn fit(rows: &[ObservationRow], prior: &ParameterPrior, scale: Option<f64>) -> Fit {
    let mut parameters = prior.mean;
    let mut weights = vec![1.0; rows.len()];
    let mut deviation = scale.unwrap_or(1.0);
    let mut inverse = Matrix4::identity();
    let mut whitened = vec![0.0; rows.len()];
    for _ in 0..6 {
        let mut normal = Matrix4::from_diagonal(&prior.sigma.map(|sigma| (deviation / sigma).powi(2)));
        let mut right = Vector4::zeros();
        for (row, weight) in rows.iter().zip(&weights) {
            let weight = weight / row.duration_s;
            normal += row.design * row.design.transpose() * weight;
            right += row.design * (row.target - row.design.dot(&prior.mean)) * weight;
        }
        let Some(factor) = normal.cholesky() else { break };
        parameters = prior.mean + factor.solve(&right);
        inverse = factor.inverse();
        for (residual, row) in whitened.iter_mut().zip(rows) {
            *residual = (row.target - row.design.dot(&parameters)) / row.duration_s.sqrt();
        }
        if scale.is_none() {
            // The larger of the two directions' noise, so that the residuals of the noisier
            // direction are not treated as outliers.
            let of = |second: bool| {
                let of_direction = whitened.iter().zip(rows).filter(|(_, row)| row.second == second);
                normal_sigma(&of_direction.map(|(residual, _)| *residual).collect::<Vec<f64>>())
            };
            deviation = of(false).max(of(true)).max(1e-9);
        }
        for (weight, residual) in weights.iter_mut().zip(&whitened) {
            *weight = LOSS.weight_of_square((residual / deviation).powi(2));
        }
    }
    let loss = |residual: &f64| LOSS.of_square((residual / deviation).powi(2));
    Fit {
        parameters,
        covariance: inverse * deviation.powi(2),
        residuals: whitened
            .iter()
            .zip(rows)
            .map(|(residual, row)| residual * row.duration_s.sqrt())
            .collect(),
        density: deviation.powi(2),
        loss: whitened.iter().map(loss).sum::<f64>() / rows.len().max(1) as f64,
    }
}

/// Clock offset of a sensor relative to the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimeOffset {
    /// Sensor time minus camera time, seconds.
    pub offset_s: f64,
    /// Standard deviation, seconds; infinite if the motion does not determine the offset, which is
    /// then 0.
    pub sigma_s: f64,
}

/// Largest clock offset that is searched, seconds.
pub const MAX_OFFSET_S: f64 = 1.0;

/// Step of the grid search, seconds: a tenth of the period of a 5 Hz oscillation.
const COARSE_S: f64 = 0.02;

/// Largest usable standard deviation of a clock offset, seconds.
const WORST_SIGMA_S: f64 = 0.05;

/// Estimates the clock offset at which the sensor best explains the camera's motion. `rows` returns
/// the observation equations at an offset; `independent` is the fraction of them with independent
/// noise.
pub fn time_offset(
    rows: impl Fn(f64) -> Vec<ObservationRow>,
    prior: &ParameterPrior,
    independent: f64,
) -> TimeOffset {
    let unknown = TimeOffset { offset_s: 0.0, sigma_s: f64::INFINITY };
    let steps = (MAX_OFFSET_S / COARSE_S).round() as i32;
    let looks: Vec<(f64, usize, Fit)> = (-steps..=steps)
        .map(|i| {
            let offset_s = f64::from(i) * COARSE_S;
            let rows = rows(offset_s);
            (offset_s, rows.len(), fit(&rows, prior, None))
        })
        .collect();
    let most = looks.iter().map(|look| look.1).max().unwrap_or(0);
    // Offsets at which much of the record has no counterpart are not comparable, and are excluded.
    let eligible = looks.iter().filter(|look| look.1 >= 30 && 10 * look.1 >= 8 * most);
    let Some(best) = eligible.min_by(|a, b| a.2.density.total_cmp(&b.2.density)) else { return unknown };
    let count = independent * best.1 as f64;
    // Significance test: without motion, noise alone makes one offset look best. The residual
    // variance scatters by a relative √(2 / count), and the smallest of a hundred is about three
    // standard deviations below the median; twice that is required.
    let mut densities: Vec<f64> = looks.iter().map(|look| look.2.density).collect();
    if median(&mut densities).unwrap_or(0.0) < best.2.density * (1.0 + 6.0 * (2.0 / count).sqrt()) {
        return unknown;
    }
    let scale = best.2.density.sqrt();
    let loss = |offset_s: f64| fit(&rows(offset_s), prior, Some(scale)).loss;
    let (mut low, mut high) = (best.0 - COARSE_S, best.0 + COARSE_S);
    // Golden-section search (J. Kiefer, 1953) to 0.1 ms.
    let golden = 0.5 * (5f64.sqrt() - 1.0);
    let mut inner = [high - golden * (high - low), low + golden * (high - low)];
    let mut losses = inner.map(loss);
    while high - low > 1e-4 {
        if losses[0] < losses[1] {
            high = inner[1];
            inner = [high - golden * (high - low), inner[0]];
            losses = [loss(inner[0]), losses[0]];
        } else {
            low = inner[0];
            inner = [inner[1], low + golden * (high - low)];
            losses = [losses[1], loss(inner[1])];
        }
    }
    let offset_s = 0.5 * (low + high);
    // Curvature over a step wider than the kinks that interpolation between samples causes.
    let curvature = count * (loss(offset_s - COARSE_S) + loss(offset_s + COARSE_S) - 2.0 * loss(offset_s))
        / (COARSE_S * COARSE_S);
    let sigma_s = if curvature > 0.0 { (2.0 / curvature).sqrt() } else { f64::INFINITY };
    if sigma_s > WORST_SIGMA_S { unknown } else { TimeOffset { offset_s, sigma_s } }
}
