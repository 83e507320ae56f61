//! The data of a map: keyframes and the edges between them.
//!
//! Plain values: mapping, place recognition and storage import them from here.

use super::places::Signature;
use crate::camera::{Camera, Rig};
use crate::error::Result;
use crate::geometry::{GroundPose, Sim2};
use crate::image::{GrayImage, RgbImage};
use nalgebra::{Matrix4, Matrix6, Vector4};

/// Number of a keyframe in its map: from 0 in order of creation, never reused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct KeyframeId(pub u64);

/// A frame whose image is part of the map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapKeyframe {
    /// Its number.
    pub id: KeyframeId,
    /// The session it comes from, from 0.
    pub session: u32,
    /// Number of gaps before it in its session.
    pub segment: usize,
    /// Number of its frame in the source.
    pub frame: u64,
    /// Its time, seconds, from the source.
    pub time_s: f64,
    /// Pose in the odometry frame of its session, which never jumps.
    pub odometry_pose: GroundPose,
    /// Pose in the map frame, after loop closure.
    pub pose: GroundPose,
    /// Covariance of `pose`: (x, y, heading, height, roll, pitch), metres and radians.
    pub covariance: Matrix6<f64>,
    /// Appearance for place recognition.
    pub signature: Signature,
}

impl MapKeyframe {
    /// The transform of poses near it from the odometry frame to the map frame.
    pub fn map_from_odometry(&self) -> Sim2 {
        self.odometry_pose.similarity_to(&self.pose)
    }
}

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

/// A map without its images: enough to localize in it.
#[derive(Debug, Clone, PartialEq)]
pub struct GroundMap {
    /// The camera that every keyframe was taken with.
    pub camera: Camera,
    /// Its mount at the start of the first session.
    pub rig: Rig,
    /// The keyframes in order of their numbers; a thinned map lacks some numbers.
    pub keyframes: Vec<MapKeyframe>,
    /// The edges in order of their creation.
    pub edges: Vec<MapEdge>,
}

/// A keyframe's image.
#[derive(Debug, Clone, PartialEq)]
pub struct KeyframeImage {
    /// Luminance, used for all measurements.
    pub gray: GrayImage,
    /// Colour for the mosaic, if the source has it.
    pub color: Option<RgbImage>,
}

/// Access to the images of a map, in memory or in the map file.
pub trait KeyframeImages {
    /// The image of a keyframe. Fails if there is none or it cannot be read.
    fn load(&mut self, keyframe: KeyframeId) -> Result<KeyframeImage>;
}
