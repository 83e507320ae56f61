//! The figures of all kills, as `bench/kills.json`.

use crate::moment::EndingSignal;
use crate::trial::TrialReport;
use odograph::error::{Error, Result};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

/// The figures of one command.
#[derive(Debug, Default, Serialize)]
pub struct VictimFigures {
    /// Times that SIGKILL hit it while it ran.
    pub killed: u64,
    /// Times that SIGTERM or SIGINT hit it while it ran.
    pub interrupted: u64,
    /// Times that it had ended before the signal.
    pub ended_before: u64,
    /// Times that the signal came within its first 150 ms.
    pub early: u64,
    /// Maps that were opened and checked afterwards.
    pub maps_checked: u64,
    /// Keyframes that were on disk before the signal, and were looked for afterwards.
    pub keyframes_checked: u64,
    /// Frames that were on disk before the signal, and were looked for afterwards.
    pub frames_checked: u64,
    /// Files under their final names that were checked for being complete.
    pub files_checked: u64,
    /// Times that the command was run again and went on.
    pub run_again: u64,
    /// Checks that failed.
    pub failed: u64,
}

/// The figures of all commands.
#[derive(Debug, Serialize)]
pub struct KillFigures {
    /// Seed of the moments.
    pub seed: u64,
    /// By name of the command.
    pub commands: BTreeMap<String, VictimFigures>,
}

impl KillFigures {
    pub fn new(seed: u64) -> Self {
        Self { seed, commands: BTreeMap::new() }
    }

    /// Adds what one kill showed.
    pub fn add(&mut self, name: &str, report: TrialReport) {
        let figures = self.commands.entry(name.to_owned()).or_default();
        match (report.ended_before, report.moment.signal) {
            (true, _) => figures.ended_before += 1,
            (false, EndingSignal::Kill) => figures.killed += 1,
            (false, _) => figures.interrupted += 1,
        }
        figures.early += u64::from(!report.ended_before && report.moment.after.as_millis() < 150);
        figures.maps_checked += report.maps;
        figures.keyframes_checked += report.keyframes;
        figures.frames_checked += report.frames;
        figures.files_checked += report.files;
        figures.run_again += u64::from(report.ran_again);
        figures.failed += report.failures.len() as u64;
    }

    /// Whether no check failed.
    pub fn is_clean(&self) -> bool {
        self.commands.values().all(|figures| figures.failed == 0)
    }

    /// A line about a command.
    pub fn line(&self, name: &str) -> Option<String> {
        let figures = self.commands.get(name)?;
        Some(format!(
            "{name:16} {:4} killed, {:4} interrupted, {:4} had ended; {} checks failed",
            figures.killed, figures.interrupted, figures.ended_before, figures.failed
        ))
    }

    /// Writes the figures as JSON.
    pub fn write(&self, path: &Path) -> Result<()> {
        let failed = |error: &dyn std::fmt::Display| Error::output(format!("{}: {error}", path.display()));
        let text = serde_json::to_string_pretty(self).map_err(|error| failed(&error))?;
        std::fs::write(path, text + "\n").map_err(|error| failed(&error))
    }
}
