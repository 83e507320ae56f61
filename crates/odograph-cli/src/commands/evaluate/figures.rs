//! The result as JSON for programs: metres, radians, seconds; units are in the names.

use crate::console;
use odograph::error::Result;
use odograph::evaluation::{Delta, Evaluation, EvaluationOptions, SegmentDrift, Statistics};
use serde::Serialize;
use std::path::Path;

#[derive(Serialize)]
struct EvaluationFigures<'a> {
    estimate: String,
    truth: String,
    alignment: AlignmentFigures,
    max_time_difference_s: f64,
    estimate_poses: usize,
    truth_poses: usize,
    compared_poses: usize,
    time_covered: Option<f64>,
    estimate_length_m: f64,
    truth_length_m: f64,
    scale: Option<f64>,
    final_position_error_m: f64,
    final_heading_error_rad: f64,
    absolute: Errors<'a>,
    relative: Vec<RelativeFigures<'a>>,
    drift: &'a [SegmentDrift],
}

#[derive(Serialize)]
struct AlignmentFigures {
    kind: String,
    scale: f64,
    rotation_xyzw: [f64; 4],
    translation_m: [f64; 3],
    rotation_determined: bool,
}

#[derive(Serialize)]
struct Errors<'a> {
    translation_m: &'a Statistics,
    rotation_rad: &'a Statistics,
}

#[derive(Serialize)]
struct RelativeFigures<'a> {
    delta: f64,
    delta_unit: &'static str,
    all_pairs: bool,
    #[serde(flatten)]
    errors: Errors<'a>,
}

/// Prints the whole document.
pub fn print_json(estimate: &Path, truth: &Path, options: &EvaluationOptions, e: &Evaluation) -> Result<()> {
    let movement = &e.alignment.truth_from_estimate;
    let relative = e.relative.iter().map(|r| {
        let (delta, delta_unit) = match r.delta {
            Delta::Frames(count) => (count as f64, "frames"),
            Delta::Metres(length_m) => (length_m, "m"),
        };
        let errors = Errors { translation_m: &r.translation, rotation_rad: &r.rotation };
        RelativeFigures { delta, delta_unit, all_pairs: options.all_pairs, errors }
    });
    let figures = EvaluationFigures {
        estimate: estimate.display().to_string(),
        truth: truth.display().to_string(),
        alignment: AlignmentFigures {
            kind: options.alignment.to_string(),
            scale: e.alignment.scale,
            rotation_xyzw: movement.rotation.coords.into(),
            translation_m: movement.translation.vector.into(),
            rotation_determined: e.alignment.rotation_determined,
        },
        max_time_difference_s: options.max_time_difference_s,
        estimate_poses: e.estimate_poses,
        truth_poses: e.truth_poses,
        compared_poses: e.pairs.len(),
        time_covered: e.time_covered,
        estimate_length_m: e.estimate_length_m,
        truth_length_m: e.truth_length_m,
        scale: e.scale,
        final_position_error_m: e.final_position_error_m,
        final_heading_error_rad: e.final_heading_error_rad,
        absolute: Errors { translation_m: &e.absolute.translation, rotation_rad: &e.absolute.rotation },
        relative: relative.collect(),
        drift: &e.drift,
    };
    console::print_json("the result", &figures)
}
