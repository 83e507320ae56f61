//! Absolute errors: each pose against its own truth.

use super::association::PosePair;
use super::statistics::Statistics;

/// Absolute trajectory error: how far each aligned pose is from the truth, in the order of the pairs.
#[derive(Debug, Clone, PartialEq)]
pub struct AbsoluteErrors {
    /// Distance of each position from the truth, metres.
    pub translation_m: Vec<f64>,
    /// Angle of the rotation between each orientation and the truth, radians in [0, π].
    pub rotation_rad: Vec<f64>,
    /// Summary of the distances.
    pub translation: Statistics,
    /// Summary of the angles.
    pub rotation: Statistics,
}

pub(super) fn measure(pairs: &[PosePair]) -> AbsoluteErrors {
    let distance =
        |pair: &PosePair| (pair.truth.translation.vector - pair.estimate.translation.vector).norm();
    let angle = |pair: &PosePair| (pair.truth.rotation.inverse() * pair.estimate.rotation).angle();
    let translation_m: Vec<_> = pairs.iter().map(distance).collect();
    let rotation_rad: Vec<_> = pairs.iter().map(angle).collect();
    // Pairs are never empty; a lone zero says the same of none.
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
