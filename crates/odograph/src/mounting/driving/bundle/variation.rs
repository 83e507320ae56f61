//! How much a mount that is not steady moves: the second view of a pair against the first, and a keyframe against the mount.

use super::TILT;
use super::pair::SolvedPair;
use super::system::System;
use crate::numerics::{Part, inverse};
use nalgebra::{Matrix2, SVector, Vector2};

/// By how much the second view of a pair may be higher and tilted against the first: a Gaussian whose variances the recording itself
/// tells (empirical Bayes, as [`crate::motion::RigPriorEstimator`] does for the odometry). On a steady mount nothing is left of them.
pub struct PairVariation {
    pub variance: [f64; 3],
}

/// Standard deviations to begin with: a part of the height, radians.
const INITIAL_PAIR_SIGMAS: [f64; 3] = [0.01, 0.01, 0.01];

/// Below this nothing changes that could be measured.
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

/// By how much a keyframe may be tilted against the mount, in roll and pitch: as [`PairVariation`], from keyframe to keyframe.
pub struct KeyframeVariation {
    variance: [f64; TILT],
}

impl Default for KeyframeVariation {
    fn default() -> Self {
        Self { variance: [INITIAL_KEYFRAME_SIGMA_RAD * INITIAL_KEYFRAME_SIGMA_RAD; TILT] }
    }
}

/// Standard deviation to begin with, radians.
const INITIAL_KEYFRAME_SIGMA_RAD: f64 = 0.01;

/// A keyframe whose own tilt is free.
pub struct Marginal<const N: usize> {
    /// What its pairs say about the rest then.
    pub reduced: Part<N>,
    /// How well its tilt is known where the rest is.
    pub covariance: Matrix2<f64>,
    /// That times the way to where it would be.
    slope: Vector2<f64>,
}

impl KeyframeVariation {
    /// Frees the tilt of a keyframe; `part` is what its pairs say where it is tilted by `tilted`. To its pairs it is the same as the tilt of the mount.
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

    /// One step of expectation-maximisation, over the keyframes that say something.
    pub fn update(&mut self, keyframe_tilts: &[Vector2<f64>], covariances: &[Vector2<f64>]) {
        for k in 0..TILT {
            let squares: f64 =
                keyframe_tilts.iter().zip(covariances).map(|(own, unsure)| own[k] * own[k] + unsure[k]).sum();
            self.variance[k] = (squares / keyframe_tilts.len().max(1) as f64).max(MIN_SIGMA * MIN_SIGMA);
        }
    }
}

impl<const N: usize> Marginal<N> {
    /// The step of the keyframe's tilt that goes with one of the rest.
    pub fn step(&self, part: &Part<N>, rest: &SVector<f64, N>) -> Vector2<f64> {
        self.covariance * (self.slope - part.information.fixed_rows::<TILT>(0) * rest)
    }
}
