//! Frames that no motion of a camera explains: images that are out of order, repeated or badly
//! timed, and poses that were measured wrongly.
//!
//! Each position is compared with the linear interpolation between its neighbours. Where the
//! acceleration is at most a, the remainder is at most a Δt₁ Δt₂ / 2, with the times Δt to both
//! neighbours (the error of linear interpolation; Burden and Faires, "Numerical Analysis", theorem
//! 3.3). What exceeds it is an error of about this size.

use crate::geometry::pose_index::{HEADING, X, Y};
use crate::trajectory::FrameEstimate;
use nalgebra::{Matrix3, Vector3};

/// Largest acceleration of a camera, m/s²: 2 g. An emergency stop reaches 1 g; a camera shaken by
/// 6 mm at 8 Hz reaches 1.5 g.
const MOST_ACCELERATION: f64 = 20.0;

/// Largest angular acceleration, rad/s²; shaking by 15 mrad at 8 Hz reaches 38.
const MOST_TURN_ACCELERATION: f64 = 100.0;

/// Smaller remainders are let pass: this part of the height, some pixels, and as many radians.
const LEAST_SHARE: f64 = 0.005;

/// Standard deviations by which a remainder must exceed the bound.
const CERTAIN: f64 = 5.0;

/// A frame beside one that deviates deviates too if its remainder is at least this part of the
/// other's: two that are swapped have equal ones, the frames beside them a third.
const SIMILAR: f64 = 0.6;

/// A camera stands if it moves by less than this part of its height, and turns by less than as many
/// radians: one pixel of most cameras.
const STANDING_SHARE: f64 = 0.002;

/// Longest frozen video that is recognised by the jump at its end, seconds.
const LONGEST_FREEZE_S: f64 = 2.0;

/// A posed frame as far as its motion goes.
#[derive(Debug, Clone, Copy)]
struct Waypoint {
    time_s: f64,
    /// x and y in metres, heading in radians.
    place: Vector3<f64>,
    /// Variances of the frame's own measurement, in the squares of these units.
    variance: Vector3<f64>,
    height_m: f64,
    segment: usize,
}

/// Looks for frames that no motion of a camera explains. Holds some numbers of each frame.
#[derive(Debug, Default)]
pub struct AbruptMotion {
    waypoints: Vec<Waypoint>,
    /// The frame of each waypoint.
    frames: Vec<usize>,
    count: usize,
}

/// By how much a frame deviates from what the motion allows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AbruptFrame {
    /// The index of the frame among those pushed.
    pub index: usize,
    /// Deviation of x and y, metres, and of the heading, radians.
    pub deviation: Vector3<f64>,
}

impl AbruptFrame {
    /// Adds the deviation to the stated and to the measured covariance of its frame.
    pub fn widen(&self, frame: &mut FrameEstimate) {
        let Some(known) = &mut frame.estimate else { return };
        let squares: Matrix3<f64> = self.deviation * self.deviation.transpose();
        known.measured.covariance += squares;
        let mut stated = known.covariance.fixed_view_mut::<3, 3>(X, X);
        stated += squares;
    }
}

impl AbruptMotion {
    /// Adds the next frame.
    pub fn push(&mut self, frame: &FrameEstimate) {
        if let Some(known) = &frame.estimate {
            let own = &known.measured.covariance;
            self.waypoints.push(Waypoint {
                time_s: frame.time_s,
                place: Vector3::new(known.pose.x_m, known.pose.y_m, known.pose.heading_rad),
                variance: Vector3::new(own[(X, X)], own[(Y, Y)], own[(HEADING, HEADING)]),
                height_m: known.pose.height_m,
                segment: frame.segment,
            });
            self.frames.push(self.count);
        }
        self.count += 1;
    }

    /// The frames that deviate, in their order.
    pub fn frames(&self) -> Vec<AbruptFrame> {
        let mut remainders = vec![Remainder::default(); self.waypoints.len()];
        for (remainder, trio) in remainders.iter_mut().skip(1).zip(self.waypoints.windows(3)) {
            *remainder = Remainder::of(trio).unwrap_or_default();
        }
        let mut deviations = vec![None; self.waypoints.len()];
        for at in (1..deviations.len()).filter(|&at| remainders[at].excess > 1.0) {
            for near in at - 1..(at + 2).min(deviations.len()) {
                if remainders[near].excess > SIMILAR * remainders[at].excess {
                    deviations[near].get_or_insert(remainders[near].deviation);
                }
            }
            if self.waypoints.get(at + 1).is_some_and(|next| jumps(&self.waypoints[at], next)) {
                self.thaw(at, &mut deviations);
            }
        }
        let found = self.frames.iter().zip(deviations);
        found.filter_map(|(&index, deviation)| Some(AbruptFrame { index, deviation: deviation? })).collect()
    }

    /// Where the camera stood before it jumped, the video may have been frozen, and the camera have
    /// gone on at constant velocity. `last` is the last frame before the jump.
    fn thaw(&self, last: usize, deviations: &mut [Option<Vector3<f64>>]) {
        let (end, next) = (&self.waypoints[last], &self.waypoints[last + 1]);
        let is_frozen = |at: &Waypoint| {
            !jumps(at, end) && at.segment == end.segment && end.time_s - at.time_s <= LONGEST_FREEZE_S
        };
        let standing = self.waypoints[..last].iter().rev().take_while(|at| is_frozen(at)).count();
        let Some(first) = self.waypoints.get(last - standing).filter(|_| standing > 0) else { return };
        let frozen = last - standing..=last;
        for (here, deviation) in self.waypoints[frozen.clone()].iter().zip(&mut deviations[frozen]) {
            let share = (here.time_s - first.time_s) / (next.time_s - first.time_s);
            *deviation = Some(first.place + share * (next.place - first.place) - here.place);
        }
    }
}

/// Whether a camera that stands is elsewhere in the next frame.
fn jumps(from: &Waypoint, to: &Waypoint) -> bool {
    let moved = to.place - from.place;
    let limit = STANDING_SHARE * from.height_m;
    moved.xy().norm() > limit || moved[HEADING].abs() > STANDING_SHARE
}

/// Deviation of a frame from the linear interpolation of its neighbours.
#[derive(Debug, Clone, Copy, Default)]
struct Remainder {
    /// From the frame to the line.
    deviation: Vector3<f64>,
    /// Its size in units of the largest that a motion allows.
    excess: f64,
}

impl Remainder {
    fn of(trio: &[Waypoint]) -> Option<Self> {
        let [before, here, after] = trio else { return None };
        let (past_s, future_s) = (here.time_s - before.time_s, after.time_s - here.time_s);
        if before.segment != after.segment || past_s <= 0.0 || future_s <= 0.0 {
            return None;
        }
        let share = past_s / (past_s + future_s);
        let deviation = before.place + share * (after.place - before.place) - here.place;
        let variance =
            here.variance + (1.0 - share).powi(2) * before.variance + share * share * after.variance;
        let possible = 0.5 * past_s * future_s;
        let position_m = (MOST_ACCELERATION * possible).max(LEAST_SHARE * here.height_m)
            + CERTAIN * (variance[X] + variance[Y]).sqrt();
        let heading_rad =
            (MOST_TURN_ACCELERATION * possible).max(LEAST_SHARE) + CERTAIN * variance[HEADING].sqrt();
        let excess = (deviation.xy().norm() / position_m).max(deviation[HEADING].abs() / heading_rad);
        Some(Self { deviation, excess })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use crate::geometry::GroundPose;
    use crate::trajectory::{PlaneMeasurement, PoseEstimate, TrackStatus};
    use nalgebra::Matrix6;

    fn frame(number: usize, [x_m, heading_rad]: [f64; 2]) -> FrameEstimate {
        let pose = GroundPose { x_m, heading_rad, ..GroundPose::level(0.75) };
        let covariance = Matrix6::identity() * 1e-8;
        FrameEstimate {
            frame: number as u64,
            time_s: number as f64 / 30.0,
            status: TrackStatus::Tracked,
            estimate: Some(PoseEstimate {
                pose,
                velocity: Default::default(),
                covariance,
                measured: PlaneMeasurement::new(&pose, &covariance),
            }),
            tracks: 300,
            inliers: 300,
            residual_px: 0.1,
            keyframe: false,
            segment: 0,
        }
    }

    /// The deviating frames of a drive whose frame `k` is where an exact drive is in `shown(k)`.
    fn found(place: impl Fn(f64) -> [f64; 2], shown: impl Fn(usize) -> usize) -> Vec<AbruptFrame> {
        let mut motion = AbruptMotion::default();
        (0..90).for_each(|k| motion.push(&frame(k, place(shown(k) as f64 / 30.0))));
        motion.frames()
    }

    fn straight(time_s: f64) -> [f64; 2] {
        [0.5 * time_s, 0.0]
    }

    #[test]
    fn motion_that_a_camera_can_make_is_let_pass() {
        let shaken =
            |time_s: f64| [0.5 * time_s + 0.006 * (50.0 * time_s).sin(), 0.015 * (50.0 * time_s).cos()];
        let stops = |time_s: f64| [0.25 - 0.5 * (0.5 - time_s).max(0.0), 0.0];
        for found in [found(straight, |k| k), found(shaken, |k| k), found(stops, |k| k)] {
            assert_eq!(found, []);
        }
    }

    #[test]
    fn two_images_in_the_wrong_order_deviate_by_at_least_their_error() {
        let swapped = |k| match k {
            40 => 41,
            41 => 40,
            k => k,
        };
        let found = found(straight, swapped);
        assert_eq!(found.iter().map(|frame| frame.index).collect::<Vec<_>>(), [40, 41]);
        for abrupt in found {
            let k = abrupt.index;
            let mut estimate = frame(k, straight(swapped(k) as f64 / 30.0));
            abrupt.widen(&mut estimate);
            let covariance = estimate.estimate.unwrap().covariance;
            assert!(covariance[(X, X)].sqrt() > 0.5 / 30.0);
            assert!((covariance - covariance.transpose()).norm() == 0.0);
        }
        let turning = found_turning(swapped);
        assert_eq!(turning.iter().map(|frame| frame.index).collect::<Vec<_>>(), [40, 41]);
    }

    fn found_turning(shown: impl Fn(usize) -> usize) -> Vec<AbruptFrame> {
        found(|time_s| [0.0, 2.0 * time_s], shown)
    }

    #[test]
    fn over_a_frozen_video_the_camera_may_have_gone_on() {
        let found = found(straight, |k| if (40..60).contains(&k) { 39 } else { k });
        for k in 40..60 {
            let abrupt = found.iter().find(|frame| frame.index == k).unwrap();
            let error_m = 0.5 * (k - 39) as f64 / 30.0;
            assert!((abrupt.deviation[X] - error_m).abs() < 1e-9, "frame {k}: {abrupt:?}");
        }
    }
}
