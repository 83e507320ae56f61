//! Absolute trajectory error (ATE): each aligned pose against its ground truth.

use super::association::PosePair;
use super::statistics::Statistics;

/// Absolute trajectory error of each aligned pose, in the order of the pairs.
#[derive(Debug, Clone, PartialEq)]
pub struct AbsoluteErrors {
    /// Distance between estimated and true position, metres.
    pub translation_m: Vec<f64>,
    /// Angle of the rotation between estimated and true orientation, radians in [0, π].
    pub rotation_rad: Vec<f64>,
    /// Statistics of the distances.
    pub translation: Statistics,
    /// Statistics of the angles.
    pub rotation: Statistics,
}

pub(super) fn measure(pairs: &[PosePair]) -> AbsoluteErrors {
    let distance =
        |pair: &PosePair| (pair.truth.translation.vector - pair.estimate.translation.vector).norm();
    let angle = |pair: &PosePair| (pair.truth.rotation.inverse() * pair.estimate.rotation).angle();
    let translation_m: Vec<_> = pairs.iter().map(distance).collect();
    let rotation_rad: Vec<_> = pairs.iter().map(angle).collect();
    // There is always at least one pair; the default is never used.
    let summary = |errors: &[f64]| Statistics::of(errors).unwrap_or(NOTHING);
    AbsoluteErrors {
        translation: summary(&translation_m),
        rotation: summary(&rotation_rad),
        translation_m,
        rotation_rad,
    }
}

const NOTHING: Statistics =
    Statistics { count: 0, rmse: 0.0, mean: 0.0, median: 0.0, std: 0.0, min: 0.0, max: 0.0, sse: 0.0 };
