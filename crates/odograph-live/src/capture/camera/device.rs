//! Access to cameras through V4L2.

use super::negotiation::{self, Agreed, Control, Driver, Given, OfferedIntervals, OfferedSizes, failed};
use super::{Mode, ModeWish};
use crate::capture::{Captured, LiveSource, Watch};
use linuxvideo::controls::Cid;
use linuxvideo::format::{FrameIntervals, FrameSizes, PixFormat, PixelFormat};
use linuxvideo::stream::ReadStream;
use linuxvideo::{BufType, CapabilityFlags, Device, Fract, VideoCaptureDevice};
use odograph::error::{Error, Result};
use odograph_video::{Frame, Picture, SourceInfo};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Maximum wait for an image; after that the camera counts as lost.
const PATIENCE: Duration = Duration::from_secs(5);
/// Polling interval for images; the driver only reports whether one is available.
const GLANCE: Duration = Duration::from_millis(1);
/// Time for the automatic exposure to settle before it is fixed; not measured: longer is safer,
/// shorter starts sooner.
const EXPOSURE_SETTLES: Duration = Duration::from_millis(1500);
/// Lists the cameras of this machine: device path, name and modes.
pub fn list() -> Vec<(PathBuf, String, Vec<Mode>)> {
    let Ok(entries) = std::fs::read_dir("/dev") else { return Vec::new() };
    let paths = entries.flatten().map(|entry| entry.path());
    let mut paths: Vec<_> = paths
        .filter(|path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("video")))
        .collect();
    // Sort video2 before video10.
    paths.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    let described = |path: PathBuf| {
        let device = Device::open(&path).ok()?;
        let capabilities = device.capabilities().ok()?;
        let captures = capabilities.device_capabilities().contains(CapabilityFlags::VIDEO_CAPTURE);
        let modes = negotiation::modes(&V4l2::Idle(device));
        (captures && !modes.is_empty()).then(|| (path, capabilities.card().to_owned(), modes))
    };
    paths.into_iter().filter_map(described).collect()
}

/// A V4L2 device before and after its format is set.
enum V4l2 {
    Idle(Device),
    Set(VideoCaptureDevice),
    /// During the transition, and after it failed.
    Gone,
}

impl V4l2 {
    fn idle(&self) -> io::Result<&Device> {
        match self {
            Self::Idle(device) => Ok(device),
            _ => Err(io::Error::other("its format is set already")),
        }
    }
}

/// Converts a frame interval in seconds.
fn seconds(interval: Fract) -> (u32, u32) {
    (interval.numerator(), interval.denominator())
}

fn identifier(control: Control) -> Cid {
    match control {
        Control::ExposureAuto => Cid::EXPOSURE_AUTO,
        Control::Exposure => Cid::EXPOSURE_ABSOLUTE,
        Control::WhiteBalanceAuto => Cid::AUTO_WHITE_BALANCE,
    }
}

impl Driver for V4l2 {
    fn formats(&self) -> Vec<[u8; 4]> {
        let Ok(device) = self.idle() else { return Vec::new() };
        let formats = device.formats(BufType::VIDEO_CAPTURE).flatten();
        formats.map(|description| description.pixel_format().as_fourcc()).collect()
    }

    fn sizes(&self, fourcc: [u8; 4]) -> io::Result<OfferedSizes> {
        Ok(match self.idle()?.frame_sizes(PixelFormat::from_fourcc(fourcc))? {
            FrameSizes::Discrete(sizes) => {
                OfferedSizes::Listed(sizes.iter().map(|size| (size.width(), size.height())).collect())
            }
            FrameSizes::Stepwise(range) | FrameSizes::Continuous(range) => OfferedSizes::Range {
                least: (range.min_width(), range.min_height()),
                most: (range.max_width(), range.max_height()),
                step: (range.step_width(), range.step_height()),
            },
        })
    }

    fn intervals(&self, fourcc: [u8; 4], (width, height): (u32, u32)) -> io::Result<OfferedIntervals> {
        let intervals = self.idle()?.frame_intervals(PixelFormat::from_fourcc(fourcc), width, height)?;
        Ok(match intervals {
            FrameIntervals::Discrete(intervals) => OfferedIntervals::Listed(
                intervals.iter().map(|interval| seconds(*interval.fract())).collect(),
            ),
            FrameIntervals::Stepwise(range) | FrameIntervals::Continuous(range) => {
                OfferedIntervals::Range { shortest: seconds(*range.min()), longest: seconds(*range.max()) }
            }
        })
    }

    fn set_format(&mut self, fourcc: [u8; 4], (width, height): (u32, u32)) -> io::Result<Given> {
        self.idle()?;
        let Self::Idle(device) = std::mem::replace(self, Self::Gone) else {
            return Err(io::ErrorKind::Other.into());
        };
        let capture =
            device.video_capture(PixFormat::new(width, height, PixelFormat::from_fourcc(fourcc)))?;
        let format = capture.format();
        let given = Given {
            fourcc: format.pixel_format().as_fourcc(),
            width: format.width(),
            height: format.height(),
            bytes_per_line: format.bytes_per_line(),
        };
        *self = Self::Set(capture);
        Ok(given)
    }

    fn set_interval(&mut self, (numerator, denominator): (u32, u32)) -> io::Result<(u32, u32)> {
        match self {
            Self::Set(capture) => {
                Ok(seconds(capture.set_frame_interval(Fract::new(numerator, denominator))?))
            }
            _ => Err(io::Error::other("its format is not set")),
        }
    }

    fn control(&self, control: Control) -> io::Result<i32> {
        self.idle()?.read_control_raw(identifier(control))
    }

    fn set_control(&mut self, control: Control, value: i32) -> io::Result<()> {
        match self {
            Self::Idle(device) => device.write_control_raw(identifier(control), value),
            _ => Err(io::Error::other("its format is set already")),
        }
    }
}

/// An open camera that delivers images.
pub struct CameraDevice {
    path: PathBuf,
    mode: Mode,
    bytes_per_line: usize,
    info: SourceInfo,
    stream: ReadStream,
    began: Instant,
    number: u64,
    last_time_s: f64,
    /// Whether the exposure is still to be fixed.
    hold_exposure: bool,
    damaged: u64,
    watch: Watch,
    warnings: Vec<String>,
}

impl CameraDevice {
    /// Opens a camera in the mode that fits a request best.
    ///
    /// # Errors
    /// If there is no camera, another program uses it, or it has no such mode.
    pub fn open(path: &Path, wish: &ModeWish, hold_exposure: bool, watch: Watch) -> Result<Self> {
        let cannot = |what: &'static str| move |error: io::Error| failed(path, what, &error);
        let device = Device::open(path).map_err(cannot(
            "is no camera that can be opened (odograph cameras lists those of this machine)",
        ))?;
        let name = device.capabilities().map_or_else(|_| "camera".to_owned(), |c| c.card().to_owned());
        let mut driver = V4l2::Idle(device);
        let Agreed { mode, bytes_per_line, warnings } = negotiation::set_up(&mut driver, wish, path)?;
        let stream = match driver {
            V4l2::Set(capture) => capture.into_stream(),
            _ => Err(io::Error::other("its format was not set")),
        };
        let stream = stream.map_err(cannot("gives no pictures"))?;
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

    /// Fixes exposure and white balance, if the driver supports it.
    fn hold_exposure(&mut self) {
        self.hold_exposure = false;
        // Through a second file descriptor: drivers allow that for everything except streaming.
        let held =
            Device::open(&self.path).and_then(|device| negotiation::hold_exposure(&mut V4l2::Idle(device)));
        if let Err(error) = held {
            self.warnings.push(format!("{}: the exposure stays automatic ({error})", self.path.display()));
        }
    }

    /// Waits for an image and decodes it; `None` if it was damaged or the source was asked to end.
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

impl LiveSource for CameraDevice {
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
