//! The part of the ground that is drawn, and where on the page.

use super::path::MeasuredPath;
use super::reckoned::ReckonedStretch;
use super::scale;
use super::svg::{coordinate, escape};
use super::{AXIS, BACKGROUND, FAINT, INK, MUTED};
use crate::geometry::Placement;
use std::fmt::Write;

/// Pages narrower than this, drawing units, have smaller margins and stand upright, as on a phone.
const NARROW: f64 = 700.0;
/// Left edge of the drawn ground on a wide and on a narrow page, drawing units: room for the labels
/// of the axis.
const LEFT: (f64, f64) = (86.0, 76.0);
/// From the right edge of the drawn ground to that of the page, drawing units.
pub(super) const RIGHT_MARGIN: f64 = 34.0;
/// Least and greatest height of the drawn ground, as a share of the page's width.
const HEIGHTS: (f64, f64) = (0.35, 0.75);
const NARROW_HEIGHTS: (f64, f64) = (0.6, 1.2);
/// Room around the path for markers and their words on a wide and on a narrow page, drawing units.
const MARGIN: (f64, f64) = (48.0, 30.0);
/// Smallest extent that is enlarged to fill the page, metres: a path below it is noise.
const MIN_EXTENT_M: f64 = 0.004;

/// Left edge of the drawn ground, and of all words over it, on a page of the given width.
pub(super) fn left(page_width: f64) -> f64 {
    if page_width < NARROW { LEFT.1 } else { LEFT.0 }
}

/// A rectangle of ground and its place on the page; the same scale on both axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct DrawingWindow {
    centre_m: (f64, f64),
    /// Drawing units a metre.
    pub scale: f64,
    pub left: f64,
    pub top: f64,
    pub width: f64,
    pub height: f64,
}

impl DrawingWindow {
    /// The window that shows the whole path, what other sensors have of it, and all of the
    /// backdrop.
    pub fn around(
        path: &MeasuredPath<'_>,
        reckoned: &[ReckonedStretch],
        backdrop: Option<(Placement, usize, usize)>,
        page_width: f64,
        top: f64,
    ) -> Self {
        let mut low = (f64::INFINITY, f64::INFINITY);
        let mut high = (f64::NEG_INFINITY, f64::NEG_INFINITY);
        let mut include = |x: f64, y: f64| {
            low = (low.0.min(x), low.1.min(y));
            high = (high.0.max(x), high.1.max(y));
        };
        path.places().for_each(|place| include(place.at.x_m, place.at.y_m));
        let drawable = reckoned.iter().filter(|stretch| stretch.is_drawable());
        drawable.flat_map(|stretch| &stretch.points).for_each(|at| include(at.x_m, at.y_m));
        if let Some((placement, columns, rows)) = backdrop {
            for (column, row) in [(-0.5, -0.5), (columns as f64 - 0.5, rows as f64 - 0.5)] {
                let corner = placement.ground_from_pixel(column, row);
                include(corner.x_m, corner.y_m);
            }
        }
        if low.0 > high.0 {
            (low, high) = ((-0.5, -0.2), (0.5, 0.2));
        }
        let centre_m = (0.5 * (low.0 + high.0), 0.5 * (low.1 + high.1));
        let least = MIN_EXTENT_M.max(1e-9 * (centre_m.0.abs() + centre_m.1.abs()));
        let (width_m, height_m) = (high.0 - low.0, high.1 - low.1);
        let left = left(page_width);
        let (margin, heights) = match page_width < NARROW {
            false => (MARGIN.0, HEIGHTS),
            true => (MARGIN.1, NARROW_HEIGHTS),
        };
        let room = |size: f64| size - 2.0 * margin;
        let width = page_width - RIGHT_MARGIN - left;
        let heights = (heights.0 * page_width, heights.1 * page_width);
        let scale = (room(width) / width_m.max(least)).min(room(heights.1) / height_m.max(least));
        let height = (height_m * scale + 2.0 * margin).clamp(heights.0, heights.1).round();
        Self { centre_m, scale, left, top, width, height }
    }

    /// Where a ground point is on the page.
    pub fn page(&self, x_m: f64, y_m: f64) -> (f64, f64) {
        (
            self.left + 0.5 * self.width + (x_m - self.centre_m.0) * self.scale,
            self.top + 0.5 * self.height - (y_m - self.centre_m.1) * self.scale,
        )
    }

    pub fn right(&self) -> f64 {
        self.left + self.width
    }

    pub fn bottom(&self) -> f64 {
        self.top + self.height
    }

    /// Width of the whole page.
    pub fn page_width(&self) -> f64 {
        self.right() + RIGHT_MARGIN
    }

    /// The name under which the clip rectangle is known; two drawings of different width can stand
    /// on one page.
    pub fn clip_name(&self) -> String {
        format!("map-ground-{}", coordinate(self.page_width()))
    }

    /// The step between grid lines, metres.
    fn grid_step_m(&self) -> f64 {
        scale::round_step((self.page_width() / 12.0).clamp(48.0, 100.0) / self.scale, 1.0)
    }

    /// Grid lines (to go over the ground, under the path).
    pub fn grid(&self, svg: &mut String) {
        let step = self.grid_step_m();
        let mut line = |a: (f64, f64), b: (f64, f64), at_zero: bool| {
            let (class, colour, wide) = if at_zero { ("axis", AXIS, 1.2) } else { ("faint", FAINT, 1.0) };
            let _ = writeln!(
                svg,
                "<line class=\"{class}\" stroke=\"{colour}\" stroke-width=\"{wide}\" x1=\"{}\" y1=\"{}\" x2=\"{}\" y2=\"{}\"/>",
                coordinate(a.0),
                coordinate(a.1),
                coordinate(b.0),
                coordinate(b.1)
            );
        };
        let (xs, ys) = self.grid_values(step);
        for x in xs {
            let at = self.page(x, 0.0).0;
            line((at, self.top), (at, self.bottom()), x.abs() < 1e-9 * step);
        }
        for y in ys {
            let at = self.page(0.0, y).1;
            line((self.left, at), (self.right(), at), y.abs() < 1e-9 * step);
        }
    }

    /// The frame around the ground, the numbers at the grid lines and the names of the axes.
    pub fn axes(&self, svg: &mut String) {
        let step = self.grid_step_m();
        let (unit, metres) = scale::length_unit(step);
        let _ = writeln!(
            svg,
            "<rect class=\"frame\" fill=\"none\" stroke=\"{AXIS}\" x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\"/>",
            self.left, self.top, self.width, self.height
        );
        let _ = writeln!(svg, "<g class=\"muted\" fill=\"{MUTED}\" font-size=\"14\">");
        let (xs, ys) = self.grid_values(step);
        for x in xs {
            let at = coordinate(self.page(x, 0.0).0);
            let text = scale::label(x / metres, step / metres);
            let _ = writeln!(
                svg,
                "<text text-anchor=\"middle\" x=\"{at}\" y=\"{}\">{text}</text>",
                coordinate(self.bottom() + 21.0)
            );
        }
        for y in ys {
            let at = coordinate(self.page(0.0, y).1 + 5.0);
            let text = scale::label(y / metres, step / metres);
            let _ = writeln!(
                svg,
                "<text text-anchor=\"end\" x=\"{}\" y=\"{at}\">{text}</text>",
                coordinate(self.left - 9.0)
            );
        }
        let _ = writeln!(svg, "</g>");
        let name = |text: &str| format!("{} ({unit})", escape(text));
        let (middle_x, middle_y) = (self.left + 0.5 * self.width, self.top + 0.5 * self.height);
        let _ = writeln!(
            svg,
            "<g class=\"ink\" fill=\"{INK}\" font-size=\"15\" text-anchor=\"middle\"><text x=\"{}\" y=\"{}\">{}</text>\
             <text transform=\"translate({} {}) rotate(-90)\">{}</text></g>",
            coordinate(middle_x),
            coordinate(self.bottom() + 46.0),
            name("x, forward at the start"),
            coordinate(self.left - 60.0),
            coordinate(middle_y),
            name("y, left at the start"),
        );
    }

    /// The values of the grid lines on both axes, none so near the frame's corner that its number
    /// would run into another.
    fn grid_values(&self, step: f64) -> (Vec<f64>, Vec<f64>) {
        let half = (0.5 * self.width / self.scale, 0.5 * self.height / self.scale);
        let (x, y) = self.centre_m;
        (scale::multiples(x - half.0, x + half.0, step), scale::multiples(y - half.1, y + half.1, step))
    }

    /// The clip rectangle and the ground's background.
    pub fn ground(&self, svg: &mut String) {
        let place = format!(
            "x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\"",
            self.left, self.top, self.width, self.height
        );
        let _ = writeln!(svg, "<clipPath id=\"{}\"><rect {place}/></clipPath>", self.clip_name());
        let _ = writeln!(svg, "<rect class=\"ground\" fill=\"{BACKGROUND}\" {place}/>");
    }
}
