//! Camera calibration from views of a known board: a [`crate::camera::Camera`] with its covariance.
//!
//! [`Board`] defines the positions of a board's points, in metres. A [`BoardFinder`] detects the
//! board in an image and returns a [`BoardView`]: the indices of the detected points and their
//! pixels. [`calibrate`] estimates the camera from many views and returns a [`Calibration`].
//! [`board_pose`] estimates the pose of a board relative to a calibrated camera from one view.

mod board;
mod dictionary;
mod drawing;
mod finder;
pub mod selection;
mod solver;

pub use board::{Board, BoardKind, BoardPoint, BoardView, Dictionary, SeenPoint};
pub use drawing::{Drawing, Rectangle, Shape};
pub use finder::{BoardFinder, NotFound};
pub use solver::{
    BoardPose, BoardShape, CalibratedView, Calibration, CalibrationConfig, Candidate, LensModel, Parameter,
    Verdict, board_pose, calibrate,
};
