//! The first appearance of a corner, prepared for being found again.

use super::patch::{AREA, SIDE, TO_CENTRE};
use crate::geometry::Pixel;
use crate::image::simd::{Appearance, copy_appearance, dot, remove_mean, remove_share};
use crate::image::{GrayImage, Pyramid};
use nalgebra::{Matrix2, Vector2};

/// Patches of a keyframe around one corner, one a pyramid level, with everything about them that does not depend on the
/// image they will be searched in.
#[derive(Debug, Clone)]
pub struct Template {
    centre: Pixel,
    levels: Vec<LevelTemplate>,
}

impl Template {
    /// The template of the patch whose centre is half a pixel right of and below `corner` (a patch has an even side).
    ///
    /// `None` where the patch does not fit into the image, or has no texture in some direction. Coarser levels are left out
    /// from the first on which it does not fit.
    pub fn new(pyramid: &Pyramid, corner: (usize, usize)) -> Option<Self> {
        let centre = Pixel::new(corner.0 as f64 + 0.5, corner.1 as f64 + 0.5);
        let mut levels = Vec::with_capacity(pyramid.levels().len());
        for (level, image) in pyramid.levels().iter().enumerate() {
            let scale = (1 << level) as f64;
            match LevelTemplate::new(image, centre.x / scale, centre.y / scale) {
                Some(template) => levels.push(template),
                None if level == 0 => return None,
                None => break,
            }
        }
        Some(Self { centre, levels })
    }

    /// The keyframe point that the template is about, in pixels of the full image.
    pub fn centre(&self) -> Pixel {
        self.centre
    }

    /// The levels, finest first; at least one.
    pub(super) fn levels(&self) -> &[LevelTemplate] {
        &self.levels
    }
}

/// A patch of one pyramid level.
#[derive(Debug, Clone)]
pub(super) struct LevelTemplate {
    /// Centre of the patch in pixels of its level; integer plus one half, so that the samples are the image's own.
    pub centre: Vector2<f64>,
    /// Contrast: samples less their mean. Gradients along x and y, made orthogonal to constants and to the contrast: their product
    /// with an image that differs only by gain and offset is zero.
    pub appearance: Box<Appearance>,
    /// Inverse of the matrix of products of the two gradients.
    pub inverse_hessian: Matrix2<f64>,
    /// Sum of the squared contrast.
    pub contrast_energy: f64,
}

impl LevelTemplate {
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
        let mut appearance = Appearance::zero();
        copy_appearance(image, left, top, &mut appearance);
        let Appearance { contrast, gradient_x, gradient_y } = &mut *appearance;
        remove_mean(contrast);
        let contrast_energy = dot(contrast, contrast);
        if contrast_energy < AREA as f64 * 0.25 {
            return None; // half a gray level of contrast is rounding
        }
        for gradient in [&mut *gradient_x, &mut *gradient_y] {
            remove_mean(gradient);
            remove_share(gradient, (dot(gradient, contrast) / contrast_energy) as f32, contrast);
        }
        let cross = dot(gradient_x, gradient_y);
        let hessian = Matrix2::new(dot(gradient_x, gradient_x), cross, cross, dot(gradient_y, gradient_y));
        // A direction with less than this mean squared gradient cannot be held.
        let weakest = hessian.symmetric_eigenvalues().min();
        if weakest < AREA as f64 * 0.01 {
            return None;
        }
        Some(Self {
            centre: Vector2::new(left as f64 + TO_CENTRE, top as f64 + TO_CENTRE),
            inverse_hessian: hessian.try_inverse()?,
            appearance,
            contrast_energy,
        })
    }
}
