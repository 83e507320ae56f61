//! How long poses take, from capture on.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// What the page shows is of the last so many seconds.
const WINDOW: Duration = Duration::from_secs(5);

/// Latencies of all frames, and of the last seconds.
#[derive(Debug, Default)]
pub struct Latencies {
    all_ms: Vec<f32>,
    recent: VecDeque<(Instant, f32)>,
}

impl Latencies {
    /// Takes the latency of a frame that was finished now.
    pub fn add(&mut self, latency: Duration) -> f64 {
        let ms = 1e3 * latency.as_secs_f64();
        self.all_ms.push(ms as f32);
        self.recent.push_back((Instant::now(), ms as f32));
        ms
    }

    /// Frames a second, median and 99th percentile in milliseconds of the last seconds.
    pub fn recent(&mut self) -> (f64, f64, f64) {
        while self.recent.front().is_some_and(|(at, _)| at.elapsed() > WINDOW) {
            self.recent.pop_front();
        }
        let ms: Vec<f32> = self.recent.iter().map(|(_, ms)| *ms).collect();
        let span = self.recent.front().map_or(0.0, |(at, _)| at.elapsed().as_secs_f64());
        let fps = if span > 0.2 { ms.len() as f64 / span } else { 0.0 };
        let [median, p99, _] = quantiles(ms);
        (fps, median, p99)
    }

    /// Median, 99th percentile and most of all frames, milliseconds.
    pub fn overall(&self) -> [f64; 3] {
        quantiles(self.all_ms.clone())
    }
}

/// Median, 99th percentile and most; zeros of nothing.
fn quantiles(mut values: Vec<f32>) -> [f64; 3] {
    values.sort_unstable_by(f32::total_cmp);
    let at = |share: f64| {
        let rank = (share * values.len() as f64).ceil() as usize;
        values.get(rank.saturating_sub(1)).map_or(0.0, |ms| f64::from(*ms))
    };
    [at(0.5), at(0.99), at(1.0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_a_hundred_and_of_nothing() {
        assert_eq!(quantiles((1..=100).rev().map(|k| k as f32).collect()), [50.0, 99.0, 100.0]);
        assert_eq!(quantiles(vec![]), [0.0; 3]);
    }
}
