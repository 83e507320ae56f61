//! SQLite errors as one-sentence messages for users.

use odograph::error::{Error, Result};
use rusqlite::ErrorCode;
use std::path::Path;

/// Converts SQLite errors to messages about one file.
#[derive(Debug, Clone)]
pub(crate) struct Complaint {
    path: String,
}

impl Complaint {
    pub fn about(path: &Path) -> Self {
        Self { path: path.display().to_string() }
    }

    /// Error for a failed read.
    pub fn reading(&self, failure: &rusqlite::Error) -> Error {
        let path = &self.path;
        let why = match failure.sqlite_error_code() {
            Some(ErrorCode::DatabaseCorrupt | ErrorCode::NotADatabase) => {
                return Error::input(format!(
                    "{path} is damaged: {failure}; odograph map repair saves what can be read"
                ));
            }
            Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked) => {
                return Error::input(format!(
                    "{path} is being written by another program; wait until that has ended"
                ));
            }
            Some(ErrorCode::CannotOpen | ErrorCode::PermissionDenied | ErrorCode::ReadOnly) => {
                return Error::input(format!("{path} cannot be opened: {failure}"));
            }
            Some(ErrorCode::TooBig) => "something in it is larger than anything in a map".to_owned(),
            Some(_) => failure.to_string(),
            None => format!("it holds what no map holds ({failure}); odograph map repair saves the rest"),
        };
        Error::input(format!("{path} cannot be read as a map: {why}"))
    }

    /// Error for a failed write.
    pub fn writing(&self, failure: &rusqlite::Error) -> Error {
        let path = &self.path;
        match failure.sqlite_error_code() {
            Some(ErrorCode::DatabaseCorrupt | ErrorCode::NotADatabase) => self.reading(failure),
            Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked) => Error::output(format!(
                "{path} cannot be written: another program is writing it; wait until that has ended"
            )),
            Some(ErrorCode::DiskFull) => Error::output(format!(
                "{path} cannot be written: the disk is full; free some space, or choose another place"
            )),
            Some(ErrorCode::SystemIoFailure) => Error::output(format!(
                "{path} cannot be written: {failure}; the disk is full or has failed: choose another place"
            )),
            // Not the disk: what was to be written is nothing that a map holds.
            None | Some(ErrorCode::TooBig | ErrorCode::TypeMismatch | ErrorCode::ConstraintViolation) => {
                Error::input(format!("{path} cannot be written: {failure}"))
            }
            Some(_) => Error::output(format!("{path} cannot be written: {failure}")),
        }
    }

    /// Input error with the file's name.
    pub fn input(&self, what: impl std::fmt::Display) -> Error {
        Error::input(format!("{}: {what}", self.path))
    }

    /// Input error about damage that [`crate::repair`] can leave out.
    pub fn damage(&self, what: impl std::fmt::Display) -> Error {
        self.input(format!("{what}; odograph map repair saves the rest"))
    }

    /// Input error about the mosaic, which is made of the rest of the map.
    pub fn damaged_mosaic(&self, what: impl std::fmt::Display) -> Error {
        self.input(format!("{what}; odograph map mosaic renders it again"))
    }

    /// Usage error with the file's name.
    pub fn usage(&self, what: impl std::fmt::Display) -> Error {
        Error::usage(format!("{}: {what}", self.path))
    }
}

/// Converts an SQLite result to one with a message.
pub(crate) trait WithContext<T> {
    /// For a read operation.
    fn while_reading(self, complaint: &Complaint) -> Result<T>;
    /// For a write operation.
    fn while_writing(self, complaint: &Complaint) -> Result<T>;
}

impl<T> WithContext<T> for rusqlite::Result<T> {
    fn while_reading(self, complaint: &Complaint) -> Result<T> {
        self.map_err(|failure| complaint.reading(&failure))
    }

    fn while_writing(self, complaint: &Complaint) -> Result<T> {
        self.map_err(|failure| complaint.writing(&failure))
    }
}
