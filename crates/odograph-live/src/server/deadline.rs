//! A connection on which nothing takes longer than it may.

use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// A connection with a moment at which reading or writing fails, however little or much goes over it until then.
#[derive(Debug)]
pub struct Deadlined {
    stream: TcpStream,
    until: Instant,
    /// Reading waits at most so long and then fails with `WouldBlock`.
    read_patience: Option<Duration>,
}

impl Deadlined {
    /// A connection with so much time.
    pub fn new(stream: TcpStream, patience: Duration) -> Self {
        Self { stream, until: Instant::now() + patience, read_patience: None }
    }

    /// Gives so much time from now on.
    pub fn allow(&mut self, patience: Duration) {
        self.until = Instant::now() + patience;
    }

    /// Reading waits at most so long from now on.
    pub fn read_for(&mut self, patience: Duration) {
        self.read_patience = Some(patience);
    }

    fn left(&self) -> io::Result<Duration> {
        let left = self.until.saturating_duration_since(Instant::now());
        // A timeout of zero would mean none.
        if left < Duration::from_millis(1) { Err(io::ErrorKind::TimedOut.into()) } else { Ok(left) }
    }
}

impl Read for Deadlined {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let left = match self.read_patience {
            Some(patience) => patience,
            None => self.left()?,
        };
        self.stream.set_read_timeout(Some(left))?;
        self.stream.read(buffer)
    }
}

impl Write for Deadlined {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.stream.set_write_timeout(Some(self.left()?))?;
        self.stream.write(bytes).map_err(|error| match error.kind() {
            // To a writer "try again" would mean to keep what could not be sent.
            io::ErrorKind::WouldBlock => io::ErrorKind::TimedOut.into(),
            _ => error,
        })
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}
