//! Self-calibration of the camera's mounting from driving: a [`crate::camera::Rig`] with its
//! uncertainty, from the motion between keyframes ([`DrivenTilt`]).
//!
//! Signs and units are those of [`crate::camera::Rig`]: height of the camera centre above the floor
//! in metres; roll and pitch against straight down in radians, about the axes of the image (roll
//! about the direction that is up in the image, positive with the left side of the image raised;
//! pitch about the direction that is left, positive when the camera looks backwards); mount yaw
//! from the carrier's forward to the top of the image, counter-clockwise seen from above.

mod driving;

pub use driving::{
    CalibrationMonitor, CalibrationUpdate, DrivenTilt, DrivingConfig, LensCoefficient, LensMeasurement,
    Observability, OnlineCalibration, SelfCalibration, TiltMeasurement,
};
