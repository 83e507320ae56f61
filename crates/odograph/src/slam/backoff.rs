//! Exponential back-off for an expensive search that keeps failing.

/// Exponential back-off for an expensive search: after every failure in a row twice as many
/// opportunities are skipped.
#[derive(Debug, Default)]
pub struct Patience {
    failures: u32,
    let_go_by: u32,
}

/// Maximum number of doublings of the skipped opportunities.
const MOST_DOUBLINGS: u32 = 5;

impl Patience {
    /// Whether to search at this opportunity.
    pub fn is_worth_it(&mut self) -> bool {
        let rest = self.let_go_by.checked_sub(1);
        self.let_go_by = rest.unwrap_or(0);
        rest.is_none()
    }

    /// Records whether the search succeeded.
    pub fn learn(&mut self, succeeded: bool) {
        self.failures = if succeeded { 0 } else { (self.failures + 1).min(MOST_DOUBLINGS) };
        self.let_go_by = (1 << self.failures) - 1;
    }
}
