//! A recording of messages on topics, read sequentially, whatever its format.

use super::cursor::Serialization;
use odograph::error::Result;
use std::collections::HashMap;

/// A topic of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Topic {
    pub name: String,
    /// As in the recording, e.g. `sensor_msgs/msg/Image`.
    pub type_name: String,
    pub serialization: Serialization,
    /// Number of messages: from the index, or counted where there is none.
    pub count: u64,
    /// Times at which the first and the last message were recorded, nanoseconds; from an index
    /// those of the whole recording.
    pub span_ns: (u64, u64),
}

impl Topic {
    /// Whether it is the same topic, by name and type.
    pub fn is(&self, other: &Self) -> bool {
        self.name == other.name && self.type_name == other.type_name
    }

    /// Adds messages.
    pub fn add(&mut self, count: u64, span_ns: (u64, u64)) {
        if count == 0 {
            return;
        }
        self.span_ns = if self.count == 0 {
            span_ns
        } else {
            (self.span_ns.0.min(span_ns.0), self.span_ns.1.max(span_ns.1))
        };
        self.count = self.count.saturating_add(count);
    }

    /// The type without the `msg` that ROS 2 puts into it, e.g. `sensor_msgs/Image`.
    pub fn plain_type(&self) -> String {
        self.type_name.replace("/msg/", "/").replace("::msg::dds_::", "/").trim_end_matches('_').to_owned()
    }

    /// Messages per second; 0 if unknown.
    pub fn rate_hz(&self) -> f64 {
        let duration_ns = self.span_ns.1.saturating_sub(self.span_ns.0);
        if self.count < 2 || duration_ns == 0 {
            0.0
        } else {
            (self.count - 1) as f64 * 1e9 / duration_ns as f64
        }
    }
}

/// The topics of a recording, and which of them are read.
#[derive(Debug, Default)]
pub(super) struct Topics {
    pub all: Vec<Topic>,
    by_name: HashMap<(String, String), usize>,
    wanted: Option<Vec<bool>>,
}

/// Most topics of a recording: more are a damaged file.
const MAX_TOPICS: usize = 100_000;

impl Topics {
    /// The index of a topic, which is added if it is new; `None` if there are too many.
    pub fn index(&mut self, name: &str, type_name: &str, serialization: Serialization) -> Option<usize> {
        let key = (name.to_owned(), type_name.to_owned());
        if let Some(&index) = self.by_name.get(&key) {
            return Some(index);
        }
        if self.all.len() >= MAX_TOPICS {
            return None;
        }
        let (name, type_name) = key.clone();
        self.all.push(Topic { name, type_name, serialization, count: 0, span_ns: (0, 0) });
        self.by_name.insert(key, self.all.len() - 1);
        Some(self.all.len() - 1)
    }

    /// Restricts reading to the topics for which `wanted` holds.
    pub fn select(&mut self, wanted: &dyn Fn(&Topic) -> bool) {
        self.wanted = Some(self.all.iter().map(wanted).collect());
    }

    /// Whether messages of a topic are read.
    pub fn is_wanted(&self, index: usize) -> bool {
        self.wanted.as_ref().is_none_or(|wanted| wanted.get(index).copied().unwrap_or(false))
    }
}

/// One message.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Message<'a> {
    /// Index among the topics.
    pub topic: usize,
    /// When it was recorded, nanoseconds.
    pub log_ns: u64,
    pub data: &'a [u8],
}

/// Reads the messages of a recording in the order in which they were recorded.
///
/// A damaged or truncated recording is not an error: what can be read is read, with a warning.
pub(crate) trait MessageReader: Send {
    /// Human-readable name of the format.
    fn format(&self) -> String;
    fn topics(&self) -> &[Topic];
    /// Restricts reading to the topics for which `wanted` holds.
    fn select(&mut self, wanted: &dyn Fn(&Topic) -> bool);
    /// Advances to the next message; false at the end.
    fn advance(&mut self) -> Result<bool>;
    /// The current message; an empty one before the first.
    fn message(&self) -> Message<'_>;
    /// Restarts before the first message.
    fn rewind(&mut self) -> Result<()>;
    /// Drains the warnings about defects, one sentence each.
    fn take_warnings(&mut self) -> Vec<String>;
}
