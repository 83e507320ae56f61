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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Camera, Distortion};
    use crate::keyframe::relative_pose::relative_motion;
    use crate::loop_closure::matching::{CameraIndex, CameraPose};
    use crate::motion::Random;
    use crate::odometry::OdometryConfig;
    use crate::simulation::{Ground, Renderer, Texture};

    #[test]
    fn a_tile_is_told_from_the_tiles_around_it() {
        let camera = Camera::new((320, 240), (250.0, 250.0), (160.5, 119.0), Distortion::None).unwrap();
        let renderer = Renderer::new(&camera);
        let matcher = Matcher::new(&camera, &OdometryConfig::default());
        let ground = Ground::new(Texture::Tiles, renderer.footprint_m(0.9), false, 9).unwrap();
        let mut random = Random::new(4);
        let mut picture = |pose: &GroundPose| {
            let mut image = renderer.gray_view(&ground, pose);
            for sample in image.samples_mut() {
                // The sum of four uniform numbers deviates by 0.577 of their width: 2 gray levels.
                let noise: f64 = (0..4).map(|_| random.below(1 << 16) as f64 / 65536.0 - 0.5).sum();
                *sample = (f64::from(*sample) + 3.5 * noise).round().clamp(0.0, 255.0) as u8;
            }
            image
        };
        let at = |pose: GroundPose| CameraPose { camera: CameraIndex::default(), pose, ground: None };
        let (here, there) =
            (GroundPose::level(0.9), GroundPose { x_m: 0.05, heading_rad: 0.8, ..GroundPose::level(0.9) });
        let query = matcher.query(picture(&here), &at(here), None);
        let reference = matcher.reference(picture(&there), &at(there), None);
        let hypothesis = |x_m: f64, y_m: f64| PlaceHypothesis {
            keyframe: KeyframeId(3),
            motion: relative_motion(&there, &GroundPose { x_m, y_m, ..here }),
            ln_scale_deviation: f64::INFINITY,
            matches: 20,
            shared: 100,
            worth: 4.0,
            rival_worth: 3.0,
            score: 0.4,
        };
        let shifts = [(0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.0, 0.2), (0.0, -0.2)];
        let found: Vec<Lookalike> = shifts
            .iter()
            .filter_map(|&(x_m, y_m)| {
                Lookalike::new(&matcher, (&query, &reference), &hypothesis(x_m, y_m), &there)
            })
            .collect();
        let view_m = matcher.view_m(&at(here));
        let (keyframe, sighting) = only_place(&found, view_m).expect("the place is among them");
        assert_eq!(keyframe, KeyframeId(3));
        let off_m = (sighting.motion - relative_motion(&here, &there)).xy().norm();
        assert!(off_m < 5e-4, "{off_m}");
        // Of lookalikes alone none is the place, and one without others is not judged.
        assert!(only_place(&found[1..], view_m).is_none());
        assert!(only_place(&found[..1], view_m).is_none());
    }
}
