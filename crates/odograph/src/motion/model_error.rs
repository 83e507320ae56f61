//! Errors of the model: relief, lens, shutter, reflections, blur. Derivation:
//! `docs/math/correlated-noise.md`.

use super::Observations;
use super::normal_equations::{Factor, POSE, Row, Unknowns, WITH_KEYFRAME};
use super::nuisance::Nuisance;
use super::residual::Residual;
use crate::camera::Camera;
use crate::geometry::Pixel;
use nalgebra::{Matrix6, Vector6};

/// Variance of a coordinate of a track beyond that by the noise of the images, pixels²: the moment
/// estimate of R. DerSimonian and N. Laird (1986), in which tracks count by their information.
fn variance_px2(observations: &Observations<'_>, residuals: &[Residual], weights: &[f64]) -> f64 {
    let (mut excess_px2, mut information) = (0.0, 0.0);
    for ((observation, residual), &weight) in observations.seen.iter().zip(residuals).zip(weights) {
        if weight > 0.0 {
            excess_px2 += weight * (0.5 * residual.length().powi(2) - observations.noise_px.powi(2));
            information += weight * 0.5 * observation.whitening.norm_squared();
        }
    }
    if information > 0.0 { (excess_px2 / information).max(0.0) } else { 0.0 }
}

/// Covariance of the pose, given the keyframe, by errors of the model: independent ones in each of
/// the [`modes`] of each coordinate. A fit absorbs them in heading, height and tilt, and no number
/// of tracks averages them out.
pub fn model_covariance(
    camera: &Camera,
    nuisance: &Nuisance<'_>,
    residuals: &[Residual],
    weights: &[f64],
    given_keyframe: &Factor,
    unknowns: &Unknowns,
    scale_px: f64,
) -> Matrix6<f64> {
    let variance_px2 = variance_px2(&nuisance.observations, residuals, weights);
    if variance_px2 == 0.0 {
        return Matrix6::zeros();
    }
    let mut slopes: [[Row; 2]; MODES] = Default::default();
    for ((observation, residual), &weight) in nuisance.observations.seen.iter().zip(residuals).zip(weights) {
        if weight <= 0.0 {
            continue;
        }
        let rows = [0, 1].map(|k| nuisance.row(observation, residual, k, nuisance.count));
        let whiten = residual.parallax.whitener(observation.elevation.variance_m2, scale_px * scale_px);
        let modes = modes(camera, observation.pixel);
        for coordinate in 0..2 {
            let shift = observation.whitening.column(coordinate);
            let (mut x, mut y) = (shift[0], shift[1]);
            whiten(&mut x, &mut y);
            let slope: Row = std::array::from_fn(|i| weight * (rows[0][i] * x + rows[1][i] * y));
            for (mode, sums) in modes.iter().zip(&mut slopes) {
                sums[coordinate].iter_mut().zip(&slope).for_each(|(sum, slope)| *sum += mode * slope);
            }
        }
    }
    let mut covariance = Matrix6::zeros();
    for mut slope in slopes.into_iter().flatten() {
        slope[unknowns.count()..POSE].fill(0.0);
        slope[POSE..WITH_KEYFRAME].fill(0.0);
        let change = Vector6::from_row_slice(&given_keyframe.solve(&slope)[..POSE]);
        covariance += change * change.transpose();
    }
    covariance * variance_px2
}

/// Number of [`modes`].
const MODES: usize = 6;

/// Polynomials of second order in the image coordinates, each of which is 1 at most: the form in
/// which a pose with six degrees of freedom absorbs an error.
fn modes(camera: &Camera, pixel: Pixel) -> [f64; MODES] {
    let x = 2.0 * pixel.x / camera.width() as f64 - 1.0;
    let y = 2.0 * pixel.y / camera.height() as f64 - 1.0;
    [1.0, x, y, x * x - 1.0 / 3.0, x * y, y * y - 1.0 / 3.0]
}
