//! The exception of the module.

use odograph_core::ErrorKind;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;

pyo3::create_exception!(
    odograph,
    Error,
    PyException,
    "One sentence that says what failed, where, why, and what to do.\n\nkind: \"usage\" (a wrong \
     argument), \"input\" (a file or image that cannot be used) or \"output\" (a result that cannot be \
     written)."
);

/// What a function of the module fails with: an error of the libraries, or a Python exception.
#[derive(Debug)]
pub enum Failure {
    Library(odograph_core::Error),
    Python(PyErr),
}

/// The result of a function of the module.
pub type Result<T> = std::result::Result<T, Failure>;

impl Failure {
    /// An argument that cannot be.
    pub fn usage(message: impl Into<String>) -> Self {
        odograph_core::Error::usage(message).into()
    }
}

impl From<odograph_core::Error> for Failure {
    fn from(error: odograph_core::Error) -> Self {
        Self::Library(error)
    }
}

impl From<PyErr> for Failure {
    fn from(error: PyErr) -> Self {
        Self::Python(error)
    }
}

impl From<Failure> for PyErr {
    fn from(failure: Failure) -> Self {
        let error = match failure {
            Failure::Python(error) => return error,
            Failure::Library(error) => error,
        };
        let kind = match error.kind() {
            ErrorKind::Usage => "usage",
            ErrorKind::Output => "output",
            _ => "input",
        };
        let raised = Error::new_err(error.to_string());
        Python::attach(|py| raised.value(py).setattr("kind", kind).map_or_else(|other| other, |()| raised))
    }
}
