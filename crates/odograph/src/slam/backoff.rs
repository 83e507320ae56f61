//! Exponential back-off for an expensive search that keeps failing.

/// Exponential back-off for an expensive search: after every failure in a row twice as many
/// opportunities are skipped.
#[derive(Debug, Default)]
pub struct Backoff {
    failures: u32,
    to_skip: u32,
}

/// Maximum number of doublings: at most 31 opportunities are skipped. On a kilometre of 2500
/// keyframes, 92 registrations of whole images without back-off found no loop.
const MAX_DOUBLINGS: u32 = 5;

impl Backoff {
    /// Whether to search at this opportunity.
    pub fn is_due(&mut self) -> bool {
        let rest = self.to_skip.checked_sub(1);
        self.to_skip = rest.unwrap_or(0);
        rest.is_none()
    }

    /// Records whether the search succeeded.
    pub fn record(&mut self, succeeded: bool) {
        self.failures = if succeeded { 0 } else { (self.failures + 1).min(MAX_DOUBLINGS) };
        self.to_skip = (1 << self.failures) - 1;
    }
}
