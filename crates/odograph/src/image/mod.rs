//! Images as the rest of the library sees them.
//!
//! Pixel centres are at integer coordinates: pixel (0, 0) is the centre of the top-left pixel; `x` runs right, `y` down.

mod noise;
mod pyramid;
pub(crate) mod simd;

pub use noise::noise_variance;
pub use pyramid::Pyramid;

/// An owned gray (luminance) image, 8 bits a pixel, rows packed without padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GrayImage {
    width: usize,
    height: usize,
    samples: Vec<u8>,
}

impl GrayImage {
    /// A black image.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, samples: vec![0; width * height] }
    }

    /// An image from its samples in row order; `None` unless there are exactly `width * height` of them.
    pub fn from_samples(width: usize, height: usize, samples: Vec<u8>) -> Option<Self> {
        (samples.len() == width.checked_mul(height)?).then_some(Self { width, height, samples })
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All samples in row order.
    pub fn samples(&self) -> &[u8] {
        &self.samples
    }

    /// All samples in row order, to be written.
    pub fn samples_mut(&mut self) -> &mut [u8] {
        &mut self.samples
    }

    /// The samples, without the image around them.
    pub fn into_samples(self) -> Vec<u8> {
        self.samples
    }

    /// One row of samples. Panics if `y` is not below [`GrayImage::height`].
    pub fn row(&self, y: usize) -> &[u8] {
        &self.samples[y * self.width..][..self.width]
    }

    /// Makes this an image of the given size, keeping the allocation where it is large enough; samples are unspecified.
    pub fn resize(&mut self, width: usize, height: usize) {
        self.width = width;
        self.height = height;
        self.samples.resize(width * height, 0);
    }
}

/// An owned colour image, 8 bits each of red, green and blue (sRGB), interleaved, rows packed without padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbImage {
    width: usize,
    height: usize,
    samples: Vec<u8>,
}

impl RgbImage {
    /// A black image.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, samples: vec![0; 3 * width * height] }
    }

    /// An image from its interleaved samples; `None` unless there are exactly `3 * width * height` of them.
    pub fn from_samples(width: usize, height: usize, samples: Vec<u8>) -> Option<Self> {
        (samples.len() == width.checked_mul(height)?.checked_mul(3)?).then_some(Self {
            width,
            height,
            samples,
        })
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All samples: red, green, blue, red, … in row order.
    pub fn samples(&self) -> &[u8] {
        &self.samples
    }

    /// All samples, to be written.
    pub fn samples_mut(&mut self) -> &mut [u8] {
        &mut self.samples
    }

    /// The colour of a pixel. Panics outside the image.
    pub fn pixel(&self, x: usize, y: usize) -> [u8; 3] {
        let at = 3 * (y * self.width + x);
        [self.samples[at], self.samples[at + 1], self.samples[at + 2]]
    }
}

impl From<&GrayImage> for RgbImage {
    fn from(gray: &GrayImage) -> Self {
        let samples = gray.samples().iter().flat_map(|&s| [s, s, s]).collect();
        Self { width: gray.width, height: gray.height, samples }
    }
}
