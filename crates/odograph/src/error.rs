//! The error type shared by the whole workspace.

use std::error::Error as Cause;
use std::fmt;
use std::io;
use std::ops::RangeInclusive;

/// The category of an error; decides the exit code of the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ErrorKind {
    /// The caller's request is invalid: an unknown option or a value out of range.
    Usage,
    /// A file, stream or image is missing, damaged or of the wrong format.
    Input,
    /// A result could not be written.
    Output,
}

/// An error with a message for people: one sentence that says what failed, where, why, and what to
/// do.
///
/// Opaque on purpose: code branches on [`Error::kind`], people read the [`Display`](fmt::Display)
/// form, which is complete: what [`source`](Cause::source) gives stands in it already and is for
/// programs.
#[derive(Debug)]
pub struct Error {
    kind: ErrorKind,
    message: String,
    list: Vec<String>,
    source: Option<Box<dyn Cause + Send + Sync>>,
}

/// A result whose error is the workspace's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    /// An error of the given kind with the given message.
    pub fn new(kind: ErrorKind, message: impl Into<String>) -> Self {
        Self { kind, message: message.into(), list: Vec::new(), source: None }
    }

    /// A [`ErrorKind::Usage`] error.
    pub fn usage(message: impl Into<String>) -> Self {
        Self::new(ErrorKind::Usage, message)
    }

    /// A [`ErrorKind::Input`] error.
    pub fn input(message: impl Into<String>) -> Self {
        Self::new(ErrorKind::Input, message)
    }

    /// A [`ErrorKind::Output`] error.
    pub fn output(message: impl Into<String>) -> Self {
        Self::new(ErrorKind::Output, message)
    }

    /// An [`ErrorKind::Output`] error of a file or folder that cannot be written, with what to do.
    pub fn not_written(place: impl fmt::Display, why: io::Error) -> Self {
        Self::output(format!("{place} cannot be written: {why}{}", remedy(why.kind()))).caused_by(why)
    }

    /// An [`ErrorKind::Output`] error of a folder that cannot be made, with what to do.
    pub fn not_made(place: impl fmt::Display, why: io::Error) -> Self {
        Self::output(format!("{place} cannot be made: {why}{}", remedy(why.kind()))).caused_by(why)
    }

    /// A [`ErrorKind::Usage`] error if a parameter is out of its range. Not a number lies in none.
    pub(crate) fn check_range<T: PartialOrd + fmt::Display>(
        name: &str,
        value: T,
        range: RangeInclusive<T>,
    ) -> Result<()> {
        if range.contains(&value) {
            return Ok(());
        }
        let (least, most) = range.into_inner();
        Err(Self::usage(format!("{name} is {value}; it must lie between {least} and {most}")))
    }

    /// The category of this error.
    pub fn kind(&self) -> ErrorKind {
        self.kind
    }

    /// The same error with its location prepended to the message: `camera.yaml: fx is NaN`.
    #[must_use]
    pub fn at(self, place: impl fmt::Display) -> Self {
        let place = place.to_string();
        let place = if place.is_empty() { "``" } else { &place };
        Self { message: format!("{place}: {}", self.message), ..self }
    }

    /// The same error with a list below the sentence, such as what could be chosen instead.
    #[must_use]
    pub fn with_list(self, lines: impl IntoIterator<Item = String>) -> Self {
        Self { list: lines.into_iter().collect(), ..self }
    }

    /// The sentence without the list, and the lines of the list.
    pub fn sentence_and_list(&self) -> (&str, &[String]) {
        (&self.message, &self.list)
    }

    /// The same error with what caused it as its [`source`](Cause::source): so a program can tell a
    /// full disk from a missing file.
    #[must_use]
    pub fn caused_by(self, source: impl Cause + Send + Sync + 'static) -> Self {
        Self { source: Some(Box::new(source)), ..self }
    }
}

/// What to do where a file or folder cannot be written.
fn remedy(why: io::ErrorKind) -> &'static str {
    use io::ErrorKind::{NotADirectory, PermissionDenied, QuotaExceeded, ReadOnlyFilesystem, StorageFull};
    match why {
        StorageFull | QuotaExceeded => "; free some space, or choose another place",
        ReadOnlyFilesystem | PermissionDenied => "; choose a place where you may write",
        NotADirectory => "; a part of its path is a file, so choose another place",
        io::ErrorKind::NotFound => "; make its folder, or choose another place",
        io::ErrorKind::FileTooLarge => {
            "; raise the limit of a file's size (ulimit -f), or choose another place"
        }
        _ => "",
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)?;
        self.list.iter().try_for_each(|line| write!(f, "\n  {line}"))
    }
}

impl Cause for Error {
    fn source(&self) -> Option<&(dyn Cause + 'static)> {
        self.source.as_deref().map(|source| source as &(dyn Cause + 'static))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cause_of_an_error_can_be_asked_for_and_its_message_stays() {
        let cause = io::Error::from(io::ErrorKind::NotFound);
        let error = Error::input("camera.yaml cannot be read").caused_by(cause).at("drive");
        assert_eq!(error.to_string(), "drive: camera.yaml cannot be read");
        let cause = error.source().and_then(|cause| cause.downcast_ref::<io::Error>());
        assert_eq!(cause.map(io::Error::kind), Some(io::ErrorKind::NotFound));
        assert!(Error::usage("no camera is given").source().is_none());
    }

    #[test]
    fn what_cannot_be_written_says_what_to_do() {
        let full = Error::not_written("drive/map.png", io::ErrorKind::StorageFull.into());
        assert_eq!(full.kind(), ErrorKind::Output);
        assert!(full.to_string().starts_with("drive/map.png cannot be written: "), "{full}");
        assert!(full.to_string().ends_with("; free some space, or choose another place"), "{full}");
        let other = Error::not_written("a", io::Error::other("the cable is out"));
        assert_eq!(other.to_string(), "a cannot be written: the cable is out");
    }

    #[test]
    fn a_list_stands_below_the_sentence_wherever_that_gets_its_place() {
        let error = Error::usage("choose a topic").with_list(["/left".into(), "/right".into()]).at("a.bag");
        assert_eq!(error.to_string(), "a.bag: choose a topic\n  /left\n  /right");
    }
}
