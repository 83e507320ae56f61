//! Random variation of height and tilt of a mount that is not rigid: between the views of a pair,
//! and of a keyframe against the mount.

use super::TILT;
use super::pair::SolvedPair;
use super::system::System;
use crate::numerics::{Part, inverse};
use nalgebra::{Matrix2, SVector, Vector2};

/// Zero-mean Gaussian prior of the change of height and tilt between the views of a pair. Its
/// variances are estimated from the recording (empirical Bayes, as
/// [`crate::motion::RigPriorEstimator`] does for the odometry) and vanish on a rigid mount.
pub struct PairVariation {
    pub variance: [f64; 3],
}

/// Initial standard deviations: fraction of the height, radians.
const INITIAL_PAIR_SIGMAS: [f64; 3] = [0.01, 0.01, 0.01];

/// Lower bound of the standard deviations, without measurable effect.
const MIN_SIGMA: f64 = 1e-6;

impl Default for PairVariation {
    fn default() -> Self {
        Self { variance: INITIAL_PAIR_SIGMAS.map(|sigma| sigma * sigma) }
    }
}

impl PairVariation {
    /// One step of expectation-maximisation (A. Dempster, N. Laird, D. Rubin, 1977).
    pub fn update<const N: usize>(&mut self, pairs: &[SolvedPair<'_>], systems: &[System<N>]) {
        let mut squares = [0.0; 3];
        let mut count = 0.0;
        for (pair, system) in pairs.iter().zip(systems) {
            let Some(covariance) = inverse(&system.movement) else { continue };
            for k in 0..3 {
                squares[k] += pair.movement[3 + k] * pair.movement[3 + k] + covariance[(3 + k, 3 + k)];
            }
            count += 1.0;
        }
        if count > 0.0 {
            self.variance = squares.map(|sum| (sum / count).max(MIN_SIGMA * MIN_SIGMA));
        }
    }
}

/// Zero-mean Gaussian prior of the roll and pitch of a keyframe against the mount, estimated as in
/// [`PairVariation`].
pub struct KeyframeVariation {
    variance: [f64; TILT],
}

impl Default for KeyframeVariation {
    fn default() -> Self {
        Self { variance: [INITIAL_KEYFRAME_SIGMA_RAD * INITIAL_KEYFRAME_SIGMA_RAD; TILT] }
    }
}

/// Initial standard deviation, radians.
const INITIAL_KEYFRAME_SIGMA_RAD: f64 = 0.01;

/// A keyframe with its tilt marginalised.
pub struct Marginal<const N: usize> {
    /// Equations of the remaining unknowns.
    pub reduced: Part<N>,
    /// Covariance of its tilt given the remaining unknowns.
    pub covariance: Matrix2<f64>,
    /// That covariance times the gradient: its step at zero change of the others.
    slope: Vector2<f64>,
}

impl KeyframeVariation {
    /// Marginalises the tilt of a keyframe. `part` holds the equations of its pairs about
    /// `keyframe_tilt` against the mount. Its pairs cannot distinguish it from the tilt of the
    /// mount.
    pub fn marginalised<const N: usize>(
        &self,
        part: &Part<N>,
        keyframe_tilt: &Vector2<f64>,
    ) -> Option<Marginal<N>> {
        let prior = Vector2::from(self.variance.map(f64::recip));
        let own = part.information.fixed_view::<TILT, TILT>(0, 0) + Matrix2::from_diagonal(&prior);
        let covariance = inverse(&own)?;
        let slope = part.slope.fixed_rows::<TILT>(0) - prior.component_mul(keyframe_tilt);
        let cross = part.information.fixed_columns::<TILT>(0);
        let reduced = Part {
            information: part.information - cross * covariance * cross.transpose(),
            slope: part.slope - cross * covariance * slope,
        };
        Some(Marginal { reduced, covariance, slope })
    }

    /// One step of expectation maximisation over the keyframes with equations.
    pub fn update(&mut self, keyframe_tilts: &[Vector2<f64>], covariances: &[Vector2<f64>]) {
        for k in 0..TILT {
            let squares: f64 =
                keyframe_tilts.iter().zip(covariances).map(|(own, unsure)| own[k] * own[k] + unsure[k]).sum();
            self.variance[k] = (squares / keyframe_tilts.len().max(1) as f64).max(MIN_SIGMA * MIN_SIGMA);
        }
    }
}

impl<const N: usize> Marginal<N> {
    /// Back substitution: the step of the keyframe's tilt for a step of the remaining unknowns.
    pub fn step(&self, part: &Part<N>, rest: &SVector<f64, N>) -> Vector2<f64> {
        self.covariance * (self.slope - part.information.fixed_rows::<TILT>(0) * rest)
    }
}
