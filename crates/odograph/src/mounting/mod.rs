//! How the camera sits on its carrier, measured: a [`crate::camera::Rig`] with its uncertainty, from views of a board that lies on the
//! floor ([`rig_from_boards`]) or from driving about on it ([`DrivenTilt`]).
//!
//! Signs and units are those of [`crate::camera::Rig`]: height of the camera centre above the floor in metres, roll and pitch against
//! straight down in radians about the image's own axes (roll about the direction that is up in the image, positive with the image's left
//! side raised; pitch about the direction that is left, positive when the camera looks backwards), mount yaw from the carrier's forward to
//! the top of the image, counter-clockwise seen from above.

mod board;
mod combination;
mod driving;
mod reprojection;
mod uncertainty;

pub use board::{BoardDirection, BoardMounting, FloorBoard, MountingView, ambiguity_turns, rig_from_boards};
pub use driving::{
    DrivenTilt, DrivingConfig, Found, LensCoefficient, LensMeasurement, ReadoutMeasurement, Revealed,
    SelfCalibration, TiltMeasurement, Untold,
};
pub use uncertainty::{CameraUncertainty, MeasuredRig, RigDeviations};
