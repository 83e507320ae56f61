//! The baseline of stored results, and the comparison of new results with it.

use crate::figures::{Better, DRAWS_ALLOWED, Figures, Measure, TIMES, looseness, measure};
use odograph::error::{Error, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Results of one row.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RowFigures {
    /// Name of the row.
    pub name: String,
    /// First seed.
    pub first_seed: u64,
    /// Number of seeds over which the results are aggregated.
    pub seeds: u64,
    /// The results.
    pub figures: Figures,
}

/// A row that could not be measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Skipped {
    /// Name of the row.
    pub name: String,
    /// The reason.
    pub reason: String,
}

/// Results of one run of the gate.
#[derive(Debug, Clone, Default, Serialize)]
pub struct GateResults {
    /// The rows, in the order of the table.
    pub rows: Vec<RowFigures>,
    /// Results that concern the whole process.
    pub process: Figures,
    /// Rows whose data is not available.
    pub skipped: Vec<Skipped>,
    /// Rows that ended with an error.
    pub failed: Vec<Skipped>,
}

/// The results that new ones are compared with.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Baseline {
    /// The rows, in the order of the table.
    pub rows: Vec<RowFigures>,
    /// Results that concern the whole process.
    pub process: Figures,
}

impl GateResults {
    /// Writes the results as JSON.
    pub fn write(&self, path: &Path) -> Result<()> {
        write(self, path)
    }
}

impl Baseline {
    /// Reads a baseline. A missing file is an empty baseline; one that cannot be parsed is an
    /// error.
    pub fn read_or_empty(path: &Path) -> Result<Self> {
        if !path.exists() {
            return Ok(Self::default());
        }
        let with_path = |error: &dyn std::fmt::Display| Error::input(format!("{}: {error}", path.display()));
        let text = std::fs::read_to_string(path).map_err(|error| with_path(&error))?;
        serde_json::from_str(&text).map_err(|error| with_path(&error))
    }

    /// Returns the baseline with the measured rows replaced.
    pub fn updated(mut self, measured: &GateResults) -> Self {
        for new in &measured.rows {
            match self.rows.iter_mut().find(|old| old.name == new.name) {
                Some(old) => *old = new.clone(),
                None => self.rows.push(new.clone()),
            }
        }
        self.process.0.extend(measured.process.0.clone());
        self
    }

    /// Writes the baseline as JSON.
    pub fn write(&self, path: &Path) -> Result<()> {
        write(self, path)
    }
}

fn write(value: &impl Serialize, path: &Path) -> Result<()> {
    let with_path = |error: &dyn std::fmt::Display| Error::output(format!("{}: {error}", path.display()));
    let text = serde_json::to_string_pretty(value).map_err(|error| with_path(&error))?;
    std::fs::write(path, text + "\n").map_err(|error| with_path(&error))
}

/// Outcome of comparing one result with its baseline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BaselineVerdict {
    /// Within the tolerance.
    Same,
    /// Worse by more than the tolerance.
    Worse,
    /// Better by more than the tolerance.
    Better,
}

/// A result that differs from the baseline by more than its tolerance.
#[derive(Debug, Clone, PartialEq)]
pub struct ResultChange {
    /// Name of the row; `process` for results of the whole process.
    pub row: String,
    /// Key of the measure.
    pub key: &'static str,
    /// Value in the baseline; `None` if it has none.
    pub old: Option<f64>,
    /// The measured value; `None` if it is missing.
    pub new: Option<f64>,
    /// Outcome of the comparison.
    pub verdict: BaselineVerdict,
}

/// Comparison of a run of the gate with the baseline.
#[derive(Debug, Clone, Default)]
pub struct Comparison {
    /// Number of rows without a result that is worse.
    pub passed: usize,
    /// Number of rows with at least one result that is worse.
    pub worse: usize,
    /// Number of rows that are not in the baseline with the same seeds.
    pub not_compared: usize,
    /// All results that are better or worse.
    pub changes: Vec<ResultChange>,
}

impl Comparison {
    /// Compares row by row.
    pub fn new(baseline: &Baseline, measured: &GateResults) -> Self {
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
            match changes.iter().any(|change| change.verdict == BaselineVerdict::Worse) {
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

    /// Names of the rows that are worse in nothing but their times.
    pub fn only_slower(&self) -> Vec<&str> {
        let mut worse: BTreeMap<&str, bool> = BTreeMap::new();
        for change in self.changes.iter().filter(|change| change.verdict == BaselineVerdict::Worse) {
            *worse.entry(&change.row).or_insert(true) &= TIMES.contains(&change.key);
        }
        worse.into_iter().filter_map(|(row, only_times)| only_times.then_some(row)).collect()
    }

    /// Whether no result is worse.
    pub fn is_passed(&self) -> bool {
        !self.changes.iter().any(|change| change.verdict == BaselineVerdict::Worse)
    }
}

/// The results of a row that are better or worse. One that exists only in the baseline counts as
/// worse.
fn changes(row: &str, old: &Figures, new: &Figures) -> Vec<ResultChange> {
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
            _ => BaselineVerdict::Worse,
        };
        if verdict != BaselineVerdict::Same {
            changes.push(ResultChange { row: row.to_owned(), key: measure.key, old, new, verdict });
        }
    }
    changes
}

/// Compares one result with its baseline, according to the tolerance of its measure.
pub fn verdict(measure: &Measure, old: f64, new: f64) -> BaselineVerdict {
    let (cost, allowed): (fn(f64, f64) -> f64, f64) = match measure.better {
        Better::Shown => return BaselineVerdict::Same,
        Better::Lower => (|value, _| value, measure.relative * old.abs() + measure.absolute),
        Better::Higher => (|value, _| -value, measure.relative * old.abs() + measure.absolute),
        Better::Near(_) => (|value, target| (value / target).max(1e-9).ln().abs(), measure.absolute),
    };
    let target = if let Better::Near(target) = measure.better { target } else { 0.0 };
    let grown = cost(new, target) - cost(old, target);
    // A relative tolerance of 1.5 allows growth by a factor of 2.5. The inverse factor, 1 / 2.5, is
    // a decrease by less than the baseline itself.
    let shrunk = match measure.better {
        Better::Lower => (measure.relative / (1.0 + measure.relative)) * old.abs() + measure.absolute,
        _ => allowed,
    };
    if grown > allowed {
        BaselineVerdict::Worse
    } else if -grown > shrunk {
        BaselineVerdict::Better
    } else {
        BaselineVerdict::Same
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
        Comparison::new(&baseline, &GateResults { rows: vec![row("asphalt", new)], ..GateResults::default() })
    }

    #[test]
    fn a_result_beyond_its_tolerance_fails_the_gate() {
        let same = compared(&[("drift_percent", 0.1)], &[("drift_percent", 0.11)]);
        assert!(same.is_passed() && same.changes.is_empty() && same.passed == 1);
        let worse = compared(&[("drift_percent", 0.1)], &[("drift_percent", 0.17)]);
        assert!(!worse.is_passed() && worse.worse == 1);
        assert!(!compared(&[("posed_percent", 100.0)], &[("posed_percent", 99.0)]).is_passed());
        assert!(!compared(&[("lost", 0.0)], &[("lost", 1.0)]).is_passed());
    }

    #[test]
    fn a_row_that_is_only_slower_is_known_and_keeps_its_shorter_times() {
        let slower = compared(&[("p99_ratio", 3.0), ("lost", 0.0)], &[("p99_ratio", 9.0), ("lost", 0.0)]);
        assert_eq!(slower.only_slower(), ["asphalt"]);
        let wrong_too = compared(&[("p99_ratio", 3.0), ("lost", 0.0)], &[("p99_ratio", 9.0), ("lost", 1.0)]);
        assert!(wrong_too.only_slower().is_empty());
        let mut figures = row("asphalt", &[("p99_ratio", 9.0), ("frame_ratio", 1.0), ("lost", 1.0)]).figures;
        let again = [("p99_ratio", 3.0), ("frame_ratio", 2.0), ("lost", 0.0)];
        figures.keep_shorter_times(&row("asphalt", &again).figures);
        let kept = [("p99_ratio", 3.0), ("frame_ratio", 1.0), ("lost", 1.0)];
        assert_eq!(figures, row("asphalt", &kept).figures);
    }

    #[test]
    fn missing_results_fail_and_informative_ones_never_do() {
        assert!(!compared(&[("nees", 3.0)], &[]).is_passed());
        assert!(compared(&[("frame_ms", 1.0)], &[("frame_ms", 100.0)]).is_passed());
    }

    #[test]
    fn nees_may_approach_its_target_from_both_sides() {
        for (old, new) in [(0.1, 3.0), (90.0, 3.0)] {
            let comparison = compared(&[("nees", old)], &[("nees", new)]);
            assert_eq!(comparison.changes[0].verdict, BaselineVerdict::Better);
            assert!(!compared(&[("nees", new)], &[("nees", old)]).is_passed());
        }
    }

    #[test]
    fn rows_with_other_seeds_are_not_compared() {
        let baseline = Baseline { rows: vec![row("asphalt", &[("lost", 0.0)])], ..Baseline::default() };
        let other = RowFigures { seeds: 5, ..row("asphalt", &[("lost", 9.0)]) };
        let comparison =
            Comparison::new(&baseline, &GateResults { rows: vec![other], ..GateResults::default() });
        assert!(comparison.is_passed() && comparison.not_compared == 1);
    }
}
