//! Output of a run's result, as text or JSON.

use crate::console;
use odograph::error::Result;
use odograph::trajectory::LostStretch;
use odograph_report::{because, lost_stretches};
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
    let lost = losses(&lost_stretches(&outcome.trajectory), "the report lists");
    lost.iter().for_each(|line| console::note(line));
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

/// Says when and why tracking was lost, in a line each; `elsewhere` says where the rest is listed.
pub fn losses(stretches: &[LostStretch], elsewhere: &str) -> Vec<String> {
    let line = |stretch: &LostStretch| {
        format!("lost from {:.2} to {:.2} s: {}", stretch.from_s, stretch.to_s, because(stretch))
    };
    let more = stretches.len().saturating_sub(MAX_LOSSES);
    let more = (more > 0).then(|| format!("and {more} more losses, which {elsewhere}"));
    stretches.iter().take(MAX_LOSSES).map(line).chain(more).collect()
}
