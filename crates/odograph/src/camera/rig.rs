//! The mounting of the camera on its carrier.

use super::LeverArm;
use crate::error::{Error, Result};
use crate::geometry::GroundPose;
use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// Mounting (extrinsics) of the camera on its carrier over flat ground.
///
/// The angles are those of [`GroundPose`]: roll about the carrier's forward axis and pitch about
/// its left axis, both right-handed and 0 for a nadir-looking camera. With `yaw_rad` = 0 the top of
/// the image points forward.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rig {
    /// Height of the camera centre above the ground, metres.
    pub height_m: f64,
    /// Roll, 0 for a nadir-looking camera, radians.
    #[serde(default)]
    pub roll_rad: f64,
    /// Pitch, 0 for a nadir-looking camera, radians.
    #[serde(default)]
    pub pitch_rad: f64,
    /// Mount yaw: direction of the top of the image, counter-clockwise from the carrier's forward
    /// axis, radians.
    #[serde(default)]
    pub yaw_rad: f64,
    /// Position of the camera centre on the robot, where it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lever_arm: Option<LeverArm>,
}

impl Rig {
    /// A nadir-looking camera at `height_m` with the top of its image forward.
    pub fn level(height_m: f64) -> Self {
        Self { height_m, roll_rad: 0.0, pitch_rad: 0.0, yaw_rad: 0.0, lever_arm: None }
    }

    /// Heights above the ground that are accepted, metres: from a microscope to an aeroplane.
    pub const HEIGHTS_M: RangeInclusive<f64> = 1e-6..=1e4;

    /// Cosine of the steepest tilt that is accepted, 75.5°. Beyond it a common lens sees more sky
    /// than ground, and driving does not correct a wrong tilt: on a rendered drive straight down it
    /// did from 75°, and from 78° the path had a third of its length.
    const MIN_TILT_COSINE: f64 = 0.25;

    /// Checks the mounting. Fails if a number is not finite, the height is not within
    /// [`Self::HEIGHTS_M`], the camera does not look at the ground, or the lever arm is longer than
    /// [`LeverArm::GREATEST_M`].
    pub fn validated(self) -> Result<Self> {
        let Self { height_m, roll_rad, pitch_rad, yaw_rad, lever_arm } = self;
        if !Self::HEIGHTS_M.contains(&height_m) {
            let expected = match height_m < 0.0 {
                true => "it is measured from the ground up to the camera, so write it without the sign",
                false => "a camera above the ground is between 1 µm and 10 km high",
            };
            return Err(Error::usage(format!("the height is {} m; {expected}", readable(height_m))));
        }
        for (name, value) in [("roll", roll_rad), ("pitch", pitch_rad), ("yaw", yaw_rad)] {
            if !value.is_finite() {
                return Err(Error::usage(format!("the rig's {name} is {value}; it must be finite")));
            }
        }
        if roll_rad.cos() * pitch_rad.cos() < Self::MIN_TILT_COSINE
            || roll_rad.abs() > 1.6
            || pitch_rad.abs() > 1.6
        {
            return Err(Error::usage(format!(
                "a rig with roll {}° and pitch {}° does not look at the ground; angles count from straight down",
                readable((10.0 * roll_rad.to_degrees()).round() / 10.0),
                readable((10.0 * pitch_rad.to_degrees()).round() / 10.0)
            )));
        }
        lever_arm.map(LeverArm::validated).transpose()?;
        Ok(self)
    }

    /// Pose of the camera in `base_link`, where the lever arm is known: the axes of a level robot,
    /// x forward, y left, z up.
    pub fn base_from_camera(&self) -> Option<Isometry3<f64>> {
        let LeverArm { x_m, y_m, z_m } = self.lever_arm?;
        let on_robot = GroundPose {
            x_m,
            y_m,
            heading_rad: self.yaw_rad,
            height_m: z_m,
            roll_rad: self.roll_rad,
            pitch_rad: self.pitch_rad,
        };
        Some(on_robot.world_from_camera())
    }

    /// Initial pose of a run: above the world's origin, with the top of the image along world x.
    pub fn first_pose(&self) -> GroundPose {
        GroundPose {
            x_m: 0.0,
            y_m: 0.0,
            heading_rad: 0.0,
            height_m: self.height_m,
            roll_rad: self.roll_rad,
            pitch_rad: self.pitch_rad,
        }
    }
}

/// A number without hundreds of zeros.
fn readable(value: f64) -> String {
    let size = value.abs();
    let usual = size == 0.0 || !size.is_finite() || (1e-3..1e7).contains(&size);
    if usual { value.to_string() } else { format!("{value:.1e}") }
}
