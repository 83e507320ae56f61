//! Exponential backoff between attempts to reconnect.

use std::time::Duration;

/// The pause after the first failure: short, for a connection that is back at once.
const FIRST: Duration = Duration::from_millis(250);
/// The longest pause: longer disturbs the network less, shorter finds the camera sooner.
const LONGEST: Duration = Duration::from_secs(8);

/// State of the backoff: the next pause and the total time waited.
#[derive(Debug)]
pub(super) struct BackOff {
    next: Duration,
    spent: Duration,
    patience: Duration,
}

impl BackOff {
    /// Allows attempts until a total of `patience` has been waited.
    pub fn new(patience: Duration) -> Self {
        Self { next: FIRST, spent: Duration::ZERO, patience }
    }

    /// The pause before the next attempt; `None` if it is time to give up.
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
    fn pauses_double_up_to_the_limit_of_total_time() {
        let mut back_off = BackOff::new(Duration::from_secs(30));
        let pauses: Vec<f64> = std::iter::from_fn(|| back_off.pause()).map(|p| p.as_secs_f64()).collect();
        assert_eq!(pauses, [0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 8.0, 6.25]);
        assert!(BackOff::new(Duration::ZERO).pause().is_none());
    }
}
