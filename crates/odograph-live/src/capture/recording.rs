//! A recording as a live source, played in real time or as fast as possible.

use super::{Captured, LiveSource, Watch};
use odograph::error::Result;
use odograph_video::{Source, SourceInfo};
use std::time::{Duration, Instant};

/// A recording that is being played.
#[derive(Debug)]
pub struct Recording {
    source: Source,
    /// Playback speed relative to real time; `None` for as fast as possible.
    speed: Option<f64>,
    /// When playback began, and the timestamp of the first frame, seconds.
    began: Option<(Instant, f64)>,
    watch: Watch,
}

impl Recording {
    /// Plays a source at `speed` times real time (> 0), or with `None` as fast as its frames are
    /// consumed.
    pub fn new(source: Source, speed: Option<f64>, watch: Watch) -> Self {
        Self { source, speed, began: None, watch }
    }
}

impl LiveSource for Recording {
    fn info(&self) -> &SourceInfo {
        self.source.info()
    }

    fn next_frame(&mut self) -> Result<Option<Captured>> {
        if self.watch.ended() {
            return Ok(None);
        }
        let Some(frame) = self.source.next_frame()? else { return Ok(None) };
        if let Some(speed) = self.speed {
            let (began, first_time_s) = *self.began.get_or_insert((Instant::now(), frame.time_s));
            // Bounds the wait if a damaged timestamp jumps by years.
            let after_s = ((frame.time_s - first_time_s) / speed).clamp(0.0, 1e8);
            if !self.watch.sleep_until(began + Duration::from_secs_f64(after_s)) {
                return Ok(None);
            }
        }
        Ok(Some(Captured { frame, at: Instant::now() }))
    }

    fn take_warnings(&mut self) -> Vec<String> {
        self.source.take_warnings()
    }
}
