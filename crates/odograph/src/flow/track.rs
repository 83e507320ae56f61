//! Finding a template again: pyramidal Lucas–Kanade, inverse compositional, indifferent to gain and offset.

use super::noise::Noise;
use super::patch::{AREA, Samples, sample_products};
use super::template::{LevelTemplate, Template};
use super::{FlowConfig, Warp};
use crate::geometry::Pixel;
use crate::image::Pyramid;
use crate::image::simd::mean_and_energy;
use nalgebra::{Matrix2, Vector2};

/// A template found again.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Track {
    /// Where its centre is now, in pixels of the full image; what draws all templates alike, samples between pixels and noise, is taken off.
    pub position: Pixel,
    /// The part of its contrast that is left unexplained after gain and offset, 0 to 1.
    pub dissimilarity: f64,
    /// Covariance of the position as far as the noise of the samples goes, pixels²: large along an edge that is only straight.
    pub covariance_px2: Matrix2<f64>,
    /// Logarithm of its mean gray level over the template's.
    pub light: f64,
    /// The noise that what is left unexplained tells of.
    pub noise: Noise,
}

/// Why a template was not found again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrackFailure {
    /// It left the image.
    Outside,
    /// The search did not settle.
    Diverged,
    /// What is there is dark, or its negative.
    Unlike,
}

/// Searches a template in an image, coarse to fine, from where `prediction` expects it to within `off_px` (pixels of the full image;
/// infinite where nothing is known: the more is known, the fewer coarse levels are searched); the shape of the warp stays as predicted,
/// its position is found. Whether what was found is still the same is for the caller to judge by its dissimilarity.
///
/// With the gradients of the template orthogonal to constants and to the template itself, the normal equations of Lucas–Kanade with
/// unknown gain and offset reduce to two products with the image (the elimination of a linear appearance variation of Baker and Matthews,
/// part 3, done once per template).
pub fn track(
    template: &Template,
    image: &Pyramid,
    prediction: &Warp,
    off_px: f64,
    config: &FlowConfig,
) -> Result<Track, TrackFailure> {
    let mut shift = Vector2::zeros(); // pixels of the full image
    let mut likeness = None;
    let levels = levels_for(off_px, template.levels().min(image.levels()));
    for level in (0..levels).rev() {
        let scale = (1usize << level) as f64;
        // A coarse level has only to come near enough for the next.
        let step_px = if level == 0 { config.step_px } else { config.step_px.max(COARSE_STEP_PX) * scale };
        let Some(patch) = template.level(level) else { continue };
        let result =
            search(patch, level, template.centre(), image, prediction, shift, config.iterations, step_px);
        match result {
            Ok((level_shift, there)) => {
                // A coarse level that found something else must not lead the finer ones astray.
                if level == 0 || there.dissimilarity < config.dissimilarity {
                    shift = level_shift;
                }
                likeness = Some(there);
            }
            Err(failure) if level == 0 => return Err(failure),
            // On a coarse level the patch covers more of the image and may lie partly outside; finer ones may still hold.
            Err(_) => {}
        }
    }
    let Likeness { dissimilarity, light } = likeness.ok_or(TrackFailure::Outside)?;
    let linear = &prediction.linear;
    let found = Vector2::new(prediction.position.x, prediction.position.y) + shift;
    let noise = Noise::new(template, found, linear, dissimilarity);
    let place = found - template.pulled(found, linear, &noise);
    let position = Pixel::new(place.x, place.y);
    Ok(Track { position, dissimilarity, covariance_px2: noise.covariance(linear), light, noise })
}

/// Steps that would lead less than this far end a level other than the full image, pixels of the level.
const COARSE_STEP_PX: f64 = 0.05;

/// What a level finds even where the ground's texture is fine, pixels of the level: what is no further off is found in the full image alone.
pub const REACH_PX: f64 = 1.0;

/// How many levels, of so many that there are, find what may be `off_px` away.
fn levels_for(off_px: f64, most: usize) -> usize {
    let mut levels = 1;
    let mut reach_px = REACH_PX;
    while levels < most && reach_px < off_px {
        levels += 1;
        reach_px *= 2.0;
    }
    levels
}

/// One level of [`track`] for a template about the keyframe point `centre`: the improved shift (pixels of the full image) and the
/// likeness there.
fn search(
    patch: &LevelTemplate,
    level: usize,
    centre: Pixel,
    image: &Pyramid,
    prediction: &Warp,
    mut shift: Vector2<f64>,
    iterations: usize,
    step_px: f64,
) -> Result<(Vector2<f64>, Likeness), TrackFailure> {
    let scale = (1usize << level) as f64;
    // The patch of this level is centred on samples of its level, a little beside the template's own centre.
    let offset = patch.centre * scale - Vector2::new(centre.x, centre.y);
    let expected = prediction.at(offset);
    let image = image.level(level);
    let mut samples: Samples = [0.0; AREA];
    let mut last_step = f64::INFINITY;
    let mut product = 0.0;
    for _ in 0..iterations {
        let centre = (expected + shift) / scale;
        let products = sample_products(image, centre, &prediction.linear, patch.appearance(), &mut samples)
            .ok_or(TrackFailure::Outside)?;
        product = products.contrast;
        let mut gain = product / patch.contrast_energy;
        if level > 0 {
            // Far from the answer likeness tells nothing of the gain.
            gain = gain.max(LEAST_COARSE_GAIN);
        } else if gain < 0.05 {
            return Err(TrackFailure::Unlike); // darkness, or a negative
        }
        let step = prediction.linear * (patch.inverse_hessian * (products.gradient / gain)) * scale;
        shift -= step;
        let length = step.norm();
        if length > 8.0 * scale {
            return Err(TrackFailure::Diverged); // half a patch: the gradients mean nothing there
        }
        // Near the answer each step is the same part of the one before: what is left after this one is a geometric series.
        let part = (length / last_step).min(MOST_SHRINKING); // 0 for the first
        let last_step_known = last_step.is_finite();
        let steps_left = if last_step_known { part / (1.0 - part) } else { 1.0 };
        last_step = length;
        if length * steps_left < step_px {
            // The steps still to come, where they are known, are taken at once.
            if last_step_known && part < 0.5 {
                shift -= step * steps_left;
            }
            return Ok((shift, Likeness::of(patch, product, &samples)));
        }
    }
    if last_step > 25.0 * step_px && last_step > 0.1 * scale {
        return Err(TrackFailure::Diverged);
    }
    Ok((shift, Likeness::of(patch, product, &samples)))
}

/// No image of the same ground is darker than this part of the keyframe, as far as levels other than the full image are concerned.
const LEAST_COARSE_GAIN: f64 = 0.5;

/// Steps that shrink more slowly than this, or grow, are taken to shrink by this.
const MOST_SHRINKING: f64 = 0.9;

/// How alike a template and what was found are.
#[derive(Debug, Clone, Copy)]
pub(super) struct Likeness {
    /// The part of the contrast that gain and offset of the template leave unexplained: √(1 − ρ²), ρ the correlation.
    pub dissimilarity: f64,
    /// Logarithm of the mean gray level over the template's.
    pub light: f64,
}

impl Likeness {
    /// `product` is that of the samples with the template's contrast.
    pub fn of(patch: &LevelTemplate, product: f64, samples: &Samples) -> Self {
        let (mean, energy) = mean_and_energy(samples);
        let light = (mean.max(DARKEST) / f64::from(patch.less.mean).max(DARKEST)).ln();
        if energy < 1e-6 || product <= 0.0 {
            return Self { dissimilarity: 1.0, light };
        }
        let unexplained = 1.0 - (product * product / (energy * patch.contrast_energy));
        Self { dissimilarity: unexplained.max(0.0).sqrt(), light }
    }
}

/// Below this mean gray level the light is not told.
const DARKEST: f64 = 1.0;

/// Follows a found template backward: a patch of `image` at the found place is searched in the keyframe. Gives how far from
/// the template's centre it arrives, in keyframe pixels (Z. Kalal et al., 2010); `None` where it does not arrive.
///
/// `found` is the warp with its found position. The found place is within a pixel or so of the answer, so the full image is enough.
pub fn forward_backward_px(
    template: &Template,
    keyframe: &Pyramid,
    image: &Pyramid,
    found: &Warp,
    config: &FlowConfig,
) -> Option<f64> {
    let back = LevelTemplate::new(image.base(), found.position.x, found.position.y)?;
    let inverse = found.linear.try_inverse()?;
    // The backward patch sits on whole samples, up to half a pixel beside the found position.
    let beside = back.centre - Vector2::new(found.position.x, found.position.y);
    let start = Vector2::new(template.centre().x, template.centre().y) + inverse * beside;
    let prediction = Warp { position: Pixel::new(start.x, start.y), linear: inverse };
    let centre = Pixel::new(back.centre.x, back.centre.y);
    // Nearer than what it is compared with is near enough.
    let step_px = config.step_px.max(0.05 * config.forward_backward_px);
    let (shift, _) =
        search(&back, 0, centre, keyframe, &prediction, Vector2::zeros(), config.iterations, step_px).ok()?;
    Some(shift.norm())
}
