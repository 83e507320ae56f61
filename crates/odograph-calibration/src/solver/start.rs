//! Initial camera and initial poses for any lens, from telephoto to fisheye.
//!
//! The initial camera is the same for every model: a Kannala–Brandt lens, fitted from several
//! hypotheses of the focal length and an initially equidistant projection. Its θ + k1 θ³ + k2 θ⁵
//! approximates every common lens (tan θ of a pinhole has k1 = 1/3). For each hypothesis,
//! homographies and poses are computed from the ray directions and a few views are refined in a
//! short bundle adjustment; the best-fitting hypothesis is used. Zhang's closed-form solution only
//! provides the first hypothesis. It ignores distortion and is off by tens of percent for strong
//! barrel distortion.

use super::bundle::{BoardCorrespondence, Bundle, BundleState, BundleUnknowns, adjust, residuals};
use super::config::LensModel;
use super::lens::{Lens, free_numbers};
use super::zhang;
use nalgebra::{Isometry3, Vector3};

/// Number of views, and points per view, used to compare hypotheses of the focal length.
const VIEWS: usize = 10;
const POINTS: usize = 40;

/// Hypotheses of the half diagonal field of view, degrees, in the order in which they are tried.
const HALF_ANGLES: [f64; 8] = [30.0, 45.0, 20.0, 60.0, 75.0, 12.0, 90.0, 105.0];

/// Maximum angle from the optical axis for ray directions computed with a hypothetical lens,
/// radians.
const WIDEST_RAD: f64 = 2.0;

/// A Kannala–Brandt lens that approximately fits the views, and the pose of each view (`None` if no
/// pose was found).
pub fn start(
    views: &[&[BoardCorrespondence]],
    size: (usize, usize),
) -> Option<(Lens, Vec<Option<Isometry3<f64>>>)> {
    let centre = ((size.0 as f64 - 1.0) / 2.0, (size.1 as f64 - 1.0) / 2.0);
    let half_diagonal = (size.0 as f64).hypot(size.1 as f64) / 2.0;
    let homographies: Vec<_> =
        views.iter().map(|sights| zhang::pixel_homography(sights, centre, half_diagonal)).collect();
    let few = telling_views(&homographies);
    let thinned: Vec<Vec<BoardCorrespondence>> = few.iter().map(|&view| thin(views[view], POINTS)).collect();
    let few: Vec<&[BoardCorrespondence]> = thinned.iter().map(Vec::as_slice).collect();

    let known: Vec<_> = homographies.iter().flatten().copied().collect();
    let closed = zhang::focal_length_centred(&known);
    let closed_free = zhang::focal_length_free(&known);
    let guesses = closed.into_iter().chain(closed_free).chain(HALF_ANGLES.map(|a| 1.0 / a.to_radians()));
    let mut best: Option<(f64, Lens)> = None;
    let mut tried: Vec<f64> = Vec::new();
    for focal in guesses {
        // A hypothesis within 25 % of an earlier one converges to the same lens.
        let sensible = (0.3..60.0).contains(&focal);
        if !sensible || tried.iter().any(|before: &f64| (focal / before).ln().abs() < 0.22) {
            continue;
        }
        tried.push(focal);
        if let Some((misfit_px, lens)) = attempt(&few, centre, focal * half_diagonal) {
            if best.as_ref().is_none_or(|(least, _)| misfit_px < *least) {
                best = Some((misfit_px, lens));
            }
            // This is the usual accuracy of corners in real images (0.6 px in 640x480). Further
            // hypotheses would not improve the initial camera by a relevant amount.
            if misfit_px < 0.0015 * half_diagonal {
                break;
            }
        }
    }
    let (_, lens) = best?;
    let poses = views.iter().map(|sights| pose(&lens, sights)).collect();
    Some((lens, poses))
}

/// Views for the comparison of focal lengths: half with the strongest perspective, half spread over
/// the remaining views.
fn telling_views(homographies: &[Option<nalgebra::Matrix3<f64>>]) -> Vec<usize> {
    let perspective = |view: usize| {
        homographies[view].map_or(0.0, |h| {
            let scale = h.column(0).norm() + h.column(1).norm();
            (h[(2, 0)].hypot(h[(2, 1)])) / scale.max(1e-300)
        })
    };
    let usable: Vec<usize> = (0..homographies.len()).filter(|&view| homographies[view].is_some()).collect();
    let mut few = usable.clone();
    few.sort_by(|&a, &b| perspective(b).total_cmp(&perspective(a)));
    few.truncate(VIEWS / 2);
    let rest: Vec<usize> = usable.into_iter().filter(|view| !few.contains(view)).collect();
    let wanted = (VIEWS - few.len()).min(rest.len());
    few.extend((0..wanted).map(|i| rest[i * rest.len() / wanted]));
    few.sort_unstable();
    few
}

/// A subset of about `most` points, evenly spaced in their order.
fn thin(sights: &[BoardCorrespondence], most: usize) -> Vec<BoardCorrespondence> {
    let kept = sights.len().min(most);
    (0..kept).map(|i| sights[i * sights.len() / kept]).collect()
}

/// The pose of a board from the homography of its ray directions.
pub fn pose(lens: &Lens, sights: &[BoardCorrespondence]) -> Option<Isometry3<f64>> {
    let pairs: Vec<((f64, f64), Vector3<f64>)> = sights
        .iter()
        .filter_map(|sight| Some((sight.on_board, lens.direction(sight.pixel, WIDEST_RAD)?)))
        .collect();
    zhang::pose_from_homography(&zhang::homography(&pairs)?)
}

/// A short bundle adjustment from one hypothesis of the focal length. Returns the misfit (mean of
/// the smallest 80 % of the residuals, pixels) and the lens.
fn attempt(few: &[&[BoardCorrespondence]], centre: (f64, f64), focal_px: f64) -> Option<(f64, Lens)> {
    let lens = Lens::new(LensModel::KannalaBrandt4, focal_px, centre);
    let posed: Vec<(&[BoardCorrespondence], Isometry3<f64>)> =
        few.iter().filter_map(|sights| Some((*sights, pose(&lens, sights)?))).collect();
    if posed.len() < 3 || 2 * posed.len() < few.len() {
        return None;
    }
    let views: Vec<&[BoardCorrespondence]> = posed.iter().map(|(sights, _)| *sights).collect();
    let poses = posed.into_iter().map(|(_, pose)| pose).collect();
    let mut state = BundleState { lens, shape: [0.0; 5], poses };
    let model = LensModel::KannalaBrandt4;
    let spread_px = centre.0.hypot(centre.1);
    let priors = vec![(2, centre.0, 0.2 * spread_px), (3, centre.1, 0.2 * spread_px)];
    let unknowns = |centred, coefficients| BundleUnknowns {
        lens: free_numbers(model, true, centred, coefficients),
        shape: false,
        poses: true,
        priors: priors.clone(),
    };
    // Far from the minimum, a wide scale of the robust loss keeps all points as inliers.
    let wide = 0.02 * spread_px;
    Bundle { views: &views, unknowns: &BundleUnknowns::poses_only(), noise_px: wide }.minimise(&mut state, 4);
    Bundle { views: &views, unknowns: &unknowns(true, 1), noise_px: wide }.minimise(&mut state, 10);
    adjust(&views, &mut state, &unknowns(false, 2), 8);
    Some((misfit_px(&views, &state), state.lens))
}

/// Mean of the smallest 80 % of the residuals, pixels; robust against a few outlier views.
fn misfit_px(views: &[&[BoardCorrespondence]], state: &BundleState) -> f64 {
    let mut distances: Vec<f64> = Vec::new();
    for (sights, pose) in views.iter().zip(&state.poses) {
        let off = residuals(&state.lens, &state.shape, pose, sights);
        distances.extend(off.map(|off| off.map_or(1e4, |(dx, dy)| dx.hypot(dy))));
    }
    distances.sort_by(f64::total_cmp);
    let kept = (distances.len() * 4).div_ceil(5).max(1);
    distances.iter().take(kept).sum::<f64>() / kept as f64
}

/// Converts a Kannala–Brandt lens to another lens model: the lens parameters are fitted with the
/// poses fixed.
pub fn translated(
    views: &[&[BoardCorrespondence]],
    lens: &Lens,
    poses: &[Isometry3<f64>],
    model: LensModel,
    square: bool,
    centred: Option<(f64, f64)>,
) -> Lens {
    let [fx, fy, cx, cy, k1, k2, k3, k4, ..] = lens.numbers;
    let mut start = Lens::new(model, fx, centred.unwrap_or((cx, cy)));
    start.numbers[1] = if square { fx } else { fy };
    match model {
        LensModel::KannalaBrandt4 => start.numbers[4..8].copy_from_slice(&[k1, k2, k3, k4]),
        // For small angles sin θ / (α + (1 − α) cos θ) = θ (1 + (1/3 − α / 2) θ² + …).
        LensModel::DoubleSphere => start.numbers[5] = (2.0 / 3.0 - 2.0 * k1).clamp(0.02, 0.95),
        _ => {}
    }
    let few: Vec<Vec<BoardCorrespondence>> = views.iter().map(|sights| thin(sights, POINTS)).collect();
    let few: Vec<&[BoardCorrespondence]> = few.iter().map(Vec::as_slice).collect();
    let mut state = BundleState { lens: start, shape: [0.0; 5], poses: poses.to_vec() };
    for coefficients in [2.min(model.coefficients()), model.coefficients()] {
        let unknowns = BundleUnknowns {
            lens: free_numbers(model, square, true, coefficients)
                .into_iter()
                .filter(|free| free.at > 1)
                .collect(),
            shape: false,
            poses: false,
            priors: coefficient_priors(model),
        };
        if unknowns.shared() > 0 {
            adjust(&few, &mut state, &unknowns, 6);
        }
    }
    state.lens
}

/// Priors on distortion coefficients, as index, mean and standard deviation, for models with a
/// parameter ambiguity. In the rational model the denominator can cancel the numerator, so many
/// coefficient sets describe the same lens.
pub fn coefficient_priors(model: LensModel) -> Vec<(usize, f64, f64)> {
    match model {
        LensModel::BrownConrady8 => {
            (4..12).filter(|&at| at != 6 && at != 7).map(|at| (at, 0.0, 10.0)).collect()
        }
        // For lenses far from a fisheye, f and ξ are nearly interchangeable.
        LensModel::DoubleSphere => vec![(4, 0.0, 0.5)],
        _ => Vec::new(),
    }
}
