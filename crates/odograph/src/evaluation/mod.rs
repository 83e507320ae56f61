//! Trajectory evaluation: absolute trajectory error, relative pose error, drift.
//!
//! The steps: poses are associated by time ([`associate`]), the estimate is aligned with the ground
//! truth ([`Alignment`]), and the pairs are compared: each pose by itself ([`AbsoluteErrors`],
//! "ATE"), over short path segments ([`RelativeErrors`], "RPE"), and over segments of given length
//! as a fraction of that length ([`SegmentDrift`]).
//!
//! The definitions follow J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems",
//! 2012, and Z. Zhang and D. Scaramuzza, "A tutorial on quantitative trajectory evaluation for
//! visual(-inertial) odometry", 2018; details follow the program evo, so that results are
//! comparable.

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

/// Configuration of an evaluation.
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluationOptions {
    /// Largest time difference of associated poses, seconds.
    pub max_time_difference_s: f64,
    /// Alignment of the estimate with the ground truth.
    pub alignment: Alignment,
    /// Segment lengths of the relative pose errors.
    pub deltas: Vec<Delta>,
    /// Whether relative pose errors start at every pose (overlapping segments) instead of at the
    /// end of the previous segment.
    pub all_pairs: bool,
    /// Segment lengths of the drift, metres. If empty: every power of ten from 1 m up to the path
    /// length, or 0.1 m for a path shorter than 1 m.
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

/// Result of an evaluation.
#[derive(Debug, Clone, PartialEq)]
pub struct Evaluation {
    /// The compared poses, after alignment.
    pub pairs: Vec<PosePair>,
    /// Number of poses in the estimate.
    pub estimate_poses: usize,
    /// Number of poses in the ground truth.
    pub truth_poses: usize,
    /// Time from the first to the last compared pose as a fraction of the ground truth's duration,
    /// 0 to 1; `None` for a ground truth of a single pose.
    pub time_covered: Option<f64>,
    /// Path length of the estimate through its compared poses, metres, whatever the alignment: the
    /// scale of one has no part in it.
    pub estimate_length_m: f64,
    /// Path length of the ground truth through its compared poses, metres.
    pub truth_length_m: f64,
    /// Transformation that aligned the estimate.
    pub alignment: Similarity,
    /// Least-squares (Sim(3)) scale factor for the estimate's lengths, whatever the alignment;
    /// `None` if the positions do not determine it.
    pub scale: Option<f64>,
    /// Absolute trajectory errors.
    pub absolute: AbsoluteErrors,
    /// Relative pose errors, one entry for each delta that has at least one segment.
    pub relative: Vec<RelativeErrors>,
    /// Drift, one entry for each length that has at least one segment.
    pub drift: Vec<SegmentDrift>,
    /// Heading error at the last pose with the first poses aligned, radians in (−π, π],
    /// counter-clockwise positive.
    pub final_heading_error_rad: f64,
    /// Position error at the last pose with the first poses aligned, metres.
    pub final_position_error_m: f64,
}

/// Compares an estimated trajectory with the ground truth.
///
/// Fails if no poses can be associated, an option is out of range, a trajectory's times do not
/// strictly increase or its numbers are not finite, or the requested scale is not determined.
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
    let truth_length_m = *association::path_m(&pairs, |pair| &pair.truth).last().unwrap_or(&0.0);
    let estimate_length_m = *association::path_m(&pairs, |pair| &pair.estimate).last().unwrap_or(&0.0);
    for pair in &mut pairs {
        pair.estimate = alignment.apply(&pair.estimate);
    }
    // Halving before subtracting avoids overflow for extreme times; only the ratio of the spans
    // matters.
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
