//! The measured quantities and their tolerances.

use odograph::numerics::median;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Direction of improvement of a measure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Better {
    /// Smaller is better.
    Lower,
    /// Larger is better.
    Higher,
    /// Closer to this target is better, as a ratio.
    Near(f64),
    /// Informative only; explains changes of other results.
    Shown,
}

/// One measured quantity.
#[derive(Debug, Clone, Copy)]
pub struct Measure {
    /// Its key in the JSON file.
    pub key: &'static str,
    /// Its title in tables.
    pub title: &'static str,
    /// Number of decimals in tables.
    pub decimals: usize,
    /// Direction of improvement.
    pub better: Better,
    /// Relative tolerance for deterioration, as a fraction of the baseline.
    pub relative: f64,
    /// Absolute tolerance for deterioration, in the measure's unit; added to the relative one. With
    /// [`Better::Near`] it is a difference of natural logarithms.
    pub absolute: f64,
}

impl Measure {
    const fn new(key: &'static str, title: &'static str, decimals: usize, better: Better) -> Self {
        Self { key, title, decimals, better, relative: 0.0, absolute: 0.0 }
    }

    const fn within(self, relative: f64, absolute: f64) -> Self {
        Self { relative, absolute, ..self }
    }
}

/// All measures in the order of the tables, with their tolerances.
///
/// Except for times, the same program gives the same results. Any change of the program, and the
/// last bits of the C library's functions on another platform, act as a new random draw of a
/// trajectory's error. The tolerances cover the variation between such draws, measured by a run
/// with 396 corners instead of 400; the comments below give its results.
pub const MEASURES: [Measure; 14] = [
    // One seed of 4 m: mostly within 20 %, up to a factor of 2 on concrete and `tilt-unknown`.
    Measure::new("drift_percent", "error over each metre, %", 4, Better::Lower).within(0.6, 0.001),
    Measure::new("heading_deg_per_m", "heading, °/m", 4, Better::Lower).within(0.7, 0.001),
    // A single draw: up to a factor of 11, but within its estimated standard deviation; see
    // `DRAWS_ALLOWED`.
    Measure::new("end_mm", "at the end, mm", 2, Better::Lower).within(1.0, 0.15),
    // The estimated standard deviation of `end_mm`: within 11 %. NEES measures its consistency.
    Measure::new("end_sigma_mm", "stated σ, mm", 2, Better::Lower).within(0.25, 0.03),
    // Absolute trajectory error of a real recording: within 9 %; see `LOOSE` for the exception.
    Measure::new("ate_mm", "ATE, mm", 2, Better::Lower).within(0.15, 0.05),
    // 0.5 percentage points, i.e. half a frame in a hundred.
    Measure::new("posed_percent", "posed, %", 1, Better::Higher).within(0.0, 0.5),
    Measure::new("lost", "times lost", 0, Better::Lower).within(0.0, 0.5),
    // Three degrees of freedom of a single trajectory: a new draw changes the logarithm by about
    // 0.8. The expected value is 3 for a consistent covariance.
    Measure::new("nees", "NEES", 2, Better::Near(3.0)).within(0.0, 1.2),
    Measure::new("restarts", "begun again", 0, Better::Shown),
    Measure::new("frame_ms", "a frame, ms", 2, Better::Shown),
    Measure::new("reference_ms", "reference, ms", 2, Better::Shown),
    // Processors differ in what vectors, caches and single operations cost.
    Measure::new("frame_ratio", "a frame, × reference", 2, Better::Lower).within(0.5, 0.1),
    // The slowest percent of the frames are keyframes, and frames during other load of the machine.
    Measure::new("p99_ratio", "p99 / mean", 1, Better::Lower).within(0.8, 1.0),
    // Of the whole process: the clips that are processed in parallel, and their tracking.
    Measure::new("peak_memory_mb", "most memory, MB", 0, Better::Lower).within(0.4, 30.0),
];

/// Keys of the measures that depend on the machine and on its other load.
pub const TIMES: [&str; 2] = ["frame_ratio", "p99_ratio"];

/// Additional tolerance for the error at the end, in estimated standard deviations.
pub const DRAWS_ALLOWED: f64 = 1.5;

/// Rows whose results depend on single frames, with the factor on their tolerances.
///
/// `floor_flight`: blurred frames near the floor determine the rest of the trajectory. With 396
/// corners, 58 mm and five losses became 129 mm and three losses, at twice the time per frame.
const LOOSE: [(&str, f64); 1] = [("floor_flight", 10.0)];

/// Factor on the tolerances of a row.
pub fn looseness(row: &str) -> f64 {
    LOOSE.iter().find(|(name, _)| *name == row).map_or(1.0, |(_, factor)| *factor)
}

/// The measure with that key.
pub fn measure(key: &str) -> Option<&'static Measure> {
    MEASURES.iter().find(|measure| measure.key == key)
}

/// Results by the key of their measure. A row has only the measures that apply to it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Figures(pub BTreeMap<String, f64>);

impl Figures {
    /// Adds a result; values that are not finite are left out.
    pub fn set(&mut self, key: &str, value: f64) {
        debug_assert!(measure(key).is_some(), "{key} is no measure");
        if value.is_finite() {
            self.0.insert(key.to_owned(), value);
        }
    }

    /// The result with that key.
    pub fn get(&self, key: &str) -> Option<f64> {
        self.0.get(key).copied()
    }

    /// Takes over the times of another measurement of the same row that are shorter.
    pub fn keep_shorter_times(&mut self, other: &Self) {
        for key in TIMES {
            let shorter = self.get(key).into_iter().chain(other.get(key)).reduce(f64::min);
            shorter.into_iter().for_each(|time| self.set(key, time));
        }
    }

    /// Aggregates over seeds: sums of losses and restarts, medians of all others, rounded to four
    /// digits.
    pub fn over_seeds(all: &[Self]) -> Self {
        let mut figures = Self::default();
        for measure in &MEASURES {
            let mut values: Vec<f64> = all.iter().filter_map(|one| one.get(measure.key)).collect();
            let Some(usual) = median(&mut values) else { continue };
            let counted = matches!(measure.key, "lost" | "restarts");
            let value = if counted { values.iter().sum() } else { usual };
            figures.set(measure.key, four_digits(value));
        }
        figures
    }
}

/// Rounds to four significant digits.
fn four_digits(value: f64) -> f64 {
    format!("{value:.3e}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_has_medians_over_seeds_and_summed_losses() {
        let one = |drift, lost| {
            let mut figures = Figures::default();
            figures.set("drift_percent", drift);
            figures.set("lost", lost);
            figures
        };
        let over = Figures::over_seeds(&[one(3.0, 1.0), one(1.0, 0.0), one(2.000_049, 4.0)]);
        assert_eq!((over.get("drift_percent"), over.get("lost")), (Some(2.0), Some(5.0)));
    }
}
