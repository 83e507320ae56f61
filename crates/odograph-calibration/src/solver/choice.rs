//! Selection of the lens model by expected ray error and cross-validation.

use super::bundle::BoardCorrespondence;
use super::config::LensModel;
use super::fit::{HoldOut, LensFit};
use super::quality::{ErrorMap, covariance, disagreement_px};
use super::result::ModelComparison;
use odograph::camera::{Camera, Distortion};
use odograph::geometry::{Pixel, Ray};

/// Relative differences of the mean square error below this value are insignificant.
const MIN_LOSS: f64 = 0.002;

/// Factor from the excess mean square error of a model at the points to its assumed mean square ray
/// error over the image. A misfit grows towards the image corners, where there are few points.
const SURE_OVER_FITTING: f64 = 30.0;

/// Two models whose rays differ by less than this many standard deviations may be the same lens.
const CHANCE_DEVIATIONS: f64 = 2.0;

/// Models whose RMS errors differ by less than this factor describe the views equally well.
const NEAR: f64 = 1.1;

/// Half diagonal field of view from which a lens counts as very wide, radians: 60°.
const VERY_WIDE_RAD: f64 = std::f64::consts::FRAC_PI_3;

/// A fitted lens model with its cross-validation result and comparison figures.
pub struct Tried {
    pub fit: LensFit,
    pub hold_out: HoldOut,
    pub candidate: ModelComparison,
    pub camera: Camera,
}

impl Tried {
    /// Cross-validates a fit; `None` if its parameters are not a valid camera.
    pub fn new(fit: LensFit, sights: &[Vec<BoardCorrespondence>], size: (usize, usize)) -> Option<Self> {
        let hold_out = fit.hold_out(sights);
        let camera = fit.state.lens.camera(size).ok()?;
        let map = ErrorMap::new(&camera, &fit.state.lens, &fit.unknowns.lens, covariance(&fit, sights));
        let candidate = ModelComparison {
            model: fit.model,
            hold_out_rms_px: hold_out.rms_px,
            rms_px: fit.rms_px(sights),
            expected_error_px: map.over_image_px(),
            with_misfit_px: map.over_image_px(),
        };
        Some(Self { fit, hold_out, candidate, camera })
    }
}

/// Index of the selected model: the one with the smallest expected ray error over the image, misfit
/// included, which is entered into the figures of each.
///
/// Cross-validation finds the model that predicts held-out views best, but only where there were
/// points. There, a superfluous coefficient does no harm, while in the image corners it may cost
/// pixels. The mean square ray error of each model is therefore the sum of two terms: the variance
/// from the covariance of its parameters, and a squared bias for a wrong lens model. The bias is
/// the larger of two estimates:
///
/// * the disagreement of its rays with those of the best-predicting model, minus the variance of
///   the latter, where it is significant;
/// * the excess of its cross-validation error over that of the best-predicting model, minus one
///   standard error of the paired differences between views (the one-standard-error rule of L.
///   Breiman et al., "Classification and regression trees", 1984, section 3.4.3), times a factor.
///
/// The double sphere model, which few programs support, is only selected for very wide lenses, a
/// rational model only without a pole in the image. A model that turns back within the image, where
/// one that predicts as well does not, is neither selected nor what the others are compared with.
pub fn choose(tried: &mut [Tried]) -> Option<usize> {
    let squares = squared_ray_errors(tried);
    for (one, square) in tried.iter_mut().zip(squares.iter().flatten()) {
        one.candidate.with_misfit_px = square.sqrt();
    }
    let Some(squares) = squares else { return simplest_that_fits(tried) };
    let whole = with_most_corners(tried);
    let very_wide = is_very_wide(&tried[best_predicting(tried, &whole)?].camera);
    let eligible = |at: &usize| {
        let rare = tried[*at].fit.model == LensModel::DoubleSphere && !very_wide;
        !rare && whole[*at] && !has_pole(&tried[*at].camera)
    };
    (0..tried.len()).filter(eligible).min_by(|&a, &b| squares[a].total_cmp(&squares[b]))
}

/// Mean square reprojection error of a model over held-out views; NaN or infinite if unknown.
fn held_out(tried: &Tried) -> f64 {
    let views = &tried.hold_out.views;
    views.iter().sum::<f64>() / views.len().max(1) as f64
}

/// Index of the model that predicts held-out views best, among those that are `whole`.
fn best_predicting(tried: &[Tried], whole: &[bool]) -> Option<usize> {
    let models = (0..tried.len()).filter(|&at| whole[at]);
    models.min_by(|&a, &b| held_out(&tried[a]).total_cmp(&held_out(&tried[b])))
}

/// Of each model whether none that predicts held-out views as well, to [`NEAR`], has rays through
/// more corners of the image.
fn with_most_corners(tried: &[Tried]) -> Vec<bool> {
    let least = tried.iter().map(held_out).fold(f64::INFINITY, f64::min);
    let counts: Vec<usize> = tried.iter().map(|one| corners_with_rays(&one.camera)).collect();
    let near = tried.iter().zip(&counts).filter(|(one, _)| held_out(one) <= NEAR.powi(2) * least);
    let most = near.map(|(_, count)| *count).max().unwrap_or(0);
    counts.into_iter().map(|count| count >= most).collect()
}

/// Number of image corners with rays, but for their outermost pixels. Beyond some angle the
/// polynomials of a lens turn back: from there on there are none.
fn corners_with_rays(camera: &Camera) -> usize {
    /// Distance from the middle of the image, of that of a corner.
    const WITHIN: f64 = 0.97;
    rays_at(camera, WITHIN).iter().flatten().count()
}

/// Mean square ray error of each model over the image, variance plus squared bias; `None` if there
/// are too few views for cross-validation.
fn squared_ray_errors(tried: &[Tried]) -> Option<Vec<f64>> {
    let best = best_predicting(tried, &with_most_corners(tried))?;
    if !held_out(&tried[best]).is_finite() {
        return None;
    }
    let error = |at: usize| tried[at].candidate.expected_error_px;
    let total = |at: usize| {
        let pairs = tried[at].hold_out.views.iter().zip(&tried[best].hold_out.views);
        let differences: Vec<f64> = pairs.map(|(a, b)| a - b).collect();
        let count = differences.len() as f64;
        let lost = differences.iter().sum::<f64>() / count;
        let variance = differences.iter().map(|d| (d - lost).powi(2)).sum::<f64>() / (count - 1.0).max(1.0);
        let chance = (variance / count).sqrt().max(MIN_LOSS * held_out(&tried[best]));
        let apart_px = disagreement_px(&tried[best].camera, &tried[at].fit.state.lens);
        let is_chance = at == best || apart_px < CHANCE_DEVIATIONS * error(best);
        let apart = if is_chance { 0.0 } else { apart_px.powi(2) - error(best).powi(2) };
        error(at).powi(2) + apart.max(SURE_OVER_FITTING * (lost - chance)).max(0.0)
    };
    Some((0..tried.len()).map(total).collect())
}

/// The model for too few views: the simplest one whose RMS is within [`NEAR`] of the best.
fn simplest_that_fits(tried: &[Tried]) -> Option<usize> {
    let least = tried.iter().map(|one| one.candidate.rms_px).fold(f64::INFINITY, f64::min);
    let near = |at: &usize| tried[*at].candidate.rms_px <= NEAR * least;
    (0..tried.len()).filter(near).min_by_key(|&at| tried[at].fit.model.coefficients())
}

/// Whether the denominator of a rational lens comes near zero within the image. Beside such a pole
/// the numerator has a zero, and they cancel only at the fitted coefficients: a standard deviation
/// off, there is no lens.
fn has_pole(camera: &Camera) -> bool {
    const MIN_DENOMINATOR: f64 = 0.2;
    const STEPS: u32 = 200;
    let Distortion::BrownConrady { k4, k5, k6, .. } = *camera.distortion() else { return false };
    let widest = corner_rays(camera)
        .into_iter()
        .flatten()
        .map(|ray| ray.x.powi(2) + ray.y.powi(2))
        .fold(0.0, f64::max);
    (0..=STEPS).map(|step| widest * f64::from(step) / f64::from(STEPS)).any(|r2| {
        let denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
        denominator < MIN_DENOMINATOR
    })
}

/// Whether an image corner is more than [`VERY_WIDE_RAD`] from the optical axis, or has no ray.
fn is_very_wide(camera: &Camera) -> bool {
    let limit = VERY_WIDE_RAD.tan();
    corner_rays(camera).iter().any(|ray| ray.is_none_or(|ray| ray.x.hypot(ray.y) > limit))
}

/// The rays through the corners of the image, as far as there are any.
fn corner_rays(camera: &Camera) -> [Option<Ray>; 4] {
    rays_at(camera, 1.0)
}

/// The same at this share of the way from the middle of the image to its corners.
fn rays_at(camera: &Camera, share: f64) -> [Option<Ray>; 4] {
    let (x, y) = (0.5 * (camera.width() as f64 - 1.0), 0.5 * (camera.height() as f64 - 1.0));
    [(-share, -share), (share, -share), (-share, share), (share, share)]
        .map(|(right, down)| camera.ray_from_pixel(Pixel::new(x + right * x, y + down * y)))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // in a test, what cannot be is a failure of the test
mod tests {
    use super::*;

    #[test]
    fn a_lens_that_turns_back_before_the_corners_has_no_rays_there() {
        // Fitted to the same views of an action camera: nearly alike to 500 px from the middle, but
        // the first has its largest radius, 610 px, at 60°.
        let polynomial = Distortion::from_opencv(&[-0.246, 0.076, 0.0, 0.0, -0.012]).unwrap();
        let fisheye = Distortion::KannalaBrandt { k1: 0.070, k2: -0.014, k3: 0.013, k4: -0.004 };
        let camera = |lens| Camera::new((1280, 960), (565.5, 566.4), (651.3, 500.3), lens).unwrap();
        assert_eq!(corners_with_rays(&camera(polynomial)), 0);
        assert_eq!(corners_with_rays(&camera(fisheye)), 4);
    }

    #[test]
    fn a_rational_lens_with_a_pole_in_the_image_is_recognised() {
        for (coefficients, expected) in [
            // Calibrated from a rendered board: numerator and denominator nearly vanish together.
            (&[-5.41, 7.13, 0.0, 0.0, 0.514, -5.29, 6.47, 1.42][..], true),
            // A wide lens, by OpenCV.
            (&[20.6, 8.1, 0.0, 0.0, 0.1, 20.9, 14.9, 1.2], false),
            (&[-0.28, 0.1, 0.0, 0.0, -0.01], false),
        ] {
            let lens = Distortion::from_opencv(coefficients).unwrap();
            let camera = Camera::new((640, 480), (500.0, 500.0), (320.0, 240.0), lens).unwrap();
            assert_eq!(has_pole(&camera), expected, "{coefficients:?}");
        }
    }
}
