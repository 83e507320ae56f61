//! Covariance and bias of a match by image noise.
//!
//! Noise scatters the match, more along an edge that is nearly straight: that is the covariance of
//! a track. It also biases the match: the gradients of a template are made orthogonal to its noisy
//! contrast, though the other image does not have that noise, so that their projection onto the
//! true contrast is not zero. The projection is the difference of the squared contrast between
//! opposite borders; since a patch has an even side and a corner is not at its centre, it has a
//! preferred sign, and no number of corners averages it out (Y. Wang et al., 2009; Y. Su et al.,
//! 2016). Derivation: `docs/math/interpolation-bias.md`.

use super::level_template::LevelTemplate;
use super::patch::{AREA, gradient_noise};
use super::subpixel_phase::{fraction, phase_coherence};
use nalgebra::{Matrix2, Vector2};

/// Noise of a template and its match, from the unexplained contrast.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Noise {
    /// Noise variance of a template sample, gray levels², at most that of the image.
    pub(super) variance: f64,
    /// Variance of all unexplained contrast, gray levels²: also what is not noise scatters the
    /// match.
    unexplained: f64,
    /// Inverse Hessian of the template after the noise of its gradients is subtracted.
    pub(super) inverse_hessian: Matrix2<f64>,
}

/// Upper bound of the unexplained fraction of the squared contrast in the noise estimate. Not
/// derived; chosen.
const MAX_UNEXPLAINED: f64 = 0.9;

/// Upper bound of a patch's noise variance over that of the image; a patch estimates it to about a
/// tenth. Not derived; chosen.
const MAX_NOISE_RATIO: f64 = 1.25;

/// Least fraction of an eigenvalue of the Hessian that counts as signal. Not derived; chosen.
const MIN_SIGNAL: f64 = 0.05;

/// Variance of a linear interpolation over that of the samples, mean over all subpixel phases.
const MEAN_VARIANCE_RATIO: f64 = 2.0 / 3.0;

impl Noise {
    /// From a match at `position` under a warp with this linear part, and its dissimilarity.
    ///
    /// Both images have the same noise, but interpolated samples have less of it. Without this
    /// correction matches near the middle between pixels would appear better and would bias
    /// weighted means.
    pub(super) fn new(
        patch: &LevelTemplate,
        max_noise_variance: f64,
        position: Vector2<f64>,
        linear: &Matrix2<f64>,
        dissimilarity: f64,
    ) -> Self {
        let explained = 1.0 - (dissimilarity * dissimilarity).min(MAX_UNEXPLAINED);
        // With the noise n of the template relative to the common signal, and κ n that of the
        // image, the squared correlation is 1 / ((1 + n) (1 + κ n)).
        let left = variance_ratio(position, linear);
        let n = {
            let (sum, product) = (1.0 + left, 4.0 * left * (1.0 / explained - 1.0));
            ((sum * sum + product).sqrt() - sum) / (2.0 * left)
        };
        let unexplained = n / (1.0 + n) * patch.contrast_energy / AREA as f64;
        let variance = unexplained.min(MAX_NOISE_RATIO * max_noise_variance);
        Self {
            variance,
            unexplained,
            inverse_hessian: noise_corrected_inverse(&patch.hessian, gradient_noise(variance)),
        }
    }

    /// Expected contribution of noise to the sum of squared gradients in any direction.
    pub(super) fn gradient_noise(&self) -> f64 {
        gradient_noise(self.variance)
    }

    /// Covariance of the match, pixels².
    pub(super) fn covariance(&self, linear: &Matrix2<f64>) -> Matrix2<f64> {
        let both = self.unexplained * (1.0 + MEAN_VARIANCE_RATIO * MEAN_VARIANCE_RATIO);
        linear * (self.inverse_hessian * both) * linear.transpose()
    }

    /// Noise-induced bias of the match, pixels of the template.
    pub(super) fn bias(&self, patch: &LevelTemplate) -> Vector2<f64> {
        -(self.inverse_hessian * patch.contrast_projection * (self.variance * AREA as f64))
    }
}

/// Inverse of a Hessian after isotropic noise is subtracted from its eigenvalues.
fn noise_corrected_inverse(hessian: &Matrix2<f64>, noise_part: f64) -> Matrix2<f64> {
    let [[xx, xy], [_, yy]] = hessian.data.0;
    // Spectral decomposition: the traceless part over half the difference of the eigenvalues is the
    // difference of the two projections, whose sum is the identity.
    let difference = 0.5 * (xx - yy);
    let (mean, half) = (0.5 * (xx + yy), (difference * difference + xy * xy).sqrt());
    let inverse_half = if half > 0.0 { 1.0 / half } else { 0.0 };
    let traceless = Matrix2::new(difference, xy, xy, -difference) * inverse_half;
    let inverse = |noise_corrected_inverse: f64| {
        1.0 / (noise_corrected_inverse - noise_part).max(MIN_SIGNAL * noise_corrected_inverse)
    };
    let (larger, axis) = (inverse(mean + half), inverse((mean - half).max(1e-9)));
    Matrix2::identity() * (0.5 * (larger + axis)) + traceless * (0.5 * (larger - axis))
}

/// Variance of interpolated samples over that of pixels, for a patch at `position`.
fn variance_ratio(position: Vector2<f64>, linear: &Matrix2<f64>) -> f64 {
    let axis = |centre: f64, phase_coherence: f64| {
        let fraction = fraction(centre);
        MEAN_VARIANCE_RATIO
            + (1.0 - MEAN_VARIANCE_RATIO - 2.0 * fraction * (1.0 - fraction)) * phase_coherence
    };
    let [x, y] = phase_coherence(linear);
    axis(position.x, x) * axis(position.y, y)
}

#[cfg(test)]
mod tests {
    use super::super::{FlowConfig, Template, Warp, track};
    use super::*;
    use crate::geometry::Pixel;
    use crate::image::{GrayImage, Pyramid};
    use crate::motion::Random;

    const NOISE_GRAY: f64 = 4.0;

    /// Means over many noise samples, along x, pixels: error of a match of a Gaussian blob, the
    /// correction applied, and the error weighted by covariance. Then the actual variance over the
    /// stated one.
    fn errors_px(fraction: f64) -> [f64; 4] {
        let linear = Matrix2::identity();
        let mut random = Random::new(7);
        // The sum of twelve uniform numbers is nearly normal.
        let mut normal = || (0..12).map(|_| random.below(1 << 16) as f64 / 65536.0).sum::<f64>() - 6.0;
        let mut picture = |shift: f64| {
            let sample = |at: usize| {
                let (x, y) = ((at % 64) as f64 - 31.0 - shift, (at / 64) as f64 - 31.0);
                (100.0 + 40.0 * (-(x * x + y * y) / 50.0).exp() + NOISE_GRAY * normal()).round() as u8
            };
            Pyramid::new(GrayImage::from_samples(64, 64, (0..64 * 64).map(sample).collect()).unwrap(), 1)
        };
        let count = 4000;
        let (mut error, mut corrected, mut weighted, mut weights, mut squares, mut stated) =
            (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        for _ in 0..count {
            let (keyframe, image) = (picture(0.0), picture(fraction));
            let template = Template::new(&keyframe, (31, 31)).unwrap();
            let there = template.centre().x + fraction;
            let prediction = Warp { position: Pixel::new(there, template.centre().y), linear };
            let found = track(&template, &image, &prediction, 0.5, &FlowConfig::default()).unwrap();
            let (match_error, variance) = (found.position.x - there, found.covariance_px2[(0, 0)]);
            error += match_error / f64::from(count);
            corrected -= found.noise.bias(template.finest()).x / f64::from(count);
            weighted += match_error / variance;
            weights += 1.0 / variance;
            squares += match_error * match_error;
            stated += variance;
        }
        [error, corrected, weighted / weights, squares / stated]
    }

    #[test]
    fn noise_biases_neither_matches_nor_weighted_means() {
        for fraction in [0.0, 0.25, 0.5, 0.75] {
            let [error, corrected, weighted, variance_over_stated] = errors_px(fraction);
            println!("{fraction}: {error:.4} px ({weighted:.4} weighted), {corrected:.4} px were corrected");
            println!("variance {variance_over_stated:.2} times that stated");
            // The mean of 4000 matches is known to 0.002 px.
            assert!(corrected > 0.02 && error.abs() < 0.006, "{fraction}: {error} {corrected}");
            assert!((weighted - error).abs() < 0.002, "{fraction}: {error} {weighted}");
            // The second order of the noise, a tenth of the contrast, is neglected.
            assert!((1.0..2.0).contains(&variance_over_stated), "{fraction}: {variance_over_stated}");
        }
    }
}
