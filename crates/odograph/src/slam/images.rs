//! Storage of a growing map.

use crate::error::{Error, Result};
use crate::mapping::{KeyframeId, KeyframeImage, KeyframeImages, MapEdge, MapKeyframe};
use std::collections::BTreeMap;

/// Storage of a growing map: in memory, or the map file.
pub trait KeyframeStore: KeyframeImages + Send {
    /// Stores a keyframe with its image and its edges to earlier ones. Fails if they cannot be
    /// written.
    fn keep(&mut self, keyframe: &MapKeyframe, image: KeyframeImage, ties: &[MapEdge]) -> Result<()>;

    /// Stores an edge between stored keyframes. Fails if it cannot be written.
    fn tie(&mut self, edge: &MapEdge) -> Result<()>;
}

/// Uncompressed images in memory, a few hundred kilobytes each. The numbers of the map are in the
/// [`super::Mapper`].
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

    fn tie(&mut self, _: &MapEdge) -> Result<()> {
        Ok(())
    }
}
