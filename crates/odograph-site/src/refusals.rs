//! What the site has refused, for its log and its page. Nothing of it is a token.

use crate::limits::Rate;
use serde_json::{Value, json};
use std::net::IpAddr;
use std::time::{Duration, Instant};

/// Number of refusals that are known; of more, those that are oldest are forgotten.
const MAX_REFUSALS: usize = 64;
/// Longest reason that is kept, characters: it may contain what was sent.
const MAX_REASON: usize = 300;
/// Pause before a refusal that comes again is logged again.
const LOGGED_EVERY: Duration = Duration::from_secs(60);
/// Lines of the log at once, and per second in the long run.
const LINES_AT_ONCE: f64 = 32.0;
const LINES_PER_S: f64 = 0.5;

/// Why a request is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RefusalKind {
    /// There is no token.
    NoToken,
    /// The token is unknown.
    UnknownToken,
    /// The token may not do this.
    Forbidden,
    /// The tokens cannot be read.
    Unreadable,
    /// The token was revoked.
    Revoked,
    /// A page of another site sends it.
    Origin,
    /// There are too many of them.
    Flood,
    /// What it contains is malformed, or contradicts what is stored.
    Content,
}

/// A refused request.
#[derive(Debug, Clone, PartialEq)]
pub struct Refusal {
    pub kind: RefusalKind,
    /// The robot whose token it has, or that sends records.
    pub robot: Option<String>,
    pub reason: String,
}

/// The refusals of a site.
#[derive(Debug)]
pub struct Refusals {
    entries: Vec<Counted>,
    lines: Rate,
}

#[derive(Debug)]
struct Counted {
    refusal: Refusal,
    from: IpAddr,
    count: u64,
    last: Instant,
    logged: Option<(Instant, u64)>,
}

impl Refusals {
    /// None yet.
    pub fn new(now: Instant) -> Self {
        Self { entries: Vec::new(), lines: Rate::new(LINES_AT_ONCE, now) }
    }

    /// Counts a refusal; of those of the same kind, robot and address the last reason is kept.
    pub fn add(&mut self, refusal: &Refusal, from: IpAddr, now: Instant) {
        let plain = refusal.reason.chars().filter(|letter| !letter.is_control());
        let refusal = Refusal { reason: plain.take(MAX_REASON).collect(), ..refusal.clone() };
        let same = |known: &&mut Counted| {
            (known.refusal.kind, &known.refusal.robot, known.from) == (refusal.kind, &refusal.robot, from)
        };
        if let Some(known) = self.entries.iter_mut().find(same) {
            known.refusal.reason = refusal.reason;
            known.count += 1;
            known.last = now;
            return;
        }
        if self.entries.len() >= MAX_REFUSALS
            && let Some(oldest) = (0..self.entries.len()).min_by_key(|&index| self.entries[index].last)
        {
            self.entries.swap_remove(oldest);
        }
        self.entries.push(Counted { refusal, from, count: 1, last: now, logged: None });
    }

    /// Lines for the log: each refusal when it is new, and every minute while it goes on.
    pub fn new_lines(&mut self, now: Instant) -> Vec<String> {
        let mut lines = Vec::new();
        for entry in &mut self.entries {
            let before = match entry.logged {
                Some((at, count)) if entry.count == count || now < at + LOGGED_EVERY => continue,
                Some((_, count)) => count,
                None => 0,
            };
            if !self.lines.take(LINES_PER_S, LINES_AT_ONCE, now) {
                break;
            }
            entry.logged = Some((now, entry.count));
            let times = match entry.count - before {
                1 => String::new(),
                times => format!(", {times} times"),
            };
            lines.push(format!("refused a request from {}{times}: {}", entry.from, entry.refusal.reason));
        }
        lines
    }

    /// For the page, the last one first.
    pub fn page(&self, now: Instant) -> Value {
        let mut entries: Vec<&Counted> = self.entries.iter().collect();
        entries.sort_by_key(|entry| std::cmp::Reverse(entry.last));
        let of = |entry: &&Counted| {
            json!({
                "robot": entry.refusal.robot,
                "address": entry.from.to_string(),
                "reason": entry.refusal.reason,
                "count": entry.count,
                "ago_s": now.saturating_duration_since(entry.last).as_secs(),
            })
        };
        entries.iter().map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(robot: &str, reason: &str) -> Refusal {
        Refusal { kind: RefusalKind::Content, robot: Some(robot.to_owned()), reason: reason.to_owned() }
    }

    #[test]
    fn refusals_are_counted_and_logged_once_a_minute() {
        let start = Instant::now();
        let after = |seconds: u64| start + Duration::from_secs(seconds);
        let from = IpAddr::from([10, 0, 0, 7]);
        let mut refusals = Refusals::new(start);
        refusals.add(&refusal("a", "a record\u{1b}[2J is cut off"), from, start);
        assert_eq!(refusals.new_lines(start), ["refused a request from 10.0.0.7: a record[2J is cut off"]);
        for _ in 0..5 {
            refusals.add(&refusal("a", "a record is too large"), from, after(1));
        }
        assert!(refusals.new_lines(after(59)).is_empty());
        assert_eq!(
            refusals.new_lines(after(61)),
            ["refused a request from 10.0.0.7, 5 times: a record is too large"]
        );
        assert!(refusals.new_lines(after(200)).is_empty(), "nothing was refused since");
        let page = refusals.page(after(11));
        assert_eq!(
            (&page[0]["count"], &page[0]["ago_s"], &page[0]["robot"]),
            (&6.into(), &10.into(), &"a".into())
        );
    }

    #[test]
    fn strangers_without_end_take_bounded_memory_and_lines() {
        let start = Instant::now();
        let mut refusals = Refusals::new(start);
        let mut lines = 0;
        for number in 0..10_000_u32 {
            let from = IpAddr::from(number.to_be_bytes());
            refusals.add(
                &refusal("a", &"x".repeat(10_000)),
                from,
                start + Duration::from_millis(number.into()),
            );
            lines += refusals.new_lines(start + Duration::from_millis(number.into())).len();
        }
        assert_eq!(refusals.entries.len(), MAX_REFUSALS);
        assert!(refusals.entries.iter().all(|entry| entry.refusal.reason.len() == MAX_REASON));
        assert!((32..=37).contains(&lines), "{lines} lines in ten seconds");
    }
}
