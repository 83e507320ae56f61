//! Bias of a match by the curvature of the warp.
//!
//! Lucas–Kanade minimises a difference that is weighted by the gradients. Under a curved warp (lens
//! distortion) the minimum is not the displacement of the centre: a corner's gradients are
//! concentrated about its middle and see less of the curvature than the whole patch. That is some
//! thousandths of a pixel and equal for all corners, so that no number of them averages it out.
//! Derivation: `docs/math/interpolation-bias.md`.

use super::Noise;
use super::patch::SIDE;
use crate::image::simd::Moments;
use nalgebra::{Matrix2, Vector2};

/// Mean squared distance of the samples from the centre of a patch along one axis, pixels².
const MEAN_SQUARE_PX2: f64 = ((SIDE * SIDE - 1) as f64) / 12.0;

/// Displacement of a match with this noise by the curvature of the warp, pixels, for a template
/// with these moments; `curvature` holds the second derivatives by (x, x), (x, y) and (y, y),
/// pixels per pixel². Noise adds to the moments of the gradients and is subtracted.
pub(super) fn curvature_bias(
    [xx, xy, yx, yy]: &Moments,
    noise: &Noise,
    linear: &Matrix2<f64>,
    curvature: &[Vector2<f64>; 3],
) -> Vector2<f64> {
    let Some(inverse) = linear.try_inverse() else { return Vector2::zeros() };
    let noise_part = noise.gradient_noise() * MEAN_SQUARE_PX2;
    let moment = |k: usize, noise_part: f64, curved: &Vector2<f64>| {
        Matrix2::new(xx[k] - noise_part, xy[k], yx[k], yy[k] - noise_part) * (inverse * curved)
    };
    let [by_xx, by_xy, by_yy] = curvature;
    let sum = moment(0, noise_part, by_xx) * 0.5 + moment(1, 0.0, by_xy) + moment(2, noise_part, by_yy) * 0.5;
    linear * (noise.inverse_hessian * sum)
}

#[cfg(test)]
mod tests {
    use super::super::{FlowConfig, Template, Warp, track};
    use crate::geometry::Pixel;
    use crate::image::{GrayImage, Pyramid};
    use nalgebra::{Matrix2, Vector2};

    /// Gray level at a place: waves in all directions, from the finest period to four times that.
    fn ground(finest: f64, seed: f64, place: Vector2<f64>) -> f64 {
        let wave = |k: usize| {
            let (number, period) = (k as f64, finest * 1.16f64.powi(k as i32));
            let (sin, cos) = (2.4 * number + seed).sin_cos();
            9.0 * ((place.x * cos + place.y * sin) * std::f64::consts::TAU / period + 7.0 * seed * number)
                .sin()
        };
        120.0 + (0..10).map(wave).sum::<f64>()
    }

    /// Root mean square errors of matches of curved and unevenly lit ground, pixels: corrected by
    /// the model, and by the mean displacement over the patch.
    fn off_px(
        finest: f64,
        linear: Matrix2<f64>,
        curvature: [Vector2<f64>; 3],
        slope: Vector2<f64>,
    ) -> (f64, f64) {
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
            let keyframe = picture(&|place| ground(finest, seed, place - centre));
            let image = picture(&|place| {
                // Inverse of the curved warp by fixed-point iteration.
                let mut u = inverse * (place - there);
                for _ in 0..20 {
                    u = inverse * (place - there - curved(u));
                }
                ground(finest, seed, u) * (slope.dot(&(place - there))).exp()
            });
            let template = Template::new(&keyframe, (31, 31)).unwrap();
            let prediction = Warp { position: Pixel::new(there.x, there.y), linear };
            let found = track(&template, &image, &prediction, 0.5, &FlowConfig::default()).unwrap();
            let off = Vector2::new(found.position.x, found.position.y) - there;
            let expected = template.curvature_bias(&found.noise, &linear, &curvature);
            left += (off - expected).norm_squared() / f64::from(seeds);
            uniform += (off - (xx + yy) * (0.5 * 255.0 / 12.0)).norm_squared() / f64::from(seeds);
        }
        (left.sqrt(), uniform.sqrt())
    }

    #[test]
    fn bias_by_curvature_is_as_computed() {
        let rotation = Matrix2::new(0.9, -0.4, 0.35, 1.0);
        let curvature = [Vector2::new(3e-3, 5e-4), Vector2::new(-5e-4, 1e-3), Vector2::new(1e-3, 2e-3)];
        for linear in [Matrix2::identity(), rotation] {
            // The floor: rounding to gray levels, and interpolation.
            let (floor, _) = off_px(9.0, linear, Default::default(), Vector2::zeros());
            let beyond = |off: f64| (off * off - floor * floor).max(0.0).sqrt();
            let (left, uniform) = off_px(9.0, linear, curvature, Vector2::zeros());
            println!("curved: {left:.4} px, {uniform:.4} by the mean over the patch, {floor:.4} without");
            assert!(beyond(left) < 0.5 * beyond(uniform) && floor < 0.02, "{left} {uniform} {floor}");
        }
    }

    #[test]
    fn light_that_changes_over_a_patch_moves_no_match() {
        let rotation = Matrix2::new(0.9, -0.4, 0.35, 1.0);
        for linear in [Matrix2::identity(), rotation] {
            let (floor, _) = off_px(4.0, linear, Default::default(), Vector2::zeros());
            // By 0.2 gray levels per pixel, as vignetting, and by 1, as a soft shadow or a lamp. In
            // patches of waves alone: what is left is that light multiplies the contrast, too.
            let (vignetted, _) = off_px(4.0, linear, Default::default(), Vector2::new(1.5e-3, -1e-3));
            let (shadowed, _) = off_px(4.0, linear, Default::default(), Vector2::new(7.5e-3, -5e-3));
            println!("vignetted: {vignetted:.4} px, shadowed: {shadowed:.4} px, {floor:.4} without");
            assert!(vignetted < 1.2 * floor && shadowed < 2.0 * floor, "{vignetted} {shadowed} {floor}");
        }
    }
}
