//! Image pyramids in floating point: on low-texture ground rounding to gray levels would exceed the
//! signal.

use crate::fixed_pattern::ImageMask;
use crate::image::GrayImage;
use std::sync::Arc;

/// One level of the pyramid.
#[derive(Debug, Clone)]
pub(super) struct DensePlane {
    pub width: usize,
    pub height: usize,
    pub samples: Vec<f32>,
    /// Pixels of the full image per sample.
    pub pixels_per_sample: f64,
}

/// An image prepared for dense registration: its pyramid, each sample the mean of four of the finer
/// level.
#[derive(Debug, Clone)]
pub struct DenseImage {
    /// The full image first.
    pub(super) planes: Vec<DensePlane>,
    /// Pixels that are not ground.
    pub(super) mask: Option<Arc<ImageMask>>,
}

/// Shortest side of a level, samples: three tiles of 16. Not derived; chosen.
const SMALLEST_SIDE: usize = 48;

/// Most levels: beyond 8 pixels per sample little of a floor's texture is left. Not derived;
/// chosen.
const MOST_LEVELS: usize = 4;

impl DenseImage {
    /// The pyramid of an image.
    pub fn new(image: &GrayImage) -> Self {
        let samples = image.samples().iter().map(|&sample| f32::from(sample)).collect();
        let base =
            DensePlane { width: image.width(), height: image.height(), samples, pixels_per_sample: 1.0 };
        let mut planes = vec![base];
        while let Some(half) =
            planes.last().filter(|_| planes.len() < MOST_LEVELS).and_then(DensePlane::halved)
        {
            planes.push(half);
        }
        Self { planes, mask: None }
    }

    /// The same image with a mask of what is not ground.
    pub fn without(mut self, mask: Option<Arc<ImageMask>>) -> Self {
        self.mask = mask;
        self
    }
}

impl DensePlane {
    /// The next coarser level; `None` where it would be too small.
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

    /// Sample coordinate of a pixel coordinate of the full image.
    pub fn sample_of_pixel(&self, pixel: f64) -> f64 {
        (pixel + 0.5) / self.pixels_per_sample - 0.5
    }

    /// Pixel coordinate of the full image of a sample coordinate.
    pub fn pixel_of_sample(&self, sample: f64) -> f64 {
        (sample + 0.5) * self.pixels_per_sample - 0.5
    }
}
