//! Live video sources: cameras, network streams, and recordings played in real time.

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

use odograph::error::{Error, Result};
use odograph::filter::fusion::Sensors;
use odograph::image::GrayImage;
use odograph_video::{Frame, SourceInfo};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Reads the parts of a multipart stream, its first line a `Content-Type`, for the fuzz target.
#[cfg(fuzzing)]
pub fn read_multipart(bytes: &[u8]) {
    let (head, body) = bytes.split_at(bytes.iter().position(|&byte| byte == b'\n').unwrap_or(0));
    let Some(boundary) = multipart::boundary(&String::from_utf8_lossy(head)) else { return };
    // A small buffer: a boundary may span two reads.
    let reader = std::io::BufReader::with_capacity(16, body);
    let mut multipart = multipart::Multipart::new(reader, &boundary);
    let mut part = Vec::new();
    while multipart.next(&mut part).is_ok_and(|more| more) {}
}

/// A frame with its arrival time.
#[derive(Debug, Clone)]
pub struct Captured {
    /// The frame.
    pub frame: Frame,
    /// When the frame was received completely; of a recording, when it was due.
    pub at: Instant,
}

/// A source of live frames.
pub trait LiveSource: Send {
    /// Description of the source.
    fn info(&self) -> &SourceInfo;

    /// Waits for the next frame. `None` at the end of a recording, or if the source was asked to
    /// end.
    ///
    /// # Errors
    /// If no more frames can be received.
    fn next_frame(&mut self) -> Result<Option<Captured>>;

    /// Returns and clears the warnings since the last call, one sentence each.
    fn take_warnings(&mut self) -> Vec<String> {
        Vec::new()
    }

    /// The records of other sensors that came with the frames, at the end.
    fn take_sensors(&mut self) -> Sensors {
        Sensors::default()
    }

    /// Number of frames so far that were left out because newer ones came.
    fn dropped(&self) -> u64 {
        0
    }
}

/// Checks that the image of a camera at `place` has the size of its first one.
fn check_size(place: &str, image: &GrayImage, first: &SourceInfo) -> Result<()> {
    let (width, height) = (image.width(), image.height());
    if (width, height) != (first.width, first.height) {
        return Err(Error::input(format!(
            "{place} now sends {width}x{height} pixels, at first it was {}x{}; a camera must keep its size",
            first.width, first.height
        )));
    }
    Ok(())
}

/// State shared by a source and its consumers: stop request and connection status.
#[derive(Debug, Default, Clone)]
pub struct Watch(Arc<Watched>);

#[derive(Debug, Default)]
struct Watched {
    ended: AtomicBool,
    reconnects: AtomicU64,
    waiting: Mutex<Option<String>>,
    notices: Mutex<Vec<String>>,
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

    /// The reason why no frames arrive at the moment; `None` while they arrive.
    pub fn waiting(&self) -> Option<String> {
        self.0.waiting.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Number of times the source was lost and came back.
    pub fn reconnects(&self) -> u64 {
        self.0.reconnects.load(Ordering::Relaxed)
    }

    /// No frames arrive at the moment, for a reason.
    pub fn lost(&self, why: &str) {
        *self.0.waiting.lock().unwrap_or_else(PoisonError::into_inner) = Some(why.to_owned());
    }

    /// Something about the source that a person should know at once, as a sentence.
    pub fn notice(&self, sentence: String) {
        self.0.notices.lock().unwrap_or_else(PoisonError::into_inner).push(sentence);
    }

    /// Returns and clears the notices since the last call.
    pub fn take_notices(&self) -> Vec<String> {
        std::mem::take(&mut *self.0.notices.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Frames arrive again.
    pub fn back(&self) {
        if self.0.waiting.lock().unwrap_or_else(PoisonError::into_inner).take().is_some() {
            self.0.reconnects.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Sleeps until `moment`; `false` if the source was asked to end before that.
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
