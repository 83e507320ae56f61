//! The mask of what is not ground.

use odograph::error::{Error, Result};
use odograph::image::GrayImage;
use odograph_video::SourceOptions;
use std::path::Path;

/// Reads a mask in any image format that recordings may have.
pub fn read(path: &Path) -> Result<GrayImage> {
    let mut source = odograph_video::open(path.display().to_string(), &SourceOptions::default())?;
    let frame = source.next_frame()?;
    frame
        .map(|frame| frame.gray)
        .ok_or_else(|| Error::input(format!("{} shows nothing; a mask is one picture", path.display())))
}
