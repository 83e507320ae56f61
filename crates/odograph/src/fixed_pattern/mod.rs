//! Detection of regions that are static in the image while the ground moves: the vehicle's own
//! bumper, dirt on the lens, a specular highlight of its lamp.
//!
//! The image is divided into cells of 4x4 pixels. Each cell keeps the temporal mean and variance of
//! its brightness gradient: a single-mode background model in the manner of C. Stauffer and W.
//! Grimson, "Adaptive background mixture models for real-time tracking", 1999. The gradient of
//! moving ground averages out and varies; that of a static region keeps its mean and varies only by
//! noise. The detection uses no feature tracks, so a tracker that follows the wrong surface cannot
//! mislead it.
//!
//! Only images in which much of the view has changed since the last one used are evidence: images
//! of a stationary camera are ignored.

mod image_mask;
mod nonuniformity;
mod stale_blocks;
mod statistics;

pub use image_mask::{CELL_PX, ImageMask};
pub use nonuniformity::NonuniformityCorrection;
pub use stale_blocks::stale_blocks;

use crate::image::{GrayImage, noise_variance};
use statistics::{Cells, Change, GradientStatistics};
use std::sync::Arc;

/// Result of the comparison of an image with the last one that was used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SinceLast {
    /// The image was skipped, or too little has changed.
    Unclear,
    /// Most of the unmasked texture has moved; the image is added to the statistics.
    Moved,
}

/// Learns the static regions of the image from a sequence of images.
#[derive(Debug)]
pub struct FixedPattern {
    size: (usize, usize),
    /// Mask given by the user.
    given: Option<ImageMask>,
    /// Mask found in an earlier pass over the same images, with what is given: it applies until
    /// this pass is sure of its own.
    known: Option<Arc<ImageMask>>,
    mask: Option<Arc<ImageMask>>,
    images: u64,
    last: Cells,
    now: Cells,
    statistics: GradientStatistics,
    change: Change,
    /// Variance of the pixel noise, gray levels².
    noise: f64,
    /// Whether static gradients are all over the image.
    is_everywhere: bool,
    /// Static cells of the previous decision, and the confirmed ones of the current decision.
    before: Vec<bool>,
    lasting: Vec<bool>,
}

/// Number of samples after which only every twelfth image is compared; a comparison takes 0.3 ms at
/// 640x480.
const SETTLED_SAMPLES: u32 = 12;
const EVERY: u64 = 12;

/// Before that, every image is compared, up to this frame index.
const FIRST_IMAGES: u64 = 300;

/// The mask is recomputed at these numbers of samples, and then every `DECIDE_EVERY` samples.
const FIRST_DECISIONS: [u32; 9] = [3, 4, 5, 6, 8, 12, 16, 20, 24];
const DECIDE_EVERY: u32 = 16;

/// Minimum fraction of the textured blocks that must have moved for an image to be used. Without a
/// mask it is a third, so that a bumper over more than half of the image is found. With a mask it
/// is most of the unmasked blocks, so that a person who walks past a stationary camera is no
/// evidence.
const MOVED_SHARE: f64 = 0.33;
const MOVED_SHARE_OF_GROUND: f64 = 0.6;

/// Minimum fraction of blocks with texture; with fewer the image is not used.
const MIN_TEXTURED: f64 = 0.05;

/// Static regions larger than this fraction of the image may attract all corners and are masked at
/// once. Smaller ones must be found in two consecutive decisions after at least `SURE_SAMPLES`
/// samples, because a few samples of moving ground may be alike by chance.
const LARGE: f64 = 0.04;
const SURE_SAMPLES: u32 = 20;

/// Lower bound of the noise variance, gray levels²: quantisation to integer gray levels and detail
/// removed by codecs.
const MIN_NOISE: f64 = 0.3;

impl FixedPattern {
    /// A model without evidence, for images of this size.
    pub fn new(size: (usize, usize)) -> Self {
        let (columns, rows) = image_mask::cells(size);
        let count = columns * rows;
        Self {
            size,
            given: None,
            known: None,
            mask: None,
            images: 0,
            last: Cells::new(size),
            now: Cells::new(size),
            statistics: GradientStatistics::new(size),
            change: Change::new(size),
            noise: MIN_NOISE,
            is_everywhere: false,
            before: vec![false; count],
            lasting: vec![false; count],
        }
    }

    /// Adds a mask given by the user, which applies in any case.
    pub fn with_given(mut self, given: ImageMask) -> Self {
        self.mask = (!given.is_empty()).then(|| Arc::new(given.clone()));
        self.given = Some(given);
        self
    }

    /// Begins with the mask that an earlier pass over the same images has found.
    pub fn with_known(mut self, found: &ImageMask) -> Self {
        let known = match &self.given {
            Some(given) => found.union(given),
            None => found.clone(),
        };
        let known = Arc::new(known);
        self.mask = Some(Arc::clone(&known));
        self.known = Some(known);
        self
    }

    /// The mask, where a later pass over the same images should begin with it: a large one that
    /// does not change any more.
    pub fn settled_mask(&self) -> Option<&Arc<ImageMask>> {
        let is_settled = self.statistics.added() >= SETTLED_SAMPLES && !self.is_everywhere;
        let given = self.given.as_ref().map_or(0.0, ImageMask::share);
        self.mask.as_ref().filter(|mask| is_settled && mask.share() > given + LARGE)
    }

    /// Forgets what was found: from now on the images look otherwise. What was given is kept.
    pub fn reset(&mut self) {
        let fresh = Self::new(self.size);
        *self = match self.given.take() {
            Some(given) => fresh.with_given(given),
            None => fresh,
        };
    }

    /// The same for images of half the size, of which nothing is known yet but the mask.
    pub(crate) fn halved(&self) -> Self {
        let size = (self.size.0.div_ceil(2), self.size.1.div_ceil(2));
        let mut fresh = Self::new(size);
        if let Some(given) = &self.given {
            fresh = fresh.with_given(given.scaled(size, 1));
        }
        match &self.mask {
            Some(mask) => fresh.with_known(&mask.scaled(size, 1)),
            None => fresh,
        }
    }

    /// The mask of pixels that are not ground; `None` where it is empty.
    pub fn mask(&self) -> Option<&Arc<ImageMask>> {
        self.mask.as_ref()
    }

    /// Whether what is static is all over the image: a pattern that the camera adds.
    pub fn is_everywhere(&self) -> bool {
        self.is_everywhere
    }

    /// The masked fraction of the image, 0 to 1.
    pub fn share(&self) -> f64 {
        self.mask.as_ref().map_or(0.0, |mask| mask.share())
    }

    /// The mask as an image: ground is white, masked pixels are black.
    pub fn picture(&self) -> GrayImage {
        match &self.mask {
            Some(mask) => mask.picture(),
            None => ImageMask::nothing(self.size).picture(),
        }
    }

    /// Processes the next image.
    pub fn look(&mut self, image: &GrayImage) -> SinceLast {
        let number = self.images;
        self.images += 1;
        let eager = self.statistics.samples() < SETTLED_SAMPLES && number < FIRST_IMAGES;
        if !eager && !number.is_multiple_of(EVERY) {
            return SinceLast::Unclear;
        }
        self.now.fill(image);
        if self.statistics.samples() == 0 {
            self.noise = noise_variance(image).max(MIN_NOISE);
            self.take();
            return SinceLast::Unclear;
        }
        self.change.between(&self.last, &self.now, self.mask.as_deref());
        let wanted = if self.mask.is_some() { MOVED_SHARE_OF_GROUND } else { MOVED_SHARE };
        let Change { blocks, textured, moved, .. } = self.change;
        if (textured as f64) < MIN_TEXTURED * blocks as f64 || (moved as f64) < wanted * textured as f64 {
            return SinceLast::Unclear;
        }
        // Both estimates are upper bounds: fine texture is taken for noise, and where everything
        // moves no block contains noise alone.
        let by_change = self.change.least_noise();
        let by_image = if eager { noise_variance(image) } else { self.noise };
        self.noise = by_image.min(by_change).max(MIN_NOISE);
        self.take();
        SinceLast::Moved
    }

    fn take(&mut self) {
        self.statistics.add(&self.now);
        std::mem::swap(&mut self.last, &mut self.now);
        let samples = self.statistics.added();
        if FIRST_DECISIONS.contains(&samples) || samples.is_multiple_of(DECIDE_EVERY) {
            self.decide();
        }
    }

    fn decide(&mut self) {
        let sure = self.statistics.added() >= SURE_SAMPLES;
        self.statistics.find_fixed_cells(self.noise);
        // Were a pattern masked, nothing would be left that shows how the ground moves.
        let is_pattern = self.statistics.lies_over_moving_ground(self.noise);
        let is_everywhere = is_pattern || self.statistics.is_everywhere();
        self.is_everywhere = is_everywhere && self.statistics.samples() >= SETTLED_SAMPLES;
        let found = self.statistics.fixed();
        let large = found.iter().filter(|fixed| **fixed).count() as f64 > LARGE * found.len() as f64;
        for (lasting, (now, before)) in self.lasting.iter_mut().zip(found.iter().zip(&self.before)) {
            *lasting = *now && !is_pattern && (large || *before && sure);
        }
        self.before.copy_from_slice(found);
        let known = self.known.as_deref().filter(|_| !sure);
        let given = known.or(self.given.as_ref());
        if !self.lasting.contains(&true) && given.is_none_or(ImageMask::is_empty) {
            self.mask = None;
            return;
        }
        let mask = ImageMask::of_cells(self.size, &self.lasting, given);
        if self.mask.as_deref() != Some(&mask) {
            self.mask = Some(Arc::new(mask));
        }
    }
}

#[cfg(test)]
mod tests;
