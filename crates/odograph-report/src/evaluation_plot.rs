//! The paths, superimposed, and the errors over time, as SVG.

use odograph::drawing::scale::{label, multiples, round_step};
use odograph::drawing::svg::escape;
use odograph::evaluation::{Evaluation, PosePair};
use odograph::formats::trajectory_file::Trajectory;
use odograph::numerics::median;
use std::fmt::Write;

const WIDTH: f64 = 960.0;
/// Inner edges of the panels.
const LEFT: f64 = 84.0;
const RIGHT: f64 = WIDTH - 28.0;
const TOP: f64 = 70.0;
const TRUTH: &str = "#444444";
const ESTIMATE: &str = "#d1495b";
const ROTATION: &str = "#2a6f97";

/// A whole SVG document. The path is seen along the axis in which it extends least (from above
/// for a camera over ground), at the same scale both ways; below it the position and the rotation
/// error of each compared pose.
pub fn svg(title: &str, evaluation: &Evaluation, truth: &Trajectory) -> String {
    let view = PlotView::along(evaluation, truth, seen_axes);
    let below = view.bottom + 60.0;
    let height = below + 430.0;
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{height}\" viewBox=\"0 0 {WIDTH} {height}\" \
         font-family=\"sans-serif\" font-size=\"13\" fill=\"#222222\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n\
         <text x=\"{LEFT}\" y=\"30\" font-size=\"17\" font-weight=\"bold\">{}</text>\n",
        escape(title)
    );
    let _ = writeln!(
        out,
        "<text x=\"{LEFT}\" y=\"50\">absolute position error: rmse {:.6} m, largest {:.6} m; path {:.3} m</text>",
        evaluation.absolute.translation.rmse, evaluation.absolute.translation.max, evaluation.truth_length_m
    );
    draw_paths(&mut out, &view, evaluation, "truth");
    let degrees: Vec<f64> = evaluation.absolute.rotation_rad.iter().map(|angle| angle.to_degrees()).collect();
    let position_m = &evaluation.absolute.translation_m;
    draw_errors(
        &mut out,
        (below, below + 160.0),
        "position error (m)",
        ESTIMATE,
        &evaluation.pairs,
        position_m,
    );
    draw_errors(
        &mut out,
        (below + 210.0, below + 370.0),
        "rotation error (°)",
        ROTATION,
        &evaluation.pairs,
        &degrees,
    );
    let _ = writeln!(
        out,
        "<text x=\"{}\" y=\"{}\" text-anchor=\"middle\">time (s){}</text>",
        0.5 * (LEFT + RIGHT),
        height - 14.0,
        since(evaluation)
    );
    out.push_str("</svg>\n");
    out
}

/// The paths, from above, and below them their distance over time: an SVG element that fits into a
/// page.
pub fn in_page(evaluation: &Evaluation, truth: &Trajectory) -> String {
    let view = PlotView::along(evaluation, truth, |_| (0, 1));
    let below = view.bottom + 60.0;
    let (top, height) = (TOP - 10.0, below + 160.0 - TOP + 60.0);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 {top} {WIDTH} {height}\" font-family=\"sans-serif\" font-size=\"13\" fill=\"#222222\">\n\
         <rect y=\"{top}\" width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n"
    );
    draw_paths(&mut out, &view, evaluation, "reference");
    let position_m = &evaluation.absolute.translation_m;
    draw_errors(&mut out, (below, below + 160.0), "distance (m)", ESTIMATE, &evaluation.pairs, position_m);
    let _ = writeln!(
        out,
        "<text x=\"{}\" y=\"{}\" text-anchor=\"middle\">time (s){}</text>",
        0.5 * (LEFT + RIGHT),
        below + 196.0,
        since(evaluation)
    );
    out.push_str("</svg>\n");
    out
}

/// What moment the zero of the time axis is, where it is not that of the times.
fn since(evaluation: &Evaluation) -> String {
    match evaluation.pairs.first().map_or(0.0, |pair| pair.time_s) {
        0.0 => String::new(),
        start_s => format!(", 0 is {start_s:.3} s"),
    }
}

/// A range of values on a line of the drawing.
struct PlotAxis {
    low: f64,
    high: f64,
    from_px: f64,
    to_px: f64,
}

impl PlotAxis {
    fn at(&self, value: f64) -> f64 {
        self.from_px + (value - self.low) / (self.high - self.low) * (self.to_px - self.from_px)
    }

    /// The step of round numbers that cuts the range into about `count` parts.
    fn step(&self, count: f64) -> f64 {
        round_step(0.75 * (self.high - self.low), count)
    }

    /// Positions and labels of the multiples of a step within the range.
    fn ticks(&self, step: f64) -> Vec<(f64, String)> {
        let values = multiples(self.low, self.high, step).into_iter();
        values.map(|value| (self.at(value), label(value, step))).collect()
    }
}

/// The paths and how they are seen: along the axis of least extent, at one scale for both axes.
struct PlotView {
    truth: Vec<[f64; 3]>,
    estimate: Vec<[f64; 3]>,
    across: usize,
    up: usize,
    x: PlotAxis,
    y: PlotAxis,
    bottom: f64,
}

impl PlotView {
    /// Seen so that `axes` of the paths' extents go across and up.
    fn along(
        evaluation: &Evaluation,
        truth: &Trajectory,
        axes: impl FnOnce([f64; 3]) -> (usize, usize),
    ) -> Self {
        let position = |pose: &nalgebra::Isometry3<f64>| <[f64; 3]>::from(pose.translation.vector);
        let truth: Vec<_> = truth.poses.iter().map(|pose| position(&pose.world_from_camera)).collect();
        let estimate: Vec<_> = evaluation.pairs.iter().map(|pair| position(&pair.estimate)).collect();
        let (low, high) = bounds(truth.iter().chain(&estimate));
        let (across, up) = axes([0, 1, 2].map(|i| high[i] - low[i]));
        // A margin of 5 %, and at least a millimetre to look at.
        let wide_m = (high[across] - low[across]).max(1e-3) * 1.1;
        let tall_m = (high[up] - low[up]) * 1.1;
        let wide = RIGHT - LEFT;
        let tall = (wide * tall_m / wide_m).clamp(220.0, 640.0);
        let metres_per_px = (wide_m / wide).max(tall_m / tall);
        let axis = |i: usize, from_px: f64, to_px: f64| {
            let centre = 0.5 * (low[i] + high[i]);
            let reach = 0.5 * metres_per_px * (to_px - from_px).abs();
            PlotAxis { low: centre - reach, high: centre + reach, from_px, to_px }
        };
        let bottom = TOP + tall;
        let (x, y) = (axis(across, LEFT, RIGHT), axis(up, bottom, TOP));
        Self { truth, estimate, across, up, x, y, bottom }
    }
}

fn draw_paths(out: &mut String, view: &PlotView, evaluation: &Evaluation, truth_name: &str) {
    let PlotView { truth: true_path, estimate: estimated, across, up, x, y, bottom } = view;
    let (across, up, bottom) = (*across, *up, *bottom);
    let names = ["x", "y", "z"];
    let step = x.step(8.0);
    frame(out, x, y, (step, step.min(y.step(3.0))), &format!("{} (m)", names[up]));
    let _ = writeln!(
        out,
        "<text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{} (m)</text>",
        0.5 * (LEFT + RIGHT),
        bottom + 36.0,
        names[across]
    );
    let on_paper = |p: &[f64; 3]| (x.at(p[across]), y.at(p[up]));
    let drawn: Vec<_> = thinned(true_path).map(on_paper).collect();
    polyline(out, TRUTH, 3.0, "stroke-dasharray=\"7 4\"", &drawn);
    // No line is drawn where there was no estimate.
    let mut from = 0;
    for end in gaps(&evaluation.pairs).chain([estimated.len()]) {
        let drawn: Vec<_> = thinned(&estimated[from..end]).map(on_paper).collect();
        polyline(out, ESTIMATE, 1.6, "", &drawn);
        from = end;
    }
    if let (Some(first), Some(last)) = (estimated.first(), estimated.last()) {
        let ((a, b), (c, d)) = (on_paper(first), on_paper(last));
        let _ = writeln!(
            out,
            "<circle cx=\"{a:.2}\" cy=\"{b:.2}\" r=\"6\" fill=\"#ffffff\" stroke=\"{ESTIMATE}\" stroke-width=\"2\"/>\n\
             <rect x=\"{:.2}\" y=\"{:.2}\" width=\"10\" height=\"10\" fill=\"{ESTIMATE}\"/>",
            c - 5.0,
            d - 5.0
        );
    }
    let _ = writeln!(
        out,
        "<g transform=\"translate({} {})\"><rect width=\"376\" height=\"26\" fill=\"#ffffff\" fill-opacity=\"0.85\"/>\
         <path d=\"M8 13h34\" stroke=\"{TRUTH}\" stroke-width=\"3\" stroke-dasharray=\"7 4\"/><text x=\"48\" y=\"18\">{truth_name}</text>\
         <path d=\"M118 13h34\" stroke=\"{ESTIMATE}\" stroke-width=\"1.6\"/><text x=\"158\" y=\"18\">estimate</text>\
         <circle cx=\"234\" cy=\"13\" r=\"6\" fill=\"#ffffff\" stroke=\"{ESTIMATE}\" stroke-width=\"2\"/><text x=\"246\" y=\"18\">start</text>\
         <rect x=\"294\" y=\"8\" width=\"10\" height=\"10\" fill=\"{ESTIMATE}\"/><text x=\"311\" y=\"18\">end</text></g>",
        RIGHT - 378.0,
        TOP + 2.0
    );
}

fn draw_errors(
    out: &mut String,
    (top, bottom): (f64, f64),
    name: &str,
    color: &str,
    pairs: &[PosePair],
    errors: &[f64],
) {
    let start_s = pairs.first().map_or(0.0, |pair| pair.time_s);
    let points: Vec<_> =
        pairs.iter().zip(errors).map(|(pair, &error)| (pair.time_s - start_s, error)).collect();
    let duration_s = points.last().map_or(0.0, |point| point.0);
    let largest = errors.iter().copied().fold(0.0, f64::max);
    let x = PlotAxis { low: 0.0, high: duration_s.max(1e-3), from_px: LEFT, to_px: RIGHT };
    let y = PlotAxis { low: 0.0, high: (largest * 1.08).max(1e-5), from_px: bottom, to_px: top };
    frame(out, &x, &y, (x.step(8.0), y.step(4.0)), name);
    let mut from = 0;
    for end in gaps(pairs).chain([points.len()]) {
        let drawn: Vec<_> = envelope(&points[from..end], points.len())
            .iter()
            .map(|point| (x.at(point.0), y.at(point.1)))
            .collect();
        polyline(out, color, 1.4, "", &drawn);
        from = end;
    }
}

/// Grid, tick labels, border, and the name of the vertical axis.
fn frame(out: &mut String, x: &PlotAxis, y: &PlotAxis, (step_x, step_y): (f64, f64), name: &str) {
    let (top, bottom) = (y.to_px, y.from_px);
    let _ = writeln!(out, "<g stroke=\"#dddddd\" stroke-width=\"1\">");
    let ticks_x = x.ticks(step_x);
    let ticks_y = y.ticks(step_y);
    for (at, _) in &ticks_x {
        let _ = writeln!(out, "<path d=\"M{at:.2} {top}V{bottom}\"/>");
    }
    for (at, _) in &ticks_y {
        let _ = writeln!(out, "<path d=\"M{LEFT} {at:.2}H{RIGHT}\"/>");
    }
    let _ = writeln!(out, "</g>\n<g font-size=\"12\" fill=\"#444444\">");
    let (below, beside) = (bottom + 17.0, LEFT - 6.0);
    for (at, label) in &ticks_x {
        let _ = writeln!(out, "<text x=\"{at:.2}\" y=\"{below}\" text-anchor=\"middle\">{label}</text>");
    }
    for (at, label) in &ticks_y {
        let y = at + 4.0;
        let _ = writeln!(out, "<text x=\"{beside}\" y=\"{y:.2}\" text-anchor=\"end\">{label}</text>");
    }
    let middle = 0.5 * (top + bottom);
    let _ = writeln!(
        out,
        "</g>\n<rect x=\"{LEFT}\" y=\"{top}\" width=\"{}\" height=\"{}\" fill=\"none\" stroke=\"#888888\"/>\n\
         <text x=\"18\" y=\"{middle}\" text-anchor=\"middle\" transform=\"rotate(-90 18 {middle})\">{name}</text>",
        RIGHT - LEFT,
        bottom - top
    );
}

fn polyline(out: &mut String, color: &str, width: f64, style: &str, points: &[(f64, f64)]) {
    if points.len() < 2 {
        return;
    }
    let _ = write!(
        out,
        "<polyline fill=\"none\" stroke=\"{color}\" stroke-width=\"{width}\" stroke-linejoin=\"round\" {style} points=\""
    );
    for (x, y) in points {
        let _ = write!(out, "{x:.2},{y:.2} ");
    }
    out.push_str("\"/>\n");
}

/// Smallest and largest of each coordinate; zeros without points.
fn bounds<'a>(points: impl Iterator<Item = &'a [f64; 3]>) -> ([f64; 3], [f64; 3]) {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    let mut any = false;
    for point in points {
        any = true;
        for i in 0..3 {
            low[i] = low[i].min(point[i]);
            high[i] = high[i].max(point[i]);
        }
    }
    if any { (low, high) } else { ([0.0; 3], [0.0; 3]) }
}

/// The axes across and up the paper: x and y, unless z clearly extends more than one of them.
fn seen_axes(extent: [f64; 3]) -> (usize, usize) {
    let clearly = extent[2] > 2.0 * extent[0].min(extent[1]) && extent[2] > 0.1 * extent[0].max(extent[1]);
    match clearly {
        false => (0, 1),
        true if extent[0] >= extent[1] => (0, 2),
        true => (1, 2),
    }
}

/// Where the estimate pauses: indices of pairs that follow on the one before after more than five
/// times the usual interval.
fn gaps(pairs: &[PosePair]) -> impl Iterator<Item = usize> {
    let mut steps: Vec<f64> = pairs.windows(2).map(|pair| pair[1].time_s - pair[0].time_s).collect();
    let limit_s = median(&mut steps).map_or(f64::INFINITY, |usual_s| 5.0 * usual_s);
    pairs
        .windows(2)
        .enumerate()
        .filter(move |(_, pair)| pair[1].time_s - pair[0].time_s > limit_s)
        .map(|(i, _)| i + 1)
}

/// More points than this cannot be distinguished on paper.
const MAX_POINTS: usize = 4000;

/// Evenly taken points with the first and the last.
fn thinned<T>(points: &[T]) -> impl Iterator<Item = &T> {
    let step = points.len().div_ceil(MAX_POINTS).max(1);
    let last = points.len().saturating_sub(1);
    points.iter().enumerate().filter(move |(i, _)| i % step == 0 || *i == last).map(|(_, point)| point)
}

/// Points of a part of a curve of `all` points, thinned so that no peak is lost: of each bundle the
/// lowest and the highest.
fn envelope(points: &[(f64, f64)], all: usize) -> Vec<(f64, f64)> {
    let step = (2 * all).div_ceil(MAX_POINTS).max(1);
    if step <= 2 {
        return points.to_vec();
    }
    let mut kept = Vec::with_capacity(MAX_POINTS);
    for bundle in points.chunks(step) {
        let value = |a: &&(f64, f64), b: &&(f64, f64)| a.1.total_cmp(&b.1);
        if let (Some(&low), Some(&high)) = (bundle.iter().min_by(value), bundle.iter().max_by(value)) {
            kept.extend(if low.0 <= high.0 { [low, high] } else { [high, low] });
        }
    }
    kept
}
