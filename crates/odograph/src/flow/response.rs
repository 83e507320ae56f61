//! How a template answers to what is not the same all over it.
//!
//! Lucas–Kanade finds a patch where, weighted by its gradients, image and template differ least. Where the true warp is curved (a lens) that is not where its
//! centre is: the gradients of a corner lie about its middle, and feel less of the curvature than the patch as a whole has. And where the light grows across
//! it (vignetting, a lamp, a soft shadow), what is brighter pulls: after integration by parts by half of its growth times the squared contrast over the squared
//! gradient, always the same way, the more the smoother the ground. Both are small, some thousandths of a pixel, and both are the same for all corners, so that
//! no number of them averages them away.

use super::Noise;
use super::patch::SIDE;
use crate::image::simd::Moments;
use nalgebra::{Matrix2, Vector2};

/// See the [module](self).
#[derive(Debug, Clone, Copy)]
pub struct Response<'a> {
    moments: &'a Moments,
    noise: Noise,
}

/// The mean square of a sample's place from the middle of a patch, along one axis.
const MEAN_SQUARE_PX2: f64 = ((SIDE * SIDE - 1) as f64) / 12.0;

impl<'a> Response<'a> {
    /// Of a patch with these moments. Its noise adds to them as gradients, but what is found answers only to those that are in both images.
    pub(super) fn new(moments: &'a Moments, noise: Noise) -> Self {
        Self { moments, noise }
    }

    /// How far from its centre the template is found where its warp has this linear part and this curvature (second derivatives by (x, x), (x, y) and
    /// (y, y), pixels by pixels²).
    pub fn to_curvature(&self, linear: &Matrix2<f64>, curvature: &[Vector2<f64>; 3]) -> Vector2<f64> {
        let Some(inverse) = linear.try_inverse() else { return Vector2::zeros() };
        let [xx, xy, yx, yy] = self.moments.squares;
        let of_noise = self.noise.of_gradients() * MEAN_SQUARE_PX2;
        let square = |k: usize, of_noise: f64, bent: &Vector2<f64>| {
            Matrix2::new(xx[k] - of_noise, xy[k], yx[k], yy[k] - of_noise) * (inverse * bent)
        };
        let [by_xx, by_xy, by_yy] = curvature;
        let sum = square(0, of_noise, by_xx) * 0.5 + square(1, 0.0, by_xy) + square(2, of_noise, by_yy) * 0.5;
        linear * (self.noise.inverse_hessian * sum)
    }

    /// How far from its centre the template is found, under a warp with this linear part, where the logarithm of the light grows by `slope` a pixel
    /// of the image.
    pub fn to_light(&self, linear: &Matrix2<f64>, slope: Vector2<f64>) -> Vector2<f64> {
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

    /// Gray levels at a place: waves of 9 to 40 pixels in all directions.
    fn ground(seed: f64, place: Vector2<f64>) -> f64 {
        let wave = |k: usize| {
            let (number, period) = (k as f64, 9.0 * 1.16f64.powi(k as i32));
            let (sin, cos) = (2.4 * number + seed).sin_cos();
            9.0 * ((place.x * cos + place.y * sin) * std::f64::consts::TAU / period + 7.0 * seed * number)
                .sin()
        };
        120.0 + (0..10).map(wave).sum::<f64>()
    }

    /// Where templates are found whose ground is curved and lit unevenly, less where the response says, root mean square, pixels; and less only what
    /// a patch with gradients everywhere alike would answer.
    fn off_px(linear: Matrix2<f64>, curvature: [Vector2<f64>; 3], slope: Vector2<f64>) -> (f64, f64) {
        let centre = Vector2::new(31.5, 31.5);
        let there = centre + Vector2::new(0.31, -0.23);
        let picture = |of: &dyn Fn(Vector2<f64>) -> f64| {
            let sample = |at: usize| of(Vector2::new((at % 64) as f64, (at / 64) as f64)).round() as u8;
            Pyramid::new(GrayImage::from_samples(64, 64, (0..64 * 64).map(sample).collect()).unwrap(), 1)
        };
        let [xx, xy, yy] = curvature;
        let bent = |u: Vector2<f64>| xx * (0.5 * u.x * u.x) + xy * (u.x * u.y) + yy * (0.5 * u.y * u.y);
        let inverse = linear.try_inverse().unwrap();
        let (mut left, mut uniform) = (0.0, 0.0);
        let seeds = 40;
        for seed in 0..seeds {
            let seed = f64::from(seed);
            let keyframe = picture(&|place| ground(seed, place - centre));
            let image = picture(&|place| {
                // The place on the keyframe that is seen here.
                let mut u = inverse * (place - there);
                for _ in 0..20 {
                    u = inverse * (place - there - bent(u));
                }
                ground(seed, u) * (slope.dot(&(place - there))).exp()
            });
            let template = Template::new(&keyframe, (31, 31)).unwrap();
            let prediction = Warp { position: Pixel::new(there.x, there.y), linear };
            let found = track(&template, &image, &prediction, 0.5, &FlowConfig::default()).unwrap();
            let off = Vector2::new(found.position.x, found.position.y) - there;
            let response = template.response(found.noise);
            let expected = response.to_curvature(&linear, &curvature) + response.to_light(&linear, slope);
            left += (off - expected).norm_squared() / f64::from(seeds);
            uniform += (off - (xx + yy) * (0.5 * 255.0 / 12.0)).norm_squared() / f64::from(seeds);
        }
        (left.sqrt(), uniform.sqrt())
    }

    #[test]
    fn what_bends_a_patch_and_what_lights_it_unevenly_shifts_it_as_told() {
        let turned = Matrix2::new(0.9, -0.4, 0.35, 1.0);
        let curvature = [Vector2::new(3e-3, 5e-4), Vector2::new(-5e-4, 1e-3), Vector2::new(1e-3, 2e-3)];
        for linear in [Matrix2::identity(), turned] {
            // Rounding to gray levels and interpolation, which every track has.
            let (floor, _) = off_px(linear, Default::default(), Vector2::zeros());
            let beyond = |off: f64| (off * off - floor * floor).max(0.0).sqrt();
            let (left, uniform) = off_px(linear, curvature, Vector2::zeros());
            println!("bent: {left:.4} px, {uniform:.4} by the mean over the patch, {floor:.4} without");
            assert!(beyond(left) < 0.5 * beyond(uniform) && floor < 0.02, "{left} {uniform} {floor}");
            let (left, ignored) = off_px(linear, Default::default(), Vector2::new(1.5e-3, -1e-3));
            println!("lit: {left:.4} px, {ignored:.4} px where it is ignored");
            assert!(beyond(left) < 0.15 * beyond(ignored), "{left} {ignored} {floor}");
        }
    }
}
