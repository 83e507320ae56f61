//! Files that cannot be opened or read. Whoever knows the name of the file puts it before these
//! words.

use odograph::error::Error;
use std::io;

pub(crate) fn unopened(error: io::Error) -> Error {
    Error::input(format!("cannot be opened: {error}"))
}

pub(crate) fn unreadable(error: io::Error) -> Error {
    Error::input(format!("cannot be read: {error}"))
}
