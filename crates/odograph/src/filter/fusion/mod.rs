//! Loosely coupled fusion of the camera with low-cost sensors: gyroscope, compass, wheel odometer
//! and range finder.
//!
//! The fusion runs over a whole recording, after visual odometry with the camera alone:
//!
//! 1. Each sensor is calibrated against the camera where both have data: clock offset, scale, bias
//!    and mounting by robust least squares, noise from the residuals ([`SensorReport`]).
//! 2. A sensor is rejected if it contradicts the camera in more than a fifth of the seconds
//!    (normalised innovation squared, NIS; Y. Bar-Shalom et al., 2001, §5.4), or if its noise
//!    exceeds a limit for its kind.
//! 3. The accepted sensors enter one forward–backward estimator, weighted by their noise and the
//!    camera's covariance: wheel and gyroscope bridge tracking gaps by dead reckoning, the compass
//!    bounds heading drift, and the range finder bounds scale drift.
//!
//! Without an accepted sensor the result is the camera's, unchanged.

mod bridge;
mod calibration;
mod camera_motion;
mod estimator;
mod fit;
mod online;
mod reckoning;
mod rejection;
mod report;
mod series;

pub use fit::{MAX_OFFSET_S, TimeOffset};
pub use online::{FusedFrame, LONGEST_DELAY_S, OnlineFusion, SensorCalibration};
pub use rejection::Reason;
pub use report::{SensorKind, SensorParameter, SensorReport};
pub use series::{Quantity, SensorRecord};

use super::smoother::SmoothedFrame;
use crate::geometry::pose_index::HEIGHT;
use crate::geometry::{GroundPose, PlaneTransform, Se2, Sim2, propagated};
use crate::trajectory::{FrameEstimate, PoseEstimate};
use bridge::{Bridge, rates_around};
use calibration::{MAX_CONTRADICTIONS, Sighted};
use camera_motion::{MeasuredFrame, MotionStep};
use estimator::{Consistency, Corrected, Estimate};
use reckoning::{Believed, TrackingGap};
use report::{gyro_report, sighted_report, wheel_report};

/// Records of the available sensors.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Sensors {
    /// Gyroscope: [`Quantity::TurnRate`] or [`Quantity::TurnRates`].
    pub gyro: Option<SensorRecord>,
    /// Compass: [`Quantity::Heading`].
    pub heading: Option<SensorRecord>,
    /// Wheel odometer: [`Quantity::Speed`] or [`Quantity::Way`].
    pub wheel: Option<SensorRecord>,
    /// Range finder: [`Quantity::Height`] or [`Quantity::AxisDistance`].
    pub range: Option<SensorRecord>,
}

/// Result of the fusion of a recording with its sensors.
#[derive(Debug, Clone)]
pub struct Fusion {
    /// The frames, with corrected poses where they have one.
    pub frames: Vec<FrameEstimate>,
    /// Calibration and acceptance of each sensor.
    pub reports: Vec<SensorReport>,
    /// Whether the fusion changed any pose of the camera.
    pub moved: bool,
    /// Dead-reckoned poses of frames that the camera could not measure.
    pub reckoned: Reckoned,
}

/// Dead-reckoned frames, in order of time.
#[derive(Debug, Clone, Default)]
pub struct Reckoned(Vec<SmoothedFrame>);

/// Sensors accepted so far.
struct AcceptedSensors<'a> {
    believed: Believed<'a>,
    heading: Option<&'a Sighted>,
    range: Option<&'a Sighted>,
}

/// Fuses visual odometry with the records of other sensors. Frames must be in order of time.
pub fn fuse(frames: &[FrameEstimate], sensors: &Sensors) -> Fusion {
    let nodes = camera_motion::nodes(frames);
    let steps = camera_motion::steps(&nodes);
    let mut reports = Vec::new();
    let mut judge = |sensor, outcome: Option<Result<SensorReport, Reason>>| {
        reports.extend(
            outcome.map(|outcome| outcome.unwrap_or_else(|reason| SensorReport::rejected(sensor, reason))),
        );
    };
    let gyro = sensors.gyro.as_ref().map(|record| calibration::gyro(record, &steps, 0));
    let wheel = sensors.wheel.as_ref().map(|record| calibration::wheel(record, &steps, 0));
    let mut heading = sensors.heading.as_ref().map(|record| calibration::heading(record, &nodes));
    let mut range = sensors.range.as_ref().map(|record| calibration::range(record, &nodes));
    let mut outcome: Option<(Estimate, Vec<Bridge>)> = None;
    // A compass or range finder that is inconsistent with the fused estimate is rejected, and the
    // estimate is repeated without it.
    for _ in 0..3 {
        let comparison = AcceptedSensors {
            believed: Believed {
                gyro: believed(&sensors.gyro, &gyro),
                heading: believed(&sensors.heading, &heading),
                wheel: believed(&sensors.wheel, &wheel),
            },
            heading: heading.as_ref().and_then(|found| found.as_ref().ok()),
            range: range.as_ref().and_then(|found| found.as_ref().ok()),
        };
        let Some((estimate, bridges)) = comparison.estimate(frames, &nodes, &steps) else { break };
        let lies = [contradicts(&estimate.heading), contradicts(&estimate.range)];
        if let Some(reason) = lies[0] {
            heading = Some(Err(reason));
        }
        if let Some(reason) = lies[1] {
            range = Some(Err(reason));
        }
        if lies == [None, None] {
            outcome = Some((estimate, bridges));
            break;
        }
    }
    judge(SensorKind::Gyro, gyro.map(|found| found.map(|known| gyro_report(&known, sensors.gyro.as_ref()))));
    let estimate = outcome.as_ref().map(|(estimate, _)| estimate);
    judge(
        SensorKind::Heading,
        heading.map(|found| {
            let zero = estimate.map(|estimate| (estimate.heading_zero, estimate.heading));
            found.map(|known| sighted_report(SensorKind::Heading, "zero_rad", &known, zero))
        }),
    );
    judge(SensorKind::Wheel, wheel.map(|found| found.map(|known| wheel_report(&known))));
    judge(
        SensorKind::Range,
        range.map(|found| {
            let zero = estimate.map(|estimate| (estimate.range_zero, estimate.range));
            found.map(|known| sighted_report(SensorKind::Range, "camera_above_sensor_m", &known, zero))
        }),
    );
    match outcome {
        Some((estimate, bridges)) => corrected(frames, &nodes, &estimate.corrected, &bridges, reports),
        None => Fusion { frames: frames.to_vec(), reports, moved: false, reckoned: Reckoned::default() },
    }
}

impl Reckoned {
    /// Whether there are no dead-reckoned frames.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Moves the dead-reckoned frames along with their measured neighbours, for example after a
    /// loop closure: the corrections of the neighbours are interpolated in time. `moves` has the
    /// time of each measured frame, in order, with its pose before and after.
    pub fn moved_with(self, moves: &[(f64, GroundPose, GroundPose)]) -> Self {
        let moved = |frame: SmoothedFrame| {
            let next = moves.partition_point(|(time_s, ..)| *time_s <= frame.time_s);
            let ends = [next.checked_sub(1).and_then(|at| moves.get(at)), moves.get(next)];
            let [Some(before), after] = ends else { return frame };
            let share = after.map_or(0.0, |after| (frame.time_s - before.0) / (after.0 - before.0));
            let carried = |(_, from, to): &(f64, GroundPose, GroundPose)| {
                from.similarity_to(to).apply_to_pose(&frame.pose)
            };
            let a = carried(before);
            let pose = after.map_or(a, |after| a.interpolated(&carried(after), share));
            SmoothedFrame { pose, ..frame }
        };
        Self(self.0.into_iter().map(moved).collect())
    }

    /// Starts merging the dead-reckoned frames into a smoothed path, frame by frame.
    pub fn merge(&self) -> Merge<'_> {
        Merge { rest: &self.0 }
    }
}

/// Merges dead-reckoned frames into a smoothed path: replaces frames of the same index and inserts
/// the others.
#[derive(Debug)]
pub struct Merge<'a> {
    rest: &'a [SmoothedFrame],
}

impl Merge<'_> {
    /// Takes the next frame of the path and outputs all frames up to it.
    pub fn next(&mut self, frame: SmoothedFrame, take: &mut dyn FnMut(SmoothedFrame)) {
        let count = self.rest.partition_point(|reckoned| reckoned.frame <= frame.frame);
        let (now, rest) = self.rest.split_at(count);
        self.rest = rest;
        now.iter().cloned().for_each(&mut *take);
        if now.last().is_none_or(|reckoned| reckoned.frame != frame.frame) {
            take(frame);
        }
    }

    /// Outputs the frames after the last one of the path.
    pub fn end(self, take: &mut dyn FnMut(SmoothedFrame)) {
        self.rest.iter().cloned().for_each(take);
    }
}

fn believed<'a, T>(
    record: &'a Option<SensorRecord>,
    found: &'a Option<Result<T, Reason>>,
) -> Option<(&'a SensorRecord, &'a T)> {
    record.as_ref().zip(found.as_ref()?.as_ref().ok())
}

fn contradicts(consistency: &Consistency) -> Option<Reason> {
    let Consistency { readings, contradictions, .. } = *consistency;
    (contradictions as f64 > MAX_CONTRADICTIONS * readings as f64)
        .then_some(Reason::Contradicts { seconds: contradictions, of: readings })
}

impl AcceptedSensors<'_> {
    /// The fused estimate and the dead reckoning through the gaps. `None` without an accepted
    /// sensor or a measured frame.
    fn estimate(
        &self,
        frames: &[FrameEstimate],
        nodes: &[MeasuredFrame],
        steps: &[MotionStep],
    ) -> Option<(Estimate, Vec<Bridge>)> {
        let Believed { gyro, wheel, .. } = self.believed;
        if nodes.is_empty()
            || (gyro.is_none() && wheel.is_none() && self.heading.is_none() && self.range.is_none())
        {
            return None;
        }
        let mut gaps: Vec<Option<reckoning::ReckonedPose>> = vec![None; nodes.len()];
        let mut bridges = Vec::new();
        for (before, node) in nodes.iter().enumerate() {
            let after = (before + 1 < nodes.len()).then_some(before + 1);
            let next = after.map_or(frames.len(), |after| nodes[after].index);
            let lost: Vec<usize> = (node.index + 1..next).filter(|&i| frames[i].estimate.is_none()).collect();
            let separate = after.is_some_and(|after| nodes[after].segment != node.segment);
            if lost.is_empty() && !separate {
                continue;
            }
            let to_s = after.map_or_else(|| frames[frames.len() - 1].time_s, |after| nodes[after].time_s);
            let times_s: Vec<f64> = lost.iter().map(|&i| frames[i].time_s.clamp(node.time_s, to_s)).collect();
            let rates = rates_around(steps, before, after);
            let gap = TrackingGap { from_s: node.time_s, to_s, before: rates[0], after: rates[1] };
            let Some(reckoned) = self.believed.reckon(&gap, &times_s) else { continue };
            // After the last measured frame there is nothing to interpolate to: without speed and
            // turn rate, dead reckoning would be a guess.
            if after.is_none() && (wheel.is_none() || (gyro.is_none() && self.heading.is_none())) {
                continue;
            }
            let Some(&end) = reckoned.last() else { continue };
            if let Some(after) = after.filter(|_| separate) {
                gaps[after] = Some(end);
            }
            let duration_s = to_s - node.time_s;
            bridges.push(Bridge {
                before,
                after,
                frames: lost.into_iter().zip(reckoned).collect(),
                end,
                duration_s,
            });
        }
        let sights = |found: Option<&Sighted>| found.map_or(Vec::new(), |found| found.sights.clone());
        let estimate = estimator::estimate(nodes, &gaps, &sights(self.heading), &sights(self.range));
        Some((estimate, bridges))
    }
}

/// Applies the corrections of the nodes to the frames, and fills in the dead-reckoned frames.
fn corrected(
    frames: &[FrameEstimate],
    nodes: &[MeasuredFrame],
    corrections: &[Corrected],
    bridges: &[Bridge],
    reports: Vec<SensorReport>,
) -> Fusion {
    let mut moved = false;
    let mut fused = frames.to_vec();
    let mut k = 0;
    for (index, frame) in fused.iter_mut().enumerate() {
        while k + 1 < nodes.len() && nodes[k + 1].index <= index {
            k += 1;
        }
        if let Some(known) = &mut frame.estimate {
            moved |= moved_by(known, &nodes[k], &corrections[k]);
        }
    }
    if !moved {
        // Keeps the original frames if the corrections are only rounding.
        fused = frames.to_vec();
    }
    let reckoned = Reckoned(bridges.iter().flat_map(|bridge| bridge.placed(&fused, nodes)).collect());
    Fusion { frames: fused, reports, moved, reckoned }
}

/// Applies the correction of a node to a frame that it holds for; whether that is more than
/// rounding.
fn moved_by(known: &mut PoseEstimate, node: &MeasuredFrame, correction: &Corrected) -> bool {
    let Corrected { x_m, y_m, turn_rad, scale, .. } = *correction;
    let turned = |x: f64, y: f64| Sim2::about_origin(turn_rad, scale).rotate(x, y);
    let place = |x: f64, y: f64| {
        let (dx, dy) = turned(x - node.x_m, y - node.y_m);
        (x_m + dx, y_m + dy)
    };
    let (pose, plane, velocity) = (&mut known.pose, &mut known.measured, &mut known.velocity);
    (pose.x_m, pose.y_m) = place(pose.x_m, pose.y_m);
    (plane.x_m, plane.y_m) = place(plane.x_m, plane.y_m);
    pose.heading_rad += turn_rad;
    plane.heading_rad += turn_rad;
    pose.height_m *= scale;
    (velocity.x_m_s, velocity.y_m_s) = turned(velocity.x_m_s, velocity.y_m_s);
    plane.covariance = propagated(&Se2::rotation(turn_rad).product_by_right(), &plane.covariance);
    let own = plane.covariance;
    known.covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&(correction.covariance + own));
    // The correlations between position and height held for the camera alone.
    known.covariance.fixed_view_mut::<3, 3>(0, 3).fill(0.0);
    known.covariance.fixed_view_mut::<3, 3>(3, 0).fill(0.0);
    if known.covariance[(HEIGHT, HEIGHT)] > 0.0 {
        known.covariance[(HEIGHT, HEIGHT)] = pose.height_m.powi(2) * correction.scale_variance;
    }
    (x_m - node.x_m).hypot(y_m - node.y_m) > MIN_MOVE_M
        || turn_rad.abs() > MIN_TURN_RAD
        || (scale - 1.0).abs() > MIN_TURN_RAD
}

/// Corrections below 0.1 µm or 0.1 µrad are rounding.
const MIN_MOVE_M: f64 = 1e-7;
const MIN_TURN_RAD: f64 = 1e-7;

#[cfg(test)]
mod tests;
