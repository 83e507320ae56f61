//! Error of the mount's roll and pitch, as the frames of a recording show it. Derivation:
//! `docs/math/frame-pose.md`.

use super::RigEvidence;
use crate::geometry::GroundPose;
use nalgebra::{Matrix2, Matrix3, Matrix3x2, Vector2, Vector3};

/// Error of roll and pitch of the rig file: a normal distribution, radians.
///
/// A frame alone tells its tilt only relative to that of its keyframe. That both have the same
/// tilt, the mount's, makes it observable: under a wrong one a motion along the ground looks like a
/// change of height and tilt. How exact that is shows in how well the keyframes agree.
#[derive(Debug, Clone, Copy)]
pub struct MountTilt {
    prior: Matrix2<f64>,
    /// What an earlier pass over the same frames left, radians².
    earlier_pass: Option<Matrix2<f64>>,
    keyframes: SharedTilt,
    /// What the last frame tells.
    latest: Option<SharedTilt>,
}

/// What pairs of a frame and its keyframe tell of the tilt that both share, as sums of a linear
/// least-squares problem: information matrix, that times the tilt, and sum of squares.
#[derive(Debug, Clone, Copy)]
pub struct SharedTilt {
    information: Matrix2<f64>,
    vector: Vector2<f64>,
    squares: f64,
    pairs: usize,
}

impl SharedTilt {
    const NONE: Self = Self {
        information: Matrix2::new(0.0, 0.0, 0.0, 0.0),
        vector: Vector2::new(0.0, 0.0),
        squares: 0.0,
        pairs: 0,
    };

    /// From the height and tilt of a frame given those of its keyframe, where both are those of the
    /// mount but for independent deviations with these variances. Relative to `nominal`. The height
    /// over the ground is `rise_m` larger than in the keyframe.
    pub fn new(
        evidence: &RigEvidence,
        keyframe: &GroundPose,
        rise_m: f64,
        nominal: &Vector2<f64>,
        variances: &Vector3<f64>,
    ) -> Option<Self> {
        let assumed = Vector3::new(keyframe.height_m, keyframe.roll_rad, keyframe.pitch_rad);
        let by_both = Matrix3::identity() - evidence.by_keyframe;
        let by_tilt: Matrix3x2<f64> = by_both.fixed_columns::<2>(1).into_owned();
        let change = evidence.value - assumed - Vector3::new(rise_m, 0.0, 0.0);
        let measured = change + by_tilt * (assumed.fixed_rows::<2>(1) - nominal);
        let deviations = Matrix3::from_diagonal(variances);
        let noise = evidence.covariance
            + deviations
            + evidence.by_keyframe * deviations * evidence.by_keyframe.transpose();
        let weight = noise.try_inverse()?;
        Some(Self {
            information: by_tilt.transpose() * weight * by_tilt,
            vector: by_tilt.transpose() * weight * measured,
            squares: measured.dot(&(weight * measured)),
            pairs: 1,
        })
    }

    fn with(&self, other: &Self) -> Self {
        Self {
            information: self.information + other.information,
            vector: self.vector + other.vector,
            squares: self.squares + other.squares,
            pairs: self.pairs + other.pairs,
        }
    }

    /// Mean and covariance of the tilt, whose prior has mean zero and this covariance. The noise is
    /// scaled by what the pairs leave (R. Birge, 1932), with the assumed one as some pairs' worth.
    fn posterior(&self, prior: &Matrix2<f64>) -> Option<(Vector2<f64>, Matrix2<f64>)> {
        let prior_information = prior.try_inverse()?;
        let unscaled = (prior_information + self.information).try_inverse()?;
        let squares = (self.squares - self.vector.dot(&(unscaled * self.vector))).max(0.0);
        let scale = (ASSUMED_PAIRS + squares / 3.0) / (ASSUMED_PAIRS + self.pairs as f64);
        let covariance = (prior_information + self.information / scale).try_inverse()?;
        Some((covariance * self.vector / scale, 0.5 * (covariance + covariance.transpose())))
    }
}

/// Weight of the assumed noise among what pairs of frames show of it, pairs. Not derived; chosen.
const ASSUMED_PAIRS: f64 = 3.0;

/// Prior standard deviation of an unknown mount tilt, radians: larger ones are visible when the
/// camera is mounted. Not derived; chosen.
const PRIOR_TILT_SIGMA: f64 = 0.05;

/// Smallest prior standard deviation, radians: tilts are never known better. Not derived; chosen.
const MIN_TILT_SIGMA: f64 = 1e-6;

/// Squared standard deviations at which the mean is significant (five sigma), and minimum number of
/// keyframes: over a single one a slow variation looks like a constant tilt. Not derived; chosen.
const SIGNIFICANT_TILT: f64 = 25.0;
const MIN_KEYFRAMES: usize = 3;

/// Largest ratio of the short-term standard deviation to the tilt itself for a tilt of the mount
/// rather than of a hand or a spring. Not derived; chosen.
const MAX_RELATIVE_VARIATION: f64 = 1.0 / 3.0;

impl MountTilt {
    /// Of a mount of which nothing is known but that it looks level to the eye.
    pub fn unknown() -> Self {
        Self {
            prior: Self::unknown_covariance(),
            earlier_pass: None,
            keyframes: SharedTilt::NONE,
            latest: None,
        }
    }

    /// Covariance before any keyframe, radians².
    pub fn unknown_covariance() -> Matrix2<f64> {
        Matrix2::from_diagonal_element(PRIOR_TILT_SIGMA * PRIOR_TILT_SIGMA)
    }

    /// Sets the covariance of a tilt that was measured in other frames, radians².
    pub fn set_covariance(&mut self, covariance: Matrix2<f64>) {
        self.prior = covariance;
    }

    /// Sets the covariance of a tilt that an earlier pass found in the same frames, radians².
    pub fn set_earlier_pass(&mut self, covariance: Matrix2<f64>) {
        self.earlier_pass = Some(covariance);
    }

    /// Sets the standard deviations of roll and pitch, radians, where they are known.
    pub fn set_deviations(&mut self, deviations: [Option<f64>; 2]) {
        let variances = deviations.map(|known| known.unwrap_or(PRIOR_TILT_SIGMA).max(MIN_TILT_SIGMA).powi(2));
        self.prior = Matrix2::from_diagonal(&variances.into());
    }

    /// What the present frame tells; counts for good only if it is the last one of its keyframe.
    pub fn saw(&mut self, shared: Option<SharedTilt>) {
        self.latest = shared;
    }

    /// A new keyframe begins.
    pub fn change_keyframe(&mut self) {
        if let Some(shared) = self.latest.take() {
            self.keyframes = self.keyframes.with(&shared);
        }
    }

    /// Mean squared errors of roll and pitch with the correction that is applied, as the frames up
    /// to the present one show them; the mount varies by `variances` from frame to frame. Frames
    /// that an earlier pass saw do not count twice: either pass is believed, whichever is surer.
    pub fn squared_errors(&self, variances: [f64; 2]) -> Matrix2<f64> {
        let all = self.latest.map_or(self.keyframes, |shared| self.keyframes.with(&shared));
        let this_pass = all.posterior(&self.prior).unwrap_or((Vector2::zeros(), self.prior));
        let correction = Vector2::from(self.correction(variances));
        let errors = |(mean, covariance): (Vector2<f64>, Matrix2<f64>)| {
            let off = mean - correction;
            covariance + off * off.transpose()
        };
        match self.earlier_pass {
            Some(covariance) if covariance.trace() < this_pass.1.trace() => {
                errors((Vector2::zeros(), covariance))
            }
            _ => errors(this_pass),
        }
    }

    /// The corrections of roll and pitch: zero unless the mean is significant and the short-term
    /// variation is small beside it.
    pub fn correction(&self, variances: [f64; 2]) -> [f64; 2] {
        let posterior = self.keyframes.posterior(&self.earlier_pass.unwrap_or(self.prior));
        let Some((mean, covariance)) = posterior.filter(|_| self.keyframes.pairs >= MIN_KEYFRAMES) else {
            return [0.0; 2];
        };
        [0, 1].map(|i| {
            let squared = mean[i] * mean[i];
            let is_significant = squared > SIGNIFICANT_TILT * covariance[(i, i)];
            let is_steady = variances[i] < MAX_RELATIVE_VARIATION * MAX_RELATIVE_VARIATION * squared;
            if is_significant && is_steady { mean[i] } else { 0.0 }
        })
    }
}
