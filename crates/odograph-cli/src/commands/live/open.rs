//! What a source's name means, and whether it waits for us.

use super::LiveArguments;
use crate::commands::run::SourcePlan;
use crate::files;
use odograph::error::{Error, Result};
use odograph::formats::camera_file;
use odograph_live::capture::camera::ModeWish;
use odograph_live::capture::{HttpMjpeg, LiveSource, Policy, RawFrames, Recording, Watch};
use std::path::Path;
use std::time::Duration;

/// A source and what happens to frames that come too fast.
pub struct Opened {
    pub source: Box<dyn LiveSource>,
    pub policy: Policy,
}

/// Opens a source by its name.
pub fn open(plan: &SourcePlan, arguments: &LiveArguments, watch: &Watch) -> Result<Opened> {
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
        let patience = Duration::from_secs(arguments.patience);
        return Ok(never_late(Box::new(HttpMjpeg::open(name, patience, watch.clone())?)));
    }
    if name.starts_with("/dev/video") {
        return device(Path::new(name), arguments, watch).map(never_late);
    }
    if let Some(format) = arguments.raw {
        return Ok(never_late(Box::new(RawFrames::new(std::io::stdin(), format, watch.clone()))));
    }
    let streams = name == "-" || odograph_video::is_stream(name);
    // A pipe or a stream has a pace of its own already; what it has is what there is now.
    let speed = arguments.realtime.filter(|_| !streams);
    let policy = if speed.is_some() || streams { Policy::NewestWins } else { Policy::Wait };
    Ok(Opened { source: Box::new(Recording::new(plan.open()?, speed, watch.clone())), policy })
}

#[cfg(target_os = "linux")]
fn device(path: &Path, arguments: &LiveArguments, watch: &Watch) -> Result<Box<dyn LiveSource>> {
    // A calibration holds for one size only: that is the one to ask the camera for.
    let calibrated = || -> Option<(u32, u32)> {
        let text = files::read_text(arguments.camera.as_deref()?).ok()?;
        let camera = camera_file::parse(&text, None).ok()?;
        Some((camera.width() as u32, camera.height() as u32))
    };
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
fn device(path: &Path, _: &LiveArguments, _: &Watch) -> Result<Box<dyn LiveSource>> {
    Err(Error::usage(format!(
        "{}: cameras at this machine are read on Linux only; give an http:// address",
        path.display()
    )))
}
