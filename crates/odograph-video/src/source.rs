//! Public interface: opens a source of frames with options.

use crate::container::annex_b::{self, AnnexBReader};
use crate::container::avi::AviReader;
use crate::container::matroska::{self, MatroskaReader};
use crate::container::mp4::Mp4Reader;
use crate::file_error::{unopened, unreadable};
use crate::frame::{Frame, Picture};
use crate::limits;
use crate::opened::{Frames, Opened};
use crate::regular_file::check_regular_file;
use crate::source_options::SourceOptions;
use crate::timestamps::Timestamps;
use crate::{bag, ffmpeg, foreign_file, pictures, pipe, video, y4m};
use odograph::error::{Error, ErrorKind, Result};
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::{Path, PathBuf};

/// Default frame rate of a source without one, frames per second.
const ASSUMED_FRAMES_PER_SECOND: f64 = 30.0;

/// Tolerance for start and end times, seconds: a decimal time is not exactly representable in
/// binary.
const TIME_SLACK_S: f64 = 1e-6;

/// Properties of a source, known before its frames are read.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceInfo {
    /// Width of every frame after rotation to upright, pixels.
    pub width: usize,
    /// Height of every frame after rotation to upright, pixels.
    pub height: usize,
    /// Estimated number of frames, for a progress bar; `None` if unknown.
    pub frame_count: Option<u64>,
    /// Human-readable description, e.g. `H.264 (High) in MP4, 640x480`.
    pub description: String,
}

/// The frames of one file, folder or stream, read sequentially.
pub struct Source {
    place: String,
    info: SourceInfo,
    options: SourceOptions,
    frames: Box<dyn Frames>,
    /// The first frame, decoded when the source is opened.
    first: Option<(f64, Picture)>,
    clock: Clock,
    rate_is_assumed: bool,
    next_number: u64,
    in_range: u64,
    given: u64,
    first_time_s: Option<f64>,
    last_time_s: f64,
    without_time: u64,
    ended: bool,
    warnings: Vec<String>,
}

/// Origin of the timestamps.
enum Clock {
    Container,
    Rate(f64),
    /// Times from a file of timestamps.
    List {
        file: PathBuf,
        times: Vec<f64>,
    },
}

/// Opens a recording: a video file, an image folder, a single image, a robot recording (MCAP, ROS
/// bag, rosbag2 folder or database), `-` for Y4M from standard input, or an address `rtsp://…`.
///
/// The format is detected from the content. The first frame is decoded at once, so that an
/// undecodable source fails here.
///
/// # Errors
/// [`ErrorKind::Usage`](odograph::error::ErrorKind::Usage) for invalid options;
/// [`ErrorKind::Input`](odograph::error::ErrorKind::Input) for a source that is missing, damaged,
/// without frames, or in a format that needs an `ffmpeg` that is not installed. The environment
/// variable `ODOGRAPH_FFMPEG` sets the program to use as `ffmpeg`; an empty value disables it.
pub fn open(path: impl AsRef<Path>, options: &SourceOptions) -> Result<Source> {
    let path = path.as_ref();
    options.check()?;
    let place = if path == Path::new("-") { "standard input".into() } else { path.display().to_string() };
    open_kind(path, options)
        .and_then(|opened| Source::new(place.clone(), opened, options))
        .map_err(|error| at_place(error, &place))
}

/// Opens a file that must be one picture, such as a mask.
///
/// # Errors
/// As [`open`], and for everything that is not a picture.
pub fn open_picture(path: impl AsRef<Path>) -> Result<Source> {
    let path = path.as_ref();
    let refused = |why: String| Error::input(why).at(path.display());
    if path.is_dir() {
        return Err(refused("this is a folder, not a picture".to_owned()));
    }
    let mut start = Vec::new();
    check_regular_file(path)
        .and_then(|_| File::open(path)?.take(foreign_file::START_BYTES).read_to_end(&mut start))
        .map_err(|error| refused(format!("the picture cannot be read: {error}")).caused_by(error))?;
    if !start.is_empty() && !pictures::is_picture(&start) {
        let what = foreign_file::name(&start).map_or(String::new(), |what| format!("{what}, "));
        return Err(refused(format!("this is {what}not a picture")));
    }
    open(path, &SourceOptions::default())
}

/// Bytes at the start of a file that say its format.
const MAGIC_BYTES: usize = 64;

/// Frames of a camera in motion are hardly ever as far apart as this, seconds.
const LONG_INTERVAL_S: f64 = 10.0;

/// Box types at the start of an MP4 or QuickTime file.
const MP4_STARTS: [&[u8]; 11] =
    [b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot", b"uuid", b"styp", b"sidx", b"moof"];

/// Prefixes an error with its location. What a file is at fault for stands on one line: third-party
/// decoders write messages of several lines. A wrong option may be answered with a list.
fn at_place(error: Error, place: &str) -> Error {
    match error.kind() {
        ErrorKind::Usage => error.at(place),
        kind => Error::new(kind, one_line(&error.to_string())).at(place),
    }
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Whether a source name is the address of a live stream (`rtsp://…`), which is read with ffmpeg.
pub fn is_stream(name: &str) -> bool {
    name.starts_with("rtsp://") || name.starts_with("rtsps://")
}

/// Whether a path is where Linux has its cameras.
fn is_video_device(path: &Path) -> bool {
    path.to_str().is_some_and(|name| name.starts_with("/dev/video"))
}

pub(crate) fn open_kind(path: &Path, options: &SourceOptions) -> Result<Opened> {
    if let Some(address) = path.to_str().filter(|name| is_stream(name)) {
        return ffmpeg::open_stream(address, options.color);
    }
    if path == Path::new("-") {
        return open_pipe(pipe::standard_input()?, options);
    }
    let metadata = std::fs::metadata(path).map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound if path.to_string_lossy().contains("://") => Error::input(
            "this is an address, and recordings are files; odograph live follows cameras at http:// and rtsp://",
        ),
        std::io::ErrorKind::NotFound if is_video_device(path) => {
            Error::input("there is no such camera; odograph cameras lists those of this machine")
        }
        std::io::ErrorKind::NotFound => Error::input("there is no such file or folder"),
        _ => Error::input(format!("cannot be opened: {error}")),
    })?;
    // Before all others: a bag of JPEG images looks like a Motion JPEG stream.
    if let Some(recording) = bag::open(path)? {
        return bag::open_frames(recording, options);
    }
    if let Some(topic) = &options.topic {
        return Err(Error::usage(format!(
            "only robot recordings (MCAP, ROS bags) have topics, and this is none; leave --topic {topic} away"
        )));
    }
    if metadata.is_dir() {
        return pictures::open_folder(path, options);
    }
    #[cfg(unix)]
    if std::os::unix::fs::FileTypeExt::is_socket(&metadata.file_type()) {
        return Err(Error::input("it is a socket, which cannot be opened; give a file or a pipe"));
    }
    if is_video_device(path) {
        return Err(Error::input("this is a camera, not a recording; odograph live follows it"));
    }
    if !metadata.is_file() {
        return open_pipe(pipe::open(path)?, options);
    }
    open_file(path, metadata.len(), options)
}

/// Opens a regular file by what it starts with.
fn open_file(path: &Path, length: u64, options: &SourceOptions) -> Result<Opened> {
    let mut file = File::open(path).map_err(unopened)?;
    let mut start = Vec::new();
    file.by_ref()
        .take(foreign_file::START_BYTES)
        .read_to_end(&mut start)
        .and_then(|_| file.rewind())
        .map_err(unreadable)?;
    let video = |reader| video::open(Some(path), reader, options.color);
    match &start[..start.len().min(MAGIC_BYTES)] {
        [] => Err(Error::input("the file is empty; record or copy it again")),
        m if m.starts_with(y4m::MAGIC) => {
            y4m::open(BufReader::with_capacity(1 << 18, file), Some(length), options.color)
        }
        [0xff, 0xd8, ..]
            if path
                .extension()
                .is_some_and(|e| e.eq_ignore_ascii_case("mjpeg") || e.eq_ignore_ascii_case("mjpg")) =>
        {
            ffmpeg::open(path, ffmpeg::Content::JpegStream, options.color)
        }
        m if pictures::is_picture(m) => pictures::open_picture(path, options),
        _ if let Err(error) = foreign_file::check(&start) => Err(error),
        [_, _, _, _, kind @ ..] if MP4_STARTS.iter().any(|start| kind.starts_with(start)) => {
            video(Box::new(Mp4Reader::open(file)?))
        }
        m if m.starts_with(&matroska::MAGIC) => video(Box::new(MatroskaReader::open(file)?)),
        [b'R', b'I', b'F', b'F', _, _, _, _, b'A', b'V', b'I', b' ', ..] => {
            video(Box::new(AviReader::open(file)?))
        }
        m if let Some(codec) = annex_b::codec(m) => video(Box::new(AnnexBReader::open(file, codec))),
        _ => ffmpeg::open(path, ffmpeg::Content::Unknown, options.color),
    }
}

/// What cannot be sought in.
fn open_pipe(bytes: impl Read + Send + 'static, options: &SourceOptions) -> Result<Opened> {
    let opened = y4m::open(BufReader::with_capacity(1 << 18, bytes), None, options.color);
    opened.map_err(pipe::interrupted_or)
}

impl Source {
    fn new(place: String, mut opened: Opened, options: &SourceOptions) -> Result<Self> {
        let mut warnings = Vec::new();
        let clock = match (&options.timestamps, options.fps) {
            (Some(_), _) if opened.timestamps_used => Clock::Container,
            (Some(file), _) => {
                let times = Timestamps::read(file)?.into_times();
                // A part of the recording may need fewer times than the whole.
                let is_whole = options.end_s.is_none() && options.max_frames.is_none();
                check_number_of_times(&times, file, opened.frames_within.filter(|_| is_whole))?;
                Clock::List { file: file.clone(), times }
            }
            (None, Some(fps)) => Clock::Rate(fps),
            (None, None) if opened.times_known => Clock::Container,
            (None, None) => Clock::Rate(opened.frames_per_second.unwrap_or_else(|| {
                warnings.push(format!(
                    "nothing says when the frames were taken: {ASSUMED_FRAMES_PER_SECOND} frames a second are assumed; \
                     give --timestamps or --fps"
                ));
                ASSUMED_FRAMES_PER_SECOND
            })),
        };
        let rate_is_assumed = !warnings.is_empty();
        let (time_s, picture, skipped) = first_frame(opened.frames.as_mut())?;
        let (width, height) = (picture.gray.width(), picture.gray.height());
        limits::check_size(width, height)?;
        let info = SourceInfo {
            width,
            height,
            frame_count: opened
                .frame_count
                .map(|count| count.div_ceil(options.every).min(options.max_frames.unwrap_or(u64::MAX))),
            description: format!("{}, {width}x{height}", opened.description),
        };
        Ok(Self {
            place,
            info,
            options: options.clone(),
            frames: opened.frames,
            first: Some((time_s, picture)),
            clock,
            rate_is_assumed,
            next_number: skipped,
            in_range: 0,
            given: 0,
            first_time_s: None,
            last_time_s: f64::NEG_INFINITY,
            without_time: 0,
            ended: false,
            warnings,
        })
    }

    /// Properties of the source.
    pub fn info(&self) -> &SourceInfo {
        &self.info
    }

    /// Whether nothing says when the frames were taken, so that a frame rate is assumed.
    pub fn is_rate_assumed(&self) -> bool {
        self.rate_is_assumed
    }

    /// The next selected frame; `None` at the end.
    ///
    /// # Errors
    /// If a frame is too damaged to decode, differs in size from the first, or has no line in the
    /// timestamps file. A truncated video is not an error: its frames up to the truncation are
    /// yielded, with a warning.
    pub fn next_frame(&mut self) -> Result<Option<Frame>> {
        let frame = self.next_wanted().map_err(|error| at_place(error, &self.place));
        if !matches!(frame, Ok(Some(_))) {
            self.end();
        }
        frame
    }

    /// Drains the warnings about the source since the last call, one sentence each, for users.
    pub fn take_warnings(&mut self) -> Vec<String> {
        let mut warnings = std::mem::take(&mut self.warnings);
        warnings.append(&mut self.frames.take_warnings());
        for warning in &mut warnings {
            *warning = format!("{}: {}", self.place, one_line(warning));
        }
        warnings
    }

    fn end(&mut self) {
        if !self.ended && self.without_time > 0 {
            self.warnings.push(format!(
                "{} frames whose time is not after the time of the frame before were left out",
                self.without_time
            ));
        }
        self.ended = true;
    }

    /// Passes over the next selected frame and returns its time, seconds; `None` at the end. Its
    /// image is decoded only if later ones need it.
    ///
    /// # Errors
    /// As [`Source::next_frame`].
    pub fn skip_frame(&mut self) -> Result<Option<f64>> {
        let next = self.advance_to_wanted().map_err(|error| at_place(error, &self.place));
        let time_s = next.map(|next| next.map(|(_, time_s, _)| time_s));
        match time_s {
            Ok(Some(_)) => self.given += 1,
            _ => self.end(),
        }
        time_s
    }

    fn next_wanted(&mut self) -> Result<Option<Frame>> {
        while let Some((number, time_s, picture)) = self.advance_to_wanted()? {
            let picture = match picture {
                Some(picture) => Some(picture),
                None => self.frames.picture()?,
            };
            let Some(picture) = picture else { continue };
            let (width, height) = (picture.gray.width(), picture.gray.height());
            if (width, height) != (self.info.width, self.info.height) {
                return Err(Error::input(format!(
                    "frame {number} has {width}x{height} pixels, the first has {}x{}; all frames must have the same size",
                    self.info.width, self.info.height
                )));
            }
            self.given += 1;
            let name = self.frames.name();
            return Ok(Some(Frame { number, time_s, name, gray: picture.gray, color: picture.color }));
        }
        Ok(None)
    }

    /// Warns at the last frame of a recording whose number of frames was not known before.
    fn warn_of_times_left(&mut self) {
        let Clock::List { file, times } = &self.clock else { return };
        if !self.ended && times.len() as u64 > self.next_number + 1 {
            self.warnings.push(format!(
                "{} has {} times, but there were {} frames; the times may belong to other frames",
                file.display(),
                times.len(),
                self.next_number
            ));
        }
    }

    /// Warns at the end of a recording whose times were probably read in a wrong unit.
    fn warn_of_long_intervals(&mut self) {
        let (Some(file), Some(first_s)) = (&self.options.timestamps, self.first_time_s) else { return };
        let interval_s = (self.last_time_s - first_s) / self.next_number.saturating_sub(1).max(1) as f64;
        if !self.ended && interval_s > LONG_INTERVAL_S {
            self.warnings.push(format!(
                "by {} the frames are {interval_s:.0} s apart, because its numbers are read as seconds; if they are \
                 milliseconds, divide them by 1000; if they are nanoseconds, begin it with a line `# [ns]`",
                file.display()
            ));
        }
    }

    /// Advances to the next frame that the options select: its number, its time in seconds, and its
    /// picture where that is decoded already.
    fn advance_to_wanted(&mut self) -> Result<Option<(u64, f64, Option<Picture>)>> {
        while !self.ended && self.options.max_frames.is_none_or(|most| self.given < most) {
            let (source_time_s, picture) = match self.first.take() {
                Some((time_s, picture)) => (time_s, Some(picture)),
                None => match self.frames.advance()? {
                    Some(time_s) => (time_s, None),
                    None => {
                        self.warn_of_times_left();
                        self.warn_of_long_intervals();
                        return Ok(None);
                    }
                },
            };
            let number = self.next_number;
            self.next_number += 1;
            let time_s = match &self.clock {
                Clock::Container => source_time_s,
                Clock::Rate(fps) => number as f64 / fps,
                Clock::List { file, times } => *times.get(number as usize).ok_or_else(|| {
                    Error::input(format!(
                        "{} has {} times, but there are more frames; give a time for each frame",
                        file.display(),
                        times.len()
                    ))
                })?,
            };
            if !time_s.is_finite() || time_s <= self.last_time_s {
                self.without_time += 1;
                continue;
            }
            self.last_time_s = time_s;
            let since_first_s = time_s - *self.first_time_s.get_or_insert(time_s);
            if self.options.end_s.is_some_and(|end_s| since_first_s > end_s + TIME_SLACK_S) {
                return Ok(None);
            }
            if self.options.start_s.is_some_and(|start_s| since_first_s < start_s - TIME_SLACK_S) {
                continue;
            }
            self.in_range += 1;
            if (self.in_range - 1).is_multiple_of(self.options.every) {
                return Ok(Some((number, time_s, picture)));
            }
        }
        Ok(None)
    }
}

/// Fails if there are fewer times than frames, or more by two and more, so that it is not known
/// which frame a time belongs to. Some loggers write a last time for a frame that is not recorded.
fn check_number_of_times(times: &[f64], file: &Path, frames: Option<(u64, u64)>) -> Result<()> {
    let Some((least, greatest)) = frames else { return Ok(()) };
    let count = times.len() as u64;
    if (least..=greatest + 1).contains(&count) {
        return Ok(());
    }
    Err(Error::input(format!(
        "{} has {count} times, but there are {greatest} frames; give a time for each frame",
        file.display()
    )))
}

/// The first frame that can be decoded with its time, and the number of frames before it.
fn first_frame(frames: &mut dyn Frames) -> Result<(f64, Picture, u64)> {
    let mut skipped = 0;
    while let Some(time_s) = frames.advance()? {
        if let Some(picture) = frames.picture()? {
            return Ok((time_s, picture, skipped));
        }
        skipped += 1;
    }
    let why = frames.take_warnings();
    let why =
        if why.is_empty() { "; record or copy it again".to_owned() } else { format!(": {}", why.join(", ")) };
    Err(pipe::interrupted_or(Error::input(format!("there is no frame in it{why}"))))
}

impl std::fmt::Debug for Source {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Source").field("place", &self.place).field("info", &self.info).finish_non_exhaustive()
    }
}

// A source can be read in a separate thread.
const _: fn() = || {
    fn is_send<T: Send>() {}
    is_send::<Source>();
};

#[cfg(test)]
mod tests {
    use super::*;
    use odograph::image::GrayImage;

    /// Single-pixel frames at given times.
    struct TimedFrames(std::vec::IntoIter<f64>);

    impl Frames for TimedFrames {
        fn advance(&mut self) -> Result<Option<f64>> {
            Ok(self.0.next())
        }

        fn picture(&mut self) -> Result<Option<Picture>> {
            Ok(Some(Picture::gray(GrayImage::new(1, 1))))
        }

        fn take_warnings(&mut self) -> Vec<String> {
            Vec::new()
        }
    }

    fn opened(times_s: Vec<f64>) -> Opened {
        Opened {
            frame_count: Some(times_s.len() as u64),
            frames: Box::new(TimedFrames(times_s.into_iter())),
            frames_within: None,
            description: "times".into(),
            times_known: true,
            timestamps_used: false,
            frames_per_second: None,
        }
    }

    #[test]
    fn skipped_frames_count_as_given() {
        let opened = opened(vec![0.0, 0.5, 0.5, 1.0, 1.5]);
        let options = SourceOptions { max_frames: Some(3), ..SourceOptions::default() };
        let mut source = Source::new("here".into(), opened, &options).unwrap();
        assert_eq!(source.skip_frame().unwrap(), Some(0.0));
        assert_eq!(source.skip_frame().unwrap(), Some(0.5));
        let frame = source.next_frame().unwrap().unwrap();
        assert_eq!((frame.number, frame.time_s), (3, 1.0));
        assert_eq!(source.skip_frame().unwrap(), None);
        assert_eq!(source.take_warnings().len(), 1);
    }

    #[test]
    fn frames_with_non_increasing_times_are_dropped_with_a_warning() {
        let opened = opened(vec![-1.0, 0.0, 0.0, f64::NAN, -0.5, 2.0]);
        let mut source = Source::new("here".into(), opened, &SourceOptions::default()).unwrap();
        assert_eq!(source.info().description, "times, 1x1");
        let frames: Vec<_> = std::iter::from_fn(|| source.next_frame().unwrap()).collect();
        let seen: Vec<_> = frames.iter().map(|f| (f.number, f.time_s)).collect();
        assert_eq!(seen, [(0, -1.0), (1, 0.0), (5, 2.0)]);
        assert!(source.next_frame().unwrap().is_none());
        let warnings = source.take_warnings();
        assert_eq!(
            warnings,
            ["here: 3 frames whose time is not after the time of the frame before were left out"]
        );
        assert!(source.take_warnings().is_empty());
    }
}
