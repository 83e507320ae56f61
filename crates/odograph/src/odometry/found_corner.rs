//! A keyframe's corner found again in a frame.

use crate::buffer::stored;
use crate::flow::{Noise, Warp};
use nalgebra::Matrix2;

/// A corner found again.
#[derive(Debug, Clone, Copy)]
pub struct FoundCorner {
    /// Which of the keyframe's corners.
    pub corner: usize,
    pub warp: Warp,
    /// Of the position, from the noise of the samples, pixels².
    pub covariance_px2: Matrix2<f64>,
    /// Logarithm of its brightness over that of its first appearance.
    pub light: f64,
    pub noise: Noise,
}

stored!(FoundCorner);
