//! Which lens model: the one that foretells views it has not seen, and of those that do so equally well the surest.

use super::bundle::Sight;
use super::fit::{Fit, HoldOut};
use super::quality::{ErrorMap, covariance};
use super::result::Candidate;

/// How much better, as a share of the mean square distance, a model must be beyond chance to count as better.
const LEAST_GAIN: f64 = 0.002;

/// A model with what speaks for and against it.
pub struct Tried {
    pub fit: Fit,
    pub hold_out: HoldOut,
    pub candidate: Candidate,
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
        Some(Self { fit, hold_out, candidate })
    }
}

/// The place of the model to take.
///
/// The best foreteller is the one with the least mean over views. Another is as good where it is worse by less than one standard
/// error of the paired differences between views (the rule of L. Breiman et al., "Classification and regression trees", 1984,
/// section 3.4.3) or by a trifle. Of all those the one is taken whose rays are expected to be the surest over the whole
/// image: a coefficient that is not needed costs nothing where points are and pixels in the corners.
pub fn choose(tried: &[Tried]) -> Option<usize> {
    let mean = |at: usize| {
        let views = &tried[at].hold_out.views;
        views.iter().map(|view| view.1).sum::<f64>() / views.len().max(1) as f64
    };
    // With too few views to hold any out, the simplest of those that fit within a tenth.
    let best = (0..tried.len()).min_by(|&a, &b| mean(a).total_cmp(&mean(b)))?;
    if !mean(best).is_finite() {
        let least = tried.iter().map(|one| one.candidate.rms_px).fold(f64::INFINITY, f64::min);
        let near = |at: &usize| tried[*at].candidate.rms_px <= 1.1 * least;
        return (0..tried.len()).filter(near).min_by_key(|&at| tried[at].fit.model.coefficients());
    }
    let as_good = |at: &usize| {
        let differences: Vec<f64> = tried[*at]
            .hold_out
            .views
            .iter()
            .zip(&tried[best].hold_out.views)
            .map(|(a, b)| a.1 - b.1)
            .collect();
        let count = differences.len() as f64;
        let worse = differences.iter().sum::<f64>() / count;
        let variance = differences.iter().map(|d| (d - worse).powi(2)).sum::<f64>() / (count - 1.0).max(1.0);
        worse <= (variance / count).sqrt().max(LEAST_GAIN * mean(best))
    };
    let surest = |&a: &usize, &b: &usize| {
        tried[a].candidate.expected_error_px.total_cmp(&tried[b].candidate.expected_error_px)
    };
    (0..tried.len()).filter(as_good).min_by(surest)
}
