//! The place of TLS in a program that is built without it: files are refused, so that there is
//! never a connection to encrypt.

use odograph::error::{Error, Result};
use odograph_live::server::deadline::Encryption;
use std::convert::Infallible;
use std::io;
use std::path::Path;

/// The certificate and key with which a site serves HTTPS.
#[derive(Debug, Clone)]
pub struct SiteIdentity(Infallible);

/// The authorities whose certificates a robot accepts.
#[derive(Debug, Clone)]
pub struct TrustedAuthorities(Infallible);

impl SiteIdentity {
    /// Fails: there is no TLS.
    ///
    /// # Errors
    /// Always.
    pub fn from_files(_certificate: &Path, _key: &Path) -> Result<Self> {
        Err(not_built())
    }

    pub(crate) fn accepted(&self) -> io::Result<Box<dyn Encryption>> {
        match self.0 {}
    }
}

impl TrustedAuthorities {
    /// Fails: there is no TLS.
    ///
    /// # Errors
    /// Always.
    pub fn from_file_or_system(_file: Option<&Path>) -> Result<Self> {
        Err(not_built())
    }

    pub(crate) fn connected(&self, _host: &str) -> io::Result<Box<dyn Encryption>> {
        match self.0 {}
    }
}

fn not_built() -> Error {
    Error::usage(
        "this program is built without encryption (TLS); build it with cargo build --release --features tls, or use \
         http:// through a tunnel",
    )
}
