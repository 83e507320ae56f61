//! Requests to a site.

use crate::encryption::TrustedAuthorities;
use crate::protocol::{SessionDescription, SiteStatus};
use odograph::error::{Error, Result};
use odograph_live::server::deadline::Deadlined;
use odograph_map::SessionOrigin;
use serde_json::Value;
use std::fmt;
use std::fs::File;
use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream, ToSocketAddrs};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Time limit for a connection.
const CONNECT_PATIENCE: Duration = Duration::from_secs(5);
/// Time limit for a request and its answer.
const EXCHANGE_PATIENCE: Duration = Duration::from_secs(60);
/// Longest pause without a byte sent or received. A site answers when the records are on disk,
/// 0.1 s after it has them: measured with 16 images of 640x480 pixels (2.2 MB), both cores busy.
const SILENCE_PATIENCE: Duration = Duration::from_secs(10);
/// Bytes of a body sent at a time, within that pause each: 6 kB/s are enough.
const PIECE: usize = 64 << 10;
/// Longest file with a token, bytes.
const MAX_TOKEN_FILE: u64 = 4096;
/// Longest answer, bytes.
const MAX_ANSWER: usize = 64 << 20;

/// Where a site is, and the token that it requires.
#[derive(Clone, PartialEq, Eq)]
pub struct SiteAddress {
    /// Host and port, as in the `Host` header.
    host: String,
    is_encrypted: bool,
    token: Option<String>,
}

impl fmt::Debug for SiteAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // The token is not for others to read.
        f.debug_struct("SiteAddress")
            .field("host", &self.host)
            .field("is_encrypted", &self.is_encrypted)
            .finish_non_exhaustive()
    }
}

impl fmt::Display for SiteAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}://{}/", if self.is_encrypted { "https" } else { "http" }, self.host)
    }
}

impl std::str::FromStr for SiteAddress {
    type Err = Error;

    /// Reads `http://HOST:PORT/?token=TOKEN` or `https://HOST:PORT/?token=TOKEN`, as a site prints
    /// it; port and token may be left out.
    fn from_str(text: &str) -> Result<Self> {
        let wrong = |what: &str| {
            Error::usage(format!(
                "the address of a site is http://HOST:{0}/?token=TOKEN or https://HOST:{0}/?token=TOKEN; {what}",
                super::DEFAULT_PORT
            ))
        };
        let (is_encrypted, rest) = match (text.strip_prefix("http://"), text.strip_prefix("https://")) {
            (Some(rest), _) => (false, rest),
            (_, Some(rest)) => (true, rest),
            _ => return Err(wrong("it begins with http:// or https://")),
        };
        let (host, path) = rest.split_once('/').unwrap_or((rest, ""));
        let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-.:[]".contains(&byte);
        if host.is_empty() || !host.bytes().all(plain) {
            return Err(wrong("the host is a name or a number of a machine"));
        }
        let token = match path.strip_prefix("?token=") {
            Some(token) if is_token(token) => Some(token.to_owned()),
            None if path.is_empty() => None,
            _ => return Err(wrong("nothing but a token of letters, digits and hyphens follows the host")),
        };
        // The colons of an IPv6 address are within its brackets.
        let port = host.rsplit_once(':').filter(|(before, _)| !before.contains(':') || before.ends_with(']'));
        let has_port = port.is_some();
        if port.is_some_and(|(_, port)| !port.parse::<u16>().is_ok_and(|port| port > 0)) {
            return Err(wrong("its port is a number from 1 to 65535"));
        }
        let host = if has_port { host.to_owned() } else { format!("{host}:{}", super::DEFAULT_PORT) };
        Ok(Self { host, is_encrypted, token })
    }
}

impl SiteAddress {
    /// The same site with the token that is in a file, alone, on its first line.
    ///
    /// # Errors
    /// If the file cannot be read, or contains no token.
    pub fn with_token_of(self, file: &Path) -> Result<Self> {
        let mut text = String::new();
        let shown = file.display();
        if self.token.is_some() {
            return Err(Error::usage(format!(
                "the address of the site has a token, and {shown} another; leave the one in the address away"
            )));
        }
        File::open(file)
            .and_then(|file| file.take(MAX_TOKEN_FILE).read_to_string(&mut text))
            .map_err(|error| Error::input(format!("the token in {shown} cannot be read: {error}")))?;
        let token = text.trim_end();
        if !is_token(token) {
            return Err(Error::input(format!(
                "{shown} has no token; one is a line of letters, digits and hyphens, as odograph site token add \
                 writes it"
            )));
        }
        Ok(Self { token: Some(token.to_owned()), ..self })
    }

    /// Whether the connection is encrypted.
    pub fn is_encrypted(&self) -> bool {
        self.is_encrypted
    }

    /// The host without its port and without the brackets of an IPv6 address.
    fn host_name(&self) -> &str {
        let host = self.host.rsplit_once(':').map_or(self.host.as_str(), |(host, _)| host);
        host.trim_start_matches('[').trim_end_matches(']')
    }

    /// Whether it has a token.
    pub fn has_token(&self) -> bool {
        self.token.is_some()
    }
}

fn is_token(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-')
}

/// Why a request has no answer.
#[derive(Debug)]
pub enum NoAnswer {
    /// The site cannot be reached or is not able to answer now: the request may be repeated.
    Unreachable(String),
    /// The site answers that it takes nothing now: the request may be repeated.
    NotNow(String),
    /// The site has other records of the session than the client assumed.
    OutOfOrder,
    /// The site refuses.
    Refused(String),
}

/// A client of a site.
#[derive(Debug, Clone)]
pub struct SiteClient {
    address: SiteAddress,
    authorities: Option<TrustedAuthorities>,
    silence: Duration,
    /// The connection of the request that is under way.
    under_way: Arc<Mutex<Option<TcpStream>>>,
}

impl SiteClient {
    /// A client; nothing is connected yet. For an encrypted address it needs
    /// [`SiteClient::trusting`].
    pub fn new(address: SiteAddress) -> Self {
        Self { address, authorities: None, silence: SILENCE_PATIENCE, under_way: Arc::default() }
    }

    /// The same, which accepts certificates of these authorities.
    #[must_use]
    pub fn trusting(self, authorities: TrustedAuthorities) -> Self {
        Self { authorities: Some(authorities), ..self }
    }

    /// Ends the request that is under way in another thread, which then has no answer.
    pub(crate) fn abort(&self) {
        if let Some(stream) = self.lock_under_way().take() {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }

    fn lock_under_way(&self) -> std::sync::MutexGuard<'_, Option<TcpStream>> {
        self.under_way.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The address.
    pub fn address(&self) -> &SiteAddress {
        &self.address
    }

    /// Everything that the page of the site shows.
    ///
    /// # Errors
    /// If the site cannot be reached, or refuses.
    pub fn state(&self) -> Result<Value> {
        self.request("GET", "/state", &[]).and_then(|body| parsed(&body)).map_err(|why| self.error(&why))
    }

    /// Withdraws, restores or trusts a robot: `action` is that word.
    ///
    /// # Errors
    /// If the site cannot be reached, refuses, or keeps the decision but merges nothing.
    pub fn set_robot(&self, robot: &str, action: &str) -> Result<()> {
        odograph_map::check_name(robot)?;
        let done = self.request("POST", &format!("/robots/{robot}/{action}"), &[]);
        let answer: Value = done.and_then(|body| parsed(&body)).map_err(|why| self.error(&why))?;
        match self.failure_in(&answer) {
            Some(failure) => {
                Err(Error::input(format!("the decision is kept and not carried out: {failure}")))
            }
            None => Ok(()),
        }
    }

    /// The sentence about a site that merges nothing, where an answer says so.
    pub fn failure_in(&self, answer: &Value) -> Option<String> {
        let failure: String =
            answer["failure"].as_str()?.chars().filter(|letter| !letter.is_control()).collect();
        Some(format!(
            "the site at {} merges nothing at the moment: {failure}; put that right there",
            self.address
        ))
    }

    pub(crate) fn describe(
        &self,
        description: &SessionDescription,
    ) -> std::result::Result<SiteStatus, NoAnswer> {
        let body = serde_json::to_vec(description).map_err(|error| NoAnswer::Refused(error.to_string()))?;
        parsed(&self.request("POST", "/sessions", &body)?)
    }

    pub(crate) fn send(
        &self,
        origin: &SessionOrigin,
        records: &[u8],
        lost: bool,
    ) -> std::result::Result<SiteStatus, NoAnswer> {
        let path = format!("/records/{}/{}?lost={lost}", origin.robot, origin.key);
        parsed(&self.request("POST", &path, records)?)
    }

    /// The sentence about a request without an answer.
    pub(crate) fn error(&self, why: &NoAnswer) -> Error {
        match why {
            NoAnswer::Unreachable(why) => Error::input(format!(
                "the site at {} cannot be reached: {why}; check the address, and that odograph site serve runs there",
                self.address
            )),
            NoAnswer::NotNow(why) => {
                Error::input(format!("the site at {} takes nothing at the moment: {why}", self.address))
            }
            NoAnswer::OutOfOrder => Error::input(format!("the site at {} misses records", self.address)),
            NoAnswer::Refused(why) => Error::input(format!("the site at {} refuses: {why}", self.address)),
        }
    }

    fn request(&self, method: &str, path: &str, body: &[u8]) -> std::result::Result<Vec<u8>, NoAnswer> {
        let (status, answer) =
            self.exchange(method, path, body).map_err(|error| NoAnswer::Unreachable(error.to_string()))?;
        if status == 200 {
            return Ok(answer);
        }
        let value: Value = serde_json::from_slice(&answer).unwrap_or_default();
        let problem = value["problem"].as_str().map_or_else(|| format!("status {status}"), str::to_owned);
        Err(match status {
            409 if value.get("acknowledged").is_some() => NoAnswer::OutOfOrder,
            408 | 429 | 500.. => NoAnswer::NotNow(problem),
            _ => NoAnswer::Refused(problem),
        })
    }

    /// The error of a connection, in words where the site was silent.
    fn silent(&self, error: io::Error) -> io::Error {
        if !is_late(&error) {
            return error;
        }
        io::Error::new(
            io::ErrorKind::TimedOut,
            format!("it is connected and has not answered within {:?}", self.silence),
        )
    }

    /// Status code and body of the answer.
    fn exchange(&self, method: &str, path: &str, body: &[u8]) -> io::Result<(u16, Vec<u8>)> {
        let mut last = io::Error::new(io::ErrorKind::NotFound, "the host has no address");
        for address in self.address.host.to_socket_addrs()? {
            match TcpStream::connect_timeout(&address, CONNECT_PATIENCE) {
                Ok(stream) => return self.exchange_over(stream, method, path, body),
                Err(error) => last = error,
            }
        }
        Err(last)
    }

    fn exchange_over(
        &self,
        stream: TcpStream,
        method: &str,
        path: &str,
        body: &[u8],
    ) -> io::Result<(u16, Vec<u8>)> {
        stream.set_nodelay(true)?;
        *self.lock_under_way() = Some(stream.try_clone()?);
        let begun = Instant::now();
        let allowed = || self.silence.min(EXCHANGE_PATIENCE.saturating_sub(begun.elapsed()));
        let mut stream = Deadlined::new(stream, allowed());
        if self.address.is_encrypted {
            let Some(authorities) = &self.authorities else {
                return Err(io::Error::other(
                    "no authority is trusted, so that its certificate cannot be checked",
                ));
            };
            stream = stream.encrypted(authorities.connected(self.address.host_name())?);
        }
        let mut head =
            format!("{method} {path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n", self.address.host);
        if let Some(token) = &self.address.token {
            head += &format!("Authorization: Bearer {token}\r\n");
        }
        head += &format!("Content-Length: {}\r\n\r\n", body.len());
        // A site that refuses early does not read the body: its answer counts.
        let sent = stream.write_all(head.as_bytes()).and_then(|()| {
            body.chunks(PIECE).try_for_each(|piece| {
                stream.allow(allowed());
                stream.write_all(piece)
            })
        });
        if sent.as_ref().is_err_and(is_late) {
            return Err(self.silent(io::ErrorKind::TimedOut.into()));
        }
        let mut bytes = Vec::new();
        let mut piece = vec![0; 64 << 10];
        loop {
            stream.allow(allowed());
            match stream.read(&mut piece) {
                Ok(0) => break,
                Ok(read) => bytes.extend_from_slice(&piece[..read]),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(_) if !bytes.is_empty() => break,
                Err(error) => return Err(self.silent(sent.err().unwrap_or(error))),
            }
            if bytes.len() > MAX_ANSWER {
                return Err(io::Error::other("the answer is too long"));
            }
        }
        self.lock_under_way().take();
        let mut space = [httparse::EMPTY_HEADER; 64];
        let mut answer = httparse::Response::new(&mut space);
        let length = match answer.parse(&bytes) {
            Ok(httparse::Status::Complete(length)) => length,
            // An alert of TLS.
            _ if bytes.first() == Some(&21) => {
                return Err(io::Error::other("it answers in TLS; perhaps its address begins with https://"));
            }
            _ => return Err(io::Error::other("the answer is not HTTP, or is cut off")),
        };
        let stated = answer.headers.iter().find(|header| header.name.eq_ignore_ascii_case("content-length"));
        let stated =
            stated.and_then(|header| std::str::from_utf8(header.value).ok()?.trim().parse::<usize>().ok());
        let body = &bytes[length..];
        match stated.and_then(|stated| body.get(..stated)) {
            Some(body) => Ok((answer.code.unwrap_or(0), body.to_vec())),
            None => Err(io::Error::other("the answer is cut off")),
        }
    }
}

/// Whether a socket's time limit has passed, by either name that systems have for it.
fn is_late(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::TimedOut | io::ErrorKind::WouldBlock)
}

fn parsed<T: serde::de::DeserializeOwned>(body: &[u8]) -> std::result::Result<T, NoAnswer> {
    serde_json::from_slice(body)
        .map_err(|error| NoAnswer::Unreachable(format!("its answer is none: {error}")))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test fails by panicking
mod tests {
    use super::*;

    #[test]
    fn a_site_that_accepts_and_never_answers_is_given_up() {
        let silent = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("http://{}/", silent.local_addr().unwrap()).parse().unwrap();
        let client = SiteClient { silence: Duration::from_millis(50), ..SiteClient::new(address) };
        // More than the sockets hold, too.
        for body in [0, 12 << 20] {
            let NoAnswer::Unreachable(why) = client.request("POST", "/sessions", &vec![0; body]).unwrap_err()
            else {
                panic!("it may be tried again");
            };
            assert_eq!(why, "it is connected and has not answered within 50ms");
        }
    }

    #[test]
    fn addresses_are_read_as_a_site_prints_them() {
        let read = |text: &str| text.parse::<SiteAddress>().map(|address| (address.host, address.token));
        let token = || Some("ab-12".to_owned());
        assert_eq!(read("http://127.0.0.1:8137/").unwrap(), ("127.0.0.1:8137".to_owned(), None));
        assert_eq!(read("http://hall/?token=ab-12").unwrap(), ("hall:8137".to_owned(), token()));
        assert_eq!(read("http://[::1]:80").unwrap(), ("[::1]:80".to_owned(), None));
        assert_eq!(read("http://[::1]").unwrap(), ("[::1]:8137".to_owned(), None));
        let encrypted: SiteAddress = "https://[::1]:80/?token=ab-12".parse().unwrap();
        assert!(encrypted.is_encrypted() && encrypted.host_name() == "::1");
        assert_eq!(encrypted.to_string(), "https://[::1]:80/");
        for text in [
            "hall:8137",
            "ftp://hall/",
            "http:///",
            "http://a b/",
            "http://hall/x",
            "http://h/?token=a\r\n",
            "http://h:99999/",
            "http://h:0/",
            "http://h:/",
        ] {
            assert!(read(text).is_err(), "{text}");
        }
        let address: SiteAddress = "http://hall/?token=secret-1".parse().unwrap();
        assert!(!format!("{address:?} {address}").contains("secret"));
        assert!(address.has_token() && address.to_string() == "http://hall:8137/");
    }

    #[test]
    fn a_token_is_read_from_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("token");
        let site = |address: &str| address.parse::<SiteAddress>().unwrap().with_token_of(&file);
        assert!(site("http://hall/").unwrap_err().to_string().contains("cannot be read"));
        std::fs::write(&file, "ab-12\n").unwrap();
        assert_eq!(site("http://hall/").unwrap().token.as_deref(), Some("ab-12"));
        let two = site("http://hall/?token=other").unwrap_err().to_string();
        assert!(two.contains(" another; ") && !two.contains("ab-12"), "{two}");
        for text in ["", "\n", "ab 12", "ab\ncd", "ab\u{e9}"] {
            std::fs::write(&file, text).unwrap();
            let complaint = site("http://hall/").unwrap_err().to_string();
            assert!(complaint.contains("has no token"), "{text:?}: {complaint}");
        }
    }
}
