//! What a source's name means, and whether it waits for us.

use crate::commands::run::SourcePlan;
use odograph::error::{Error, Result};
use odograph_live::capture::camera::{ModeWish, PixelFormat};
use odograph_live::capture::{
    HttpMjpeg, LiveSource, NetworkStream, Policy, RawFormat, RawFrames, Recording, Watch,
};
use std::path::Path;
use std::time::Duration;

/// How frames are had from a source that gives them as they come.
#[derive(Debug, Clone, PartialEq, clap::Args)]
pub struct CaptureArguments {
    /// Play a recording at its own pace, or at SPEED times that.
    ///
    /// Frames that come too fast are dropped. Without this every frame is taken, as fast as
    /// possible. Of frames on standard input the newest win.
    #[arg(help_heading = "Source", long, value_name = "SPEED", num_args = 0..=1, default_missing_value = "1", value_parser = speed)]
    pub realtime: Option<f64>,
    /// Frame rate: of a recording that does not say, or asked of a camera.
    #[arg(help_heading = "Source", long, value_name = "RATE")]
    pub fps: Option<f64>,
    /// Image size asked of a camera, pixels, such as 640x480.
    ///
    /// [default: the camera file's]
    #[arg(help_heading = "Source", long, value_name = "WxH", value_parser = pixels)]
    pub size: Option<(u32, u32)>,
    /// Pixel format asked of a camera: grey, yuyv or mjpeg.
    #[arg(help_heading = "Source", long, value_name = "FORMAT")]
    pub format: Option<PixelFormat>,
    /// Leave a camera's exposure to itself; otherwise it is held once it has settled.
    #[arg(help_heading = "Source", long)]
    pub auto_exposure: bool,
    /// Standard input has bare frames: gray:640x480@30, yuyv:… or rgb:….
    #[arg(help_heading = "Source", long, value_name = "FORMAT")]
    pub raw: Option<RawFormat>,
    /// Seconds to wait for a network camera to come back.
    ///
    /// [default: 60]
    #[arg(help_heading = "Source", long, value_name = "SECONDS")]
    pub patience: Option<u64>,
}

/// A network camera may be away so long, seconds.
const PATIENCE_S: u64 = 60;

fn speed(text: &str) -> std::result::Result<f64, String> {
    match text.parse::<f64>() {
        Ok(speed) if speed.is_finite() && speed > 0.0 => Ok(speed),
        _ => Err("give a number above zero, 1 for the recording's own pace".to_owned()),
    }
}

fn pixels(text: &str) -> std::result::Result<(u32, u32), String> {
    let size = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    size.filter(|(w, h)| *w > 0 && *h > 0)
        .ok_or_else(|| "give width and height in pixels, as 640x480".to_owned())
}

impl CaptureArguments {
    /// Whether none of them is given.
    pub fn is_empty(&self) -> bool {
        let Self { realtime, fps, size, format, auto_exposure, raw, patience } = self;
        let given = [realtime.is_some(), fps.is_some(), size.is_some(), format.is_some(), *auto_exposure];
        !given.contains(&true) && raw.is_none() && patience.is_none()
    }
}

/// A source and what happens to frames that come too fast.
pub struct Opened {
    pub source: Box<dyn LiveSource>,
    pub policy: Policy,
}

/// Opens a source by its name. Of a camera, pictures of the size `calibrated` are wanted where
/// nothing else is wished.
pub fn open(
    plan: &SourcePlan,
    arguments: &CaptureArguments,
    calibrated: impl FnOnce() -> Option<(u32, u32)>,
    watch: &Watch,
) -> Result<Opened> {
    let name = plan.path.as_str();
    if arguments.raw.is_some() && name != "-" {
        return Err(Error::usage("--raw says how the frames on standard input look; give - as the source"));
    }
    let never_late = |source: Box<dyn LiveSource>| Opened { source, policy: Policy::NewestWins };
    if name.starts_with("https://") {
        return Err(Error::usage(format!(
            "{name}: encrypted streams are not read here; most cameras give http:// too"
        )));
    }
    if name.starts_with("http://") {
        let patience = Duration::from_secs(arguments.patience.unwrap_or(PATIENCE_S));
        return Ok(never_late(Box::new(HttpMjpeg::open(name, patience, watch.clone())?)));
    }
    if name.starts_with("/dev/video") {
        return device(Path::new(name), arguments, calibrated, watch).map(never_late);
    }
    if let Some(format) = arguments.raw {
        return Ok(never_late(Box::new(RawFrames::new(std::io::stdin(), format, watch.clone()))));
    }
    if odograph_video::is_stream(name) {
        let patience = Duration::from_secs(arguments.patience.unwrap_or(PATIENCE_S));
        let again = plan.clone();
        let stream = NetworkStream::open(name, Box::new(move || again.open()), patience, watch.clone())?;
        return Ok(never_late(Box::new(stream)));
    }
    let streams = name == "-";
    // A pipe has a pace of its own already; what it has is what there is now.
    let speed = arguments.realtime.filter(|_| !streams);
    let policy = if speed.is_some() || streams { Policy::NewestWins } else { Policy::Wait };
    Ok(Opened { source: Box::new(Recording::new(plan.open()?, speed, watch.clone())), policy })
}

#[cfg(target_os = "linux")]
fn device(
    path: &Path,
    arguments: &CaptureArguments,
    calibrated: impl FnOnce() -> Option<(u32, u32)>,
    watch: &Watch,
) -> Result<Box<dyn LiveSource>> {
    let wish = ModeWish {
        format: arguments.format,
        size: arguments.size.or_else(calibrated),
        frames_per_second: arguments.fps,
    };
    let hold_exposure = !arguments.auto_exposure;
    let camera = odograph_live::capture::camera::Camera::open(path, &wish, hold_exposure, watch.clone())?;
    Ok(Box::new(camera))
}

#[cfg(not(target_os = "linux"))]
fn device(
    path: &Path,
    _: &CaptureArguments,
    _: impl FnOnce() -> Option<(u32, u32)>,
    _: &Watch,
) -> Result<Box<dyn LiveSource>> {
    Err(Error::usage(format!(
        "{}: cameras at this machine are read on Linux only; give an http:// address",
        path.display()
    )))
}
