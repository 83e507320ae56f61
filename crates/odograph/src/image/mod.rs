//! Image types.
//!
//! Integer coordinates are pixel centres: (0, 0) is the centre of the top left pixel; `x` points
//! right, `y` down.

mod impulse_noise;
mod interlacing;
mod noise;
mod pyramid;
mod restoration;
mod row_noise;
pub(crate) mod simd;

pub use noise::noise_variance;
pub use pyramid::{Halving, Pyramid};
pub use restoration::{ImageDefects, Restoration};

/// An owned image, 8 bits per sample, channels interleaved, rows without padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image<const CHANNELS: usize> {
    width: usize,
    height: usize,
    samples: Vec<u8>,
}

/// A gray (luminance) image.
pub type GrayImage = Image<1>;

/// A colour image: red, green and blue (sRGB).
pub type RgbImage = Image<3>;

impl<const CHANNELS: usize> Image<CHANNELS> {
    /// A black image of the given size, pixels.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, samples: vec![0; CHANNELS * width * height] }
    }

    /// An image from its interleaved samples in row order; `None` unless there are exactly
    /// `CHANNELS * width * height` of them.
    pub fn from_samples(width: usize, height: usize, samples: Vec<u8>) -> Option<Self> {
        let count = width.checked_mul(height)?.checked_mul(CHANNELS)?;
        (samples.len() == count).then_some(Self { width, height, samples })
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All samples in row order, interleaved.
    pub fn samples(&self) -> &[u8] {
        &self.samples
    }

    /// All samples in row order, interleaved and mutable.
    pub fn samples_mut(&mut self) -> &mut [u8] {
        &mut self.samples
    }
}

impl GrayImage {
    /// Takes the samples out of the image, in row order.
    pub fn into_samples(self) -> Vec<u8> {
        self.samples
    }

    /// One row of samples.
    ///
    /// # Panics
    ///
    /// Panics unless `y` is below [`GrayImage::height`].
    pub fn row(&self, y: usize) -> &[u8] {
        &self.samples[y * self.width..][..self.width]
    }

    /// Resizes the image, reusing the allocation where it is large enough. The samples are
    /// unspecified afterwards.
    pub fn resize(&mut self, width: usize, height: usize) {
        self.width = width;
        self.height = height;
        self.samples.resize(width * height, 0);
    }

    /// The gray level at a place, by bilinear interpolation; `None` outside the pixels' centres.
    #[inline]
    pub fn bilinear(&self, x: f64, y: f64) -> Option<f64> {
        if !(x >= 0.0 && y >= 0.0) {
            return None;
        }
        let (left, top) = (x as usize, y as usize);
        let (u, v) = (x - left as f64, y - top as f64);
        if left + 1 >= self.width || top + 1 >= self.height {
            return None;
        }
        let at = top * self.width + left;
        let [a, b] = [self.samples[at], self.samples[at + 1]].map(f64::from);
        let [c, d] = [self.samples[at + self.width], self.samples[at + self.width + 1]].map(f64::from);
        let (above, below) = (a + (b - a) * u, c + (d - c) * u);
        Some(above + (below - above) * v)
    }

    /// Makes `into` the transposed image: its rows are the columns of this one.
    pub fn transpose_into(&self, into: &mut Self) {
        /// Side length of the blocks that are copied one after the other, so that both images are
        /// read and written in lines of the cache.
        const BLOCK: usize = 16;
        into.resize(self.height, self.width);
        for top in (0..self.height).step_by(BLOCK) {
            for left in (0..self.width).step_by(BLOCK) {
                for y in top..(top + BLOCK).min(self.height) {
                    for x in left..(left + BLOCK).min(self.width) {
                        into.samples[x * self.height + y] = self.samples[y * self.width + x];
                    }
                }
            }
        }
    }
}

impl RgbImage {
    /// The colour (red, green, blue) of a pixel.
    ///
    /// # Panics
    ///
    /// Panics outside the image.
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
