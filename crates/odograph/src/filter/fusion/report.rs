//! Report on the calibration and acceptance of a sensor.

use super::calibration::{Calibrated, Sighted};
use super::estimator::Consistency;
use super::fit::TimeOffset;
use super::rejection::Reason;
use super::series::{Quantity, SensorRecord};
use serde::Serialize;
use std::fmt;

/// Kind of a sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum SensorKind {
    /// Gyroscope: turn rate.
    Gyro,
    /// Compass: heading.
    Heading,
    /// Wheel odometer: speed or distance.
    Wheel,
    /// Range finder: height.
    Range,
}

impl fmt::Display for SensorKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Gyro => "gyro",
            Self::Heading => "heading",
            Self::Wheel => "wheel",
            Self::Range => "range",
        })
    }
}

/// Estimated calibration parameter of a sensor.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SensorParameter {
    /// Name with its unit.
    pub name: &'static str,
    /// Estimated value.
    pub value: f64,
    /// Standard deviation.
    pub sigma: f64,
}

/// Calibration and acceptance of a sensor.
#[derive(Debug, Clone, PartialEq)]
pub struct SensorReport {
    /// Kind of the sensor.
    pub sensor: SensorKind,
    /// Why it was rejected; `None` if it was accepted.
    pub rejected: Option<Reason>,
    /// Clock offset relative to the camera.
    pub offset: Option<TimeOffset>,
    /// Scale, bias and mounting.
    pub parameters: Vec<SensorParameter>,
    /// Standard deviation of the noise, radians or metres: for rates of the integral over one
    /// second, for states of a reading averaged over one second.
    pub noise: Option<f64>,
    /// Number of seconds compared with the camera.
    pub seconds: usize,
    /// Number of seconds in which it contradicts the camera.
    pub contradictions: usize,
    /// Mean normalised innovation squared; about 1 if the noise is consistent.
    pub nis: Option<f64>,
}

impl SensorReport {
    pub(super) fn rejected(sensor: SensorKind, reason: Reason) -> Self {
        let (seconds, contradictions) = match reason {
            Reason::Contradicts { seconds, of } => (of, seconds),
            _ => (0, 0),
        };
        Self {
            sensor,
            rejected: Some(reason),
            offset: None,
            parameters: Vec::new(),
            noise: None,
            seconds,
            contradictions,
            nis: None,
        }
    }
}

fn parameter(name: &'static str, value: f64, variance: f64) -> SensorParameter {
    SensorParameter { name, value, sigma: variance.max(0.0).sqrt() }
}

fn calibrated_report(
    sensor: SensorKind,
    known: &Calibrated,
    parameters: Vec<SensorParameter>,
) -> SensorReport {
    SensorReport {
        sensor,
        rejected: None,
        offset: Some(known.offset),
        parameters,
        noise: Some(known.density.sqrt()),
        seconds: known.seconds,
        contradictions: known.contradictions,
        nis: Some(known.nis),
    }
}

/// Report on an accepted gyroscope.
pub(super) fn gyro_report(known: &Calibrated, record: Option<&SensorRecord>) -> SensorReport {
    let (p, c) = (&known.parameters, &known.covariance);
    let mut parameters = match record.map(SensorRecord::quantity) {
        Some(Quantity::TurnRates) => ["axis_x", "axis_y", "axis_z"]
            .iter()
            .enumerate()
            .map(|(i, name)| parameter(name, p[i], c[(i, i)]))
            .collect(),
        _ => vec![parameter("scale", p[0], c[(0, 0)])],
    };
    parameters.push(parameter("bias_rad_s", p[3], c[(3, 3)]));
    calibrated_report(SensorKind::Gyro, known, parameters)
}

/// Report on an accepted wheel.
pub(super) fn wheel_report(known: &Calibrated) -> SensorReport {
    let (p, c) = (&known.parameters, &known.covariance);
    let scale = p[0].hypot(p[1]);
    let along =
        (p[0] * p[0] * c[(0, 0)] + 2.0 * p[0] * p[1] * c[(0, 1)] + p[1] * p[1] * c[(1, 1)]) / (scale * scale);
    let across =
        (p[1] * p[1] * c[(0, 0)] - 2.0 * p[0] * p[1] * c[(0, 1)] + p[0] * p[0] * c[(1, 1)]) / (scale * scale);
    let parameters = vec![
        parameter("scale", scale, along),
        parameter("direction_rad", p[1].atan2(p[0]), across / (scale * scale)),
        parameter("camera_ahead_m", p[2], c[(2, 2)]),
        parameter("camera_left_m", p[3], c[(3, 3)]),
    ];
    calibrated_report(SensorKind::Wheel, known, parameters)
}

/// Report on an accepted compass or range finder; `zero` is its bias with variance.
pub(super) fn sighted_report(
    sensor: SensorKind,
    zero_name: &'static str,
    known: &Sighted,
    zero: Option<((f64, f64), Consistency)>,
) -> SensorReport {
    let (parameters, consistency) = match zero {
        Some(((value, variance), consistency)) => (vec![parameter(zero_name, value, variance)], consistency),
        None => (Vec::new(), Consistency::default()),
    };
    SensorReport {
        sensor,
        rejected: None,
        offset: Some(known.offset),
        parameters,
        noise: Some(known.sigma),
        seconds: known.sights.len(),
        contradictions: consistency.contradictions,
        nis: consistency.nis(),
    }
}
