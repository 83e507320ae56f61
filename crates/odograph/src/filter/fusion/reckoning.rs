//! Dead reckoning with the other sensors while the camera is lost.

use super::calibration::{Calibrated, Sighted};
use super::series::{Quantity, SensorRecord};
use crate::geometry::pose_index::HEADING;
use crate::geometry::{PlaneTransform, Se2, propagated};
use nalgebra::{Matrix3, SMatrix, Vector3};

/// Sensors that were accepted.
#[derive(Debug, Clone, Copy, Default)]
pub struct Believed<'a> {
    pub gyro: Option<(&'a SensorRecord, &'a Calibrated)>,
    pub heading: Option<(&'a SensorRecord, &'a Sighted)>,
    pub wheel: Option<(&'a SensorRecord, &'a Calibrated)>,
}

/// Velocity in the camera's frame: forward and left, metres per second, and heading rate, radians
/// per second.
pub type BodyRates = Vector3<f64>;

/// A tracking gap: its times, and the camera's velocity before and after it.
#[derive(Debug, Clone, Copy)]
pub struct TrackingGap {
    pub from_s: f64,
    pub to_s: f64,
    pub before: BodyRates,
    pub after: BodyRates,
}

/// Dead-reckoned pose relative to the camera at the start of the gap: forward, left (metres) and
/// heading (radians), with its covariance.
#[derive(Debug, Clone, Copy)]
pub struct ReckonedPose {
    pub pose: Vector3<f64>,
    pub covariance: Matrix3<f64>,
}

/// Integration step, seconds: at 6 rad/s, the curvature within a step changes the path length by
/// less than 1e-4.
const STEP_S: f64 = 0.01;

/// Longest gap that is dead-reckoned, seconds: bounds the work for a recording with a pause.
const LONGEST_S: f64 = 600.0;

/// Jacobian of the pose with respect to the calibration parameters of both sensors: scale factors
/// (3) and bias of the gyroscope, then the four of the wheel.
type Jacobian = SMatrix<f64, 3, 8>;

/// Uncertainty of a dead-reckoned path.
struct ReckoningNoise {
    /// Covariance of the parameters of [`Jacobian`].
    parameters: SMatrix<f64, 8, 8>,
    /// Covariance of the pose that does not grow with time.
    constant: Matrix3<f64>,
    /// Variance of (forward, left, heading) per second.
    density: Vector3<f64>,
}

impl<'a> Believed<'a> {
    /// Dead-reckoned poses at `times_s` (increasing, within the gap) and at its end. `None` if no
    /// sensor covers the gap.
    ///
    /// Velocities that no sensor measures are interpolated between those before and after the gap.
    /// Their uncertainty allows a stop or twice the speed in between, or 0.2 m/s and 0.2 rad/s from
    /// rest (two standard deviations).
    pub fn reckon(&self, gap: &TrackingGap, times_s: &[f64]) -> Option<Vec<ReckonedPose>> {
        let (from_s, to_s) = (gap.from_s, gap.to_s);
        if to_s - from_s > LONGEST_S {
            return None;
        }
        let sensors = self.covering(gap)?;
        let ReckoningNoise { parameters, constant: mut noise, density } = sensors.noise(gap);
        let mut pose = Vector3::<f64>::zeros();
        let mut jacobian = Jacobian::zeros();
        let mut now_s = from_s;
        let mut reckoned = Vec::with_capacity(times_s.len() + 1);
        for &time_s in times_s.iter().chain([&to_s]) {
            let count = ((time_s - now_s) / STEP_S).ceil().max(0.0) as usize;
            let start_s = now_s;
            for i in 0..count {
                let next_s = start_s + (time_s - start_s) * (i + 1) as f64 / count as f64;
                let share = (0.5 * (now_s + next_s) - from_s) / (to_s - from_s);
                let rates = gap.before + share * (gap.after - gap.before);
                let mut by_parameters = Jacobian::zeros();
                let turn = sensors.turn((now_s, next_s), &rates, &mut by_parameters)?;
                let (ahead, left) = sensors.advance((now_s, next_s), &rates, turn, &mut by_parameters)?;
                let half_way = Se2::rotation(pose[HEADING] + 0.5 * turn);
                let (dx, dy) = half_way.rotate(ahead, left);
                let carry = Se2::lever_arm(dx, dy);
                // Midpoint rule: half of the heading error acts on the direction of this step.
                let turned = Se2::lever_arm(0.5 * dx, 0.5 * dy) * half_way.product_by_right();
                let own = Matrix3::from_diagonal(&density) * (next_s - now_s);
                noise = propagated(&carry, &noise) + propagated(&turned, &own);
                jacobian = carry * jacobian + turned * by_parameters;
                pose += Vector3::new(dx, dy, turn);
                now_s = next_s;
            }
            reckoned.push(ReckonedPose { pose, covariance: noise + propagated(&jacobian, &parameters) });
        }
        Some(reckoned)
    }

    /// The sensors that cover a gap; a compass only without a gyroscope. `None` if none does.
    fn covering(&self, gap: &TrackingGap) -> Option<Believed<'a>> {
        let covers = |record: &SensorRecord, offset_s: f64| {
            record.between(0, gap.from_s + offset_s, gap.to_s + offset_s).is_some()
        };
        let gyro = self.gyro.filter(|(record, known)| covers(record, known.offset.offset_s));
        let wheel = self.wheel.filter(|(record, known)| covers(record, known.offset.offset_s));
        let heading =
            self.heading.filter(|(record, known)| gyro.is_none() && covers(record, known.offset.offset_s));
        (gyro.is_some() || wheel.is_some() || heading.is_some()).then_some(Self { gyro, heading, wheel })
    }

    fn noise(&self, gap: &TrackingGap) -> ReckoningNoise {
        let mut parameters = SMatrix::<f64, 8, 8>::zeros();
        let (mut turn_density, mut path_density) = (0.0, 0.0);
        let mut constant = Matrix3::zeros();
        let fastest = |axis: usize| gap.before[axis].abs().max(gap.after[axis].abs());
        match (self.gyro, self.heading) {
            (Some((_, known)), _) => {
                parameters.fixed_view_mut::<4, 4>(0, 0).copy_from(&known.covariance);
                turn_density = known.density;
            }
            (None, Some((_, known))) => constant[(2, 2)] = 2.0 * known.single,
            (None, None) => parameters[(3, 3)] = (0.5 * fastest(2) + 0.1).powi(2),
        }
        match self.wheel {
            Some((_, known)) => {
                parameters.fixed_view_mut::<4, 4>(4, 4).copy_from(&known.covariance);
                path_density = known.density;
            }
            None => {
                let variance = (0.5 * fastest(0).hypot(fastest(1)) + 0.1).powi(2);
                parameters[(4, 4)] = variance;
                parameters[(5, 5)] = variance;
            }
        }
        let density = Vector3::new(path_density, path_density, turn_density);
        ReckoningNoise { parameters, constant, density }
    }

    /// Change of heading within a step, radians. `None` where the sensor has a gap of its own.
    fn turn(
        &self,
        (from_s, to_s): (f64, f64),
        rates: &BodyRates,
        by_parameters: &mut Jacobian,
    ) -> Option<f64> {
        let duration_s = to_s - from_s;
        Some(match (self.gyro, self.heading) {
            (Some((record, known)), _) => {
                let offset_s = known.offset.offset_s;
                let channels = if record.quantity() == Quantity::TurnRates { 3 } else { 1 };
                let mut turn = -known.parameters[3] * duration_s;
                by_parameters[(2, 3)] = -duration_s;
                for channel in 0..channels {
                    let angle = record.between(channel, from_s + offset_s, to_s + offset_s)?;
                    by_parameters[(2, channel)] = angle;
                    turn += known.parameters[channel] * angle;
                }
                turn
            }
            (None, Some((record, known))) => {
                let offset_s = known.offset.offset_s;
                record.at(0, to_s + offset_s)? - record.at(0, from_s + offset_s)?
            }
            (None, None) => {
                by_parameters[(2, 3)] = -duration_s;
                rates[2] * duration_s
            }
        })
    }

    /// Displacement forward and to the left within a step that turns by `turn`, metres. `None`
    /// where the sensor has a gap of its own.
    fn advance(
        &self,
        (from_s, to_s): (f64, f64),
        rates: &BodyRates,
        turn: f64,
        by_parameters: &mut Jacobian,
    ) -> Option<(f64, f64)> {
        let duration_s = to_s - from_s;
        Some(match self.wheel {
            Some((record, known)) => {
                let offset_s = known.offset.offset_s;
                let distance = record.between(0, from_s + offset_s, to_s + offset_s)?;
                let p = &known.parameters;
                by_parameters[(0, 4)] = distance;
                by_parameters[(0, 7)] = -turn;
                by_parameters[(1, 5)] = distance;
                by_parameters[(1, 6)] = turn;
                (p[0] * distance - p[3] * turn, p[1] * distance + p[2] * turn)
            }
            None => {
                by_parameters[(0, 4)] = duration_s;
                by_parameters[(1, 5)] = duration_s;
                (rates[0] * duration_s, rates[1] * duration_s)
            }
        })
    }
}
