//! Tracking of a template: pyramidal Lucas–Kanade, inverse compositional, invariant to gain
//! and to light that changes linearly over a patch.

use super::level_template::LevelTemplate;
use super::noise::Noise;
use super::patch::{AREA, Samples, sample_products};
use super::template::Template;
use super::{FlowConfig, Warp};
use crate::geometry::Pixel;
use crate::image::simd::plane_and_energy;
use crate::image::{GrayImage, Pyramid};
use nalgebra::{Matrix2, Vector2};

/// A tracked template.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Track {
    /// Position of its centre, pixels of the full image, corrected for interpolation bias and
    /// noise-induced bias.
    pub position: Pixel,
    /// Root of the fraction of its contrast that gain and light leave unexplained, √(1 − ρ²), 0 to
    /// 1.
    pub dissimilarity: f64,
    /// Covariance of the position by image noise, pixels²: large along a straight edge.
    pub covariance_px2: Matrix2<f64>,
    /// Noise estimated from the dissimilarity.
    pub noise: Noise,
}

/// Why a template could not be tracked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrackFailure {
    /// It left the image.
    Outside,
    /// The iteration did not converge.
    Diverged,
    /// The image there is dark, or has inverted contrast.
    Unlike,
}

/// Tracks a template in an image, coarse to fine, from `prediction`, whose position is known to
/// within `uncertainty_px` (pixels of the full image; infinite for a search on all levels). The
/// linear part of the warp stays as predicted, its position is estimated. The caller decides by the
/// dissimilarity whether the match is accepted.
///
/// With the gradients of the template orthogonal to planes and to the template itself, the normal
/// equations of Lucas–Kanade with unknown gain, offset and slopes of the light reduce to two
/// products with the image (the elimination of a linear appearance variation of Baker and Matthews,
/// part 3, done once per template). Shadows, lamps, reflections and caustics are such planes.
pub fn track(
    template: &Template,
    image: &Pyramid,
    prediction: &Warp,
    uncertainty_px: f64,
    config: &FlowConfig,
) -> Result<Track, TrackFailure> {
    let mut shift = Vector2::zeros(); // pixels of the full image
    let mut last = None;
    let centre = Vector2::new(template.centre().x, template.centre().y);
    let levels = levels_for(uncertainty_px, template.levels().min(image.levels()));
    for level in (0..levels).rev() {
        let scale = (1usize << level) as f64;
        // A coarse level only has to reach the convergence radius of the next.
        let step_px = if level == 0 { config.step_px } else { config.step_px.max(COARSE_STEP_PX) * scale };
        let Some(patch) = template.level(level) else { continue };
        // The patch of this level is centred between pixels of its level, slightly off the
        // template's centre.
        let expected = prediction.at(patch.centre * scale - centre);
        let (image, linear, iterations) = (image.level(level), &prediction.linear, config.iterations);
        let search = LevelSearch { patch, image, scale, expected, linear, iterations, step_px };
        match search.improve(shift) {
            Ok((level_shift, there)) => {
                // A poor match on a coarse level must not mislead the finer ones.
                if level == 0 || there < config.dissimilarity {
                    shift = level_shift;
                }
                last = Some(there);
            }
            Err(failure) if level == 0 => return Err(failure),
            // On a coarse level the patch covers more of the image and may lie partly outside it.
            Err(_) => {}
        }
    }
    let dissimilarity = last.ok_or(TrackFailure::Outside)?;
    let linear = &prediction.linear;
    let found = Vector2::new(prediction.position.x, prediction.position.y) + shift;
    let noise = template.noise(found, linear, dissimilarity);
    let place = found - template.bias(found, linear, &noise);
    let position = Pixel::new(place.x, place.y);
    Ok(Track { position, dissimilarity, covariance_px2: noise.covariance(linear), noise })
}

/// Convergence of coarse levels, pixels of the level. Not derived; chosen.
const COARSE_STEP_PX: f64 = 0.05;

/// Convergence radius of a level even for fine texture, pixels of the level: smaller displacements
/// need the full image only. Not derived; chosen.
pub const SEARCH_RADIUS_PX: f64 = 1.0;

/// Number of levels, of those available, for a displacement of up to `uncertainty_px`.
fn levels_for(uncertainty_px: f64, available: usize) -> usize {
    let mut levels = 1;
    let mut radius_px = SEARCH_RADIUS_PX;
    while levels < available && radius_px < uncertainty_px {
        levels += 1;
        radius_px *= 2.0;
    }
    levels
}

/// One level of [`track`].
struct LevelSearch<'a> {
    patch: &'a LevelTemplate,
    image: &'a GrayImage,
    /// Pixels of the full image over those of the level: 1 on the finest.
    scale: f64,
    /// Where the centre of the patch is predicted, pixels of the full image.
    expected: Vector2<f64>,
    linear: &'a Matrix2<f64>,
    iterations: usize,
    step_px: f64,
}

impl LevelSearch<'_> {
    /// The improved shift from the prediction (pixels of the full image) and the dissimilarity
    /// there.
    fn improve(&self, mut shift: Vector2<f64>) -> Result<(Vector2<f64>, f64), TrackFailure> {
        let Self { patch, scale, linear, .. } = *self;
        let mut samples: Samples = [0.0; AREA];
        let mut last_step = f64::INFINITY;
        let mut product = 0.0;
        for _ in 0..self.iterations {
            let centre = (self.expected + shift) / scale;
            let products = sample_products(self.image, centre, linear, patch.appearance(), &mut samples)
                .ok_or(TrackFailure::Outside)?;
            product = products.contrast;
            let mut gain = product / patch.contrast_energy;
            if scale > 1.0 {
                // Far from the solution the product does not measure the gain.
                gain = gain.max(MIN_COARSE_GAIN);
            } else if gain < 0.05 {
                return Err(TrackFailure::Unlike); // dark, or inverted
            }
            let step = linear * (patch.inverse_hessian * (products.gradient / gain)) * scale;
            shift -= step;
            let length = step.norm();
            if length > 8.0 * scale {
                return Err(TrackFailure::Diverged); // half a patch: outside the linear range
            }
            // Near the solution the steps contract at a constant rate: the remaining ones are a
            // geometric series.
            let contraction = (length / last_step).min(MAX_CONTRACTION); // 0 for the first
            let last_step_known = last_step.is_finite();
            let steps_left = if last_step_known { contraction / (1.0 - contraction) } else { 1.0 };
            last_step = length;
            if length * steps_left < self.step_px {
                // The remaining steps, where the rate is known, are taken at once.
                if last_step_known && contraction < 0.5 {
                    shift -= step * steps_left;
                }
                return Ok((shift, dissimilarity(patch, product, &samples)));
            }
        }
        if last_step > 25.0 * self.step_px && last_step > 0.1 * scale {
            return Err(TrackFailure::Diverged);
        }
        Ok((shift, dissimilarity(patch, product, &samples)))
    }
}

/// Lower bound of the gain on coarse levels. Not derived; chosen.
const MIN_COARSE_GAIN: f64 = 0.5;

/// Upper bound of the contraction rate. Not derived; chosen.
const MAX_CONTRACTION: f64 = 0.9;

/// Root of the fraction of the contrast that a gain of the template and a plane of light leave
/// unexplained: √(1 − ρ²), with ρ the correlation. `product` is that of the samples with the
/// template's contrast.
pub(super) fn dissimilarity(patch: &LevelTemplate, product: f64, samples: &Samples) -> f64 {
    let (plane, energy) = plane_and_energy(samples);
    let energy = if patch.is_in_uneven_light() { energy } else { energy + plane.sloping().dot(&plane) };
    if energy < 1e-6 || product <= 0.0 {
        return 1.0;
    }
    (1.0 - product * product / (energy * patch.contrast_energy)).max(0.0).sqrt()
}

/// Forward–backward check (Z. Kalal et al., 2010): tracks the patch of `image` at the match back
/// into the keyframe. Returns its distance from the template's centre, keyframe pixels; `None`
/// where it is lost.
///
/// `found` is the warp with the position of the match. The full image suffices, because the match
/// is within about a pixel of the solution.
pub fn forward_backward_px(
    template: &Template,
    keyframe: &Pyramid,
    image: &Pyramid,
    found: &Warp,
    config: &FlowConfig,
) -> Option<f64> {
    let back = LevelTemplate::new(image, 0, found.position)?;
    let inverse = found.linear.try_inverse()?;
    // The backward patch lies on pixels, up to half a pixel off the match.
    let offset = back.centre - Vector2::new(found.position.x, found.position.y);
    let expected = Vector2::new(template.centre().x, template.centre().y) + inverse * offset;
    // A twentieth of the threshold is accurate enough.
    let step_px = config.step_px.max(0.05 * config.forward_backward_px);
    let (patch, image, iterations) = (&back, keyframe.base(), config.iterations);
    let search = LevelSearch { patch, image, scale: 1.0, expected, linear: &inverse, iterations, step_px };
    let (shift, _) = search.improve(Vector2::zeros()).ok()?;
    Some(shift.norm())
}
