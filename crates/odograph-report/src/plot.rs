//! Plots of values over time for the report; colours come from the page's style sheet.

use odograph::drawing::scale::{label, multiples, round_step};
use odograph::drawing::svg::coordinate;
use std::fmt::Write;

const WIDTH: f64 = 520.0;
const HEIGHT: f64 = 210.0;
const LEFT: f64 = 62.0;
const RIGHT: f64 = WIDTH - 12.0;
const TOP: f64 = 10.0;
const BOTTOM: f64 = HEIGHT - 46.0;
/// Number of columns to which a long run is reduced, about two per drawing unit.
const COLUMNS: usize = 900;

/// One line of a plot: one value per frame, `None` where it is undefined.
pub struct Series<'a> {
    /// CSS class that defines its colour.
    pub class: &'a str,
    pub values: Vec<Option<f64>>,
}

/// Minimum range of the vertical axis.
#[derive(Debug, Clone, Copy)]
pub enum Range {
    /// Starts at zero.
    FromZero,
    /// Centred on the values, with at least this extent.
    Around(f64),
}

/// The time axis shared by all plots of a page.
pub struct TimeAxis<'a> {
    times_s: &'a [f64],
    shaded_s: &'a [(f64, f64)],
    span_s: f64,
}

impl<'a> TimeAxis<'a> {
    /// Creates an axis from frame times and intervals to be shaded, all in seconds since the first
    /// frame.
    pub fn new(times_s: &'a [f64], shaded_s: &'a [(f64, f64)]) -> Self {
        let longest = times_s.iter().copied().filter(|t| t.is_finite()).fold(0.0, f64::max);
        Self { times_s, shaded_s, span_s: if longest > 0.0 { longest } else { 1.0 } }
    }

    /// Where the axis lies in every plot, and its length in seconds, as JSON.
    pub fn json(&self) -> String {
        format!(
            "{{\"left\":{LEFT},\"right\":{RIGHT},\"top\":{TOP},\"bottom\":{BOTTOM},\"span\":{}}}",
            self.span_s
        )
    }

    /// The unit of the labels, and its length in seconds.
    fn unit(&self) -> (&'static str, f64) {
        match self.span_s {
            s if s > 3.0 * 3600.0 => ("h", 3600.0),
            s if s > 300.0 => ("min", 60.0),
            _ => ("s", 1.0),
        }
    }

    fn x(&self, time_s: f64) -> f64 {
        LEFT + (RIGHT - LEFT) * (time_s / self.span_s).clamp(0.0, 1.0)
    }
}

/// A plot as an SVG element.
pub fn plot(name: &str, axis: &TimeAxis<'_>, series: &[Series<'_>], range: Range) -> String {
    let (low, high, step) = vertical(series, range);
    let y = |value: f64| BOTTOM - (BOTTOM - TOP) * ((value - low) / (high - low)).clamp(-0.01, 1.01);
    let mut svg = format!(
        "<svg class=\"plot\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{name} over time\">\n"
    );
    for &(from, to) in axis.shaded_s {
        let (left, right) = (axis.x(from), axis.x(to));
        let _ = writeln!(
            svg,
            "<rect class=\"lost\" x=\"{}\" y=\"{TOP}\" width=\"{}\" height=\"{}\"/>",
            coordinate(left),
            coordinate((right - left).max(1.0)),
            BOTTOM - TOP
        );
    }
    for value in multiples(low, high, step) {
        let at = coordinate(y(value));
        let _ = writeln!(
            svg,
            "<line class=\"grid\" x1=\"{LEFT}\" y1=\"{at}\" x2=\"{RIGHT}\" y2=\"{at}\"/>\
             <text text-anchor=\"end\" x=\"{}\" y=\"{}\">{}</text>",
            LEFT - 8.0,
            coordinate(y(value) + 5.0),
            label(value, step)
        );
    }
    let (unit, seconds) = axis.unit();
    let step = round_step(axis.span_s / seconds, 6.0);
    for value in multiples(0.0, axis.span_s / seconds, step) {
        let at = axis.x(value * seconds);
        let _ = writeln!(
            svg,
            "<line class=\"grid\" x1=\"{0}\" y1=\"{TOP}\" x2=\"{0}\" y2=\"{BOTTOM}\"/>\
             <text text-anchor=\"middle\" x=\"{0}\" y=\"{1}\">{2}</text>",
            coordinate(at),
            BOTTOM + 18.0,
            label(value, step)
        );
    }
    let _ = writeln!(
        svg,
        "<line class=\"base\" x1=\"{LEFT}\" y1=\"{BOTTOM}\" x2=\"{RIGHT}\" y2=\"{BOTTOM}\"/>\
         <text text-anchor=\"middle\" x=\"{}\" y=\"{}\">time ({unit})</text>",
        coordinate(0.5 * (LEFT + RIGHT)),
        HEIGHT - 7.0
    );
    for line in series {
        let points =
            axis.times_s.iter().zip(&line.values).map(|(&t, value)| {
                value.filter(|v| v.is_finite() && t.is_finite()).map(|v| (axis.x(t), y(v)))
            });
        let _ = writeln!(svg, "<path class=\"line {}\" d=\"{}\"/>", line.class, outline(points));
    }
    svg + "</svg>"
}

/// Minimum, maximum and step of the vertical axis.
fn vertical(series: &[Series<'_>], range: Range) -> (f64, f64, f64) {
    let values = || {
        series
            .iter()
            .flat_map(|s| s.values.iter().copied().flatten())
            .filter(|v| v.is_finite() && v.abs() < 1e15)
    };
    let (mut low, mut high) =
        values().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if low > high {
        (low, high) = (0.0, 1.0);
    }
    match range {
        Range::FromZero => {
            low = 0.0;
            high = if high > 0.0 { high * 1.04 } else { 1.0 };
        }
        Range::Around(least) => {
            let least = least.max(1e-9 * (low.abs() + high.abs()));
            let missing = 0.5 * (least - (high - low)).max(0.0);
            let margin = 0.05 * (high - low);
            (low, high) = (low - missing - margin, high + missing + margin);
        }
    }
    (low, high, round_step(high - low, 5.0))
}

/// A polyline through the points, interrupted at `None`. Columns with many points are reduced to
/// their first, minimum, maximum and last, which looks the same.
fn outline(points: impl Iterator<Item = Option<(f64, f64)>> + Clone) -> String {
    let dense = points.clone().count() > 2 * COLUMNS;
    let column = |x: f64| ((x - LEFT) / (RIGHT - LEFT) * COLUMNS as f64) as i64;
    let mut d = String::new();
    let mut pen_down = false;
    let mut gathered: Vec<(f64, f64)> = vec![];
    let mut draw = |gathered: &mut Vec<(f64, f64)>, pen_down: &mut bool| {
        for (x, y) in standing_for(gathered) {
            let (x, y) = (coordinate(x), coordinate(y));
            // A line of zero length draws a dot for a single point between gaps.
            let _ = if *pen_down { write!(d, "L{x} {y}") } else { write!(d, "M{x} {y}h0") };
            *pen_down = true;
        }
        gathered.clear();
    };
    for point in points {
        let full = match (point, gathered.last()) {
            (None, _) => true,
            (Some(next), Some(last)) => !dense || column(next.0) != column(last.0),
            (Some(_), None) => false,
        };
        if full {
            draw(&mut gathered, &mut pen_down);
        }
        match point {
            Some(next) => gathered.push(next),
            None => pen_down = false,
        }
    }
    draw(&mut gathered, &mut pen_down);
    d
}

fn standing_for(gathered: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let by_y = |a: &usize, b: &usize| gathered[*a].1.total_cmp(&gathered[*b].1);
    let mut keep = vec![0, gathered.len().saturating_sub(1)];
    keep.extend((0..gathered.len()).min_by(by_y));
    keep.extend((0..gathered.len()).max_by(by_y));
    keep.sort_unstable();
    keep.dedup();
    keep.into_iter().filter_map(|index| gathered.get(index).copied()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plot_of_an_hour_is_small_and_keeps_spikes() {
        let times: Vec<f64> = (0..108_000).map(|k| f64::from(k) / 30.0).collect();
        let values: Vec<_> =
            (0..108_000).map(|k| Some(if k == 54_321 { 9.0 } else { (0.01 * f64::from(k)).sin() })).collect();
        let axis = TimeAxis::new(&times, &[]);
        let svg = plot("x", &axis, &[Series { class: "a", values }], Range::Around(0.1));
        assert!(svg.len() < 80_000, "{}", svg.len());
        let top = coordinate(BOTTOM - (BOTTOM - TOP) * (9.0 + 1.0 + 0.5) / 11.0);
        assert!(svg.contains(&format!(" {top}L")), "the spike at {top}");
    }

    #[test]
    fn lines_are_interrupted_at_missing_values() {
        let times: Vec<f64> = (0..9).map(f64::from).collect();
        let values = (0..9).map(|k| (k != 4).then_some(f64::from(k))).collect();
        let axis = TimeAxis::new(&times, &[(4.0, 5.0)]);
        let svg = plot("x", &axis, &[Series { class: "a", values }], Range::FromZero);
        let d = svg.split("class=\"line a\" d=\"").nth(1).unwrap();
        assert_eq!(d.split('"').next().unwrap().matches('M').count(), 2);
        assert!(svg.contains("class=\"lost\""));
    }

    #[test]
    fn non_finite_values_are_not_drawn() {
        let axis = TimeAxis::new(&[0.0, f64::NAN, 1.0], &[]);
        let values = vec![Some(f64::INFINITY), Some(1.0), Some(f64::NAN)];
        let svg = plot("x", &axis, &[Series { class: "a", values }], Range::Around(0.0));
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        plot("x", &TimeAxis::new(&[], &[]), &[], Range::FromZero);
    }
}
