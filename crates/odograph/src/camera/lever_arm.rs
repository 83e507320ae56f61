//! Where the camera is on the robot.

use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// Lever arm: position of the camera centre in the robot's frame `base_link` (ROS REP-103 and
/// REP-105), metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LeverArm {
    /// Forward.
    pub x_m: f64,
    /// To the left.
    pub y_m: f64,
    /// Up. `base_link` is (height − z) above the ground.
    pub z_m: f64,
}

impl LeverArm {
    /// Greatest distance along an axis that is accepted, metres: more than the length of a lorry.
    pub const GREATEST_M: f64 = 30.0;

    /// Checks the lever arm. Fails if a number is not finite or beyond [`LeverArm::GREATEST_M`].
    pub fn validated(self) -> Result<Self> {
        for (axis, value_m) in [("x", self.x_m), ("y", self.y_m), ("z", self.z_m)] {
            if !value_m.is_finite() {
                return Err(Error::usage(format!("the lever arm's {axis} is {value_m}; it must be finite")));
            }
            if value_m.abs() > Self::GREATEST_M {
                return Err(Error::usage(format!(
                    "the lever arm's {axis} is {value_m:?} m; no camera is {} m from its base_link, are other units meant?",
                    Self::GREATEST_M
                )));
            }
        }
        Ok(self)
    }
}
