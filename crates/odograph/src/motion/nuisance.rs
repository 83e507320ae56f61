//! Unknowns beside the pose of a frame, eliminated by the Schur complement: the rates of the pose
//! within the image and the readout time.
//!
//! With rows J of the pose and E of the nuisance parameters δ, weights w and the prior's information P
//! the normal equations are `[H11 H12; H21 H22]` with `H22 = Σ w EᵀE + P`. Rows reduced by
//! `K = H22⁻¹ H21`, that is `J − E K`, have the pose's marginal information, less `Kᵀ P K`, which is
//! added. Whatever is made of reduced rows (steps, covariances, sensitivities) holds for any δ.

use super::planar_pose::Residual;
use super::rolling_shutter::{ShutterEstimate, ShutterPrior};
use super::{Observation, PoseRates};
use crate::geometry::GroundPose;
use nalgebra::{Matrix6, SMatrix, SVector, Vector6};

/// Six rates and the readout time.
const NUISANCES: usize = 7;

type Nuisances = SVector<f64, NUISANCES>;

/// The shutter's unknowns of one frame, during its fit.
#[derive(Debug, Clone)]
pub struct ShutterFit<'a> {
    prior: &'a ShutterPrior,
    /// The rates with which the pixels were brought to a global shutter.
    assumed: PoseRates,
    /// What rates and readout time differ by from what was assumed.
    difference: Nuisances,
}

/// The normal equations of the nuisance parameters, solved for a given pose.
#[derive(Debug, Clone)]
pub struct Elimination {
    /// K of the [module](self).
    by_pose: SMatrix<f64, NUISANCES, 6>,
    /// `H22⁻¹`.
    inverse: SMatrix<f64, NUISANCES, NUISANCES>,
    /// The step of the nuisance parameters for a pose that stays.
    step: Nuisances,
    prior_information: Nuisances,
    /// What the pose's information has beside that of the reduced rows.
    pub information: Matrix6<f64>,
    /// What the slope of the pose has beside that of the reduced rows.
    pub slope: Vector6<f64>,
}

impl<'a> ShutterFit<'a> {
    /// Nothing fitted yet. `assumed` are the rates with which pixels were brought to a global shutter.
    pub fn new(prior: &'a ShutterPrior, assumed: PoseRates) -> Self {
        Self { prior, assumed, difference: Nuisances::zeros() }
    }

    /// The rows of the nuisance parameters of an observation.
    fn rows(&self, observation: &Observation, residual: &Residual) -> [[f64; NUISANCES]; 2] {
        let fraction = observation.row_fraction;
        let time_s = fraction * self.prior.readout.mean_s;
        let [x, y] = observation.ground_by_readout;
        residual.by_pose.map(|row| {
            let along: f64 = row.iter().zip(&self.assumed).map(|(by, rate)| by * rate).sum();
            let mut all = [0.0; NUISANCES];
            for (all, by) in all.iter_mut().zip(row) {
                *all = time_s * by;
            }
            // A ground point moves as the camera would move in the opposite direction.
            all[NUISANCES - 1] = fraction * along - row[0] * x - row[1] * y;
            all
        })
    }

    /// Adds to a residual what rates and readout time differ by from what was assumed.
    pub fn correct(&self, observation: &Observation, residual: &mut Residual) {
        let rows = self.rows(observation, residual);
        for (error, row) in residual.error.iter_mut().zip(&rows) {
            *error += row.iter().zip(&self.difference).map(|(by, value)| by * value).sum::<f64>();
        }
    }

    /// Reduces the rows of all residuals; `scale_px` is the standard deviation of a usual one. `None`
    /// where the nuisance parameters have neither prior nor evidence.
    pub fn eliminate(
        &self,
        observations: &[Observation],
        residuals: &mut [Residual],
        weights: &[f64],
        scale_px: f64,
    ) -> Option<Elimination> {
        let sigma = self.prior.rate_sigma.insert_row(6, self.prior.readout.variance_s2.sqrt());
        let prior_information = sigma.map(|sigma| (scale_px / sigma.max(1e-12)).powi(2));
        let mut own = SMatrix::<f64, NUISANCES, NUISANCES>::zeros();
        let mut cross = SMatrix::<f64, NUISANCES, 6>::zeros();
        let mut slope = Nuisances::zeros();
        for ((observation, residual), &weight) in observations.iter().zip(&*residuals).zip(weights) {
            if weight <= 0.0 {
                continue;
            }
            let rows = self.rows(observation, residual);
            for ((row, by_pose), error) in rows.iter().zip(&residual.by_pose).zip(residual.error) {
                for i in 0..NUISANCES {
                    let weighted = weight * row[i];
                    for k in 0..=i {
                        own[(i, k)] += weighted * row[k];
                    }
                    for k in 0..6 {
                        cross[(i, k)] += weighted * by_pose[k];
                    }
                    slope[i] += weighted * error;
                }
            }
        }
        own.fill_upper_triangle_with_lower_triangle();
        let with_prior = own + SMatrix::from_diagonal(&prior_information);
        let slope = slope + prior_information.component_mul(&self.difference);
        let inverse = with_prior.cholesky()?.inverse();
        let by_pose = inverse * cross;
        for (observation, residual) in observations.iter().zip(residuals) {
            let rows = self.rows(observation, residual);
            for (row, by) in rows.iter().zip(&mut residual.by_pose) {
                for (k, by) in by.iter_mut().enumerate() {
                    *by -= (0..NUISANCES).map(|i| row[i] * by_pose[(i, k)]).sum::<f64>();
                }
            }
        }
        let weighted = SMatrix::from_diagonal(&prior_information) * by_pose;
        Some(Elimination {
            information: by_pose.tr_mul(&weighted),
            slope: -weighted.tr_mul(&self.difference),
            step: inverse * slope,
            by_pose,
            inverse,
            prior_information,
        })
    }

    /// Takes the step that belongs to one of the pose, from `before` to `after`.
    pub fn advance(&mut self, elimination: &Elimination, before: &GroundPose, after: &GroundPose) {
        let moved = before.to_vector() - after.to_vector();
        self.difference -= elimination.step - elimination.by_pose * moved;
    }

    /// What the frame tells of its shutter. `pose_covariance` is that of the pose in units of the
    /// squared pixel noise.
    pub fn estimate(
        &self,
        elimination: &Elimination,
        pose_covariance: &Matrix6<f64>,
        scale_px: f64,
    ) -> ShutterEstimate {
        let by_pose = &elimination.by_pose;
        let covariance = elimination.inverse + by_pose * pose_covariance * by_pose.transpose();
        let (mut value, mut information) = (self.difference, Nuisances::zeros());
        for i in 0..NUISANCES {
            let posterior = 1.0 / covariance[(i, i)];
            // Less than a thousandth of the prior's is rounding.
            let alone = posterior - elimination.prior_information[i];
            if alone > 1e-3 * posterior {
                value[i] *= posterior / alone;
                information[i] = alone / (scale_px * scale_px);
            }
        }
        let rates = |values: &Nuisances| -> PoseRates { values.fixed_rows::<6>(0).into_owned() };
        ShutterEstimate {
            rates: self.assumed + rates(&self.difference),
            expected: self.assumed,
            evidence: self.assumed + rates(&value),
            evidence_variance: rates(&information).map(|information| 1.0 / information),
            readout_s: self.prior.readout.mean_s + value[NUISANCES - 1],
            readout_information: information[NUISANCES - 1],
        }
    }
}
