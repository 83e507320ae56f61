//! Output of a run's result, as text or JSON.

use crate::console;
use odograph::error::Result;
use odograph_report::{LostStretch, lost_stretches};
use odograph_session::{RunEnd, RunOutcome};

/// Prints the result and where to look.
pub fn print_summary(outcome: &RunOutcome, quiet: bool, json: bool) -> Result<()> {
    let statistics = &outcome.statistics;
    if json {
        console::print(&format!("{}\n", statistics.json()?))?;
    } else if !quiet {
        let page = outcome.folder.join("report.html");
        console::print(&format!("{}Look at {}\n", statistics.summary(), console::name(page)))?;
    }
    if quiet {
        return Ok(());
    }
    tell_warnings(outcome, "");
    losses(&lost_stretches(&outcome.trajectory));
    if let Some(interruption) = statistics.stopped_early() {
        console::warn(&format!("{interruption}; what there is up to there has been written"));
    }
    if outcome.end == RunEnd::TrackingFailed {
        console::error(&format!(
            "the movement could not be measured in {} of {} frames; the report says where and why",
            statistics.frames - statistics.frames_with_pose,
            statistics.frames
        ));
    }
    Ok(())
}

/// Tells the warnings of a run, each after `place`. What was found and used is nothing to be warned
/// of.
pub fn tell_warnings(outcome: &RunOutcome, place: &str) {
    let statistics = &outcome.statistics;
    let readout = statistics.readout.as_ref().filter(|readout| readout.is_known());
    let found = [
        statistics.mount.as_ref().map(|mount| mount.sentence()),
        readout.and_then(|readout| readout.sentence()),
    ];
    for warning in &outcome.warnings {
        let text = format!("{place}{warning}");
        if found.iter().flatten().any(|found| found == warning) {
            console::note(&text);
        } else {
            console::warn(&text);
        }
    }
}

/// Number of losses that are listed one by one.
const MAX_LOSSES: usize = 5;

/// Tells when and why tracking was lost.
fn losses(stretches: &[LostStretch]) {
    for stretch in stretches.iter().take(MAX_LOSSES) {
        console::note(&format!(
            "lost from {:.2} to {:.2} s: {}",
            stretch.from_s,
            stretch.to_s,
            stretch.because()
        ));
    }
    if stretches.len() > MAX_LOSSES {
        console::note(&format!("and {} more losses, which the report lists", stretches.len() - MAX_LOSSES));
    }
}
