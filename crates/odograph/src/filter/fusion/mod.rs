//! Cheap sensors beside the camera: gyroscope, compass, wheel and range finder.
//!
//! The coupling is loose, over a whole recording: the camera is followed alone, and then
//!
//! 1. each sensor is compared with the camera where both see: the offset of its clock, its scale, bias and mounting are found by robust least
//!    squares, its noise by what is left over ([`SensorReport`]);
//! 2. a sensor that says other than the camera in more than a fifth of the seconds (normalised innovation squared; Y. Bar-Shalom et al., 2001,
//!    §5.4), or is worse than the worst of its kind, is rejected;
//! 3. what is left goes into one estimator, forward and backward in time: gaps are crossed by wheel and gyroscope, the compass holds the heading,
//!    the range finder the scale, each with the weight that its noise allows beside the camera's covariance.
//!
//! Without a believed sensor nothing changes.

mod bridge;
mod calibration;
mod camera_motion;
mod estimator;
mod fit;
mod reckoning;
mod report;
mod series;

pub use fit::{MOST_OFFSET_S, TimeOffset};
pub use report::{Reason, SensorKind, SensorParameter, SensorReport};
pub use series::{Quantity, SensorRecord};

use super::FilterConfig;
use super::smoother::{SmoothedFrame, smooth};
use crate::geometry::pose_index::HEIGHT;
use crate::geometry::{GroundPose, PlaneTransform, Se2, Sim2, propagated};
use crate::trajectory::FrameEstimate;
use bridge::{Bridge, rates_around};
use calibration::{MOST_CONTRADICTIONS, Sighted};
use camera_motion::{Node, Step};
use estimator::{Consistency, Corrected, Estimate};
use reckoning::{Believed, Gap};
use report::{gyro_report, sighted_report, wheel_report};

/// The records of the sensors there are.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Sensors {
    /// [`Quantity::TurnRate`] or [`Quantity::TurnRates`].
    pub gyro: Option<SensorRecord>,
    /// [`Quantity::Heading`].
    pub heading: Option<SensorRecord>,
    /// [`Quantity::Speed`] or [`Quantity::Way`].
    pub wheel: Option<SensorRecord>,
    /// [`Quantity::Height`] or [`Quantity::AxisDistance`].
    pub range: Option<SensorRecord>,
}

/// A recording with what the sensors bring to it.
#[derive(Debug, Clone)]
pub struct Fusion {
    /// The frames, those with a pose set right.
    pub frames: Vec<FrameEstimate>,
    /// What became of each sensor.
    pub reports: Vec<SensorReport>,
    /// Whether any pose is another one than the camera's alone.
    pub moved: bool,
    /// Frames without a pose, where the sensors tell one.
    pub reckoned: Reckoned,
}

/// What the sensors tell of frames without a pose, in order.
#[derive(Debug, Clone, Default)]
pub struct Reckoned(Vec<SmoothedFrame>);

/// What became of the sensors one by one: those that are believed.
struct Comparison<'a> {
    believed: Believed<'a>,
    heading: Option<&'a Sighted>,
    range: Option<&'a Sighted>,
}

/// Fuses what the camera saw with what the sensors tell. Frames must be in order of time.
pub fn fuse(frames: &[FrameEstimate], sensors: &Sensors) -> Fusion {
    let nodes = camera_motion::nodes(frames);
    let steps = camera_motion::steps(&nodes);
    let mut reports = Vec::new();
    let mut judge = |sensor, outcome: Option<Result<SensorReport, Reason>>| {
        reports.extend(
            outcome.map(|outcome| outcome.unwrap_or_else(|reason| SensorReport::rejected(sensor, reason))),
        );
    };
    let gyro = sensors.gyro.as_ref().map(|record| calibration::gyro(record, &steps));
    let wheel = sensors.wheel.as_ref().map(|record| calibration::wheel(record, &steps));
    let mut heading = sensors.heading.as_ref().map(|record| calibration::heading(record, &nodes));
    let mut range = sensors.range.as_ref().map(|record| calibration::range(record, &nodes));
    let mut outcome: Option<(Estimate, Vec<Bridge>)> = None;
    // A compass or range finder that does not go together with the whole is left out, and the whole is done again without it.
    for _ in 0..3 {
        let comparison = Comparison {
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

impl Fusion {
    /// The smoothed path ([`smooth`]), with the gaps as the sensors tell them.
    pub fn smooth(&self, config: &FilterConfig) -> Vec<SmoothedFrame> {
        let mut path = Vec::with_capacity(self.frames.len());
        let mut merge = self.reckoned.merge();
        smooth(&self.frames, config).into_iter().for_each(|frame| merge.next(frame, &mut |f| path.push(f)));
        merge.end(&mut |frame| path.push(frame));
        path
    }
}

impl Reckoned {
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The same with the frames that have a pose elsewhere, as a map has them: they go along with those before and after. `moves` are the times of the
    /// latter, in order, each with its pose before and after.
    pub fn laid(self, moves: &[(f64, GroundPose, GroundPose)]) -> Self {
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

    /// What puts them into a smoothed path that comes frame by frame.
    pub fn merge(&self) -> Merge<'_> {
        Merge { rest: &self.0 }
    }
}

/// Puts what the sensors tell into a smoothed path: in the place of frames that it has, and between them.
#[derive(Debug)]
pub struct Merge<'a> {
    rest: &'a [SmoothedFrame],
}

impl Merge<'_> {
    /// Takes the next frame of the path, and gives those that come up to it.
    pub fn next(&mut self, frame: SmoothedFrame, take: &mut dyn FnMut(SmoothedFrame)) {
        let count = self.rest.partition_point(|reckoned| reckoned.frame <= frame.frame);
        let (now, rest) = self.rest.split_at(count);
        self.rest = rest;
        now.iter().cloned().for_each(&mut *take);
        if now.last().is_none_or(|reckoned| reckoned.frame != frame.frame) {
            take(frame);
        }
    }

    /// Gives those behind the last frame of the path.
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
    (contradictions as f64 > MOST_CONTRADICTIONS * readings as f64)
        .then_some(Reason::Contradicts { seconds: contradictions, of: readings })
}

impl Comparison<'_> {
    /// The estimate, and the ways through the gaps. `None` where no sensor is believed or nothing was measured.
    fn estimate(
        &self,
        frames: &[FrameEstimate],
        nodes: &[Node],
        steps: &[Step],
    ) -> Option<(Estimate, Vec<Bridge>)> {
        let Believed { gyro, wheel, .. } = self.believed;
        if nodes.is_empty()
            || (gyro.is_none() && wheel.is_none() && self.heading.is_none() && self.range.is_none())
        {
            return None;
        }
        let mut gaps: Vec<Option<reckoning::Reckoned>> = vec![None; nodes.len()];
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
            let gap = Gap { from_s: node.time_s, to_s, before: rates[0], after: rates[1] };
            let Some(reckoned) = self.believed.reckon(&gap, &times_s) else { continue };
            // Beyond the last measured frame what no sensor tells would be a guess.
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

/// The frames with the corrections of their nodes, and those without a pose as the sensors tell them.
fn corrected(
    frames: &[FrameEstimate],
    nodes: &[Node],
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
        let Some(known) = &mut frame.estimate else { continue };
        let (node, correction) = (&nodes[k], &corrections[k]);
        let Corrected { x_m, y_m, turn_rad, scale, .. } = *correction;
        let turned = |x: f64, y: f64| Sim2::about_origin(turn_rad, scale).rotate(x, y);
        let place = |x: f64, y: f64| {
            let (dx, dy) = turned(x - node.x_m, y - node.y_m);
            (x_m + dx, y_m + dy)
        };
        moved |= (x_m - node.x_m).hypot(y_m - node.y_m) > LEAST_MOVE_M
            || turn_rad.abs() > LEAST_TURN_RAD
            || (scale - 1.0).abs() > LEAST_TURN_RAD;
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
        // How position and height go astray together was the camera's alone.
        known.covariance.fixed_view_mut::<3, 3>(0, 3).fill(0.0);
        known.covariance.fixed_view_mut::<3, 3>(3, 0).fill(0.0);
        if known.covariance[(HEIGHT, HEIGHT)] > 0.0 {
            known.covariance[(HEIGHT, HEIGHT)] = pose.height_m.powi(2) * correction.scale_variance;
        }
    }
    if !moved {
        // What would be rewritten by rounding alone stays as it was.
        fused = frames.to_vec();
    }
    let reckoned = Reckoned(bridges.iter().flat_map(|bridge| bridge.laid(&fused, nodes)).collect());
    Fusion { frames: fused, reports, moved, reckoned }
}

/// Corrections below a tenth of a micrometre or microradian are rounding.
const LEAST_MOVE_M: f64 = 1e-7;
const LEAST_TURN_RAD: f64 = 1e-7;

#[cfg(test)]
mod tests;
