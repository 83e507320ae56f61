//! Drift: the relative error over path segments as a fraction of their length.

use super::association::{PosePair, path_m};
use super::relative::error_between;
use crate::geometry::wrap_angle;
use serde::Serialize;

/// Mean drift over all segments of one length. A segment starts at every pose and ends at the first
/// pose whose true path length is larger by at least that length. Its drift is the relative error
/// divided by the true segment length, as in A. Geiger et al., "Are we ready for autonomous
/// driving? The KITTI vision benchmark suite", 2012, where segments start at every tenth frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SegmentDrift {
    /// Requested segment length along the true path, metres.
    pub length_m: f64,
    /// Number of segments.
    pub segments: usize,
    /// Mean translation error divided by length, per cent.
    pub translation_percent: f64,
    /// Mean angle of the rotation error divided by length, degrees per metre.
    pub rotation_deg_per_m: f64,
    /// Mean absolute heading error divided by length, degrees per metre.
    pub heading_deg_per_m: f64,
    /// Mean signed heading error divided by length, counter-clockwise positive, degrees per metre:
    /// the heading bias, which does not average out.
    pub heading_bias_deg_per_m: f64,
}

/// Drift for each of the lengths that has at least one segment.
pub(super) fn measure(pairs: &[PosePair], lengths_m: &[f64]) -> Vec<SegmentDrift> {
    let path_m = path_m(pairs, |pair| &pair.truth);
    lengths_m.iter().filter_map(|&length_m| over(pairs, &path_m, length_m)).collect()
}

fn over(pairs: &[PosePair], path_m: &[f64], length_m: f64) -> Option<SegmentDrift> {
    let mut drift = SegmentDrift {
        length_m,
        segments: 0,
        translation_percent: 0.0,
        rotation_deg_per_m: 0.0,
        heading_deg_per_m: 0.0,
        heading_bias_deg_per_m: 0.0,
    };
    for (index, start) in pairs.iter().enumerate() {
        let reached = path_m.partition_point(|&at| at - path_m[index] < length_m);
        let Some(end) = pairs.get(reached) else { break };
        let segment_m = path_m[reached] - path_m[index];
        let error = error_between(start, end);
        let heading_deg_per_m = heading_error_rad(start, end).to_degrees() / segment_m;
        drift.segments += 1;
        drift.translation_percent += 100.0 * error.translation.vector.norm() / segment_m;
        drift.rotation_deg_per_m += error.rotation.angle().to_degrees() / segment_m;
        drift.heading_deg_per_m += heading_deg_per_m.abs();
        drift.heading_bias_deg_per_m += heading_deg_per_m;
    }
    let count = drift.segments as f64;
    (drift.segments > 0).then(|| SegmentDrift {
        translation_percent: drift.translation_percent / count,
        rotation_deg_per_m: drift.rotation_deg_per_m / count,
        heading_deg_per_m: drift.heading_deg_per_m / count,
        heading_bias_deg_per_m: drift.heading_bias_deg_per_m / count,
        ..drift
    })
}

/// Heading component of a segment's rotation error, radians in (−π, π], counter-clockwise positive:
/// the twist about the world's z axis of the relative rotation error, expressed in the true world
/// frame. It does not depend on the estimate's world frame and, unlike a difference of Euler
/// angles, is defined for every viewing direction. For a camera of constant tilt it equals the
/// error of the heading change.
pub(super) fn heading_error_rad(start: &PosePair, end: &PosePair) -> f64 {
    let error = error_between(start, end).rotation;
    let in_world = end.truth.rotation * error * end.truth.rotation.inverse();
    wrap_angle(2.0 * in_world.coords.z.atan2(in_world.coords.w))
}

/// Every power of ten from 1 m up to the path length, or 0.1 m for a path shorter than 1 m.
pub(super) fn usual_lengths_m(path_m: f64) -> Vec<f64> {
    let from = if path_m < 1.0 { -1 } else { 0 };
    (from..=6).map(|power| 10f64.powi(power)).filter(|&length_m| length_m <= path_m).collect()
}
