//! URLs of HTTP streams.

use super::without_credentials;
use odograph::error::{Error, Result};

/// The parts of an `http://` URL.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct HttpUrl {
    pub host: String,
    pub port: u16,
    /// Including the query.
    pub path: String,
    /// `user:password`.
    pub credentials: Option<String>,
}

impl HttpUrl {
    pub fn parse(text: &str) -> Result<Self> {
        let wrong = || {
            let shown = without_credentials(text);
            Error::usage(format!("{shown} is not an address as http://192.168.1.20:8080/video"))
        };
        let rest = text.strip_prefix("http://").ok_or_else(wrong)?;
        let (authority, path) = match rest.find(['/', '?']) {
            Some(at) if rest[at..].starts_with('/') => (&rest[..at], rest[at..].to_owned()),
            Some(at) => (&rest[..at], format!("/{}", &rest[at..])),
            None => (rest, "/".to_owned()),
        };
        let path = path.split('#').next().unwrap_or_default().to_owned();
        let (credentials, place) = match authority.rsplit_once('@') {
            Some((credentials, place)) => (Some(credentials.to_owned()), place),
            None => (None, authority),
        };
        let (host, port) = match place.strip_prefix('[').and_then(|inside| inside.split_once(']')) {
            Some((host, rest)) => (host, rest.strip_prefix(':')),
            None => match place.split_once(':') {
                Some((host, port)) => (host, Some(port)),
                None => (place, None),
            },
        };
        let port = port.map_or(Ok(80), str::parse).map_err(|_| wrong())?;
        // Control characters and spaces could end the request line and inject headers.
        let harmless = |text: &str| text.chars().all(|c| !c.is_control() && c != ' ');
        if host.is_empty() || !harmless(host) || !harmless(&path) {
            return Err(wrong());
        }
        Ok(Self { host: host.to_owned(), port, path, credentials })
    }

    /// The value of the `Host` header.
    pub fn host_header(&self) -> String {
        let host = if self.host.contains(':') { format!("[{}]", self.host) } else { self.host.clone() };
        if self.port == 80 { host } else { format!("{host}:{}", self.port) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn valid_urls_are_parsed_and_invalid_ones_refused() {
        let url = HttpUrl::parse("http://me:secret@[::1]:8081/video?a=b#c").unwrap();
        assert_eq!((url.host.as_str(), url.port, url.path.as_str()), ("::1", 8081, "/video?a=b"));
        assert_eq!((url.credentials.as_deref(), url.host_header()), (Some("me:secret"), "[::1]:8081".into()));
        let url = HttpUrl::parse("http://phone?x").unwrap();
        assert_eq!((url.port, url.path.as_str(), url.host_header()), (80, "/?x", "phone".into()));
        for wrong in
            ["http://", "http://:80/", "http://a:b/", "ftp://a/", "http://a:99999/", "http://a/\r\nX: y"]
        {
            assert!(HttpUrl::parse(wrong).is_err(), "{wrong}");
        }
        let message = HttpUrl::parse("http://me:secret@hall:99999/").unwrap_err().to_string();
        assert!(message.starts_with("http://hall:99999/ is not an address"), "{message}");
    }
}
