//! Relative errors: the movement over a stretch against the true movement over it.

use super::association::{PosePair, path_m};
use super::statistics::Statistics;
use crate::error::{Error, Result};
use nalgebra::Isometry3;
use std::fmt;

/// How long a stretch is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Delta {
    /// A count of compared poses, at least 1.
    Frames(usize),
    /// A length of the estimate's path, metres, positive.
    Metres(f64),
}

impl Delta {
    /// Fails where the delta is zero, negative or not finite.
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

/// Relative pose error over stretches of one length.
#[derive(Debug, Clone, PartialEq)]
pub struct RelativeErrors {
    /// How long the stretches are.
    pub delta: Delta,
    /// First and last pair of each stretch, as indices into the compared pairs.
    pub stretches: Vec<(usize, usize)>,
    /// Length of the translation that each stretch is off by, metres.
    pub translation_m: Vec<f64>,
    /// Angle of the rotation that each stretch is off by, radians in [0, π].
    pub rotation_rad: Vec<f64>,
    /// Summary of the lengths.
    pub translation: Statistics,
    /// Summary of the angles.
    pub rotation: Statistics,
}

/// Stretches in metres that start at every pose may be longer or shorter than wanted by this share: evo's default.
const LENGTH_TOLERANCE: f64 = 0.1;

/// The relative errors over one delta; `None` where the path is too short for a single stretch.
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

/// Stretches that begin where the one before ended, each as short as it can be without being shorter than wanted.
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

/// From every pose the stretch whose length comes nearest to the wanted one, where it is near enough.
fn every_start(path_m: &[f64], length_m: f64) -> Vec<(usize, usize)> {
    let stretch = |start: usize| {
        let from_here = |index: usize| path_m[index] - path_m[start];
        let off = |index: usize| (from_here(index) - length_m).abs();
        let first = start + 1;
        let reached = first + path_m.get(first..)?.partition_point(|&at| at - path_m[start] < length_m);
        let after = (reached < path_m.len()).then_some(reached);
        // Of several poses at the same place the first one counts.
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
