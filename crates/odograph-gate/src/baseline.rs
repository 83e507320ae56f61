//! The stored figures, and how new ones compare with them.

use crate::figures::{Better, DRAWS_ALLOWED, Figures, Measure, looseness, measure};
use odograph::error::{Error, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Figures of one row.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RowFigures {
    /// Name of the row.
    pub name: String,
    /// First of the seeds.
    pub first_seed: u64,
    /// How many seeds the figures are over.
    pub seeds: u64,
    /// The figures.
    pub figures: Figures,
}

/// A row that could not be measured, and why.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Skipped {
    /// Name of the row.
    pub name: String,
    /// Why.
    pub reason: String,
}

/// What one run of the gate measured.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Measured {
    /// The rows, in the order of the table.
    pub rows: Vec<RowFigures>,
    /// Figures of the whole process.
    pub process: Figures,
    /// Rows whose data is not there.
    pub skipped: Vec<Skipped>,
    /// Rows that ended with an error.
    pub failed: Vec<Skipped>,
}

/// The figures that new ones are compared with.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Baseline {
    /// The rows, in the order of the table.
    pub rows: Vec<RowFigures>,
    /// Figures of the whole process.
    pub process: Figures,
}

impl Measured {
    /// Writes the figures as JSON.
    pub fn write(&self, path: &Path) -> Result<()> {
        write(self, path)
    }
}

impl Baseline {
    /// Reads a baseline; one that does not exist is empty. Fails where it cannot be understood.
    pub fn read_or_empty(path: &Path) -> Result<Self> {
        if !path.exists() {
            return Ok(Self::default());
        }
        let told = |error: &dyn std::fmt::Display| Error::input(format!("{}: {error}", path.display()));
        let text = std::fs::read_to_string(path).map_err(|error| told(&error))?;
        serde_json::from_str(&text).map_err(|error| told(&error))
    }

    /// With the figures of the rows that were measured in place of the old ones.
    pub fn updated(mut self, measured: &Measured) -> Self {
        for new in &measured.rows {
            match self.rows.iter_mut().find(|old| old.name == new.name) {
                Some(old) => *old = new.clone(),
                None => self.rows.push(new.clone()),
            }
        }
        self.process.0.extend(measured.process.0.clone());
        self
    }

    /// Writes it as JSON.
    pub fn write(&self, path: &Path) -> Result<()> {
        write(self, path)
    }
}

fn write(value: &impl Serialize, path: &Path) -> Result<()> {
    let told = |error: &dyn std::fmt::Display| Error::output(format!("{}: {error}", path.display()));
    let text = serde_json::to_string_pretty(value).map_err(|error| told(&error))?;
    std::fs::write(path, text + "\n").map_err(|error| told(&error))
}

/// How a figure compares with its baseline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Within the tolerance.
    Same,
    /// Worse by more than the tolerance.
    Worse,
    /// Better by more than the tolerance.
    Better,
}

/// A figure that is not what it was.
#[derive(Debug, Clone, PartialEq)]
pub struct Change {
    /// Name of the row; of the whole process, `process`.
    pub row: String,
    /// Key of the measure.
    pub key: &'static str,
    /// The baseline's; `None` where it has none.
    pub old: Option<f64>,
    /// What was measured; `None` where the figure is gone.
    pub new: Option<f64>,
    /// What that means.
    pub verdict: Verdict,
}

/// How a run of the gate compares with the baseline.
#[derive(Debug, Clone, Default)]
pub struct Comparison {
    /// Rows with no figure that is worse.
    pub passed: usize,
    /// Rows with one at least.
    pub worse: usize,
    /// Rows that the baseline does not have with these seeds.
    pub not_compared: usize,
    /// Every figure that is better or worse.
    pub changes: Vec<Change>,
}

impl Comparison {
    /// Compares row by row.
    pub fn new(baseline: &Baseline, measured: &Measured) -> Self {
        let mut comparison = Self::default();
        for row in &measured.rows {
            let same_seeds = |old: &&RowFigures| {
                (&old.name, old.first_seed, old.seeds) == (&row.name, row.first_seed, row.seeds)
            };
            let Some(old) = baseline.rows.iter().find(same_seeds) else {
                comparison.not_compared += 1;
                continue;
            };
            let changes = changes(&row.name, &old.figures, &row.figures);
            match changes.iter().any(|change| change.verdict == Verdict::Worse) {
                true => comparison.worse += 1,
                false => comparison.passed += 1,
            }
            comparison.changes.extend(changes);
        }
        let shared: BTreeMap<String, f64> = baseline.process.0.clone();
        let kept = shared.into_iter().filter(|(key, _)| measured.process.0.contains_key(key)).collect();
        comparison.changes.extend(changes("process", &Figures(kept), &measured.process));
        comparison
    }

    /// Whether no figure is worse.
    pub fn is_passed(&self) -> bool {
        !self.changes.iter().any(|change| change.verdict == Verdict::Worse)
    }
}

/// The figures of a row that are better or worse. One that the baseline has and the run has not is
/// worse.
fn changes(row: &str, old: &Figures, new: &Figures) -> Vec<Change> {
    let mut changes = Vec::new();
    let factor = looseness(row);
    let sigma_mm = old.get("end_sigma_mm").unwrap_or(0.0);
    for measure in old.0.keys().filter_map(|key| measure(key)) {
        let draws = if measure.key == "end_mm" { DRAWS_ALLOWED * sigma_mm } else { 0.0 };
        let measure = &Measure {
            relative: factor * measure.relative,
            absolute: factor * measure.absolute + draws,
            ..*measure
        };
        let (old, new) = (old.get(measure.key), new.get(measure.key));
        let verdict = match (old, new) {
            (Some(old), Some(new)) => verdict(measure, old, new),
            _ => Verdict::Worse,
        };
        if verdict != Verdict::Same {
            changes.push(Change { row: row.to_owned(), key: measure.key, old, new, verdict });
        }
    }
    changes
}

/// Judges one figure by its tolerance.
pub fn verdict(measure: &Measure, old: f64, new: f64) -> Verdict {
    let (cost, allowed): (fn(f64, f64) -> f64, f64) = match measure.better {
        Better::Shown => return Verdict::Same,
        Better::Lower => (|value, _| value, measure.relative * old.abs() + measure.absolute),
        Better::Higher => (|value, _| -value, measure.relative * old.abs() + measure.absolute),
        Better::Near(_) => (|value, target| (value / target).max(1e-9).ln().abs(), measure.absolute),
    };
    let target = if let Better::Near(target) = measure.better { target } else { 0.0 };
    let grown = cost(new, target) - cost(old, target);
    // Worse by a factor of 2.5 is allowed for some; better by the same factor is less than the
    // whole of it.
    let shrunk = match measure.better {
        Better::Lower => (measure.relative / (1.0 + measure.relative)) * old.abs() + measure.absolute,
        _ => allowed,
    };
    if grown > allowed {
        Verdict::Worse
    } else if -grown > shrunk {
        Verdict::Better
    } else {
        Verdict::Same
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(name: &str, figures: &[(&str, f64)]) -> RowFigures {
        let figures = Figures(figures.iter().map(|&(key, value)| (key.to_owned(), value)).collect());
        RowFigures { name: name.to_owned(), first_seed: 0, seeds: 1, figures }
    }

    fn compared(old: &[(&str, f64)], new: &[(&str, f64)]) -> Comparison {
        let baseline = Baseline { rows: vec![row("asphalt", old)], ..Baseline::default() };
        Comparison::new(&baseline, &Measured { rows: vec![row("asphalt", new)], ..Measured::default() })
    }

    #[test]
    fn a_figure_beyond_its_tolerance_fails_the_gate() {
        let same = compared(&[("drift_percent", 0.1)], &[("drift_percent", 0.11)]);
        assert!(same.is_passed() && same.changes.is_empty() && same.passed == 1);
        let worse = compared(&[("drift_percent", 0.1)], &[("drift_percent", 0.17)]);
        assert!(!worse.is_passed() && worse.worse == 1);
        assert!(!compared(&[("posed_percent", 100.0)], &[("posed_percent", 99.0)]).is_passed());
        assert!(!compared(&[("lost", 0.0)], &[("lost", 1.0)]).is_passed());
    }

    #[test]
    fn a_figure_that_is_gone_fails_and_a_shown_one_never_does() {
        assert!(!compared(&[("nees", 3.0)], &[]).is_passed());
        assert!(compared(&[("frame_ms", 1.0)], &[("frame_ms", 100.0)]).is_passed());
    }

    #[test]
    fn a_stated_covariance_may_come_closer_to_the_truth_from_both_sides() {
        for (old, new) in [(0.1, 3.0), (90.0, 3.0)] {
            let comparison = compared(&[("nees", old)], &[("nees", new)]);
            assert_eq!(comparison.changes[0].verdict, Verdict::Better);
            assert!(!compared(&[("nees", new)], &[("nees", old)]).is_passed());
        }
    }

    #[test]
    fn rows_of_other_seeds_are_not_compared() {
        let baseline = Baseline { rows: vec![row("asphalt", &[("lost", 0.0)])], ..Baseline::default() };
        let other = RowFigures { seeds: 5, ..row("asphalt", &[("lost", 9.0)]) };
        let comparison = Comparison::new(&baseline, &Measured { rows: vec![other], ..Measured::default() });
        assert!(comparison.is_passed() && comparison.not_compared == 1);
    }
}
