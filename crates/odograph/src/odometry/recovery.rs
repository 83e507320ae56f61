//! The way back: when the predictions have failed, the whole image is compared with the keyframes.
//!
//! What the comparison gives are predictions, no more: a pose is measured only where the fine tracker finds the keyframe's corners from
//! there. Where a floor repeats, several predictions may be confirmed; the one that most corners speak for is taken, and where that does not
//! decide, the one clearly nearest to where the camera should be. Where nothing decides, the frame stays lost.

use super::follow::{self, Measurement};
use super::keyframe::{Keyframe, KeyframeMemory};
use super::{LastPose, OdometryConfig};
use crate::camera::Camera;
use crate::geometry::{GroundPose, wrap_angle};
use crate::image::Pyramid;
use crate::motion::{CoarseOptions, CoarseRegistration, Hypothesis, MotionModel, Random, RigWander};

/// So many remembered keyframes are compared with a frame, beside the present one.
const REMEMBERED_PER_FRAME: usize = 2;

/// Hypotheses that stand out less than this are not worth following.
const LEAST_SCORE: f64 = 4.5;

/// A hypothesis that stands out so many times as far as the next, and is confirmed by most corners, needs no rivals.
const OUTSTANDING: f64 = 1.4;

/// The part of the corners that should be in view which must be found again.
const LEAST_PRESENCE: f64 = 0.3;

/// A rival with at least this part of the best one's inliers leaves the choice to the prediction.
const RIVAL: f64 = 0.75;

/// Finds frames again whose movement was too large, or that come after a loss.
#[derive(Debug)]
pub struct Recovery {
    registration: CoarseRegistration,
    /// How many of the remembered keyframes were tried since the loss.
    tried: usize,
}

/// A keyframe found again.
pub struct Found {
    pub measurement: Measurement,
    /// Which of the remembered keyframes it was measured against; `None` is the present one.
    pub remembered: Option<usize>,
}

/// What a frame is, and what is known about where it may be.
pub struct Lost<'a> {
    pub pyramid: &'a Pyramid,
    pub last: &'a LastPose,
    pub expected: GroundPose,
    /// How many frames before this one were lost too.
    pub frames: usize,
    /// A measurement of this frame that few corners speak for.
    pub doubtful: Option<Measurement>,
}

impl Recovery {
    pub fn new(camera: &Camera) -> Self {
        Self { registration: CoarseRegistration::new(camera), tried: 0 }
    }

    /// The next loss begins with the newest keyframes again.
    pub fn reset(&mut self) {
        self.tried = 0;
    }

    /// Whether every keyframe that the camera could have come back to was tried since the loss.
    pub fn is_exhausted(&self, memory: &KeyframeMemory) -> bool {
        self.tried >= memory.reachable()
    }

    /// Measures a lost frame against the present keyframe and some of the remembered ones. Nothing where none is found, or
    /// where it cannot be told which.
    pub fn find(
        &mut self,
        lost: Lost<'_>,
        keyframe: &mut Keyframe,
        memory: &mut KeyframeMemory,
        camera: &Camera,
        config: &OdometryConfig,
        wander: &RigWander,
        random: &mut Random,
    ) -> Option<Found> {
        let Lost { pyramid, last, expected, frames, doubtful } = lost;
        let now = self.registration.view(pyramid, &last.pose)?;
        let remembered = self.choose(memory, &expected, frames);
        let registration = &self.registration;
        keyframe.prepare_view(registration);
        remembered.iter().for_each(|&index| memory.prepare_view(index, registration));
        let views: Vec<_> = std::iter::once((None, keyframe.view()))
            .chain(remembered.iter().map(|&index| (Some(index), memory.view(index))))
            .filter_map(|(place, view)| Some((place, view?)))
            .collect();
        let options = CoarseOptions {
            scale_free: matches!(config.motion.model, MotionModel::Similarity | MotionModel::Free),
            ..Default::default()
        };
        let only_views: Vec<_> = views.iter().map(|(_, view)| *view).collect();
        let hypotheses = registration.register(&only_views, &now, &options);
        let places: Vec<Option<usize>> = views.iter().map(|(place, _)| *place).collect();
        let mut confirmed: Vec<Found> =
            doubtful.into_iter().map(|measurement| Found { measurement, remembered: None }).collect();
        for (place, hypotheses) in places.into_iter().zip(hypotheses) {
            if hypotheses.iter().all(|hypothesis| hypothesis.score < LEAST_SCORE) {
                continue;
            }
            let check = |keyframe: &Keyframe, random: &mut Random| {
                confirm(keyframe, pyramid, &hypotheses, last, camera, config, wander, random)
            };
            let found = match place {
                None => check(keyframe, random),
                Some(index) => {
                    let Some(old) = memory.take(index, camera) else { continue };
                    let found = check(&old, random);
                    memory.put_back_at(index, old);
                    found
                }
            };
            let decided = found.decided;
            let found = found.measurements.into_iter();
            confirmed.extend(found.map(|measurement| Found { measurement, remembered: place }));
            if decided {
                break;
            }
        }
        decide(confirmed, &expected)
    }

    /// The remembered keyframes to try: after a jump the nearest to where the camera should be, after a loss one after the other.
    fn choose(&mut self, memory: &KeyframeMemory, expected: &GroundPose, lost_frames: usize) -> Vec<usize> {
        let order = if lost_frames == 0 { memory.nearest(expected) } else { memory.newest() };
        if order.is_empty() {
            return order;
        }
        let count = REMEMBERED_PER_FRAME.min(order.len());
        let first = if lost_frames == 0 { 0 } else { self.tried };
        self.tried += if lost_frames == 0 { 0 } else { count };
        (first..first + count).map(|i| order[i % order.len()]).collect()
    }
}

/// What the fine tracker makes of the hypotheses about one keyframe.
struct Confirmed {
    measurements: Vec<Measurement>,
    /// Whether the first is so clearly right that nothing else need be tried.
    decided: bool,
}

fn confirm(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    hypotheses: &[Hypothesis],
    last: &LastPose,
    camera: &Camera,
    config: &OdometryConfig,
    wander: &RigWander,
    random: &mut Random,
) -> Confirmed {
    let mut measurements: Vec<Measurement> = Vec::new();
    for (rank, hypothesis) in hypotheses.iter().enumerate() {
        if hypothesis.score < LEAST_SCORE {
            break;
        }
        let pose = hypothesis.pose(&keyframe.pose, &last.pose);
        // Whole turns are kept.
        let heading_rad = last.pose.heading_rad + wrap_angle(pose.heading_rad - last.pose.heading_rad);
        let prediction = GroundPose { heading_rad, ..pose };
        let Ok(first) = follow::measure(keyframe, pyramid, camera, &prediction, config, wander, random)
        else {
            continue;
        };
        // Once more from where it was found: corners that were out of reach are now within.
        let again = follow::measure(keyframe, pyramid, camera, &first.estimate.pose, config, wander, random);
        let measurement = match again {
            Ok(again) if again.support >= first.support => again,
            _ => first,
        };
        let presence = follow::presence(keyframe, camera, &measurement.estimate);
        if presence < LEAST_PRESENCE {
            continue;
        }
        let next = hypotheses.get(rank + 1).map_or(0.0, |next| next.score);
        let decided = presence > 2.0 * LEAST_PRESENCE && hypothesis.score > OUTSTANDING * next;
        measurements.push(measurement);
        if decided {
            return Confirmed { measurements, decided };
        }
    }
    Confirmed { measurements, decided: false }
}

/// The measurement that most corners speak for; where another place has nearly as many, the one clearly nearer to the expected place.
fn decide(mut confirmed: Vec<Found>, expected: &GroundPose) -> Option<Found> {
    let inliers = |found: &Found| found.measurement.estimate.inlier_count();
    confirmed.sort_by_key(|found| std::cmp::Reverse(inliers(found)));
    let best = confirmed.first()?;
    let best_pose = best.measurement.estimate.pose;
    let elsewhere =
        |found: &&Found| distance_m(&found.measurement.estimate.pose, &best_pose) > 0.02 * best_pose.height_m;
    let enough = RIVAL * inliers(best) as f64;
    let away = |found: &Found| distance_m(&found.measurement.estimate.pose, expected);
    let rival = confirmed
        .iter()
        .filter(elsewhere)
        .filter(|found| inliers(found) as f64 >= enough)
        .map(away)
        .min_by(f64::total_cmp);
    match rival {
        None => {}
        Some(rival) if away(best) < 0.5 * rival => {}
        Some(rival) if rival < 0.5 * away(best) => {
            confirmed.retain(|found| away(found) <= rival);
        }
        Some(_) => return None,
    }
    confirmed.into_iter().next()
}

/// How far two poses are apart: over the ground, and at the edge of the image through the heading.
fn distance_m(a: &GroundPose, b: &GroundPose) -> f64 {
    let turn = wrap_angle(a.heading_rad - b.heading_rad);
    (a.x_m - b.x_m).hypot(a.y_m - b.y_m) + 0.5 * a.height_m * turn.abs()
}
