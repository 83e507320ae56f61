//! Interpolation bias: the systematic error of a match by bilinear sampling of the image between
//! pixels (H. Schreier, J. Braasch and M. Sutton, 2000). Derivation:
//! `docs/math/interpolation-bias.md`.
//!
//! *Phase error.* A wave of frequency ω sampled at the subpixel phase φ appears closer to the
//! nearest pixel by φ (1 − φ) (1 − 2 φ) ω² / 6, to third order in ω: up to 0.02 px for fine
//! texture. If the whole image has moved by about the same phase, the error is equal for all
//! corners and no number of them averages it out; if a lens varies the phase over the image, it
//! looks like a tilt.
//!
//! *Smoothing.* A sample at φ has ½ φ (1 − φ) times the second difference added. Summed over a
//! patch this biases the match by half the difference of the squared gradient between opposite
//! borders. A patch has an even side and a corner is not at its centre, so the bias has a preferred
//! sign: ground under motion blur, fine across the motion and smooth along it, is biased along the
//! motion.

use super::level_template::LevelTemplate;
use super::noise::Noise;
use super::patch::{AREA, SIDE, TO_CENTRE};
use super::subpixel_phase::{fraction, phase_coherence};
use crate::image::GrayImage;
use crate::image::simd::bend_products;
use nalgebra::{Matrix2, Vector2};

/// Precomputed products of the gradients' differences, which stand for ω² times those of the
/// gradients.
#[derive(Debug, Clone, Copy)]
pub(super) struct InterpolationBias {
    /// Differences along x: of the gradient along x squared, and times those of the gradient along
    /// y.
    along_x: [f64; 2],
    /// Differences along y: of the gradient along y squared, and times those of the gradient along
    /// x.
    along_y: [f64; 2],
    /// Products of second differences along x and y with the gradients.
    second_differences: [Vector2<f64>; 2],
}

/// A row has one difference fewer than samples.
const ROW_CORRECTION: f64 = SIDE as f64 / (SIDE as f64 - 1.0);

impl InterpolationBias {
    /// The sums over a template of this image.
    pub(super) fn new(image: &GrayImage, template: &LevelTemplate) -> Self {
        let appearance = template.appearance();
        let (x, y) =
            (appearance.gradient_x.as_chunks::<SIDE>().0, appearance.gradient_y.as_chunks::<SIDE>().0);
        let mut sums = [[0.0f32; SIDE]; 4];
        for j in 0..SIDE {
            for i in 0..SIDE - 1 {
                let (of_x, of_y) = (x[j][i + 1] - x[j][i], y[j][i + 1] - y[j][i]);
                sums[0][i] += of_x * of_x;
                sums[1][i] += of_x * of_y;
            }
        }
        for j in 0..SIDE - 1 {
            for i in 0..SIDE {
                let (of_x, of_y) = (x[j + 1][i] - x[j][i], y[j + 1][i] - y[j][i]);
                sums[2][i] += of_x * of_y;
                sums[3][i] += of_y * of_y;
            }
        }
        let [xx, xy, yx, yy] =
            sums.map(|sums| ROW_CORRECTION * sums.iter().map(|&sum| f64::from(sum)).sum::<f64>());
        Self { along_x: [xx, xy], along_y: [yy, yx], second_differences: second_differences(image, template) }
    }

    /// Interpolation bias of a match at `position` under a warp with this linear part, pixels.
    pub(super) fn at(
        &self,
        position: Vector2<f64>,
        linear: &Matrix2<f64>,
        template: &LevelTemplate,
        noise: &Noise,
    ) -> Vector2<f64> {
        let phase_coherence = phase_coherence(linear);
        let smoothing = self.smoothing_bias(position, linear, phase_coherence, template, noise);
        let [x, y] = phase_coherence;
        let phase_error = Vector2::new(phase_error(position.x) * x, phase_error(position.y) * y);
        if phase_error == Vector2::zeros() {
            return smoothing;
        }
        // The grid is aligned with the image axes, up to right angles.
        let rotation = linear.map(f64::round);
        // Noise variance of a difference of central differences.
        let noise_part = noise.variance * AREA as f64;
        let along = |[own, other]: [f64; 2], own_gradients: f64| {
            let own = (own - noise_part).max(0.0);
            let more = higher_order_factor(own / own_gradients);
            [own * more, other * more]
        };
        let [xx, xy] = along(self.along_x, template.hessian[(0, 0)]);
        let [yy, yx] = along(self.along_y, template.hessian[(1, 1)]);
        smoothing
            + rotation
                * (noise.inverse_hessian * (Matrix2::new(xx, yx, xy, yy) * rotation.tr_mul(&phase_error)))
    }

    /// Bias by smoothing.
    fn smoothing_bias(
        &self,
        position: Vector2<f64>,
        linear: &Matrix2<f64>,
        phase_coherence: [f64; 2],
        template: &LevelTemplate,
        noise: &Noise,
    ) -> Vector2<f64> {
        let between = |centre: f64, phase_coherence: f64| {
            let fraction = fraction(centre);
            MEAN_SMOOTHING + (fraction * (1.0 - fraction) - MEAN_SMOOTHING) * phase_coherence
        };
        let of_image =
            Vector2::new(between(position.x, phase_coherence[0]), between(position.y, phase_coherence[1]));
        // Squared entries of the inverse of the warp.
        let [[a, b], [c, d]] = linear.map(|entry| entry * entry).data.0;
        let along = Matrix2::new(d, c, b, a) * of_image / linear.determinant().powi(2).max(1e-6);
        let noise_part = template.contrast_projection * (2.0 * noise.variance * AREA as f64);
        let bent = (self.second_differences[0] - noise_part) * along.x
            + (self.second_differences[1] - noise_part) * along.y;
        -(linear * (noise.inverse_hessian * bent)) * 0.5
    }
}

/// Products of second differences along x and y with the gradients of a template.
fn second_differences(image: &GrayImage, template: &LevelTemplate) -> [Vector2<f64>; 2] {
    let (left, top) = (template.centre.x - TO_CENTRE, template.centre.y - TO_CENTRE);
    bend_products(image, left as usize, top as usize, template.appearance()).map(Vector2::from)
}

/// Mean of φ (1 − φ) over all phases.
const MEAN_SMOOTHING: f64 = 1.0 / 6.0;

/// Factor of the phase error over its third-order approximation, for a wave whose squared
/// differences are `ratio` times its squared amplitude, 4 sin² ω/2. Accurate to 2 % up to periods
/// of four pixels.
fn higher_order_factor(ratio: f64) -> f64 {
    1.0 + ratio * (0.15 + 0.04 * ratio)
}

/// Phase error of bilinear sampling over ω², for a patch with this centre.
fn phase_error(centre: f64) -> f64 {
    let fraction = fraction(centre);
    fraction * (1.0 - fraction) * (1.0 - 2.0 * fraction) / 6.0
}

#[cfg(test)]
mod tests {
    use super::super::{FlowConfig, Template, Warp, track};
    use super::*;
    use crate::geometry::Pixel;
    use crate::image::{GrayImage, Pyramid};
    use nalgebra::Rotation2;

    /// Gray level at a place: waves of 4 to 14 pixels in all directions, as of fine asphalt.
    fn ground(seed: f64, place: Vector2<f64>) -> f64 {
        let wave = |k: usize| {
            let (number, period) = (k as f64, 4.0 * 1.15f64.powi(k as i32));
            let (sin, cos) = (2.4 * number + seed).sin_cos();
            10.0 * ((place.x * cos + place.y * sin) * std::f64::consts::TAU / period + 7.0 * seed * number)
                .sin()
        };
        120.0 + (0..10).map(wave).sum::<f64>()
    }

    /// Mean errors along x, pixels: without and with correction.
    fn mean_off_px(fraction: f64, linear: Matrix2<f64>) -> (f64, f64) {
        let centre = Vector2::new(31.5, 31.5);
        let there = centre + Vector2::new(fraction, 0.4 * fraction);
        let picture = |of: &dyn Fn(Vector2<f64>) -> f64| {
            let sample = |at: usize| of(Vector2::new((at % 64) as f64, (at / 64) as f64)).round() as u8;
            Pyramid::new(GrayImage::from_samples(64, 64, (0..64 * 64).map(sample).collect()).unwrap(), 1)
        };
        let inverse = linear.try_inverse().unwrap();
        let (mut raw_px, mut corrected_px) = (0.0, 0.0);
        let seeds = 60;
        for seed in 0..seeds {
            let seed = f64::from(seed);
            let keyframe = picture(&|place| ground(seed, place - centre));
            let image = picture(&|place| ground(seed, inverse * (place - there)));
            let template = Template::new(&keyframe, (31, 31)).unwrap();
            let prediction = Warp { position: Pixel::new(there.x, there.y), linear };
            let found = track(&template, &image, &prediction, 0.5, &FlowConfig::default()).unwrap();
            let place = Vector2::new(found.position.x, found.position.y);
            let noise = template.noise(place, &linear, found.dissimilarity);
            let bias = template.bias(place, &linear, &noise);
            raw_px += (place.x + bias.x - there.x) / f64::from(seeds);
            corrected_px += (place.x - there.x) / f64::from(seeds);
        }
        (raw_px, corrected_px)
    }

    #[test]
    fn corrected_matches_have_no_bias_at_any_phase() {
        let scaled = Matrix2::new(1.008, -0.006, 0.006, 1.008);
        let quarter = Matrix2::new(0.0, -1.0, 1.0, 0.0);
        for linear in [Matrix2::identity(), scaled, quarter, -Matrix2::identity()] {
            for fraction in [0.0, 0.1, 0.25, 0.4, 0.5, 0.75, 0.9] {
                let (raw_px, corrected_px) = mean_off_px(fraction, linear);
                println!("{fraction}: {raw_px:.4} px, {corrected_px:.4} px corrected");
                // Rounding to gray levels alone gives 0.0005 px in the mean of 60 templates.
                assert!(corrected_px.abs() < 0.003, "{fraction}: {raw_px} {corrected_px}");
                assert!(fraction != 0.25 || raw_px > 0.012, "{raw_px}");
            }
        }
    }

    /// Mean errors along y of a smooth blob with fine stripes along y, moved by a fraction of a
    /// pixel across the stripes, pixels: without and with correction.
    fn mean_off_across_px(fraction: f64, linear: Matrix2<f64>) -> (f64, f64) {
        let middle = Vector2::new(31.0, 31.0);
        let inverse = linear.try_inverse().unwrap();
        let centre = Vector2::new(31.5, 31.5);
        let there = centre + linear.column(0) * fraction;
        let (mut raw_px, mut corrected_px) = (0.0, 0.0);
        let phases = 20;
        for phase in 0..phases {
            let phase = std::f64::consts::TAU * f64::from(phase) / f64::from(phases);
            let stripes = |place: Vector2<f64>| {
                let (soft, stripes) = (0.02 * (place - middle).norm_squared(), 1.2 * place.x + phase);
                120.0 + (60.0 + 60.0 * stripes.sin()) * (-soft).exp()
            };
            let picture = |of: &dyn Fn(Vector2<f64>) -> f64| {
                let sample = |at: usize| of(Vector2::new((at % 64) as f64, (at / 64) as f64)).round() as u8;
                Pyramid::new(GrayImage::from_samples(64, 64, (0..64 * 64).map(sample).collect()).unwrap(), 1)
            };
            let keyframe = picture(&stripes);
            let image = picture(&|place| stripes(centre + inverse * (place - there)));
            let template = Template::new(&keyframe, (31, 31)).unwrap();
            let prediction = Warp { position: Pixel::new(there.x, there.y), linear };
            let found = track(&template, &image, &prediction, 0.5, &FlowConfig::default()).unwrap();
            let place = Vector2::new(found.position.x, found.position.y);
            let bias = template.bias(place, &linear, &found.noise);
            let across = linear.column(1).normalize();
            raw_px += (place + bias - there).dot(&across) / f64::from(phases);
            corrected_px += (place - there).dot(&across) / f64::from(phases);
        }
        (raw_px, corrected_px)
    }

    #[test]
    fn smoothed_stripes_give_no_bias_along_them() {
        let rotation = Rotation2::new(0.4).into_inner();
        let quarter = Matrix2::new(0.0, -1.0, 1.0, 0.0);
        for linear in [Matrix2::identity(), quarter, rotation] {
            for fraction in [0.0, 0.25, 0.5, 0.8] {
                let (raw_px, corrected_px) = mean_off_across_px(fraction, linear);
                println!("{fraction}: {raw_px:.4} px, {corrected_px:.4} px corrected");
                // The stripes have a period of 5 px, for which higher orders matter.
                assert!(corrected_px.abs() < 0.004, "{fraction}: {raw_px} {corrected_px}");
                assert!(fraction != 0.5 || raw_px < -0.012, "{raw_px}");
            }
        }
    }

    #[test]
    fn higher_orders_match_those_of_a_wave() {
        for omega in [0.3f64, 0.8, 1.2, std::f64::consts::FRAC_PI_2] {
            let fraction = 0.25;
            let seen = (fraction * omega.sin()).atan2(1.0 - fraction + fraction * omega.cos()) / omega;
            let third = fraction * (1.0 - fraction) * (1.0 - 2.0 * fraction) / 6.0;
            let ratio = 4.0 * (0.5 * omega).sin().powi(2);
            let expected = third * ratio * higher_order_factor(ratio);
            assert!(
                (expected - (fraction - seen)).abs() < 0.02 * expected,
                "{omega}: {expected} {}",
                fraction - seen
            );
        }
    }
}
