//! Pipes, standard input and devices: what gives bytes when its writer likes to. Waiting for them
//! can be ended, also where no writer has come yet.

use crate::file_error::{unopened, unreadable};
use odograph::error::{Error, Result};
use std::io::Read;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

static IS_ENDED: AtomicBool = AtomicBool::new(false);

/// Ends, for the rest of this process, all waiting for pipes, devices and standard input: a
/// recording ends there as if its writer had closed it, and opening one fails. On systems other
/// than Linux, what waits already goes on to wait.
pub fn end_waiting() {
    IS_ENDED.store(true, Ordering::Relaxed);
}

/// Whether [`end_waiting`] was called.
pub(crate) fn is_ended() -> bool {
    IS_ENDED.load(Ordering::Relaxed)
}

/// Fails once [`end_waiting`] was called: for those that need everything.
pub(crate) fn check_waiting() -> Result<()> {
    if is_ended() {
        return Err(Error::input("interrupted while waiting for frames; nothing was written"));
    }
    Ok(())
}

/// Why there are no frames: that they were no longer waited for, or else `error`.
pub(crate) fn interrupted_or(error: Error) -> Error {
    check_waiting().err().unwrap_or(error)
}

/// Standard input.
pub(crate) fn standard_input() -> Result<impl Read + Send + 'static> {
    waiting::standard_input().map_err(unreadable)
}

/// A pipe or device. Does not wait for its writer.
pub(crate) fn open(path: &Path) -> Result<impl Read + Send + 'static> {
    waiting::open(path).map_err(unopened)
}

#[cfg(target_os = "linux")]
mod waiting {
    use super::is_ended;
    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    use rustix::fs::OFlags;
    use std::fs::{File, OpenOptions};
    use std::io::{self, ErrorKind, Read};
    use std::os::fd::AsFd;
    use std::os::unix::fs::OpenOptionsExt;
    use std::path::Path;

    /// How long an end is noticed after it was asked for, at most. Shorter wakes more often.
    const LOOKS_EVERY: Timespec = Timespec { tv_sec: 0, tv_nsec: 50_000_000 };

    /// Bytes that are waited for.
    pub struct Waiting(File);

    pub fn standard_input() -> io::Result<Waiting> {
        Ok(Waiting(File::from(io::stdin().as_fd().try_clone_to_owned()?)))
    }

    pub fn open(path: &Path) -> io::Result<Waiting> {
        // Otherwise the system waits for a writer, and that wait outlasts a signal.
        let flags = OFlags::NONBLOCK.bits().cast_signed();
        OpenOptions::new().read(true).custom_flags(flags).open(path).map(Waiting)
    }

    impl Read for Waiting {
        fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
            while !is_ended() {
                let mut ready = [PollFd::new(&self.0, PollFlags::IN)];
                match poll(&mut ready, Some(&LOOKS_EVERY)) {
                    Ok(0) | Err(rustix::io::Errno::INTR) => continue,
                    Ok(_) => {}
                    Err(error) => return Err(error.into()),
                }
                match self.0.read(bytes) {
                    Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                    read => return read,
                }
            }
            Ok(0)
        }
    }
}

#[cfg(not(target_os = "linux"))]
mod waiting {
    use std::fs::File;
    use std::io::{self, Stdin};
    use std::path::Path;

    pub fn standard_input() -> io::Result<Stdin> {
        Ok(io::stdin())
    }

    pub fn open(path: &Path) -> io::Result<File> {
        File::open(path)
    }
}
