//! A histogram of durations, whose memory does not grow with their number.

use serde::Serialize;
use std::time::Duration;

/// Durations in classes of 1 %. Sum and maximum are exact.
#[derive(Debug, Clone, Default)]
pub struct Timings {
    /// Counts of the classes up to the longest duration.
    counts: Vec<u64>,
    count: u64,
    sum: Duration,
    most: Duration,
}

/// Classes for each doubling: each is 1.1 % wide.
const CLASSES: f64 = 64.0;

impl Timings {
    /// Adds a duration.
    pub fn push(&mut self, duration: Duration) {
        let class = class_of(duration);
        if self.counts.len() <= class {
            self.counts.resize(class + 1, 0);
        }
        self.counts[class] += 1;
        self.count += 1;
        self.sum += duration;
        self.most = self.most.max(duration);
    }

    /// Mean, milliseconds; zero if empty.
    pub fn mean_ms(&self) -> f64 {
        ms(self.sum) / self.count.max(1) as f64
    }

    /// Maximum, milliseconds; zero if empty.
    pub fn most_ms(&self) -> f64 {
        ms(self.most)
    }

    /// Quantile, milliseconds, to 0.5 %; zero if empty.
    pub fn quantile_ms(&self, share: f64) -> f64 {
        let rank = ((share * self.count as f64).ceil() as u64).clamp(1, self.count.max(1));
        let mut below = 0;
        let class = self.counts.iter().position(|count| {
            below += count;
            below >= rank
        });
        let middle = |class: usize| 1e-6 * ((class as f64 + 0.5) / CLASSES).exp2();
        class.map_or(0.0, |class| middle(class).min(self.most_ms()))
    }

    /// Number of durations above this one, to 1 %.
    pub fn longer_than(&self, duration: Duration) -> u64 {
        self.counts.iter().skip(class_of(duration) + 1).sum()
    }
}

/// Processing times of a stage.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct StageTime {
    /// Mean over all frames, milliseconds.
    pub mean_ms: f64,
    /// 99th percentile, milliseconds.
    pub p99_ms: f64,
}

impl StageTime {
    pub(crate) fn of(timings: &Timings) -> Self {
        Self { mean_ms: timings.mean_ms(), p99_ms: timings.quantile_ms(0.99) }
    }
}

fn class_of(duration: Duration) -> usize {
    (CLASSES * (duration.as_nanos().max(1) as f64).log2()) as usize
}

fn ms(duration: Duration) -> f64 {
    1e3 * duration.as_secs_f64()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thousand_durations_and_none() {
        let mut timings = Timings::default();
        (1..=1000).rev().for_each(|k| timings.push(Duration::from_millis(k)));
        let near = |value: f64, expected: f64| (value / expected - 1.0).abs() < 0.006;
        assert!(near(timings.quantile_ms(0.5), 500.0), "{}", timings.quantile_ms(0.5));
        assert!(near(timings.quantile_ms(0.99), 990.0), "{}", timings.quantile_ms(0.99));
        assert_eq!((timings.mean_ms(), timings.most_ms()), (500.5, 1000.0));
        assert_eq!(timings.quantile_ms(1.0), 1000.0);
        let longer = timings.longer_than(Duration::from_millis(800));
        assert!((192..=200).contains(&longer), "{longer}");
        let none = Timings::default();
        assert_eq!((none.quantile_ms(0.99), none.mean_ms(), none.most_ms()), (0.0, 0.0, 0.0));
    }
}
