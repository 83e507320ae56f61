//! Lines of a sensor or receiver beside a live source: from a pipe, a serial device, standard
//! input, datagrams, or a file that grows.

use odograph::error::{Error, Result};
use std::fs::File;
use std::io::{self, Read};
use std::net::{SocketAddr, UdpSocket};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

/// Longest line that is read, bytes; longer ones are no readings.
const LONGEST_LINE: usize = 1024;
/// Pause before a pipe or device that ended is opened again, and before a file is looked at again.
const AGAIN: Duration = Duration::from_millis(100);
/// Wait for a datagram after which the end of the run is noticed.
const PATIENCE: Duration = Duration::from_millis(500);

/// Where lines come from.
#[derive(Debug, Clone, PartialEq)]
pub enum LineSource {
    /// Standard input.
    Input,
    /// A pipe or a serial device.
    Device(PathBuf),
    /// Datagrams to this address, `HOST:PORT`.
    Datagrams(String),
    /// A file that may grow.
    File(PathBuf),
}

impl LineSource {
    /// The source of this name: `-`, `udp:HOST:PORT`, `udp:PORT` (of this machine), a pipe or a
    /// device. `None` for an ordinary file. `what` is read there, for messages.
    ///
    /// # Errors
    /// If there is no such file, or the address is invalid.
    pub fn named(name: &str, what: &str) -> Result<Option<Self>> {
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
                    "{name} is no address for the {what}; give udp:PORT or udp:HOST:PORT, such as udp:10110"
                ))),
            };
        }
        let metadata = std::fs::metadata(name).map_err(|error| {
            Error::input(format!("the {what} cannot be read from {name}: {error}")).caused_by(error)
        })?;
        Ok((!metadata.is_file() && !metadata.is_dir()).then(|| Self::Device(PathBuf::from(name))))
    }

    /// Its name in messages.
    pub fn name(&self) -> String {
        match self {
            Self::Input => "standard input".to_owned(),
            Self::Device(path) | Self::File(path) => path.display().to_string(),
            Self::Datagrams(address) => format!("udp:{address}"),
        }
    }

    /// Begins to read lines on a thread, which is not joined, because reading may block. Lines that
    /// a file has already are taken before this returns.
    ///
    /// # Errors
    /// If the port or the file cannot be opened. `what` is read, for messages.
    pub fn read(&self, what: &str, sink: Arc<dyn LineSink>) -> Result<()> {
        match self.clone() {
            Self::Input => drop(thread::spawn(move || read_lines(io::stdin().lock(), &*sink))),
            Self::Device(path) => drop(thread::spawn(move || read_device(&path, &*sink))),
            Self::Datagrams(address) => {
                let socket = UdpSocket::bind(&address).and_then(|socket| {
                    socket.set_read_timeout(Some(PATIENCE))?;
                    Ok(socket)
                });
                let socket = socket.map_err(|error| {
                    Error::usage(format!(
                        "the {what} cannot be received at {address}: {error}; give another port"
                    ))
                })?;
                drop(thread::spawn(move || read_datagrams(&socket, &*sink)));
            }
            Self::File(path) => {
                let mut file = File::open(&path).map_err(|error| {
                    Error::input(format!("the {what} cannot be read from {}: {error}", path.display()))
                        .caused_by(error)
                })?;
                let mut lines = Lines::default();
                lines.read_all(&mut file, None, &*sink);
                drop(thread::spawn(move || {
                    while !sink.is_ended() {
                        thread::sleep(AGAIN);
                        lines.read_all(&mut file, Some(Instant::now()), &*sink);
                    }
                }));
            }
        }
        Ok(())
    }
}

/// Takes the lines of a source.
pub trait LineSink: Send + Sync {
    /// A line without its end. `arrived` is missing for what a file had before it was opened, and
    /// `sender` for all but datagrams.
    fn take(&self, line: &str, arrived: Option<Instant>, sender: Option<SocketAddr>);

    /// Whether no more lines are needed.
    fn is_ended(&self) -> bool;
}

/// A line that is being read.
#[derive(Default)]
struct Lines {
    begun: Vec<u8>,
}

impl Lines {
    fn add(
        &mut self,
        bytes: &[u8],
        arrived: Option<Instant>,
        sender: Option<SocketAddr>,
        sink: &dyn LineSink,
    ) {
        for &byte in bytes {
            if byte != b'\n' && byte != b'\r' {
                // Beyond the longest line nothing is kept but that it is too long.
                if self.begun.len() <= LONGEST_LINE {
                    self.begun.push(byte);
                }
            } else {
                self.end(arrived, sender, sink);
            }
        }
    }

    /// Ends the line, as the end of a datagram does.
    fn end(&mut self, arrived: Option<Instant>, sender: Option<SocketAddr>, sink: &dyn LineSink) {
        if !self.begun.is_empty() && self.begun.len() <= LONGEST_LINE {
            sink.take(&String::from_utf8_lossy(&self.begun), arrived, sender);
        }
        self.begun.clear();
    }

    /// Reads what there is, or until the run ends. A line without an end is kept for later.
    fn read_all(&mut self, mut input: impl Read, arrived: Option<Instant>, sink: &dyn LineSink) {
        let mut bytes = [0; 8192];
        while !sink.is_ended() {
            match input.read(&mut bytes) {
                Ok(0) => return,
                Ok(count) => self.add(&bytes[..count], arrived, None, sink),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(_) => return,
            }
        }
    }
}

/// Reads lines until the end or until the run ends.
fn read_lines(mut input: impl Read, sink: &dyn LineSink) {
    let mut lines = Lines::default();
    let mut bytes = [0; 512];
    loop {
        let count = match input.read(&mut bytes) {
            Ok(0) => break,
            Ok(count) => count,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(_) => break,
        };
        if sink.is_ended() {
            return;
        }
        lines.add(&bytes[..count], Some(Instant::now()), None, sink);
    }
    lines.end(Some(Instant::now()), None, sink);
}

/// Reads a pipe or a device, again after its other end was closed.
fn read_device(path: &Path, sink: &dyn LineSink) {
    while !sink.is_ended() {
        // Opening a pipe blocks until another program opens it for writing.
        if let Ok(file) = File::open(path) {
            read_lines(file, sink);
        }
        thread::sleep(AGAIN);
    }
}

fn read_datagrams(socket: &UdpSocket, sink: &dyn LineSink) {
    let mut bytes = [0; 1 << 16];
    while !sink.is_ended() {
        match socket.recv_from(&mut bytes) {
            Ok((count, sender)) => {
                let (mut lines, arrived) = (Lines::default(), Some(Instant::now()));
                lines.add(&bytes[..count], arrived, Some(sender), sink);
                // A datagram may end without a line break.
                lines.end(arrived, Some(sender), sink);
            }
            Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => {}
            Err(_) => thread::sleep(AGAIN),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use std::sync::Mutex;

    #[derive(Default)]
    struct Kept(Mutex<Vec<String>>);

    impl LineSink for Kept {
        fn take(&self, line: &str, _: Option<Instant>, _: Option<SocketAddr>) {
            self.0.lock().unwrap().push(line.to_owned());
        }

        fn is_ended(&self) -> bool {
            false
        }
    }

    #[test]
    fn sources_are_recognised_by_their_names() {
        let named = |name: &str| LineSource::named(name, "speeds of the wheel").unwrap();
        assert_eq!(named("-"), Some(LineSource::Input));
        assert_eq!(named("udp:10110"), Some(LineSource::Datagrams("127.0.0.1:10110".to_owned())));
        assert_eq!(named("udp:[::1]:7"), Some(LineSource::Datagrams("[::1]:7".to_owned())));
        assert_eq!(named("Cargo.toml"), None);
        assert_eq!(named("/dev/null"), Some(LineSource::Device("/dev/null".into())));
        for bad in ["udp:", "udp:host:", "udp:99999", "not-there.csv"] {
            let message = LineSource::named(bad, "speeds of the wheel").unwrap_err().to_string();
            assert!(message.contains(bad) && message.contains("speeds of the wheel"), "{message}");
            assert!(!message.contains('\n'), "{message}");
        }
    }

    #[test]
    fn lines_are_read_whole_and_long_ones_left_out() {
        let kept = Kept::default();
        let long = "9".repeat(3000);
        read_lines(format!("time_s,lat,lon\r\n1,48,16\r\n{long}\n2,48,16\n3,48,16").as_bytes(), &kept);
        assert_eq!(*kept.0.lock().unwrap(), ["time_s,lat,lon", "1,48,16", "2,48,16", "3,48,16"]);
    }

    #[test]
    fn a_line_of_a_growing_file_is_taken_when_it_is_complete() {
        let (kept, mut lines) = (Kept::default(), Lines::default());
        lines.read_all(&b"1,2\n3,"[..], None, &kept);
        assert_eq!(*kept.0.lock().unwrap(), ["1,2"]);
        lines.read_all(&b"4\n"[..], None, &kept);
        assert_eq!(*kept.0.lock().unwrap(), ["1,2", "3,4"]);
    }
}
