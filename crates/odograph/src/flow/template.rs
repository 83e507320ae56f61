//! The first appearance of a corner, prepared for tracking.

use super::curvature_bias::curvature_bias;
use super::interpolation_bias::InterpolationBias;
use super::level_template::LevelTemplate;
use super::noise::Noise;
use crate::geometry::Pixel;
use crate::image::Pyramid;
use crate::image::simd::{Moments, moments};
use nalgebra::{Matrix2, Vector2};
use std::sync::OnceLock;

/// Patches of a keyframe around one corner, one per pyramid level, with all precomputed values that
/// do not depend on the image to be searched.
#[derive(Debug, Clone)]
pub struct Template {
    centre: Pixel,
    finest: LevelTemplate,
    moments: Moments,
    interpolation_bias: InterpolationBias,
    /// Upper bound of the noise variance of its samples, gray levels².
    max_noise_variance: f64,
    /// Coarser levels, the finer ones first; made when first needed.
    coarser: OnceLock<Vec<LevelTemplate>>,
}

impl Template {
    /// The template of the patch whose centre is half a pixel right of and below `corner` (a patch
    /// has an even side).
    ///
    /// `None` where the patch does not fit into the image, or has no texture in some direction.
    /// Coarser levels end at the first on which it does not fit.
    pub fn new(pyramid: &Pyramid, corner: (usize, usize)) -> Option<Self> {
        let template = Self::of_finest_level(pyramid, corner)?;
        template.add_coarser_levels(pyramid);
        Some(template)
    }

    /// [`Template::new`] with the full image only, until [`Template::add_coarser_levels`].
    pub fn of_finest_level(pyramid: &Pyramid, corner: (usize, usize)) -> Option<Self> {
        let centre = Pixel::new(corner.0 as f64 + 0.5, corner.1 as f64 + 0.5);
        let finest = LevelTemplate::new(pyramid, 0, centre)?;
        let moments = moments(finest.appearance(), &finest.removed);
        let interpolation_bias = InterpolationBias::new(pyramid.base(), &finest);
        Some(Self {
            centre,
            finest,
            moments,
            interpolation_bias,
            max_noise_variance: pyramid.noise_variance(),
            coarser: OnceLock::new(),
        })
    }

    /// Makes the missing coarser levels, from the pyramid of the keyframe.
    pub fn add_coarser_levels(&self, pyramid: &Pyramid) {
        self.coarser.get_or_init(|| {
            (1..=pyramid.coarser().len())
                .map_while(|level| LevelTemplate::new(pyramid, level, self.centre))
                .collect()
        });
    }

    /// Centre of the template in the keyframe, pixels of the full image.
    pub fn centre(&self) -> Pixel {
        self.centre
    }

    /// Displacement of a match with this noise by the curvature of the warp, pixels; `curvature`
    /// holds the second derivatives by (x, x), (x, y) and (y, y), pixels per pixel².
    pub fn curvature_bias(
        &self,
        noise: &Noise,
        linear: &Matrix2<f64>,
        curvature: &[Vector2<f64>; 3],
    ) -> Vector2<f64> {
        curvature_bias(&self.moments, noise, linear, curvature)
    }

    /// Interpolation bias and noise-induced bias of a match at `position` in the full image,
    /// pixels.
    pub(super) fn bias(&self, position: Vector2<f64>, linear: &Matrix2<f64>, noise: &Noise) -> Vector2<f64> {
        self.interpolation_bias.at(position, linear, &self.finest, noise) + linear * noise.bias(&self.finest)
    }

    /// Noise of a match at `position` under a warp with this linear part, from its dissimilarity.
    pub(super) fn noise(&self, position: Vector2<f64>, linear: &Matrix2<f64>, dissimilarity: f64) -> Noise {
        Noise::new(&self.finest, self.max_noise_variance, position, linear, dissimilarity)
    }

    /// Number of levels, at least one.
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
