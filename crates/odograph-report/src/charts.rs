//! The report's section of quantities over time.

use super::figures::{RunFigures, sigmas};
use super::plot::{Range, Series, TimeAxis, plot};
use odograph::geometry::wrap_angle;
use odograph::trajectory::{FrameSummary, PlaceSummary};
use std::fmt::Write;

/// Writes the section, with one plot per quantity.
pub fn over_time(frames: &[FrameSummary], figures: &RunFigures, page: &mut String) {
    let Some(first) = frames.first() else { return };
    let times_s: Vec<f64> = frames.iter().map(|frame| frame.time_s - first.time_s).collect();
    let shaded_s: Vec<(f64, f64)> =
        figures.lost.iter().map(|stretch| (stretch.from_s, stretch.to_s)).collect();
    let axis = TimeAxis::new(&times_s, &shaded_s);
    let posed = |value: &dyn Fn(&PlaceSummary) -> f64| -> Vec<Option<f64>> {
        frames.iter().map(|frame| frame.place.as_ref().map(value)).collect()
    };
    let blue = |values| Series { class: "blue", values };
    let shading = if figures.lost.is_empty() { "" } else { " Shaded: lost." };
    let _ = writeln!(
        page,
        "<h2>Over time</h2>\n<p class=\"quiet\">Every frame of the run.{shading}</p>\n<p class=\"readout\" data-hint=\"\"></p>\n<div class=\"plots\">"
    );
    let mut figure = |name: &str, says: &str, series: &[Series<'_>], range: Range| {
        let _ = writeln!(
            page,
            "<figure><figcaption><b>{name}</b><span>{says}</span></figcaption>\n{}</figure>",
            plot(name, &axis, series, range)
        );
    };
    figure(
        "Speed (m/s)",
        "How fast the camera moved over the ground.",
        &[blue(posed(&|at| at.speed_m_s))],
        Range::FromZero,
    );
    figure(
        "Heading (°)",
        "Where the top of the image points; counter-clockwise is up.",
        &[blue(continuous_headings(frames))],
        Range::Around(2.0),
    );
    let heights = posed(&|at| at.height_m);
    let known = || heights.iter().copied().flatten();
    if known().fold(f64::NEG_INFINITY, f64::max) - known().fold(f64::INFINITY, f64::min) > 1e-6 {
        figure("Height (m)", "Height of the camera above the ground.", &[blue(heights)], Range::Around(0.01));
    }
    figure(
        "Corners",
        "<span class=\"key blue\">found again</span><span class=\"key orange\">inliers</span><br>More \
         inliers determine the motion better.",
        &[
            blue(frames.iter().map(|f| Some(f.tracks as f64)).collect()),
            Series { class: "orange", values: frames.iter().map(|f| Some(f.inliers as f64)).collect() },
        ],
        Range::FromZero,
    );
    figure(
        "Residual (px)",
        "Root mean square re-projection error of the inliers.",
        &[blue(
            frames.iter().map(|f| (f.place.is_some() && f.inliers > 0).then_some(f.residual_px)).collect(),
        )],
        Range::FromZero,
    );
    let worst_m = frames.iter().filter_map(|f| f.place.as_ref()).map(|at| sigmas(at).0).fold(0.0, f64::max);
    let (unit, size_m) = if worst_m < 0.1 { ("mm", 0.001) } else { ("m", 1.0) };
    figure(
        &format!("Uncertainty of the position ({unit})"),
        "One standard deviation in the least certain direction, as stated by the program.",
        &[blue(posed(&|at| sigmas(at).0 / size_m))],
        Range::FromZero,
    );
    figure(
        "Uncertainty of the heading (°)",
        "One standard deviation, as stated by the program.",
        &[blue(posed(&|at| sigmas(at).1.to_degrees()))],
        Range::FromZero,
    );
    page.push_str("</div>\n");
}

/// The heading of each frame with a pose, degrees, unwrapped.
fn continuous_headings(frames: &[FrameSummary]) -> Vec<Option<f64>> {
    let mut before: Option<f64> = None;
    let mut next = |heading_rad: f64| {
        let continued = before.map_or(heading_rad, |last| last + wrap_angle(heading_rad - last));
        before = continued.is_finite().then_some(continued).or(before);
        continued.to_degrees()
    };
    frames.iter().map(|frame| frame.place.map(|at| next(at.heading_rad))).collect()
}
