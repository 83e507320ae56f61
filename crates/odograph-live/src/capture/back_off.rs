//! Longer and longer pauses between attempts to reach what has gone.

use std::time::Duration;

/// The pause after the first failure.
const FIRST: Duration = Duration::from_millis(250);
/// The longest pause.
const LONGEST: Duration = Duration::from_secs(8);

/// How long to wait before the next attempt, and how long it was tried in all.
#[derive(Debug)]
pub(super) struct BackOff {
    next: Duration,
    spent: Duration,
    patience: Duration,
}

impl BackOff {
    /// Attempts go on until so much time has been spent waiting.
    pub fn new(patience: Duration) -> Self {
        Self { next: FIRST, spent: Duration::ZERO, patience }
    }

    /// The pause before the next attempt; `None` where it is time to give up.
    pub fn pause(&mut self) -> Option<Duration> {
        if self.spent >= self.patience {
            return None;
        }
        let pause = self.next.min(self.patience - self.spent);
        self.spent += pause;
        self.next = (2 * self.next).min(LONGEST);
        Some(pause)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_and_end_when_patience_does() {
        let mut back_off = BackOff::new(Duration::from_secs(30));
        let pauses: Vec<f64> = std::iter::from_fn(|| back_off.pause()).map(|p| p.as_secs_f64()).collect();
        assert_eq!(pauses, [0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 8.0, 6.25]);
        assert!(BackOff::new(Duration::ZERO).pause().is_none());
    }
}
