//! Where the map is kept as it grows.

use crate::error::{Error, Result};
use crate::mapping::{KeyframeId, KeyframeImage, KeyframeImages, MapEdge, MapKeyframe};
use std::collections::BTreeMap;

/// What a growing map is written into: in memory, or the map file.
pub trait KeyframeStore: KeyframeImages + Send {
    /// Keeps a keyframe with its image, and the edges that tie it to the ones before. Fails where it cannot be written.
    fn keep(&mut self, keyframe: &MapKeyframe, image: KeyframeImage, ties: &[MapEdge]) -> Result<()>;

    /// Keeps an edge between keyframes that are kept already. Fails where it cannot be written.
    fn tie(&mut self, edge: &MapEdge) -> Result<()>;
}

/// Images in memory, as they are: a few hundred kilobytes each. The numbers of the map are with the [`super::Mapper`] anyway.
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
