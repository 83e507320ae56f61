//! The movement map as a drawing: the path over the ground in metres, as SVG text.
//!
//! World x runs to the right and world y up, at the same scale, as any graph of the trajectory file
//! shows them. Only the measured path is a solid line. Gaps are dashed: as other sensors have the
//! path there, or thin straight lines. The drawing is made for a light background; every part also
//! has a class, so that a page around it can recolour it.

pub mod canvas;
mod markers;
mod path;
mod reckoned;
pub mod scale;
pub mod svg;
mod window;

use crate::geometry::GroundPoint;
use crate::geometry::Placement;
use crate::trajectory::{FrameSummary, distance_m};
use path::{MeasuredPath, simplified};
pub use reckoned::ReckonedStretch;
use std::fmt::Write;
use svg::{coordinate, escape};
use window::DrawingWindow;

/// Colours of the drawing on a light page.
const INK: &str = "#1b2430";
const MUTED: &str = "#64707f";
const FAINT: &str = "#dfe4ea";
const AXIS: &str = "#aab4bf";
const BACKGROUND: &str = "#ffffff";
/// Number of colours of the time scale.
const TIME_COLOURS: usize = 48;

/// Contents of the drawing besides the path.
#[derive(Debug, Clone, Copy)]
pub struct MapDrawing<'a> {
    /// Title above the drawing, with a line of figures; empty for neither.
    pub title: &'a str,
    /// Width of the drawing, from 400 to 4000 units; words are 14 to 16 units high.
    pub width: f64,
    /// A picture of the ground under the path.
    pub backdrop: Option<Backdrop<'a>>,
    /// Places that were recognised: each the two positions of the camera from which the same ground
    /// was seen.
    pub loops: &'a [[GroundPoint; 2]],
    /// Markers on the ground: crosses with their numbers.
    pub landmarks: &'a [DrawnLandmark],
    /// The path by other sensors where the camera was lost.
    pub reckoned: &'a [ReckonedStretch],
}

/// A marker on the ground as a cross with its number.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrawnLandmark {
    /// Its number.
    pub number: u32,
    /// Its centre.
    pub at: GroundPoint,
    /// Whether its surveyed place or its number contradicts others.
    pub doubtful: bool,
}

/// A picture of the ground that lies under the path, embedded in the drawing.
#[derive(Debug, Clone, Copy)]
pub struct Backdrop<'a> {
    /// The bytes of a PNG file; transparent where the ground was not seen.
    pub png: &'a [u8],
    /// Its columns.
    pub width_px: usize,
    /// Its rows.
    pub height_px: usize,
    /// Where it lies.
    pub placement: Placement,
    /// Opacity, from 0, invisible, to 1.
    pub opacity: f64,
}

impl Default for MapDrawing<'_> {
    fn default() -> Self {
        Self { title: "", width: 1200.0, backdrop: None, loops: &[], landmarks: &[], reckoned: &[] }
    }
}

impl MapDrawing<'_> {
    /// The drawing as a whole SVG document. The same input gives the same text.
    ///
    /// Any number of frames is allowed, including zero; polylines are thinned to visible detail.
    /// Poses that are not finite count as lost.
    pub fn svg(&self, frames: &[FrameSummary]) -> String {
        let path = MeasuredPath::new(frames);
        let backdrop = self.backdrop.filter(|b| b.is_drawable());
        let page_width = if self.width.is_nan() { 1200.0 } else { self.width.clamp(400.0, 4000.0).round() };
        let mut heading = String::new();
        let top = self.heading(frames, &path, page_width, &mut heading);
        let backed = backdrop.map(|b| (b.placement, b.width_px, b.height_px));
        let window = DrawingWindow::around(&path, self.reckoned, backed, page_width, top);
        let mut body = String::new();
        window.ground(&mut body);
        let _ = writeln!(body, "<g clip-path=\"url(#{})\">", window.clip_name());
        if let Some(backdrop) = backdrop {
            backdrop.draw(&window, &mut body);
        }
        window.grid(&mut body);
        let mut shown = markers::Shown::default();
        markers::ellipses(&path, &window, &mut shown, &mut body);
        let first_s = frames.first().map_or(0.0, |frame| frame.time_s);
        let breaks = gaps(&path, self.reckoned, first_s, &window, &mut shown, &mut body);
        measured_path(&path, &window, &mut body);
        breaks.into_iter().for_each(|(x, y)| markers::cross(x, y, &mut body));
        markers::loops(self.loops, &window, &mut shown, &mut body);
        markers::landmarks(self.landmarks, &window, &mut shown, &mut body);
        markers::headings(&path, &window, &mut shown, &mut body);
        markers::ends(&path, &window, &mut body);
        let _ = writeln!(body, "</g>");
        window.axes(&mut body);
        if path.segments.is_empty() {
            let _ = writeln!(
                body,
                "<text class=\"muted\" fill=\"{MUTED}\" font-size=\"20\" text-anchor=\"middle\" x=\"{}\" y=\"{}\">\
                 no frame has a pose: nothing to draw</text>",
                coordinate(window.left + 0.5 * window.width),
                coordinate(window.top + 0.5 * window.height - 24.0)
            );
        }
        let height = markers::legend(&path, &window, &shown, &mut body);
        let height = coordinate(height);
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"map\" viewBox=\"0 0 {page_width} {height}\" \
             width=\"{page_width}\" height=\"{height}\" font-family=\"Roboto, 'Helvetica Neue', Arial, sans-serif\" \
             role=\"img\" aria-label=\"Map of the movement\">\n\
             <rect class=\"page\" fill=\"{BACKGROUND}\" width=\"{page_width}\" height=\"{height}\"/>\n{heading}{body}</svg>\n"
        )
    }

    /// Title and figures over the drawing, as many lines as they need; returns where the drawn
    /// ground begins.
    fn heading(
        &self,
        frames: &[FrameSummary],
        path: &MeasuredPath<'_>,
        page_width: f64,
        body: &mut String,
    ) -> f64 {
        if self.title.trim().is_empty() {
            return 20.0;
        }
        let posed = path.places().count();
        let mut facts = vec![
            format!("{} travelled", scale::length_text(finite(distance_m(frames)))),
            format!("in {}", scale::duration_text(path.duration_s)),
            format!("{posed} of {} frames with a pose", frames.len()),
        ];
        let gaps = path.segments.len().saturating_sub(1) + usize::from(path.ends_lost);
        if gaps > 0 {
            facts.push(if gaps == 1 { "lost once".into() } else { format!("lost {gaps} times") });
        }
        let left = window::left(page_width);
        let room = page_width - left - window::RIGHT_MARGIN;
        let title = escape(&svg::fitted(self.title, 27.0, room));
        let _ = writeln!(
            body,
            "<text class=\"ink\" fill=\"{INK}\" x=\"{left}\" y=\"46\" font-size=\"27\" font-weight=\"500\">{title}</text>"
        );
        let mut lines: Vec<String> = vec![];
        for fact in facts {
            match lines.last_mut() {
                Some(line) if svg::text_width(line, 16.0) + svg::text_width(&fact, 16.0) + 20.0 < room => {
                    line.push_str("  ·  ");
                    line.push_str(&fact);
                }
                _ => lines.push(fact),
            }
        }
        for (index, line) in lines.iter().enumerate() {
            let y = coordinate(75.0 + 22.0 * index as f64);
            let _ = writeln!(
                body,
                "<text class=\"muted\" fill=\"{MUTED}\" x=\"{left}\" y=\"{y}\" font-size=\"16\">{line}</text>"
            );
        }
        75.0 + 22.0 * lines.len() as f64
    }
}

impl Backdrop<'_> {
    fn is_drawable(&self) -> bool {
        let Placement { metres_per_pixel, x_m, y_m } = self.placement;
        let finite = [x_m, y_m, metres_per_pixel].iter().all(|v| v.is_finite() && v.abs() < 1e12);
        finite && metres_per_pixel > 0.0 && self.width_px > 0 && self.height_px > 0
    }

    fn draw(&self, window: &DrawingWindow, body: &mut String) {
        let corner = self.placement.ground_from_pixel(-0.5, -0.5);
        let (x, y) = window.page(corner.x_m, corner.y_m);
        let side = self.placement.metres_per_pixel * window.scale;
        let _ = writeln!(
            body,
            "<image x=\"{x:.3}\" y=\"{y:.3}\" width=\"{:.3}\" height=\"{:.3}\" opacity=\"{:.2}\" \
             preserveAspectRatio=\"none\" href=\"{}\"/>",
            side * self.width_px as f64,
            side * self.height_px as f64,
            if self.opacity.is_finite() { self.opacity.clamp(0.0, 1.0) } else { 1.0 },
            svg::data_uri("image/png", self.png)
        );
    }
}

/// The colour of a moment from 0, the start, to 1, the end, as red, green and blue: from blue over
/// violet to orange, all of middling lightness so that they stand out on white, on black and on a
/// picture.
fn time_colour(moment: f64) -> (u8, u8, u8) {
    const STOPS: [(f64, f64, f64); 5] = [
        (37.0, 99.0, 235.0),
        (124.0, 58.0, 237.0),
        (200.0, 40.0, 170.0),
        (232.0, 62.0, 80.0),
        (245.0, 145.0, 20.0),
    ];
    let at = if moment.is_finite() { moment.clamp(0.0, 1.0) } else { 0.0 } * (STOPS.len() - 1) as f64;
    let index = (at as usize).min(STOPS.len() - 2);
    let share = at - index as f64;
    let mix = |a: f64, b: f64| (a + (b - a) * share).round() as u8;
    let (a, b) = (STOPS[index], STOPS[index + 1]);
    (mix(a.0, b.0), mix(a.1, b.1), mix(a.2, b.2))
}

/// A colour in SVG notation.
fn hex((red, green, blue): (u8, u8, u8)) -> String {
    format!("#{red:02x}{green:02x}{blue:02x}")
}

/// The measured parts: a pale casing for contrast with the ground, then the line, coloured by time.
fn measured_path(path: &MeasuredPath<'_>, window: &DrawingWindow, body: &mut String) {
    let at = |place: &path::PathPoint<'_>| window.page(place.at.x_m, place.at.y_m);
    let _ = writeln!(body, "<g fill=\"none\" stroke-linejoin=\"round\" stroke-linecap=\"round\">");
    for segment in &path.segments {
        let line = simplified(segment.iter().map(at), 0.25);
        polyline(&line, &format!("class=\"casing\" stroke=\"{BACKGROUND}\" stroke-width=\"6.5\""), body);
    }
    let colour_of = |time_s: f64| {
        let moment = if path.duration_s > 0.0 { time_s / path.duration_s } else { 0.0 };
        ((moment * TIME_COLOURS as f64) as usize).min(TIME_COLOURS - 1)
    };
    for segment in &path.segments {
        let mut rest = &segment[..];
        while let Some(first) = rest.first() {
            let colour = colour_of(first.time_s);
            let same = rest.iter().take_while(|p| colour_of(p.time_s) == colour).count().max(1);
            // One point further, so that the colours touch.
            let line = simplified(rest[..rest.len().min(same + 1)].iter().map(at), 0.25);
            let stroke = hex(time_colour(colour as f64 / (TIME_COLOURS - 1) as f64));
            polyline(&line, &format!("stroke=\"{stroke}\" stroke-width=\"3.2\""), body);
            rest = &rest[same..];
        }
    }
    let _ = writeln!(body, "</g>");
}

/// Dashed lines over the gaps: the path by other sensors, or a straight line where it is unknown.
/// `first_s` is the time of the first frame. Returns the ends of the gaps.
fn gaps(
    path: &MeasuredPath<'_>,
    reckoned: &[ReckonedStretch],
    first_s: f64,
    window: &DrawingWindow,
    shown: &mut markers::Shown,
    body: &mut String,
) -> Vec<(f64, f64)> {
    let at = |place: &path::PathPoint<'_>| window.page(place.at.x_m, place.at.y_m);
    let mut breaks = vec![];
    let known = |before: &path::PathPoint<'_>, after: Option<&path::PathPoint<'_>>| {
        let after_s = after.map(|after| first_s + after.time_s);
        ReckonedStretch::between(reckoned, first_s + before.time_s, after_s)
    };
    for pair in path.segments.windows(2) {
        if let (Some(before), Some(after)) = (pair[0].last(), pair[1].first()) {
            let ends = [at(before), at(after)];
            if let Some(stretch) = known(before, Some(after)) {
                draw_reckoned(stretch, before, Some(after), window, body);
                shown.reckoned = true;
            } else {
                let _ = writeln!(
                    body,
                    "<line class=\"gap\" stroke=\"{MUTED}\" stroke-width=\"1.6\" stroke-dasharray=\"2 6\" \
                     stroke-linecap=\"round\" x1=\"{}\" y1=\"{}\" x2=\"{}\" y2=\"{}\"/>",
                    coordinate(ends[0].0),
                    coordinate(ends[0].1),
                    coordinate(ends[1].0),
                    coordinate(ends[1].1)
                );
                shown.gaps = true;
            }
            breaks.extend(ends);
        }
    }
    if path.ends_lost
        && let Some(last) = path.places().next_back()
    {
        match known(last, None) {
            Some(stretch) => {
                draw_reckoned(stretch, last, None, window, body);
                shown.reckoned = true;
            }
            None => shown.gaps = true,
        }
        breaks.push(at(last));
    }
    breaks.dedup_by(|a, b| (a.0 - b.0).hypot(a.1 - b.1) < 1.0);
    breaks
}

/// Draws a stretch between the measured poses before and after it.
fn draw_reckoned(
    stretch: &ReckonedStretch,
    before: &path::PathPoint<'_>,
    after: Option<&path::PathPoint<'_>>,
    window: &DrawingWindow,
    body: &mut String,
) {
    let measured = |point: &path::PathPoint<'_>| window.page(point.at.x_m, point.at.y_m);
    let reckoned = stretch.points.iter().map(|at| window.page(at.x_m, at.y_m));
    let points = [measured(before)].into_iter().chain(reckoned).chain(after.map(measured));
    polyline(&simplified(points, 0.25), &reckoned::style(), body);
}

fn polyline(points: &[(f64, f64)], style: &str, body: &mut String) {
    let _ = write!(body, "<path {style} d=\"M");
    for (index, &(x, y)) in points.iter().enumerate() {
        let _ = write!(
            body,
            "{}{} {}",
            if index == 1 {
                "L"
            } else if index > 1 {
                " "
            } else {
                ""
            },
            coordinate(x),
            coordinate(y)
        );
    }
    if points.len() == 1 {
        body.push_str("h0.1");
    }
    body.push_str("\"/>\n");
}

fn finite(value: f64) -> f64 {
    if value.is_finite() { value } else { 0.0 }
}

#[cfg(test)]
mod tests;
