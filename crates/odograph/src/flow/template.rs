//! The first appearance of a corner, prepared for being found again.

use super::noise::Noise;
use super::patch::{AREA, SIDE, TO_CENTRE};
use super::response::Response;
use super::sampling_pull::SamplingPull;
use crate::geometry::Pixel;
use crate::image::simd::{Appearance, Moments, Orthogonal, moments, patch_sums, write_appearance};
use crate::image::{GrayImage, Pyramid};
use nalgebra::{Matrix2, Vector2};
use std::cell::RefCell;
use std::sync::OnceLock;

/// Patches of a keyframe around one corner, one a pyramid level, with everything about them that does not depend on the
/// image they will be searched in.
#[derive(Debug, Clone)]
pub struct Template {
    centre: Pixel,
    finest: LevelTemplate,
    moments: Moments,
    pull: SamplingPull,
    /// At most how much noise its samples have, gray levels².
    most_noise: f64,
    /// The other levels, finer ones first; made when they are first needed.
    coarser: OnceLock<Vec<LevelTemplate>>,
}

impl Template {
    /// The template of the patch whose centre is half a pixel right of and below `corner` (a patch has an even side).
    ///
    /// `None` where the patch does not fit into the image, or has no texture in some direction. Coarser levels are left out
    /// from the first on which it does not fit.
    pub fn new(pyramid: &Pyramid, corner: (usize, usize)) -> Option<Self> {
        let template = Self::of_finest_level(pyramid, corner)?;
        template.add_coarser_levels(pyramid);
        Some(template)
    }

    /// [`Template::new`] for a search near its place: of the full image only, until [`Template::add_coarser_levels`].
    pub fn of_finest_level(pyramid: &Pyramid, corner: (usize, usize)) -> Option<Self> {
        let centre = Pixel::new(corner.0 as f64 + 0.5, corner.1 as f64 + 0.5);
        let finest = LevelTemplate::new(pyramid.base(), centre.x, centre.y)?;
        let moments = moments(finest.appearance(), &finest.less);
        let pull = SamplingPull::new(pyramid.base(), &finest);
        Some(Self {
            centre,
            finest,
            moments,
            pull,
            most_noise: pyramid.noise_variance(),
            coarser: OnceLock::new(),
        })
    }

    /// Makes the coarser levels, where they are not there yet, from the pyramid that the template was made of.
    pub fn add_coarser_levels(&self, pyramid: &Pyramid) {
        self.coarser.get_or_init(|| {
            let mut scale = 1.0;
            let coarser = pyramid.coarser().iter().map_while(|image| {
                scale *= 2.0;
                LevelTemplate::new(image, self.centre.x / scale, self.centre.y / scale)
            });
            coarser.collect()
        });
    }

    /// The keyframe point that the template is about, in pixels of the full image.
    pub fn centre(&self) -> Pixel {
        self.centre
    }

    /// How it answers, where it was found with that noise, to what is not the same all over it.
    pub fn response(&self, noise: Noise) -> Response<'_> {
        Response::new(&self.moments, noise)
    }

    /// How far from its place the template is found in a full image at `position` because that is sampled between its pixels, and because of its noise.
    pub(super) fn pulled(
        &self,
        position: Vector2<f64>,
        linear: &Matrix2<f64>,
        noise: &Noise,
    ) -> Vector2<f64> {
        self.pull.at(position, linear, &self.finest, noise) + linear * noise.pull(&self.finest)
    }

    /// At most how much noise its samples have, gray levels².
    pub(super) fn most_noise(&self) -> f64 {
        self.most_noise
    }

    /// How many levels there are; at least one.
    pub(super) fn levels(&self) -> usize {
        1 + self.coarser.get().map_or(0, Vec::len)
    }

    /// A level, 0 the finest.
    pub(super) fn level(&self, level: usize) -> Option<&LevelTemplate> {
        match level {
            0 => Some(&self.finest),
            _ => self.coarser.get()?.get(level - 1),
        }
    }

    /// The level of the full image.
    pub(super) fn finest(&self) -> &LevelTemplate {
        &self.finest
    }
}

/// A patch of one pyramid level.
#[derive(Debug, Clone)]
pub(super) struct LevelTemplate {
    /// Centre of the patch in pixels of its level; integer plus one half, so that the samples are the image's own.
    pub centre: Vector2<f64>,
    /// Contrast: samples less their mean. Gradients along x and y, made orthogonal to constants and to the contrast: their product
    /// with an image that differs only by gain and offset is zero.
    appearance: Memory,
    /// The matrix of products of the two gradients.
    pub hessian: Matrix2<f64>,
    /// Its inverse.
    pub inverse_hessian: Matrix2<f64>,
    /// Sum of the squared contrast.
    pub contrast_energy: f64,
    /// The part of the contrast that was taken off the gradients along x and y.
    pub shares: Vector2<f64>,
    /// What was taken off samples and gradients; [`LevelTemplate::shares`] too.
    pub less: Orthogonal,
}

/// Room for one appearance. A keyframe has hundreds of them, 3 KiB each, and the next one has as many again: they are kept for it, because
/// memory that is new from the system costs more than what is written into it.
#[derive(Debug, Clone)]
struct Memory(Vec<Appearance>);

/// At most so many are kept in a thread: those of a keyframe with its coarser levels.
const MOST_KEPT: usize = 1024;

thread_local! {
    static KEPT: RefCell<Vec<Memory>> = const { RefCell::new(Vec::new()) };
}

impl Memory {
    /// What is in it means nothing.
    fn new() -> Self {
        let kept = KEPT.try_with(|kept| kept.borrow_mut().pop()).ok().flatten();
        kept.unwrap_or_else(|| Self(vec![Appearance::ZERO]))
    }
}

impl Drop for LevelTemplate {
    fn drop(&mut self) {
        let appearance = std::mem::take(&mut self.appearance.0);
        // Nothing is kept where the thread is ending.
        let _ = KEPT.try_with(|kept| {
            let mut kept = kept.borrow_mut();
            if kept.len() < MOST_KEPT {
                kept.push(Memory(appearance));
            }
        });
    }
}

impl LevelTemplate {
    /// Contrast and gradients of the patch; see the field.
    pub fn appearance(&self) -> &Appearance {
        &self.appearance.0[0]
    }

    pub fn new(image: &GrayImage, x: f64, y: f64) -> Option<Self> {
        // One sample around the patch is needed for the gradients.
        let (left, top) = ((x - TO_CENTRE).round(), (y - TO_CENTRE).round());
        let fits = left >= 1.0
            && top >= 1.0
            && left + SIDE as f64 + 1.0 <= image.width() as f64
            && top + SIDE as f64 + 1.0 <= image.height() as f64;
        if !fits {
            return None;
        }
        let (left, top) = (left as usize, top as usize);
        // Whole numbers, exact; gradients are in half gray levels per pixel until they are halved here.
        let sums = patch_sums(image, left, top);
        let n = AREA as f64;
        let mean = f64::from(sums.sample) / n;
        let mean_x = 0.5 * f64::from(sums.x) / n;
        let mean_y = 0.5 * f64::from(sums.y) / n;
        let contrast_energy = f64::from(sums.sample_sample) - n * mean * mean;
        if contrast_energy < n * 0.25 {
            return None; // half a gray level of contrast is rounding
        }
        let share_x = (0.5 * f64::from(sums.sample_x) - n * mean * mean_x) / contrast_energy;
        let share_y = (0.5 * f64::from(sums.sample_y) - n * mean * mean_y) / contrast_energy;
        // What is left of the products when means and shares of the contrast are taken off.
        let left_of = |product: i32, means: f64, shares: f64| {
            0.25 * f64::from(product) - n * means - shares * contrast_energy
        };
        let xx = left_of(sums.x_x, mean_x * mean_x, share_x * share_x);
        let xy = left_of(sums.x_y, mean_x * mean_y, share_x * share_y);
        let yy = left_of(sums.y_y, mean_y * mean_y, share_y * share_y);
        // A direction with less than this mean squared gradient cannot be held.
        let weakest = 0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
        if weakest < n * 0.01 {
            return None;
        }
        let hessian = Matrix2::new(xx, xy, xy, yy);
        let inverse_hessian = hessian.try_inverse()?;
        let mut appearance = Memory::new();
        let less = Orthogonal {
            mean: mean as f32,
            mean_x: mean_x as f32,
            mean_y: mean_y as f32,
            share_x: share_x as f32,
            share_y: share_y as f32,
        };
        appearance.0.iter_mut().for_each(|a| write_appearance(image, left, top, &less, a));
        Some(Self {
            centre: Vector2::new(left as f64 + TO_CENTRE, top as f64 + TO_CENTRE),
            hessian,
            inverse_hessian,
            appearance,
            contrast_energy,
            shares: Vector2::new(share_x, share_y),
            less,
        })
    }
}
