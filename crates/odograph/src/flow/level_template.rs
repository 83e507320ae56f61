//! A template on one pyramid level: contrast, orthogonal gradients and their Hessian.

use super::patch::{AREA, SIDE, TO_CENTRE};
use crate::image::GrayImage;
use crate::image::simd::{Appearance, Orthogonal, patch_sums, write_appearance};
use nalgebra::{Matrix2, Vector2};
use std::cell::RefCell;

/// A patch of one pyramid level.
#[derive(Debug, Clone)]
pub(super) struct LevelTemplate {
    /// Centre of the patch in pixels of its level: integer plus one half, so that the samples are
    /// pixels.
    pub centre: Vector2<f64>,
    /// Contrast: samples minus their mean. Gradients along x and y, orthogonal to constants and to
    /// the contrast, so that their product with an image that differs by gain and offset only is
    /// zero.
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
    /// The means and projections that were subtracted from samples and gradients.
    pub removed: Orthogonal,
}

/// Memory of one appearance from a pool. A keyframe has hundreds of 3 KiB each, and the next one as
/// many again; fresh memory from the system costs more than writing into it.
#[derive(Debug, Clone)]
struct PooledAppearance(Vec<Appearance>);

/// Most appearances kept per thread: those of a keyframe with its coarser levels.
const MAX_POOLED: usize = 1024;

thread_local! {
    static POOL: RefCell<Vec<PooledAppearance>> = const { RefCell::new(Vec::new()) };
}

impl PooledAppearance {
    /// Uninitialised appearance.
    fn new() -> Self {
        let pool = POOL.try_with(|pool| pool.borrow_mut().pop()).ok().flatten();
        pool.unwrap_or_else(|| Self(vec![Appearance::ZERO]))
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
    pub fn appearance(&self) -> &Appearance {
        &self.appearance.0[0]
    }

    pub fn new(image: &GrayImage, x: f64, y: f64) -> Option<Self> {
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
        let sums = patch_sums(image, left, top);
        let n = AREA as f64;
        let mean = f64::from(sums.sample) / n;
        let mean_x = 0.5 * f64::from(sums.x) / n;
        let mean_y = 0.5 * f64::from(sums.y) / n;
        let contrast_energy = f64::from(sums.sample_sample) - n * mean * mean;
        if contrast_energy < n * 0.25 {
            return None; // a contrast of half a gray level is rounding error
        }
        let share_x = (0.5 * f64::from(sums.sample_x) - n * mean * mean_x) / contrast_energy;
        let share_y = (0.5 * f64::from(sums.sample_y) - n * mean * mean_y) / contrast_energy;
        // Products after means and projections are subtracted.
        let remaining = |product: i32, means: f64, contrast_projection: f64| {
            0.25 * f64::from(product) - n * means - contrast_projection * contrast_energy
        };
        let xx = remaining(sums.x_x, mean_x * mean_x, share_x * share_x);
        let xy = remaining(sums.x_y, mean_x * mean_y, share_x * share_y);
        let yy = remaining(sums.y_y, mean_y * mean_y, share_y * share_y);
        // Minimum mean squared gradient in the weakest direction (aperture problem). Not derived;
        // chosen.
        let smallest_eigenvalue = 0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
        if smallest_eigenvalue < n * 0.01 {
            return None;
        }
        let hessian = Matrix2::new(xx, xy, xy, yy);
        let inverse_hessian = hessian.try_inverse()?;
        let mut appearance = PooledAppearance::new();
        let removed = Orthogonal {
            mean: mean as f32,
            mean_x: mean_x as f32,
            mean_y: mean_y as f32,
            share_x: share_x as f32,
            share_y: share_y as f32,
        };
        appearance.0.iter_mut().for_each(|a| write_appearance(image, left, top, &removed, a));
        Some(Self {
            centre: Vector2::new(left as f64 + TO_CENTRE, top as f64 + TO_CENTRE),
            hessian,
            inverse_hessian,
            appearance,
            contrast_energy,
            contrast_projection: Vector2::new(share_x, share_y),
            removed,
        })
    }
}
