//! TLS between robots and site, by rustls.

use odograph::error::{Error, Result};
use odograph_live::server::deadline::{DeadlinedSocket, Encryption};
use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, ClientConnection, Connection, RootCertStore, ServerConfig, ServerConnection};
use std::fs::File;
use std::io::{self, Read, Write};
use std::path::Path;
use std::sync::Arc;

/// Largest file with certificates or a key, bytes.
const MAX_FILE: u64 = 4 << 20;

/// The certificate and key with which a site serves HTTPS.
#[derive(Debug, Clone)]
pub struct SiteIdentity(Arc<ServerConfig>);

/// The authorities whose certificates a robot accepts.
#[derive(Debug, Clone)]
pub struct TrustedAuthorities(Arc<ClientConfig>);

impl SiteIdentity {
    /// Reads a chain of certificates, that of the site first, and its private key, both as PEM.
    ///
    /// # Errors
    /// If a file cannot be read, or if the key is not that of the certificate.
    pub fn from_files(certificate: &Path, key: &Path) -> Result<Self> {
        let chain = certificates(certificate)?;
        let key_der = PrivateKeyDer::from_pem_slice(&bytes(key)?).map_err(|error| {
            Error::input(format!(
                "{} has no private key ({error}); give an unencrypted key as PEM",
                key.display()
            ))
        })?;
        let wrong = |error: rustls::Error| {
            Error::input(format!(
                "{} and {} are not a certificate and its key: {error}",
                certificate.display(),
                key.display()
            ))
        };
        let config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()
            .and_then(|builder| builder.with_no_client_auth().with_single_cert(chain, key_der))
            .map_err(wrong)?;
        Ok(Self(Arc::new(config)))
    }

    /// For a connection that was accepted.
    pub(crate) fn accepted(&self) -> io::Result<Box<dyn Encryption>> {
        let connection = ServerConnection::new(Arc::clone(&self.0)).map_err(io::Error::other)?;
        Ok(Box::new(Tls(connection.into())))
    }
}

impl TrustedAuthorities {
    /// Those in a file of PEM certificates, or those that the system trusts.
    ///
    /// # Errors
    /// If the file has no certificate that can be used, or if the system trusts nobody.
    pub fn from_file_or_system(file: Option<&Path>) -> Result<Self> {
        let mut roots = RootCertStore::empty();
        match file {
            Some(file) => {
                for certificate in certificates(file)? {
                    roots.add(certificate).map_err(|error| {
                        Error::input(format!("a certificate in {} cannot be used: {error}", file.display()))
                    })?;
                }
            }
            None => {
                roots.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
                if roots.is_empty() {
                    return Err(Error::input(
                        "this system trusts no authority, so that an https:// address cannot be checked; install the \
                         package ca-certificates, or give the certificate of the site's authority with \
                         --site-certificate",
                    ));
                }
            }
        }
        let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()
            .map_err(|error| Error::output(format!("TLS cannot be used: {error}")))?
            .with_root_certificates(roots)
            .with_no_client_auth();
        Ok(Self(Arc::new(config)))
    }

    /// For a connection to a host, whose certificate must name it.
    pub(crate) fn connected(&self, host: &str) -> io::Result<Box<dyn Encryption>> {
        let name = ServerName::try_from(host.to_owned()).map_err(io::Error::other)?;
        let connection = ClientConnection::new(Arc::clone(&self.0), name).map_err(io::Error::other)?;
        Ok(Box::new(Tls(connection.into())))
    }
}

fn certificates(file: &Path) -> Result<Vec<CertificateDer<'static>>> {
    let parsed: std::result::Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&bytes(file)?).collect();
    let what = match parsed {
        Ok(certificates) if !certificates.is_empty() => return Ok(certificates),
        Ok(_) => String::new(),
        Err(error) => format!(" ({error})"),
    };
    Err(Error::input(format!("{} has no certificate{what}; give one as PEM", file.display())))
}

fn bytes(path: &Path) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let read = File::open(path).and_then(|file| file.take(MAX_FILE).read_to_end(&mut bytes));
    read.map_err(|error| Error::input(format!("{} cannot be read: {error}", path.display())))?;
    Ok(bytes)
}

/// A TLS connection over a socket with a deadline.
#[derive(Debug)]
struct Tls(Connection);

impl Tls {
    /// The handshake, and what is left to write.
    fn begin(&mut self, socket: &mut DeadlinedSocket) -> io::Result<()> {
        while self.0.is_handshaking() {
            self.0.complete_io(socket)?;
        }
        self.send(socket)
    }

    fn send(&mut self, socket: &mut DeadlinedSocket) -> io::Result<()> {
        while self.0.wants_write() {
            self.0.write_tls(socket)?;
        }
        Ok(())
    }
}

impl Encryption for Tls {
    fn read(&mut self, socket: &mut DeadlinedSocket, buffer: &mut [u8]) -> io::Result<usize> {
        self.begin(socket).map_err(in_words)?;
        while self.0.wants_read() {
            if self.0.complete_io(socket).map_err(in_words)?.0 == 0 {
                break;
            }
        }
        self.0.reader().read(buffer)
    }

    fn write(&mut self, socket: &mut DeadlinedSocket, bytes: &[u8]) -> io::Result<usize> {
        self.begin(socket).map_err(in_words)?;
        let written = self.0.writer().write(bytes)?;
        self.send(socket)?;
        Ok(written)
    }

    fn close(&mut self, socket: &mut DeadlinedSocket) {
        self.0.send_close_notify();
        let _ = self.send(socket);
    }
}

/// The error of a TLS connection, with what to do about it.
fn in_words(error: io::Error) -> io::Error {
    let what = match error.get_ref().and_then(|inner| inner.downcast_ref::<rustls::Error>()) {
        Some(rustls::Error::InvalidCertificate(why)) => format!(
            "its certificate is not trusted: {why}; give that of its authority with --site-certificate, and the \
             name that is in the certificate as host"
        ),
        Some(rustls::Error::InvalidMessage(_)) => {
            "it does not answer in TLS; perhaps its address begins with http://".to_owned()
        }
        _ => return error,
    };
    io::Error::new(error.kind(), what)
}
