//! Loop closure candidates by appearance, where the predicted position is uncertain.

use super::candidates::{Prior, Strength};
use super::gate::{CONTRADICTION_GATE, GATE};
use crate::geometry::wrap_angle;
use crate::keyframe::relative_pose::{compose, inverse};
use crate::keyframe::{KeyframeId, MapEdge};
use crate::loop_closure::matching::{CameraPose, Matcher};
use crate::place_recognition::{PlaceHypothesis, PlaceIndex, Signature};
use crate::pose_graph::{PoseGraph, Reach};
use nalgebra::{Matrix4, Vector4};

/// A recognised place.
#[derive(Debug, Clone)]
pub struct Recognised {
    pub id: KeyframeId,
    /// Pose of the older keyframe in the new one's frame.
    pub motion: Vector4<f64>,
    /// Standard deviation of the logarithm of the scale in `motion`; infinite where appearance does
    /// not show the scale.
    pub ln_scale_deviation: f64,
    /// Its predicted pose; `None` if nothing connects the two.
    pub prior: Option<Prior>,
}

impl Recognised {
    /// Whether a single match is enough to accept it.
    pub fn stands_alone(&self) -> bool {
        self.prior.as_ref().is_some_and(|prior| prior.strength != Strength::Weak)
    }

    /// Whether a registered match is not where the graph predicts it.
    pub fn contradicts(&self, edge: &MapEdge) -> bool {
        self.innovation(&edge.motion, &edge.covariance) > GATE
    }

    /// Normalised innovation squared of a measured pose of the older keyframe. Zero without a
    /// prediction, and across a gap: the camera may have been moved anywhere meanwhile.
    pub fn innovation(&self, motion: &Vector4<f64>, covariance: &Matrix4<f64>) -> f64 {
        let prior = self.prior.as_ref().filter(|prior| !prior.reached.across_gap);
        prior.map_or(0.0, |prior| prior.innovation(motion, covariance))
    }
}

/// Factor of a gate for a pose by appearance alone, which is less exact than a registered one.
/// Lower misses true loops, higher verifies more false ones.
const UNREGISTERED: f64 = 4.0;

/// Height ratios of a [`PlaceHypothesis`], whose scale is already that of its metres.
pub const SAME_METRES: [f64; 2] = [1.0; 2];

/// Number of places looked up: more find a place behind similar ones, and each takes a
/// verification.
const MAX_PLACES: usize = 4;

/// A second place with at least this share of the best score makes the result ambiguous. Lower
/// rejects more true loops, higher accepts more false ones.
const RIVAL_SCORE: f64 = 0.6;

/// The places that a new keyframe may show, best first: similar in appearance, not just behind it,
/// and consistent with the graph. None if different places look alike and the graph does not
/// decide. Keyframes of which `compared` is false are left out. `reach` starts at the new keyframe.
pub fn recognise(
    places: &PlaceIndex,
    signature: &Signature,
    graph: &PoseGraph,
    reach: &mut Reach<'_>,
    new: (KeyframeId, &CameraPose),
    least_edges: usize,
    matcher: &Matcher,
    compared: &dyn Fn(KeyframeId) -> bool,
) -> Vec<Recognised> {
    let hypotheses = places.query_among(signature, MAX_PLACES + least_edges, compared);
    let view_m = matcher.view_m(new.1);
    let mut found: Vec<(Recognised, &PlaceHypothesis)> = Vec::new();
    for hypothesis in &hypotheses {
        let there = reach.to(hypothesis.keyframe);
        if hypothesis.keyframe == new.0 || there.as_ref().is_some_and(|one| one.edges < least_edges) {
            continue;
        }
        let motion = inverse(&hypothesis.motion, SAME_METRES);
        let prior = there.map(|one| Prior::new(one, matcher, new.1));
        let ln_scale_deviation = hypothesis.ln_scale_deviation;
        let mut recognised = Recognised { id: hypothesis.keyframe, motion, ln_scale_deviation, prior };
        let innovation = recognised.innovation(&motion, &Matrix4::zeros());
        if let Some(prior) = recognised.prior.as_mut().filter(|_| innovation > UNREGISTERED * GATE) {
            prior.strength = Strength::Weak;
        }
        if innovation < UNREGISTERED * CONTRADICTION_GATE {
            found.push((recognised, hypothesis));
        }
    }
    // All hypotheses must agree with the best on the new keyframe's pose, or score far less.
    let place = |(recognised, hypothesis): &(Recognised, &PlaceHypothesis)| {
        graph.pose(recognised.id).map(|pose| compose(&pose, &hypothesis.motion, 1.0))
    };
    let Some(best) = found.first() else { return Vec::new() };
    let (Some(here), score) = (place(best), best.1.score) else { return Vec::new() };
    let rival = found.iter().skip(1).filter(|other| !other.0.stands_alone()).any(|other| {
        other.1.score >= RIVAL_SCORE * score
            && place(other).is_some_and(|there| {
                here.distance_m(&there) > 0.25 * view_m
                    || wrap_angle(here.heading_rad - there.heading_rad).abs() > 0.3
            })
    });
    let keep = |one: &(Recognised, &PlaceHypothesis)| one.0.stands_alone() || (!rival && one.1.is_sure());
    found.into_iter().filter(keep).map(|(recognised, _)| recognised).take(MAX_PLACES).collect()
}
