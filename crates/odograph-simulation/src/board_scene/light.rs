//! Illumination, lens and sensor effects on the image of a calibration board.

use super::{GaussianStream, mix};
use odograph::image::GrayImage;

/// Degradations of the image of a board. [`BoardEffects::default`] is a sharp, evenly lit image
/// without noise.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardEffects {
    /// Gray level of the ink.
    pub black_gray: f64,
    /// Gray level of the paper.
    pub white_gray: f64,
    /// An object in front of the board.
    pub occlusion: Option<Occlusion>,
    /// Standard deviation of the lens's Gaussian blur, pixels.
    pub blur_px: f64,
    /// Change of the illumination across the image, from left to right and from top to bottom,
    /// relative to that in the centre.
    pub light_gradient: (f64, f64),
    /// Vignetting: relative loss of brightness in the image corners, 0 to 1; quadratic in the
    /// distance from the centre.
    pub vignetting: f64,
    /// Standard deviation of the sensor noise, gray levels.
    pub noise_gray: f64,
    /// Whether the image is mirrored left to right, as by a selfie camera or a mirror.
    /// [`super::BoardScene::true_view`] is not.
    pub mirrored: bool,
    /// Seed of the noise.
    pub seed: u64,
}

/// A gray rectangle in front of the board, in image widths and heights from the top left corner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Occlusion {
    /// Top left corner.
    pub from: (f64, f64),
    /// Bottom right corner.
    pub to: (f64, f64),
}

/// Gray level of an [`Occlusion`]: that of a hand.
const OCCLUSION_GRAY: f32 = 105.0;

impl Default for BoardEffects {
    fn default() -> Self {
        Self {
            black_gray: 30.0,
            white_gray: 215.0,
            occlusion: None,
            blur_px: 0.0,
            light_gradient: (0.0, 0.0),
            vignetting: 0.0,
            noise_gray: 0.0,
            mirrored: false,
            seed: 0,
        }
    }
}

impl BoardEffects {
    /// A typical sharp camera: a blur of 0.7 px, vignetting of 0.2 and noise with a standard
    /// deviation of `noise_gray` gray levels.
    pub fn camera_like(noise_gray: f64, seed: u64) -> Self {
        Self { blur_px: 0.7, noise_gray, vignetting: 0.2, seed, ..Self::default() }
    }

    /// Converts light to 8-bit samples.
    pub(super) fn develop(&self, width: usize, height: usize, mut light: Vec<f32>) -> GrayImage {
        if let Some(Occlusion { from, to }) = self.occlusion {
            let span = |from: f64, to: f64, size: usize| {
                let at = |share: f64| ((share * size as f64).max(0.0) as usize).min(size);
                at(from)..at(to).max(at(from))
            };
            for row in span(from.1, to.1, height) {
                light[row * width..][span(from.0, to.0, width)].fill(OCCLUSION_GRAY);
            }
        }
        if self.blur_px > 0.0 {
            blur(&mut light, width, height, self.blur_px);
        }
        let (across, down) = (self.light_gradient.0 as f32, self.light_gradient.1 as f32);
        let mut noise = GaussianStream::new(mix(self.seed ^ 0xB0A2D));
        let noise_gray = self.noise_gray as f32;
        let mut image = GrayImage::new(width, height);
        let rows = image.samples_mut().chunks_exact_mut(width).zip(light.chunks_exact(width));
        for (row, (samples, light)) in rows.enumerate() {
            let y = (row as f32 + 0.5) / height as f32 - 0.5;
            for (column, (sample, light)) in samples.iter_mut().zip(light).enumerate() {
                let x = (column as f32 + 0.5) / width as f32 - 0.5;
                // 2 (x² + y²) is 1 in the corners.
                let shade = 1.0 - self.vignetting as f32 * 2.0 * (x * x + y * y);
                let mut gray = light * shade * (1.0 + across * x + down * y);
                if noise_gray > 0.0 {
                    gray += noise_gray * noise.sample();
                }
                // The cast saturates at both ends; 0.5 rounds to nearest.
                *sample = (gray + 0.5) as u8;
            }
            if self.mirrored {
                samples.reverse();
            }
        }
        image
    }
}

/// Gaussian blur with replicated border.
fn blur(light: &mut [f32], width: usize, height: usize, sigma_px: f64) {
    let radius = (3.5 * sigma_px).ceil().max(1.0) as usize;
    let weight = |distance: usize| (-0.5 * (distance as f64 / sigma_px).powi(2)).exp();
    let total: f64 = (1..=radius).map(weight).sum::<f64>() * 2.0 + 1.0;
    let kernel: Vec<f32> = (0..=2 * radius).map(|at| (weight(at.abs_diff(radius)) / total) as f32).collect();
    let mut extended = vec![0.0f32; width + 2 * radius];
    for row in light.chunks_exact_mut(width) {
        extended[..radius].fill(row[0]);
        extended[radius..radius + width].copy_from_slice(row);
        extended[radius + width..].fill(row[width - 1]);
        row.fill(0.0);
        for (shift, weight) in kernel.iter().enumerate() {
            for (sum, sample) in row.iter_mut().zip(&extended[shift..]) {
                *sum += weight * sample;
            }
        }
    }
    let sharp = light.to_vec();
    for (y, row) in light.chunks_exact_mut(width).enumerate() {
        row.fill(0.0);
        for (shift, weight) in kernel.iter().enumerate() {
            let from = (y + shift).saturating_sub(radius).min(height - 1);
            for (sum, sample) in row.iter_mut().zip(&sharp[from * width..][..width]) {
                *sum += weight * sample;
            }
        }
    }
}
