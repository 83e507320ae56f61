//! What the noise of two images does to where a template is found in one of them.
//!
//! It scatters, and more along an edge that is only straight; that is the covariance of a track. It also pulls. The gradients of a template are made
//! orthogonal to its contrast, which is squared to that end with the noise in it, though no other image has that noise: of what its gradients have in common
//! with its contrast too little is taken off. That is what the squared contrast has more at one border than at the other, and since a patch has an even side and a
//! corner is not in its middle, one border has more in most patches: no number of corners averages it away.

use super::Template;
use super::patch::AREA;
use super::sampling_pull::alike;
use super::template::LevelTemplate;
use nalgebra::{Matrix2, Vector2};

/// The noise of a template and of what was found, as far as what is left unexplained tells it.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Noise {
    /// Variance of a sample of the template, gray levels²; no more than the image has.
    pub(super) variance: f64,
    /// The same for all that is unexplained: also what does not come from noise scatters.
    unexplained: f64,
    /// The inverse of the products of the template's gradients without those of its noise, which hold nothing.
    pub(super) inverse_hessian: Matrix2<f64>,
}

/// What is unexplained counts as noise up to this part of the contrast: beyond, it is something else.
const MOST_UNEXPLAINED: f64 = 0.9;

/// A patch tells its noise to a tenth; what is more than so many times the noise of its image is something else.
const CERTAINLY_MORE: f64 = 1.25;

/// Variance of a central difference over that of the samples.
const OF_DIFFERENCE: f64 = 0.5;

/// The part of the squared gradients in a direction that counts even where noise alone would have made as many.
const LEAST_HELD: f64 = 0.05;

/// The part of the variance that is left between two samples, a mean over all fractions.
const LEFT_BETWEEN: f64 = 2.0 / 3.0;

impl Noise {
    /// Where a template was found at `position` under a warp with this linear part, so that `dissimilarity` was left.
    ///
    /// Both images have the same noise, but samples between pixels are means and have less of it. If that were not counted, what happens to be found nearer to the
    /// middle between pixels would seem better than its neighbours, and would draw a weighted mean there.
    pub(super) fn new(
        template: &Template,
        position: Vector2<f64>,
        linear: &Matrix2<f64>,
        dissimilarity: f64,
    ) -> Self {
        let explained = 1.0 - (dissimilarity * dissimilarity).min(MOST_UNEXPLAINED);
        // With the noise n of the template over what both have in common, and c n that of the image, the squared correlation is 1 / ((1 + n) (1 + c n)).
        let left = left_in_samples(position, linear);
        let n = {
            let (sum, product) = (1.0 + left, 4.0 * left * (1.0 / explained - 1.0));
            ((sum * sum + product).sqrt() - sum) / (2.0 * left)
        };
        let patch = template.finest();
        let unexplained = n / (1.0 + n) * patch.contrast_energy / AREA as f64;
        let variance = unexplained.min(CERTAINLY_MORE * template.most_noise());
        Self { variance, unexplained, inverse_hessian: held(&patch.hessian, of_gradients(variance)) }
    }

    /// What noise makes of the sum of the template's squared gradients, in every direction.
    pub(super) fn of_gradients(&self) -> f64 {
        of_gradients(self.variance)
    }

    /// The covariance of where the template was found, pixels².
    pub(super) fn covariance(&self, linear: &Matrix2<f64>) -> Matrix2<f64> {
        let both = self.unexplained * (1.0 + LEFT_BETWEEN * LEFT_BETWEEN);
        linear * (self.inverse_hessian * both) * linear.transpose()
    }

    /// How far from its place the template is found for its own noise, pixels of the template.
    pub(super) fn pull(&self, patch: &LevelTemplate) -> Vector2<f64> {
        -(self.inverse_hessian * patch.shares * (self.variance * AREA as f64))
    }
}

fn of_gradients(variance: f64) -> f64 {
    OF_DIFFERENCE * AREA as f64 * variance
}

/// The inverse of the products of gradients of which noise makes that much in every direction.
fn held(hessian: &Matrix2<f64>, of_noise: f64) -> Matrix2<f64> {
    let [[xx, xy], [_, yy]] = hessian.data.0;
    // Eigenvalues. What is left of the matrix without its mean, over half their difference, is the projection onto the direction of the larger one less that onto
    // the other; the two add up to the identity.
    let difference = 0.5 * (xx - yy);
    let (middle, half) = (0.5 * (xx + yy), (difference * difference + xy * xy).sqrt());
    let part = if half > 0.0 { 1.0 / half } else { 0.0 };
    let apart = Matrix2::new(difference, xy, xy, -difference) * part;
    let inverse = |held: f64| 1.0 / (held - of_noise).max(LEAST_HELD * held);
    let (across, along) = (inverse(middle + half), inverse((middle - half).max(1e-9)));
    Matrix2::identity() * (0.5 * (across + along)) + apart * (0.5 * (across - along))
}

/// The part of the variance that is left in samples between pixels, for a patch about `position`.
fn left_in_samples(position: Vector2<f64>, linear: &Matrix2<f64>) -> f64 {
    let along = |centre: f64, alike: f64| {
        // A patch has an even side: its samples lie on pixels when its centre lies between them.
        let fraction = (centre - 0.5).rem_euclid(1.0);
        LEFT_BETWEEN + (1.0 - LEFT_BETWEEN - 2.0 * fraction * (1.0 - fraction)) * alike
    };
    let [x, y] = alike(linear);
    along(position.x, x) * along(position.y, y)
}

#[cfg(test)]
mod tests {
    use super::super::{FlowConfig, Template, Warp, track};
    use super::*;
    use crate::geometry::Pixel;
    use crate::image::{GrayImage, Pyramid};
    use crate::motion::Random;

    const NOISE_GRAY: f64 = 4.0;

    /// Means over many noises, along x: how far a mound about a corner is found from its place, what was taken off before, and the same with each
    /// weighed by its covariance; pixels. Then the variance found over the one that is stated.
    fn off_px(fraction: f64) -> [f64; 4] {
        let linear = Matrix2::identity();
        let mut random = Random::new(7);
        // Twelve uniform numbers make a normal one.
        let mut normal = || (0..12).map(|_| random.below(1 << 16) as f64 / 65536.0).sum::<f64>() - 6.0;
        let mut picture = |shift: f64| {
            let sample = |at: usize| {
                let (x, y) = ((at % 64) as f64 - 31.0 - shift, (at / 64) as f64 - 31.0);
                (100.0 + 40.0 * (-(x * x + y * y) / 50.0).exp() + NOISE_GRAY * normal()).round() as u8
            };
            Pyramid::new(GrayImage::from_samples(64, 64, (0..64 * 64).map(sample).collect()).unwrap(), 1)
        };
        let count = 4000;
        let (mut off, mut taken, mut weighed, mut weights, mut squares, mut stated) =
            (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        for _ in 0..count {
            let (keyframe, image) = (picture(0.0), picture(fraction));
            let template = Template::new(&keyframe, (31, 31)).unwrap();
            let there = template.centre().x + fraction;
            let prediction = Warp { position: Pixel::new(there, template.centre().y), linear };
            let found = track(&template, &image, &prediction, 0.5, &FlowConfig::default()).unwrap();
            let (is_off, variance) = (found.position.x - there, found.covariance_px2[(0, 0)]);
            off += is_off / f64::from(count);
            taken -= found.noise.pull(template.finest()).x / f64::from(count);
            weighed += is_off / variance;
            weights += 1.0 / variance;
            squares += is_off * is_off;
            stated += variance;
        }
        [off, taken, weighed / weights, squares / stated]
    }

    #[test]
    fn noise_draws_what_is_found_neither_to_a_border_nor_between_pixels() {
        for fraction in [0.0, 0.25, 0.5, 0.75] {
            let [off, taken, weighed, of_stated] = off_px(fraction);
            println!("{fraction}: {off:.4} px ({weighed:.4} weighed), {taken:.4} px were taken off");
            println!("variance {of_stated:.2} times that stated");
            // The mean of so many is known to 0.002 px.
            assert!(taken > 0.02 && off.abs() < 0.006, "{fraction}: {off} {taken}");
            assert!((weighed - off).abs() < 0.002, "{fraction}: {off} {weighed}");
            // The second order of the noise, of which there is a tenth as much as of contrast, is not counted.
            assert!((1.0..2.0).contains(&of_stated), "{fraction}: {of_stated}");
        }
    }
}
