//! Recognising a place: from the picture of a piece of ground to the keyframes that show the same piece, at any heading and without knowing
//! where to look.
//!
//! Ground is a plane seen from a known height, so its picture can be laid out in metres: tilt, lens and height are gone, and what is
//! left between two pictures of one place is a turn and a shift. A [`Signature`] is taken from such a picture: corners, each with the
//! direction of the ground around it and 256 comparisons of brightness made along that direction (M. Calonder et al., "BRIEF: Binary robust
//! independent elementary features", 2010; turned as in E. Rublee et al., "ORB: an efficient alternative to SIFT or SURF", 2011).
//! That short binary descriptors looked up as they are, with a vote on the plane, are enough to find one's place on ground is the
//! idea of L. Zhang, A. Finkelstein and S. Rusinkiewicz, "High-precision localization using ground texture", 2019, and of J. F. Schmid,
//! S. F. Simon and R. Mester, "Ground texture based localization using compact binary descriptors", 2020.
//!
//! A [`PlaceIndex`] holds the signatures of a map's keyframes. A query goes through three sieves, each finer and dearer than the one before:
//!
//! 1. **Look-up.** Parts of a descriptor's bits are addresses of buckets, several for each descriptor (locality-sensitive hashing; P. Indyk and
//!    R. Motwani, "Approximate nearest neighbors", 1998). What lies in the same bucket is compared in all bits. The emptiest buckets come
//!    first and the number of comparisons is bounded: what is everywhere, such as the joints between tiles, tells nothing about where.
//! 2. **Pairs.** Two features of a keyframe that look like two of the query must lie as far from each other and turned alike. Such a pair
//!    gives the motion; unrelated ground hardly ever offers one.
//! 3. **Support.** Under that motion every feature of the query that should be seen in the keyframe is looked for there, the motion is
//!    fitted to those found, and they are counted. The count, against how many there should be and against the count of the best other
//!    motion over the same keyframe, says how sure the place is ([`PlaceHypothesis::is_sure`]).

mod bytes;
mod descriptor;
mod features;
mod index;
mod lookup;
mod support;
mod view;

#[cfg(test)]
mod tests;

pub use index::{PlaceHypothesis, PlaceIndex};

use crate::camera::Camera;
use crate::geometry::GroundPose;
use crate::image::Pyramid;
use serde::{Deserialize, Serialize};

/// At most so many features of a picture are kept.
pub const MOST_FEATURES: usize = 512;

/// What a picture of the ground is recognised by.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Signature {
    /// The features, in no particular order.
    pub features: Vec<GroundFeature>,
}

/// A spot of the ground that can be told from others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundFeature {
    /// What it looks like, as bits: alike where few differ.
    pub descriptor: [u64; 4],
    /// Where it lies from the point below the camera, metres: in the direction that is up in the image, and to the left.
    pub position_m: [f32; 2],
    /// The direction of its pattern on the ground, counter-clockwise from the direction that is up in the image, radians.
    pub direction_rad: f32,
}

/// How places are recognised. Signatures can be compared where they were taken with the same `spot_m`, within some per cent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlacesConfig {
    /// Size of the smallest detail that is looked at, metres on the ground. One size for the whole map, whatever the height.
    pub spot_m: f64,
    /// So many features in a picture of [`PlacesConfig::SPOTS`] spots; more or fewer where it shows more or less ground. Positive.
    pub features: usize,
}

impl PlacesConfig {
    /// A picture from the usual height is so many spots wide and high.
    pub const SPOTS: (usize, usize) = (320, 240);

    /// For a map made with this camera, usually from about this height in metres. The same camera and height give the same value.
    pub fn new(camera: &Camera, height_m: f64) -> Self {
        let (fx, fy) = camera.focal_px();
        let long_side_px = camera.width().max(camera.height()) as f64;
        let spot_px = (long_side_px / Self::SPOTS.0 as f64).max(1.0);
        Self { spot_m: spot_px * height_m / (fx * fy).sqrt(), features: 300 }
    }
}

impl Signature {
    /// What the ground in this picture is recognised by. Of the pose only height, roll and pitch count. The pyramid should reach down to
    /// pixels that cover about a spot; with fewer levels fine grain gets in the way. Empty where the ground shows nothing to hold on to.
    pub fn of(pyramid: &Pyramid, camera: &Camera, pose: &GroundPose, config: &PlacesConfig) -> Self {
        let Some(view) = view::View::new(pyramid, camera, pose, config.spot_m) else {
            return Self::default();
        };
        Self { features: descriptor::features(&view, config) }
    }
}
