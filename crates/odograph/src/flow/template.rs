//! The first appearance of a corner, prepared for being found again.

use super::patch::{AREA, SIDE, Samples, TO_CENTRE};
use crate::geometry::Pixel;
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
    /// Samples less their mean.
    pub contrast: Box<Samples>,
    /// Gradient along x, made orthogonal to constants and to the contrast: its product with an image that differs only by
    /// gain and offset is zero.
    pub gradient_x: Box<Samples>,
    /// The same along y.
    pub gradient_y: Box<Samples>,
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
        let mut contrast = Box::new([0.0f32; AREA]);
        let mut gradient_x = Box::new([0.0f32; AREA]);
        let mut gradient_y = Box::new([0.0f32; AREA]);
        for j in 0..SIDE {
            let above = &image.row(top + j - 1)[left - 1..left + SIDE + 1];
            let here = &image.row(top + j)[left - 1..left + SIDE + 1];
            let below = &image.row(top + j + 1)[left - 1..left + SIDE + 1];
            for i in 0..SIDE {
                let at = j * SIDE + i;
                contrast[at] = f32::from(here[i + 1]);
                gradient_x[at] = 0.5 * (f32::from(here[i + 2]) - f32::from(here[i]));
                gradient_y[at] = 0.5 * (f32::from(below[i + 1]) - f32::from(above[i + 1]));
            }
        }
        remove_mean(&mut contrast);
        let contrast_energy = dot(&contrast, &contrast);
        if contrast_energy < AREA as f64 * 0.25 {
            return None; // half a gray level of contrast is rounding
        }
        for gradient in [&mut gradient_x, &mut gradient_y] {
            remove_mean(gradient);
            let share = (dot(gradient, &contrast) / contrast_energy) as f32;
            gradient.iter_mut().zip(contrast.iter()).for_each(|(g, c)| *g -= share * c);
        }
        let cross = dot(&gradient_x, &gradient_y);
        let hessian =
            Matrix2::new(dot(&gradient_x, &gradient_x), cross, cross, dot(&gradient_y, &gradient_y));
        // A direction with less than this mean squared gradient cannot be held.
        let weakest = hessian.symmetric_eigenvalues().min();
        if weakest < AREA as f64 * 0.01 {
            return None;
        }
        Some(Self {
            centre: Vector2::new(left as f64 + TO_CENTRE, top as f64 + TO_CENTRE),
            inverse_hessian: hessian.try_inverse()?,
            contrast,
            gradient_x,
            gradient_y,
            contrast_energy,
        })
    }
}

fn remove_mean(samples: &mut Samples) {
    let mean = samples.iter().map(|&s| f64::from(s)).sum::<f64>() / AREA as f64;
    samples.iter_mut().for_each(|s| *s -= mean as f32);
}

/// The sum of products. Eight running sums, so that the order of additions is the same whatever the compiler makes of it.
pub(super) fn dot(a: &Samples, b: &Samples) -> f64 {
    let mut sums = [0.0f32; 8];
    for (a, b) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
        for i in 0..8 {
            sums[i] += a[i] * b[i];
        }
    }
    sums.iter().map(|&s| f64::from(s)).sum()
}
