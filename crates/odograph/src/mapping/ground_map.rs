//! The ground that is remembered: keyframes, how each lies to others, and the numbers that tie them.
//!
//! These are values, no more: who makes them, who finds places in them and who puts them on disk import them from here.

use super::places::Signature;
use crate::camera::{Camera, Rig};
use crate::error::Result;
use crate::geometry::{GroundPose, Sim2};
use crate::image::{GrayImage, RgbImage};
use nalgebra::{Matrix4, Matrix6, Vector4};

/// Number of a keyframe in its map: from 0 in the order in which they were made, never given twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct KeyframeId(pub u64);

/// A frame whose image is part of the map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapKeyframe {
    /// Its number.
    pub id: KeyframeId,
    /// Which of the runs that made the map it comes from, from 0.
    pub session: u32,
    /// Number of gaps before it in its run.
    pub segment: usize,
    /// Number of its frame in the source.
    pub frame: u64,
    /// Its time, seconds, from the source.
    pub time_s: f64,
    /// Where odometry put it: the odometry frame of its session, which never jumps.
    pub odometry_pose: GroundPose,
    /// Where it is, after all loops: the map frame.
    pub pose: GroundPose,
    /// Covariance of `pose`: (x, y, heading, height, roll, pitch), metres and radians.
    pub covariance: Matrix6<f64>,
    /// What it is recognised by.
    pub signature: Signature,
}

impl MapKeyframe {
    /// Takes poses near it from the odometry frame to the map frame.
    pub fn map_from_odometry(&self) -> Sim2 {
        self.odometry_pose.similarity_to(&self.pose)
    }
}

/// How two keyframes came to be tied.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum EdgeKind {
    /// One was measured against the other as the camera went on.
    Odometry,
    /// Between them nothing was measured; where the other lies is extrapolated.
    Gap,
    /// The ground was seen again, and measured.
    Loop,
}

/// The pose of one keyframe as another sees it.
///
/// A plane seen with its height unknown is known up to scale, so this is a motion of Sim(2): (x, y) in metres in the frame of `from`
/// (x up in its image, y left, at `from`'s height), heading in radians, and the natural logarithm of the ratio of heights.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapEdge {
    /// The keyframe that sees.
    pub from: KeyframeId,
    /// The keyframe that is seen.
    pub to: KeyframeId,
    /// How it was found.
    pub kind: EdgeKind,
    /// (x, y, heading, ln(height of `to` / height of `from`)); metres as they are when `from` is at the height of its `odometry_pose`.
    pub motion: Vector4<f64>,
    /// Covariance of `motion`. Where the rig holds the height fixed its last row and column are zero.
    pub covariance: Matrix4<f64>,
}

/// A map without its images: all that is needed to know where everything is and to recognise it.
#[derive(Debug, Clone, PartialEq)]
pub struct GroundMap {
    /// The camera that every keyframe was taken with.
    pub camera: Camera,
    /// How it sat when the first session began.
    pub rig: Rig,
    /// The keyframes, in the order of their numbers; numbers may be missing where the map was thinned.
    pub keyframes: Vec<MapKeyframe>,
    /// The edges, in the order in which they were found.
    pub edges: Vec<MapEdge>,
}

/// A keyframe's picture.
#[derive(Debug, Clone, PartialEq)]
pub struct KeyframeImage {
    /// Luminance, in which everything is measured.
    pub gray: GrayImage,
    /// Colour, where the source has it, for the mosaic.
    pub color: Option<RgbImage>,
}

/// Where a map's images are kept: in memory, or in the map file.
pub trait KeyframeImages {
    /// The image of a keyframe. Fails where there is none, or where it cannot be read.
    fn load(&mut self, keyframe: KeyframeId) -> Result<KeyframeImage>;
}
