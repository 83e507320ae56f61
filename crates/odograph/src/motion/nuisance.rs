//! The skew of a rolling shutter as unknowns beside the pose of a frame, eliminated by the Schur
//! complement.
//!
//! The *skew* of an image is how far its pose moves from the first row to the last: readout time times
//! the rates of the pose. With rows J of the pose and E of the skew's difference δ from what was
//! assumed, weights w and the prior's information P, the normal equations are `[H11 H12; H21 H22]` with
//! `H22 = Σ w EᵀE + P`. Rows reduced by `K = H22⁻¹ H21`, that is `J − E K`, have the pose's marginal
//! information less `Kᵀ P K`, which is added. Whatever is made of reduced rows (steps, covariances,
//! sensitivities) holds for any δ.

use super::planar_pose::Residual;
use super::rolling_shutter::{ShutterEstimate, ShutterPrior};
use super::{Observation, PoseRates};
use crate::geometry::GroundPose;
use nalgebra::{Matrix6, Vector2, Vector6};

/// The skew of one frame, during its fit.
#[derive(Debug, Clone)]
pub struct ShutterFit<'a> {
    prior: &'a ShutterPrior,
    /// The rates with which the pixels were brought to a global shutter.
    assumed: PoseRates,
    /// What the skew differs by from what was assumed, metres and radians.
    difference: Vector6<f64>,
}

/// The normal equations of the skew, solved for a given pose.
#[derive(Debug, Clone)]
pub struct Elimination {
    /// K of the [module](self).
    by_pose: Matrix6<f64>,
    /// `H22⁻¹` and `H21`.
    inverse: Matrix6<f64>,
    cross: Matrix6<f64>,
    /// The step of the skew for a pose that stays.
    step: Vector6<f64>,
    prior_information: Vector6<f64>,
    /// What the pose's information has beside that of the reduced rows.
    pub information: Matrix6<f64>,
    /// What the slope of the pose has beside that of the reduced rows.
    pub slope: Vector6<f64>,
}

impl<'a> ShutterFit<'a> {
    /// Nothing fitted yet. `assumed` are the rates with which pixels were brought to a global shutter.
    pub fn new(prior: &'a ShutterPrior, assumed: PoseRates) -> Self {
        Self { prior, assumed, difference: Vector6::zeros() }
    }

    /// Adds to a residual what the skew differs by from what was assumed.
    pub fn correct(&self, observation: &Observation, residual: &mut Residual) {
        for (error, row) in residual.error.iter_mut().zip(&residual.by_pose) {
            let along: f64 = row.iter().zip(&self.difference).map(|(by, value)| by * value).sum();
            *error += observation.row_fraction * along;
        }
        let error = Vector2::from(residual.error);
        let in_pixels = observation.whitening.try_inverse().map_or(error, |inverse| inverse * error);
        residual.distance_px = in_pixels.norm();
    }

    /// Reduces the rows of all residuals; `scale_px` is the standard deviation of a usual one. `None`
    /// where the skew has neither prior nor evidence.
    pub fn eliminate(
        &self,
        observations: &[Observation],
        residuals: &mut [Residual],
        weights: &[f64],
        scale_px: f64,
    ) -> Option<Elimination> {
        let sigma = self.prior.skew_sigma(&self.assumed);
        let prior_information = sigma.map(|sigma| (scale_px / sigma.max(1e-12)).powi(2));
        // Sums over Jᵀ J times the row's place in the image and its square: lower triangles.
        let (mut first, mut second) = ([[0.0; 6]; 6], [[0.0; 6]; 6]);
        let mut slope = Vector6::zeros();
        for ((observation, residual), &weight) in observations.iter().zip(&*residuals).zip(weights) {
            if weight <= 0.0 {
                continue;
            }
            let fraction = observation.row_fraction;
            for (row, error) in residual.by_pose.iter().zip(residual.error) {
                for i in 0..6 {
                    let weighted = weight * fraction * row[i];
                    for k in 0..=i {
                        let product = weighted * row[k];
                        first[i][k] += product;
                        second[i][k] += fraction * product;
                    }
                    slope[i] += weighted * error;
                }
            }
        }
        let symmetric =
            |sums: &[[f64; 6]; 6]| Matrix6::from_fn(|i, k| if k <= i { sums[i][k] } else { sums[k][i] });
        let with_prior = symmetric(&second) + Matrix6::from_diagonal(&prior_information);
        let slope = slope + prior_information.component_mul(&self.difference);
        let inverse = with_prior.cholesky()?.inverse();
        let cross = symmetric(&first);
        let by_pose = inverse * cross;
        for (observation, residual) in observations.iter().zip(residuals) {
            for row in &mut residual.by_pose {
                let skew = by_pose.tr_mul(&Vector6::from(*row)) * observation.row_fraction;
                row.iter_mut().zip(&skew).for_each(|(by, skew)| *by -= skew);
            }
        }
        let weighted = Matrix6::from_diagonal(&prior_information) * by_pose;
        Some(Elimination {
            information: by_pose.tr_mul(&weighted),
            slope: -weighted.tr_mul(&self.difference),
            step: inverse * slope,
            by_pose,
            inverse,
            cross,
            prior_information,
        })
    }

    /// Takes the step that belongs to one of the pose, from `before` to `after`.
    pub fn advance(&mut self, elimination: &Elimination, before: &GroundPose, after: &GroundPose) {
        let moved = before.to_vector() - after.to_vector();
        self.difference -= elimination.step - elimination.by_pose * moved;
    }

    /// What a frame that was fitted without a skew tells of it: one step from there, and what the skew
    /// that was left out does to the pose.
    pub fn estimate_aside(
        mut self,
        elimination: &Elimination,
        pose_covariance: &Matrix6<f64>,
        scale_px: f64,
    ) -> ShutterEstimate {
        let Elimination { by_pose, cross, step, .. } = elimination;
        // The pose has no slope any more; its covariance without the skew becomes that with it.
        let information = pose_covariance.try_inverse().unwrap_or_default();
        let with_skew = (information - cross.tr_mul(by_pose)).try_inverse().unwrap_or(*pose_covariance);
        self.difference = -(step + by_pose * with_skew * cross.tr_mul(step));
        ShutterEstimate {
            pose_by_expected_skew: -pose_covariance * cross.transpose(),
            ..self.estimate(elimination, &with_skew, scale_px)
        }
    }

    /// What the frame tells of its shutter. `pose_covariance` is that of the pose in units of the
    /// squared pixel noise.
    pub fn estimate(
        &self,
        elimination: &Elimination,
        pose_covariance: &Matrix6<f64>,
        scale_px: f64,
    ) -> ShutterEstimate {
        let Elimination { by_pose, inverse, prior_information, .. } = elimination;
        let covariance = inverse + by_pose * pose_covariance * by_pose.transpose();
        let (mut evidence, mut variance) = (self.difference, Vector6::repeat(f64::INFINITY));
        for i in 0..6 {
            let posterior = 1.0 / covariance[(i, i)];
            // Less than a thousandth of the prior's is rounding.
            let alone = posterior - prior_information[i];
            if alone > 1e-3 * posterior {
                evidence[i] *= posterior / alone;
                variance[i] = scale_px * scale_px / alone;
            }
        }
        let expected = self.prior.readout.mean_s * self.assumed;
        // A prior that is off pulls the skew, and the skew the pose.
        let pull = by_pose.transpose() * Matrix6::from_diagonal(prior_information);
        ShutterEstimate {
            expected_rates: self.assumed,
            skew: expected + self.difference,
            skew_variance: covariance.diagonal() * (scale_px * scale_px),
            evidence: expected + evidence,
            evidence_variance: variance,
            pose_by_expected_skew: -pose_covariance * pull,
            pose_by_keyframe_skew: Matrix6::zeros(),
        }
    }
}
