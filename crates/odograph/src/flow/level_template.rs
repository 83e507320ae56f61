//! A template on one pyramid level: contrast, orthogonal gradients and their Hessian.

use super::patch::{AREA, SIDE, TO_CENTRE, gradient_noise};
use crate::geometry::Pixel;
use crate::image::Pyramid;
use crate::image::simd::{
    Orthogonal, PatchSums, Plane, TemplateSamples, patch_sums, weighted_sums, write_appearance,
};
use nalgebra::{Matrix2, Vector2};
use std::cell::RefCell;

/// A patch of one pyramid level.
#[derive(Debug, Clone)]
pub(super) struct LevelTemplate {
    /// Centre of the patch in pixels of its level: integer plus one half, so that the samples are
    /// pixels.
    pub centre: Vector2<f64>,
    /// Contrast: samples minus the plane that fits them best. Gradients along x and y, orthogonal
    /// to planes and to the contrast, so that their product with an image that differs only by a
    /// gain and by light that changes linearly over the patch is zero. In a patch that would lose
    /// too much, they are orthogonal to constants only.
    appearance: PooledAppearance,
    /// Gauss–Newton Hessian: products of the gradients.
    pub hessian: Matrix2<f64>,
    /// Its inverse.
    pub inverse_hessian: Matrix2<f64>,
    /// Sum of the squared contrast.
    pub contrast_energy: f64,
    /// Projection coefficients: the multiples of the contrast that were subtracted from the
    /// gradients along x and y.
    pub contrast_projection: Vector2<f64>,
    /// The planes and projections that were subtracted from samples and gradients.
    pub removed: Orthogonal,
}

/// Memory of one appearance from a pool. A keyframe has hundreds of 3 KiB each, and the next one as
/// many again; fresh memory from the system costs more than writing into it.
#[derive(Debug, Clone)]
struct PooledAppearance(Vec<TemplateSamples>);

/// Most appearances kept per thread: those of a keyframe with its coarser levels.
const MAX_POOLED: usize = 1024;

thread_local! {
    static POOL: RefCell<Vec<PooledAppearance>> = const { RefCell::new(Vec::new()) };
}

impl PooledAppearance {
    /// Uninitialised appearance.
    fn new() -> Self {
        let pool = POOL.try_with(|pool| pool.borrow_mut().pop()).ok().flatten();
        pool.unwrap_or_else(|| Self(vec![TemplateSamples::ZERO]))
    }
}

impl Drop for LevelTemplate {
    fn drop(&mut self) {
        let appearance = std::mem::take(&mut self.appearance.0);
        // The thread-local pool may already be gone at the end of a thread.
        let _ = POOL.try_with(|pool| {
            let mut pool = pool.borrow_mut();
            if pool.len() < MAX_POOLED {
                pool.push(PooledAppearance(appearance));
            }
        });
    }
}

impl LevelTemplate {
    /// Contrast and gradients of the patch.
    pub fn appearance(&self) -> &TemplateSamples {
        &self.appearance.0[0]
    }

    /// The patch on this level of a pyramid whose centre is nearest to a position in the full
    /// image. `None` where it does not fit into the image, or has no texture in some direction.
    pub fn new(pyramid: &Pyramid, level: usize, centre: Pixel) -> Option<Self> {
        let (image, scale) = (pyramid.level(level), (1usize << level) as f64);
        let (x, y) = (centre.x / scale, centre.y / scale);
        // The gradients need one sample around the patch.
        let (left, top) = ((x - TO_CENTRE).round(), (y - TO_CENTRE).round());
        let fits = left >= 1.0
            && top >= 1.0
            && left + SIDE as f64 + 1.0 <= image.width() as f64
            && top + SIDE as f64 + 1.0 <= image.height() as f64;
        if !fits {
            return None;
        }
        let (left, top) = (left as usize, top as usize);
        // Integer sums, exact; gradients are in half gray levels per pixel until they are halved
        // here.
        let (sums, weighted) = (patch_sums(image, left, top), weighted_sums(image, left, top));
        let plane = |sum: i32, weighted: [i32; 2], unit: f64| {
            Plane::of_sums(unit * f64::from(sum), weighted.map(|sum| 0.5 * unit * f64::from(sum)))
        };
        let samples = plane(sums.sample, weighted.sample, 1.0);
        let [x, y] = [(sums.x, weighted.x), (sums.y, weighted.y)].map(|(sum, by)| plane(sum, by, 0.5));
        let even = [samples, x, y].map(|plane| Plane { slope: [0.0; 2], ..plane });
        let noise_part = gradient_noise(pyramid.noise_variance() * VARIANCE_PER_LEVEL.powi(level as i32));
        let in_even_light = DetrendedProducts::new(&sums, &even)?;
        let in_uneven_light = DetrendedProducts::new(&sums, &[samples, x, y]).filter(|products| {
            let [kept, whole] = [products, &in_even_light].map(|of| of.smaller_eigenvalue - noise_part);
            kept > MIN_KEPT * whole.max(0.0)
        });
        let planes = if in_uneven_light.is_some() { [samples, x, y] } else { even };
        let products = in_uneven_light.unwrap_or(in_even_light);
        if products.smaller_eigenvalue < AREA as f64 * MIN_SQUARED_GRADIENT {
            return None;
        }
        let DetrendedProducts { contrast_energy, contrast_projection, hessian, .. } = products;
        let inverse_hessian = hessian.try_inverse()?;
        let mut appearance = PooledAppearance::new();
        let removed = Orthogonal { planes, shares: contrast_projection.into() };
        appearance.0.iter_mut().for_each(|a| write_appearance(image, left, top, &removed, a));
        Some(Self {
            centre: Vector2::new(left as f64 + TO_CENTRE, top as f64 + TO_CENTRE),
            appearance,
            hessian,
            inverse_hessian,
            contrast_energy,
            contrast_projection,
            removed,
        })
    }

    /// Whether the light may change linearly over the patch.
    pub fn is_in_uneven_light(&self) -> bool {
        self.removed.planes[0].slope != [0.0; 2]
    }
}

/// A patch of which less than this fraction of the smaller eigenvalue of the Hessian would be left
/// is taken to be in even light: what is smooth over the patch, by blur or by itself, cannot be
/// told from light. Not derived; chosen on variants of a flight with strong blur, where 0.35 to 0.7
/// lose no frame, and shown on rendered shadows, lamps, caustics and reflections. Noise does not
/// count.
const MIN_KEPT: f64 = 0.5;

/// Variance of white noise on a level over that on the finer one: the binomial filter 1 4 6 4 1
/// along both axes.
const VARIANCE_PER_LEVEL: f64 = (70.0 / 256.0) * (70.0 / 256.0);

/// Minimum mean squared gradient in the weakest direction (aperture problem), (gray levels per
/// pixel)². Not derived; chosen.
const MIN_SQUARED_GRADIENT: f64 = 0.01;

/// Products of contrast and gradients after planes are subtracted from them, and from the gradients
/// their projection onto the contrast.
struct DetrendedProducts {
    contrast_energy: f64,
    contrast_projection: Vector2<f64>,
    hessian: Matrix2<f64>,
    smaller_eigenvalue: f64,
}

impl DetrendedProducts {
    /// Of a patch with these sums, less the planes of samples and of gradients along x and y.
    /// `None` where there is hardly any contrast.
    fn new(sums: &PatchSums, [samples, plane_x, plane_y]: &[Plane; 3]) -> Option<Self> {
        let contrast_energy = f64::from(sums.sample_sample) - samples.dot(samples);
        if contrast_energy < AREA as f64 * 0.25 {
            return None; // a contrast of half a gray level is rounding error
        }
        let share_x = (0.5 * f64::from(sums.sample_x) - samples.dot(plane_x)) / contrast_energy;
        let share_y = (0.5 * f64::from(sums.sample_y) - samples.dot(plane_y)) / contrast_energy;
        let remaining = |product: i32, planes: f64, shares: f64| {
            0.25 * f64::from(product) - planes - shares * contrast_energy
        };
        let xx = remaining(sums.x_x, plane_x.dot(plane_x), share_x * share_x);
        let xy = remaining(sums.x_y, plane_x.dot(plane_y), share_x * share_y);
        let yy = remaining(sums.y_y, plane_y.dot(plane_y), share_y * share_y);
        Some(Self {
            contrast_energy,
            contrast_projection: Vector2::new(share_x, share_y),
            hessian: Matrix2::new(xx, xy, xy, yy),
            smaller_eigenvalue: 0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt(),
        })
    }
}
