//! Camera calibration: views of a known board in, a [`crate::camera::Camera`] with its uncertainty out.
//!
//! [`Board`] says where a board's points are, in metres. A finder turns an image into a [`BoardView`]: which of the points
//! were seen, and at which pixels.

mod board;
pub mod selection;

pub use board::{Board, BoardKind, BoardPoint, BoardView, Dictionary, SeenPoint};
