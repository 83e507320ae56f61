//! Latency of poses, from capture on.

use crate::timings::Timings;
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Averaging window of the page, seconds.
const WINDOW: Duration = Duration::from_secs(5);

/// Latencies of all frames, and of the last seconds.
#[derive(Debug, Default)]
pub struct Latencies {
    all: Timings,
    recent: VecDeque<(Instant, Duration)>,
}

impl Latencies {
    /// Adds the latency of a frame that was finished now. Returns it in milliseconds.
    pub fn add(&mut self, latency: Duration) -> f64 {
        self.all.push(latency);
        self.recent.push_back((Instant::now(), latency));
        self.forget();
        1e3 * latency.as_secs_f64()
    }

    /// Frames per second, median and 99th percentile in milliseconds over the last seconds.
    pub fn recent(&mut self) -> (f64, f64, f64) {
        self.forget();
        let mut timings = Timings::default();
        self.recent.iter().for_each(|(_, latency)| timings.push(*latency));
        let span = self.recent.front().map_or(0.0, |(at, _)| at.elapsed().as_secs_f64());
        let fps = if span > 0.2 { self.recent.len() as f64 / span } else { 0.0 };
        (fps, timings.quantile_ms(0.5), timings.quantile_ms(0.99))
    }

    /// Median, 99th percentile and maximum over all frames, milliseconds.
    pub fn overall(&self) -> [f64; 3] {
        [self.all.quantile_ms(0.5), self.all.quantile_ms(0.99), self.all.most_ms()]
    }

    fn forget(&mut self) {
        while self.recent.front().is_some_and(|(at, _)| at.elapsed() > WINDOW) {
            self.recent.pop_front();
        }
    }
}
