//! Summaries of many errors.

use serde::Serialize;

/// What is told of a set of errors, in the errors' unit (its square for `sse`).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Statistics {
    /// How many errors there are.
    pub count: usize,
    /// Root of the mean square.
    pub rmse: f64,
    /// Mean.
    pub mean: f64,
    /// The middle one; the mean of the middle two of an even count.
    pub median: f64,
    /// Standard deviation about the mean, of the whole population (divided by the count).
    pub std: f64,
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
    /// Sum of squares.
    pub sse: f64,
}

impl Statistics {
    /// The summary of finite errors; `None` without any.
    pub fn of(errors: &[f64]) -> Option<Self> {
        let mut sorted = errors.to_vec();
        sorted.sort_by(f64::total_cmp);
        let (&min, &max) = (sorted.first()?, sorted.last()?);
        let count = errors.len() as f64;
        let mean = errors.iter().sum::<f64>() / count;
        let sse = errors.iter().map(|e| e * e).sum::<f64>();
        let variance = errors.iter().map(|e| (e - mean) * (e - mean)).sum::<f64>() / count;
        let middle = sorted.len() / 2;
        let median =
            if sorted.len() % 2 == 1 { sorted[middle] } else { 0.5 * (sorted[middle - 1] + sorted[middle]) };
        Some(Self {
            count: errors.len(),
            rmse: (sse / count).sqrt(),
            mean,
            median,
            std: variance.sqrt(),
            min,
            max,
            sse,
        })
    }
}
