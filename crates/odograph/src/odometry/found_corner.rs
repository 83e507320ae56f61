//! A keyframe's corner found again in a frame.

use crate::buffer::stored;
use crate::flow::Warp;
use nalgebra::Matrix2;

/// A corner found again.
#[derive(Debug, Clone, Copy)]
pub struct FoundCorner {
    /// Which of the keyframe's corners.
    pub corner: usize,
    pub warp: Warp,
    /// Of the position, from the noise of the samples, pixels².
    pub covariance_px2: Matrix2<f64>,
}

stored!(FoundCorner);
