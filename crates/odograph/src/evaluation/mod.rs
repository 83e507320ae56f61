//! How good a trajectory is: absolute and relative errors, drift per metre.
//!
//! The steps, in order: poses are paired by time ([`associate`]), the estimate is laid onto the truth ([`Alignment`]), and the
//! paired poses are compared: each by itself ([`AbsoluteErrors`], "ATE"), over short stretches ([`RelativeErrors`], "RPE") and
//! over stretches of given length as a share of that length ([`SegmentDrift`]).
//!
//! Definitions follow J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", 2012, and Z. Zhang and
//! D. Scaramuzza, "A tutorial on quantitative trajectory evaluation for visual(-inertial) odometry", 2018, in the details
//! those of the program evo, so that figures can be put side by side.

mod absolute;
mod alignment;
mod association;
mod drift;
mod relative;
mod statistics;

pub use absolute::AbsoluteErrors;
pub use alignment::{Alignment, Similarity};
pub use association::{PosePair, associate};
pub use drift::SegmentDrift;
pub use relative::{Delta, RelativeErrors};
pub use statistics::Statistics;

use crate::error::{Error, Result};
use crate::trajectory::Trajectory;

/// What is to be measured, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluationOptions {
    /// Poses further apart in time than this are not compared, seconds.
    pub max_time_difference_s: f64,
    /// How the estimate is laid onto the truth.
    pub alignment: Alignment,
    /// The stretches of the relative errors.
    pub deltas: Vec<Delta>,
    /// Whether relative errors start at every pose instead of where the stretch before ended.
    pub all_pairs: bool,
    /// Lengths of the segments that drift is measured over, metres; where empty, every power of ten from 1 m that the path is
    /// long enough for, and 0.1 m for paths shorter than 1 m.
    pub segment_lengths_m: Vec<f64>,
}

impl Default for EvaluationOptions {
    fn default() -> Self {
        Self {
            max_time_difference_s: 0.01,
            alignment: Alignment::Se3,
            deltas: vec![Delta::Frames(1), Delta::Metres(1.0)],
            all_pairs: false,
            segment_lengths_m: vec![],
        }
    }
}

/// All that was measured.
#[derive(Debug, Clone, PartialEq)]
pub struct Evaluation {
    /// The compared poses, the estimate's laid onto the truth's.
    pub pairs: Vec<PosePair>,
    /// Count of poses in the estimate.
    pub estimate_poses: usize,
    /// Count of poses in the truth.
    pub truth_poses: usize,
    /// Time from the first to the last compared pose as a share of the truth's, 0 to 1; `None` for a truth of one pose.
    pub time_covered: Option<f64>,
    /// Path length of the estimate through its compared poses, as aligned, metres.
    pub estimate_length_m: f64,
    /// Path length of the truth through its compared poses, metres.
    pub truth_length_m: f64,
    /// What laid the estimate onto the truth.
    pub alignment: Similarity,
    /// The factor that the estimate's lengths must be multiplied by to fit the truth best (Sim(3)), whatever the alignment;
    /// `None` where the path does not tell it.
    pub scale: Option<f64>,
    /// Errors of the poses themselves.
    pub absolute: AbsoluteErrors,
    /// Errors over stretches, one entry for each delta for which the path is long enough.
    pub relative: Vec<RelativeErrors>,
    /// Errors over segments as shares of their length, one entry for each length for which the path is long enough.
    pub drift: Vec<SegmentDrift>,
    /// Error of the heading at the last pose when the first poses are laid onto each other, radians in (−π, π],
    /// counter-clockwise positive.
    pub final_heading_error_rad: f64,
    /// Error of the position at the last pose when the first poses are laid onto each other, metres.
    pub final_position_error_m: f64,
}

/// Compares an estimate with the truth.
///
/// Fails where no poses belong together in time, an option is out of its range, a trajectory's times do not increase or its
/// numbers are not finite, or the wanted scale is not determined.
pub fn evaluate(
    estimate: &Trajectory,
    truth: &Trajectory,
    options: &EvaluationOptions,
) -> Result<Evaluation> {
    for delta in &options.deltas {
        delta.check()?;
    }
    if let Some(bad) = options.segment_lengths_m.iter().find(|&&length| !(length.is_finite() && length > 0.0))
    {
        return Err(Error::usage(format!(
            "a segment length of {bad} m is not possible; it must be positive"
        )));
    }
    let mut pairs = associate(estimate, truth, options.max_time_difference_s)?;
    let scale = alignment::scale(&pairs);
    let alignment = alignment::fit(&pairs, options.alignment)?;
    for pair in &mut pairs {
        pair.estimate = alignment.apply(&pair.estimate);
    }
    let truth_length_m = *association::path_m(&pairs, |pair| &pair.truth).last().unwrap_or(&0.0);
    let estimate_length_m = *association::path_m(&pairs, |pair| &pair.estimate).last().unwrap_or(&0.0);
    // Halves: the whole of times at both ends of all numbers would be infinite. Only the ratio of spans counts.
    let span = |first: f64, last: f64| 0.5 * last - 0.5 * first;
    let truth_span_s = span(truth.poses[0].time_s, truth.poses[truth.poses.len() - 1].time_s);
    let paired_span_s = span(pairs[0].truth_time_s, pairs[pairs.len() - 1].truth_time_s);
    let lengths_m = match options.segment_lengths_m.as_slice() {
        [] => drift::usual_lengths_m(truth_length_m),
        given => given.to_vec(),
    };
    let relative =
        options.deltas.iter().filter_map(|&delta| relative::measure(&pairs, delta, options.all_pairs));
    let (first, last) = (&pairs[0], &pairs[pairs.len() - 1]);
    Ok(Evaluation {
        estimate_poses: estimate.poses.len(),
        truth_poses: truth.poses.len(),
        time_covered: (truth_span_s > 0.0).then(|| paired_span_s / truth_span_s),
        estimate_length_m,
        truth_length_m,
        scale,
        absolute: absolute::measure(&pairs),
        relative: relative.collect(),
        drift: drift::measure(&pairs, &lengths_m),
        final_heading_error_rad: drift::heading_error_rad(first, last),
        final_position_error_m: relative::error_between(first, last).translation.vector.norm(),
        alignment,
        pairs,
    })
}

#[cfg(test)]
mod tests;
