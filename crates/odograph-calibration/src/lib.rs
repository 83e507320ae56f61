//! # odograph-calibration
//!
//! Camera calibration from views of a known board: a [`odograph::camera::Camera`] with its
//! covariance, and how it is mounted over the floor.
//!
//! [`Board`] defines the positions of a board's points, in metres. A [`BoardFinder`] detects the
//! board in an image and returns a [`BoardView`]: the indices of the detected points and their
//! pixels. [`calibrate`] estimates the camera from many views and returns a [`Calibration`].
//! [`rig_from_boards`] estimates height and tilt of the camera from a board that lies on the floor,
//! and [`calibration_file`] writes a calibration down.
//!
//! A [`MarkerFinder`] finds single markers of a [`MarkerFamily`], such as those on a floor.

#[cfg(test)]
mod test_random;
mod dictionary;
mod board;
mod marker_family;
mod drawing;
mod finder;
mod solver;
pub mod selection;
mod extrinsics;
pub mod calibration_file;

pub use board::{Board, BoardKind, BoardPoint, BoardView, Dictionary, SeenPoint};
pub use drawing::{Drawing, Rectangle, Shape};
pub use extrinsics::{
    BoardDirection, BoardMounting, FloorBoard, MountingView, ambiguity_turns, rig_from_boards,
};
pub use finder::{BoardFinder, MarkerFinder, NotFound, SeenInstead, SeenMarker, nothing_found, seen_instead};
pub use marker_family::MarkerFamily;
pub use solver::{
    BendEvidence, BoardShape, CalibratedView, Calibration, CalibrationConfig, LensModel, ModelComparison,
    Parameter, Verdict, calibrate,
};
