//! The place of a single picture on ground that repeats itself.
//!
//! A printed or paved floor looks alike in many places, and descriptors of corners do not tell
//! them apart. What is left when the registered images are divided by each other does: at the place
//! it is noise, at a lookalike also what is peculiar to both places ([`Likeness`]). The lookalikes
//! are the sample of how a place that is not in the map would differ, so that each of them bounds
//! the probability of a false alarm.

use super::likeness::Likeness;
use super::matching::{LoopSighting, Matcher, QueryKeyframe, ReferenceKeyframe};
use super::recognition::SAME_METRES;
use super::verification::{GUESS_OFF_PX, MIN_INLIERS};
use crate::geometry::{GroundPose, wrap_angle};
use crate::keyframe::KeyframeId;
use crate::keyframe::relative_pose::{compose, inverse};
use crate::place_recognition::PlaceHypothesis;

/// Number of lookalikes that are registered, each some milliseconds.
pub const MAX_LOOKALIKES: usize = 48;

/// Maximum sum, over all lookalikes, of the probabilities that chance makes the picture differ less
/// from the chosen place.
const MAX_FALSE_ALARM: f64 = 1e-3;

/// Distance and angle beyond which two places differ: twelve spots of a view of 240, and as where
/// motions of one keyframe are told apart.
const APART_VIEWS: f64 = 0.05;
const APART_RAD: f64 = 0.15;

/// A place that looks like the picture.
#[derive(Debug)]
pub struct Lookalike {
    keyframe: KeyframeId,
    /// Where the picture would have been taken, in the map.
    pose: GroundPose,
    /// `None` where the corners are not found again.
    sighting: Option<LoopSighting>,
    likeness: Likeness,
}

impl Lookalike {
    /// Registers the picture where a hypothesis places it; `None` if too little ground is in both
    /// images.
    pub fn new(
        matcher: &Matcher,
        (query, reference): (&QueryKeyframe, &ReferenceKeyframe),
        hypothesis: &PlaceHypothesis,
        keyframe: &GroundPose,
    ) -> Option<Self> {
        let motion = inverse(&hypothesis.motion, SAME_METRES);
        let sighting = matcher.find(query, reference, &motion, GUESS_OFF_PX);
        let sighting = sighting.filter(|sighting| sighting.inliers >= MIN_INLIERS);
        let there = sighting.map_or_else(|| matcher.predicted(query, reference, &motion), |found| found.pose);
        let likeness = matcher.likeness(query, reference, &there)?;
        // Hypotheses that are some centimetres apart may lead to one place.
        let motion = sighting.map_or(motion, |found| found.motion);
        let pose = compose(keyframe, &inverse(&motion, SAME_METRES), 1.0);
        Some(Self { keyframe: hypothesis.keyframe, pose, sighting, likeness })
    }

    fn is_elsewhere(&self, other: &Self, view_m: f64) -> bool {
        self.pose.distance_m(&other.pose) > APART_VIEWS * view_m
            || wrap_angle(self.pose.heading_rad - other.pose.heading_rad).abs() > APART_RAD
    }
}

/// The place that differs from the picture by noise only, and significantly less than all others;
/// `None` if there is none, or nothing to compare it with.
pub fn only_place(found: &[Lookalike], view_m: f64) -> Option<(KeyframeId, LoopSighting)> {
    let possible = found.iter().filter(|one| one.likeness.is_of_one_place() && one.likeness.is_white());
    let judged = possible.filter_map(|one| Some((one, one.sighting?, false_alarm(one, found, view_m)?)));
    let (best, sighting, probability) = judged.min_by(|a, b| a.2.total_cmp(&b.2))?;
    (probability <= MAX_FALSE_ALARM).then_some((best.keyframe, sighting))
}

/// The probability of mistaking any of the other places for one; `None` without another. Of the
/// keyframes that show a place the one that differs most counts, times their number.
fn false_alarm(one: &Lookalike, found: &[Lookalike], view_m: f64) -> Option<f64> {
    let mut places: Vec<(&Lookalike, f64, f64)> = Vec::new();
    for rival in found.iter().filter(|other| other.is_elsewhere(one, view_m)) {
        let probability = one.likeness.false_alarm(&rival.likeness);
        match places.iter_mut().find(|(place, ..)| !place.is_elsewhere(rival, view_m)) {
            Some((_, least, keyframes)) => {
                (*least, *keyframes) = (least.min(probability), *keyframes + 1.0);
            }
            None => places.push((rival, probability, 1.0)),
        }
    }
    places.iter().map(|(_, least, keyframes)| least * keyframes).reduce(|sum, place| sum + place)
}
