//! Photographs of floors, tiled over the ground plane.

use super::noise::{LatticeCache, cell, fractal};
use odograph::error::{Error, Result};
use odograph::image::RgbImage;
use serde::{Deserialize, Serialize};

/// Tiling of the ground plane with a photograph.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Tiling {
    /// Repeated side by side, for photographs with matching edges.
    Repeat,
    /// Every other copy mirrored: seamless for any photograph.
    Mirror,
    /// Random patches of the photograph, blended with preserved variance, so that nothing repeats.
    /// For stochastic textures such as asphalt or grass (E. Heitz and F. Neyret, "High-performance
    /// by-example noise using a histogram-preserving blending operator", 2018; here the variance is
    /// preserved, not the whole histogram).
    Scatter,
}

/// A photograph of the ground with its scale.
#[derive(Debug)]
pub struct Photograph {
    levels: Vec<PhotographLevel>,
    metres_per_pixel: f64,
    tiling: Tiling,
    mean: [f32; 3],
}

/// A level of the image pyramid: means of 2 × 2 pixels of the level below.
#[derive(Debug)]
struct PhotographLevel {
    width: usize,
    height: usize,
    samples: Vec<[f32; 3]>,
}

impl Photograph {
    pub(super) fn new(image: &RgbImage, metres_per_pixel: f64, tiling: Tiling) -> Result<Self> {
        let (width, height) = (image.width(), image.height());
        if width < 8 || height < 8 {
            return Err(Error::input(format!(
                "a photograph of {width}x{height} pixels is too small to cover the ground; 8x8 is the least"
            )));
        }
        if !(metres_per_pixel.is_finite() && metres_per_pixel > 0.0) {
            return Err(Error::usage(format!(
                "the photograph's scale is {metres_per_pixel} metres per pixel; it must be positive"
            )));
        }
        let samples: Vec<[f32; 3]> = image
            .samples()
            .chunks_exact(3)
            .map(|p| [f32::from(p[0]), f32::from(p[1]), f32::from(p[2])])
            .collect();
        let mean = std::array::from_fn(|c| {
            (samples.iter().map(|s| f64::from(s[c])).sum::<f64>() / samples.len() as f64) as f32
        });
        let mut levels = vec![PhotographLevel { width, height, samples }];
        while let Some(next) = levels.last().and_then(PhotographLevel::halved) {
            levels.push(next);
        }
        Ok(Self { levels, metres_per_pixel, tiling, mean })
    }

    /// Colour at a ground point; see [`super::Texture::color`].
    pub(super) fn color(
        &self,
        cache: &mut LatticeCache,
        seed: u32,
        at: (f64, f64),
        footprint_m: f64,
    ) -> [f32; 3] {
        // Interpolates between the two levels whose pixels are about as large as the footprint,
        // biased towards the coarser one.
        let fineness =
            ((footprint_m / self.metres_per_pixel).log2() + 0.3).clamp(0.0, (self.levels.len() - 1) as f64);
        let (index, share) = (fineness as usize, fineness.fract() as f32);
        let mut color = self.color_at_level(seed, at, index);
        if share > 0.0 {
            let coarser = self.color_at_level(seed, at, index + 1);
            color = std::array::from_fn(|c| color[c] + share * (coarser[c] - color[c]));
        }
        // Low-frequency variation of brightness and tint over metres, so that tiles differ at large
        // scale.
        let light = 1.0 + 0.10 * fractal(cache, seed ^ 91, at, footprint_m, 1.7, 3, 0.6);
        let warmth = 0.04 * fractal(cache, seed ^ 92, at, footprint_m, 2.3, 2, 0.6);
        [color[0] * light * (1.0 + warmth), color[1] * light, color[2] * light * (1.0 - warmth)]
            .map(|v| v.clamp(0.0, 255.0))
    }

    fn color_at_level(&self, seed: u32, at: (f64, f64), index: usize) -> [f32; 3] {
        let level = &self.levels[index];
        let scale = self.metres_per_pixel * (1u64 << index) as f64;
        match self.tiling {
            Tiling::Repeat => level.bicubic(at.0 / scale, at.1 / scale, wrap),
            Tiling::Mirror => level.bicubic(at.0 / scale, at.1 / scale, mirror),
            Tiling::Scatter => self.scattered(seed, at, level, scale),
        }
    }

    /// Blends three patches, one for each vertex of the triangle of the skewed grid that contains
    /// the point.
    fn scattered(&self, seed: u32, (x, y): (f64, f64), level: &PhotographLevel, scale: f64) -> [f32; 3] {
        let width_m = self.levels[0].width as f64 * self.metres_per_pixel;
        let height_m = self.levels[0].height as f64 * self.metres_per_pixel;
        // A patch extends one grid step around its vertex. Its centre keeps that distance from the
        // border of the photograph.
        let grid = 0.25 * width_m.min(height_m);
        // The skew maps squares to rhombi of two equilateral triangles.
        let (u, v) = ((x - 0.577_350_269 * y) / grid, 1.154_700_538 * y / grid);
        let (i, j) = (u.floor(), v.floor());
        let (fu, fv) = ((u - i) as f32, (v - j) as f32);
        let (i, j) = (i as i64 as i32, j as i64 as i32);
        let corners = if fu + fv < 1.0 {
            [(i, j, 1.0 - fu - fv), (i + 1, j, fu), (i, j + 1, fv)]
        } else {
            [(i + 1, j + 1, fu + fv - 1.0), (i, j + 1, 1.0 - fu), (i + 1, j, 1.0 - fv)]
        };
        // Cubed weights make the blended borders narrow.
        let weights = corners.map(|(_, _, w)| w * w * w);
        let total: f32 = weights.iter().sum();
        let mut sum = [0.0f32; 3];
        let mut square = 0.0;
        for ((i, j, _), weight) in corners.into_iter().zip(weights) {
            let weight = weight / total;
            square += weight * weight;
            if weight < 1e-3 {
                continue;
            }
            let (corner_x, corner_y) =
                ((f64::from(i) + 0.5 * f64::from(j)) * grid, f64::from(j) * grid * 0.866_025_404);
            let center = |seed: u32, size_m: f64| grid + f64::from(cell(seed, i, j)) * (size_m - 2.0 * grid);
            let piece_x = center(seed ^ 93, width_m) + x - corner_x;
            let piece_y = center(seed ^ 94, height_m) + y - corner_y;
            let piece = level.bicubic(piece_x / scale, piece_y / scale, mirror);
            for c in 0..3 {
                sum[c] += weight * (piece[c] - self.mean[c]);
            }
        }
        // Blending independent patches scales the variance by the sum of squared weights; dividing
        // by its square root restores it.
        let gain = 1.0 / square.sqrt();
        std::array::from_fn(|c| self.mean[c] + gain * sum[c])
    }
}

impl PhotographLevel {
    fn halved(&self) -> Option<Self> {
        let (width, height) = (self.width / 2, self.height / 2);
        if width < 8 || height < 8 {
            return None;
        }
        let at = |x: usize, y: usize, c: usize| self.samples[y * self.width + x][c];
        let samples = (0..width * height)
            .map(|i| {
                let (x, y) = (2 * (i % width), 2 * (i / width));
                std::array::from_fn(|c| {
                    0.25 * (at(x, y, c) + at(x + 1, y, c) + at(x, y + 1, c) + at(x + 1, y + 1, c))
                })
            })
            .collect();
        Some(Self { width, height, samples })
    }

    /// Catmull–Rom interpolation. Pixel coordinates are measured from the outer corner of the
    /// image, so that all levels are aligned.
    fn bicubic(&self, x: f64, y: f64, fold: fn(i64, i64) -> usize) -> [f32; 3] {
        let (x, y) = (x - 0.5, y - 0.5);
        let (left, top) = (x.floor(), y.floor());
        let weights_x = cubic_weights((x - left) as f32);
        let weights_y = cubic_weights((y - top) as f32);
        let (left, top) = (left as i64, top as i64);
        let columns: [usize; 4] = std::array::from_fn(|i| fold(left - 1 + i as i64, self.width as i64));
        let mut sum = [0.0f32; 3];
        for (j, weight_y) in weights_y.into_iter().enumerate() {
            let row = fold(top - 1 + j as i64, self.height as i64) * self.width;
            for (column, weight_x) in columns.into_iter().zip(weights_x) {
                let sample = &self.samples[row + column];
                for c in 0..3 {
                    sum[c] += weight_x * weight_y * sample[c];
                }
            }
        }
        sum
    }
}

fn wrap(i: i64, size: i64) -> usize {
    i.rem_euclid(size) as usize
}

fn mirror(i: i64, size: i64) -> usize {
    let there = i.rem_euclid(2 * size);
    there.min(2 * size - 1 - there) as usize
}

/// Catmull–Rom weights of four samples for a point at the fraction `t` between the second and the
/// third (R. Keys, "Cubic convolution interpolation for digital image processing", 1981, a = −1/2).
#[inline]
pub(super) fn cubic_weights(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [-0.5 * t + t2 - 0.5 * t3, 1.0 - 2.5 * t2 + 1.5 * t3, 0.5 * t + 2.0 * t2 - 1.5 * t3, -0.5 * t2 + 0.5 * t3]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn speckled() -> RgbImage {
        let samples = (0..64 * 48 * 3).map(|i| (cell(1, i / 3, 0) * 255.0) as u8).collect();
        RgbImage::from_samples(64, 48, samples).unwrap()
    }

    #[test]
    fn mirrored_photographs_have_no_seams() {
        let photograph = Photograph::new(&speckled(), 0.01, Tiling::Mirror).unwrap();
        let edge = 0.64;
        let before = photograph.color(&mut LatticeCache::default(), 0, (edge - 1e-6, 0.2), 0.01);
        let after = photograph.color(&mut LatticeCache::default(), 0, (edge + 1e-6, 0.2), 0.01);
        assert!((0..3).all(|c| (before[c] - after[c]).abs() < 0.1), "{before:?} {after:?}");
    }

    #[test]
    fn scattered_photographs_preserve_contrast_and_do_not_repeat() {
        let photograph = Photograph::new(&speckled(), 0.01, Tiling::Scatter).unwrap();
        let line = |offset: f64| -> Vec<f64> {
            (0..4000)
                .map(|i| {
                    f64::from(
                        photograph.color(
                            &mut LatticeCache::default(),
                            4,
                            (offset + f64::from(i) * 0.01, 0.3),
                            0.01,
                        )[1],
                    )
                })
                .collect()
        };
        let (here, there) = (line(0.0), line(0.64));
        let deviation = |v: &[f64]| {
            let mean = v.iter().sum::<f64>() / v.len() as f64;
            (v.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / v.len() as f64).sqrt()
        };
        let difference: Vec<f64> = here.iter().zip(&there).map(|(a, b)| a - b).collect();
        // Uniform speckles have a standard deviation of 74; clamping to 0 to 255 and the
        // interpolation reduce it.
        assert!(deviation(&here) > 45.0, "{}", deviation(&here));
        assert!(deviation(&difference) > deviation(&here), "one period on, the ground is the same");
    }

    #[test]
    fn unusable_photographs_are_rejected() {
        assert!(Photograph::new(&RgbImage::new(4, 4), 0.01, Tiling::Repeat).is_err());
        assert!(Photograph::new(&speckled(), f64::NAN, Tiling::Repeat).is_err());
    }
}
