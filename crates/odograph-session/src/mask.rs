//! The mask of what is not ground.

use odograph::error::{Error, Result};
use odograph::image::GrayImage;
use std::path::Path;

/// Reads a mask in any image format that recordings may have.
pub fn read(path: &Path) -> Result<GrayImage> {
    if !path.is_dir() {
        odograph_video::check_regular_file(path).map_err(|error| {
            Error::input(format!("{} cannot be read: {error}", path.display())).caused_by(error)
        })?;
    }
    let explained = |error: Error| {
        Error::input(format!(
            "{error}; a mask is one picture (PNG, JPEG, TIFF, PGM or PPM) of the size of the frames, black where \
             there is no ground"
        ))
        .caused_by(error)
    };
    let mut source = odograph_video::open_picture(path).map_err(explained)?;
    let frame = source.next_frame().map_err(explained)?;
    frame
        .map(|frame| frame.gray)
        .ok_or_else(|| Error::input(format!("{} shows nothing; a mask is one picture", path.display())))
}
