//! Times of frames that have only arrival times.
//!
//! A camera takes pictures evenly; networks and buffers deliver them in bursts, some of them a
//! millisecond apart. The time of frame n is modelled as t₀ + n T, and its arrival is later by a
//! delay that varies but is never negative. T is the slope of a line fitted to the last arrivals,
//! and the model follows their lower envelope: the frames with the least delay.

use std::collections::VecDeque;

/// Arrivals that determine the period: several bursts of a network.
const WINDOW: usize = 120;
/// Number of frames and seconds that the window must span before the period is estimated; until
/// then the period is taken to be no shorter than [`SHORTEST_PERIOD_S`].
const MIN_FRAMES: usize = 12;
const MIN_SPAN_S: f64 = 1.0;
const SHORTEST_PERIOD_S: f64 = 1.0 / 60.0;
/// A frame that arrives later than this after the one before it, in seconds and in periods, was not
/// delayed: frames between them are missing.
const LONGEST_DELAY_S: f64 = 0.7;
const LONGEST_DELAY_PERIODS: f64 = 4.0;
/// Number of frames over which the least delay is taken, and the share of it corrected with each
/// frame. More frames and a smaller share give a steadier clock, which follows a change of the
/// delay more slowly.
const ENVELOPE: usize = 30;
const CORRECTED: f64 = 0.1;
/// The share where a frame would be stamped after its arrival, which is impossible and so corrected
/// sooner.
const CORRECTED_BACK: f64 = 0.3;
/// Smallest interval between two stamps, in periods, and the largest without a missing frame.
const MIN_STEP: f64 = 0.5;
const MAX_STEP: f64 = 2.0;

/// Fewest steps that show bursts, and the fraction of them that is then shorter than this fraction
/// of the mean: frames of a network come a few milliseconds apart in bursts of two and more, those
/// of a camera that lost half of its frames in no less than half of the mean.
const FEWEST_STEPS: usize = 30;
const SHORT_STEPS: f64 = 0.25;
const SHORT_STEP: f64 = 0.125;

/// Whether times of frames, seconds, come in bursts, as those of arrivals do.
pub(crate) fn are_bursts(times_s: &[f64]) -> bool {
    let mut times_s: Vec<f64> = times_s.iter().copied().filter(|time_s| time_s.is_finite()).collect();
    times_s.sort_by(f64::total_cmp);
    let steps = times_s.windows(2).map(|pair| pair[1] - pair[0]);
    // Frames at the same time are copies, and those far apart have others missing between them.
    let steps: Vec<f64> = steps.filter(|step_s| *step_s > 0.0 && *step_s <= LONGEST_DELAY_S).collect();
    let mean_s = steps.iter().sum::<f64>() / steps.len() as f64;
    let short = steps.iter().filter(|step_s| **step_s < SHORT_STEP * mean_s).count();
    steps.len() >= FEWEST_STEPS && short as f64 >= SHORT_STEPS * steps.len() as f64
}

/// Clock of a camera that is known by the arrival of its frames.
#[derive(Debug, Default)]
pub struct ArrivalClock {
    /// Number of each frame, those that are missing counted, and its arrival, seconds.
    arrivals: VecDeque<(f64, f64)>,
    count: f64,
    /// Delays of the last frames against the model, seconds.
    delays_s: VecDeque<f64>,
    last_s: Option<f64>,
}

impl ArrivalClock {
    /// The time of a frame that arrived at `arrival_s`, seconds; times increase strictly.
    pub fn time_s(&mut self, arrival_s: f64) -> f64 {
        let Some(last_s) = self.last_s else { return self.begun_at(arrival_s) };
        let since_s = self.arrivals.back().map_or(0.0, |(_, before_s)| arrival_s - before_s);
        self.count += 1.0;
        self.arrivals.push_back((self.count, arrival_s));
        if self.arrivals.len() > WINDOW {
            self.arrivals.pop_front();
        }
        let (mut period_s, mut known) = self.period_s();
        let longest_s = LONGEST_DELAY_S.max(LONGEST_DELAY_PERIODS * period_s);
        let mut late_s = arrival_s - (last_s + period_s);
        if since_s > longest_s {
            // What was learned of the period stays.
            self.count += (late_s / period_s).round().max(0.0);
            if let Some(newest) = self.arrivals.back_mut() {
                newest.0 = self.count;
            }
            self.delays_s.clear();
            let time_s = arrival_s.max(last_s + MIN_STEP * period_s);
            self.last_s = Some(time_s);
            return time_s;
        }
        if late_s > longest_s {
            // The clock falls behind: the camera has slowed down, and only the newest arrivals
            // tell its period.
            self.arrivals.drain(..self.arrivals.len().saturating_sub(ENVELOPE));
            self.delays_s.clear();
            (period_s, known) = self.period_s();
            late_s = arrival_s - (last_s + period_s);
        }
        let time_s = if known {
            self.delays_s.push_back(late_s);
            if self.delays_s.len() > ENVELOPE {
                self.delays_s.pop_front();
            }
            let least_s = self.delays_s.iter().copied().fold(f64::INFINITY, f64::min);
            // A frame does not arrive before it is taken; a clock that is late is corrected slowly.
            let corrected = if least_s < 0.0 { CORRECTED_BACK } else { CORRECTED };
            let step_s = period_s + corrected * least_s;
            let step_s = step_s.clamp(MIN_STEP * period_s, MAX_STEP * period_s);
            self.delays_s.iter_mut().for_each(|delay_s| *delay_s -= step_s - period_s);
            last_s + step_s
        } else {
            arrival_s.max(last_s + period_s)
        };
        self.last_s = Some(time_s);
        time_s
    }

    fn begun_at(&mut self, arrival_s: f64) -> f64 {
        self.arrivals.push_back((0.0, arrival_s));
        self.last_s = Some(arrival_s);
        arrival_s
    }

    /// The slope of the line through the arrivals, and whether they determine it.
    fn period_s(&self) -> (f64, bool) {
        let count = self.arrivals.len() as f64;
        let mean = self.arrivals.iter().fold((0.0, 0.0), |sum, (n, s)| (sum.0 + n, sum.1 + s));
        let (mean_n, mean_s) = (mean.0 / count, mean.1 / count);
        let (mut product, mut square) = (0.0, 0.0);
        for (n, s) in &self.arrivals {
            product += (n - mean_n) * (s - mean_s);
            square += (n - mean_n).powi(2);
        }
        let slope_s = if square > 0.0 { product / square } else { 0.0 };
        let span_s = match (self.arrivals.front(), self.arrivals.back()) {
            (Some(first), Some(last)) => last.1 - first.1,
            _ => 0.0,
        };
        let known = self.arrivals.len() >= MIN_FRAMES && span_s >= MIN_SPAN_S && slope_s > 0.0;
        (if known { slope_s } else { slope_s.max(SHORTEST_PERIOD_S) }, known)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The steps of the times of frames that arrive like this, as multiples of the period.
    fn steps(period_s: f64, arrivals_s: impl IntoIterator<Item = f64>) -> Vec<f64> {
        let mut clock = ArrivalClock::default();
        let times: Vec<f64> = arrivals_s.into_iter().map(|arrival_s| clock.time_s(arrival_s)).collect();
        times.windows(2).map(|pair| (pair[1] - pair[0]) / period_s).collect()
    }

    /// Arrivals in bursts of `burst` frames 1 ms apart, behind the last of them.
    fn bursts(period_s: f64, burst: usize, count: usize) -> impl Iterator<Item = f64> {
        (0..count).map(move |n| {
            let last = (n / burst + 1) * burst - 1;
            last as f64 * period_s + 1e-3 * (n % burst) as f64 + 5e-3 * ((n / burst) % 3) as f64
        })
    }

    #[test]
    fn bursts_become_even_times() {
        for (period_s, burst) in [(1.0 / 30.0, 5), (0.04, 8), (0.1, 3), (1.0 / 60.0, 10)] {
            let steps = steps(period_s, bursts(period_s, burst, 600));
            // While the period is learned a step is that of a camera of sixty frames a second at
            // least.
            let learned = (2.0 / period_s) as usize;
            let least = steps.iter().copied().fold(f64::INFINITY, f64::min);
            assert!(least > 0.4 * SHORTEST_PERIOD_S / period_s, "{period_s} {burst}: {least}");
            for (n, step) in steps.iter().enumerate().skip(learned) {
                assert!((0.7..1.4).contains(step), "{period_s} {burst} {n}: {step}");
            }
            let rest = &steps[learned..];
            let mean = rest.iter().sum::<f64>() / rest.len() as f64;
            assert!((mean - 1.0).abs() < 0.02, "{period_s} {burst}: {mean}");
        }
    }

    #[test]
    fn bursts_are_told_from_lost_frames_and_pauses() {
        for (period_s, burst) in [(1.0 / 30.0, 5), (0.04, 8), (0.1, 2), (1.0 / 60.0, 10)] {
            let arrivals: Vec<f64> = bursts(period_s, burst, 100).collect();
            assert!(are_bursts(&arrivals), "{period_s} {burst}");
            assert!(!are_bursts(&arrivals[..FEWEST_STEPS]), "too few");
        }
        let kept = |keep: fn(usize) -> bool| -> Vec<f64> {
            (0..300).filter(|n| keep(*n)).map(|n| n as f64 / 30.0 + 1e-3 * (n * 7 % 5) as f64).collect()
        };
        for times_s in [kept(|_| true), kept(|n| n % 3 == 0), kept(|n| n * n % 7 < 2), kept(|n| n % 30 < 10)]
        {
            assert!(!are_bursts(&times_s), "{times_s:?}");
        }
        // Every image twice.
        let twice: Vec<f64> = (0..100).map(|n| f64::from(n / 2) * 0.05).collect();
        assert!(!are_bursts(&twice));
    }

    #[test]
    fn even_arrivals_stay_as_they_are() {
        let even = (0..300).map(|n| f64::from(n) * 0.05 + 1e-3 * f64::from(n * 7 % 5));
        for (n, step) in steps(0.05, even).iter().enumerate().skip(40) {
            assert!((step - 1.0).abs() < 0.1, "{n}: {step}");
        }
    }

    #[test]
    fn a_gap_is_a_gap_and_the_period_stays() {
        let arrivals = (0..200).map(|n| 0.04 * f64::from(n) + if n >= 100 { 3.0 } else { 0.0 });
        let steps = steps(0.04, arrivals);
        assert!((steps[99] - 76.0).abs() < 1.0, "{}", steps[99]);
        for (n, step) in steps.iter().enumerate().skip(100) {
            assert!((0.8..1.25).contains(step), "{n}: {step}");
        }
    }

    #[test]
    fn a_camera_that_slows_down_is_followed() {
        // In the dark a camera halves its rate; the clock ends where the arrivals are.
        let arrivals: Vec<f64> = (0..150)
            .map(|n| f64::from(n) / 30.0)
            .chain((0..300).map(|n| 5.0 + f64::from(n) / 15.0))
            .collect();
        let mut clock = ArrivalClock::default();
        let times: Vec<f64> = arrivals.iter().map(|arrival_s| clock.time_s(*arrival_s)).collect();
        assert!(times.windows(2).all(|pair| pair[1] - pair[0] > 0.5 / 30.0));
        let (late, arrived) = (times.last().unwrap(), arrivals.last().unwrap());
        assert!((late - arrived).abs() < 0.1, "{late} {arrived}");
    }
}
