//! The frame being added, reduced to the resolution of the ground, with bilinear sampling.

use super::MosaicSource;
use crate::fixed_pattern::ImageMask;
use crate::geometry::Pixel;
use crate::image::simd::ground::{Feather, UnrectifiedFrame};
use std::sync::Arc;

/// A frame's samples, one or three channels, halved `level` times.
#[derive(Debug, Clone, Default)]
pub(super) struct FrameSamples {
    width: usize,
    height: usize,
    channels: usize,
    /// Columns and rows of the full image.
    full: (usize, usize),
    /// Pixels of these samples per pixel of the full image.
    scale: f32,
    /// Greatest coordinates between which can be sampled.
    right: f32,
    bottom: f32,
    samples: Vec<u8>,
    spare: Vec<u8>,
    /// What of the full image is not ground.
    mask: Option<Arc<ImageMask>>,
}

impl FrameSamples {
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Columns and rows of the full image.
    pub fn full_size(&self) -> (usize, usize) {
        self.full
    }

    /// Takes a frame, halved `level` times (fewer where it has no pixels left to halve) by means of
    /// 2 × 2 pixels. What the mask covers has the mean colour of the rest, so that it hardly shows
    /// in the means along its border.
    pub fn take(&mut self, image: MosaicSource<'_>, mask: Option<&Arc<ImageMask>>, level: u32) {
        let (width, height, channels, samples) = match image {
            MosaicSource::Gray(gray) => (gray.width(), gray.height(), 1, gray.samples()),
            MosaicSource::Rgb(rgb) => (rgb.width(), rgb.height(), 3, rgb.samples()),
        };
        (self.width, self.height, self.channels, self.scale) = (width, height, channels, 1.0);
        self.full = (width, height);
        self.samples.clear();
        self.samples.extend_from_slice(samples);
        self.mask = mask.cloned();
        if let Some(mask) = mask {
            self.fill(mask);
        }
        for _ in 0..level {
            if self.width < 4 || self.height < 4 {
                break;
            }
            self.halve();
        }
        (self.right, self.bottom) = (self.width as f32 - 1.0, self.height as f32 - 1.0);
    }

    /// The frame prepared for blending, its samples multiplied by `gains`; `None` if it has too few
    /// of them.
    pub fn unrectified<const N: usize>(
        &self,
        feather: Feather,
        gains: [f32; N],
    ) -> Option<UnrectifiedFrame<'_, N>> {
        UnrectifiedFrame::new(&self.samples, (self.width, self.height), self.scale, feather, gains)
    }

    /// Gives what the mask covers the mean colour of the rest. The samples are those of the full
    /// image.
    fn fill(&mut self, mask: &ImageMask) {
        let (width, n) = (self.width, self.channels);
        let (mut sums, mut count) = ([0u64; 3], 0u64);
        for (at, pixel) in self.samples.chunks_exact(n).enumerate() {
            if !mask.covers(at % width, at / width) {
                sums.iter_mut().zip(pixel).for_each(|(sum, &sample)| *sum += u64::from(sample));
                count += 1;
            }
        }
        let mean = sums.map(|sum| (sum / count.max(1)) as u8);
        for (at, pixel) in self.samples.chunks_exact_mut(n).enumerate() {
            if mask.covers(at % width, at / width) {
                pixel.copy_from_slice(&mean[..n]);
            }
        }
    }

    /// Whether a pixel of the full image is known not to show the ground.
    #[inline]
    pub fn is_masked(&self, x: f32, y: f32) -> bool {
        self.mask.as_ref().is_some_and(|mask| mask.covers_pixel(Pixel::new(f64::from(x), f64::from(y))))
    }

    /// Whether anything is masked.
    pub fn has_mask(&self) -> bool {
        self.mask.is_some()
    }

    fn halve(&mut self) {
        let (width, height, n) = (self.width / 2, self.height / 2, self.channels);
        self.spare.clear();
        for y in 0..height {
            let above = &self.samples[2 * y * self.width * n..];
            let below = &self.samples[(2 * y + 1) * self.width * n..];
            for x in 0..width {
                for channel in 0..n {
                    let at = 2 * x * n + channel;
                    let sum = [above[at], above[at + n], below[at], below[at + n]]
                        .map(u16::from)
                        .iter()
                        .sum::<u16>();
                    self.spare.push(((sum + 2) / 4) as u8);
                }
            }
        }
        std::mem::swap(&mut self.samples, &mut self.spare);
        (self.width, self.height) = (width, height);
        self.scale *= 0.5;
    }

    /// The bilinear sample at a pixel of the full image; `None` outside the centres of its
    /// outermost pixels and where it is masked.
    #[inline]
    pub fn at<const N: usize>(&self, x: f32, y: f32) -> Option<[f32; N]> {
        if self.is_masked(x, y) {
            return None;
        }
        let (x, y) = self.reduced(x, y);
        let inside = x >= 0.0 && y >= 0.0 && x <= self.right && y <= self.bottom;
        if !(inside && self.width > 1 && self.height > 1) {
            return None;
        }
        self.bilinear(x, y)
    }

    /// The bilinear sample at the place nearest to a pixel of the full image that has one.
    #[inline]
    pub fn nearest_at<const N: usize>(&self, x: f32, y: f32) -> [f32; N] {
        let (x, y) = self.reduced(x, y);
        self.bilinear(x.clamp(0.0, self.right), y.clamp(0.0, self.bottom)).unwrap_or([0.0; N])
    }

    /// A pixel of the full image in pixels of these samples.
    #[inline]
    fn reduced(&self, x: f32, y: f32) -> (f32, f32) {
        let offset = 0.5 * self.scale - 0.5;
        (x * self.scale + offset, y * self.scale + offset)
    }

    #[inline]
    fn bilinear<const N: usize>(&self, x: f32, y: f32) -> Option<[f32; N]> {
        let left = (x as usize).min(self.width.saturating_sub(2));
        let top = (y as usize).min(self.height.saturating_sub(2));
        let (dx, dy) = (x - left as f32, y - top as f32);
        let at = (top * self.width + left) * N;
        let above = self.samples.get(at..at + 2 * N)?;
        let below = self.samples.get(at + self.width * N..at + self.width * N + 2 * N)?;
        let mut sample = [0.0; N];
        for (channel, value) in sample.iter_mut().enumerate() {
            let (a, b) = (f32::from(above[channel]), f32::from(above[channel + N]));
            let (c, d) = (f32::from(below[channel]), f32::from(below[channel + N]));
            let (up, down) = (a + (b - a) * dx, c + (d - c) * dx);
            *value = up + (down - up) * dy;
        }
        Some(sample)
    }
}
