//! `odograph cameras`: lists the cameras of this machine with their modes.

use crate::{Outcome, console};
use odograph::error::Result;
use std::fmt::Write;

/// List the cameras of this machine.
///
/// With the sizes, rates and formats of each.
#[derive(Debug, clap::Args)]
pub struct CamerasArguments {}

/// Runs the command.
pub fn cameras(_: CamerasArguments) -> Result<Outcome> {
    let mut text = String::new();
    for (path, name, modes) in found() {
        let _ = writeln!(text, "{}  {}", console::name(path), console::name(name));
        for mode in modes {
            let _ = writeln!(text, "    {mode}");
        }
    }
    if text.is_empty() {
        console::note("no camera was found at this machine (/dev/video*)");
    }
    console::print(&text)?;
    Ok(Outcome::Done)
}

type ListedCamera = Vec<(std::path::PathBuf, String, Vec<odograph_live::capture::camera::Mode>)>;

#[cfg(target_os = "linux")]
fn found() -> ListedCamera {
    odograph_live::capture::camera::list()
}

#[cfg(not(target_os = "linux"))]
fn found() -> ListedCamera {
    Vec::new()
}
