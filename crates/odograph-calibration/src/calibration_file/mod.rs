//! Calibration files: a calibrated camera with its covariance and quality figures.
//!
//! The format is OpenCV FileStorage YAML. [`odograph::formats::camera_file::parse`] and every
//! program that reads OpenCV camera files read the camera and ignore the other keys.

use crate::{Board, Calibration};
use odograph::formats::camera_file;
use odograph::formats::decimal::decimal;
use std::fmt::Write;

/// Writes a calibration file. The output is deterministic: it has no date.
///
/// Besides the camera of [`camera_file::write`] it has the keys
///
/// * `lens_model`, `calibration_board`, `verdict`, `reasons`, `views_used`, `views_seen`,
///   `points_used`;
/// * `rms_px` and `hold_out_rms_px`: root mean square reprojection error in the views used and in
///   held-out views, pixels;
/// * `expected_error_px`: expected error of a ray over the image, from the covariance, without the
///   part that a camera rotation compensates, pixels;
/// * `parameter_names`, `parameter_values`, `parameter_deviations` (standard deviations) and
///   `parameter_covariance`.
pub fn write(calibration: &Calibration, board: &Board) -> String {
    let mut text = camera_file::write(&calibration.camera);
    let points: usize =
        calibration.views.iter().filter(|view| view.used).map(|view| view.residuals.len()).sum();
    let _ = writeln!(text, "lens_model: {}", quoted(calibration.model.name()));
    let _ = writeln!(text, "calibration_board: {}", quoted(&board.to_string()));
    let _ = writeln!(text, "verdict: {}", quoted(&calibration.verdict.to_string()));
    list(&mut text, "reasons", calibration.reasons.iter().map(String::as_str));
    let _ = writeln!(text, "views_used: {}", calibration.views_used());
    let _ = writeln!(text, "views_seen: {}", calibration.views.len());
    let _ = writeln!(text, "points_used: {points}");
    let _ = writeln!(text, "rms_px: {}", real(calibration.rms_px));
    let _ = writeln!(text, "hold_out_rms_px: {}", real(calibration.hold_out_rms_px));
    let _ = writeln!(text, "expected_error_px: {}", real(calibration.expected_error_over_image_px()));
    let parameters = &calibration.parameters;
    list(&mut text, "parameter_names", parameters.iter().map(|parameter| parameter.name));
    let values: Vec<f64> = parameters.iter().map(|parameter| parameter.value).collect();
    matrix(&mut text, "parameter_values", 1, &values);
    let deviations: Vec<f64> = parameters.iter().map(|parameter| parameter.deviation).collect();
    matrix(&mut text, "parameter_deviations", 1, &deviations);
    // nalgebra stores matrices by columns.
    let by_rows = calibration.covariance.transpose();
    matrix(&mut text, "parameter_covariance", by_rows.ncols(), by_rows.as_slice());
    text
}

/// A number as OpenCV's reader parses it, with YAML's literals for NaN and infinities.
fn real(value: f64) -> String {
    match value {
        v if v.is_nan() => ".Nan".into(),
        v if v == f64::INFINITY => ".Inf".into(),
        v if v == f64::NEG_INFINITY => "-.Inf".into(),
        v => decimal(v),
    }
}

/// A double-quoted string on one line: escapes quotes and backslashes, and replaces control
/// characters by spaces.
fn quoted(text: &str) -> String {
    let mut safe = String::from('"');
    for character in text.chars() {
        match character {
            '"' | '\\' => safe.extend(['\\', character]),
            c if c.is_control() => safe.push(' '),
            c => safe.push(c),
        }
    }
    safe.push('"');
    safe
}

fn list<'a>(text: &mut String, key: &str, items: impl Iterator<Item = &'a str>) {
    let items: Vec<String> = items.map(quoted).collect();
    if items.is_empty() {
        let _ = writeln!(text, "{key}: []");
        return;
    }
    let _ = writeln!(text, "{key}:");
    for item in items {
        let _ = writeln!(text, "   - {item}");
    }
}

fn matrix(text: &mut String, key: &str, rows: usize, data: &[f64]) {
    let numbers = data.iter().map(|&number| real(number)).collect::<Vec<_>>().join(", ");
    let columns = data.len().checked_div(rows).unwrap_or(0);
    let _ = writeln!(
        text,
        "{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {numbers} ]"
    );
}

#[cfg(test)]
mod tests;
