//! Relative pose error (RPE): estimated against true motion over path segments.

use super::association::{PosePair, path_m};
use super::statistics::Statistics;
use crate::error::{Error, Result};
use nalgebra::Isometry3;
use std::fmt;

/// Length of a segment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Delta {
    /// Number of compared poses, at least 1.
    Frames(usize),
    /// Length along the estimated path, metres, positive.
    Metres(f64),
}

impl Delta {
    /// Fails if the delta is zero, negative or not finite.
    pub(super) fn check(self) -> Result<()> {
        match self {
            Self::Frames(count) if count > 0 => Ok(()),
            Self::Metres(length_m) if length_m.is_finite() && length_m > 0.0 => Ok(()),
            _ => Err(Error::usage(format!(
                "a relative error over {self} is not possible; the delta must be positive"
            ))),
        }
    }
}

impl fmt::Display for Delta {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Frames(1) => f.write_str("1 frame"),
            Self::Frames(count) => write!(f, "{count} frames"),
            Self::Metres(length_m) => write!(f, "{length_m} m"),
        }
    }
}

/// Relative pose errors over segments of one length.
#[derive(Debug, Clone, PartialEq)]
pub struct RelativeErrors {
    /// Length of the segments.
    pub delta: Delta,
    /// First and last pair of each segment, as indices into the compared pairs.
    pub stretches: Vec<(usize, usize)>,
    /// Norm of the translation error of each segment, metres.
    pub translation_m: Vec<f64>,
    /// Angle of the rotation error of each segment, radians in [0, π].
    pub rotation_rad: Vec<f64>,
    /// Statistics of the translation errors.
    pub translation: Statistics,
    /// Statistics of the rotation errors.
    pub rotation: Statistics,
}

/// Relative tolerance on the length of overlapping segments in metres; the default of evo.
const LENGTH_TOLERANCE: f64 = 0.1;

/// Relative pose errors for one delta; `None` if the path is shorter than one segment.
pub(super) fn measure(pairs: &[PosePair], delta: Delta, all_pairs: bool) -> Option<RelativeErrors> {
    let stretches = match (delta, all_pairs) {
        (Delta::Frames(count), true) => {
            (0..pairs.len().saturating_sub(count)).map(|start| (start, start + count)).collect()
        }
        (Delta::Frames(count), false) => {
            let starts: Vec<_> = (0..pairs.len()).step_by(count.max(1)).collect();
            consecutive(&starts)
        }
        (Delta::Metres(length_m), true) => every_start(&path_m(pairs, |pair| &pair.estimate), length_m),
        (Delta::Metres(length_m), false) => one_after_another(pairs, length_m),
    };
    let errors: Vec<_> =
        stretches.iter().map(|&(start, end)| error_between(&pairs[start], &pairs[end])).collect();
    let translation_m: Vec<_> = errors.iter().map(|error| error.translation.vector.norm()).collect();
    let rotation_rad: Vec<_> = errors.iter().map(|error| error.rotation.angle()).collect();
    Some(RelativeErrors {
        delta,
        stretches,
        translation: Statistics::of(&translation_m)?,
        rotation: Statistics::of(&rotation_rad)?,
        translation_m,
        rotation_rad,
    })
}

/// Sturm et al., equation 1: `(Q_i⁻¹ Q_j)⁻¹ (P_i⁻¹ P_j)`, Q the truth, P the estimate.
pub(super) fn error_between(start: &PosePair, end: &PosePair) -> Isometry3<f64> {
    let truth = start.truth.inverse() * end.truth;
    let estimate = start.estimate.inverse() * end.estimate;
    truth.inverse() * estimate
}

fn consecutive(ends: &[usize]) -> Vec<(usize, usize)> {
    ends.windows(2).map(|pair| (pair[0], pair[1])).collect()
}

/// Consecutive segments: each ends at the first pose that is at least `length_m` along the path
/// from its start.
fn one_after_another(pairs: &[PosePair], length_m: f64) -> Vec<(usize, usize)> {
    let mut ends = vec![0];
    let mut since_m = 0.0;
    for (index, step) in pairs.windows(2).enumerate() {
        since_m += (step[1].estimate.translation.vector - step[0].estimate.translation.vector).norm();
        if since_m >= length_m {
            ends.push(index + 1);
            since_m = 0.0;
        }
    }
    consecutive(&ends)
}

/// Overlapping segments: from every pose the segment whose length is closest to `length_m`, if it
/// is within the tolerance.
fn every_start(path_m: &[f64], length_m: f64) -> Vec<(usize, usize)> {
    let stretch = |start: usize| {
        let from_here = |index: usize| path_m[index] - path_m[start];
        let off = |index: usize| (from_here(index) - length_m).abs();
        let first = start + 1;
        let reached = first + path_m.get(first..)?.partition_point(|&at| at - path_m[start] < length_m);
        let after = (reached < path_m.len()).then_some(reached);
        // Of several poses with equal path length, the first one counts.
        let before = (reached > first).then(|| {
            let place = from_here(reached - 1);
            first + path_m[first..reached].partition_point(|&at| at - path_m[start] < place)
        });
        let end = match (before, after) {
            (Some(before), Some(after)) => {
                if off(before) <= off(after) {
                    before
                } else {
                    after
                }
            }
            (Some(only), None) | (None, Some(only)) => only,
            (None, None) => return None,
        };
        (off(end) <= length_m * LENGTH_TOLERANCE).then_some((start, end))
    };
    (0..path_m.len()).filter_map(stretch).collect()
}
