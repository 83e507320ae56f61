//! Interpretation of a source's name, and its drop policy.

use crate::plan::SourcePlan;
use odograph::error::{Error, Result};
use odograph_live::capture::camera::{ModeWish, PixelFormat};
use odograph_live::capture::{
    HttpMjpeg, LiveSource, NetworkStream, Policy, RawFormat, RawFrames, Recording, Watch, without_credentials,
};
use std::path::Path;
use std::time::Duration;

/// How frames are captured from a live source.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CaptureOptions {
    /// Playback speed of a recording relative to its own pace; frames that come too fast are
    /// dropped. Without it every frame is taken, as fast as possible; of frames on standard input
    /// the newest are taken.
    pub realtime: Option<f64>,
    /// Frame rate requested from a camera.
    pub fps: Option<f64>,
    /// Image size requested from a camera, pixels; the calibrated one by default.
    pub size_px: Option<(u32, u32)>,
    /// Pixel format requested from a camera.
    pub format: Option<PixelFormat>,
    /// Leaves automatic exposure on; otherwise it is fixed once it has settled.
    pub auto_exposure: bool,
    /// Format of raw frames on standard input.
    pub raw: Option<RawFormat>,
    /// Longest wait for a network camera to reconnect; a minute by default.
    pub patience: Option<Duration>,
}

/// Default longest wait for a network camera to come back; longer survives a restart of the camera,
/// shorter ends the run of one that is gone.
const PATIENCE: Duration = Duration::from_secs(60);

/// A source and its drop policy.
pub struct LiveInput {
    /// Frames as they come.
    pub source: Box<dyn LiveSource>,
    /// Drop policy.
    pub policy: Policy,
}

/// Opens a source by its name. A camera is asked for images of the size `calibrated` unless the
/// options request another.
///
/// # Errors
/// If the source cannot be opened, or an option does not fit it.
pub fn open_live_input(
    plan: &SourcePlan,
    options: &CaptureOptions,
    calibrated: impl FnOnce() -> Option<(u32, u32)>,
    watch: &Watch,
) -> Result<LiveInput> {
    let name = plan.path.as_str();
    if options.raw.is_some() && name != "-" {
        return Err(Error::usage("--raw says how the frames on standard input look; give - as the source"));
    }
    if name.starts_with("https://") {
        return Err(Error::usage(format!(
            "{}: encrypted streams are not read here; most cameras give http:// too",
            without_credentials(name)
        )));
    }
    check_options(plan, options)?;
    let never_late = |source: Box<dyn LiveSource>| LiveInput { source, policy: Policy::NewestWins };
    if name.starts_with("http://") {
        let patience = options.patience.unwrap_or(PATIENCE);
        return Ok(never_late(Box::new(HttpMjpeg::open(name, patience, watch.clone())?)));
    }
    if name.starts_with("/dev/video") {
        return device(Path::new(name), options, calibrated, watch).map(never_late);
    }
    if let Some(format) = options.raw {
        return Ok(never_late(Box::new(RawFrames::new(std::io::stdin(), format, watch.clone()))));
    }
    if odograph_video::is_stream(name) {
        let patience = options.patience.unwrap_or(PATIENCE);
        let again = plan.clone();
        let stream = NetworkStream::open(name, Box::new(move || again.open()), patience, watch.clone())?;
        return Ok(never_late(Box::new(stream)));
    }
    let streams = name == "-";
    let is_there = || match Path::new(name).try_exists() {
        Err(error) => Err(Error::input(format!("{name} cannot be opened: {error}")).caused_by(error)),
        Ok(is_there) => Ok(is_there),
    };
    if !streams && !name.contains("://") && !is_there()? {
        return Err(Error::input(format!(
            "{name}: there is no such file or camera; odograph cameras lists the cameras of this machine"
        )));
    }
    // A pipe has its own pace: its newest frame is the present one.
    let speed = options.realtime.filter(|_| !streams);
    let policy = if speed.is_some() || streams { Policy::NewestWins } else { Policy::Wait };
    Ok(LiveInput { source: Box::new(Recording::new(plan.open()?, speed, watch.clone())), policy })
}

/// Fails if an option has no effect on this kind of source.
fn check_options(plan: &SourcePlan, options: &CaptureOptions) -> Result<()> {
    let name = without_credentials(&plan.path);
    let is_camera = name.starts_with("/dev/video");
    let is_http = name.starts_with("http://");
    let is_network = is_http || odograph_video::is_stream(&name);
    let chosen = [
        ("--size", options.size_px.is_some()),
        ("--format", options.format.is_some()),
        ("--auto-exposure", options.auto_exposure),
    ];
    let selected = [
        ("--start", plan.start_s.is_some()),
        ("--end", plan.end_s.is_some()),
        ("--every", plan.every != 1),
        ("--topic", plan.topic.is_some()),
    ];
    let given = |options: &[(&'static str, bool)]| {
        options.iter().find(|(_, is_given)| *is_given).map(|(option, _)| *option)
    };
    let refused =
        |option: &str, what: &str| Err(Error::usage(format!("{option} {what}; leave it away for {name}")));
    if let Some(option) = given(&chosen).filter(|_| !is_camera) {
        return refused(option, "is asked of a camera at this machine, such as /dev/video0");
    }
    if options.patience.is_some() && !is_network {
        return refused("--patience", "is for cameras of the network, which may come back");
    }
    if options.realtime.is_some() && (is_camera || is_network) {
        return refused("--realtime", "is for recordings: a camera has its own pace");
    }
    if let Some(option) = given(&selected).filter(|_| is_camera || is_http || options.raw.is_some()) {
        return refused(option, "selects frames of a recording");
    }
    Ok(())
}

#[cfg(target_os = "linux")]
fn device(
    path: &Path,
    options: &CaptureOptions,
    calibrated: impl FnOnce() -> Option<(u32, u32)>,
    watch: &Watch,
) -> Result<Box<dyn LiveSource>> {
    let wish = ModeWish {
        format: options.format,
        size: options.size_px.or_else(calibrated),
        frames_per_second: options.fps,
    };
    let hold_exposure = !options.auto_exposure;
    let camera =
        odograph_live::capture::camera::CameraDevice::open(path, &wish, hold_exposure, watch.clone())?;
    Ok(Box::new(camera))
}

#[cfg(not(target_os = "linux"))]
fn device(
    path: &Path,
    _: &CaptureOptions,
    _: impl FnOnce() -> Option<(u32, u32)>,
    _: &Watch,
) -> Result<Box<dyn LiveSource>> {
    Err(Error::usage(format!(
        "{}: cameras at this machine are read on Linux only; give an http:// address",
        path.display()
    )))
}
