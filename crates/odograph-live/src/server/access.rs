//! Access control.

use super::http::Request;
use odograph::error::{Error, Result};

/// Name of the cookie that stores the token after the first request.
const COOKIE: &str = "odograph";

/// Generates a random token of 128 bits from the operating system.
///
/// # Errors
/// If the system's random number generator is not available.
pub fn new_token() -> Result<String> {
    random_token::<16>()
}

/// Generates a random token of `BYTES` bytes from the operating system, as hexadecimal digits.
///
/// # Errors
/// If the system's random number generator is not available.
pub fn random_token<const BYTES: usize>() -> Result<String> {
    let mut bytes = [0; BYTES];
    getrandom::fill(&mut bytes)
        .map_err(|error| Error::output(format!("the system gives no random token: {error}")))?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Decides which requests are allowed.
#[derive(Debug)]
pub struct Access {
    token: Option<String>,
}

/// Outcome of the access check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AccessVerdict {
    /// The request is answered.
    Allowed,
    /// The request is answered with a cookie that stores the token, so that later URLs need not
    /// contain it.
    AllowedWithCookie,
    /// The request is refused.
    Denied,
}

impl Access {
    /// Requires a token; without one, that the client is on this machine.
    pub fn new(token: Option<String>) -> Self {
        Self { token }
    }

    /// The value of the `Set-Cookie` header.
    pub fn cookie(&self) -> String {
        format!("{COOKIE}={}; Path=/; HttpOnly; SameSite=Strict", self.token.as_deref().unwrap_or_default())
    }

    /// Decides about a request.
    pub fn judge(&self, request: &Request) -> AccessVerdict {
        let Some(token) = &self.token else {
            // Without a token only this machine is served. A foreign page can make a local browser
            // send requests here under its own host name (DNS rebinding); the `Host` header reveals
            // that.
            let named = request.header("host").is_some_and(is_loopback_name);
            return if named && same_origin(request) {
                AccessVerdict::Allowed
            } else {
                AccessVerdict::Denied
            };
        };
        let known = |given: Option<&str>| given.is_some_and(|given| same(given.as_bytes(), token.as_bytes()));
        if !same_origin(request) {
            AccessVerdict::Denied
        } else if known(request.cookie(COOKIE)) || known(request.bearer()) {
            AccessVerdict::Allowed
        } else if known(request.query_value("token")) {
            AccessVerdict::AllowedWithCookie
        } else {
            AccessVerdict::Denied
        }
    }
}

/// Whether a request has the origin of this server, or no `Origin` header.
pub fn same_origin(request: &Request) -> bool {
    match request.header("origin") {
        None => true,
        Some(origin) => {
            origin.split_once("://").is_some_and(|(_, host)| Some(host) == request.header("host"))
        }
    }
}

/// Whether a `Host` header names this machine.
fn is_loopback_name(host: &str) -> bool {
    let name = match host.strip_prefix('[') {
        Some(rest) => return rest.split(']').next() == Some("::1"),
        None => host.split(':').next().unwrap_or_default(),
    };
    name.eq_ignore_ascii_case("localhost")
        || name.parse::<std::net::Ipv4Addr>().is_ok_and(|address| address.is_loopback())
}

/// Compares in constant time, so that the response time reveals nothing about the token.
pub fn same(given: &[u8], token: &[u8]) -> bool {
    given.len() == token.len()
        && given.iter().zip(token).fold(0, |different, (a, b)| different | (a ^ b)) == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_loopback_names_are_local() {
        for host in ["localhost:8080", "127.0.0.1", "127.9.9.9:1", "[::1]:8080", "LocalHost"] {
            assert!(is_loopback_name(host), "{host}");
        }
        for host in ["", "evil.example", "127.0.0.1.evil.example", "[::2]", "localhost.evil.example:80"] {
            assert!(!is_loopback_name(host), "{host}");
        }
    }

    #[test]
    fn tokens_differ_and_are_compared_in_full() {
        let token = new_token().unwrap();
        assert!(token.len() == 32 && token != new_token().unwrap());
        assert!(same(token.as_bytes(), token.as_bytes()));
        assert!(!same(&token.as_bytes()[..31], token.as_bytes()));
        assert!(!same(b"", token.as_bytes()));
    }
}
