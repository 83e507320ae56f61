//! A satellite receiver beside a live source: positions as they come.

use super::line_source::{LineSink, LineSource};
use crate::earth::GnssRecord;
use odograph::error::{Error, Result};
use odograph::formats::gnss_file::{GnssLines, ReceivedFixes};
use odograph::georeference::GnssFix;
use odograph::numerics::median;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Longest time between a frame and a line for which the time of the line is known by the frame's.
const LONGEST_GAP: Duration = Duration::from_secs(2);

/// What is read, for messages.
pub const POSITIONS: &str = "positions of the receiver";

/// The positions of a live run.
pub enum LiveGnss {
    /// Those of a file, if there is one.
    Recorded(Option<GnssRecord>),
    Received(GnssReceiver),
}

impl LiveGnss {
    /// Tells the receiver when a frame was captured, and its time, seconds.
    pub fn frame(&self, at: Instant, time_s: f64) {
        if let Self::Received(receiver) = self {
            receiver.frame(at, time_s);
        }
    }

    /// The positions at the end, and a warning where some of those received were left out.
    pub fn finish(self) -> (Option<GnssRecord>, Option<String>) {
        match self {
            Self::Recorded(record) => (record, None),
            Self::Received(receiver) => {
                let (record, warning) = receiver.finish();
                (Some(record), warning)
            }
        }
    }
}

/// A receiver whose lines are read on a thread, which is not joined: reading may block.
pub struct GnssReceiver {
    name: String,
    heard: Arc<Heard>,
}

/// What is shared with the thread.
#[derive(Default)]
struct Heard {
    lines: Mutex<TimedLines>,
    is_ended: AtomicBool,
}

/// Lines of a receiver, each with the time of the frames at its arrival.
#[derive(Debug, Default)]
struct TimedLines {
    lines: GnssLines,
    /// Seconds by the clock of the frames; NaN for lines without a frame nearby.
    arrivals_s: Vec<f64>,
    /// Arrival and time of the newest frame.
    frame: Option<(Instant, f64)>,
}

impl TimedLines {
    fn take(&mut self, line: &str, now: Instant) {
        let near = self.frame.map(|(at, time_s)| (now.saturating_duration_since(at), time_s));
        let near = near.filter(|(since, _)| *since <= LONGEST_GAP);
        self.lines.push(line);
        self.arrivals_s.push(near.map_or(f64::NAN, |(since, time_s)| time_s + since.as_secs_f64()));
    }

    /// The positions by the clock of the frames: the receiver's clock is taken to run evenly, and
    /// its offset is the median of what its lines show. How late they usually are is for the
    /// alignment with the path to find.
    fn received(self) -> (Vec<GnssFix>, usize, Option<Error>) {
        let ReceivedFixes { fixes, left_out, first } = self.lines.received();
        let lead_s = |(line, fix): &(usize, GnssFix)| {
            let arrival_s = self.arrivals_s.get(*line).copied().unwrap_or(f64::NAN);
            Some(arrival_s - fix.time_s).filter(|lead_s| lead_s.is_finite())
        };
        let mut leads_s: Vec<f64> = fixes.iter().filter_map(lead_s).collect();
        let Some(offset_s) = median(&mut leads_s) else { return (Vec::new(), left_out, first) };
        let shifted = |(_, fix): (usize, GnssFix)| GnssFix { time_s: fix.time_s + offset_s, ..fix };
        (fixes.into_iter().map(shifted).collect(), left_out, first)
    }
}

impl Heard {
    fn lines(&self) -> MutexGuard<'_, TimedLines> {
        self.lines.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl LineSink for Heard {
    fn take(&self, line: &str, arrived: Option<Instant>, _: Option<SocketAddr>) {
        self.lines().take(line, arrived.unwrap_or_else(Instant::now));
    }

    fn is_ended(&self) -> bool {
        self.is_ended.load(Ordering::Relaxed)
    }
}

impl GnssReceiver {
    /// Begins to listen.
    ///
    /// # Errors
    /// If the port cannot be opened.
    pub fn open(source: &LineSource) -> Result<Self> {
        let heard = Arc::new(Heard::default());
        source.read(POSITIONS, Arc::clone(&heard) as Arc<dyn LineSink>)?;
        Ok(Self { name: source.name(), heard })
    }

    fn frame(&self, at: Instant, time_s: f64) {
        self.heard.lines().frame = Some((at, time_s));
    }

    fn finish(self) -> (GnssRecord, Option<String>) {
        let lines = std::mem::take(&mut *self.heard.lines());
        let (fixes, left_out, first) = lines.received();
        let warning = first.map(|error| {
            let lines =
                if left_out == 1 { "1 line was".to_owned() } else { format!("{left_out} lines were") };
            format!("{}: {lines} left out, the first because of this: {error}", self.name)
        });
        (GnssRecord::received(self.name.clone(), fixes), warning)
    }
}

impl Drop for GnssReceiver {
    fn drop(&mut self) {
        self.heard.is_ended.store(true, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    #[test]
    fn positions_have_the_time_of_the_frames() {
        let heard = Heard::default();
        let began = Instant::now();
        let at = |time_s: f64| began + Duration::from_secs_f64(time_s);
        heard.lines().take("time_s,latitude_deg,longitude_deg", at(0.0));
        for second in 0..9 {
            let time_s = f64::from(second);
            // Frames have times from 100 s on; the receiver counts from 5000 s and is 0.2 s late,
            // once much later.
            heard.lines().frame = Some((at(time_s + 0.17), 100.17 + time_s));
            let late_s = if second == 4 { 0.9 } else { 0.2 };
            heard.lines().take(&format!("{},48.2,16.4", 5000 + second), at(time_s + late_s));
        }
        // Long after the last frame: its time is not known, and the receiver's own clock says it.
        heard.lines().take("5020,48.2,16.4", at(20.0));
        let (fixes, left_out, _) = std::mem::take(&mut *heard.lines()).received();
        assert_eq!((fixes.len(), left_out), (10, 0));
        for (fix, second) in fixes.iter().zip((0..9).chain([20])) {
            assert!((fix.time_s - f64::from(second) - 100.2).abs() < 1e-6, "{fix:?}");
        }
    }

    #[test]
    fn before_the_first_frame_no_position_has_a_time() {
        let heard = Heard::default();
        heard.lines().take("time_s,lat,lon", Instant::now());
        heard.lines().take("1,48,16", Instant::now());
        assert!(std::mem::take(&mut *heard.lines()).received().0.is_empty());
    }
}
