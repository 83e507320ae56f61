//! Keyframe numbers, and the measured poses of keyframes relative to each other.

use nalgebra::{Matrix4, Vector4};

/// Number of a keyframe in its map: from 0 in order of creation, never reused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct KeyframeId(pub u64);

/// The origin of an edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum EdgeKind {
    /// Measured by odometry as the camera moved on.
    Odometry,
    /// Extrapolated across a gap without measurements.
    Gap,
    /// Measured when the ground was seen again.
    Loop,
}

/// The measured pose of one keyframe in the frame of another.
///
/// A plane seen from an unknown height is known up to scale, so this is a motion in Sim(2): (x, y)
/// in metres in the frame of `from` (x up in its image, y left, at `from`'s height), heading in
/// radians, and the natural logarithm of the ratio of heights.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapEdge {
    /// The reference keyframe.
    pub from: KeyframeId,
    /// The keyframe whose pose was measured.
    pub to: KeyframeId,
    /// Its origin.
    pub kind: EdgeKind,
    /// (x, y, heading, ln(height of `to` / height of `from`)); metres as they are when `from` is at
    /// the height of its `odometry_pose`.
    pub motion: Vector4<f64>,
    /// Covariance of `motion`. If the rig holds the height, its last row and column are zero.
    pub covariance: Matrix4<f64>,
}
