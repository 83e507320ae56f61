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
    /// The sensor contradicts the camera.
    Contradicts {
        /// Number of seconds with a contradiction.
        seconds: usize,
        /// Number of seconds compared.
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
