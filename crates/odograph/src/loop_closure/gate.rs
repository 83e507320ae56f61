//! The gate that a match must pass to be consistent with a predicted pose.

use crate::geometry::pose_index::{HEADING, X, Y};
use crate::geometry::wrap_angle;
use nalgebra::{Matrix3, Matrix4, Vector3, Vector4};

/// Gate of the normalised innovation squared: one in a thousand true loops exceeds it (chi-square,
/// three degrees of freedom).
pub const GATE: f64 = 16.3;

/// Gate of a match that contradicts the graph: three times the standard deviations of [`GATE`].
/// Patterns repeat beyond what the prior admits, and odometry over ground that is no plane, with a
/// lens that is not known, states its error too small: over a field with trees most loops had 17 to
/// 157. A match between the two gates makes another one ambiguous, and needs one that confirms it.
pub const CONTRADICTION_GATE: f64 = 9.0 * GATE;

/// Unmodelled errors of lens and tilt, metres and radians: a third of a pixel for a camera 0.5 m
/// high with a focal length of 330 pixels, and far less than the distance to the next place that
/// could be confused.
const UNMODELLED: f64 = 5e-4;

/// Normalised innovation squared of a motion against an expected one, over (x, y, heading);
/// `covariance` is that of their difference.
pub fn normalised_innovation_squared(
    motion: &Vector4<f64>,
    covariance: &Matrix4<f64>,
    expected: &Vector4<f64>,
) -> f64 {
    let off = motion - expected;
    let off = Vector3::new(off[X], off[Y], wrap_angle(off[HEADING]));
    let covariance = covariance.fixed_view::<3, 3>(0, 0) + Matrix3::identity() * UNMODELLED.powi(2);
    covariance.try_inverse().map_or(f64::INFINITY, |information| off.dot(&(information * off)))
}
