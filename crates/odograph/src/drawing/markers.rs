//! Markers along the path: heading ticks, uncertainty, start and end, and the legend.

use super::path::MeasuredPath;
use super::reckoned;
use super::scale::{duration_text, length_text, round_step};
use super::svg::{coordinate as c, text_width};
use super::window::{DrawingWindow, RIGHT_MARGIN};
use super::{BACKGROUND, DrawnLandmark, INK, MUTED, TIME_COLOURS, hex, time_colour};
use crate::geometry::{GroundPoint, wrap_angle};
use crate::trajectory::PlaceSummary;
use std::collections::BTreeSet;
use std::fmt::Write;

const START: &str = "#0f9d58";
const ELLIPSE: &str = "#0e7490";
const LOST: &str = "#c2410c";
const LOOP: &str = "#7c3aed";
const LANDMARK: &str = "#1d4ed8";
/// Radius of the ring around a recognised place, drawing units.
const RING: f64 = 5.0;
/// The dart that points along a heading, drawing units: distances of its tip and its tail from the
/// position, and half its width.
const DART: (f64, f64, f64) = (10.0, 5.0, 4.8);
/// Smallest half axis of a drawn covariance ellipse, drawing units: smaller ones are hidden by the
/// line of the path.
const SEEN: f64 = 8.0;

/// Which kinds of marks the drawing has; the legend explains those.
#[derive(Debug, Default)]
pub(super) struct Shown {
    pub gaps: bool,
    pub reckoned: bool,
    /// Distance along the path between heading ticks, metres.
    pub headings: Option<f64>,
    pub ellipses: bool,
    pub loops: bool,
    pub landmarks: bool,
}

/// A ring at every loop closure, and a line to the place from where its ground was seen before.
pub(super) fn loops(
    loops: &[[GroundPoint; 2]],
    window: &DrawingWindow,
    shown: &mut Shown,
    body: &mut String,
) {
    let mut taken = BTreeSet::new();
    let mut drawn = String::new();
    for [now, before] in loops {
        let ends = [now, before].map(|place| window.page(place.x_m, place.y_m));
        if !ends.iter().all(|(x, y)| x.is_finite() && y.is_finite()) {
            continue;
        }
        let [(x, y), (from_x, from_y)] = ends;
        // Overlapping lanes close loops everywhere; rings on top of each other add nothing.
        if taken.insert(((x / 14.0).round() as i64, (y / 14.0).round() as i64)) {
            let _ = write!(
                drawn,
                "<path d=\"M{} {}L{} {}\"/><circle cx=\"{0}\" cy=\"{1}\" r=\"{RING}\"/>",
                c(x),
                c(y),
                c(from_x),
                c(from_y)
            );
        }
    }
    if !drawn.is_empty() {
        shown.loops = true;
        let _ = writeln!(
            body,
            "<g class=\"loop\" fill=\"none\" stroke=\"{LOOP}\" stroke-width=\"1.6\">{drawn}</g>"
        );
    }
}

/// An upright cross at every marker, with its number; in the colour of a loss where it is doubtful.
pub(super) fn landmarks(
    landmarks: &[DrawnLandmark],
    window: &DrawingWindow,
    shown: &mut Shown,
    body: &mut String,
) {
    let mut numbered = BTreeSet::new();
    for landmark in landmarks {
        let (x, y) = window.page(landmark.at.x_m, landmark.at.y_m);
        if !(x.is_finite() && y.is_finite()) {
            continue;
        }
        shown.landmarks = true;
        let colour = if landmark.doubtful { LOST } else { LANDMARK };
        let _ = write!(body, "{}", upright_cross(x, y, colour));
        // Numbers on top of each other cannot be read.
        if numbered.insert(((x / 26.0).round() as i64, (y / 18.0).round() as i64)) {
            let _ = writeln!(
                body,
                "<text class=\"landmark label\" fill=\"{colour}\" stroke=\"{BACKGROUND}\" stroke-width=\"3\" \
                 stroke-linejoin=\"round\" paint-order=\"stroke\" font-size=\"13\" x=\"{}\" y=\"{}\">{}</text>",
                c(x + 8.0),
                c(y - 7.0),
                landmark.number
            );
        }
    }
}

fn upright_cross(x: f64, y: f64, colour: &str) -> String {
    let d = format!("M{} {}v13M{} {}h13", c(x), c(y - 6.5), c(x - 6.5), c(y));
    format!(
        "<path class=\"casing\" fill=\"none\" stroke=\"{BACKGROUND}\" stroke-width=\"4.5\" d=\"{d}\"/>\
         <path class=\"landmark\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\" d=\"{d}\"/>"
    )
}

/// Darts that point where the top of the image points, at regular distances and wherever the camera
/// has turned by 45°.
pub(super) fn headings(
    path: &MeasuredPath<'_>,
    window: &DrawingWindow,
    shown: &mut Shown,
    body: &mut String,
) {
    let every_m = round_step(70.0 / window.scale, 1.0);
    let mut taken = BTreeSet::new();
    let mut ticks = String::new();
    for segment in &path.segments {
        let Some(first) = segment.first() else { continue };
        let (mut since_m, mut before, mut heading) = (0.0, first.at, first.at.heading_rad);
        for (index, place) in segment.iter().enumerate() {
            let pose = place.at;
            since_m += (pose.x_m - before.x_m).hypot(pose.y_m - before.y_m);
            before = pose;
            if index == 0 || since_m < every_m && wrap_angle(pose.heading_rad - heading).abs() < 0.785 {
                continue;
            }
            since_m = 0.0;
            heading = pose.heading_rad;
            let (x, y) = window.page(pose.x_m, pose.y_m);
            // A camera that goes round and round would otherwise paint the same ticks over each
            // other.
            let octant = (wrap_angle(heading) / 0.4).round() as i64;
            if !taken.insert(((x / 8.0).round() as i64, (y / 8.0).round() as i64, octant)) {
                continue;
            }
            ticks.push_str(&dart(x, y, heading));
        }
    }
    if !ticks.is_empty() {
        shown.headings = Some(every_m);
        let _ = writeln!(
            body,
            "<path class=\"tick casing\" fill=\"{INK}\" stroke=\"{BACKGROUND}\" stroke-width=\"1.2\" stroke-linejoin=\"round\" d=\"{ticks}\"/>"
        );
    }
}

/// The outline of a dart at a position that points along a heading.
fn dart(x: f64, y: f64, heading_rad: f64) -> String {
    let (forward, left) = ((heading_rad.cos(), -heading_rad.sin()), (-heading_rad.sin(), -heading_rad.cos()));
    let at = |ahead: f64, aside: f64| {
        format!("{} {}", c(x + ahead * forward.0 + aside * left.0), c(y + ahead * forward.1 + aside * left.1))
    };
    let (tip, tail, half) = DART;
    format!("M{}L{}L{}L{}Z", at(tip, 0.0), at(-tail, half), at(-0.45 * tail, 0.0), at(-tail, -half))
}

/// Half axes of the 2-sigma ellipse of the position, metres, and the direction of the longer one,
/// radians; `None` for an invalid covariance.
fn two_sigma(at: &PlaceSummary) -> Option<(f64, f64, f64)> {
    let [xx, xy, yy] = at.position_covariance;
    let (middle, half) = (0.5 * (xx + yy), (0.5 * (xx - yy)).hypot(xy));
    let (long, short) = (middle + half, (middle - half).max(0.0));
    (long.is_finite() && long > 0.0)
        .then(|| (2.0 * long.sqrt(), 2.0 * short.sqrt(), 0.5 * (2.0 * xy).atan2(xx - yy)))
}

/// The 2-sigma ellipses of the position that are large enough to be seen and do not overlap; always
/// that of the end.
pub(super) fn ellipses(
    path: &MeasuredPath<'_>,
    window: &DrawingWindow,
    shown: &mut Shown,
    body: &mut String,
) {
    let mut drawn: Vec<String> = vec![];
    // Centres, and how far from them the next ellipse must be. The end comes first: it is always
    // there.
    let mut end: Option<(f64, f64, f64)> = None;
    let mut last: Option<(f64, f64, f64)> = None;
    for place in path.places().next_back().into_iter().chain(path.places()) {
        let (x, y) = window.page(place.at.x_m, place.at.y_m);
        let close =
            |other: Option<(f64, f64, f64)>| other.is_some_and(|(u, v, apart)| (x - u).hypot(y - v) < apart);
        if drawn.len() >= 60 || close(end) || close(last) {
            continue;
        }
        let Some((long, short, turn)) = two_sigma(place.at) else { continue };
        let (long, short) = (long * window.scale, short * window.scale);
        if !(SEEN..3000.0).contains(&long) {
            continue;
        }
        drawn.push(format!(
            "<ellipse rx=\"{}\" ry=\"{}\" transform=\"translate({} {}) rotate({})\"/>",
            c(long),
            c(short.max(0.5)),
            c(x),
            c(y),
            c(-turn.to_degrees())
        ));
        let centre = Some((x, y, (1.6 * long).max(110.0)));
        if drawn.len() == 1 {
            end = centre;
        } else {
            last = centre;
        }
    }
    shown.ellipses = !drawn.is_empty();
    if shown.ellipses {
        let _ = writeln!(
            body,
            "<g class=\"ellipse\" fill=\"{ELLIPSE}\" fill-opacity=\"0.09\" stroke=\"{ELLIPSE}\" stroke-width=\"1.2\" stroke-opacity=\"0.75\">{}</g>",
            drawn.join("\n")
        );
    }
}

/// A small cross where tracking was lost or began again.
pub(super) fn cross(x: f64, y: f64, body: &mut String) {
    let d = format!("M{} {}l9 9m0 -9l-9 9", c(x - 4.5), c(y - 4.5));
    let _ = writeln!(
        body,
        "<g fill=\"none\" stroke-linecap=\"round\"><path class=\"casing\" stroke=\"{BACKGROUND}\" stroke-width=\"5\" d=\"{d}\"/>\
         <path class=\"lost\" stroke=\"{LOST}\" stroke-width=\"2.2\" d=\"{d}\"/></g>"
    );
}

fn start_mark(x: f64, y: f64) -> String {
    format!(
        "<circle class=\"start\" fill=\"{BACKGROUND}\" stroke=\"{START}\" stroke-width=\"3.5\" cx=\"{}\" cy=\"{}\" r=\"8\"/>",
        c(x),
        c(y)
    )
}

fn end_mark(x: f64, y: f64) -> String {
    format!(
        "<rect class=\"end\" fill=\"{INK}\" stroke=\"{BACKGROUND}\" stroke-width=\"1.5\" x=\"{}\" y=\"{}\" width=\"10\" height=\"10\" rx=\"1.5\"/>",
        c(x - 5.0),
        c(y - 5.0)
    )
}

/// Start and end with their labels, placed where they hide least of the path.
pub(super) fn ends(path: &MeasuredPath<'_>, window: &DrawingWindow, body: &mut String) {
    let (Some(first), Some(last)) = (path.places().next(), path.places().next_back()) else {
        return;
    };
    let start = window.page(first.at.x_m, first.at.y_m);
    let end = window.page(last.at.x_m, last.at.y_m);
    let _ = writeln!(body, "{}{}", start_mark(start.0, start.1), end_mark(end.0, end.1));
    let mut ink = inked(path, window);
    let together = (start.0 - end.0).hypot(start.1 - end.1) < 12.0;
    let words: &[((f64, f64), &str)] =
        if together { &[(start, "start, end")] } else { &[(start, "start"), (end, "end")] };
    ink.extend(std::iter::repeat_n(start, 40).chain(std::iter::repeat_n(end, 40)));
    for &(at, word) in words {
        let (x, y, anchor) = best_place(at, word, &ink, window);
        let _ = writeln!(
            body,
            "<text class=\"ink label\" fill=\"{INK}\" stroke=\"{BACKGROUND}\" stroke-width=\"4\" stroke-linejoin=\"round\" \
             paint-order=\"stroke\" font-size=\"16\" font-weight=\"500\" text-anchor=\"{anchor}\" x=\"{}\" y=\"{}\">{word}</text>",
            c(x),
            c(y)
        );
        // The next word keeps off this one.
        let width = text_width(word, 16.0);
        let left = x - width
            * match anchor {
                "start" => 0.0,
                "middle" => 0.5,
                _ => 1.0,
            };
        ink.extend(
            (0..40).map(|k| (left + width * f64::from(k % 10) / 9.0, y - 12.0 + 4.0 * f64::from(k / 10))),
        );
    }
}

/// Points along the drawn path and along its heading ticks, dense enough to find what a label
/// would cover.
fn inked(path: &MeasuredPath<'_>, window: &DrawingWindow) -> Vec<(f64, f64)> {
    let mut ink: Vec<(f64, f64)> = vec![];
    for segment in &path.segments {
        let mut before: Option<(f64, f64)> = None;
        for place in segment {
            let at = window.page(place.at.x_m, place.at.y_m);
            let from = before.unwrap_or(at);
            let length = (at.0 - from.0).hypot(at.1 - from.1);
            if before.is_some() && length < 4.0 {
                continue;
            }
            let parts = (length / 4.0).clamp(1.0, 500.0) as usize;
            ink.extend((1..=parts).map(|k| {
                let share = k as f64 / parts as f64;
                (from.0 + share * (at.0 - from.0), from.1 + share * (at.1 - from.1))
            }));
            before = Some(at);
            if ink.len() > 200_000 {
                return ink;
            }
        }
    }
    ink
}

/// The label position that hides least of the path, out of ten around the marker: its baseline
/// point and anchor.
fn best_place(
    (x, y): (f64, f64),
    word: &str,
    ink: &[(f64, f64)],
    window: &DrawingWindow,
) -> (f64, f64, &'static str) {
    let width = text_width(word, 16.0);
    let places = [
        (x + 16.0, y + 5.5, "start"),
        (x - 16.0, y + 5.5, "end"),
        (x, y - 17.0, "middle"),
        (x, y + 28.0, "middle"),
        (x + 13.0, y - 13.0, "start"),
        (x + 13.0, y + 24.0, "start"),
        (x - 13.0, y - 13.0, "end"),
        (x - 13.0, y + 24.0, "end"),
        (x + 30.0, y + 5.5, "start"),
        (x - 30.0, y + 5.5, "end"),
    ];
    let covered = |&(u, v, anchor): &(f64, f64, &str)| {
        let left = u - width
            * match anchor {
                "start" => 0.0,
                "middle" => 0.5,
                _ => 1.0,
            };
        let (right, top, bottom) = (left + width, v - 13.0, v + 4.0);
        let outside = left < window.left + 4.0
            || right > window.right() - 4.0
            || top < window.top + 4.0
            || bottom > window.bottom() - 4.0;
        let inside =
            |&&(p, q): &&(f64, f64)| p > left - 5.0 && p < right + 5.0 && q > top - 5.0 && q < bottom + 5.0;
        ink.iter().filter(inside).count() + if outside { 1_000_000 } else { 0 }
    };
    places.into_iter().min_by_key(covered).unwrap_or(places[0])
}

/// A round length without trailing zeros: `50 cm`, `2 m`.
fn round_length(length_m: f64) -> String {
    let text = length_text(length_m);
    match text.split_once(' ') {
        Some((digits, unit)) if digits.contains('.') => {
            format!("{} {unit}", digits.trim_end_matches('0').trim_end_matches('.'))
        }
        _ => text,
    }
}

/// An entry of the legend: its width and its SVG text, both in drawing units.
type LegendItem = (f64, String);

/// The row under the drawing that explains its marks; returns where the page ends.
pub(super) fn legend(
    path: &MeasuredPath<'_>,
    window: &DrawingWindow,
    shown: &Shown,
    body: &mut String,
) -> f64 {
    let mut items = vec![scale_bar(window)];
    if path.places().nth(1).is_some() && path.duration_s > 0.0 {
        items.push(time_scale(path.duration_s));
    }
    if !path.segments.is_empty() {
        items.push(labelled(22.0, -2.0, start_mark(7.0, 0.0), "start"));
        items.push(labelled(18.0, 0.0, end_mark(5.0, 0.0), "end"));
    }
    if let Some(every_m) = shown.headings {
        let words = format!("heading, every {} or 45°", round_length(every_m));
        let mark = format!("<path class=\"tick\" fill=\"{INK}\" d=\"{}\"/>", dart(6.0, 0.0, 0.6));
        items.push(labelled(24.0, 0.0, mark, &words));
    }
    if shown.ellipses {
        let mark = format!(
            "<ellipse class=\"ellipse\" fill=\"{ELLIPSE}\" fill-opacity=\"0.12\" stroke=\"{ELLIPSE}\" cx=\"13\" cy=\"0\" rx=\"13\" ry=\"6.5\"/>"
        );
        items.push(labelled(34.0, 0.0, mark, "2 σ of the position"));
    }
    if shown.loops {
        let mark = format!(
            "<circle class=\"loop\" fill=\"none\" stroke=\"{LOOP}\" stroke-width=\"1.6\" cx=\"7\" cy=\"0\" r=\"{RING}\"/>"
        );
        items.push(labelled(20.0, 0.0, mark, "ground recognised"));
    }
    if shown.landmarks {
        items.push(labelled(20.0, 0.0, upright_cross(7.0, 0.0, LANDMARK), "marker"));
    }
    if shown.gaps {
        let mut mark = format!(
            "<path class=\"gap\" stroke=\"{MUTED}\" stroke-width=\"1.6\" stroke-dasharray=\"2 6\" stroke-linecap=\"round\" d=\"M12 0h24\"/>"
        );
        cross(5.0, 0.0, &mut mark);
        items.push(labelled(44.0, 2.0, mark, "lost: path unknown"));
    }
    if shown.reckoned {
        items.push(labelled(46.0, 0.0, reckoned::mark(), "lost: path by other sensors"));
    }
    let (mut x, mut y) = (window.left, window.bottom() + 84.0);
    let _ = writeln!(body, "<g font-size=\"15\">");
    for (width, item) in items {
        if x > window.left && x + width > window.page_width() - RIGHT_MARGIN {
            (x, y) = (window.left, y + 32.0);
        }
        let _ = writeln!(body, "<g transform=\"translate({} {})\">{item}</g>", c(x), c(y));
        x += width + 34.0;
    }
    let _ = writeln!(body, "</g>");
    y + 30.0
}

fn legend_text(x: f64, words: &str) -> String {
    format!("<text class=\"ink\" fill=\"{INK}\" x=\"{}\" y=\"5\">{words}</text>", c(x))
}

/// Width of words of the legend.
fn legend_width(words: &str) -> f64 {
    text_width(words, 15.0)
}

/// A mark with its meaning at `x`; the entry ends `margin` after the words.
fn labelled(x: f64, margin: f64, mark: String, words: &str) -> LegendItem {
    (x + margin + legend_width(words), mark + &legend_text(x, words))
}

fn scale_bar(window: &DrawingWindow) -> LegendItem {
    let bar_m = round_step(80.0 / window.scale, 1.0);
    let (bar, words) = (bar_m * window.scale, round_length(bar_m));
    let half = c(0.5 * bar);
    let mark = format!(
        "<g class=\"bar\" stroke=\"{INK}\" stroke-width=\"1.2\"><rect fill=\"{INK}\" x=\"0\" y=\"-3.5\" width=\"{half}\" height=\"7\"/>\
         <rect class=\"page\" fill=\"{BACKGROUND}\" x=\"{half}\" y=\"-3.5\" width=\"{half}\" height=\"7\"/></g>"
    );
    labelled(bar + 10.0, 0.0, mark, &words)
}

/// The colours of the path from the start of the recording to its end.
fn time_scale(duration_s: f64) -> LegendItem {
    let (from, to) = ("0 s", duration_text(duration_s));
    let left = legend_width(from) + 10.0;
    let step = 130.0 / TIME_COLOURS as f64;
    let cells: String = (0..TIME_COLOURS)
        .map(|k| {
            let colour = hex(time_colour(k as f64 / (TIME_COLOURS - 1) as f64));
            let x = left + step * k as f64;
            format!(
                "<rect fill=\"{colour}\" x=\"{x:.2}\" y=\"-3.5\" width=\"{:.2}\" height=\"7\"/>",
                step + 0.3
            )
        })
        .collect();
    let mark = format!("<g shape-rendering=\"crispEdges\">{cells}</g>{}", legend_text(0.0, from));
    labelled(left + 140.0, 0.0, mark, &to)
}
