//! Place recognition: finds the keyframes that show the same ground as an image, at any heading and
//! without a prior position.
//!
//! Ground is a plane seen from a known height, so its image can be orthorectified: without tilt,
//! lens and height, two images of one place differ by a rotation and a translation. A [`Signature`]
//! is taken from such a picture: corners, each with the direction of the ground around it and 256
//! comparisons of brightness along that direction (M. Calonder et al., "BRIEF: Binary robust
//! independent elementary features", 2010; rotated as in E. Rublee et al., "ORB: an efficient
//! alternative to SIFT or SURF", 2011). That binary descriptors with a vote on the plane are enough
//! to localize on ground texture is the idea of L. Zhang, A. Finkelstein and S. Rusinkiewicz,
//! "High-precision localization using ground texture", 2019, and of J. F. Schmid, S. F. Simon and
//! R. Mester, "Ground texture based localization using compact binary descriptors", 2020.
//!
//! A [`PlaceIndex`] holds the signatures of a map's keyframes. A query passes three stages, each
//! finer and more expensive than the one before:
//!
//! 1. **Lookup.** Parts of a descriptor's bits are the keys of hash tables, several per descriptor
//!    (locality-sensitive hashing; P. Indyk and R. Motwani, "Approximate nearest neighbors", 1998).
//!    Descriptors in the same bucket are compared in all bits. The emptiest buckets come first and
//!    the number of comparisons is bounded: frequent patterns, such as the joints between tiles, do
//!    not identify a place.
//! 2. **Pairs.** Two features of a keyframe that match two of the query must have the same distance
//!    and relative orientation. Such a pair gives the motion; unrelated ground hardly ever has one.
//! 3. **Verification.** Under that motion every feature of the query in the overlap is searched in
//!    the keyframe, the motion is fitted to the matches, and they are counted. The count, relative
//!    to the number expected and to that of the best other motion over the same keyframe, decides
//!    how certain the place is ([`PlaceHypothesis::is_sure`]).

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
use crate::fixed_pattern::ImageMask;
use crate::geometry::GroundPose;
use crate::image::Pyramid;
use serde::{Deserialize, Serialize};

/// Maximum number of features of an image.
pub const MAX_FEATURES: usize = 512;

/// The appearance of an image of the ground.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Signature {
    /// The features, in no particular order.
    pub features: Vec<GroundFeature>,
}

/// A distinctive spot of the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundFeature {
    /// Its binary descriptor; similar spots differ in few bits.
    pub descriptor: [u64; 4],
    /// Position relative to the point below the camera, metres: forward (up in the image) and to
    /// the left.
    pub position_m: [f32; 2],
    /// Orientation of its pattern on the ground, counter-clockwise from the direction that is up in
    /// the image, radians.
    pub direction_rad: f32,
}

/// Parameters of place recognition. Signatures are comparable if their `spot_m` is equal within
/// some per cent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlacesConfig {
    /// Size of the smallest detail used, metres on the ground. One size for the whole map, whatever
    /// the height.
    pub spot_m: f64,
    /// Number of features in an image of [`PlacesConfig::SPOTS`] spots, positive; in proportion to
    /// the ground that an image shows.
    pub features: usize,
}

impl PlacesConfig {
    /// Width and height in spots of an image from the usual height.
    pub const SPOTS: (usize, usize) = (320, 240);

    /// For a map made with this camera, from about this height in metres. The same input gives the
    /// same value.
    pub fn new(camera: &Camera, height_m: f64) -> Self {
        let (fx, fy) = camera.focal_px();
        let long_side_px = camera.width().max(camera.height()) as f64;
        let spot_px = (long_side_px / Self::SPOTS.0 as f64).max(1.0);
        Self { spot_m: spot_px * height_m / (fx * fy).sqrt(), features: 300 }
    }
}

impl Signature {
    /// The signature of the ground in an image, outside the mask. Only height, roll and pitch of
    /// the pose are used. The pyramid should reach down to pixels of about a spot; with fewer
    /// levels fine grain disturbs. Empty if the ground has no features.
    pub fn of(
        pyramid: &Pyramid,
        camera: &Camera,
        mask: Option<&ImageMask>,
        pose: &GroundPose,
        config: &PlacesConfig,
    ) -> Self {
        let Some(view) = view::OrthoView::new(pyramid, camera, mask, pose, config.spot_m) else {
            return Self::default();
        };
        Self { features: descriptor::features(&view, config) }
    }
}
