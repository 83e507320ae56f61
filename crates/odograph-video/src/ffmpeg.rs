//! Everything else, through an installed `ffmpeg`.

use crate::source::Opened;
use odograph::error::{Error, Result};
use std::path::Path;

/// Opens a file with ffmpeg. `codec` names what this crate does not decode.
pub(crate) fn open(_path: &Path, codec: &str, _color: bool) -> Result<Opened> {
    Err(Error::input(format!("{codec} needs ffmpeg, which is not installed")))
}
