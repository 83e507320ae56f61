//! Camera calibration: views of a known board in, a [`crate::camera::Camera`] with its uncertainty out.
//!
//! [`Board`] says where a board's points are, in metres. A finder turns an image into a [`BoardView`]: which of the points
//! were seen, and at which pixels. [`calibrate`] turns views into a [`Calibration`], and [`board_pose`] says where a board is in
//! front of a known camera.

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
