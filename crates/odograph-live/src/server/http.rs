//! HTTP/1.1 requests and responses (RFC 9112), reduced to what the page needs.

use super::deadline::{Deadlined, Encryption};
use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

/// Maximum length of a request's header section, bytes.
const MAX_HEAD: usize = 8 << 10;
/// Maximum length of a request's body unless the server admits more, bytes.
const MAX_BODY: usize = 4 << 10;
/// Time limit for a complete request, from the previous response or from the start of the
/// connection.
const REQUEST_PATIENCE: Duration = Duration::from_secs(8);
/// Time limit for a body that is longer than that.
const BODY_PATIENCE: Duration = Duration::from_secs(60);
/// Time limit for sending a response that is held in memory.
pub const ANSWER_PATIENCE: Duration = Duration::from_secs(15);

/// A valid request.
#[derive(Debug, Clone, PartialEq)]
pub struct Request {
    /// The method.
    pub method: Method,
    /// Without the query.
    pub path: String,
    /// The part after `?`.
    pub query: String,
    /// Header names are in lower case.
    headers: Vec<(String, String)>,
    /// The body.
    pub body: Vec<u8>,
    /// Whether the client wants to send further requests.
    pub keep_alive: bool,
}

/// The methods that are answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// Reads.
    Get,
    /// Reads without the body.
    Head,
    /// Changes.
    Post,
}

/// The reason why a request is refused: HTTP status code and reason phrase.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HttpRefusal(pub u16, pub &'static str);

impl Request {
    /// The value of a header; `name` must be in lower case.
    pub fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(known, _)| known == name).map(|(_, value)| value.as_str())
    }

    /// The bearer token.
    pub fn bearer(&self) -> Option<&str> {
        self.header("authorization").and_then(|value| value.strip_prefix("Bearer "))
    }

    /// The value of a query parameter.
    pub fn query_value(&self, key: &str) -> Option<&str> {
        self.query.split('&').filter_map(|pair| pair.split_once('=')).find(|(k, _)| *k == key).map(|(_, v)| v)
    }

    /// The value of a cookie.
    pub fn cookie(&self, name: &str) -> Option<&str> {
        let cookies = self.header("cookie")?.split(';').filter_map(|pair| pair.trim().split_once('='));
        cookies.into_iter().find(|(known, _)| *known == name).map(|(_, value)| value)
    }
}

/// Reads requests from a connection.
#[derive(Debug)]
pub struct RequestReader {
    stream: Deadlined,
    buffer: Vec<u8>,
}

impl RequestReader {
    /// A reader of a new connection.
    pub fn new(stream: TcpStream) -> Self {
        Self { stream: Deadlined::new(stream, REQUEST_PATIENCE), buffer: Vec::new() }
    }

    /// A reader of a new connection that is encrypted.
    pub fn encrypted(stream: TcpStream, encryption: Box<dyn Encryption>) -> Self {
        let stream = Deadlined::new(stream, REQUEST_PATIENCE).encrypted(encryption);
        Self { stream, buffer: Vec::new() }
    }

    /// The connection, for writing a response.
    pub fn stream(&mut self) -> &mut Deadlined {
        &mut self.stream
    }

    /// Returns the connection; buffered bytes are discarded.
    pub fn into_stream(self) -> Deadlined {
        self.stream
    }

    /// The next request; `None` if the client closed the connection or sent nothing in time.
    ///
    /// # Errors
    /// If it is invalid, incomplete, or longer than any that is answered.
    #[allow(clippy::should_implement_trait)] // a refusal ends the connection, not an iteration
    pub fn next(&mut self) -> Result<Option<Request>, HttpRefusal> {
        self.next_admitted(&|_| Ok(MAX_BODY))
    }

    /// As [`RequestReader::next`]; `admit` sees the request without its body, and refuses it or
    /// says how long its body may be, before any of that is read.
    ///
    /// # Errors
    /// As [`RequestReader::next`], and what `admit` refuses.
    pub fn next_admitted(
        &mut self,
        admit: &dyn Fn(&Request) -> Result<usize, HttpRefusal>,
    ) -> Result<Option<Request>, HttpRefusal> {
        self.stream.allow(REQUEST_PATIENCE);
        let (mut request, head_length, body_length) = loop {
            match parse_head(&self.buffer)? {
                Some(parsed) => break parsed,
                None if self.buffer.len() >= MAX_HEAD => {
                    return Err(HttpRefusal(431, "Request Header Fields Too Large"));
                }
                None => {}
            }
            if !self.read_more(MAX_HEAD)? {
                return if self.buffer.is_empty() {
                    Ok(None)
                } else {
                    Err(HttpRefusal(408, "Request Timeout"))
                };
            }
        };
        if body_length > admit(&request)? {
            return Err(HttpRefusal(413, "Content Too Large"));
        }
        if body_length > MAX_BODY {
            self.stream.allow(BODY_PATIENCE);
        }
        while self.buffer.len() < head_length + body_length {
            if !self.read_more(head_length + body_length)? {
                return Err(HttpRefusal(408, "Request Timeout"));
            }
        }
        // What follows is the next request: the memory of a large body goes with it.
        let rest = self.buffer.split_off(head_length + body_length);
        request.body = std::mem::replace(&mut self.buffer, rest);
        request.body.drain(..head_length);
        Ok(Some(request))
    }

    /// Reads once, until the buffer holds at most `most` bytes. `false` at the end of the stream or
    /// after the deadline.
    fn read_more(&mut self, most: usize) -> Result<bool, HttpRefusal> {
        let before = self.buffer.len();
        self.buffer.resize(most.max(before + 1), 0);
        let read = self.stream.read(&mut self.buffer[before..]).unwrap_or(0);
        self.buffer.truncate(before + read);
        Ok(read > 0)
    }
}

/// Parses a request without its body. Returns it with the length of its header section and of its
/// body, or `None` while the header section is incomplete.
fn parse_head(bytes: &[u8]) -> Result<Option<(Request, usize, usize)>, HttpRefusal> {
    let mut space = [httparse::EMPTY_HEADER; 64];
    let mut head = httparse::Request::new(&mut space);
    let length = match head.parse(bytes) {
        Ok(httparse::Status::Complete(length)) => length,
        Ok(httparse::Status::Partial) => return Ok(None),
        Err(httparse::Error::TooManyHeaders) => {
            return Err(HttpRefusal(431, "Request Header Fields Too Large"));
        }
        Err(_) => return Err(HttpRefusal(400, "Bad Request")),
    };
    let method = match head.method {
        Some("GET") => Method::Get,
        Some("HEAD") => Method::Head,
        Some("POST") => Method::Post,
        _ => return Err(HttpRefusal(405, "Method Not Allowed")),
    };
    let text = |value: &[u8]| String::from_utf8_lossy(value).trim().to_owned();
    let headers: Vec<_> = head.headers.iter().map(|h| (h.name.to_ascii_lowercase(), text(h.value))).collect();
    let target = head.path.unwrap_or("/");
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    let mut request = Request {
        method,
        path: path.to_owned(),
        query: query.to_owned(),
        headers,
        body: Vec::new(),
        keep_alive: head.version == Some(1),
    };
    if request.header("connection").is_some_and(|value| value.eq_ignore_ascii_case("close")) {
        request.keep_alive = false;
    }
    // A request with two conflicting lengths enables request smuggling; no client of this page
    // needs `Transfer-Encoding`.
    if request.header("transfer-encoding").is_some() {
        return Err(HttpRefusal(411, "Length Required"));
    }
    let lengths: Vec<_> = request.headers.iter().filter(|(name, _)| name == "content-length").collect();
    let body_length = match lengths.as_slice() {
        [] => 0,
        [(_, value)] => value.parse::<usize>().map_err(|_| HttpRefusal(400, "Bad Request"))?,
        _ => return Err(HttpRefusal(400, "Bad Request")),
    };
    Ok(Some((request, length, body_length)))
}

/// Parses the header section of a request and looks into it, for the fuzz target.
#[cfg(fuzzing)]
pub(super) fn read_head(bytes: &[u8]) {
    if let Ok(Some((request, ..))) = parse_head(bytes) {
        let _ = (request.query_value("token"), request.cookie("odograph"));
    }
}

/// What the page may load and run: its own files.
const PAGE_POLICY: &str = "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; frame-ancestors 'none'";

/// An HTTP response.
#[derive(Debug, Default)]
pub struct Answer {
    /// Status code.
    pub status: u16,
    /// Reason phrase.
    pub reason: &'static str,
    /// Media type of the body.
    pub content_type: &'static str,
    /// Content security policy; `None` for that of the page.
    pub policy: Option<&'static str>,
    /// Further headers.
    pub headers: Vec<(&'static str, String)>,
    /// The body.
    pub body: Vec<u8>,
}

impl Answer {
    /// A successful response.
    pub fn ok(content_type: &'static str, body: impl Into<Vec<u8>>) -> Self {
        Self { status: 200, reason: "OK", content_type, policy: None, headers: Vec::new(), body: body.into() }
    }

    /// A successful response that has no content.
    pub fn nothing() -> Self {
        Self { status: 204, reason: "No Content", ..Self::ok("", []) }
    }

    /// A response that says why a request is refused.
    pub fn refusal(HttpRefusal(status, reason): HttpRefusal) -> Self {
        let body = format!("{reason}\n").into_bytes();
        Self { status, reason, content_type: "text/plain; charset=utf-8", body, ..Self::default() }
    }

    /// The same with a further header.
    #[must_use]
    pub fn with(mut self, name: &'static str, value: impl Into<String>) -> Self {
        self.headers.push((name, value.into()));
        self
    }

    /// The status line and headers, for a body of `length` bytes.
    pub fn head(&self, length: u64, keep_alive: bool) -> String {
        let mut head = format!("HTTP/1.1 {} {}\r\n", self.status, self.reason);
        // A response without content has neither (RFC 9110, section 8.6).
        if self.status != 204 {
            head += &format!("Content-Type: {}\r\nContent-Length: {length}\r\n", self.content_type);
        }
        head += &format!("Connection: {}\r\n", if keep_alive { "keep-alive" } else { "close" });
        // Nothing is loaded from other origins, no other page may embed this one, and the browser
        // caches nothing.
        head +=
            "Cache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n";
        head += &format!("Content-Security-Policy: {}\r\n", self.policy.unwrap_or(PAGE_POLICY));
        for (name, value) in &self.headers {
            head += &format!("{name}: {value}\r\n");
        }
        head + "\r\n"
    }

    /// Sends the response within the time limit.
    ///
    /// # Errors
    /// If the client does not take it.
    pub fn write(&self, stream: &mut Deadlined, request: &Request) -> io::Result<()> {
        stream.allow(ANSWER_PATIENCE);
        let mut bytes = self.head(self.body.len() as u64, request.keep_alive).into_bytes();
        if request.method != Method::Head {
            bytes.extend_from_slice(&self.body);
        }
        stream.write_all(&bytes)
    }
}

/// Responds to an invalid request and ends the connection.
///
/// # Errors
/// If the client does not take the response.
pub fn refuse(stream: Deadlined, refusal: HttpRefusal) -> io::Result<()> {
    refuse_with(stream, &Answer::refusal(refusal))
}

/// Responds to a request whose body is not read, and ends the connection.
///
/// # Errors
/// If the client does not take the response.
pub fn refuse_with(mut stream: Deadlined, answer: &Answer) -> io::Result<()> {
    stream.allow(Duration::from_secs(2));
    let mut bytes = answer.head(answer.body.len() as u64, false).into_bytes();
    bytes.extend_from_slice(&answer.body);
    stream.write_all(&bytes)?;
    // Closing a socket with unread bytes would reset it, and the client might lose the response.
    let mut rest = [0; 1 << 14];
    stream.allow(Duration::from_millis(500));
    for _ in 0..16 {
        if !stream.read(&mut rest).is_ok_and(|read| read > 0) {
            break;
        }
    }
    Ok(())
}

/// File names come from the command line. Characters that a header value cannot hold are replaced.
pub(super) fn safe_in_header(letter: char) -> char {
    if letter.is_ascii_graphic() && !matches!(letter, '"' | '\\') || letter == ' ' { letter } else { '_' }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(text: &str) -> Option<u16> {
        parse_head(text.as_bytes()).err().map(|HttpRefusal(status, _)| status)
    }

    #[test]
    fn request_headers_are_parsed_once_they_are_complete() {
        let text =
            "GET /tiles/1/2.png?r=3&token=a HTTP/1.1\r\nHost: here\r\nCookie: a=1; odograph=xyz\r\n\r\n";
        let (request, length, body) = parse_head(text.as_bytes()).unwrap().unwrap();
        assert_eq!((request.path.as_str(), length, body), ("/tiles/1/2.png", text.len(), 0));
        assert_eq!((request.query_value("token"), request.cookie("odograph")), (Some("a"), Some("xyz")));
        assert!(request.keep_alive && request.header("host") == Some("here"));
        for end in 0..text.len() {
            assert_eq!(parse_head(&text.as_bytes()[..end]), Ok(None), "{end}");
        }
    }

    #[test]
    fn invalid_and_oversized_requests_are_refused() {
        assert_eq!(refused("BREW / HTTP/1.1\r\n\r\n"), Some(405));
        assert_eq!(refused("\x00\x01\x02\r\n\r\n"), Some(400));
        assert_eq!(refused("GET / HTTP/9.9\r\n\r\n"), Some(400));
        assert_eq!(refused("POST / HTTP/1.1\r\nContent-Length: -1\r\n\r\n"), Some(400));
        assert_eq!(refused("POST / HTTP/1.1\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n"), Some(400));
        assert_eq!(refused("POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n"), Some(411));
        let many = "X: y\r\n".repeat(65);
        assert_eq!(refused(&format!("GET / HTTP/1.1\r\n{many}\r\n")), Some(431));
    }
}
