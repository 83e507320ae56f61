//! The path over the ground: a still picture with layers, which a script pans, zooms and links with
//! the plots.

use super::figures::sigmas;
use super::plot::TimeAxis;
use crate::photograph::photograph;
use odograph::drawing::ReckonedStretch;
use odograph::drawing::scale::length_text;
use odograph::drawing::svg::{data_uri, escape};
use odograph::geometry::{GroundPoint, Placement};
use odograph::mosaic::MosaicPicture;
use odograph::trajectory::FrameSummary;
use odograph_session::{ReportInput, ReportLocalization, files};
use std::fmt::Write;

/// Pans and zooms the picture, and links it with the plots.
const SCRIPT: &str = include_str!("ground_view.js");

/// Maximum number of frames that can be pointed at; longer runs are thinned.
const MAX_ROWS: usize = 4000;

/// A layer of the picture: the class of its elements, its name, whether it is shown at first, and
/// its elements.
struct Layer {
    class: &'static str,
    name: &'static str,
    shown: bool,
    elements: String,
}

/// Writes the section; nothing if there is no mosaic.
pub fn path_over_ground(input: &ReportInput<'_>, page: &mut String) {
    let Some(mosaic) = &input.mosaic else { return };
    let caption = format!(
        "<h2>The path over the ground</h2>\n<figure class=\"ground\"><figcaption><span>The frames, orthorectified at their \
         poses, and the path: <span class=\"key green\">start</span><span class=\"key red\">end</span>A pixel of {} is {} \
         wide; its world file has its position.</span></figcaption>",
        escape(mosaic.file_name),
        length_text(mosaic.placement.metres_per_pixel),
    );
    ground_view(&caption, mosaic.picture, layers(&mosaic.picture.placement, input), page);
}

/// Writes the recording over the mosaic of the map in which it was found, or the places that
/// resemble it; nothing if the map has no mosaic.
pub fn place_over_map(input: &ReportInput<'_>, localization: &ReportLocalization<'_>, page: &mut String) {
    let Some(ground) = localization.ground else { return };
    let placement = &ground.placement;
    let (caption, found) = match (localization.place, &input.mosaic) {
        (Some(_), Some(mosaic)) => {
            let picture = mosaic.picture;
            let place = picture.placement;
            // Pixel centres are at integers: a picture begins half a pixel before the first.
            let (x, y) = placement.pixel_from_ground(place.ground_from_pixel(-0.5, -0.5));
            let scale = place.metres_per_pixel / placement.metres_per_pixel;
            let (width, height) = (scale * picture.width as f64, scale * picture.height as f64);
            let png = files::png_from_rgba(picture.width, picture.height, &picture.rgba).unwrap_or_default();
            let image = format!(
                "<image x=\"{x:.2}\" y=\"{y:.2}\" width=\"{width:.2}\" height=\"{height:.2}\" href=\"{}\"/>",
                data_uri("image/png", &png)
            );
            ("What it shows, laid on the mosaic of the map at its place.", image)
        }
        _ => (
            "The mosaic of the map, and the places that resemble it, with their probabilities.",
            String::new(),
        ),
    };
    let caption = format!(
        "<h2>Where it is in the map</h2>\n<figure class=\"ground\"><figcaption><span>{caption} The end of a line is where \
         the top of the image points.</span></figcaption>"
    );
    // A picture has no path, and the frame of a recording that was not found is not the map's.
    let has_path = localization.place.is_some() && input.frames.len() > 1;
    let mut layers = if has_path { layers(placement, input) } else { Vec::new() };
    layers.insert(0, Layer { class: "found", name: "picture", shown: true, elements: found });
    let places = places(placement, localization);
    layers.push(Layer { class: "places", name: "place", shown: true, elements: places });
    ground_view(&caption, ground, layers, page);
}

/// The place, or the possible ones with their probabilities.
fn places(placement: &Placement, localization: &ReportLocalization<'_>) -> String {
    let found = localization.place.map(|place| (place.x_m, place.y_m, place.heading_deg, String::new()));
    let alike = localization.alike.iter().map(|place| {
        let percent = format!("{:.0} %", 100.0 * place.probability);
        (place.x_m, place.y_m, place.heading_deg, percent)
    });
    let mark = |(x_m, y_m, heading_deg, text): (f64, f64, f64, String)| {
        let (x, y) = placement.pixel_from_ground(GroundPoint::new(x_m, y_m));
        let (sin, cos) = heading_deg.to_radians().sin_cos();
        format!(
            "<path class=\"dot\" \
             d=\"M{x:.1} {y:.1}h0\"/><path class=\"dart\" d=\"M{x:.1} {y:.1}l{:.1} {:.1}\"/><text x=\"{x:.1}\" \
             y=\"{y:.1}\">{text}</text>",
            DART_M * cos / placement.metres_per_pixel,
            -DART_M * sin / placement.metres_per_pixel,
        )
    };
    found.into_iter().chain(alike).map(mark).collect()
}

/// Length of the line to where the top of the image points, metres.
const DART_M: f64 = 0.2;

/// A picture of the ground with layers, after its caption.
fn ground_view(caption: &str, picture: &MosaicPicture, layers: Vec<Layer>, page: &mut String) {
    let layers: Vec<Layer> = layers.into_iter().filter(|layer| !layer.elements.is_empty()).collect();
    let placement = picture.placement;
    let _ = writeln!(page, "{caption}");
    // Above the picture: below it, it would be off a small screen.
    let has_path = layers.iter().any(|layer| layer.class == "way");
    let hint = if has_path { "Point at the path or at a plot to see a frame." } else { "" };
    let _ = write!(
        page,
        "<p class=\"readout\" data-hint=\"{hint}\"></p>\n<div class=\"layers\" role=\"group\" aria-label=\"Layers\">\n"
    );
    for (class, name, shown) in
        [("photograph", "ground", true)].into_iter().chain(layers.iter().map(|l| (l.class, l.name, l.shown)))
    {
        let checked = if shown { " checked=\"\"" } else { "" };
        let _ = writeln!(
            page,
            "<label><input type=\"checkbox\" class=\"shows-{class}\"{checked}/><span class=\"swatch {class}\"></span>{name}</label>"
        );
    }
    let _ = write!(
        page,
        "</div>\n<div class=\"view\" role=\"group\" aria-label=\"The path over the ground. Arrow keys move, plus and minus zoom, \
         0 shows all, comma and full stop step through the frames.\" data-x=\"{}\" data-y=\"{}\" data-metres=\"{}\">\
         <div class=\"over\">{}",
        placement.x_m,
        placement.y_m,
        placement.metres_per_pixel,
        photograph(picture, "Mosaic of the ground"),
    );
    let (width, height) = (picture.width, picture.height);
    // Pixel centres are at integers: the picture begins half a pixel before the first.
    let _ = write!(
        page,
        "<svg viewBox=\"-0.5 -0.5 {width} {height}\" style=\"--unit:{:.3}\" aria-hidden=\"true\">",
        width.max(height) as f64 / 1000.0
    );
    for layer in &layers {
        let _ = write!(page, "<g class=\"{}\">{}</g>", layer.class, layer.elements);
    }
    page.push_str("</svg></div></div></figure>\n");
}

/// Writes the frames as data, and the script that shows them. It is the end of the page: everything
/// before is readable without it.
pub fn script(frames: &[FrameSummary], page: &mut String) {
    let Some(first) = frames.first() else { return };
    let times_s: Vec<f64> = frames.iter().map(|frame| frame.time_s - first.time_s).collect();
    let posed =
        frames.iter().zip(&times_s).filter_map(|(frame, &time_s)| Some((frame, time_s, frame.place?)));
    let every = posed.clone().count().div_ceil(MAX_ROWS).max(1);
    let rows: Vec<String> = posed
        .step_by(every)
        .map(|(frame, time_s, at)| {
            let (position_m, heading_rad) = sigmas(&at);
            let residual_px = if frame.inliers > 0 { frame.residual_px } else { f64::NAN };
            let columns = [
                (time_s, 3),
                (at.x_m, 4),
                (at.y_m, 4),
                (at.heading_rad.to_degrees(), 2),
                (position_m, 6),
                (heading_rad.to_degrees(), 4),
                (residual_px, 3),
            ];
            let columns = columns.map(|(value, decimals)| json_number(value, decimals));
            format!("[{}]", columns.join(","))
        })
        .collect();
    let _ = writeln!(
        page,
        "<script type=\"application/json\" id=\"frames\">{{\"axis\":{},\"rows\":[\n{}\n]}}</script>\n<script>\n{SCRIPT}</script>",
        TimeAxis::new(&times_s, &[]).json(),
        rows.join(",\n")
    );
}

/// A number as JSON has it; `null` if it is not finite.
fn json_number(value: f64, decimals: usize) -> String {
    if value.is_finite() { format!("{value:.decimals$}") } else { "null".into() }
}

/// The layers, lowest first.
fn layers(placement: &Placement, input: &ReportInput<'_>) -> Vec<Layer> {
    let pixel = |point: GroundPoint| placement.pixel_from_ground(point);
    let dots = |points: &mut dyn Iterator<Item = GroundPoint>| -> String {
        // A line of zero length with round ends is a dot of the same size at any zoom.
        let mut dots: Vec<String> = points.map(pixel).map(|(x, y)| format!("M{x:.1} {y:.1}h0")).collect();
        dots.dedup();
        dots.concat()
    };
    let drawn = |class: &str, d: String| match d.as_str() {
        "" => String::new(),
        d => format!("<path class=\"{class}\" d=\"{d}\"/>"),
    };
    let lines = |pairs: &[[GroundPoint; 2]]| -> String {
        let line = |pair: &[GroundPoint; 2]| {
            let [from, to] = pair.map(pixel);
            format!("M{:.1} {:.1}L{:.1} {:.1}", from.0, from.1, to.0, to.1)
        };
        pairs.iter().map(line).collect()
    };
    let loops = drawn("line", lines(input.loops))
        + &drawn("dot", dots(&mut input.loops.iter().map(|[newer, _]| *newer)));
    vec![
        Layer { class: "losses", name: "losses", shown: true, elements: losses(placement, input) },
        Layer { class: "way", name: "path", shown: true, elements: path(placement, input.frames) },
        Layer {
            class: "keyframes",
            name: "keyframes",
            shown: false,
            elements: drawn("dot", dots(&mut input.keyframes.iter().copied())),
        },
        Layer { class: "loops", name: "loops", shown: true, elements: loops },
        Layer { class: "marks", name: "marks", shown: true, elements: marks(placement, input) },
    ]
}

/// The path where the camera was lost: as other sensors have it, and straight lines between the two
/// known positions where it is unknown.
fn losses(placement: &Placement, input: &ReportInput<'_>) -> String {
    let (mut unknown, mut reckoned) = (String::new(), String::new());
    let mut add = |before: &FrameSummary, after: Option<&FrameSummary>| {
        let stretch =
            ReckonedStretch::between(input.reckoned, before.time_s, after.map(|after| after.time_s));
        if after.is_none() && stretch.is_none() {
            return;
        }
        let measured = |frame: &FrameSummary| frame.place.map(|at| GroundPoint::new(at.x_m, at.y_m));
        let between = stretch.iter().flat_map(|stretch| stretch.points.iter().copied());
        let points = measured(before).into_iter().chain(between).chain(after.and_then(measured));
        let points: Vec<String> = points
            .map(|point| placement.pixel_from_ground(point))
            .map(|(x, y)| format!("{x:.1} {y:.1}"))
            .collect();
        let line = if stretch.is_some() { &mut reckoned } else { &mut unknown };
        let _ = write!(line, "M{}", points.join("L"));
    };
    let mut before: Option<&FrameSummary> = None;
    let mut lost = false;
    for frame in input.frames {
        if frame.place.is_none() {
            lost = true;
            continue;
        }
        if let (true, Some(before)) = (lost, before) {
            add(before, Some(frame));
        }
        (before, lost) = (Some(frame), false);
    }
    if let (true, Some(before)) = (lost, before) {
        add(before, None);
    }
    let drawn = |class: &str, d: String| match d.as_str() {
        "" => String::new(),
        d => format!("<path class=\"{class}\" d=\"{d}\"/>"),
    };
    drawn("line", unknown) + &drawn("reckoned", reckoned)
}

/// A line for each stretch without a loss, without points that no pixel separates, and the ends of
/// the path.
fn path(placement: &Placement, frames: &[FrameSummary]) -> String {
    let mut lines: Vec<(u32, Vec<(f64, f64)>)> = vec![];
    // A loss may end in the segment in which it began, where earlier ground was recognised.
    let mut lost = false;
    for frame in frames {
        let Some(place) = &frame.place else {
            lost = true;
            continue;
        };
        let at = placement.pixel_from_ground(GroundPoint::new(place.x_m, place.y_m));
        match lines.last_mut() {
            Some((segment, line)) if *segment == frame.segment && !lost => {
                let last = line[line.len() - 1];
                if (at.0 - last.0).hypot(at.1 - last.1) > 1.0 {
                    line.push(at);
                }
            }
            _ => lines.push((frame.segment, vec![at])),
        }
        lost = false;
    }
    let mut svg = String::new();
    for class in ["casing", "path"] {
        for (_, line) in &lines {
            let points: Vec<String> = line.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
            let _ = write!(svg, "<polyline class=\"{class}\" points=\"{}\"/>", points.join(" "));
        }
    }
    let ends =
        lines.first().and_then(|(_, line)| line.first()).zip(lines.last().and_then(|(_, line)| line.last()));
    // The start is a ring around the end, which may lie on it.
    for (class, (x, y), radius) in
        ends.into_iter().flat_map(|(start, end)| [("start", start, 12.0), ("end", end, 7.5)])
    {
        let _ = write!(
            svg,
            "<circle class=\"{class}\" cx=\"{x:.1}\" cy=\"{y:.1}\" style=\"r:calc({radius}px * var(--unit))\"/>"
        );
    }
    svg
}

/// The marks at the positions of the frames nearest in time.
fn marks(placement: &Placement, input: &ReportInput<'_>) -> String {
    let Some(first) = input.frames.first() else { return String::new() };
    let mut svg = String::new();
    for mark in input.marks {
        let off_s = |frame: &&FrameSummary| (frame.time_s - first.time_s - mark.time_s).abs();
        let posed = input.frames.iter().filter(|frame| frame.place.is_some());
        let nearest = posed.min_by(|a, b| off_s(a).total_cmp(&off_s(b)));
        let Some(place) = nearest.and_then(|frame| frame.place) else { continue };
        let (x, y) = placement.pixel_from_ground(GroundPoint::new(place.x_m, place.y_m));
        let _ = write!(
            svg,
            "<path class=\"dot\" d=\"M{x:.1} {y:.1}h0\"/><text x=\"{x:.1}\" y=\"{y:.1}\">{}</text>",
            escape(&mark.name)
        );
    }
    svg
}
