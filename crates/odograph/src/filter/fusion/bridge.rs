//! Tracking gaps: the camera's velocity around a gap, and dead-reckoned frames within it.

use super::camera_motion::{MeasuredFrame, MotionStep};
use super::reckoning::{BodyRates, ReckonedPose};
use crate::filter::smoother::{PoseSource, SmoothedFrame};
use crate::geometry::pose_index::HEADING;
use crate::geometry::{GroundPose, PlaneTransform, Se2, propagated};
use crate::trajectory::{FrameEstimate, PoseEstimate, Velocity};
use nalgebra::Vector3;

/// A run of frames without a pose, bridged by dead reckoning.
pub struct Bridge {
    /// Nodes before and after the gap; there is no node after it at the end of a recording.
    pub before: usize,
    pub after: Option<usize>,
    /// Index of each frame in the gap, with its dead-reckoned pose relative to the node before.
    pub frames: Vec<(usize, ReckonedPose)>,
    /// Pose of the node after the gap, or of the last frame, relative to the node before.
    pub end: ReckonedPose,
    pub duration_s: f64,
}

/// Time over which the velocity is averaged on either side of a gap, seconds.
const RATES_S: f64 = 0.2;

/// Velocity of the camera just before and just after a gap; if one is unknown, it is set to the
/// other.
pub fn rates_around(steps: &[MotionStep], before: usize, after: Option<usize>) -> [BodyRates; 2] {
    let mean = |steps: &mut dyn Iterator<Item = &MotionStep>| {
        let (mut sum, mut duration_s) = (BodyRates::zeros(), 0.0);
        for step in steps {
            if duration_s >= RATES_S {
                break;
            }
            sum += Vector3::new(step.ahead_m, step.left_m, step.turn_rad);
            duration_s += step.duration_s();
        }
        (duration_s > 0.0).then(|| sum / duration_s)
    };
    // Steps are sorted by their first node.
    let first_after = steps.partition_point(|step| step.from < before + 1);
    let earlier = mean(&mut steps[..first_after].iter().rev().take_while(|step| step.from + 20 > before));
    let later = after
        .and_then(|after| mean(&mut steps[first_after..].iter().take_while(|step| step.from < after + 20)));
    [earlier.or(later), later.or(earlier)].map(Option::unwrap_or_default)
}

impl Bridge {
    /// Dead-reckoned frames of the gap in world coordinates, adjusted to the measured poses at its
    /// ends.
    pub fn placed(&self, frames: &[FrameEstimate], nodes: &[MeasuredFrame]) -> Vec<SmoothedFrame> {
        let before = &frames[nodes[self.before].index];
        let after = self.after.map(|after| &frames[nodes[after].index]);
        let Some(start) = &before.estimate else { return Vec::new() };
        let finish = after.and_then(|frame| frame.estimate.as_ref());
        let plane = |known: &PoseEstimate| {
            Vector3::new(known.measured.x_m, known.measured.y_m, known.measured.heading_rad)
        };
        let origin = plane(start);
        let turn = Se2::rotation(origin[HEADING]).product_by_right();
        // The misclosure at the far end is distributed linearly over the gap.
        let missed =
            finish.map_or(Vector3::zeros(), |finish| plane(finish) - (origin + turn * self.end.pose));
        let connected = after.is_some_and(|after| after.segment == before.segment);
        let covariance = |known: &PoseEstimate| known.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        let mut placed: Vec<SmoothedFrame> = Vec::with_capacity(self.frames.len());
        for (index, reckoned) in &self.frames {
            let frame = &frames[*index];
            let share = ((frame.time_s - before.time_s) / self.duration_s).clamp(0.0, 1.0);
            let at = origin + turn * reckoned.pose + missed * share;
            let own = propagated(&turn, &reckoned.covariance);
            let between = |of: fn(&GroundPose) -> f64| {
                let from = of(&start.pose);
                finish.map_or(from, |finish| from + share * (of(&finish.pose) - from))
            };
            let covariance = match finish {
                // Both ends are measured: covariance of a Brownian bridge.
                Some(finish) if connected => {
                    covariance(start) * (1.0 - share) + covariance(finish) * share + own * (1.0 - share)
                }
                _ => covariance(start) + own,
            };
            let (then_s, then) = placed.last().map_or((before.time_s, origin), |last: &SmoothedFrame| {
                (last.time_s, last.pose.to_vector().xyz())
            });
            let rates =
                if frame.time_s > then_s { (at - then) / (frame.time_s - then_s) } else { Vector3::zeros() };
            placed.push(SmoothedFrame {
                frame: frame.frame,
                time_s: frame.time_s,
                pose: GroundPose {
                    x_m: at[0],
                    y_m: at[1],
                    heading_rad: at[2],
                    height_m: between(|pose| pose.height_m),
                    roll_rad: between(|pose| pose.roll_rad),
                    pitch_rad: between(|pose| pose.pitch_rad),
                },
                velocity: Velocity { x_m_s: rates[0], y_m_s: rates[1], heading_rad_s: rates[2] },
                covariance,
                source: PoseSource::Sensors,
                segment: before.segment,
            });
        }
        placed
    }
}
