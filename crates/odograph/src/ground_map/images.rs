//! Images of a map's keyframes: loading them, and storing those of a growing map.

use super::MapKeyframe;
use crate::error::{Error, Result};
use crate::image::{GrayImage, RgbImage};
use crate::keyframe::{KeyframeId, MapEdge};
use std::collections::BTreeMap;

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

/// Storage of a growing map: in memory, or the map file.
pub trait KeyframeStore: KeyframeImages + Send {
    /// Stores a keyframe with its image and its edges to earlier ones. Fails if they cannot be
    /// written.
    fn keep(&mut self, keyframe: &MapKeyframe, image: KeyframeImage, edges: &[MapEdge]) -> Result<()>;

    /// Stores an edge between stored keyframes. Fails if it cannot be written.
    fn add_edge(&mut self, edge: &MapEdge) -> Result<()>;
}

/// Uncompressed images in memory, a few hundred kilobytes each. The numbers of the map are in the
/// [`super::GroundMap`].
#[derive(Debug, Default)]
pub struct MemoryImages {
    images: BTreeMap<KeyframeId, KeyframeImage>,
}

impl KeyframeImages for MemoryImages {
    fn load(&mut self, keyframe: KeyframeId) -> Result<KeyframeImage> {
        let found = self.images.get(&keyframe).cloned();
        found.ok_or_else(|| Error::input(format!("keyframe {} has no image in memory", keyframe.0)))
    }
}

impl KeyframeStore for MemoryImages {
    fn keep(&mut self, keyframe: &MapKeyframe, image: KeyframeImage, _: &[MapEdge]) -> Result<()> {
        self.images.insert(keyframe.id, image);
        Ok(())
    }

    fn add_edge(&mut self, _: &MapEdge) -> Result<()> {
        Ok(())
    }
}
