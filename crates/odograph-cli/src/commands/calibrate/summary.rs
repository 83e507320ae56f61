//! The summary on the terminal: the verdict first, then where to look and what to do next.

use super::CalibrationResult;
use super::focal_length::focal_px;
use super::output::CalibrationOutput;
use crate::console::{self, quoted};
use crate::report::calibration::{lens_name, pixels_text};
use odograph::drawing::scale::label;
use odograph_calibration::{Calibration, Verdict};
use std::fmt::Write;

/// The summary of a calibration.
pub fn text(calibrated: &CalibrationResult, output: &CalibrationOutput) -> String {
    let calibration = &calibrated.calibration;
    let verdict = match calibration.verdict {
        Verdict::Good => "Good",
        Verdict::Usable => "Usable",
        Verdict::DoItAgain => "Do it again",
    };
    let found = &calibrated.search.found;
    let mut text = format!(
        "{verdict}: {} from {} views ({} on views held out), expected error of a ray {}; board found in {} of {} {}\n",
        pixels_text(calibration.rms_px),
        calibration.views_used(),
        pixels_text(calibration.hold_out_rms_px),
        pixels_text(calibration.expected_error_over_image_px()),
        found.with_board,
        found.looked_at,
        if calibrated.search.pictures.is_empty() { "frames" } else { "pictures" },
    );
    for reason in calibration.reasons.iter().take(3) {
        let _ = writeln!(text, "  · {reason}");
    }
    let _ = writeln!(text, "{}", lens(calibration));
    if let Some(bent) = &calibrated.bent {
        let _ = writeln!(
            text,
            "With the board's bend estimated: {}, expected error {}: {} (--bent-board makes it the result)",
            pixels_text(bent.rms_px),
            pixels_text(bent.expected_error_over_image_px()),
            console::name(output.bent_board_file())
        );
    }
    // Most important first; the report has them all.
    let hints: Vec<String> = calibrated.guidance.missing.iter().take(3).map(ToString::to_string).collect();
    if calibration.verdict != Verdict::Good && !hints.is_empty() {
        let _ = writeln!(text, "Next time: {}", hints.join("; "));
    }
    let _ = writeln!(text, "Look at {}", console::name(output.report_page()));
    let camera = quoted(output.camera_file());
    match calibration.verdict {
        Verdict::DoItAgain => {
            let _ = writeln!(text, "{camera} has been written nevertheless");
        }
        _ => {
            let _ = writeln!(
                text,
                "Next: odograph ground floor.jpg --board {} --camera {camera} -o rig.toml\n      odograph run drive.mp4 --camera {camera} --rig rig.toml -o drive/",
                calibrated.board
            );
        }
    }
    text
}

/// Focal length and principal point, to the digits that their deviations leave, and the lens model.
fn lens(calibration: &Calibration) -> String {
    let (camera, (focal_px, deviation_px)) = (&calibration.camera, focal_px(calibration));
    let (fx, fy) = camera.focal_px();
    let deviation_of =
        |name: &str| calibration.parameters.iter().find(|p| p.name == name).map_or(0.0, |p| p.deviation);
    let step = |deviation: f64| if deviation < 0.05 { 0.01 } else { 0.1 };
    let middle_deviation_px = deviation_of("cx").max(deviation_of("cy"));
    let (focal_step, middle_step) = (step(deviation_px), step(middle_deviation_px));
    let down =
        if fx == fy { String::new() } else { format!(" and {}", label(focal_px * fy / fx, focal_step)) };
    format!(
        "focal length {}{down} ± {} px, principal point {}, {} ± {} px; {}",
        label(focal_px, focal_step),
        label(deviation_px, focal_step),
        label(camera.principal_px().0, middle_step),
        label(camera.principal_px().1, middle_step),
        label(middle_deviation_px, middle_step),
        lens_name(calibration.model)
    )
}

/// The figures of a calibration for other programs, on one line.
pub fn json(calibrated: &CalibrationResult, output: &CalibrationOutput) -> String {
    let (calibration, found) = (&calibrated.calibration, &calibrated.search.found);
    let parameters: serde_json::Map<String, serde_json::Value> = calibration
        .parameters
        .iter()
        .map(|p| (p.name.to_owned(), serde_json::json!({ "value": p.value, "deviation": p.deviation })))
        .collect();
    let left_out: Vec<_> = calibration
        .views
        .iter()
        .zip(&calibrated.names)
        .filter(|(view, _)| !view.used)
        .map(|(view, (_, name))| serde_json::json!({ "view": name, "why": view.why_not }))
        .collect();
    let bent_board = calibrated.bent.as_ref().map(|bent| {
        serde_json::json!({
            "file": output.bent_board_file().display().to_string(),
            "rms_px": bent.rms_px,
            "expected_error_px": bent.expected_error_over_image_px(),
        })
    });
    let [find, solve] = calibrated.times.map(|time| time.as_secs_f64());
    let figures = serde_json::json!({
        "verdict": calibration.verdict.to_string(),
        "reasons": calibration.reasons,
        "model": calibration.model.name(),
        "looked_at": found.looked_at,
        "with_board": found.with_board,
        "views_given": calibration.views.len(),
        "views_used": calibration.views_used(),
        "left_out": left_out,
        "rms_px": calibration.rms_px,
        "hold_out_rms_px": calibration.hold_out_rms_px,
        "expected_error_px": calibration.expected_error_over_image_px(),
        "parameters": parameters,
        "bent_board": bent_board,
        "missing": calibrated.guidance.missing.iter().map(ToString::to_string).collect::<Vec<_>>(),
        "seconds": { "find": find, "solve": solve },
    });
    format!("{figures}\n")
}
