//! A satellite receiver beside a live source: positions as they come, from a pipe, a serial device,
//! standard input or datagrams.

use crate::earth::GnssRecord;
use odograph::error::{Error, Result};
use odograph::formats::gnss_file::{GnssLines, ReceivedFixes};
use odograph::georeference::GnssFix;
use odograph::numerics::median;
use std::fs::File;
use std::io::{self, Read};
use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

/// Longest line that is read, bytes; longer ones are no sentences of a receiver.
const LONGEST_LINE: usize = 1024;
/// Longest time between a frame and a line for which the time of the line is known by the frame's.
const LONGEST_GAP: Duration = Duration::from_secs(2);
/// Pause before a pipe or device that ended is opened again.
const AGAIN: Duration = Duration::from_millis(200);
/// Wait for a datagram after which the end of the run is noticed.
const PATIENCE: Duration = Duration::from_millis(500);

/// Where the positions of a receiver come from.
#[derive(Debug, Clone, PartialEq)]
pub enum GnssSource {
    /// Standard input.
    Input,
    /// A pipe or a serial device.
    Device(PathBuf),
    /// Datagrams to this address, `HOST:PORT`.
    Datagrams(String),
}

impl GnssSource {
    /// The source of this name: `-`, `udp:HOST:PORT`, `udp:PORT` (of this machine), a pipe or a
    /// device. `None` for an ordinary file.
    ///
    /// # Errors
    /// If there is no such file, or the address is invalid.
    pub fn named(name: &str) -> Result<Option<Self>> {
        if name == "-" {
            return Ok(Some(Self::Input));
        }
        if let Some(address) = name.strip_prefix("udp:") {
            let address = match address.contains(':') {
                true => address.to_owned(),
                false => format!("127.0.0.1:{address}"),
            };
            let is_port = address.rsplit_once(':').is_some_and(|(_, port)| port.parse::<u16>().is_ok());
            return match is_port {
                true => Ok(Some(Self::Datagrams(address))),
                false => Err(Error::usage(format!(
                    "{name} is no address for the positions of a receiver; give udp:PORT or udp:HOST:PORT, such as udp:10110"
                ))),
            };
        }
        let metadata = std::fs::metadata(name).map_err(|error| {
            Error::input(format!("the positions of the receiver cannot be read from {name}: {error}"))
                .caused_by(error)
        })?;
        Ok((!metadata.is_file() && !metadata.is_dir()).then(|| Self::Device(PathBuf::from(name))))
    }

    fn name(&self) -> String {
        match self {
            Self::Input => "standard input".to_owned(),
            Self::Device(path) => path.display().to_string(),
            Self::Datagrams(address) => format!("udp:{address}"),
        }
    }
}

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

    fn is_ended(&self) -> bool {
        self.is_ended.load(Ordering::Relaxed)
    }
}

impl GnssReceiver {
    /// Begins to listen.
    ///
    /// # Errors
    /// If the port cannot be opened.
    pub fn open(source: &GnssSource) -> Result<Self> {
        let heard = Arc::new(Heard::default());
        let shared = Arc::clone(&heard);
        match source.clone() {
            GnssSource::Input => drop(thread::spawn(move || read_lines(io::stdin().lock(), &shared))),
            GnssSource::Device(path) => drop(thread::spawn(move || read_device(&path, &shared))),
            GnssSource::Datagrams(address) => {
                let socket = UdpSocket::bind(&address).and_then(|socket| {
                    socket.set_read_timeout(Some(PATIENCE))?;
                    Ok(socket)
                });
                let socket = socket.map_err(|error| {
                    Error::usage(format!(
                        "the positions of a receiver cannot be received at {address}: {error}; give another port"
                    ))
                })?;
                drop(thread::spawn(move || read_datagrams(&socket, &shared)));
            }
        }
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

/// Reads lines until the end or until the run ends.
fn read_lines(mut input: impl Read, heard: &Heard) {
    let mut line: Vec<u8> = Vec::new();
    let mut bytes = [0; 512];
    loop {
        let count = match input.read(&mut bytes) {
            Ok(0) => break,
            Ok(count) => count,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(_) => break,
        };
        if heard.is_ended() {
            return;
        }
        let now = Instant::now();
        for &byte in &bytes[..count] {
            if byte != b'\n' && byte != b'\r' {
                // Beyond the longest line nothing is kept but that it is too long.
                if line.len() <= LONGEST_LINE {
                    line.push(byte);
                }
            } else if !line.is_empty() {
                take(&line, now, heard);
                line.clear();
            }
        }
    }
    // A datagram may end without a line break.
    if !line.is_empty() {
        take(&line, Instant::now(), heard);
    }
}

fn take(line: &[u8], now: Instant, heard: &Heard) {
    if line.len() <= LONGEST_LINE {
        heard.lines().take(&String::from_utf8_lossy(line), now);
    }
}

/// Reads a pipe or a device, again after its other end was closed.
fn read_device(path: &Path, heard: &Heard) {
    while !heard.is_ended() {
        // Opening a pipe blocks until another program opens it for writing.
        if let Ok(file) = File::open(path) {
            read_lines(file, heard);
        }
        thread::sleep(AGAIN);
    }
}

fn read_datagrams(socket: &UdpSocket, heard: &Heard) {
    let mut bytes = [0; 1 << 16];
    while !heard.is_ended() {
        match socket.recv(&mut bytes) {
            Ok(count) => read_lines(&bytes[..count], heard),
            Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => {}
            Err(_) => thread::sleep(AGAIN),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    #[test]
    fn sources_are_recognised_by_their_names() {
        let named = |name: &str| GnssSource::named(name).unwrap();
        assert_eq!(named("-"), Some(GnssSource::Input));
        assert_eq!(named("udp:10110"), Some(GnssSource::Datagrams("127.0.0.1:10110".to_owned())));
        assert_eq!(named("udp:[::1]:7"), Some(GnssSource::Datagrams("[::1]:7".to_owned())));
        assert_eq!(named("Cargo.toml"), None);
        assert_eq!(named("/dev/null"), Some(GnssSource::Device("/dev/null".into())));
        for bad in ["udp:", "udp:host:", "udp:99999", "not-there.csv"] {
            let message = GnssSource::named(bad).unwrap_err().to_string();
            assert!(message.contains(bad) && !message.contains('\n'), "{message}");
        }
    }

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

    #[test]
    fn lines_are_read_whole_and_long_ones_left_out() {
        let heard = Heard::default();
        let long = "9".repeat(3000);
        let text = format!("time_s,lat,lon\r\n1,48,16\r\n{long}\n2,48,16\n3,48,16");
        read_lines(text.as_bytes(), &heard);
        let lines = std::mem::take(&mut *heard.lines());
        assert_eq!(lines.arrivals_s.len(), 4);
        assert_eq!(lines.lines.received().fixes.len(), 3);
    }
}
