//! Motion JPEG over HTTP (`multipart/x-mixed-replace`), as phones and network cameras send it.

use super::back_off::BackOff;
use super::multipart::{Multipart, boundary};
use super::url::HttpUrl;
use super::{Captured, LiveSource, Watch, check_size};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use odograph::error::{Error, Result};
use odograph_video::{ArrivalClock, Frame, Picture, SourceInfo};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Time limit for the camera's response, and for each read of an image.
const PATIENCE: Duration = Duration::from_secs(5);
/// Time limit for the whole header section of the response, however it is spread.
const HEAD_PATIENCE: Duration = Duration::from_secs(10);
/// Time limit for each image, from the end of the one before.
const PICTURE_PATIENCE: Duration = Duration::from_secs(20);
/// Maximum length of the camera's own words in a message, characters.
const MAX_QUOTED: usize = 200;
/// Maximum length of the response's header section, bytes.
const MAX_HEAD: u64 = 16 << 10;

/// A Motion JPEG stream over HTTP.
pub struct HttpMjpeg {
    url: HttpUrl,
    place: String,
    info: SourceInfo,
    connection: Option<Connection>,
    first: Option<Arrived>,
    began: Instant,
    number: u64,
    clock: FrameClock,
    patience: Duration,
    part: Vec<u8>,
    damaged: u64,
    watch: Watch,
    warnings: Vec<String>,
}

/// An image with its arrival, and the time that its camera states, seconds of the camera's clock.
struct Arrived {
    picture: Picture,
    at: Instant,
    stamp_s: Option<f64>,
}

/// Times of the frames: those that the camera states, otherwise those of a clock fitted to the
/// arrivals.
#[derive(Default)]
struct FrameClock {
    arrivals: ArrivalClock,
    /// Time of the previous frame, and the stamp that it had, seconds.
    last: Option<(f64, Option<f64>)>,
    /// What is added to the camera's time stamps, seconds.
    shift_s: Option<f64>,
    /// Whether two frames had the same stamp, so that stamps are not times of single frames.
    distrusted: bool,
}

/// Stamps that differ more than this from the arrivals, seconds, are of a clock that was set.
const MAX_STAMP_ERROR_S: f64 = 1.5;

impl FrameClock {
    fn time_s(&mut self, arrival_s: f64, stamp_s: Option<f64>) -> f64 {
        let modelled_s = self.arrivals.time_s(arrival_s);
        let (last_s, last_stamp_s) = self.last.unzip();
        // Whole seconds, or a stamp of the stream, repeat.
        self.distrusted |= stamp_s.is_some() && last_stamp_s.flatten() == stamp_s;
        let time_s = match stamp_s.filter(|_| !self.distrusted) {
            Some(stamp_s) => {
                let stated_s = stamp_s + *self.shift_s.get_or_insert(modelled_s - stamp_s);
                let ordered = last_s.is_none_or(|last_s| stated_s > last_s);
                if ordered && (stated_s - modelled_s).abs() < MAX_STAMP_ERROR_S {
                    stated_s
                } else {
                    self.shift_s = Some(modelled_s - stamp_s);
                    modelled_s
                }
            }
            None => modelled_s,
        };
        // Where it changes from one to the other, times still increase, by no small step.
        let time_s = match last_s.filter(|last_s| time_s <= *last_s) {
            Some(last_s) => last_s + 1.0 / 60.0,
            None => time_s,
        };
        self.last = Some((time_s, stamp_s));
        time_s
    }
}

impl std::fmt::Debug for HttpMjpeg {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("HttpMjpeg").field("info", &self.info).finish_non_exhaustive()
    }
}

impl HttpMjpeg {
    /// Connects and waits for the first image. A connection that is lost later is opened again;
    /// after `patience` without success the source fails.
    ///
    /// # Errors
    /// If there is no such stream at the address.
    pub fn open(address: &str, patience: Duration, watch: Watch) -> Result<Self> {
        let url = HttpUrl::parse(address)?;
        let place = format!("http://{}{}", url.host_header(), url.path);
        let failed = |NoStream { why, advice }: NoStream| {
            Error::input(format!("{place} gives no pictures: {why}; {advice}"))
        };
        let mut connection = connect(&url).map_err(failed)?;
        let mut part = Vec::new();
        let picture = loop {
            if !connection.next(&mut part).map_err(|error| failed(NoStream::broken(&error)))? {
                return Err(failed(NoStream::new("the stream ended at once", ANOTHER_READER)));
            }
            // The first image of a stream may be damaged; data that does not start as a JPEG file
            // is an error.
            match Picture::from_jpeg(&part, true) {
                Ok(picture) => break picture,
                Err(error) if part.starts_with(&[0xff, 0xd8]) => drop(error),
                Err(error) => return Err(error.at(place)),
            }
        };
        let (width, height) = (picture.gray.width(), picture.gray.height());
        let description = format!("Motion JPEG over HTTP, {width}x{height}");
        Ok(Self {
            info: SourceInfo { width, height, frame_count: None, description },
            url,
            place,
            first: Some(Arrived { picture, at: Instant::now(), stamp_s: connection.parts.timestamp_s() }),
            connection: Some(connection),
            began: Instant::now(),
            number: 0,
            clock: FrameClock::default(),
            patience,
            part,
            damaged: 0,
            watch,
            warnings: Vec::new(),
        })
    }

    /// The next image that can be decoded; `None` if the source was asked to end.
    fn next_picture(&mut self) -> Result<Option<Arrived>> {
        let mut back_off = BackOff::new(self.patience);
        loop {
            if self.watch.ended() {
                return Ok(None);
            }
            let why = match &mut self.connection {
                None => match connect(&self.url) {
                    Ok(connection) => {
                        self.connection = Some(connection);
                        continue;
                    }
                    Err(NoStream { why, .. }) => why,
                },
                Some(connection) => match connection.next(&mut self.part) {
                    Ok(true) => {
                        let (at, stamp_s) = (Instant::now(), connection.parts.timestamp_s());
                        match Picture::from_jpeg(&self.part, true) {
                            Ok(picture) => {
                                self.watch.back();
                                return Ok(Some(Arrived { picture, at, stamp_s }));
                            }
                            Err(_) => self.damaged += 1,
                        }
                        continue;
                    }
                    Ok(false) => "the stream ended".to_owned(),
                    Err(error) => NoStream::broken(&error).why,
                },
            };
            self.connection = None;
            self.watch.lost(&format!("the camera at {} is gone ({why}); trying again", self.place));
            match back_off.pause() {
                Some(pause) => {
                    if !self.watch.sleep_until(Instant::now() + pause) {
                        return Ok(None);
                    }
                }
                None => {
                    return Err(Error::input(format!(
                        "the camera at {} went away ({why}) and did not come back within {} s; check its power and \
                         network, or give a longer --patience",
                        self.place,
                        self.patience.as_secs()
                    )));
                }
            }
        }
    }
}

impl LiveSource for HttpMjpeg {
    fn info(&self) -> &SourceInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Captured>> {
        let Arrived { picture, at, stamp_s } = match self.first.take() {
            Some(first) => first,
            None => match self.next_picture()? {
                Some(next) => next,
                None => return Ok(None),
            },
        };
        check_size(&self.place, &picture.gray, &self.info)?;
        let arrival_s = at.saturating_duration_since(self.began).as_secs_f64();
        let time_s = self.clock.time_s(arrival_s, stamp_s);
        self.number += 1;
        Ok(Some(Captured { frame: Frame::new(self.number - 1, time_s, picture), at }))
    }

    fn take_warnings(&mut self) -> Vec<String> {
        if self.damaged > 0 {
            let damaged = std::mem::take(&mut self.damaged);
            self.warnings.push(format!("{}: {damaged} damaged pictures were left out", self.place));
        }
        std::mem::take(&mut self.warnings)
    }
}

/// Why an address gives no pictures, and what can be done about it.
#[derive(Debug)]
struct NoStream {
    why: String,
    advice: String,
}

const CHECK_ADDRESS: &str = "check the address, and that the camera is on and in this network";
const CHECK_PATH: &str =
    "the camera's manual states the address of its stream (Motion JPEG, multipart/x-mixed-replace)";
const ANOTHER_READER: &str = "check that no other program takes the camera's pictures, and try again";

impl NoStream {
    fn new(why: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { why: why.into(), advice: advice.into() }
    }

    /// A connection that failed. Operating systems report timeouts differently, and in messages
    /// that do not mention a timeout.
    fn broken(error: &io::Error) -> Self {
        let why = match error.kind() {
            io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut => {
                format!("nothing came for {} s", PATIENCE.as_secs())
            }
            _ => error.to_string(),
        };
        Self::new(why, CHECK_ADDRESS)
    }
}

/// When what is being read must have arrived.
#[derive(Debug, Clone)]
struct Deadline(Arc<Mutex<Instant>>);

impl Deadline {
    fn within(patience: Duration) -> Self {
        Self(Arc::new(Mutex::new(Instant::now() + patience)))
    }

    fn instant(&self) -> MutexGuard<'_, Instant> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn extend(&self, patience: Duration) {
        *self.instant() = Instant::now() + patience;
    }
}

/// A connection of which every byte must arrive within [`PATIENCE`] of the one before, and before a
/// deadline: otherwise a server that sends a byte now and then would be read without end.
struct Timely {
    stream: TcpStream,
    deadline: Deadline,
}

impl Read for Timely {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let left = self.deadline.instant().saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(io::Error::other("it sends too slowly"));
        }
        self.stream.set_read_timeout(Some(left.min(PATIENCE)))?;
        self.stream.read(buffer)
    }
}

/// The images of a connection.
struct Connection {
    parts: Multipart<Box<dyn BufRead + Send>>,
    deadline: Deadline,
}

impl Connection {
    /// Reads the next image into `part`; `false` at the end.
    fn next(&mut self, part: &mut Vec<u8>) -> io::Result<bool> {
        self.deadline.extend(PICTURE_PATIENCE);
        self.parts.next(part)
    }
}

/// Connects, sends the request, and reads the response's header section.
fn connect(url: &HttpUrl) -> std::result::Result<Connection, NoStream> {
    let stream = connection(url)?;
    let authorization = match &url.credentials {
        Some(credentials) => format!("Authorization: Basic {}\r\n", BASE64.encode(credentials)),
        None => String::new(),
    };
    let request = format!(
        "GET {} HTTP/1.1\r\nHost: {}\r\nUser-Agent: odograph\r\nAccept: multipart/x-mixed-replace, image/jpeg\r\n{authorization}Connection: close\r\n\r\n",
        url.path,
        url.host_header()
    );
    (&stream).write_all(request.as_bytes()).map_err(|error| NoStream::broken(&error))?;
    let deadline = Deadline::within(HEAD_PATIENCE);
    let stream = Timely { stream, deadline: deadline.clone() };
    let mut reader = BufReader::with_capacity(64 << 10, stream);
    let head = answer_head(&mut reader)?;
    let boundary = boundary(&head.content_type).ok_or_else(|| {
        let found = match quoted(&head.content_type) {
            found if found.is_empty() => "something unnamed".to_owned(),
            found => format!("`{found}`"),
        };
        let why =
            format!("it answers with {found}, not with a stream of pictures (multipart/x-mixed-replace)");
        NoStream::new(why, CHECK_PATH)
    })?;
    let body: Box<dyn BufRead + Send> = if head.chunked {
        Box::new(BufReader::new(Chunks { reader, left: 0, begun: false }))
    } else {
        Box::new(reader)
    };
    Ok(Connection { parts: Multipart::new(body, &boundary), deadline })
}

/// A connection to the first address of the host that answers.
fn connection(url: &HttpUrl) -> std::result::Result<TcpStream, NoStream> {
    let host = url.host.as_str();
    let unknown = |why: String| {
        let advice = "check the name, or give its IP address, such as http://192.168.1.20/video";
        NoStream::new(format!("the name {host} is not known here ({why})"), advice)
    };
    let addresses = (host, url.port).to_socket_addrs().map_err(|error| unknown(error.to_string()))?;
    let mut last = None;
    let stream = addresses.into_iter().find_map(|address| {
        TcpStream::connect_timeout(&address, PATIENCE).map_err(|error| last = Some(error)).ok()
    });
    let Some(stream) = stream else {
        return Err(last.map_or_else(|| unknown("no address".to_owned()), |error| NoStream::broken(&error)));
    };
    let limited =
        stream.set_read_timeout(Some(PATIENCE)).and_then(|()| stream.set_write_timeout(Some(PATIENCE)));
    limited.map_err(|error| NoStream::broken(&error))?;
    Ok(stream)
}

/// What a camera sent, for a message.
fn quoted(text: &str) -> String {
    text.trim().chars().take(MAX_QUOTED).collect()
}

struct AnswerHead {
    content_type: String,
    chunked: bool,
}

fn answer_head(reader: &mut impl BufRead) -> std::result::Result<AnswerHead, NoStream> {
    let no_http = || {
        let advice = "check the port of the address, which is that of the camera's web page on most cameras";
        NoStream::new("it does not answer as an HTTP server does", advice)
    };
    let mut bytes = Vec::new();
    while !bytes.ends_with(b"\r\n\r\n") && !bytes.ends_with(b"\n\n") {
        let left = MAX_HEAD.saturating_sub(bytes.len() as u64);
        let read = (&mut *reader).take(left).read_until(b'\n', &mut bytes);
        if read.map_err(|error| NoStream::broken(&error))? == 0 {
            return Err(no_http());
        }
    }
    let mut space = [httparse::EMPTY_HEADER; 64];
    let mut head = httparse::Response::new(&mut space);
    let (Ok(httparse::Status::Complete(_)), Some(code)) = (head.parse(&bytes), head.code) else {
        return Err(no_http());
    };
    let value = |name: &str| {
        let header = head.headers.iter().find(|header| header.name.eq_ignore_ascii_case(name));
        header.map_or(String::new(), |header| String::from_utf8_lossy(header.value).into_owned())
    };
    if code != 200 {
        return Err(refusal(code, head.reason.unwrap_or_default(), &value("location")));
    }
    let chunked = value("transfer-encoding").eq_ignore_ascii_case("chunked");
    Ok(AnswerHead { content_type: value("content-type"), chunked })
}

/// What it means that the camera answers with another status than 200.
fn refusal(code: u16, reason: &str, location: &str) -> NoStream {
    let answers = quoted(&format!("it answers {code} {reason}"));
    match code {
        300..=399 if !location.is_empty() => NoStream::new(
            format!("{answers}: the stream is at {}", quoted(location)),
            "give that address; redirections are not followed",
        ),
        401 => NoStream::new("it wants a name and a password", "give http://name:password@…"),
        403 => NoStream::new(answers, "give the name and password of a user who may see the pictures"),
        500..=599 => NoStream::new(answers, ANOTHER_READER),
        _ => NoStream::new(answers, CHECK_PATH),
    }
}

/// A body in chunked transfer coding (RFC 9112, section 7.1).
struct Chunks<R> {
    reader: R,
    left: u64,
    begun: bool,
}

impl<R: BufRead> Read for Chunks<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.left == 0 {
            let mut line = Vec::new();
            if std::mem::replace(&mut self.begun, true) {
                (&mut self.reader).take(2).read_until(b'\n', &mut line)?;
                line.clear();
            }
            (&mut self.reader).take(64).read_until(b'\n', &mut line)?;
            let text = String::from_utf8_lossy(&line);
            let digits = text.split(';').next().unwrap_or_default().trim().to_owned();
            self.left = u64::from_str_radix(&digits, 16)
                .map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "the stream's chunks are damaged"))?;
            if self.left == 0 {
                return Ok(0);
            }
        }
        let most = buffer.len().min(usize::try_from(self.left).unwrap_or(usize::MAX));
        let read = self.reader.read(&mut buffer[..most])?;
        self.left -= read as u64;
        Ok(read)
    }
}

#[cfg(test)]
mod tests;
