//! A picture of what was measured: the frame with the plumb point, angles about it, the carrier's
//! directions and the board's points.

use super::RigMeasurement;
use crate::files;
use crate::report::drawing_png;
use odograph::camera::Camera;
use odograph::drawing::svg::{data_uri, text_width};
use odograph::error::Result;
use odograph::geometry::{GroundPoint, GroundPose, Pixel};
use std::fmt::Write;

/// Angles from the plumb line at which rings are drawn, degrees.
const RINGS_DEG: [f64; 8] = [10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0];

/// Height of letters in a picture of 640 pixels, pixels.
const TEXT: f64 = 13.0;

/// The picture as the bytes of a PNG file.
pub fn drawn(camera: &Camera, measured: &RigMeasurement) -> Result<Vec<u8>> {
    let (width, height) = (camera.width(), camera.height());
    let png = files::png_from_rgb(&measured.frame)?;
    let unit = unit(camera);
    let rig = measured.rig.rig;
    // The world's x is the carrier's forward.
    let pose = GroundPose { heading_rad: rig.yaw_rad, ..rig.first_pose() };
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" xmlns:xlink=\"http://www.w3.org/1999/xlink\" viewBox=\"0 0 {width} {height}\" \
         width=\"{width}\" height=\"{height}\" font-family=\"Roboto\" font-size=\"{:.1}\">\n\
         <image width=\"{width}\" height=\"{height}\" xlink:href=\"{}\"/>\n",
        TEXT * unit,
        data_uri("image/png", &png)
    );
    for degrees in RINGS_DEG {
        let radius_m = rig.height_m * degrees.to_radians().tan();
        let at = |step: usize| {
            let (sin, cos) = (step as f64 / 180.0 * std::f64::consts::TAU).sin_cos();
            GroundPoint::new(radius_m * cos, radius_m * sin)
        };
        let ring: Vec<Option<Pixel>> = (0..=180).map(|step| seen(camera, &pose, at(step))).collect();
        line(&mut svg, &ring, "#ffd54a", 0.8 * unit);
        // Labels are behind the plumb point, away from the arrows.
        let behind = ring.iter().cycle().skip(110).take(ring.len()).flatten();
        if let Some(label) = behind.into_iter().find(|pixel| camera.contains(**pixel, 16.0 * unit)) {
            text(&mut svg, *label, &format!("{degrees:.0}°"), "#ffd54a", camera);
        }
    }
    let (forward, left) = match measured.forward_known {
        true => ("forward", "left"),
        false => ("up in the image", "left in the image"),
    };
    for ((x, y), name, color) in [((1.0, 0.0), forward, "#ff5a4a"), ((0.0, 1.0), left, "#5ad45a")] {
        let reach_m = 0.25 * rig.height_m;
        let along = |step: usize| {
            let part = step as f64 / 20.0 * reach_m;
            seen(camera, &pose, GroundPoint::new(part * x, part * y))
        };
        let arrow: Vec<Option<Pixel>> = (0..=20).map(along).collect();
        line(&mut svg, &arrow, color, 2.0 * unit);
        if let Some(tip) = arrow.last().copied().flatten() {
            disc(&mut svg, tip, 3.5 * unit, color, true);
            text(&mut svg, Pixel::new(tip.x + 5.0 * unit, tip.y), name, color, camera);
        }
    }
    measured.points.iter().for_each(|point| disc(&mut svg, *point, 3.0 * unit, "#3ad0ff", false));
    if let Some(plumb) = seen(camera, &pose, GroundPoint::new(0.0, 0.0)) {
        disc(&mut svg, plumb, 4.0 * unit, "#ffd54a", true);
        text(
            &mut svg,
            Pixel::new(plumb.x + 7.0 * unit, plumb.y + 14.0 * unit),
            "plumb point",
            "#ffd54a",
            camera,
        );
    }
    svg.push_str("</svg>\n");
    drawing_png(&svg, width as u32)
}

fn seen(camera: &Camera, pose: &GroundPose, point: GroundPoint) -> Option<Pixel> {
    pose.ray_from_ground(point).and_then(|ray| camera.pixel_from_ray(ray))
}

/// A line through the visible points, interrupted at the others.
fn line(svg: &mut String, points: &[Option<Pixel>], color: &str, width: f64) {
    let mut path = String::new();
    let mut before = false;
    for point in points {
        if let Some(Pixel { x, y }) = point {
            let _ = write!(path, "{}{:.2} {:.2}", if before { "L" } else { "M" }, x + 0.5, y + 0.5);
        }
        before = point.is_some();
    }
    if !path.is_empty() {
        let _ = writeln!(
            svg,
            "<path d=\"{path}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"{width:.2}\"/>"
        );
    }
}

fn disc(svg: &mut String, at: Pixel, radius: f64, color: &str, filled: bool) {
    let fill = if filled { color } else { "none" };
    let _ = writeln!(
        svg,
        "<circle cx=\"{:.2}\" cy=\"{:.2}\" r=\"{radius:.2}\" fill=\"{fill}\" stroke=\"{color}\" stroke-width=\"{:.2}\"/>",
        at.x + 0.5,
        at.y + 0.5,
        0.35 * radius
    );
}

/// A label that begins at a pixel, moved into the image where it would be cut off.
fn text(svg: &mut String, at: Pixel, text: &str, color: &str, camera: &Camera) {
    let unit = unit(camera);
    let (margin, long) = (4.0 * unit, text_width(text, TEXT * unit));
    let x = at.x.min(camera.width() as f64 - long - margin).max(margin);
    let y = at.y.clamp((TEXT + 4.0) * unit, camera.height() as f64 - margin);
    let _ = writeln!(
        svg,
        "<text x=\"{x:.1}\" y=\"{y:.1}\" fill=\"{color}\" stroke=\"#000\" stroke-width=\"{:.1}\" stroke-linejoin=\"round\" \
         paint-order=\"stroke\">{text}</text>",
        3.0 * unit
    );
}

/// Lines and letters are as large in a large picture as in a small one.
fn unit(camera: &Camera) -> f64 {
    camera.width().max(camera.height()) as f64 / 640.0
}
