//! Frames as they come: from cameras, from streams, and from recordings at their own pace.

mod back_off;
mod http_mjpeg;
mod multipart;
mod network_stream;
mod newest;
mod raw_frames;
mod recording;
mod url;
pub mod camera;

pub use http_mjpeg::HttpMjpeg;
pub use network_stream::{NetworkStream, without_credentials};
pub use newest::{Newest, Policy, Taken};
pub use raw_frames::{RawFormat, RawFrames};
pub use recording::Recording;

use odograph::error::Result;
use odograph_video::{Frame, SourceInfo};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// A frame and the moment at which it was there.
#[derive(Debug, Clone)]
pub struct Captured {
    /// The frame.
    pub frame: Frame,
    /// When its last byte had come from the camera; of a recording, when its turn came.
    pub at: Instant,
}

/// Something that gives frames as they come.
pub trait LiveSource: Send {
    /// What is known of the source.
    fn info(&self) -> &SourceInfo;

    /// The next frame; waits for it. `None` at the end: of a recording, or where the source was asked to end.
    ///
    /// # Errors
    /// Where no frame can be had any more.
    fn next_frame(&mut self) -> Result<Option<Captured>>;

    /// What was noticed since the last call, one sentence each, for people; empties the list.
    fn take_warnings(&mut self) -> Vec<String> {
        Vec::new()
    }
}

/// What a source and those who wait for its frames tell each other.
#[derive(Debug, Default, Clone)]
pub struct Watch(Arc<Watched>);

#[derive(Debug, Default)]
struct Watched {
    ended: AtomicBool,
    reconnects: AtomicU64,
    waiting: Mutex<Option<String>>,
}

impl Watch {
    /// Asks the source to end.
    pub fn end(&self) {
        self.0.ended.store(true, Ordering::Relaxed);
    }

    /// Whether the source was asked to end.
    pub fn ended(&self) -> bool {
        self.0.ended.load(Ordering::Relaxed)
    }

    /// Why no frames come at the moment, where that is so.
    pub fn waiting(&self) -> Option<String> {
        self.0.waiting.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// How often the source went away and came back.
    pub fn reconnects(&self) -> u64 {
        self.0.reconnects.load(Ordering::Relaxed)
    }

    fn lost(&self, why: &str) {
        *self.0.waiting.lock().unwrap_or_else(PoisonError::into_inner) = Some(why.to_owned());
    }

    fn back(&self) {
        if self.0.waiting.lock().unwrap_or_else(PoisonError::into_inner).take().is_some() {
            self.0.reconnects.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Waits until a moment; false where the source was asked to end before.
    fn sleep_until(&self, moment: Instant) -> bool {
        loop {
            if self.ended() {
                return false;
            }
            let left = moment.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return true;
            }
            std::thread::sleep(left.min(Duration::from_millis(100)));
        }
    }
}
