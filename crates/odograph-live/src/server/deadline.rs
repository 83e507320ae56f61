//! A connection with a deadline for reading and writing.

use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// A connection whose reads and writes fail after a deadline, independent of the amount of data
/// transferred.
#[derive(Debug)]
pub struct Deadlined {
    stream: TcpStream,
    until: Instant,
    /// If set, a read waits at most this long and then fails with `WouldBlock`.
    read_patience: Option<Duration>,
}

impl Deadlined {
    /// Sets the deadline to `patience` from now.
    pub fn new(stream: TcpStream, patience: Duration) -> Self {
        Self { stream, until: Instant::now() + patience, read_patience: None }
    }

    /// Moves the deadline to `patience` from now.
    pub fn allow(&mut self, patience: Duration) {
        self.until = Instant::now() + patience;
    }

    /// From now on each read waits at most `patience`.
    pub fn read_for(&mut self, patience: Duration) {
        self.read_patience = Some(patience);
    }

    fn left(&self) -> io::Result<Duration> {
        let left = self.until.saturating_duration_since(Instant::now());
        // A socket timeout of zero means no timeout, hence the error below 1 ms.
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
            // At `WouldBlock` the writer would keep the unsent data and try again.
            io::ErrorKind::WouldBlock => io::ErrorKind::TimedOut.into(),
            _ => error,
        })
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}
