//! Bias of a match by errors of the model: curvature of the warp and the gradient of the
//! illumination.
//!
//! Lucas–Kanade minimises a difference that is weighted by the gradients. Under a curved warp (lens
//! distortion) the minimum is not the displacement of the centre: a corner's gradients are
//! concentrated about its middle and see less of the curvature than the whole patch. A gradient of
//! the illumination (vignetting, a lamp, a soft shadow) shifts the minimum towards the brighter
//! side. Both are some thousandths of a pixel and equal for all corners, so that no number of them
//! averages them out. Derivation: `docs/math/interpolation-bias.md`.

use super::Noise;
use super::patch::SIDE;
use crate::image::simd::Moments;
use nalgebra::{Matrix2, Vector2};

/// See the [module](self).
#[derive(Debug, Clone, Copy)]
pub struct ModelBias<'a> {
    moments: &'a Moments,
    noise: Noise,
}

/// Mean squared distance of the samples from the centre of a patch along one axis, pixels².
const MEAN_SQUARE_PX2: f64 = ((SIDE * SIDE - 1) as f64) / 12.0;

impl<'a> ModelBias<'a> {
    /// For a patch with these moments. Noise adds to the moments of the gradients and is
    /// subtracted.
    pub(super) fn new(moments: &'a Moments, noise: Noise) -> Self {
        Self { moments, noise }
    }

    /// Displacement of the match by the curvature of the warp, pixels; `curvature` holds the second
    /// derivatives by (x, x), (x, y) and (y, y), pixels per pixel².
    pub fn by_curvature(&self, linear: &Matrix2<f64>, curvature: &[Vector2<f64>; 3]) -> Vector2<f64> {
        let Some(inverse) = linear.try_inverse() else { return Vector2::zeros() };
        let [xx, xy, yx, yy] = self.moments.squares;
        let noise_part = self.noise.gradient_noise() * MEAN_SQUARE_PX2;
        let moment = |k: usize, noise_part: f64, curved: &Vector2<f64>| {
            Matrix2::new(xx[k] - noise_part, xy[k], yx[k], yy[k] - noise_part) * (inverse * curved)
        };
        let [by_xx, by_xy, by_yy] = curvature;
        let sum =
            moment(0, noise_part, by_xx) * 0.5 + moment(1, 0.0, by_xy) + moment(2, noise_part, by_yy) * 0.5;
        linear * (self.noise.inverse_hessian * sum)
    }

    /// Displacement of the match by the gradient of the logarithmic illumination, `slope` per pixel
    /// of the image, pixels.
    pub fn by_illumination(&self, linear: &Matrix2<f64>, slope: Vector2<f64>) -> Vector2<f64> {
        let [x, y] = self.moments.light;
        -(linear
            * (self.noise.inverse_hessian * (Matrix2::new(x[0], x[1], y[0], y[1]) * linear.tr_mul(&slope))))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{FlowConfig, Template, Warp, track};
    use super::*;
    use crate::geometry::Pixel;
    use crate::image::{GrayImage, Pyramid};
    use nalgebra::Vector2;

    /// Gray level at a place: waves of 9 to 40 pixels in all directions.
    fn ground(seed: f64, place: Vector2<f64>) -> f64 {
        let wave = |k: usize| {
            let (number, period) = (k as f64, 9.0 * 1.16f64.powi(k as i32));
            let (sin, cos) = (2.4 * number + seed).sin_cos();
            9.0 * ((place.x * cos + place.y * sin) * std::f64::consts::TAU / period + 7.0 * seed * number)
                .sin()
        };
        120.0 + (0..10).map(wave).sum::<f64>()
    }

    /// Root mean square errors of matches of curved and unevenly lit ground, pixels: corrected by
    /// the model, and by the mean displacement over the patch.
    fn off_px(linear: Matrix2<f64>, curvature: [Vector2<f64>; 3], slope: Vector2<f64>) -> (f64, f64) {
        let centre = Vector2::new(31.5, 31.5);
        let there = centre + Vector2::new(0.31, -0.23);
        let picture = |of: &dyn Fn(Vector2<f64>) -> f64| {
            let sample = |at: usize| of(Vector2::new((at % 64) as f64, (at / 64) as f64)).round() as u8;
            Pyramid::new(GrayImage::from_samples(64, 64, (0..64 * 64).map(sample).collect()).unwrap(), 1)
        };
        let [xx, xy, yy] = curvature;
        let curved = |u: Vector2<f64>| xx * (0.5 * u.x * u.x) + xy * (u.x * u.y) + yy * (0.5 * u.y * u.y);
        let inverse = linear.try_inverse().unwrap();
        let (mut left, mut uniform) = (0.0, 0.0);
        let seeds = 40;
        for seed in 0..seeds {
            let seed = f64::from(seed);
            let keyframe = picture(&|place| ground(seed, place - centre));
            let image = picture(&|place| {
                // Inverse of the curved warp by fixed-point iteration.
                let mut u = inverse * (place - there);
                for _ in 0..20 {
                    u = inverse * (place - there - curved(u));
                }
                ground(seed, u) * (slope.dot(&(place - there))).exp()
            });
            let template = Template::new(&keyframe, (31, 31)).unwrap();
            let prediction = Warp { position: Pixel::new(there.x, there.y), linear };
            let found = track(&template, &image, &prediction, 0.5, &FlowConfig::default()).unwrap();
            let off = Vector2::new(found.position.x, found.position.y) - there;
            let model_bias = template.model_bias(found.noise);
            let expected =
                model_bias.by_curvature(&linear, &curvature) + model_bias.by_illumination(&linear, slope);
            left += (off - expected).norm_squared() / f64::from(seeds);
            uniform += (off - (xx + yy) * (0.5 * 255.0 / 12.0)).norm_squared() / f64::from(seeds);
        }
        (left.sqrt(), uniform.sqrt())
    }

    #[test]
    fn bias_by_curvature_and_illumination_is_as_computed() {
        let rotation = Matrix2::new(0.9, -0.4, 0.35, 1.0);
        let curvature = [Vector2::new(3e-3, 5e-4), Vector2::new(-5e-4, 1e-3), Vector2::new(1e-3, 2e-3)];
        for linear in [Matrix2::identity(), rotation] {
            // The floor: rounding to gray levels, and interpolation.
            let (floor, _) = off_px(linear, Default::default(), Vector2::zeros());
            let beyond = |off: f64| (off * off - floor * floor).max(0.0).sqrt();
            let (left, uniform) = off_px(linear, curvature, Vector2::zeros());
            println!("curved: {left:.4} px, {uniform:.4} by the mean over the patch, {floor:.4} without");
            assert!(beyond(left) < 0.5 * beyond(uniform) && floor < 0.02, "{left} {uniform} {floor}");
            let (left, ignored) = off_px(linear, Default::default(), Vector2::new(1.5e-3, -1e-3));
            println!("lit: {left:.4} px, {ignored:.4} px where it is ignored");
            assert!(beyond(left) < 0.15 * beyond(ignored), "{left} {ignored} {floor}");
        }
    }
}
