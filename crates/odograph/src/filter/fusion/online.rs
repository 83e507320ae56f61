//! Fusion while frames come: dead reckoning through gaps as they happen, and the path after them
//! placed where it leads.
//!
//! It is the forward half of the fusion of a recording: the same calibration, the same dead
//! reckoning and the same filter, without what only later frames can tell.

use super::calibration::{self, Calibrated, Sighted};
use super::camera_motion::{self, MeasuredFrame};
use super::estimator::{Forward, height_change};
use super::reckoning::{Believed, BodyRates, ReckonedPose, TrackingGap};
use super::{Reason, SensorKind, SensorRecord, Sensors, bridge, moved_by};
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::geometry::{GroundPose, PlaneTransform, Se2, propagated};
use crate::trajectory::{FrameEstimate, PlaneMeasurement, PoseEstimate, Velocity};
use nalgebra::{Matrix3, Vector3};

/// Calibration of the sensors against the frames so far.
#[derive(Debug, Clone, Default)]
pub struct SensorCalibration {
    gyro: Option<Calibrated>,
    heading: Option<Sighted>,
    wheel: Option<Calibrated>,
    rejected: Vec<(SensorKind, Reason)>,
}

impl SensorCalibration {
    /// Calibrates gyroscope, compass and wheel against frames of the camera, in order of time. The
    /// range finder has no part in dead reckoning.
    pub fn of(frames: &[FrameEstimate], sensors: &Sensors) -> Self {
        let nodes = camera_motion::nodes(frames);
        let steps = camera_motion::steps(&nodes);
        let mut rejected = Vec::new();
        let mut refuse = |sensor, reason| rejected.push((sensor, reason));
        let gyro = sensors.gyro.as_ref().and_then(|record| {
            calibration::gyro(record, &steps, PATIENCE)
                .map(Calibrated::widened)
                .map_err(|reason| refuse(SensorKind::Gyro, reason))
                .ok()
        });
        let heading = sensors.heading.as_ref().and_then(|record| {
            calibration::heading(record, &nodes).map_err(|reason| refuse(SensorKind::Heading, reason)).ok()
        });
        let wheel = sensors.wheel.as_ref().and_then(|record| {
            calibration::wheel(record, &steps, PATIENCE)
                .map(Calibrated::widened)
                .map_err(|reason| refuse(SensorKind::Wheel, reason))
                .ok()
        });
        Self { gyro, heading, wheel, rejected }
    }

    /// The sensors that are not used, and why.
    pub fn rejected(&self) -> &[(SensorKind, Reason)] {
        &self.rejected
    }

    /// This calibration, and of sensors that had too little to be compared with this time that of
    /// `earlier`.
    pub fn after(self, earlier: &Self) -> Self {
        let unknown =
            |sensor| self.rejected.iter().any(|(kind, reason)| *kind == sensor && reason.is_preliminary());
        let [gyro, heading, wheel] = [SensorKind::Gyro, SensorKind::Heading, SensorKind::Wheel].map(unknown);
        Self {
            gyro: self.gyro.or_else(|| earlier.gyro.clone().filter(|_| gyro)),
            heading: self.heading.or_else(|| earlier.heading.clone().filter(|_| heading)),
            wheel: self.wheel.or_else(|| earlier.wheel.clone().filter(|_| wheel)),
            rejected: self.rejected,
        }
    }

    fn believed<'a>(&'a self, sensors: &'a Sensors) -> Believed<'a> {
        let Self { gyro, heading, wheel, .. } = self;
        Believed {
            gyro: sensors.gyro.as_ref().zip(gyro.as_ref()),
            heading: sensors.heading.as_ref().zip(heading.as_ref()),
            wheel: sensors.wheel.as_ref().zip(wheel.as_ref()),
        }
    }
}

/// A frame after fusion.
#[derive(Debug, Clone)]
pub struct FusedFrame {
    /// The frame. One that the camera lost has a dead-reckoned pose where the sensors give it,
    /// although its status is that of a lost frame.
    pub frame: FrameEstimate,
    /// Takes poses of the camera's odometry, of the segment of this frame, to those after fusion.
    pub fused_from_odometry: Se2,
    /// If this frame is the first of a segment whose place the sensors gave: the same transform for
    /// the segment before, and the covariance that the gap adds to (x, y, heading).
    pub bridged: Option<(Se2, Matrix3<f64>)>,
    /// Whether the sensors were found to contradict the camera just before this lost frame, and are
    /// left out until the camera sees the ground again.
    pub distrusted: bool,
}

/// Fuses frames with other sensors as they come.
#[derive(Default)]
pub struct OnlineFusion {
    calibration: SensorCalibration,
    filter: Option<Forward>,
    /// Measured frames of the last [`RECENT_S`], and the noise of their own measurement.
    recent: Vec<MeasuredFrame>,
    noises: Vec<Matrix3<f64>>,
    /// The newest measured frame.
    last: Option<FrameEstimate>,
    /// Whether the sensors have placed a segment: until then frames are those of the camera.
    has_bridged: bool,
    /// Whether the sensors agreed with the camera just before the present gap.
    agreed: Option<bool>,
}

/// Seconds of contradiction that do not reject a sensor, however few are compared: a drive that
/// begins with a jerk has one. The last second before a gap is compared again.
const PATIENCE: usize = 1;
/// Time over which sensors are compared with the camera before they are followed into a gap.
const COMPARED_S: f64 = 1.0;
const RECENT_S: f64 = 1.5;
/// Normalised innovation squared of three components beyond which they contradict each other. The
/// 99.9 % quantile of χ² is 16.3; slip and vibration have longer tails than a normal distribution.
const WORST_NIS: f64 = 25.0;
/// Longest delay of a reading over which the motion is extrapolated, seconds.
pub const LONGEST_DELAY_S: f64 = 1.0;
/// Longest gap in which poses are given while it lasts, seconds: bounds the work per frame.
const LONGEST_SHOWN_S: f64 = 120.0;
/// Time over which the rates at the end of the readings are averaged, seconds.
const LAST_RATES_S: f64 = 0.1;

impl OnlineFusion {
    /// Uses a newer calibration from now on.
    pub fn calibrate(&mut self, calibration: SensorCalibration) {
        self.calibration = calibration;
    }

    /// Fuses the next frame. The records must reach back to the last measured frame, and should
    /// begin a second before it.
    pub fn add(&mut self, frame: &FrameEstimate, sensors: &Sensors) -> FusedFrame {
        match camera_motion::nodes(std::slice::from_ref(frame)).pop() {
            Some(node) => self.measured(frame, node, sensors),
            None => self.lost(frame, sensors),
        }
    }

    fn measured(&mut self, frame: &FrameEstimate, node: MeasuredFrame, sensors: &Sensors) -> FusedFrame {
        let before_gap = self.fused_from_odometry();
        let before = self.recent.last().copied();
        let mut bridged = None;
        if before.is_none_or(|before| before.time_s < node.time_s) {
            let crossed = before
                .filter(|before| before.segment != node.segment)
                .and_then(|before| Some((before, self.reckon(sensors, node.time_s, false)?.0)));
            match (&mut self.filter, crossed, before) {
                (Some(filter), Some((before, reckoned)), _) => {
                    let change = height_change(&self.recent, node.time_s - before.time_s);
                    let heading_rad = before.heading_rad + filter.state[HEADING];
                    filter.cross(&before, &node, &reckoned, change);
                    let turned = Se2::rotation(heading_rad).product_by_right();
                    let noise = self.noises.last().copied().unwrap_or_default();
                    bridged = Some((before_gap, propagated(&turned, &reckoned.covariance) + noise));
                    self.has_bridged = true;
                }
                (Some(filter), None, Some(before)) => filter.follow(&before, &node),
                _ => self.filter = Some(Forward::new(&node)),
            }
            if let Some(filter) = &mut self.filter {
                filter.forget();
            }
            self.remember(frame, node);
        }
        let mut fused = frame.clone();
        if let (true, Some(filter), Some(known)) = (self.has_bridged, &self.filter, &mut fused.estimate) {
            moved_by(known, &node, &filter.present());
        }
        let fused_from_odometry = self.fused_from_odometry();
        FusedFrame { frame: fused, fused_from_odometry, bridged, distrusted: false }
    }

    fn remember(&mut self, frame: &FrameEstimate, node: MeasuredFrame) {
        self.agreed = None;
        let keeps = |earlier: &MeasuredFrame| {
            earlier.segment == node.segment && earlier.time_s >= node.time_s - RECENT_S
        };
        let forgotten = self.recent.iter().take_while(|earlier| !keeps(earlier)).count();
        self.recent.drain(..forgotten);
        self.noises.drain(..forgotten);
        self.recent.push(node);
        self.noises
            .push(frame.estimate.as_ref().map_or_else(Matrix3::zeros, |known| known.measured.covariance));
        self.last = Some(frame.clone());
    }

    fn fused_from_odometry(&self) -> Se2 {
        match (self.has_bridged, &self.filter, self.recent.last()) {
            (true, Some(filter), Some(node)) => {
                let turn_rad = filter.state[HEADING];
                let (dx, dy) = Se2::rotation(turn_rad).rotate(node.x_m, node.y_m);
                Se2::new(filter.state[X] - dx, filter.state[Y] - dy, turn_rad)
            }
            _ => Se2::new(0.0, 0.0, 0.0),
        }
    }

    fn lost(&mut self, frame: &FrameEstimate, sensors: &Sensors) -> FusedFrame {
        let was_distrusted = self.agreed == Some(false);
        let estimate = self.reckoned_pose(frame.time_s, sensors);
        FusedFrame {
            frame: FrameEstimate { estimate, ..frame.clone() },
            fused_from_odometry: self.fused_from_odometry(),
            bridged: None,
            distrusted: !was_distrusted && self.agreed == Some(false),
        }
    }

    fn reckoned_pose(&mut self, time_s: f64, sensors: &Sensors) -> Option<PoseEstimate> {
        let node = *self.recent.last()?;
        if time_s <= node.time_s || time_s - node.time_s > LONGEST_SHOWN_S {
            return None;
        }
        let (reckoned, rates) = self.reckon(sensors, time_s, true)?;
        let (filter, last) = (self.filter.as_ref()?, self.last.as_ref()?.estimate.as_ref()?);
        let start_rad = node.heading_rad + filter.state[HEADING];
        let start = Se2::rotation(start_rad);
        let (dx, dy) = start.rotate(reckoned.pose[X], reckoned.pose[Y]);
        let heading_rad = start_rad + reckoned.pose[HEADING];
        let present = filter.present();
        let own = present.covariance + self.noises.last()?;
        let covariance = propagated(&Se2::lever_arm(dx, dy), &own)
            + propagated(&start.product_by_right(), &reckoned.covariance);
        let (vx, vy) = Se2::rotation(heading_rad).rotate(rates[X], rates[Y]);
        let mut whole = last.covariance;
        whole.fixed_view_mut::<3, 3>(0, 0).copy_from(&covariance);
        whole.fixed_view_mut::<3, 3>(0, 3).fill(0.0);
        whole.fixed_view_mut::<3, 3>(3, 0).fill(0.0);
        let (x_m, y_m) = (filter.state[X] + dx, filter.state[Y] + dy);
        Some(PoseEstimate {
            pose: GroundPose { x_m, y_m, heading_rad, ..last.pose },
            velocity: Velocity { x_m_s: vx, y_m_s: vy, heading_rad_s: rates[HEADING] },
            covariance: whole,
            measured: PlaneMeasurement { x_m, y_m, heading_rad, covariance: Matrix3::zeros() },
        })
    }

    /// The motion since the newest measured frame, and the rates at its end. `None` if no sensor
    /// tells it or, where `both` wheel and heading are required, one of them does not.
    fn reckon(&mut self, sensors: &Sensors, to_s: f64, both: bool) -> Option<(ReckonedPose, BodyRates)> {
        let Self { calibration, recent, noises, agreed, .. } = self;
        let from_s = recent.last()?.time_s;
        let mut believed = calibration.believed(sensors);
        // A sensor that has been silent for long is left out; one that is late is waited for.
        let is_alive = |end_s: f64| end_s >= from_s && end_s >= to_s - LONGEST_DELAY_S;
        believed.gyro =
            believed.gyro.filter(|(record, known)| is_alive(end_s(record, known.offset.offset_s)));
        believed.wheel =
            believed.wheel.filter(|(record, known)| is_alive(end_s(record, known.offset.offset_s)));
        believed.heading =
            believed.heading.filter(|(record, known)| is_alive(end_s(record, known.offset.offset_s)));
        let turns = believed.gyro.is_some() || believed.heading.is_some();
        let moves = believed.wheel.is_some();
        if !(turns && moves) && (both || !(turns || moves)) {
            return None;
        }
        if !*agreed.get_or_insert_with(|| agrees(&believed, recent, noises)) {
            return None;
        }
        let steps = camera_motion::steps(recent);
        let [before, _] = bridge::rates_around(&steps, recent.len() - 1, None);
        let read_s = to_s.min(read_until_s(&believed));
        let gap = TrackingGap { from_s, to_s: read_s, before, after: before };
        let last_s = (read_s - LAST_RATES_S).max(from_s);
        let reckoned = believed.reckon(&gap, &[last_s])?;
        let [then, now] = reckoned.as_slice() else { return None };
        let rates = if read_s - last_s > 0.5 * LAST_RATES_S {
            let (dx, dy) = Se2::rotation(-then.pose[HEADING])
                .rotate(now.pose[X] - then.pose[X], now.pose[Y] - then.pose[Y]);
            Vector3::new(dx, dy, now.pose[HEADING] - then.pose[HEADING]) / (read_s - last_s)
        } else {
            before
        };
        // A gap in the readings leaves a sensor out, which `reckon` does by itself.
        let covers = |record: &SensorRecord, offset_s: f64| {
            record.between(0, from_s + offset_s, read_s + offset_s).is_some()
        };
        let has_wheel = believed.wheel.is_some_and(|(record, known)| covers(record, known.offset.offset_s));
        let has_turn = believed.gyro.is_some_and(|(record, known)| covers(record, known.offset.offset_s))
            || believed.heading.is_some_and(|(record, known)| covers(record, known.offset.offset_s));
        if both && !(has_wheel && has_turn) {
            return None;
        }
        Some((extrapolated(now, &rates, to_s - read_s), rates))
    }
}

/// When the readings of a record end, by the camera's clock.
fn end_s(record: &SensorRecord, offset_s: f64) -> f64 {
    record.span_s().1 - offset_s
}

/// Until when all the sensors have been read.
fn read_until_s(believed: &Believed<'_>) -> f64 {
    let Believed { gyro, heading, wheel } = believed;
    let heading = heading.filter(|_| gyro.is_none());
    let ends = [
        gyro.map(|(record, known)| end_s(record, known.offset.offset_s)),
        heading.map(|(record, known)| end_s(record, known.offset.offset_s)),
        wheel.map(|(record, known)| end_s(record, known.offset.offset_s)),
    ];
    ends.into_iter().flatten().fold(f64::INFINITY, f64::min)
}

/// Standard deviation of a carrier's acceleration, m/s² and rad/s²: that of firm braking.
const ACCELERATION: f64 = 2.0;

/// A dead-reckoned pose some time later, at constant rates. As in a gap without sensors, the
/// carrier may stop or go twice as fast, or start from rest, but not at once.
fn extrapolated(reckoned: &ReckonedPose, rates: &BodyRates, duration_s: f64) -> ReckonedPose {
    if duration_s <= 0.0 {
        return *reckoned;
    }
    let turn = rates[HEADING] * duration_s;
    let half_way = Se2::rotation(reckoned.pose[HEADING] + 0.5 * turn);
    let (dx, dy) = half_way.rotate(rates[X] * duration_s, rates[Y] * duration_s);
    let at_once = 0.5 * ACCELERATION * duration_s * duration_s;
    let path = ((0.5 * rates[X].hypot(rates[Y]) + 0.1) * duration_s).min(at_once);
    let turned = ((0.5 * rates[HEADING].abs() + 0.1) * duration_s).min(at_once);
    let own = Matrix3::from_diagonal(&Vector3::new(path * path, path * path, turned * turned));
    ReckonedPose {
        pose: reckoned.pose + Vector3::new(dx, dy, turn),
        covariance: propagated(&Se2::lever_arm(dx, dy), &reckoned.covariance) + own,
    }
}

/// Whether the sensors tell the motion that the camera saw in the last second. Without readings of
/// that time nothing speaks against them.
fn agrees(believed: &Believed<'_>, nodes: &[MeasuredFrame], noises: &[Matrix3<f64>]) -> bool {
    let read_s = read_until_s(believed);
    let Some(to) = nodes.iter().rposition(|node| node.time_s <= read_s) else { return true };
    let Some(from) = nodes[..to].iter().rposition(|node| node.time_s <= nodes[to].time_s - COMPARED_S) else {
        return true;
    };
    let steps = camera_motion::steps(&nodes[..=to]);
    let [before, after] = bridge::rates_around(&steps, to, None);
    let (a, b) = (&nodes[from], &nodes[to]);
    let gap = TrackingGap { from_s: a.time_s, to_s: b.time_s, before, after };
    let Some(reckoned) = believed.reckon(&gap, &[]) else { return true };
    let Some(end) = reckoned.last() else { return true };
    let seen = Se2::new(a.x_m, a.y_m, a.heading_rad).between(&Se2::new(b.x_m, b.y_m, b.heading_rad));
    let off = Vector3::new(seen.x_m, seen.y_m, b.heading_rad - a.heading_rad) - end.pose;
    let spread = end.covariance + noises[from] + noises[to];
    spread.try_inverse().is_none_or(|information| (off.transpose() * information * off)[0] <= WORST_NIS)
}
