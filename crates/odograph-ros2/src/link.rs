//! What the source of a run tells its publisher.

use odograph_live::capture::Watch;
use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Frames between capture and tracking, and a few more.
const FRAMES: usize = 64;

/// From the images to what is published of them: the stamps as they were, and whether any come.
#[derive(Debug, Clone)]
pub struct Link {
    watch: Watch,
    frame: String,
    stamps: Arc<Mutex<VecDeque<(u64, i64)>>>,
    publishers: Arc<AtomicUsize>,
}

impl Link {
    pub(crate) fn new(watch: Watch, frame: String) -> Self {
        Self { watch, frame, stamps: Arc::default(), publishers: Arc::default() }
    }

    fn stamps(&self) -> MutexGuard<'_, VecDeque<(u64, i64)>> {
        self.stamps.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps the stamp of a frame, nanoseconds.
    pub(crate) fn keep(&self, frame: u64, stamp_ns: i64) {
        let mut stamps = self.stamps();
        if stamps.len() >= FRAMES {
            stamps.pop_front();
        }
        stamps.push_back((frame, stamp_ns));
    }

    /// The stamp of a frame, nanoseconds: seconds as a number would be a quarter of a microsecond
    /// off.
    pub(crate) fn stamp_ns(&self, frame: u64) -> Option<i64> {
        self.stamps().iter().find(|(number, _)| *number == frame).map(|(_, stamp_ns)| *stamp_ns)
    }

    /// Takes the number of publishers of the images; `true` if it is another than before.
    pub(crate) fn set_publishers(&self, publishers: usize) -> bool {
        self.publishers.swap(publishers, Ordering::Relaxed) != publishers
    }

    /// Number of publishers of the images.
    pub(crate) fn publishers(&self) -> usize {
        self.publishers.load(Ordering::Relaxed)
    }

    /// The frame of reference of the images; empty if they have none.
    pub fn frame(&self) -> &str {
        &self.frame
    }

    /// Whether the run has asked the images to end.
    pub(crate) fn has_ended(&self) -> bool {
        self.watch.ended()
    }

    /// Why no images come at the moment.
    pub(crate) fn waiting(&self) -> Option<String> {
        self.watch.waiting()
    }
}
