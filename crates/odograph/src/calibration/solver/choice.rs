//! Which lens model: the one that foretells views it has not seen, and of those that do so equally well the surest.

use super::bundle::Sight;
use super::fit::{Fit, HoldOut};
use super::quality::{ErrorMap, covariance, disagreement_px};
use super::result::{Candidate, LensModel};
use crate::camera::Camera;
use crate::geometry::Pixel;

/// A mean square distance larger by less than this share is no larger.
const LEAST_LOSS: f64 = 0.002;

/// A model that fits the points worse by a mean square of 1 is taken for wrong by this much elsewhere: what it cannot follow where points
/// are grows towards the corners, where there are few.
const SURE_OVER_FITTING: f64 = 30.0;

/// Half the angle across the image's diagonal from which on a lens is very wide, radians: 60°.
const VERY_WIDE_RAD: f64 = std::f64::consts::FRAC_PI_3;

/// A model with what speaks for and against it.
pub struct Tried {
    pub fit: Fit,
    pub hold_out: HoldOut,
    pub candidate: Candidate,
    pub camera: Camera,
}

impl Tried {
    /// Measures a fit.
    pub fn new(fit: Fit, sights: &[Vec<Sight>], size: (usize, usize)) -> Option<Self> {
        let hold_out = fit.hold_out(sights);
        let camera = fit.state.lens.camera(size).ok()?;
        let map = ErrorMap::new(&camera, &fit.state.lens, &fit.unknowns.lens, covariance(&fit, sights));
        let candidate = Candidate {
            model: fit.model,
            hold_out_rms_px: hold_out.rms_px,
            rms_px: fit.rms_px(sights),
            expected_error_px: map.over_image_px(),
        };
        Some(Self { fit, hold_out, candidate, camera })
    }
}

/// The place of the model to take: the one with the least error of rays to be expected over the whole image.
///
/// The views held out say which foretells best, but only where points were, and a coefficient that is not needed costs nothing
/// there and pixels in the corners. So of every model two errors are added as squares: that of its uncertain numbers, from the covariance,
/// and that of its shape. A shape is doubted as far as its rays differ from those of the best foreteller by more than that one's own
/// uncertainty explains, and as far as views held out are foretold worse by more than one standard error of the paired
/// differences between views (the rule of L. Breiman et al., "Classification and regression trees", 1984, section 3.4.3).
///
/// The double sphere, which few programs read, is taken for very wide lenses alone.
pub fn choose(tried: &[Tried]) -> Option<usize> {
    let mean = |at: usize| {
        let views = &tried[at].hold_out.views;
        views.iter().sum::<f64>() / views.len().max(1) as f64
    };
    // With too few views to hold any out, the simplest of those that fit within a tenth.
    let best = (0..tried.len()).min_by(|&a, &b| mean(a).total_cmp(&mean(b)))?;
    if !mean(best).is_finite() {
        let least = tried.iter().map(|one| one.candidate.rms_px).fold(f64::INFINITY, f64::min);
        let near = |at: &usize| tried[*at].candidate.rms_px <= 1.1 * least;
        return (0..tried.len()).filter(near).min_by_key(|&at| tried[at].fit.model.coefficients());
    }
    let error = |at: usize| tried[at].candidate.expected_error_px;
    // Mean square error over the image: that of uncertain numbers and that of a shape that cannot be right.
    let total = |at: usize| {
        let pairs = tried[at].hold_out.views.iter().zip(&tried[best].hold_out.views);
        let differences: Vec<f64> = pairs.map(|(a, b)| a - b).collect();
        let count = differences.len() as f64;
        let lost = differences.iter().sum::<f64>() / count;
        let variance = differences.iter().map(|d| (d - lost).powi(2)).sum::<f64>() / (count - 1.0).max(1.0);
        let chance = (variance / count).sqrt().max(LEAST_LOSS * mean(best));
        let apart_px = disagreement_px(&tried[best].camera, &tried[at].fit.state.lens);
        let apart = if at == best { 0.0 } else { apart_px.powi(2) - error(best).powi(2) };
        error(at).powi(2) + apart.max(SURE_OVER_FITTING * (lost - chance)).max(0.0)
    };
    let totals: Vec<f64> = (0..tried.len()).map(total).collect();
    let very_wide = is_very_wide(&tried[best].camera);
    let eligible = |at: &usize| very_wide || tried[*at].fit.model != LensModel::DoubleSphere;
    (0..tried.len()).filter(eligible).min_by(|&a, &b| totals[a].total_cmp(&totals[b]))
}

/// Whether a corner of the image is further from the axis than [`VERY_WIDE_RAD`], or beyond what a camera has rays for.
fn is_very_wide(camera: &Camera) -> bool {
    let (right, bottom) = (camera.width() as f64 - 1.0, camera.height() as f64 - 1.0);
    [(0.0, 0.0), (right, 0.0), (0.0, bottom), (right, bottom)].into_iter().any(|(x, y)| {
        camera.ray_from_pixel(Pixel::new(x, y)).is_none_or(|ray| ray.x.hypot(ray.y) > VERY_WIDE_RAD.tan())
    })
}
