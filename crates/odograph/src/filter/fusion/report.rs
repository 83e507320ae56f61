//! What became of a sensor.

use super::fit::TimeOffset;
use serde::Serialize;
use std::fmt;

/// The kinds of sensors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum SensorKind {
    /// Rate of turn.
    Gyro,
    /// Direction.
    Heading,
    /// Speed or way.
    Wheel,
    /// Height.
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

/// Why a sensor was not used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Reason {
    /// Its times and those of the frames with a pose have less than two seconds in common.
    NoOverlap,
    /// The camera turned too little to find how its axes lie.
    TooLittleTurning,
    /// The camera moved too little to find its scale.
    TooLittleMovement,
    /// It says other than the camera.
    Contradicts {
        /// In so many seconds …
        seconds: usize,
        /// … of so many.
        of: usize,
    },
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoOverlap => f.write_str(
                "its times and those of the frames with a pose have less than two seconds in common; its clock must count from the same \
                 moment as the recording's, to within a second",
            ),
            Self::TooLittleTurning => f.write_str("the camera turned too little to find how its axes are mounted"),
            Self::TooLittleMovement => f.write_str("the camera moved too little to find its scale"),
            Self::Contradicts { seconds, of } => {
                write!(f, "it contradicts what the camera saw in {seconds} of {of} seconds")
            }
        }
    }
}

/// A number that was found about a sensor.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SensorParameter {
    /// What it is, with its unit.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// One standard deviation.
    pub sigma: f64,
}

/// What became of a sensor.
#[derive(Debug, Clone, PartialEq)]
pub struct SensorReport {
    /// Which one.
    pub sensor: SensorKind,
    /// Why it was not used, if it was not.
    pub rejected: Option<Reason>,
    /// How far its clock is ahead.
    pub offset: Option<TimeOffset>,
    /// Scale, bias and mounting.
    pub parameters: Vec<SensorParameter>,
    /// Its noise: of rates the standard deviation of their integral over one second, of states that of a second's reading; radians or metres.
    pub noise: Option<f64>,
    /// Seconds in which it was compared with the camera.
    pub seconds: usize,
    /// In how many of them it says other than the camera.
    pub contradictions: usize,
    /// Mean normalised innovation squared; about 1 for an honest sensor.
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
