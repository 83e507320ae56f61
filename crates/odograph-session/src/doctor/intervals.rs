//! The times of frames: rate, gaps, jitter.

use odograph::numerics::median;

/// A longer interval than this many usual ones is a gap: a single frame is missing.
const GAP_INTERVALS: f64 = 1.7;

/// What the times of consecutive frames show.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intervals {
    /// The median interval, seconds.
    pub usual_s: f64,
    /// Number of gaps.
    pub gaps: usize,
    /// The longest gap, seconds; 0 without one.
    pub longest_gap_s: f64,
    /// Root mean square deviation of the other intervals from the usual one, as a fraction of it.
    pub jitter: f64,
}

impl Intervals {
    /// Of increasing times, seconds; `None` for fewer than three.
    pub fn new(times_s: &[f64]) -> Option<Self> {
        let steps_s: Vec<f64> = times_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let usual_s = median(&mut steps_s.clone()).filter(|usual_s| *usual_s > 0.0 && steps_s.len() > 1)?;
        let is_gap = |step_s: &f64| *step_s > GAP_INTERVALS * usual_s;
        let gaps: Vec<f64> = steps_s.iter().copied().filter(is_gap).collect();
        let squares: f64 = steps_s
            .iter()
            .filter(|step_s| !is_gap(step_s))
            .map(|step_s| (step_s / usual_s - 1.0).powi(2))
            .sum();
        Some(Self {
            usual_s,
            gaps: gaps.len(),
            longest_gap_s: gaps.into_iter().fold(0.0, f64::max),
            jitter: (squares / steps_s.len() as f64).sqrt(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_no_jitter() {
        let found = Intervals::new(&[0.0, 0.1, 0.2, 0.3, 1.3, 1.4]).unwrap();
        assert!((found.usual_s - 0.1).abs() < 1e-9 && found.jitter < 1e-9, "{found:?}");
        assert_eq!((found.gaps, found.longest_gap_s), (1, 1.3 - 0.3));
        assert!(Intervals::new(&[0.0, 0.1, 0.22, 0.3]).unwrap().jitter > 0.1);
        assert_eq!(Intervals::new(&[0.0, 0.1]), None);
    }
}
