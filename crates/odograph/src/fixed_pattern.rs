//! What stands still in the image while the ground moves: the carrier's own bumper, dirt on the lens, a highlight of its lamp.
//!
//! The image is seen in cells of 4x4 pixels. Of every cell the mean and the variance over time of its brightness gradient are kept, in
//! the manner of a background model (C. Stauffer and W. Grimson, "Adaptive background mixture models for real-time tracking", 1999) with
//! one mode: the gradient of moving ground averages out and varies, that of what is fixed in the image stays and varies by no more than
//! noise. Nothing is tracked for that, so it cannot be misled by a tracker that follows the wrong thing.
//!
//! Only images in which much of the view has changed since the last one count as evidence: a camera that stands still teaches nothing.

mod image_mask;
mod statistics;

pub use image_mask::{CELL_PX, ImageMask};

use crate::image::{GrayImage, noise_variance};
use statistics::{Cells, Change, Statistics};
use std::sync::Arc;

/// What an image says about the time since the last one that counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SinceLast {
    /// It was not looked at, or too little has changed to tell.
    Unclear,
    /// Most of what is not known to be fixed has moved: this image counts from now on.
    Moved,
}

/// Learns, image by image, what stands still in the image while the rest moves.
#[derive(Debug)]
pub struct FixedPattern {
    size: (usize, usize),
    /// What a person said is not ground.
    told: Option<ImageMask>,
    mask: Option<Arc<ImageMask>>,
    images: u64,
    last: Cells,
    now: Cells,
    statistics: Statistics,
    change: Change,
    /// Variance of a pixel's noise, gray levels².
    noise: f64,
    /// Which cells the last decision found to be fixed, and which this one did.
    before: Vec<bool>,
    lasting: Vec<bool>,
}

/// After so many samples the picture is complete enough to look at every twelfth image only: a look takes 0.3 ms at 640x480.
const SETTLED_SAMPLES: u32 = 12;
const EVERY: u64 = 12;

/// As long as little is known, every image of the first seconds is looked at.
const FIRST_IMAGES: u64 = 300;

/// The mask is made anew after these numbers of samples, and then every so many.
const FIRST_DECISIONS: [u32; 6] = [3, 4, 5, 6, 8, 12];
const DECIDE_EVERY: u32 = 16;

/// An image counts when this part of what has texture has moved: a third where it is not known yet what is fixed, so that a bumper over
/// more than half of the image is found, and most of the rest where it is, so that somebody who walks past a camera at rest is no evidence.
const MOVED_SHARE: f64 = 0.33;
const MOVED_SHARE_OF_GROUND: f64 = 0.6;

/// Fewer blocks with texture than this part of all tell nothing.
const LEAST_TEXTURED: f64 = 0.05;

/// What covers more than this part of the image may take all corners and is believed at once; less must be found twice, for a few samples of moving ground may look
/// alike by chance.
const LARGE: f64 = 0.04;
const SURE_SAMPLES: u32 = 20;

/// Rounding to whole gray levels, and what codecs leave out: noise is at least this, gray levels².
const LEAST_NOISE: f64 = 0.3;

impl FixedPattern {
    /// Nothing known yet, of images of this size.
    pub fn new(size: (usize, usize)) -> Self {
        let (columns, rows) = image_mask::cells(size);
        let count = columns * rows;
        Self {
            size,
            told: None,
            mask: None,
            images: 0,
            last: Cells::new(size),
            now: Cells::new(size),
            statistics: Statistics::new(size),
            change: Change::new(size),
            noise: LEAST_NOISE,
            before: vec![false; count],
            lasting: vec![false; count],
        }
    }

    /// The same with what a person said is not ground, which is masked in any case.
    pub fn with_told(mut self, told: ImageMask) -> Self {
        self.mask = (!told.is_empty()).then(|| Arc::new(told.clone()));
        self.told = Some(told);
        self
    }

    /// What is known not to be ground; `None` where that is nothing.
    pub fn mask(&self) -> Option<&Arc<ImageMask>> {
        self.mask.as_ref()
    }

    /// The part of the image that is known not to be ground, 0 to 1.
    pub fn share(&self) -> f64 {
        self.mask.as_ref().map_or(0.0, |mask| mask.share())
    }

    /// The mask as a picture: white is ground, black is not.
    pub fn picture(&self) -> GrayImage {
        match &self.mask {
            Some(mask) => mask.picture(),
            None => ImageMask::nothing(self.size).picture(),
        }
    }

    /// Takes the next image.
    pub fn look(&mut self, image: &GrayImage) -> SinceLast {
        let number = self.images;
        self.images += 1;
        let eager = self.statistics.samples() < SETTLED_SAMPLES && number < FIRST_IMAGES;
        if !eager && !number.is_multiple_of(EVERY) {
            return SinceLast::Unclear;
        }
        self.now.fill(image);
        if self.statistics.samples() == 0 {
            self.noise = noise_variance(image).max(LEAST_NOISE);
            self.take();
            return SinceLast::Unclear;
        }
        self.change.between(&self.last, &self.now, self.noise, self.mask.as_deref());
        let wanted = if self.mask.is_some() { MOVED_SHARE_OF_GROUND } else { MOVED_SHARE };
        let Change { blocks, textured, moved, .. } = self.change;
        if (textured as f64) < LEAST_TEXTURED * blocks as f64 || (moved as f64) < wanted * textured as f64 {
            return SinceLast::Unclear;
        }
        // Both are upper bounds: fine texture looks like noise, and where all moves no block has noise alone.
        let by_change = self.change.least_noise();
        let by_image = if eager { noise_variance(image) } else { self.noise };
        self.noise = by_image.min(by_change).max(LEAST_NOISE);
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
        let found = self.statistics.fixed_cells(self.noise);
        let large = found.iter().filter(|fixed| **fixed).count() as f64 > LARGE * found.len() as f64;
        for (lasting, (now, before)) in self.lasting.iter_mut().zip(found.iter().zip(&self.before)) {
            *lasting = *now && (large || *before && sure);
        }
        self.before.copy_from_slice(found);
        let told = self.told.as_ref();
        if !self.lasting.contains(&true) && told.is_none_or(ImageMask::is_empty) {
            self.mask = None;
            return;
        }
        let mask = ImageMask::of_cells(self.size, &self.lasting, told);
        if self.mask.as_deref() != Some(&mask) {
            self.mask = Some(Arc::new(mask));
        }
    }
}

#[cfg(test)]
mod tests;
