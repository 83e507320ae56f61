//! The images that were needed last.

use crate::error::Result;
use crate::ground_map::{KeyframeImage, KeyframeImages};
use crate::keyframe::KeyframeId;

/// Bytes of decoded images that are kept: some hundred of a small camera, a dozen of a large one.
/// More decode fewer images twice.
const KEPT_BYTES: usize = 32 << 20;

/// Images by keyframe, the one used last at the end.
#[derive(Debug, Default)]
pub(super) struct Images {
    kept: Vec<(KeyframeId, KeyframeImage)>,
}

impl Images {
    /// The image of a keyframe, loaded where it is not among those kept.
    pub fn get(&mut self, keyframe: KeyframeId, images: &mut dyn KeyframeImages) -> Result<&KeyframeImage> {
        let found = match self.kept.iter().position(|(id, _)| *id == keyframe) {
            Some(at) => self.kept.remove(at),
            None => {
                let image = images.load(keyframe)?;
                let most = (KEPT_BYTES / bytes(&image).max(1)).max(2);
                self.kept.drain(..(self.kept.len() + 1).saturating_sub(most));
                (keyframe, image)
            }
        };
        self.kept.push(found);
        // It was pushed a line above.
        Ok(&self.kept[self.kept.len() - 1].1)
    }
}

fn bytes(image: &KeyframeImage) -> usize {
    image.gray.samples().len() + image.color.as_ref().map_or(0, |color| color.samples().len())
}
