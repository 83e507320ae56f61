//! What is measured of a row, and by how much it may change.

use odograph::numerics::median;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Which way a figure is better.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Better {
    /// Smaller is better.
    Lower,
    /// Larger is better.
    Higher,
    /// Closer to this is better, as a ratio.
    Near(f64),
    /// Only shown: it says why others changed.
    Shown,
}

/// One kind of figure.
#[derive(Debug, Clone, Copy)]
pub struct Measure {
    /// Its name in the JSON.
    pub key: &'static str,
    /// Its name in tables.
    pub title: &'static str,
    /// Digits after the point in tables.
    pub decimals: usize,
    /// Which way it is better.
    pub better: Better,
    /// What it may become worse by: this share of the baseline …
    pub relative: f64,
    /// … and this much more, in its own unit. With [`Better::Near`] this is a difference of
    /// logarithms.
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

/// All figures, in the order of the tables, with their tolerances.
///
/// The same program gives the same figures, but for times. Any change of it, and the C library's last
/// bits on another platform, draw the noise of a path anew; a tolerance is what that draw may change.
/// Measured with 396 corners instead of 400, which is no other program: what is said of each below.
pub const MEASURES: [Measure; 14] = [
    // One seed of four metres: mostly within 20 %, up to twice as much on concrete and `tilt-untold`.
    Measure::new("drift_percent", "error over each metre, %", 4, Better::Lower).within(0.6, 0.001),
    Measure::new("heading_deg_per_m", "heading, °/m", 4, Better::Lower).within(0.7, 0.001),
    // One draw: up to eleven times as much, but within its stated deviation; see `DRAWS_ALLOWED`.
    Measure::new("end_mm", "at the end, mm", 2, Better::Lower).within(1.0, 0.15),
    // What the program says of that, within 11 %; NEES says whether it is true.
    Measure::new("end_sigma_mm", "stated σ, mm", 2, Better::Lower).within(0.25, 0.03),
    // Absolute trajectory error of a real recording, within 9 %; see `LOOSE` for the exception.
    Measure::new("ate_mm", "ATE, mm", 2, Better::Lower).within(0.15, 0.05),
    // A fifth of a frame in a hundred: a frame more is lost where some are.
    Measure::new("posed_percent", "posed, %", 1, Better::Higher).within(0.0, 0.5),
    Measure::new("lost", "times lost", 0, Better::Lower).within(0.0, 0.5),
    // Three degrees of freedom of one piece: a new draw changes its logarithm by about 0.8; 3 is
    // true.
    Measure::new("nees", "NEES", 2, Better::Near(3.0)).within(0.0, 1.2),
    Measure::new("restarts", "begun again", 0, Better::Shown),
    Measure::new("frame_ms", "a frame, ms", 2, Better::Shown),
    // Shared machines: the reference is measured beside it, but caches and clocks change between
    // the two.
    Measure::new("frame_ratio", "a frame, × reference", 2, Better::Lower).within(0.5, 0.1),
    // The slowest of a hundred frames are keyframes, and whatever the machine did meanwhile.
    Measure::new("p99_ratio", "p99 / mean", 1, Better::Lower).within(0.8, 1.0),
    // Of the whole process: the clips of as many rows as there are threads, and what follows them.
    Measure::new("peak_memory_mb", "most memory, MB", 0, Better::Lower).within(0.4, 30.0),
    Measure::new("reference_ms", "reference, ms", 2, Better::Shown),
];

/// So many stated standard deviations the error at the end may grow by beyond its tolerance.
pub const DRAWS_ALLOWED: f64 = 1.5;

/// Rows whose figures hang on single frames, and by what their tolerances are multiplied.
///
/// `floor_flight`: blurred frames near the floor decide what follows; 58 mm and five losses became 129 mm
/// and three with 396 corners, and a frame cost twice as much.
const LOOSE: [(&str, f64); 1] = [("floor_flight", 10.0)];

/// What the tolerances of a row are multiplied by.
pub fn looseness(row: &str) -> f64 {
    LOOSE.iter().find(|(name, _)| *name == row).map_or(1.0, |(_, factor)| *factor)
}

/// The measure of that key.
pub fn measure(key: &str) -> Option<&'static Measure> {
    MEASURES.iter().find(|measure| measure.key == key)
}

/// Figures by the key of their measure; a row has those that make sense for it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Figures(pub BTreeMap<String, f64>);

impl Figures {
    /// Adds a figure; what is not finite is left out.
    pub fn set(&mut self, key: &str, value: f64) {
        debug_assert!(measure(key).is_some(), "{key} is no measure");
        if value.is_finite() {
            self.0.insert(key.to_owned(), value);
        }
    }

    /// The figure of that key.
    pub fn get(&self, key: &str) -> Option<f64> {
        self.0.get(key).copied()
    }

    /// Each figure's median over seeds, to four digits; of losses and restarts the sum.
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

/// Rounded to four significant digits: what a person compares.
fn four_digits(value: f64) -> f64 {
    format!("{value:.3e}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_has_the_median_over_seeds_and_the_sum_of_losses() {
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
