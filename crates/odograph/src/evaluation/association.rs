//! Association of estimated with true poses by timestamp.

use crate::error::{Error, Result};
use crate::trajectory::{StampedPose, Trajectory};
use nalgebra::{Isometry3, Vector3};

/// An estimated pose and the true pose it is compared with, both `world_from_camera`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PosePair {
    /// Timestamp of the estimated pose, seconds.
    pub time_s: f64,
    /// Timestamp of the true pose, seconds.
    pub truth_time_s: f64,
    /// Estimated pose, metres.
    pub estimate: Isometry3<f64>,
    /// True pose, metres.
    pub truth: Isometry3<f64>,
}

/// Associates each pose of the trajectory that has fewer poses with the pose of the other one that
/// is nearest in time (the earlier one of a tie), if their times differ by at most
/// `max_time_difference_s`: the rule of the program evo. A pose of the longer trajectory is used
/// twice only where the shorter one is denser.
///
/// Fails if no poses can be associated, a trajectory is empty, its times do not strictly increase
/// or its numbers are not finite.
pub fn associate(
    estimate: &Trajectory,
    truth: &Trajectory,
    max_time_difference_s: f64,
) -> Result<Vec<PosePair>> {
    if !(max_time_difference_s.is_finite() && max_time_difference_s >= 0.0) {
        return Err(Error::usage(format!(
            "the largest time difference is {max_time_difference_s} s; it must be 0 or a positive number of seconds"
        )));
    }
    let estimate_span = checked_span(estimate, "estimate")?;
    let truth_span = checked_span(truth, "truth")?;
    let truth_is_longer = truth.poses.len() > estimate.poses.len();
    let (short, long) = if truth_is_longer { (estimate, truth) } else { (truth, estimate) };
    let pair = |one: &StampedPose, other: &StampedPose| {
        let (estimate, truth) = if truth_is_longer { (one, other) } else { (other, one) };
        PosePair {
            time_s: estimate.time_s,
            truth_time_s: truth.time_s,
            estimate: estimate.world_from_camera,
            truth: truth.world_from_camera,
        }
    };
    let pairs: Vec<_> = short
        .poses
        .iter()
        .filter_map(|pose| {
            nearest(&long.poses, pose.time_s, max_time_difference_s).map(|other| pair(pose, other))
        })
        .collect();
    if pairs.is_empty() {
        let is_apart = estimate_span.0 > truth_span.1 || truth_span.0 > estimate_span.1;
        return Err(Error::input(format!(
            "no pose of the estimate ({:.3} s to {:.3} s) is within {max_time_difference_s} s of one of the truth ({:.3} s to \
             {:.3} s); {}",
            estimate_span.0,
            estimate_span.1,
            truth_span.0,
            truth_span.1,
            if is_apart {
                "they are of other drives, or of clocks that count from another moment"
            } else {
                "check that both use the same clock, or allow a larger time difference"
            }
        )));
    }
    Ok(pairs)
}

/// Largest accepted coordinate, metres: beyond any distance on Earth, and small enough that sums of
/// squares do not overflow.
const FARTHEST_M: f64 = 1e12;

fn nearest(poses: &[StampedPose], time_s: f64, max_time_difference_s: f64) -> Option<&StampedPose> {
    let after = poses.partition_point(|pose| pose.time_s <= time_s);
    let until_later = poses.get(after).map_or(f64::INFINITY, |pose| pose.time_s - time_s);
    let since_earlier = after.checked_sub(1).map_or(f64::INFINITY, |before| time_s - poses[before].time_s);
    if until_later <= max_time_difference_s && until_later < since_earlier {
        poses.get(after)
    } else if since_earlier <= max_time_difference_s {
        poses.get(after.checked_sub(1)?)
    } else {
        None
    }
}

/// First and last time of a trajectory. Fails unless it has poses, strictly increasing times and
/// finite numbers.
fn checked_span(trajectory: &Trajectory, name: &str) -> Result<(f64, f64)> {
    let (Some(first), Some(last)) = (trajectory.poses.first(), trajectory.poses.last()) else {
        return Err(Error::input(format!("the {name} has no pose")));
    };
    let finite = |pose: &StampedPose| {
        let place = &pose.world_from_camera;
        let numbers = place.translation.vector.iter().chain(place.rotation.coords.iter());
        pose.time_s.is_finite() && numbers.into_iter().all(|number| number.is_finite())
    };
    if let Some(index) = trajectory.poses.iter().position(|pose| !finite(pose)) {
        return Err(Error::input(format!("pose {index} of the {name} has a number that is not finite")));
    }
    let far = |pose: &StampedPose| pose.world_from_camera.translation.vector.amax() > FARTHEST_M;
    if let Some(index) = trajectory.poses.iter().position(far) {
        return Err(Error::input(format!(
            "pose {index} of the {name} is more than {FARTHEST_M:e} m from the origin, too far for its error to be computed"
        )));
    }
    if let Some(pair) = trajectory.poses.windows(2).find(|pair| pair[0].time_s >= pair[1].time_s) {
        return Err(Error::input(format!(
            "the times of the {name} do not increase: {} s follows {} s",
            pair[1].time_s, pair[0].time_s
        )));
    }
    Ok((first.time_s, last.time_s))
}

/// Cumulative path length at each pose of one side of the pairs, metres; 0 for the first.
pub(super) fn path_m(pairs: &[PosePair], side: impl Fn(&PosePair) -> &Isometry3<f64>) -> Vec<f64> {
    let mut length_m = 0.0;
    let mut before: Option<Vector3<f64>> = None;
    let lengths = pairs.iter().map(|pair| {
        let at = side(pair).translation.vector;
        length_m += before.map_or(0.0, |before| (at - before).norm());
        before = Some(at);
        length_m
    });
    lengths.collect()
}
