//! Where the pictures of keyframes are kept.

use crate::error::{Error, Result};
use crate::mapping::{KeyframeId, KeyframeImage, KeyframeImages};
use std::collections::BTreeMap;

/// Images that can be added to.
pub trait KeyframeStore: KeyframeImages + Send {
    /// Keeps the image of a keyframe. Fails where it cannot be written.
    fn keep(&mut self, keyframe: KeyframeId, image: KeyframeImage) -> Result<()>;
}

/// Images in memory, as they are: a few hundred kilobytes each.
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
    fn keep(&mut self, keyframe: KeyframeId, image: KeyframeImage) -> Result<()> {
        self.images.insert(keyframe, image);
        Ok(())
    }
}
