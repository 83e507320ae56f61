//! From views of a board to a camera: Zhang's start, then everything adjusted together.

mod quality;
mod result;

pub use result::{
    BoardPose, BoardShape, CalibratedView, Calibration, CalibrationConfig, Candidate, LensModel, Parameter,
    Verdict,
};

use super::{Board, BoardView};
use crate::camera::Camera;
use crate::error::{Error, Result};

/// The camera that saw `views` of `board`.
///
/// Fails, with what to do, where the views cannot tell: too few, all the same, of different sizes, mirrored, or with numbers
/// that are none.
pub fn calibrate(_board: &Board, _views: &[BoardView], _config: &CalibrationConfig) -> Result<Calibration> {
    Err(Error::usage("calibration is not built yet"))
}

/// Where the board is in front of a calibrated camera, from one view.
///
/// Fails where fewer than four points off one line are seen, or the view is not one of this board by this camera.
pub fn board_pose(_camera: &Camera, _board: &Board, _view: &BoardView) -> Result<BoardPose> {
    Err(Error::usage("poses are not built yet"))
}
