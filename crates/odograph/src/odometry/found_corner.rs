//! The corners of a keyframe found again in a frame.

use crate::buffer::{Buffer, stored};
use crate::flow::Warp;
use crate::geometry::GroundPose;
use nalgebra::Matrix2;

/// A corner found again.
#[derive(Debug, Clone, Copy)]
pub struct FoundCorner {
    /// Which of the keyframe's corners.
    pub corner: usize,
    pub warp: Warp,
    /// Of the position, from the noise of the samples, pixels².
    pub covariance_px2: Matrix2<f64>,
    /// Part of the patch's contrast that the keyframe does not explain, 0 to 1.
    pub dissimilarity: f32,
}

stored!(FoundCorner);

/// The corners found again, and the pose that the probe corners agreed on.
pub struct FoundCorners {
    pub found: Buffer<FoundCorner>,
    pub probe_pose: Option<GroundPose>,
}
