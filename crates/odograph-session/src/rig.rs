//! The rig file, and whether its height was meant in metres.

use crate::files;
use crate::observer::Observer;
use odograph::camera::{LeverArm, Rig};
use odograph::error::Result;
use odograph::formats::rig_file;
use std::path::Path;

/// Cameras on vehicles are lower: above this a height without a unit is probably in another unit
/// than metres.
const DOUBTFUL_HEIGHT_M: f64 = 10.0;

/// Above this such a number is probably in millimetres, below it in centimetres.
const MILLIMETRES_FROM: f64 = 300.0;

/// The unit in which a height was probably meant that was given as a bare number, short and in
/// full; `None` where metres are plausible.
pub fn doubtful_unit(height_m: f64) -> Option<(&'static str, &'static str)> {
    if !(height_m.is_finite() && height_m > DOUBTFUL_HEIGHT_M) {
        return None;
    }
    Some(if height_m >= MILLIMETRES_FROM { ("mm", "millimetres") } else { ("cm", "centimetres") })
}

/// The rig in a file; the observer hears of a height that is probably in another unit.
///
/// # Errors
/// If the file cannot be read or is no rig file.
pub fn read_rig(path: &Path, observer: &dyn Observer) -> Result<Rig> {
    let rig = rig_file::parse(&files::read_text(path)?).map_err(|error| error.at(path.display()))?;
    if let Some((_, name)) = doubtful_unit(rig.height_m) {
        observer.warn(&format!(
            "{}: height_m is {}, a camera {} metres above the ground; are {name} meant?",
            path.display(),
            rig.height_m,
            rig.height_m,
        ));
    }
    Ok(rig)
}
