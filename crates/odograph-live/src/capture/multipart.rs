//! Parser of `multipart/x-mixed-replace` (RFC 2046, section 5.1): a sequence of images in one HTTP
//! response.

use std::io::{self, BufRead, Read};

/// Maximum size of an image, bytes.
const MAX_PICTURE: usize = 32 << 20;
/// Maximum length of a part's header section, bytes.
const MAX_HEAD: u64 = 16 << 10;

/// Splits a body into its parts.
pub(super) struct Multipart<R> {
    reader: R,
    /// The line prefix between parts: two hyphens and the boundary.
    delimiter: Vec<u8>,
    /// Whether the delimiter of the next part has already been consumed.
    delimiter_taken: bool,
    /// When the camera took the image of the newest part.
    timestamp_s: Option<f64>,
}

fn damaged(what: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what)
}

/// Parses the boundary in a `Content-Type` header; `None` if its type is not multipart.
pub(super) fn boundary(content_type: &str) -> Option<String> {
    let (kind, parameters) = content_type.split_once(';')?;
    if !kind.trim().to_ascii_lowercase().starts_with("multipart/") {
        return None;
    }
    let value = parameters.split(';').find_map(|parameter| {
        let (name, value) = parameter.split_once('=')?;
        name.trim().eq_ignore_ascii_case("boundary").then(|| value.trim().trim_matches('"'))
    })?;
    // Some cameras include the two leading hyphens in the boundary itself.
    let bare = value.strip_prefix("--").unwrap_or(value);
    (!bare.is_empty() && bare.len() <= 200).then(|| bare.to_owned())
}

impl<R: BufRead> Multipart<R> {
    pub fn new(reader: R, boundary: &str) -> Self {
        Self {
            reader,
            delimiter: format!("--{boundary}").into_bytes(),
            delimiter_taken: false,
            timestamp_s: None,
        }
    }

    /// When the camera took the image of the newest part, seconds of its clock, where it says so
    /// (`X-Timestamp`).
    pub fn timestamp_s(&self) -> Option<f64> {
        self.timestamp_s
    }

    /// Reads the next part into `part`; `false` at the end.
    pub fn next(&mut self, part: &mut Vec<u8>) -> io::Result<bool> {
        part.clear();
        // Skips to the next delimiter line. Text before the first one has no meaning.
        let mut line = Vec::new();
        let mut skipped = 0;
        loop {
            self.line(&mut line)?;
            if line.is_empty() {
                return Ok(false);
            }
            let text = line.trim_ascii();
            if let Some(rest) = text.strip_prefix(self.delimiter.as_slice()) {
                if rest == b"--" {
                    return Ok(false);
                }
                break;
            }
            skipped += line.len();
            if skipped > MAX_PICTURE {
                return Err(damaged("the stream has no boundary where it should"));
            }
        }
        match self.head()? {
            Some(length) if length > MAX_PICTURE => Err(damaged("a picture of the stream is too large")),
            Some(length) => {
                let read = (&mut self.reader).take(length as u64).read_to_end(part)?;
                Ok(read == length)
            }
            None => self.until_delimiter(part),
        }
    }

    /// Reads the header section of a part and returns its `Content-Length`, if present.
    fn head(&mut self) -> io::Result<Option<usize>> {
        let mut length = None;
        self.timestamp_s = None;
        let mut line = Vec::new();
        let mut total = 0;
        loop {
            self.line(&mut line)?;
            total += line.len() as u64;
            if line.is_empty() || total > MAX_HEAD {
                return Err(damaged("the head of a picture in the stream does not end"));
            }
            let text = String::from_utf8_lossy(&line);
            let text = text.trim();
            if text.is_empty() {
                return Ok(length);
            }
            if let Some((name, value)) = text.split_once(':') {
                let (name, value) = (name.trim(), value.trim());
                if name.eq_ignore_ascii_case("content-length") {
                    length = value.parse().ok();
                } else if name.eq_ignore_ascii_case("x-timestamp") {
                    self.timestamp_s = value.parse().ok().filter(|seconds: &f64| seconds.is_finite());
                }
            }
        }
    }

    /// Reads a body of unknown length, up to the next line that starts with the delimiter.
    fn until_delimiter(&mut self, part: &mut Vec<u8>) -> io::Result<bool> {
        loop {
            let buffered = self.reader.fill_buf()?;
            if buffered.is_empty() {
                return Ok(false);
            }
            // A delimiter may span two reads, so the search starts a little before the new data.
            let before = part.len();
            let from = before.saturating_sub(self.delimiter.len() + 2);
            part.extend_from_slice(buffered);
            let taken = buffered.len();
            let found =
                part[from..].windows(self.delimiter.len()).position(|window| window == self.delimiter);
            if let Some(at) = found.map(|at| at + from) {
                // The delimiter may have begun in an earlier read; the rest of its line is still
                // unread.
                self.reader.consume((at + self.delimiter.len()).saturating_sub(before).min(taken));
                part.truncate(at);
                while part.last().is_some_and(|byte| *byte == b'\n' || *byte == b'\r') && part.len() + 2 > at
                {
                    part.pop();
                }
                self.delimiter_taken = true;
                return Ok(true);
            }
            self.reader.consume(taken);
            if part.len() > MAX_PICTURE {
                return Err(damaged("a picture of the stream is too large"));
            }
        }
    }

    /// Reads a line including its end; empty at the end of the stream.
    fn line(&mut self, line: &mut Vec<u8>) -> io::Result<()> {
        line.clear();
        if std::mem::take(&mut self.delimiter_taken) {
            line.extend_from_slice(&self.delimiter);
        }
        (&mut self.reader).take(MAX_HEAD).read_until(b'\n', line)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::BufReader;

    /// All parts of a body, read through a buffer of `size` bytes, so that any token may span two
    /// reads.
    fn parts(body: &[u8], size: usize) -> Vec<Vec<u8>> {
        let mut multipart = Multipart::new(BufReader::with_capacity(size, body), "cut");
        let mut parts = Vec::new();
        let mut part = Vec::new();
        while multipart.next(&mut part).unwrap() {
            parts.push(part.clone());
        }
        parts
    }

    #[test]
    fn parts_with_and_without_content_length_are_read() {
        let with = b"preamble\r\n--cut\r\nContent-Type: image/jpeg\r\nContent-Length: 9\r\n\r\none--cut\n\r\n--cut\r\ncontent-length: 3\r\n\r\ntwo\r\n--cut--\r\n";
        let without =
            b"--cut\r\nContent-Type: image/jpeg\r\n\r\none-\r-\n\r\n--cut\r\n\r\ntwo\r\n--cut--\r\n";
        for size in 1..40 {
            assert_eq!(parts(with, size), [b"one--cut\n".to_vec(), b"two".to_vec()], "{size}");
            assert_eq!(parts(without, size), [b"one-\r-\n".to_vec(), b"two".to_vec()], "{size}");
        }
    }

    #[test]
    fn truncated_streams_end_and_damaged_ones_are_errors() {
        let cut = b"--cut\r\nContent-Length: 3\r\n\r\none\r\n--cut\r\nContent-Length: 30\r\n\r\ntw";
        assert_eq!(parts(cut, 8), [b"one".to_vec()]);
        let mut part = Vec::new();
        let endless = [b"--cut\r\n".to_vec(), b"X: y\r\n".repeat(10_000)].concat();
        assert!(Multipart::new(&endless[..], "cut").next(&mut part).is_err());
        let large = b"--cut\r\nContent-Length: 999999999999\r\n\r\n";
        assert!(Multipart::new(&large[..], "cut").next(&mut part).is_err());
    }

    #[test]
    fn boundaries_of_real_cameras_are_parsed() {
        let known = |text| boundary(text).unwrap_or_default();
        assert_eq!(known("multipart/x-mixed-replace;boundary=abc"), "abc");
        assert_eq!(known("Multipart/x-mixed-replace; charset=x; boundary=\"--abc\""), "abc");
        assert_eq!(boundary("image/jpeg"), None);
        assert_eq!(boundary("multipart/x-mixed-replace; boundary="), None);
    }
}
