//! The result as a table for people.

use crate::console::name;
use odograph::evaluation::{Evaluation, EvaluationOptions, Statistics};
use odograph::formats::decimal::Rounded;
use std::fmt::Write;
use std::path::Path;

/// The whole table; metres and degrees. `over_ground_m` are the lengths of the true and the
/// estimated path without changes of height.
pub fn text(
    estimate: &Path,
    truth: &Path,
    options: &EvaluationOptions,
    e: &Evaluation,
    over_ground_m: Option<[f64; 2]>,
) -> String {
    let mut out = summary(estimate, truth, options, e, over_ground_m);
    errors(e, &mut out);
    drift(e, &mut out);
    out
}

/// Lines about the two paths as wholes.
fn summary(
    estimate: &Path,
    truth: &Path,
    options: &EvaluationOptions,
    e: &Evaluation,
    over_ground_m: Option<[f64; 2]>,
) -> String {
    let mut out = String::new();
    let [estimate, truth] = [estimate, truth].map(name);
    let _ = writeln!(out, "{estimate} against {truth}, alignment {}", options.alignment);
    let share = 100.0 * e.pairs.len() as f64 / e.truth_poses as f64;
    let covered =
        e.time_covered.map_or(String::new(), |part| format!(", over {:.1} % of its time", 100.0 * part));
    let _ = writeln!(
        out,
        "poses    {} estimated, {} true, {} compared ({share:.1} % of the true ones{covered})",
        e.estimate_poses,
        e.truth_poses,
        e.pairs.len()
    );
    let _ = writeln!(
        out,
        "path     {:.3} m true, {:.3} m estimated, ups and downs included",
        e.truth_length_m, e.estimate_length_m
    );
    if let Some([truth_m, estimate_m]) = over_ground_m {
        let _ = writeln!(out, "         {truth_m:.3} m true, {estimate_m:.3} m estimated over the ground");
    }
    let scale = match e.scale {
        Some(scale) => {
            format!("truth is {scale:.6} times the estimate ({:+.3} %)", Rounded(100.0 * (scale - 1.0)))
        }
        None => "not determined by these paths".to_owned(),
    };
    let _ = writeln!(out, "scale    {scale}");
    let of_path = if e.truth_length_m > 0.0 {
        format!(" ({:.3} % of the path)", 100.0 * e.final_position_error_m / e.truth_length_m)
    } else {
        String::new()
    };
    let _ = writeln!(
        out,
        "at end   position {:.6} m off{of_path}, heading {:+.4}° off, with the first poses aligned",
        e.final_position_error_m,
        Rounded(e.final_heading_error_rad.to_degrees())
    );
    if !e.alignment.rotation_determined {
        let _ = writeln!(
            out,
            "note     the positions do not determine the rotation (a straight path, or none); the first \
             orientations do"
        );
    }
    for delta in
        options.deltas.iter().filter(|&&delta| e.relative.iter().all(|relative| relative.delta != delta))
    {
        let _ = writeln!(out, "note     the path has no stretch of {delta}");
    }
    out
}

/// Absolute and relative errors.
fn errors(e: &Evaluation, out: &mut String) {
    let _ = writeln!(
        out,
        "\n{:<30}{:>12}{:>12}{:>12}{:>12}{:>12}{:>12}{:>8}",
        "error", "rmse", "mean", "median", "std", "min", "max", "count"
    );
    row(out, "absolute position (m)", &e.absolute.translation, 1.0);
    row(out, "absolute rotation (°)", &e.absolute.rotation, DEGREES);
    for relative in &e.relative {
        row(out, &format!("position over {} (m)", relative.delta), &relative.translation, 1.0);
        row(out, &format!("rotation over {} (°)", relative.delta), &relative.rotation, DEGREES);
    }
}

/// Mean errors over each length of path.
fn drift(e: &Evaluation, out: &mut String) {
    if !e.drift.is_empty() {
        let _ = writeln!(
            out,
            "\n{:<30}{:>14}{:>14}{:>14}{:>14}{:>10}",
            "mean drift over each", "position %", "rotation °/m", "heading °/m", "bias °/m", "segments"
        );
        for drift in &e.drift {
            let _ = writeln!(
                out,
                "{:<30}{:>14.5}{:>14.5}{:>14.5}{:>+14.5}{:>10}",
                format!("{} m", drift.length_m),
                drift.translation_percent,
                drift.rotation_deg_per_m,
                drift.heading_deg_per_m,
                drift.heading_bias_deg_per_m,
                drift.segments
            );
        }
    }
}

const DEGREES: f64 = 180.0 / std::f64::consts::PI;

fn row(out: &mut String, name: &str, s: &Statistics, factor: f64) {
    let _ = write!(out, "{name:<30}");
    for value in [s.rmse, s.mean, s.median, s.std, s.min, s.max] {
        let _ = write!(out, "{:>12.6}", value * factor);
    }
    let _ = writeln!(out, "{:>8}", s.count);
}
