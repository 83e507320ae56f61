//! Output of a run's result, as text or JSON.

use crate::console;
use odograph::error::Result;
use odograph_session::{RunEnd, RunOutcome};

/// Prints the result and where to look.
pub fn tell(outcome: &RunOutcome, quiet: bool, json: bool) -> Result<()> {
    let statistics = &outcome.statistics;
    if json {
        console::print(&format!("{}\n", statistics.json()?))?;
    } else if !quiet {
        let page = outcome.folder.join("report.html");
        console::print(&format!("{}Look at {}\n", statistics.summary(), page.display()))?;
    }
    if quiet {
        return Ok(());
    }
    for warning in &outcome.warnings {
        console::warn(warning);
    }
    if let Some(interruption) = statistics.interruption() {
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
