//! Command-line options of capturing.

use odograph_live::capture::RawFormat;
use odograph_live::capture::camera::PixelFormat;
use odograph_session::live::CaptureOptions;
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

fn speed(text: &str) -> std::result::Result<f64, String> {
    match text.parse::<f64>() {
        Ok(speed) if (1e-3..=1e3).contains(&speed) => Ok(speed),
        _ => Err("give a number from 0.001 to 1000; 1 is the recording's own pace".to_owned()),
    }
}

fn pixels(text: &str) -> std::result::Result<(u32, u32), String> {
    let size = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    size.filter(|(w, h)| *w > 0 && *h > 0)
        .ok_or_else(|| "give width and height in pixels, as 640x480".to_owned())
}

impl CaptureArguments {
    /// Whether no option is given.
    pub fn is_empty(&self) -> bool {
        let Self { realtime, fps, size, format, auto_exposure, raw, patience } = self;
        let given = [realtime.is_some(), fps.is_some(), size.is_some(), format.is_some(), *auto_exposure];
        !given.contains(&true) && raw.is_none() && patience.is_none()
    }

    /// The options for a live run.
    pub fn options(&self) -> CaptureOptions {
        let Self { realtime, fps, size, format, auto_exposure, raw, patience } = self.clone();
        let patience = patience.map(Duration::from_secs);
        CaptureOptions { realtime, fps, size_px: size, format, auto_exposure, raw, patience }
    }
}
