//! Loop closure candidates from the predicted position.

use super::LoopClosureConfig;
use super::gate::normalised_innovation_squared;
use crate::geometry::GroundPose;
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::keyframe::KeyframeId;
use crate::keyframe::relative_pose::position_sigma_m;
use crate::loop_closure::matching::{CameraPose, Matcher};
use crate::pose_graph::{PoseGraph, Reach, Reached};
use nalgebra::{Matrix4, Vector4};

/// An older keyframe that may overlap the new one.
#[derive(Debug, Clone)]
pub struct LoopCandidate {
    pub id: KeyframeId,
    pub prior: Prior,
    /// Expected overlap: the share of the new keyframe's view, 0 to 1.
    pub overlap: f64,
}

/// The predicted pose of an older keyframe.
#[derive(Debug, Clone)]
pub struct Prior {
    pub reached: Reached,
    /// Standard deviation in the image, pixels: of the position, and of the heading over half an
    /// image.
    pub sigma_px: f64,
    /// How certain the prediction is, compared with the view.
    pub strength: Strength,
}

/// How certain a predicted pose is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Strength {
    /// Within the convergence range of the tracker.
    Sure,
    /// Within a part of the view: the whole images must be registered, but the place is
    /// unambiguous.
    Uncertain,
    /// Across a gap, or so uncertain that places may be confused: one match is not enough.
    Weak,
}

/// Convergence range of the tracker, pixels: within it three standard deviations of the predicted
/// position need no global registration.
const SURE_PX: f64 = 8.0;

/// Maximum standard deviation of a position at which one match suffices, as a share of the view.
/// Larger accepts more loops from one match, and more false ones on repetitive ground.
const MAX_UNCERTAIN_VIEWS: f64 = 0.1;

/// Search limit: standard deviation as a share of the view. Larger compares more keyframes that are
/// not in view. Candidates after the first one above the limit are at least about as uncertain,
/// since the search also orders by heading.
const HOPELESS_VIEWS: f64 = 3.0;

impl Prior {
    pub fn new(reached: Reached, matcher: &Matcher, here: &CameraPose) -> Self {
        let sigma_m = position_sigma_m(&reached.covariance);
        let view_m = matcher.view_m(here);
        let sigma_px =
            (sigma_m + 0.5 * view_m * reached.covariance[(HEADING, HEADING)].sqrt()) / matcher.pixel_m(here);
        let strength = if reached.across_gap || sigma_m > MAX_UNCERTAIN_VIEWS * view_m {
            Strength::Weak
        } else if 3.0 * sigma_px > SURE_PX {
            Strength::Uncertain
        } else {
            Strength::Sure
        };
        Self { reached, sigma_px, strength }
    }

    /// Normalised innovation squared of a measured pose.
    pub fn innovation(&self, motion: &Vector4<f64>, covariance: &Matrix4<f64>) -> f64 {
        let Reached { motion: expected, covariance: prior, .. } = &self.reached;
        normalised_innovation_squared(motion, &(prior + covariance), expected)
    }
}

/// The older keyframes that probably overlap a new one and whose position is certain enough, with
/// the largest overlap first. `known` gives camera, height, roll and pitch of a keyframe; `reach`
/// starts at the new one.
pub fn candidates(
    graph: &PoseGraph,
    reach: &mut Reach<'_>,
    new: KeyframeId,
    known: &dyn Fn(KeyframeId) -> Option<CameraPose>,
    matcher: &Matcher,
    config: &LoopClosureConfig,
) -> Vec<LoopCandidate> {
    let (Some(here), Some(at)) = (graph.pose(new), known(new)) else { return Vec::new() };
    let view_m = matcher.view_m(&at);
    let reach_m = 1.5 * view_m + 2.0 * MAX_UNCERTAIN_VIEWS * view_m;
    let near = |other: &GroundPose| other.distance_m(&here) < reach_m;
    // With no keyframes nearby the graph is not searched.
    let mut left = graph.poses().filter(|(id, other)| *id != new && near(other)).count();
    let mut found = Vec::new();
    while left > 0 {
        let Some(id) = reach.further() else { break };
        if id == new || !graph.pose(id).is_some_and(|there| near(&there)) {
            continue;
        }
        left -= 1;
        let Some(reached) = reach.to(id) else { continue };
        let sigma_m = position_sigma_m(&reached.covariance);
        if sigma_m > HOPELESS_VIEWS * view_m {
            break;
        }
        if reached.edges < config.least_edges {
            continue;
        }
        let Some(other) = known(id) else { continue };
        let prior = Prior::new(reached, matcher, &at);
        if prior.strength == Strength::Weak {
            continue;
        }
        let shown = shortened(&prior.reached.motion, 2.0 * sigma_m);
        let overlap = matcher.overlap(&at, &other, &shown);
        if overlap >= config.least_overlap {
            found.push(LoopCandidate { id, prior, overlap });
        }
    }
    // Equal overlaps stay ordered by certainty (stable sort).
    found.sort_by(|a, b| rank(b).total_cmp(&rank(a)));
    found
}

/// Rounded to tenths, so that a slightly larger overlap does not outweigh certainty.
fn rank(candidate: &LoopCandidate) -> f64 {
    (10.0 * candidate.overlap).round()
}

/// The motion shortened by `by_m`, its possible error.
fn shortened(motion: &Vector4<f64>, by_m: f64) -> Vector4<f64> {
    let length_m = motion[X].hypot(motion[Y]);
    let left = if length_m > by_m { 1.0 - by_m / length_m } else { 0.0 };
    motion.component_mul(&Vector4::new(left, left, 1.0, 1.0))
}
