//! Covariance of a robust fit, and how its pose depends on the keyframe. Derivation:
//! `docs/math/frame-pose.md`.

use super::normal_equations::{Factor, NormalEquations, POSE, Row, Unknowns, WITH_KEYFRAME, WITH_SHAPE};
use super::nuisance::Nuisance;
use super::residual::Residual;
use super::rig_evidence::WeightedRigPrior;
use crate::camera::Camera;
use crate::geometry::GroundPose;
use nalgebra::{Matrix6, Matrix6x2};

/// A converged robust fit.
#[derive(Debug)]
pub struct RobustFit<'a> {
    pub residuals: &'a [Residual],
    pub weights: &'a [f64],
    /// Lengths of the residuals, pixels.
    pub errors: &'a [f64],
    /// End of the biweight, pixels.
    pub cutoff_px: f64,
    /// Robust scale of the residuals, pixels.
    pub scale_px: f64,
    pub nuisance: &'a Nuisance<'a>,
}

impl RobustFit<'_> {
    /// Covariance of the pose given its keyframe: the sandwich estimate, which follows the actual
    /// spread of the residuals (P. Huber, "The behavior of maximum likelihood estimates under
    /// nonstandard conditions", 1967). `None` where the unknowns are not determined.
    pub fn covariance(
        &self,
        information: &NormalEquations,
        rig_prior: &WeightedRigPrior,
        unknowns: &Unknowns,
    ) -> Option<Matrix6<f64>> {
        let n = information.count();
        let mut scatter = NormalEquations::new(n);
        let (mut weights, mut influence_slopes) = (0.0, 0.0);
        let tracks = self.nuisance.observations.seen.iter().zip(self.residuals).zip(self.weights);
        for (((observation, residual), &weight), &length) in tracks.zip(self.errors) {
            if weight <= 0.0 {
                continue;
            }
            let [x, y] = [0, 1].map(|k| self.nuisance.row(observation, residual, k, n));
            let gradient = std::array::from_fn(|i| residual.error[0] * x[i] + residual.error[1] * y[i]);
            scatter.add(&gradient, 0.0, weight * weight);
            // Derivative of the influence function ψ(r) = w(r) r, mean over all directions.
            let ratio2 = (length / self.cutoff_px).powi(2);
            weights += weight;
            influence_slopes += (1.0 - ratio2) * (1.0 - 3.0 * ratio2);
        }
        let influence_slope = (influence_slopes / weights).max(MIN_INFLUENCE_SLOPE);
        // The priors are Gaussian: they are not scaled by the influence function.
        let mut information = *information;
        information.scale(influence_slope);
        let variance = self.scale_px * self.scale_px;
        let of_rig = (0..3).map(|i| (3 + i, rig_prior.weight[i]));
        for (i, weight) in of_rig.chain((WITH_KEYFRAME..n).map(|i| (i, variance))) {
            scatter.add_prior(i, 0.0, weight * variance);
            information.add_prior(i, 0.0, (1.0 - influence_slope) * weight);
        }
        let fixed = (unknowns.count()..POSE).chain(POSE..n.min(WITH_KEYFRAME));
        fixed.for_each(|i| {
            scatter.hold(i);
            information.hold(i);
        });
        let inverse = information.factor()?.inverse();
        let solved = unknowns.count();
        let mut half = [[0.0; WITH_SHAPE]; POSE];
        for (i, half) in half.iter_mut().enumerate().take(solved) {
            for (k, half) in half.iter_mut().enumerate().take(n) {
                *half = (0..n).map(|m| inverse[i][m] * scatter.entry(m, k)).sum();
            }
        }
        let covariance = Matrix6::from_fn(|i, k| match i < solved && k < solved {
            true => (0..n).map(|m| half[i][m] * inverse[m][k]).sum(),
            false => 0.0,
        });
        // Rounding makes it slightly asymmetric.
        Some(0.5 * (covariance + covariance.transpose()))
    }
}

/// Lower bound of the mean derivative of the influence function. Below it most residuals lie beyond
/// the inflection of the biweight, and the estimate of that mean is unreliable. Not derived;
/// chosen.
const MIN_INFLUENCE_SLOPE: f64 = 0.4;

/// Derivative of the solution by the right-hand sides `slopes`: one column for each of them.
pub fn pose_changes(factor: &Factor, slopes: &[Row; POSE], unknowns: &Unknowns) -> Matrix6<f64> {
    let mut pose_changes = Matrix6::zeros();
    for (i, slope) in slopes.iter().enumerate() {
        let mut slope = *slope;
        slope[unknowns.count()..POSE].fill(0.0);
        slope[POSE..WITH_KEYFRAME].fill(0.0);
        let solution = factor.solve(&slope);
        (0..POSE).for_each(|k| pose_changes[(k, i)] = solution[k]);
    }
    pose_changes
}

/// Robust scale of the residuals along the directions that the tracks constrain, pixels. Along
/// straight edges (joints between tiles) residuals are larger, but have no weight there.
pub fn well_constrained_scale(
    camera: &Camera,
    pose: &GroundPose,
    information: &NormalEquations,
    weights: &[f64],
    scale_px: f64,
) -> f64 {
    let pixels_per_m = camera.focal_px().0 / pose.height_m;
    let isotropic = pixels_per_m * pixels_per_m * weights.iter().sum::<f64>();
    scale_px * (2.0 * isotropic / (information.entry(0, 0) + information.entry(1, 1))).sqrt()
}

/// Derivative of the pose by roll and pitch of the prior's mean.
pub fn by_prior_tilt(factor: &Factor, rig_prior: &WeightedRigPrior, unknowns: &Unknowns) -> Matrix6x2<f64> {
    let mut by_tilt = Matrix6x2::zeros();
    for i in [1, 2].into_iter().filter(|i| 3 + i < unknowns.count()) {
        let column = factor.column(3 + i);
        (0..POSE).for_each(|k| by_tilt[(k, i - 1)] = rig_prior.weight[i] * column[k]);
    }
    by_tilt
}
