//! Cameras through V4L2.

use super::{Mode, ModeWish, PixelFormat, choose, sizes_in_range};
use crate::capture::{Captured, LiveSource, Watch};
use linuxvideo::controls::Cid;
use linuxvideo::format::{FrameIntervals, FrameSizes, PixFormat};
use linuxvideo::stream::ReadStream;
use linuxvideo::{BufType, CapabilityFlags, Device, Fract};
use odograph::error::{Error, Result};
use odograph_video::{Frame, Picture, SourceInfo};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// A camera that gives no picture for so long has gone.
const PATIENCE: Duration = Duration::from_secs(5);
/// How often to look for a picture; the driver tells only whether there is one.
const GLANCE: Duration = Duration::from_millis(1);
/// So long the camera may look for its exposure before it is held.
const EXPOSURE_SETTLES: Duration = Duration::from_millis(1500);
/// `V4L2_EXPOSURE_MANUAL`.
const EXPOSURE_MANUAL: i32 = 1;

/// The cameras of this machine: where each is, its name, and what it can do.
pub fn list() -> Vec<(PathBuf, String, Vec<Mode>)> {
    let Ok(entries) = std::fs::read_dir("/dev") else { return Vec::new() };
    let paths = entries.flatten().map(|entry| entry.path());
    let mut paths: Vec<_> = paths
        .filter(|path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("video")))
        .collect();
    // video2 before video10.
    paths.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    let described = |path: PathBuf| {
        let device = Device::open(&path).ok()?;
        let capabilities = device.capabilities().ok()?;
        let captures = capabilities.device_capabilities().contains(CapabilityFlags::VIDEO_CAPTURE);
        let modes = modes(&device);
        (captures && !modes.is_empty()).then(|| (path, capabilities.card().to_owned(), modes))
    };
    paths.into_iter().filter_map(described).collect()
}

/// Everything a camera can do in formats that are read here.
fn modes(device: &Device) -> Vec<Mode> {
    let mut modes = Vec::new();
    for description in device.formats(BufType::VIDEO_CAPTURE).flatten() {
        let fourcc = description.pixel_format();
        let Some(format) = PixelFormat::from_fourcc(fourcc.as_fourcc()) else { continue };
        let sizes = match device.frame_sizes(fourcc) {
            Ok(FrameSizes::Discrete(sizes)) => {
                sizes.iter().map(|size| (size.width(), size.height())).collect()
            }
            Ok(FrameSizes::Stepwise(range) | FrameSizes::Continuous(range)) => sizes_in_range(
                (range.min_width(), range.min_height()),
                (range.max_width(), range.max_height()),
                (range.step_width(), range.step_height()),
            ),
            Err(_) => Vec::new(),
        };
        for (width, height) in sizes {
            let rates = match device.frame_intervals(fourcc, width, height) {
                Ok(FrameIntervals::Discrete(intervals)) => {
                    intervals.iter().map(|i| Some(rate(*i.fract()))).collect()
                }
                // Anything in between can be asked for.
                Ok(FrameIntervals::Stepwise(range) | FrameIntervals::Continuous(range)) => {
                    vec![Some(rate(*range.min())), Some((30, 1)), Some(rate(*range.max()))]
                }
                Err(_) => vec![None],
            };
            let mode = |rate| Mode { format, fourcc: fourcc.as_fourcc(), width, height, rate };
            modes.extend(rates.into_iter().map(mode));
        }
    }
    modes
}

/// Frames a second as a fraction, from the time between two.
fn rate(interval: Fract) -> (u32, u32) {
    (interval.denominator(), interval.numerator())
}

/// A camera that gives pictures.
pub struct Camera {
    path: PathBuf,
    mode: Mode,
    bytes_per_line: usize,
    info: SourceInfo,
    stream: ReadStream,
    began: Instant,
    number: u64,
    last_time_s: f64,
    /// Whether the exposure is still to be held.
    hold_exposure: bool,
    damaged: u64,
    watch: Watch,
    warnings: Vec<String>,
}

impl Camera {
    /// Opens a camera in the mode that fits a wish best.
    ///
    /// # Errors
    /// Where there is no camera, it is in use by another program, or it has no such mode.
    pub fn open(path: &Path, wish: &ModeWish, hold_exposure: bool, watch: Watch) -> Result<Self> {
        let told = |what: &str, error: io::Error| {
            let why = match error.raw_os_error() {
                Some(16) => "it is in use by another program".to_owned(),
                Some(13) => "it may not be opened by you (the group `video` mostly may)".to_owned(),
                _ => error.to_string(),
            };
            Error::input(format!("{} {what}: {why}", path.display()))
        };
        let device = Device::open(path).map_err(|error| told("is no camera that can be opened", error))?;
        let name = device.capabilities().map_or_else(|_| "camera".to_owned(), |c| c.card().to_owned());
        let wished = choose(&modes(&device), wish).map_err(|error| error.at(path.display()))?;
        let format = linuxvideo::format::PixelFormat::from_fourcc(wished.fourcc);
        let capture = device
            .video_capture(PixFormat::new(wished.width, wished.height, format))
            .map_err(|error| told("cannot be set up", error))?;
        let given = capture.format();
        let mode = Mode { width: given.width(), height: given.height(), ..wished };
        if given.pixel_format().as_fourcc() != wished.fourcc
            || (mode.width, mode.height) != (wished.width, wished.height)
        {
            return Err(Error::input(format!(
                "{} promised {wished} and gives something else",
                path.display()
            )));
        }
        let bytes_per_line = given.bytes_per_line() as usize;
        let mut warnings = Vec::new();
        if let Some((frames, seconds)) = mode.rate.filter(|(frames, seconds)| *frames > 0 && *seconds > 0)
            && let Err(error) = capture.set_frame_interval(Fract::new(seconds, frames))
        {
            warnings.push(format!("{}: the rate cannot be set ({error})", path.display()));
        }
        let stream = capture.into_stream().map_err(|error| told("gives no pictures", error))?;
        let (width, height) = (mode.width as usize, mode.height as usize);
        Ok(Self {
            path: path.to_owned(),
            info: SourceInfo { width, height, frame_count: None, description: format!("{name}, {mode}") },
            mode,
            bytes_per_line,
            stream,
            began: Instant::now(),
            number: 0,
            last_time_s: -1.0,
            hold_exposure,
            damaged: 0,
            watch,
            warnings,
        })
    }

    /// Holds the exposure and white balance where the camera's automatics have brought them: what changes them changes every corner's look,
    /// and long exposures blur.
    fn hold_exposure(&mut self) {
        self.hold_exposure = false;
        let held = Device::open(&self.path).and_then(|mut device| {
            let found = device.read_control_raw(Cid::EXPOSURE_ABSOLUTE);
            device.write_control_raw(Cid::EXPOSURE_AUTO, EXPOSURE_MANUAL)?;
            if let Ok(found) = found {
                device.write_control_raw(Cid::EXPOSURE_ABSOLUTE, found)?;
            }
            // Not every camera has one; without it nothing is lost.
            let _ = device.write_control_raw(Cid::AUTO_WHITE_BALANCE, 0);
            Ok(())
        });
        if let Err(error) = held {
            self.warnings.push(format!("{}: the exposure stays automatic ({error})", self.path.display()));
        }
    }

    /// Waits for a picture and decodes it; `None` where it was damaged or the source was asked to end.
    fn picture(&mut self) -> io::Result<Option<(Picture, Instant)>> {
        let until = Instant::now() + PATIENCE;
        while self.stream.will_block()? {
            if self.watch.ended() {
                return Ok(None);
            }
            if Instant::now() > until {
                return Err(io::Error::other(format!("it gave no picture for {} s", PATIENCE.as_secs())));
            }
            std::thread::sleep(GLANCE);
        }
        let at = Instant::now();
        let (mode, bytes_per_line) = (self.mode, self.bytes_per_line);
        let picture = self.stream.dequeue(|buffer| {
            if buffer.is_error() {
                return Ok(None);
            }
            let picture = match mode.format.layout() {
                None => Picture::from_jpeg(&buffer, true),
                Some(layout) => {
                    let (width, height) = (mode.width as usize, mode.height as usize);
                    Picture::from_samples(layout, width, height, bytes_per_line, &buffer, true)
                }
            };
            Ok(picture.ok())
        })?;
        self.damaged += u64::from(picture.is_none());
        Ok(picture.map(|picture| (picture, at)))
    }
}

impl LiveSource for Camera {
    fn info(&self) -> &SourceInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Captured>> {
        loop {
            if self.watch.ended() {
                return Ok(None);
            }
            if self.hold_exposure && self.began.elapsed() > EXPOSURE_SETTLES {
                self.hold_exposure();
            }
            let taken = self.picture().map_err(|error| {
                Error::input(format!("the camera {} is gone: {error}", self.path.display()))
            })?;
            let Some((picture, at)) = taken else { continue };
            if (picture.gray.width(), picture.gray.height()) != (self.info.width, self.info.height) {
                self.damaged += 1;
                continue;
            }
            let time_s = at.saturating_duration_since(self.began).as_secs_f64().max(self.last_time_s + 1e-6);
            self.last_time_s = time_s;
            self.number += 1;
            return Ok(Some(Captured { frame: Frame::new(self.number - 1, time_s, picture), at }));
        }
    }

    fn take_warnings(&mut self) -> Vec<String> {
        if self.damaged > 0 {
            let damaged = std::mem::take(&mut self.damaged);
            self.warnings.push(format!("{}: {damaged} damaged pictures were left out", self.path.display()));
        }
        std::mem::take(&mut self.warnings)
    }
}
