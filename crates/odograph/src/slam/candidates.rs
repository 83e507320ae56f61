//! Which older keyframes a new one may show again, from where we think it is.

use super::SlamConfig;
use crate::geometry::GroundPose;
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::mapping::KeyframeId;
use crate::mapping::graph::{PoseGraph, Reach, Reached};
use crate::mapping::plane_motion::position_sigma_m;
use crate::odometry::matching::Matcher;
use nalgebra::Vector4;

/// An older keyframe that may be in view.
#[derive(Debug, Clone)]
pub struct Candidate {
    pub id: KeyframeId,
    pub prior: Prior,
    /// The part of the new keyframe that it would show, 0 to 1.
    pub overlap: f64,
}

/// What is known about where an older keyframe is, before it is looked at.
#[derive(Debug, Clone)]
pub struct Prior {
    pub reached: Reached,
    /// Standard deviation in the image, pixels: of the position, and of the heading over half an image.
    pub sigma_px: f64,
    /// How the knowledge compares with what the camera sees at once.
    pub strength: Strength,
}

/// How well we know where a keyframe is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Strength {
    /// Within the reach of the fine tracker.
    Sure,
    /// Within a part of an image: the whole pictures must be compared, but another place can be told from this one.
    Doubtful,
    /// A way across a gap, or so long that one place may be taken for another: one sighting is not enough.
    Weak,
}

/// Up to so many pixels off (three standard deviations), the fine tracker needs no help.
const SURE_PX: f64 = 8.0;

/// Up to this part of what the camera sees (one standard deviation) a place is not taken for another.
const DOUBTFUL_VIEWS: f64 = 0.1;

/// Where the way is this uncertain, as a part of what the camera sees, so are those that come after it: they are ordered by the heading's uncertainty, too.
const HOPELESS_VIEWS: f64 = 3.0;

impl Prior {
    pub fn new(reached: Reached, matcher: &Matcher, pose: &GroundPose) -> Self {
        let sigma_m = position_sigma_m(&reached.covariance);
        let view_m = matcher.view_m(pose);
        let sigma_px =
            (sigma_m + 0.5 * view_m * reached.covariance[(HEADING, HEADING)].sqrt()) / matcher.pixel_m(pose);
        let strength = if reached.across_gap || sigma_m > DOUBTFUL_VIEWS * view_m {
            Strength::Weak
        } else if 3.0 * sigma_px > SURE_PX {
            Strength::Doubtful
        } else {
            Strength::Sure
        };
        Self { reached, sigma_px, strength }
    }
}

/// The older keyframes that a new one probably shows and whose place is known well enough to look there, those that it shows most of first. `known` gives
/// height, roll and pitch of a keyframe, `reach` begins at the new one.
pub fn candidates(
    graph: &PoseGraph,
    reach: &mut Reach<'_>,
    new: KeyframeId,
    known: &dyn Fn(KeyframeId) -> Option<GroundPose>,
    matcher: &Matcher,
    config: &SlamConfig,
) -> Vec<Candidate> {
    let (Some(here), Some(pose)) = (graph.pose(new), known(new)) else { return Vec::new() };
    let view_m = matcher.view_m(&pose);
    let reach_m = 1.5 * view_m + 2.0 * DOUBTFUL_VIEWS * view_m;
    let near = |other: &GroundPose| (other.x_m - here.x_m).hypot(other.y_m - here.y_m) < reach_m;
    // Without anything near there is nothing to ask the graph for.
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
        let prior = Prior::new(reached, matcher, &pose);
        if prior.strength == Strength::Weak {
            continue;
        }
        let shown = shortened(&prior.reached.motion, 2.0 * sigma_m);
        let overlap = matcher.overlap(&pose, &other, &shown);
        if overlap >= config.least_overlap {
            found.push(Candidate { id, prior, overlap });
        }
    }
    // Of those that show about as much, the surest: sorting keeps their order.
    found.sort_by(|a, b| rank(b).total_cmp(&rank(a)));
    found
}

/// In steps of a tenth, so that a little more of a view does not outweigh being sure of it.
fn rank(candidate: &Candidate) -> f64 {
    (10.0 * candidate.overlap).round()
}

/// The motion as near as it may be where it is off by `by_m`.
fn shortened(motion: &Vector4<f64>, by_m: f64) -> Vector4<f64> {
    let length_m = motion[X].hypot(motion[Y]);
    let left = if length_m > by_m { 1.0 - by_m / length_m } else { 0.0 };
    motion.component_mul(&Vector4::new(left, left, 1.0, 1.0))
}
