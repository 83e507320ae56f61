//! A connection with a deadline for reading and writing.

use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// Time limit for the end of an encrypted connection.
const CLOSE_PATIENCE: Duration = Duration::from_millis(200);

/// A connection whose reads and writes fail after a deadline, independent of the amount of data
/// transferred.
#[derive(Debug)]
pub struct Deadlined {
    socket: DeadlinedSocket,
    encryption: Option<Box<dyn Encryption>>,
}

/// The socket of such a connection: what it carries may be encrypted.
#[derive(Debug)]
pub struct DeadlinedSocket {
    stream: TcpStream,
    until: Instant,
    /// If set, a read waits at most this long and then fails with `WouldBlock`.
    read_patience: Option<Duration>,
}

/// Encryption of what a socket carries.
pub trait Encryption: std::fmt::Debug + Send {
    /// Reads from the socket, and decrypts.
    ///
    /// # Errors
    /// If the socket fails, or what it carries is invalid.
    fn read(&mut self, socket: &mut DeadlinedSocket, buffer: &mut [u8]) -> io::Result<usize>;

    /// Encrypts, and writes to the socket.
    ///
    /// # Errors
    /// If the socket fails, or what it carries is invalid.
    fn write(&mut self, socket: &mut DeadlinedSocket, bytes: &[u8]) -> io::Result<usize>;

    /// Tells the other side that nothing follows. A failure is ignored.
    fn close(&mut self, socket: &mut DeadlinedSocket);
}

impl Deadlined {
    /// Sets the deadline to `patience` from now.
    pub fn new(stream: TcpStream, patience: Duration) -> Self {
        let socket = DeadlinedSocket { stream, until: Instant::now() + patience, read_patience: None };
        Self { socket, encryption: None }
    }

    /// The same with encryption, whose handshake is within the first deadline.
    #[must_use]
    pub fn encrypted(mut self, encryption: Box<dyn Encryption>) -> Self {
        self.encryption = Some(encryption);
        self
    }

    /// Moves the deadline to `patience` from now.
    pub fn allow(&mut self, patience: Duration) {
        self.socket.until = Instant::now() + patience;
    }

    /// From now on each read waits at most `patience`.
    pub fn read_for(&mut self, patience: Duration) {
        self.socket.read_patience = Some(patience);
    }
}

impl Read for Deadlined {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match &mut self.encryption {
            Some(encryption) => encryption.read(&mut self.socket, buffer),
            None => self.socket.read(buffer),
        }
    }
}

impl Write for Deadlined {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match &mut self.encryption {
            Some(encryption) => encryption.write(&mut self.socket, bytes),
            None => self.socket.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        self.socket.flush()
    }
}

impl Drop for Deadlined {
    fn drop(&mut self) {
        if let Some(mut encryption) = self.encryption.take() {
            self.allow(CLOSE_PATIENCE);
            encryption.close(&mut self.socket);
        }
    }
}

impl DeadlinedSocket {
    fn left(&self) -> io::Result<Duration> {
        let left = self.until.saturating_duration_since(Instant::now());
        // A socket timeout of zero means no timeout, hence the error below 1 ms.
        if left < Duration::from_millis(1) { Err(io::ErrorKind::TimedOut.into()) } else { Ok(left) }
    }
}

impl Read for DeadlinedSocket {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let left = match self.read_patience {
            Some(patience) => patience,
            None => self.left()?,
        };
        self.stream.set_read_timeout(Some(left))?;
        self.stream.read(buffer)
    }
}

impl Write for DeadlinedSocket {
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
