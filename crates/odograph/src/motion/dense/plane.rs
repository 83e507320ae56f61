//! Images halved again and again without rounding: on faint ground a gray level of rounding would be more than what is looked for.

use crate::fixed_pattern::ImageMask;
use crate::image::GrayImage;
use std::sync::Arc;

/// Samples of an image or of one of its halvings.
#[derive(Debug, Clone)]
pub(super) struct Plane {
    pub width: usize,
    pub height: usize,
    pub samples: Vec<f32>,
    /// Pixels of the full image along one sample.
    pub pixels_per_sample: f64,
}

/// An image prepared for dense refinement: its halvings, each sample the mean of four of the finer level.
#[derive(Debug, Clone)]
pub struct DenseImage {
    /// The full image first.
    pub(super) planes: Vec<Plane>,
    /// What of it is not ground.
    pub(super) mask: Option<Arc<ImageMask>>,
}

/// A level with fewer samples along a side holds fewer than two patches.
const SMALLEST_SIDE: usize = 48;

/// Beyond 8 pixels a sample, little is left of the texture of a floor.
const MOST_LEVELS: usize = 4;

impl DenseImage {
    /// Of an image of any size.
    pub fn new(image: &GrayImage) -> Self {
        let samples = image.samples().iter().map(|&sample| f32::from(sample)).collect();
        let base = Plane { width: image.width(), height: image.height(), samples, pixels_per_sample: 1.0 };
        let mut planes = vec![base];
        while let Some(half) = planes.last().filter(|_| planes.len() < MOST_LEVELS).and_then(Plane::halved) {
            planes.push(half);
        }
        Self { planes, mask: None }
    }

    /// The same without what is not ground.
    pub fn without(mut self, mask: Option<Arc<ImageMask>>) -> Self {
        self.mask = mask;
        self
    }
}

impl Plane {
    /// `None` where too little would be left.
    fn halved(&self) -> Option<Self> {
        let (width, height) = (self.width / 2, self.height / 2);
        if width.min(height) < SMALLEST_SIDE {
            return None;
        }
        let mut samples = Vec::with_capacity(width * height);
        for pair in self.samples.chunks_exact(2 * self.width).take(height) {
            let (above, below) = pair.split_at(self.width);
            let sums = above.chunks_exact(2).zip(below.chunks_exact(2));
            samples.extend(sums.map(|(a, b)| 0.25 * ((a[0] + a[1]) + (b[0] + b[1]))));
        }
        Some(Self { width, height, samples, pixels_per_sample: 2.0 * self.pixels_per_sample })
    }

    /// Where a pixel of the full image lies among the samples, along either side.
    pub fn sample_of_pixel(&self, pixel: f64) -> f64 {
        (pixel + 0.5) / self.pixels_per_sample - 0.5
    }

    /// The pixel of the full image at a place among the samples.
    pub fn pixel_of_sample(&self, sample: f64) -> f64 {
        (sample + 0.5) * self.pixels_per_sample - 0.5
    }
}
