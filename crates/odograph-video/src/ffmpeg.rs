//! Fallback decoder for all other formats: an installed `ffmpeg`, run as a child process with
//! bounded memory that is killed when it is no longer needed.
//!
//! It writes the frames as Y4M to its standard output, in the pixel format closest to the stored
//! one, so that the luminance is not converted. It writes a line with the container timestamp of
//! each frame (muxer `framecrc`) to its standard error, interleaved with its messages.

use crate::foreign_file;
use crate::frame::Picture;
use crate::opened::{Frames, Opened};
use crate::y4m;
use odograph::error::{Error, Result};
use std::ffi::{OsStr, OsString};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStderr, ChildStdout, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, channel, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

/// Environment variable with the program's name; an empty value disables ffmpeg.
const VARIABLE: &str = "ODOGRAPH_FFMPEG";
/// Timeout for a frame.
const PATIENCE: Duration = Duration::from_secs(60);
/// Address space limit of the process, KiB: enough for 8K.
#[cfg(unix)]
const MEMORY_KIB: u32 = 6 << 20;
/// Pixel formats whose luminance plane is used unconverted.
const FORMATS: &str = "format=pix_fmts=yuv420p|yuvj420p|yuv422p|yuvj422p|yuv444p|yuvj444p|yuv411p|gray";

/// Demuxers that ffmpeg may try for a file of an unknown format: containers with timestamps, and
/// streams with a frame rate. Others, such as `mjpeg`, accept any file that happens to include
/// something like an image, and invent its timestamps.
const CONTAINERS: &str = "mov,matroska,avi,mpeg,mpegts,flv,asf,ogg,mxf,gxf,ivf,nut,rm,dv,wtv,swf,nsv,gif,apng,webp_anim,jpegxl_anim,\
                          mpegvideo,m4v,vc1,obu,av1,dirac,h264,hevc,vvc,bmp_pipe,webp_pipe,jpegxl_pipe,j2k_pipe,exr_pipe,dpx_pipe,\
                          sgi_pipe,pam_pipe,qoi_pipe";

/// Most characters that are quoted of a message of ffmpeg.
const MAX_QUOTED: usize = 200;

/// Messages of ffmpeg that say no more than that a file is of no format that it may try. Where it
/// misses an index it has only guessed from the name that the file is an MP4.
const NOT_RECOGNISED: [&str; 3] =
    ["Invalid data found when processing input", "moov atom not found", "not on whitelist"];

/// Detected format of a file that this crate does not decode itself.
pub(crate) enum Content<'a> {
    /// A video with the names of its codec and container, and the frame count if the container has
    /// it.
    Video { codec: &'a str, container: &'a str, frame_count: Option<u64> },
    /// Concatenated JPEG images, detected from file name and first bytes; without timestamps.
    JpegStream,
    /// A live network stream.
    Stream,
    /// An unknown format.
    Unknown,
}

impl Content<'_> {
    fn description(&self) -> String {
        match self {
            Self::Video { codec, container, .. } => format!("{codec} in {container}, through ffmpeg"),
            Self::JpegStream => "raw Motion JPEG, through ffmpeg".to_owned(),
            Self::Stream => "RTSP, through ffmpeg".to_owned(),
            Self::Unknown => "video through ffmpeg".to_owned(),
        }
    }

    /// Says what is missing where there is no ffmpeg.
    fn needs_ffmpeg(&self) -> String {
        let (what, or) = match self {
            Self::Video { codec, container, .. } => {
                (format!("{codec} in {container} is decoded"), "convert the video to H.264")
            }
            Self::JpegStream => ("a raw Motion JPEG stream is decoded".to_owned(), "convert it to a video"),
            Self::Stream => ("an RTSP stream is read".to_owned(), "use the camera's http:// address"),
            Self::Unknown => {
                return format!(
                    "this is not a picture or video of a kind known here; with the program ffmpeg installed (or named in {VARIABLE}) more kinds can be read"
                );
            }
        };
        format!(
            "{what} through the program ffmpeg, which was not found; install ffmpeg (or name it in {VARIABLE}), or {or}"
        )
    }

    /// The error for what ffmpeg cannot read either, with its message.
    fn undecodable(&self, path: &Path, why: &str) -> Error {
        // The place is named once, by whoever opens it.
        let why = why.strip_prefix(&format!("file:{}: ", path.display())).unwrap_or(why);
        let why: String = why.chars().take(MAX_QUOTED).collect();
        Error::input(match self {
            Self::Video { codec, container, .. } => {
                format!("{codec} in {container} cannot be decoded, not even with ffmpeg: {why}")
            }
            Self::JpegStream => {
                format!("this raw Motion JPEG stream cannot be decoded, not even with ffmpeg: {why}")
            }
            Self::Stream => format!(
                "the stream cannot be read through ffmpeg: {why}; check the address, and that the camera is on and in \
                 this network"
            ),
            Self::Unknown if NOT_RECOGNISED.iter().any(|message| why.contains(message)) => format!(
                "this is not a picture or video of a kind known here or to ffmpeg; it is damaged or no recording: copy it again, or {}",
                foreign_file::WHAT_TO_GIVE
            ),
            Self::Unknown => format!(
                "this is not a picture or video of a kind known here, and ffmpeg cannot read it either: {why}"
            ),
        })
    }
}

/// Opens a file with ffmpeg.
///
/// # Errors
/// If there is no ffmpeg, with a message that explains what it is needed for; if ffmpeg cannot
/// decode the file either, with its message.
pub(crate) fn open(path: &Path, content: Content<'_>, color: bool) -> Result<Opened> {
    open_with(program(), path, content, color)
}

/// Opens a stream with ffmpeg: an `rtsp://` address.
///
/// # Errors
/// As [`open`].
pub(crate) fn open_stream(address: &str, color: bool) -> Result<Opened> {
    open_with(program(), Path::new(address), Content::Stream, color)
}

fn open_with(program: Option<PathBuf>, path: &Path, content: Content<'_>, color: bool) -> Result<Opened> {
    let Some(program) = program else { return Err(Error::input(content.needs_ffmpeg())) };
    let fail = |why: &str| content.undecodable(path, why);
    // `-fps_mode` exists since ffmpeg 5.1; its predecessor was `-vsync`.
    for passthrough in ["-fps_mode", "-vsync"] {
        let mut process = Process::start(&program, input(path, &content), passthrough, color)?;
        match process.receive() {
            Ok(Some(first)) => {
                process.first = Some(first);
                return Ok(Opened {
                    frames: Box::new(process),
                    frame_count: match content {
                        Content::Video { frame_count, .. } => frame_count,
                        _ => None,
                    },
                    frames_within: None,
                    description: content.description(),
                    times_known: !matches!(content, Content::JpegStream),
                    timestamps_used: false,
                    frames_per_second: None,
                });
            }
            Ok(None) => {
                let said = process.message();
                if said.contains("fps_mode") {
                    continue;
                }
                return Err(fail(if said.is_empty() { "it has no frames" } else { &said }));
            }
            Err(error) => return Err(fail(&error.to_string())),
        }
    }
    Err(fail("this version of ffmpeg is too old"))
}

/// Input options of ffmpeg. Whitelists keep a file from referring to other files or the network,
/// and a stream from referring to files.
fn input(path: &Path, content: &Content<'_>) -> Vec<OsString> {
    let options = match content {
        // TCP avoids packet loss; no buffering for smooth playback and a short stream analysis
        // reduce latency.
        Content::Stream => {
            "-protocol_whitelist rtsp,rtsps,tcp,tls,udp,rtp,crypto -rtsp_transport tcp -fflags nobuffer \
             -flags low_delay -analyzeduration 1000000"
        }
        Content::Unknown => &format!("-protocol_whitelist file -format_whitelist {CONTAINERS}"),
        Content::JpegStream => "-protocol_whitelist file -f mjpeg",
        Content::Video { .. } => "-protocol_whitelist file",
    };
    let mut place = OsString::from(if matches!(content, Content::Stream) { "" } else { "file:" });
    place.push(path);
    options.split(' ').map(OsString::from).chain(["-i".into(), place]).collect()
}

/// Path of the program, if it is installed.
fn program() -> Option<PathBuf> {
    let named = std::env::var_os(VARIABLE);
    if named.as_deref().is_some_and(OsStr::is_empty) {
        return None;
    }
    let name = PathBuf::from(named.unwrap_or_else(|| OsString::from("ffmpeg")));
    if name.components().count() > 1 {
        return name.is_file().then_some(name);
    }
    let with_ending = name.with_extension(std::env::consts::EXE_EXTENSION);
    std::env::split_paths(&std::env::var_os("PATH")?)
        .map(|folder| folder.join(&with_ending))
        .find(|p| p.is_file())
}

/// A running ffmpeg process.
struct Process {
    child: Child,
    pictures: Receiver<Result<Picture>>,
    times: Receiver<f64>,
    messages: Arc<Mutex<Messages>>,
    first: Option<(f64, Picture)>,
    current: Option<Picture>,
    warnings: Vec<String>,
}

/// Messages of ffmpeg: the first one, and their number.
#[derive(Default)]
struct Messages {
    first: String,
    count: usize,
}

impl Process {
    fn start(program: &Path, input: Vec<OsString>, passthrough: &str, color: bool) -> Result<Self> {
        let mut command = bounded(program);
        command.args(["-nostdin", "-hide_banner", "-v", "error", "-copyts"]).args(input);
        command.args(["-map", "0:v:0", passthrough, "passthrough", "-vf", FORMATS]);
        command.args(["-strict", "-1", "-f", "yuv4mpegpipe", "pipe:1"]);
        command.args(["-map", "0:v:0", passthrough, "passthrough", "-enc_time_base", "-1"]);
        command.args(["-c:v", "wrapped_avframe", "-flush_packets", "1", "-f", "framecrc", "pipe:2"]);
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| Error::input(format!("ffmpeg cannot be started: {error}")))?;
        let (picture_sender, pictures) = sync_channel(4);
        let (time_sender, times) = channel();
        let messages = Arc::new(Mutex::new(Messages::default()));
        if let (Some(output), Some(log)) = (child.stdout.take(), child.stderr.take()) {
            thread::spawn(move || read_pictures(output, color, &picture_sender));
            let messages = Arc::clone(&messages);
            thread::spawn(move || {
                read_log(log, &messages, |time_s| {
                    // Fails only after the source has been dropped.
                    let _ = time_sender.send(time_s);
                });
            });
        }
        Ok(Self { child, pictures, times, messages, first: None, current: None, warnings: Vec::new() })
    }

    /// Receives the next frame; `None` at the end.
    fn receive(&mut self) -> Result<Option<(f64, Picture)>> {
        let stalled = || Error::input(format!("ffmpeg gave no frame for {} seconds", PATIENCE.as_secs()));
        let frame = match self.pictures.recv_timeout(PATIENCE) {
            Ok(picture) => {
                let picture = picture?;
                self.times.recv_timeout(PATIENCE).map(|time_s| (time_s, picture))
            }
            Err(error) => Err(error),
        };
        match frame {
            Ok(frame) => Ok(Some(frame)),
            Err(RecvTimeoutError::Timeout) => Err(stalled()),
            Err(RecvTimeoutError::Disconnected) => {
                self.finish();
                Ok(None)
            }
        }
    }

    /// Waits until ffmpeg has exited and all its messages have been read.
    fn finish(&mut self) {
        while self.times.recv_timeout(PATIENCE).is_ok() {}
        let failed = !self.child.wait().is_ok_and(|status| status.success());
        let said = self.message();
        if !said.is_empty() || failed {
            let ending = if failed { "stopped early" } else { "found damage" };
            let said: String = said.chars().take(MAX_QUOTED).collect();
            self.warnings.push(format!(
                "ffmpeg {ending}: {}",
                if said.is_empty() { "it did not say why" } else { &said }
            ));
        }
    }

    fn message(&self) -> String {
        let messages = self.messages.lock().unwrap_or_else(PoisonError::into_inner);
        match messages.count {
            0 | 1 => messages.first.clone(),
            count => format!("{} ({count} messages)", messages.first),
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Killing fails if the process has already exited.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Frames for Process {
    fn advance(&mut self) -> Result<Option<f64>> {
        let next = match self.first.take() {
            Some(first) => Some(first),
            None => self.receive()?,
        };
        let Some((time_s, picture)) = next else { return Ok(None) };
        self.current = Some(picture);
        Ok(Some(time_s))
    }

    fn picture(&mut self) -> Result<Option<Picture>> {
        self.current.take().map(Some).ok_or_else(|| Error::input("the frame was already taken"))
    }

    fn take_warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }
}

/// A command with an address space limit, if the system supports one.
#[cfg(unix)]
fn bounded(program: &Path) -> Command {
    let mut command = Command::new("/bin/sh");
    command.arg("-c").arg(format!("ulimit -v {MEMORY_KIB} 2>/dev/null; exec \"$0\" \"$@\"")).arg(program);
    command
}

#[cfg(not(unix))]
fn bounded(program: &Path) -> Command {
    Command::new(program)
}

fn read_pictures(output: ChildStdout, color: bool, sender: &SyncSender<Result<Picture>>) {
    let mut reader = BufReader::with_capacity(1 << 18, output);
    // An empty output means that ffmpeg failed; its messages have the cause.
    if !reader.fill_buf().is_ok_and(|bytes| !bytes.is_empty()) {
        return;
    }
    let mut frames = match y4m::open(reader, None, color) {
        Ok(opened) => opened.frames,
        Err(error) => {
            let _ = sender.send(Err(error));
            return;
        }
    };
    let mut next = || match frames.advance()? {
        Some(_) => frames.picture(),
        None => Ok(None),
    };
    while let Some(picture) = next().transpose() {
        if sender.send(picture).is_err() {
            return;
        }
    }
}

/// Parses the log: passes timestamps to `on_time` and collects messages.
fn read_log(log: ChildStderr, messages: &Mutex<Messages>, mut on_time: impl FnMut(f64)) {
    let mut ticks_per_s = 1.0;
    let mut reader = BufReader::new(log);
    let mut line = Vec::new();
    loop {
        line.clear();
        if !reader.read_until(b'\n', &mut line).is_ok_and(|length| length > 0) {
            return;
        }
        let line = String::from_utf8_lossy(&line);
        match LogLine::read(line.trim_end()) {
            LogLine::TimeBase { numerator, denominator } => ticks_per_s = denominator / numerator,
            LogLine::Frame(ticks) => on_time(ticks as f64 / ticks_per_s),
            LogLine::Head => {}
            LogLine::Message(text) => {
                let mut messages = messages.lock().unwrap_or_else(PoisonError::into_inner);
                // The first message has the cause of a failure, the later ones mostly its
                // consequences.
                if messages.count == 0 {
                    messages.first = without_speaker(text).to_owned();
                }
                messages.count += 1;
            }
        }
    }
}

/// Strips ffmpeg's component and address from a message: `[mov @ 0x55d0] moov atom not found`.
fn without_speaker(message: &str) -> &str {
    match message.strip_prefix('[').and_then(|rest| rest.split_once("] ")) {
        Some((speaker, rest)) if speaker.contains(" @ ") => without_speaker(rest),
        _ => message,
    }
}

#[derive(Debug, PartialEq)]
enum LogLine<'a> {
    /// Time base: seconds per tick.
    TimeBase {
        numerator: f64,
        denominator: f64,
    },
    /// Presentation timestamp, ticks.
    Frame(i64),
    Head,
    Message(&'a str),
}

impl<'a> LogLine<'a> {
    /// Parses `#tb 0: 1/25` and `0, dts, pts, duration, size, checksum`; anything else is a
    /// message.
    fn read(line: &'a str) -> Self {
        if let Some(base) = line.strip_prefix("#tb 0: ").and_then(|base| base.split_once('/'))
            && let (Ok(numerator), Ok(denominator)) = (base.0.parse::<u32>(), base.1.trim().parse::<u32>())
        {
            let (numerator, denominator) = (f64::from(numerator.max(1)), f64::from(denominator.max(1)));
            return Self::TimeBase { numerator, denominator };
        }
        if line.starts_with('#') || line.trim().is_empty() {
            return Self::Head;
        }
        let mut fields = line.split(',').map(str::trim);
        if let (Some("0"), Some(_), Some(ticks), Some(_), Some(_), Some(checksum)) =
            (fields.next(), fields.next(), fields.next(), fields.next(), fields.next(), fields.next())
            && let (Ok(ticks), true) = (ticks.parse(), checksum.starts_with("0x"))
        {
            return Self::Frame(ticks);
        }
        Self::Message(line)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AV1: Content<'_> = Content::Video { codec: "AV1", container: "Matroska", frame_count: None };

    #[test]
    fn a_stream_needs_ffmpeg_and_cannot_refer_to_files() {
        let text = refusal(None, "rtsp://camera/1", Content::Stream);
        assert!(text.contains("RTSP") && text.contains("install ffmpeg"), "{text}");
        let options = input(Path::new("rtsp://camera/1"), &Content::Stream);
        let allowed = options.iter().position(|option| option == "-protocol_whitelist").unwrap() + 1;
        assert!(!options[allowed].to_string_lossy().contains("file"));
        assert_eq!(options.last().unwrap(), "rtsp://camera/1");
    }

    #[test]
    fn unknown_formats_are_not_searched_for_images() {
        let allowed = |content: Content<'_>| {
            let options = input(Path::new("drive.bin"), &content);
            let at = options.iter().position(|option| option == "-format_whitelist")?;
            Some(options[at + 1].to_string_lossy().into_owned())
        };
        let containers = allowed(Content::Unknown).unwrap();
        let names: Vec<&str> = containers.split(',').collect();
        assert!(
            names.contains(&"mpegts") && names.iter().all(|name| !name.is_empty() && !name.contains(' '))
        );
        assert!(
            ["mjpeg", "mpjpeg", "jpeg_pipe", "image2", "rawvideo"].iter().all(|raw| !names.contains(raw))
        );
        assert_eq!(allowed(Content::JpegStream), None);
    }

    fn refusal(program: Option<PathBuf>, path: &str, content: Content<'_>) -> String {
        match open_with(program, Path::new(path), content, false) {
            Ok(_) => panic!("opened"),
            Err(error) => error.to_string(),
        }
    }

    #[test]
    fn without_ffmpeg_the_error_names_codec_and_remedy() {
        let text = refusal(None, "film.mkv", AV1);
        assert!(text.starts_with("AV1 in Matroska") && text.contains("install ffmpeg"), "{text}");
        assert!(
            refusal(None, "film", Content::Unknown).contains("not a picture or video of a kind known here")
        );
    }

    /// A script that fails as specified by the name of its input.
    #[cfg(unix)]
    fn stand_in() -> Option<PathBuf> {
        Some(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/stand-in-for-ffmpeg"))
    }

    #[test]
    #[cfg(unix)]
    fn errors_quote_the_message_of_ffmpeg() {
        let text = refusal(stand_in(), "fails", AV1);
        assert_eq!(text, "AV1 in Matroska cannot be decoded, not even with ffmpeg: no such luck");
        let text = refusal(stand_in(), "fails", Content::Unknown);
        assert!(text.ends_with("ffmpeg cannot read it either: no such luck"), "{text}");
        let text = refusal(stand_in(), "junk", AV1);
        assert!(text.contains("this is not a Y4M stream"), "{text}");
        let text = refusal(stand_in(), "silent", AV1);
        assert!(text.ends_with("it has no frames"), "{text}");
    }

    #[test]
    #[cfg(unix)]
    fn what_ffmpeg_does_not_know_is_refused_in_own_words() {
        for path in ["unknown".to_owned(), format!("{}unknown", "folder/".repeat(40))] {
            let text = refusal(stand_in(), &path, Content::Unknown);
            assert!(text.contains("copy it again, or give a video") && !text.contains("Invalid"), "{text}");
        }
    }

    #[test]
    #[cfg(unix)]
    fn frames_have_timestamps_and_an_early_exit_is_reported() {
        let mut frames = open_with(stand_in(), Path::new("early"), AV1, false).unwrap().frames;
        assert_eq!(frames.advance().unwrap(), Some(0.5));
        assert_eq!(frames.picture().unwrap().unwrap().gray.samples(), b"ab");
        assert_eq!(frames.advance().unwrap(), Some(0.8));
        assert_eq!(frames.advance().unwrap(), None);
        assert_eq!(frames.take_warnings(), ["ffmpeg stopped early: not good"]);
    }

    #[test]
    fn lines_of_the_log() {
        assert_eq!(LogLine::read("#tb 0: 1/25"), LogLine::TimeBase { numerator: 1.0, denominator: 25.0 });
        assert_eq!(LogLine::read("#codec_id 0: wrapped_avframe"), LogLine::Head);
        assert_eq!(
            LogLine::read("0,          3,          3,        1,      456, 0xed0d96bd"),
            LogLine::Frame(3)
        );
        assert_eq!(LogLine::read("0, what, now"), LogLine::Message("0, what, now"));
        assert_eq!(
            without_speaker("[mov,mp4 @ 0x55e2] [a @ 0x1] moov atom not found"),
            "moov atom not found"
        );
        assert_eq!(LogLine::read("file:x: Invalid data"), LogLine::Message("file:x: Invalid data"));
    }
}
