//! The place of a single picture on ground that repeats itself.
//!
//! A printed or paved floor looks alike in many places, and descriptors of corners do not tell
//! them apart. What is left when the registered images are divided by each other does: at the place
//! it is noise, at a lookalike also what is peculiar to both places, be it grain ([`Likeness`]) or
//! smooth ([`SmoothDifference`]). The lookalike that differs least shows how much copies of this
//! ground differ, and so what the difference at a place is evidence of.

use super::likeness::Likeness;
use super::matching::{LoopSighting, Matcher, QueryKeyframe, ReferenceKeyframe};
use super::recognition::SAME_METRES;
use super::smooth_difference::{DifferenceEquations, SmoothDifference};
use super::verification::{GUESS_OFF_PX, MIN_INLIERS};
use crate::geometry::{GroundPose, wrap_angle};
use crate::keyframe::KeyframeId;
use crate::keyframe::relative_pose::{compose, inverse};
use crate::place_recognition::PlaceHypothesis;

/// Number of lookalikes that are registered, each some milliseconds.
pub const MAX_LOOKALIKES: usize = 48;

/// Minimum logarithm of the odds of a place, against every other place and against a copy that is
/// not in the map: one in 1,100.
const MIN_LOG_ODDS: f64 = 7.0;

/// Distance and angle beyond which two places differ: twelve spots of a view of 240, and as where
/// motions of one keyframe are told apart.
const APART_VIEWS: f64 = 0.05;
const APART_RAD: f64 = 0.15;

/// A keyframe that looks like the picture.
#[derive(Debug)]
pub struct Lookalike {
    keyframe: KeyframeId,
    /// Where the picture would have been taken, in the map.
    pose: GroundPose,
    /// `None` where the corners are not found again.
    sighting: Option<LoopSighting>,
    likeness: Likeness,
    equations: DifferenceEquations,
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
        let overlap = matcher.overlap_grid(query, reference, &there);
        let likeness = Likeness::of(&overlap)?;
        // Hypotheses that are some centimetres apart may lead to one place.
        let motion = sighting.map_or(motion, |found| found.motion);
        let pose = compose(keyframe, &inverse(&motion, SAME_METRES), 1.0);
        let equations = DifferenceEquations::of(&overlap);
        Some(Self { keyframe: hypothesis.keyframe, pose, sighting, likeness, equations })
    }

    fn is_elsewhere(&self, other: &Self, view_m: f64) -> bool {
        self.pose.distance_m(&other.pose) > APART_VIEWS * view_m
            || wrap_angle(self.pose.heading_rad - other.pose.heading_rad).abs() > APART_RAD
    }

    fn inliers(&self) -> usize {
        self.sighting.map_or(0, |sighting| sighting.inliers)
    }
}

/// The place that differs from the picture by noise only, and is far more probable than any other
/// and than a copy elsewhere; `None` if there is none, or nothing to compare it with.
pub fn only_place(found: &[Lookalike], view_m: f64) -> Option<(KeyframeId, LoopSighting)> {
    let places = places(found, view_m);
    let differences: Vec<Option<SmoothDifference>> = places.iter().map(|place| difference(place)).collect();
    let judged = places.iter().enumerate().filter_map(|(number, place)| {
        let (keyframe, sighting) = place.iter().find_map(|one| {
            one.sighting.filter(|_| one.likeness.is_of_one_place()).map(|sighting| (one.keyframe, sighting))
        })?;
        let others = differences.iter().enumerate().filter(|(other, _)| *other != number);
        let others: Vec<&SmoothDifference> =
            others.filter_map(|(_, difference)| difference.as_ref()).collect();
        let log_odds = log_odds(differences[number].as_ref()?, &others)?;
        Some((log_odds, keyframe, sighting))
    });
    let (log_odds, keyframe, sighting) = judged.max_by(|a, b| a.0.total_cmp(&b.0))?;
    (log_odds >= MIN_LOG_ODDS).then_some((keyframe, sighting))
}

/// The keyframes by places, those with the most inliers first. Those whose corners are not found
/// again are registered badly, so each of them stands for itself.
fn places(found: &[Lookalike], view_m: f64) -> Vec<Vec<&Lookalike>> {
    let mut found: Vec<&Lookalike> = found.iter().collect();
    found.sort_by_key(|one| (std::cmp::Reverse(one.inliers()), one.keyframe));
    let mut places: Vec<Vec<&Lookalike>> = Vec::new();
    for one in found {
        match places.iter_mut().find(|place| !place[0].is_elsewhere(one, view_m)) {
            None => places.push(vec![one]),
            Some(place) => {
                let is_known = place.iter().any(|other| other.keyframe == one.keyframe);
                if one.sighting.is_some() && !is_known {
                    place.push(one);
                }
            }
        }
    }
    places
}

/// The smooth difference between the picture and all keyframes of a place.
fn difference(place: &[&Lookalike]) -> Option<SmoothDifference> {
    let (first, more) = place.split_first()?;
    let mut equations = first.equations.clone();
    more.iter().for_each(|one| equations.add(&one.equations));
    equations.solved()
}

/// Logarithm of the odds of a place against a copy elsewhere, or against one of the others if that
/// is less; `None` without another.
fn log_odds(place: &SmoothDifference, others: &[&SmoothDifference]) -> Option<f64> {
    // Where only a part of a copy is in the map, little difference is no evidence that the copy is
    // the place, but it is evidence that copies differ little.
    let amplitude = others.iter().map(|other| other.amplitude()).min_by(f64::total_cmp)?;
    let own = place.log_odds(amplitude);
    let most = others.iter().map(|other| other.log_odds(amplitude)).max_by(f64::total_cmp)?;
    Some(own - most.max(0.0))
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
        // Neither is it told from an exact copy.
        let further = GroundPose { x_m: there.x_m + 1.6, ..there };
        let copy = Lookalike::new(&matcher, (&query, &reference), &hypothesis(0.0, 0.0), &further);
        let found: Vec<Lookalike> = found.into_iter().chain(copy).collect();
        assert_eq!(found.len(), 6);
        assert!(only_place(&found, view_m).is_none());
    }
}
