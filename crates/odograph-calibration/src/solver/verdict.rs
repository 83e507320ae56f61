//! Overall verdict on a calibration, with reasons and advice for users.

use super::bundle::BoardCorrespondence;
use super::result::{Calibration, Verdict};
use odograph::geometry::Pixel;

/// Inputs of the verdict in addition to the calibration.
pub struct Evidence<'a> {
    /// The points of the used views.
    pub views: &'a [&'a [BoardCorrespondence]],
    /// Number of distinct views.
    pub distinct: usize,
}

/// Thresholds that a handheld board can meet. Values in pixels are for an image diagonal of 800
/// pixels and scale with it; focal length thresholds are relative standard deviations.
const GOOD_ERROR_PX: f64 = 0.3;
const USABLE_ERROR_PX: f64 = 1.5;
const GOOD_RMS_PX: f64 = 0.7;
const USABLE_RMS_PX: f64 = 2.0;
const GOOD_FOCAL: f64 = 0.002;
const USABLE_FOCAL: f64 = 0.01;
/// Minimum tilt of a view for it to constrain the focal length, radians.
const TILTED_RAD: f64 = 0.3;

/// The verdict and its reasons, the most severe first.
pub fn judge(calibration: &Calibration, evidence: &Evidence<'_>) -> (Verdict, Vec<String>) {
    let mut all: Vec<(Verdict, String)> = Vec::new();
    let (width, height) = (calibration.camera.width() as f64, calibration.camera.height() as f64);
    let unit_px = width.hypot(height) / 800.0;
    few_views(calibration, evidence, &mut all);

    let rms = grade(calibration.rms_px, GOOD_RMS_PX * unit_px, USABLE_RMS_PX * unit_px);
    if rms > Verdict::Good {
        let what = format!(
            "points are {:.2} px off their places: check that the board's count and kind are right and that it is flat, and hold it \
             still or give more light",
            calibration.rms_px
        );
        all.push((rms, what));
    }
    tilt_and_focal(calibration, &mut all);
    let over_px = calibration.expected_error_over_image_px();
    let error = grade(over_px, GOOD_ERROR_PX * unit_px, USABLE_ERROR_PX * unit_px);
    let before = all.iter().filter(|(verdict, _)| *verdict > Verdict::Good).count();
    uncovered(calibration, evidence, unit_px, &mut all);
    let advised = all.iter().filter(|(verdict, _)| *verdict > Verdict::Good).count() > before;
    if error > Verdict::Good {
        let advice = if advised { "" } else { ": take more views, tilted, near and all over the image" };
        all.push((error, format!("the expected error of a ray is {over_px:.2} px over the image{advice}")));
    }
    let held_px = calibration.hold_out_rms_px;
    if held_px.is_finite() && held_px > 1.5 * calibration.rms_px && held_px > 0.3 * unit_px {
        let what = format!(
            "held-out views are predicted with {held_px:.2} px, fitted ones with {:.2} px: take more views",
            calibration.rms_px
        );
        all.push((Verdict::Usable, what));
    }
    if let Some(bend) = calibration.bend {
        let what = format!(
            "the board seems to be bent by {:.1} mm or misprinted ({:.0} % less noise if that is allowed): fix it to something flat, or \
             take the calibration with the bend estimated",
            bend.depth_m * 1e3,
            bend.gain * 100.0
        );
        all.push((Verdict::Good, what));
    }
    all.sort_by_key(|(verdict, _)| std::cmp::Reverse(*verdict));
    let worst = all.first().map_or(Verdict::Good, |(verdict, _)| *verdict);
    (worst, all.into_iter().map(|(_, why)| why).collect())
}

fn grade(value: f64, good: f64, usable: f64) -> Verdict {
    match value {
        value if value <= good => Verdict::Good,
        value if value <= usable => Verdict::Usable,
        _ => Verdict::DoItAgain,
    }
}

fn few_views(calibration: &Calibration, evidence: &Evidence<'_>, all: &mut Vec<(Verdict, String)>) {
    let used = calibration.views_used();
    let given = calibration.views.len();
    if used < 5 {
        all.push((Verdict::DoItAgain, format!("only {used} views: take at least ten with different tilts")));
    } else if used < 10 {
        all.push((Verdict::Usable, format!("only {used} views: take ten or more with different tilts")));
    } else if evidence.distinct < 5 {
        let what = format!(
            "only {} of {used} views differ: move and tilt the board between them",
            evidence.distinct
        );
        all.push((Verdict::DoItAgain, what));
    }
    // Single outliers occur by chance; a quarter of all views does not.
    if 4 * (given - used) > given {
        let what = format!(
            "{} of {given} views do not fit: check that the board's count is right, that it is flat and that it is held still",
            given - used
        );
        all.push((Verdict::Usable, what));
    }
}

fn tilt_and_focal(calibration: &Calibration, all: &mut Vec<(Verdict, String)>) {
    let focal = focal_uncertainty(calibration);
    let tilted = calibration.views.iter().filter(|view| view.used && view.tilt_rad() > TILTED_RAD).count();
    let verdict = grade(focal, GOOD_FOCAL, USABLE_FOCAL);
    if verdict == Verdict::Good {
        return;
    }
    let uncertain = format!("the focal length is uncertain by {:.1} %", focal * 100.0);
    let what = if tilted < 4 {
        format!("too little tilt, {uncertain}: tilt the board by 30° or more in some views, to all sides")
    } else {
        format!("{uncertain}: take more views, near and tilted to all sides")
    };
    all.push((verdict, what));
}

/// Relative standard deviation of the focal length on the optical axis. For the double sphere model
/// that focal length is `f / (1 + ξ)`, and the correlation of f and ξ is taken into account.
fn focal_uncertainty(calibration: &Calibration) -> f64 {
    let parameters = &calibration.parameters;
    let xi = parameters.iter().position(|parameter| parameter.name == "xi");
    let share = |at: usize| {
        let by_focal = 1.0 / parameters[at].value;
        let variance = |i: usize, j: usize| calibration.covariance[(i, j)];
        let mut square = by_focal * by_focal * variance(at, at);
        if let Some(xi) = xi {
            let by_xi = -1.0 / (1.0 + parameters[xi].value);
            square += 2.0 * by_focal * by_xi * variance(at, xi) + by_xi * by_xi * variance(xi, xi);
        }
        square.max(0.0).sqrt()
    };
    let focal = |at: &usize| parameters[*at].name.starts_with('f');
    (0..parameters.len()).filter(focal).map(share).fold(0.0, f64::max)
}

/// Warns about image corners without points or with a large expected ray error.
fn uncovered(
    calibration: &Calibration,
    evidence: &Evidence<'_>,
    unit_px: f64,
    all: &mut Vec<(Verdict, String)>,
) {
    let camera = &calibration.camera;
    let (right, bottom) = (camera.width() as f64 - 1.0, camera.height() as f64 - 1.0);
    let corners = [
        ("top-left", 0.0, 0.0),
        ("top-right", right, 0.0),
        ("bottom-left", 0.0, bottom),
        ("bottom-right", right, bottom),
    ];
    let (mut names, mut guessed, mut worst_px) = (Vec::new(), Vec::new(), 0.0f64);
    for (name, x, y) in corners {
        // A corner region extends over a fifth of the image in each direction.
        let near = |sight: &BoardCorrespondence| {
            (sight.pixel.0 - x).abs() < 0.2 * right && (sight.pixel.1 - y).abs() < 0.2 * bottom
        };
        let covered = evidence.views.iter().copied().flatten().any(near);
        let error_px = calibration.expected_error_px(Pixel::new(x, y)).unwrap_or(0.0);
        if error_px > 2.0 * GOOD_ERROR_PX * unit_px {
            worst_px = worst_px.max(error_px);
            if !covered {
                names.push(name);
            }
        } else if !covered {
            guessed.push(name);
        }
    }
    if !guessed.is_empty() {
        let corners = if guessed.len() == 1 { "corner was" } else { "corners were" };
        let what = format!(
            "the {} {corners} never covered; rays there rely on the lens model alone",
            guessed.join(" and ")
        );
        all.push((Verdict::Good, what));
    }
    if worst_px == 0.0 {
        return;
    }
    let there = if names.is_empty() { "" } else { "there " };
    let error = format!("rays {there}may be {worst_px:.1} px off");
    let what = match names.as_slice() {
        [] => format!(
            "{error}, in the corners of the image: bring the board closer to them, or take a lens model with fewer coefficients"
        ),
        [one] => format!("the {one} corner of the image was never covered, {error}: hold the board there"),
        many => format!(
            "the {} corners of the image were never covered, {error}: hold the board there",
            many.join(" and ")
        ),
    };
    let verdict =
        if worst_px > 4.0 * USABLE_ERROR_PX * unit_px { Verdict::DoItAgain } else { Verdict::Usable };
    all.push((verdict, what));
}
