//! Relocalization: when predictions fail, the whole image is compared with the keyframes.
//!
//! The comparison gives predictions only: a pose is accepted if the tracker finds the keyframe's
//! corners from there. On repetitive floors several predictions may be confirmed; the one with most
//! inliers is taken or, if that is ambiguous, the one clearly nearest to the expected pose. If that
//! is ambiguous too, the frame stays lost.

use super::LastPose;
use super::keyframe::{Keyframe, KeyframeMemory};
use super::tracking::{Measurement, Tracker};
use crate::camera::Camera;
use crate::geometry::{GroundPose, wrap_angle};
use crate::motion::{CoarseOptions, CoarseRegistration, GroundView, Hypothesis, Random};
use std::f64::consts::PI;

/// Number of keyframes that are compared with a lost frame, beside the present one.
const KEYFRAMES_PER_FRAME: usize = 2;

/// Hypotheses that stand out less than this are not worth following.
const LEAST_SCORE: f64 = 4.5;

/// A hypothesis is accepted if its score exceeds the next by this factor and this fraction of the
/// corners is found.
const OUTSTANDING: f64 = 1.4;
const CLEAR_INLIER_RATIO: f64 = 0.6;

/// Least inlier ratio among the corners in view; less is accepted if no other hypothesis comes
/// near.
const MIN_INLIER_RATIO: f64 = 0.5;
const MIN_CLEAR_INLIER_RATIO: f64 = 0.3;

/// A rival with at least this part of the best one's inliers leaves the choice to the prediction.
/// On a floor that repeats, in images that stabilisation shifts, the next tile but one had 76
/// inliers where the right place had 45.
const RIVAL: f64 = 0.55;

/// Largest likely error of the expected heading, radians, and how fast it grows during a loss,
/// radians per second: faster turns are rarer than floors that look alike when turned by a right
/// angle. Beyond it, only what is clearly right is accepted.
const HEADING_ERROR_RAD: f64 = 0.4;
const FASTEST_TURN_RAD_S: f64 = 3.0;

/// Finds frames again whose movement was too large, or that come after a loss.
#[derive(Debug)]
pub struct Recovery {
    registration: CoarseRegistration,
    /// How many keyframes were tried since the loss.
    tried: usize,
}

/// A keyframe found again.
pub struct RecoveredFrame {
    pub measurement: Measurement,
    /// Which of the remembered keyframes it was measured against; `None` is the present one.
    pub remembered: Option<usize>,
}

/// A lost frame with its expected pose.
pub struct Lost<'a> {
    /// The frame, to be measured against the present keyframe.
    pub tracker: Tracker<'a>,
    pub last: &'a LastPose,
    pub expected: GroundPose,
    /// The time since the last pose, seconds.
    pub gap_s: f64,
    /// How many frames before this one were lost too.
    pub frames: usize,
    /// A measurement of this frame that few corners speak for.
    pub ambiguous: Option<Measurement>,
}

impl Lost<'_> {
    /// How far the heading may be from the expected one, radians.
    fn likely_turn_rad(&self) -> f64 {
        (HEADING_ERROR_RAD + FASTEST_TURN_RAD_S * self.gap_s).min(PI)
    }
}

impl Recovery {
    pub fn new(camera: &Camera) -> Self {
        Self { registration: CoarseRegistration::new(camera), tried: 0 }
    }

    /// What compares whole images.
    pub fn registration(&self) -> &CoarseRegistration {
        &self.registration
    }

    /// The next loss begins with the newest keyframes again.
    pub fn reset(&mut self) {
        self.tried = 0;
    }

    /// Whether every keyframe that the camera could have come back to was tried since the loss.
    pub fn is_exhausted(&self, memory: &KeyframeMemory) -> bool {
        self.tried > memory.reachable()
    }

    /// Measures a lost frame against the present keyframe and some remembered ones. `None` if none
    /// is found, or if the result is ambiguous.
    pub fn find(
        &mut self,
        lost: Lost<'_>,
        memory: &mut KeyframeMemory,
        random: &mut Random,
    ) -> Option<RecoveredFrame> {
        let Tracker { keyframe, pyramid, camera, .. } = lost.tracker;
        let now = self.registration.view(pyramid, keyframe.mask.as_deref(), &lost.last.pose)?;
        let search = RecoverySearch { lost: &lost, now, registration: &self.registration };
        let jumped = lost.frames == 0;
        let turned_rad = lost.likely_turn_rad();
        // After a jump the heading is known about as well as before. After a loss, any is tried in
        // one keyframe after the other.
        let (here_rad, there_rad) = if jumped { (turned_rad, turned_rad) } else { (HEADING_ERROR_RAD, PI) };
        let there = choose(memory, &lost.expected, lost.frames, &mut self.tried);
        let there = there.into_iter().map(|there| (there, there_rad));
        let mut confirmed = Vec::new();
        let mut decided = false;
        for (remembered, heading_rad) in std::iter::once((None, here_rad)).chain(there) {
            let found = match remembered {
                None => search.look(keyframe, heading_rad, random),
                Some(index) => {
                    let Some(old) = memory.take(index, camera) else { continue };
                    let found = search.look(&old, heading_rad, random);
                    memory.put_back_at(index, old);
                    found
                }
            };
            let frames = found.measurements.into_iter();
            confirmed.extend(frames.map(|measurement| RecoveredFrame { measurement, remembered }));
            decided = found.decided;
            if decided {
                break;
            }
        }
        if jumped && confirmed.is_empty() {
            // Images of a series may be further apart than those of a video.
            let found = search.look(keyframe, PI, random).measurements.into_iter();
            confirmed.extend(found.map(|measurement| RecoveredFrame { measurement, remembered: None }));
        }
        if !decided {
            confirmed
                .extend(lost.ambiguous.map(|measurement| RecoveredFrame { measurement, remembered: None }));
        }
        decide(confirmed, &lost.expected)
    }
}

/// The keyframes to try beside the present one near the expected heading: after a jump those
/// nearest to the expected pose, after a loss one after the other. `None` is the present one.
fn choose(
    memory: &KeyframeMemory,
    expected: &GroundPose,
    lost_frames: usize,
    tried: &mut usize,
) -> Vec<Option<usize>> {
    if lost_frames == 0 {
        return memory.nearest(expected).into_iter().take(KEYFRAMES_PER_FRAME).map(Some).collect();
    }
    let order: Vec<_> = std::iter::once(None).chain(memory.newest().into_iter().map(Some)).collect();
    let count = KEYFRAMES_PER_FRAME.min(order.len());
    let first = *tried;
    *tried += count;
    (first..first + count).map(|i| order[i % order.len()]).collect()
}

/// A lost frame and what it is looked for with.
struct RecoverySearch<'a> {
    lost: &'a Lost<'a>,
    now: GroundView,
    registration: &'a CoarseRegistration,
}

/// What the fine tracker makes of the hypotheses about one keyframe.
struct Confirmed {
    measurements: Vec<Measurement>,
    /// Whether the last is so clearly right that nothing else need be tried.
    decided: bool,
}

impl RecoverySearch<'_> {
    /// Searches for the frame in a keyframe at headings about the expected one within
    /// `heading_rad`, radians.
    fn look(&self, keyframe: &Keyframe, heading_rad: f64, random: &mut Random) -> Confirmed {
        let turned_rad = wrap_angle(self.lost.expected.heading_rad - keyframe.pose.heading_rad);
        let options = CoarseOptions {
            heading_rad: (turned_rad, heading_rad),
            scale_free: self.lost.tracker.config.motion.model.scale_is_free(),
            ..Default::default()
        };
        let hypotheses = match keyframe.view(self.registration) {
            Some(view) => self.registration.register(view, &self.now, &options),
            None => Vec::new(),
        };
        let mut measurements = Vec::new();
        for (rank, hypothesis) in hypotheses.iter().enumerate() {
            if hypothesis.score < LEAST_SCORE {
                break;
            }
            let Some((measurement, inlier_ratio)) = self.confirm(keyframe, hypothesis, random) else {
                continue;
            };
            let next = hypotheses.get(rank + 1).map_or(0.0, |next| next.score);
            let outstanding = rank == 0 && hypothesis.score > OUTSTANDING * next;
            if inlier_ratio < if outstanding { MIN_CLEAR_INLIER_RATIO } else { MIN_INLIER_RATIO } {
                continue;
            }
            let decided = inlier_ratio > CLEAR_INLIER_RATIO && outstanding;
            let heading_rad = measurement.estimate.pose.heading_rad;
            let turned_rad = wrap_angle(heading_rad - self.lost.expected.heading_rad).abs();
            if decided || turned_rad <= self.lost.likely_turn_rad() {
                measurements.push(measurement);
            }
            if decided {
                return Confirmed { measurements, decided };
            }
        }
        Confirmed { measurements, decided: false }
    }

    /// Measures from a hypothesis, and returns the inlier ratio among the corners in view as well.
    fn confirm(
        &self,
        keyframe: &Keyframe,
        hypothesis: &Hypothesis,
        random: &mut Random,
    ) -> Option<(Measurement, f64)> {
        let last = &self.lost.last.pose;
        let pose = hypothesis.pose(&keyframe.pose, last);
        // Whole turns are kept.
        let heading_rad = last.heading_rad + wrap_angle(pose.heading_rad - last.heading_rad);
        let from = GroundPose { heading_rad, ..pose };
        let tracker = Tracker { keyframe, ..self.lost.tracker };
        let measurement = tracker.measure(&from, random).ok()?;
        let measurement = Measurement { prediction: self.lost.expected, ..measurement };
        let inlier_ratio = measurement.inlier_ratio(keyframe, tracker.camera);
        Some((measurement, inlier_ratio))
    }
}

/// The measurement with most inliers; if another place has nearly as many, the one clearly nearer
/// to the expected pose.
fn decide(mut confirmed: Vec<RecoveredFrame>, expected: &GroundPose) -> Option<RecoveredFrame> {
    let inliers = |found: &RecoveredFrame| found.measurement.estimate.inlier_count();
    confirmed.sort_by_key(|found| std::cmp::Reverse(inliers(found)));
    let best = confirmed.first()?;
    let best_pose = best.measurement.estimate.pose;
    let elsewhere = |found: &&RecoveredFrame| {
        distance_m(&found.measurement.estimate.pose, &best_pose) > 0.02 * best_pose.height_m
    };
    let enough = RIVAL * inliers(best) as f64;
    let away = |found: &RecoveredFrame| distance_m(&found.measurement.estimate.pose, expected);
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
    a.distance_m(b) + 0.5 * a.height_m * turn.abs()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::buffer::Buffer;
    use crate::motion::MotionEstimate;
    use nalgebra::Matrix6;

    fn found(x_m: f64, inliers: usize) -> RecoveredFrame {
        let pose = GroundPose { x_m, ..GroundPose::level(1.0) };
        let estimate = MotionEstimate {
            pose,
            covariance: Matrix6::identity(),
            model_covariance: Matrix6::zeros(),
            by_keyframe: Matrix6::identity(),
            by_prior_tilt: nalgebra::Matrix6x2::zeros(),
            keyframe_error: None,
            inliers: Buffer::of(true, inliers),
            residual_px: 0.1,
            noise_px: f64::INFINITY,
            residual_correlation: Default::default(),
            rig_evidence: None,
            elevations: Buffer::new(),
            shape: None,
            uneven: None,
            shutter: None,
        };
        RecoveredFrame {
            measurement: Measurement {
                estimate,
                prediction: pose,
                found: Buffer::new(),
                support: 0.5,
                refined: false,
                fixed: Buffer::new(),
                agreement: None,
                tiles: Vec::new(),
            },
            remembered: None,
        }
    }

    /// Where the decision falls among places that so many corners speak for, expected at 0.
    fn place(confirmed: Vec<RecoveredFrame>) -> Option<f64> {
        decide(confirmed, &GroundPose::level(1.0)).map(|found| found.measurement.estimate.pose.x_m)
    }

    #[test]
    fn most_corners_decide_and_then_the_nearest_place() {
        assert_eq!(place(vec![]), None);
        assert_eq!(place(vec![found(0.1, 100), found(0.5, 200)]), Some(0.5));
        // A tile further on has more, but not twice as many.
        assert_eq!(place(vec![found(0.45, 76), found(0.001, 45)]), Some(0.001));
        // One place twice is no rival.
        assert_eq!(place(vec![found(0.5, 200), found(0.501, 190)]), Some(0.5));
        // A floor that repeats every 0.2 m: the clearly nearest copy.
        assert_eq!(place(vec![found(0.25, 200), found(0.05, 190)]), Some(0.05));
        assert_eq!(place(vec![found(0.05, 200), found(-0.15, 195), found(0.25, 199)]), Some(0.05));
        // Half way between two copies nothing can be said.
        assert_eq!(place(vec![found(0.10, 200), found(-0.11, 198)]), None);
    }
}
