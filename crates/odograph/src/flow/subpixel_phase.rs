//! Subpixel phase of a patch's samples, on which interpolation bias and noise depend. Derivation:
//! `docs/math/interpolation-bias.md`.

use super::patch::SIDE;
use nalgebra::Matrix2;

/// Subpixel phase of the samples of a patch with this centre, 0 to 1. A patch has an even side: its
/// samples lie on pixels when its centre lies between them.
pub(super) fn fraction(centre: f64) -> f64 {
    let from_edge = centre - 0.5;
    from_edge - from_edge.floor()
}

/// Phase coherence of the samples of a patch along x and y of the image: 1 where all have the same
/// subpixel phase, as on a grid along the image axes (also rotated by right angles), 0 where the
/// phases are mixed.
pub(super) fn phase_coherence(linear: &Matrix2<f64>) -> [f64; 2] {
    [0, 1].map(|axis| {
        let (along_row, along_column) = (linear[(axis, 0)], linear[(axis, 1)]);
        let straight = along_row.round().abs() + along_column.round().abs() == 1.0;
        if straight { coherence_of_step(along_row) * coherence_of_step(along_column) } else { 0.0 }
    })
}

/// Phase coherence of a row or column of samples at distance `step`: an approximation of the mean
/// cosine, zero from one full period on.
fn coherence_of_step(step: f64) -> f64 {
    let around = (SIDE as f64 * (step - step.round())).powi(2);
    if around < 1.0 { (1.0 - around) * (1.0 - 0.6 * around) } else { 0.0 }
}
