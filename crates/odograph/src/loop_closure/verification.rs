//! Verification of loop closure candidates.
//!
//! A false loop closure distorts the whole map; a missed one costs little. So a match must have a
//! high inlier ratio (forward–backward checked), must be consistent with the graph, and must be the
//! only one that is. A place that is certain by its appearance may have a low inlier ratio, if the
//! registered images differ by noise only: on tiles few corners are found again.

use super::LoopClosureConfig;
use super::candidates::{LoopCandidate, Prior, Strength};
use super::gate::{CONTRADICTION_GATE, GATE, normalised_innovation_squared};
use super::likeness::Likeness;
use super::recognition::Recognised;
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::geometry::{Sim2, WithCovariance, wrap_angle};
use crate::keyframe::relative_pose::position_sigma_m;
use crate::keyframe::{EdgeKind, KeyframeId, MapEdge};
use crate::loop_closure::matching::{LoopSighting, Matcher, QueryKeyframe, ReferenceKeyframe};
use nalgebra::{Matrix4, Vector4};

/// A loop closure.
#[derive(Debug, Clone, PartialEq)]
pub struct LoopClosure {
    /// The edge from the newer to the older keyframe.
    pub edge: MapEdge,
    /// Corners of the newer keyframe matched in the older one.
    pub inliers: usize,
    /// Inlier ratio: the matched share of the corners in the overlap, 0 to 1.
    pub inlier_ratio: f64,
    /// Distance between the measured and the predicted position before this loop closure, metres.
    pub correction_m: f64,
}

/// Minimum number of matched corners: 10 % of the 400 of a keyframe. Fewer close loops over less
/// overlap, and let patterns that repeat pass.
pub const MIN_INLIERS: usize = 40;

/// Maximum error of a registration of whole images, pixels: the search range of the tracker that
/// verifies it.
pub const GUESS_OFF_PX: f64 = 8.0;

/// Registrations with a smaller share of the best score are not verified. Lower finds more rivals
/// on repetitive ground and takes longer.
const RIVAL_SCORE: f64 = 0.6;

/// Verifies a candidate. `None` if it is not in view, not consistent with its prior, or ambiguous.
pub fn verify(
    matcher: &Matcher,
    query: &QueryKeyframe,
    reference: &mut ReferenceKeyframe,
    candidate: &LoopCandidate,
    new: KeyframeId,
    config: &LoopClosureConfig,
) -> Option<LoopClosure> {
    let prior = &candidate.prior;
    let expected = &prior.reached.motion;
    let sighting = if prior.strength == Strength::Sure {
        let off_px = 1.0 + 3.0 * prior.sigma_px;
        matcher.find(query, reference, expected, off_px).filter(|found| is_clear(found, config))?
    } else {
        only_one(matcher, query, reference, prior, config)?
    };
    if prior.innovation(&sighting.motion, &sighting.covariance) > GATE {
        return None;
    }
    Some(closure(new, candidate.id, &sighting, sighting.motion - expected))
}

fn is_clear(found: &LoopSighting, config: &LoopClosureConfig) -> bool {
    found.inliers >= MIN_INLIERS && found.inlier_ratio >= config.least_inlier_ratio
}

/// The unique match that registering the whole images leads to; `None` if there is none or it is
/// ambiguous.
fn only_one(
    matcher: &Matcher,
    query: &QueryKeyframe,
    reference: &mut ReferenceKeyframe,
    prior: &Prior,
    config: &LoopClosureConfig,
) -> Option<LoopSighting> {
    let reached = &prior.reached;
    let heading_off_rad = 0.1 + 3.0 * reached.covariance[(HEADING, HEADING)].sqrt();
    let guesses = matcher.guess(query, reference, &reached.motion, heading_off_rad);
    let best_score = guesses.first()?.score;
    let mut found: Option<LoopSighting> = None;
    for guess in guesses.iter().filter(|guess| guess.score >= RIVAL_SCORE * best_score) {
        if prior.innovation(&guess.motion, &Matrix4::zeros()) > CONTRADICTION_GATE {
            continue;
        }
        let Some(sighting) = matcher.find(query, reference, &guess.motion, GUESS_OFF_PX) else { continue };
        if sighting.inliers < MIN_INLIERS || sighting.inlier_ratio < 0.7 * config.least_inlier_ratio {
            continue;
        }
        match &found {
            Some(other) if elsewhere(other, &sighting) => return None, // the ground repeats
            Some(_) => {}
            None => found = Some(sighting),
        }
    }
    found.filter(|found| is_clear(found, config))
}

/// Whether two matches are of different places: more than a centimetre, or 0.02 rad, apart.
fn elsewhere(a: &LoopSighting, b: &LoopSighting) -> bool {
    let off = a.motion - b.motion;
    off[X].hypot(off[Y]) > 0.01 || wrap_angle(off[HEADING]).abs() > 0.02
}

/// Verifies a place recognised by its appearance. `None` if its corners are not matched, or it is
/// far from its prior.
pub fn verify_recognised(
    matcher: &Matcher,
    query: &QueryKeyframe,
    reference: &ReferenceKeyframe,
    recognised: &Recognised,
    new: KeyframeId,
    config: &LoopClosureConfig,
) -> Option<LoopClosure> {
    let found = matcher.find(query, reference, &recognised.motion, GUESS_OFF_PX)?;
    // What stands alone was not tested for rivals.
    let looks_equal = || {
        let is_candidate = found.inliers >= MIN_INLIERS && !recognised.stands_alone();
        is_candidate
            && Likeness::of(&matcher.overlap_grid(query, reference, &found.pose))
                .is_some_and(|likeness| likeness.is_of_one_place())
    };
    if !is_clear(&found, config) && !looks_equal() {
        return None;
    }
    if recognised.innovation(&found.motion, &found.covariance) > CONTRADICTION_GATE {
        return None;
    }
    let off = recognised.prior.as_ref().map_or(Vector4::zeros(), |prior| found.motion - prior.reached.motion);
    Some(closure(new, recognised.id, &found, off))
}

/// `off` is the measured minus the predicted motion.
pub fn closure(new: KeyframeId, old: KeyframeId, found: &LoopSighting, off: Vector4<f64>) -> LoopClosure {
    let (motion, covariance) = (found.motion, found.covariance);
    LoopClosure {
        edge: MapEdge { from: new, to: old, kind: EdgeKind::Loop, motion, covariance },
        inliers: found.inliers,
        inlier_ratio: found.inlier_ratio,
        correction_m: off[X].hypot(off[Y]),
    }
}

/// Whether an edge is consistent with a path between its keyframes that is certain enough to tell
/// places apart.
pub fn agrees(edge: &MapEdge, path: &WithCovariance<Sim2, 4>, view_m: f64) -> bool {
    position_sigma_m(&path.covariance) < AGREE_VIEWS * view_m
        && normalised_innovation_squared(
            &edge.motion,
            &(path.covariance + edge.covariance),
            &path.transform.to_vector(),
        ) < GATE
}

/// Maximum standard deviation of such a path, as a share of the view: beyond it neighbouring places
/// are consistent too.
const AGREE_VIEWS: f64 = 0.1;
