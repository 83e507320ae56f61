//! Topics that are written to.

use crate::node::{Delivery, Node};
use crate::payload::{Payload, PayloadWriter};
use odograph::error::Result;
use rustdds::TopicDescription;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Messages that a reliable topic keeps until all who listen have them. A listener that was killed
/// counts until its lease ends, mostly after 10 s, and no more than these are sent to the others:
/// enough for 200 Hz.
pub const KEPT: i32 = 2000;
/// Longest wait until the last messages are delivered.
const LAST: Duration = Duration::from_millis(300);

/// A topic that is written to.
pub struct Topic(PayloadWriter);

impl std::fmt::Debug for Topic {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0.topic().name())
    }
}

impl Topic {
    pub fn new(node: &Node, name: &str, type_name: &str, delivery: Delivery, depth: i32) -> Result<Self> {
        node.writer(&name.parse()?, type_name, delivery, depth).map(Self)
    }

    /// Sends a message. One that cannot be sent at once is lost: newer ones follow.
    pub fn send(&self, message: Vec<u8>) {
        let _ = self.0.write(Payload(message), None);
    }

    /// Waits until those who listen have what was sent, for a moment at most.
    pub fn wait(&self) {
        let _ = self.0.wait_for_acknowledgments(LAST);
    }
}

/// The time of the clock, nanoseconds.
pub fn now_ns() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
}
