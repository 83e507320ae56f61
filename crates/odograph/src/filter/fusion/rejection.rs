//! Why a sensor is not used.

use std::fmt;

/// Why a sensor was rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Reason {
    /// Less than two seconds of temporal overlap between the record and the frames with a pose.
    NoOverlap,
    /// The camera turned too little to determine the orientation of the axes.
    TooLittleTurning,
    /// The camera moved too little to determine the scale.
    TooLittleMovement,
    /// The sensor agrees with the camera but for its scale.
    Scale {
        /// Its readings relative to what the camera saw, per cent.
        percent: u32,
    },
    /// The sensor contradicts the camera.
    Contradicts {
        /// Number of seconds with a contradiction.
        seconds: usize,
        /// Number of seconds compared.
        of: usize,
    },
}

/// Factors by which rates in degrees look too large: 57.3, and what noise makes of it.
const DEGREES_TIMES_LEAST: f64 = 45.0;
const DEGREES_TIMES_MOST: f64 = 70.0;

/// Seconds of comparison from which a contradiction is one of the sensor, and not of a start.
const ENOUGH_SECONDS: usize = 5;

impl Reason {
    /// Whether too little of a drive was compared, so that more of it may say something else.
    pub fn is_preliminary(&self) -> bool {
        match self {
            Self::NoOverlap | Self::TooLittleTurning | Self::TooLittleMovement => true,
            Self::Contradicts { of, .. } => *of < ENOUGH_SECONDS,
            Self::Scale { .. } => false,
        }
    }
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
            Self::Scale { percent } => {
                let times = f64::from(*percent) / 100.0;
                write!(f, "its rates are about {times:.2} times those that the camera saw; ")?;
                f.write_str(match times {
                    DEGREES_TIMES_LEAST..DEGREES_TIMES_MOST => {
                        "they seem to be degrees per second: name their columns …_deg_s"
                    }
                    _ => "check the unit of its rates and its scale factor",
                })
            }
            Self::Contradicts { seconds, of } => {
                write!(f, "it contradicts what the camera saw in {seconds} of {of} seconds")
            }
        }
    }
}
