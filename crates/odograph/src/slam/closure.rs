//! Whether an older keyframe is in view: looked at, and judged against what is known.
//!
//! A false loop bends the whole map, a missed one costs nothing that the next does not bring. So a sighting must be clear by itself (most of the
//! corners in view, found forward and backward), must lie where the way through the graph allows it, and must be the only one that does.

use super::SlamConfig;
use super::candidates::{Candidate, Prior, Strength};
use super::recognition::Recognised;
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::geometry::{Sim2, WithCovariance, wrap_angle};
use crate::mapping::plane_motion::position_sigma_m;
use crate::mapping::{EdgeKind, KeyframeId, MapEdge};
use crate::odometry::matching::{Matcher, Pictured, Sighting, Sought};
use nalgebra::{Matrix3, Matrix4, Vector3, Vector4};

/// A place seen again.
#[derive(Debug, Clone, PartialEq)]
pub struct LoopClosure {
    /// How the older keyframe lies to the newer.
    pub edge: MapEdge,
    /// Corners of the newer one that were found in the older.
    pub inliers: usize,
    /// How large a part they are of those that should be in view, 0 to 1.
    pub presence: f64,
    /// How far off the older one was from where it was thought to be before this loop, metres.
    pub correction_m: f64,
}

/// Fewer corners than this show nothing.
const LEAST_INLIERS: usize = 40;

/// Of a thousand true loops one misses its expected place by more (chi-square, three degrees of freedom).
pub const GATE: f64 = 16.3;

/// Another place this much further out may still be the true one, where a pattern repeats.
const RIVAL_GATE: f64 = 9.0 * GATE;

/// What lens and tilt leave over: metres and radians, a third of a pixel at usual heights. No other place is so near.
const UNMODELLED: f64 = 5e-4;

/// A guess from the whole pictures is off by no more than this, pixels.
const GUESS_OFF_PX: f64 = 8.0;

/// A guess whose score is a smaller part of the best one's is no rival.
const RIVAL_SCORE: f64 = 0.6;

/// Looks for a candidate. `None` where it is not in view, not where it may be, or not the only one that may be.
pub fn look(
    matcher: &Matcher,
    sought: &mut Sought,
    pictured: &mut Pictured,
    candidate: &Candidate,
    new: KeyframeId,
    config: &SlamConfig,
) -> Option<LoopClosure> {
    let prior = &candidate.prior;
    let expected = &prior.reached.motion;
    let sighting = if prior.strength == Strength::Sure {
        let off_px = 1.0 + 3.0 * prior.sigma_px;
        matcher.find(sought, pictured, expected, off_px).filter(|found| is_clear(found, config))?
    } else {
        only_one(matcher, sought, pictured, prior, config)?
    };
    if misses(&sighting, prior) > GATE {
        return None;
    }
    Some(closure(new, candidate.id, &sighting, sighting.motion - expected))
}

fn is_clear(found: &Sighting, config: &SlamConfig) -> bool {
    found.inliers >= LEAST_INLIERS && found.presence >= config.least_presence
}

/// How far a sighting is from where it may be: its normalised square.
fn misses(sighting: &Sighting, prior: &Prior) -> f64 {
    squared(&sighting.motion, &(prior.reached.covariance + sighting.covariance), &prior.reached.motion)
}

pub fn squared(motion: &Vector4<f64>, covariance: &Matrix4<f64>, expected: &Vector4<f64>) -> f64 {
    let off = motion - expected;
    let off = Vector3::new(off[X], off[Y], wrap_angle(off[HEADING]));
    let covariance = covariance.fixed_view::<3, 3>(0, 0) + Matrix3::identity() * UNMODELLED.powi(2);
    covariance.try_inverse().map_or(f64::INFINITY, |information| off.dot(&(information * off)))
}

/// The one sighting that a comparison of the whole pictures leads to; `None` where there is none, or another one as well.
fn only_one(
    matcher: &Matcher,
    sought: &mut Sought,
    pictured: &mut Pictured,
    prior: &Prior,
    config: &SlamConfig,
) -> Option<Sighting> {
    let reached = &prior.reached;
    let heading_off_rad = 0.1 + 3.0 * reached.covariance[(HEADING, HEADING)].sqrt();
    let guesses = matcher.guess(sought, pictured, &reached.motion, heading_off_rad);
    let best_score = guesses.first()?.score;
    let mut found: Option<Sighting> = None;
    for guess in guesses.iter().filter(|guess| guess.score >= RIVAL_SCORE * best_score) {
        if squared(&guess.motion, &reached.covariance, &reached.motion) > RIVAL_GATE {
            continue;
        }
        let Some(sighting) = matcher.find(sought, pictured, &guess.motion, GUESS_OFF_PX) else { continue };
        if sighting.inliers < LEAST_INLIERS || sighting.presence < 0.7 * config.least_presence {
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

/// Whether two sightings are of different places: two centimetres at a height of a metre are more than any noise.
fn elsewhere(a: &Sighting, b: &Sighting) -> bool {
    let off = a.motion - b.motion;
    off[X].hypot(off[Y]) > 0.01 || wrap_angle(off[HEADING]).abs() > 0.02
}

/// Looks for a place that was recognised by what it looks like. `None` where the corners are not there, or it is not where it may be.
pub fn look_recognised(
    matcher: &Matcher,
    sought: &Sought,
    pictured: &Pictured,
    recognised: &Recognised,
    new: KeyframeId,
    config: &SlamConfig,
) -> Option<LoopClosure> {
    let found = matcher.find(sought, pictured, &recognised.motion, GUESS_OFF_PX)?;
    if !is_clear(&found, config) {
        return None;
    }
    let prior = recognised.prior.as_ref();
    // What was extrapolated over a gap does not bind.
    if prior.is_some_and(|prior| !prior.reached.across_gap && misses(&found, prior) > GATE) {
        return None;
    }
    let off = prior.map_or(Vector4::zeros(), |prior| found.motion - prior.reached.motion);
    Some(closure(new, recognised.id, &found, off))
}

fn closure(new: KeyframeId, old: KeyframeId, found: &Sighting, off: Vector4<f64>) -> LoopClosure {
    let (motion, covariance) = (found.motion, found.covariance);
    LoopClosure {
        edge: MapEdge { from: new, to: old, kind: EdgeKind::Loop, motion, covariance },
        inliers: found.inliers,
        presence: found.presence,
        correction_m: off[X].hypot(off[Y]),
    }
}

/// Whether an edge is where a way that is sure enough to tell one place from another has it.
pub fn agrees(edge: &MapEdge, way: &WithCovariance<Sim2, 4>, view_m: f64) -> bool {
    position_sigma_m(&way.covariance) < AGREE_VIEWS * view_m
        && squared(&edge.motion, &(way.covariance + edge.covariance), &way.transform.to_vector()) < GATE
}

/// A way less sure than this part of a view cannot tell one place from another.
const AGREE_VIEWS: f64 = 0.1;
