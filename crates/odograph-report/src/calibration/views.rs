//! Drawings of the detected points and their residuals.

use super::drawing::{ImageFrame, PageDrawing};
use super::lens::pixels_text;
use super::thumbnail::Thumbnail;
use odograph::drawing::scale::{label, multiples, round_step};
use odograph::drawing::svg::{coordinate, escape, fitted};
use odograph::geometry::Pixel;
use odograph_calibration::selection::ViewCoverage;
use std::fmt::Write;

/// A detected point and its reprojection error (detected minus projected), pixels.
#[derive(Debug, Clone, Copy)]
pub struct ReprojectionError {
    /// Where it was detected.
    pub seen: Pixel,
    /// The error along x, pixels.
    pub dx_px: f64,
    /// The error along y, pixels.
    pub dy_px: f64,
}

/// A view as displayed in the drawings.
pub struct ShownView<'a> {
    /// Name of its frame or file.
    pub name: String,
    /// Its image, small.
    pub thumbnail: Option<&'a Thumbnail>,
    /// Of each point of the board in it.
    pub residuals: Vec<ReprojectionError>,
    /// Root mean square of them, pixels.
    pub rms_px: f64,
    /// The reason why it was not used; `None` if it was used.
    pub why_not: Option<String>,
}

/// Maximum number of arrows or dots. More are thinned evenly: no difference is visible, and the
/// page stays small.
const MAX_MARKS: usize = 5000;

fn marks<'a>(views: &'a [ShownView<'_>], used: bool) -> impl Iterator<Item = &'a ReprojectionError> + Clone {
    let of = move || {
        views.iter().filter(move |view| view.why_not.is_none() == used).flat_map(|view| &view.residuals)
    };
    let every = of().count().div_ceil(MAX_MARKS).max(1);
    of().step_by(every)
}

/// All detected corners over the cells of the image, whose colour is the stronger, the more of them
/// they have seen.
pub fn coverage(size: (usize, usize), views: &[ShownView<'_>], coverage: &ViewCoverage) -> PageDrawing {
    let frame = ImageFrame::new(size);
    let (left, right, top, bottom) = frame.sides();
    let (width, height) =
        ((right - left) / ViewCoverage::COLUMNS as f64, (bottom - top) / ViewCoverage::ROWS as f64);
    let most = coverage.points.iter().copied().max().unwrap_or(0);
    let mut content = String::new();
    for (cell, &points) in coverage.points.iter().enumerate() {
        let (column, row) = (cell % ViewCoverage::COLUMNS, cell / ViewCoverage::COLUMNS);
        let _ = writeln!(
            content,
            "<rect class=\"{}\" fill-opacity=\"{}\" x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\"/>",
            if points > 0 { "cell" } else { "empty" },
            coordinate(if points > 0 { shade(points, most) } else { 1.0 }),
            coordinate(left + column as f64 * width),
            coordinate(top + row as f64 * height),
            coordinate(width),
            coordinate(height)
        );
    }
    for (class, used) in [("dots", true), ("dots out", false)] {
        let mut d = String::new();
        for mark in marks(views, used) {
            let (x, y) = frame.at(mark.seen);
            let _ = write!(d, "M{} {}h0", coordinate(x), coordinate(y));
        }
        let _ = writeln!(content, "<path class=\"{class}\" stroke-width=\"4.5\" d=\"{d}\"/>");
    }
    frame.drawing(&content, 0.0)
}

/// Opacity of a cell by its number of points; `most` is that of the fullest cell. Logarithmic: the
/// difference between none and a few counts, not that between hundreds and thousands.
fn shade(points: usize, most: usize) -> f64 {
    0.15 + 0.5 * (points as f64).ln_1p() / (most as f64).ln_1p()
}

/// The residuals of all used corners as enlarged arrows from the projected to the detected
/// position, and the mean residual of each grid cell, which is small if the lens model fits. The
/// numbers returned are the magnifications.
pub fn residuals(size: (usize, usize), views: &[ShownView<'_>]) -> (PageDrawing, f64, f64) {
    let frame = ImageFrame::new(size);
    let lengths = |of: &[(f64, f64)]| {
        let mut lengths: Vec<f64> =
            of.iter().map(|(dx, dy)| dx.hypot(*dy)).filter(|l| l.is_finite()).collect();
        lengths.sort_by(f64::total_cmp);
        lengths
    };
    let each: Vec<(f64, f64)> = marks(views, true).map(|mark| (mark.dx_px, mark.dy_px)).collect();
    let each = lengths(&each);
    // 90th percentile of the arrow lengths, drawing units.
    const LONG: f64 = 22.0;
    let longer = |length_px: Option<&f64>| {
        let times = LONG / (length_px.copied().unwrap_or(1.0).max(1e-4) * frame.scale());
        // Round down to 1, 2 or 5 times a power of ten.
        let decade = 10f64.powf(times.log10().floor());
        [5.0, 2.0, 1.0]
            .map(|digit| digit * decade)
            .into_iter()
            .find(|&round| round <= times)
            .unwrap_or(decade)
    };
    let times = longer(each.get(each.len() * 9 / 10));
    let means = means(size, views);
    let mean_lengths = lengths(&means.iter().map(|(_, dx, dy)| (*dx, *dy)).collect::<Vec<_>>());
    let mean_times = longer(mean_lengths.get(mean_lengths.len() * 9 / 10));
    let mut content = String::new();
    let mut d = String::new();
    for mark in marks(views, true) {
        let (x, y) = frame.at(mark.seen);
        let reach = times * frame.scale();
        // Outliers would cross the whole image.
        let (dx, dy) = limited(mark.dx_px * reach, mark.dy_px * reach, 4.0 * LONG);
        let _ = write!(d, "M{} {}l{} {}", coordinate(x), coordinate(y), coordinate(dx), coordinate(dy));
    }
    let _ = writeln!(content, "<path class=\"arrows\" d=\"{d}\"/>");
    let (mut d, mut dots) = (String::new(), String::new());
    for (middle, dx_px, dy_px) in &means {
        let (x, y) = frame.at(*middle);
        let reach = mean_times * frame.scale();
        let (dx, dy) = limited(dx_px * reach, dy_px * reach, 2.0 * LONG);
        let _ = write!(d, "M{} {}l{} {}", coordinate(x), coordinate(y), coordinate(dx), coordinate(dy));
        let _ = write!(
            dots,
            "<circle class=\"tips\" cx=\"{}\" cy=\"{}\" r=\"2.6\"/>",
            coordinate(x),
            coordinate(y)
        );
    }
    let _ = writeln!(content, "<path class=\"means\" d=\"{d}\"/>{dots}");
    (frame.drawing(&content, 0.0), times, mean_times)
}

fn limited(dx: f64, dy: f64, longest: f64) -> (f64, f64) {
    let length = dx.hypot(dy);
    let by = if length > longest { longest / length } else { 1.0 };
    (dx * by, dy * by)
}

/// The mean residual per grid cell with enough used points: their mean position, dx and dy.
fn means(size: (usize, usize), views: &[ShownView<'_>]) -> Vec<(Pixel, f64, f64)> {
    const COLUMNS: usize = 12;
    /// Minimum number of points for a meaningful mean.
    const LEAST: usize = 8;
    let rows = (COLUMNS * size.1 / size.0.max(1)).clamp(1, 2 * COLUMNS);
    let mut sums = vec![(0usize, 0.0, 0.0, 0.0, 0.0); COLUMNS * rows];
    let used = views.iter().filter(|view| view.why_not.is_none()).flat_map(|view| &view.residuals);
    for mark in used {
        let cell = |at: f64, length: usize, cells: usize| {
            (((at + 0.5) / length as f64 * cells as f64).max(0.0) as usize).min(cells - 1)
        };
        let sum = &mut sums[cell(mark.seen.y, size.1, rows) * COLUMNS + cell(mark.seen.x, size.0, COLUMNS)];
        *sum = (sum.0 + 1, sum.1 + mark.seen.x, sum.2 + mark.seen.y, sum.3 + mark.dx_px, sum.4 + mark.dy_px);
    }
    sums.into_iter()
        .filter(|sum| sum.0 >= LEAST)
        .map(|(count, x, y, dx, dy)| {
            let n = count as f64;
            (Pixel::new(x / n, y / n), dx / n, dy / n)
        })
        .collect()
}

/// Size of text on a narrow page, drawing units.
const LARGEST_TEXT: f64 = 22.0;

/// The error of each view as a bar with its name; views that were not used are labelled.
pub fn errors(views: &[ShownView<'_>], rms_px: f64) -> PageDrawing {
    const WIDTH: f64 = 720.0;
    const NAMES: f64 = 280.0;
    const RIGHT: f64 = WIDTH - 66.0;
    const ROW: f64 = 22.0;
    let mut used: Vec<f64> = views.iter().filter(|v| v.why_not.is_none()).map(|v| v.rms_px).collect();
    used.sort_by(f64::total_cmp);
    // Unused views may have large errors; the bars of the used ones must stay readable.
    let high = used.last().copied().unwrap_or(1.0).max(rms_px).max(1e-3)
        * if used.len() < views.len() { 1.6 } else { 1.08 };
    let x = |error_px: f64| NAMES + (RIGHT - NAMES) * (error_px / high).clamp(0.0, 1.0);
    let bottom = 8.0 + ROW * views.len() as f64;
    let mut content = String::new();
    let step = round_step(high, 6.0);
    for value in multiples(0.0, high, step) {
        let _ = writeln!(
            content,
            "<line class=\"grid\" x1=\"{0}\" x2=\"{0}\" y1=\"4\" y2=\"{1}\"/><text text-anchor=\"middle\" x=\"{0}\" y=\"{2}\">{3}</text>",
            coordinate(x(value)),
            coordinate(bottom),
            coordinate(bottom + 18.0),
            label(value, step)
        );
    }
    for (row, view) in views.iter().enumerate() {
        let y = 6.0 + ROW * row as f64;
        let end = x(view.rms_px);
        let out = if view.why_not.is_some() { " out" } else { "" };
        let beyond = if view.rms_px > high { "→ " } else { "" };
        let _ = writeln!(
            content,
            "<text text-anchor=\"end\" x=\"{}\" y=\"{2}\">{1}</text><rect class=\"bar{out}\" x=\"{NAMES}\" y=\"{3}\" \
             width=\"{4}\" height=\"{5}\"/><text x=\"{6}\" y=\"{2}\">{beyond}{7}</text>",
            NAMES - 8.0,
            escape(&fitted(&view.name, LARGEST_TEXT, NAMES - 16.0)),
            coordinate(y + 16.0),
            coordinate(y + 3.0),
            coordinate((end - NAMES).max(1.0)),
            ROW - 6.0,
            coordinate(end + 6.0),
            pixels_text(view.rms_px).trim_end_matches(" px"),
        );
    }
    let _ = writeln!(
        content,
        "<line class=\"rule\" x1=\"{0}\" x2=\"{0}\" y1=\"2\" y2=\"{1}\"/><text text-anchor=\"middle\" x=\"{2}\" y=\"{3}\">error (px)</text>",
        coordinate(x(rms_px)),
        coordinate(bottom),
        coordinate(0.5 * (NAMES + RIGHT)),
        coordinate(bottom + 38.0)
    );
    PageDrawing { width: WIDTH, height: bottom + 46.0, body: content }
}
