//! Negotiation of the operating mode with a camera's driver.
//!
//! The driver is accessed through [`Driver`], which mirrors the V4L2 calls, so that tests can
//! replay the recorded answers of real cameras.

use super::{Mode, ModeWish, PixelFormat, choose, sizes_in_range};
use odograph::error::{Error, Result};
use std::io;
use std::path::Path;

/// Image sizes of a format, pixels (`VIDIOC_ENUM_FRAMESIZES`).
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OfferedSizes {
    /// A list of sizes.
    Listed(Vec<(u32, u32)>),
    /// All sizes from `least` to `most` in steps of `step`.
    Range { least: (u32, u32), most: (u32, u32), step: (u32, u32) },
}

/// Frame intervals of a format and size, seconds as fractions (`VIDIOC_ENUM_FRAMEINTERVALS`).
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OfferedIntervals {
    /// A list of intervals.
    Listed(Vec<(u32, u32)>),
    /// All intervals from `shortest` to `longest`.
    Range { shortest: (u32, u32), longest: (u32, u32) },
}

/// The format that a driver has set (`VIDIOC_S_FMT`); it may differ from the requested one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Given {
    pub fourcc: [u8; 4],
    pub width: u32,
    pub height: u32,
    /// Row stride, bytes; 0 for compressed formats.
    pub bytes_per_line: u32,
}

/// The controls used here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Control {
    /// `V4L2_CID_EXPOSURE_AUTO`.
    ExposureAuto,
    /// `V4L2_CID_EXPOSURE_ABSOLUTE`.
    Exposure,
    /// `V4L2_CID_AUTO_WHITE_BALANCE`.
    WhiteBalanceAuto,
}

/// `V4L2_EXPOSURE_MANUAL`.
const EXPOSURE_MANUAL: i32 = 1;

/// A camera's driver.
pub trait Driver {
    /// FourCCs of all formats, including those that are not supported here.
    fn formats(&self) -> Vec<[u8; 4]>;
    fn sizes(&self, fourcc: [u8; 4]) -> io::Result<OfferedSizes>;
    fn intervals(&self, fourcc: [u8; 4], size: (u32, u32)) -> io::Result<OfferedIntervals>;
    fn set_format(&mut self, fourcc: [u8; 4], size: (u32, u32)) -> io::Result<Given>;
    /// Sets the frame interval, seconds as a fraction, and returns the one that the driver set.
    fn set_interval(&mut self, seconds: (u32, u32)) -> io::Result<(u32, u32)>;
    fn control(&self, control: Control) -> io::Result<i32>;
    fn set_control(&mut self, control: Control, value: i32) -> io::Result<()>;
}

/// All modes of a camera in supported formats, without duplicates.
pub fn modes(driver: &dyn Driver) -> Vec<Mode> {
    let mut modes: Vec<Mode> = Vec::new();
    for fourcc in driver.formats() {
        let Some(format) = PixelFormat::from_fourcc(fourcc) else { continue };
        let sizes = match driver.sizes(fourcc) {
            Ok(OfferedSizes::Listed(sizes)) => sizes,
            Ok(OfferedSizes::Range { least, most, step }) => sizes_in_range(least, most, step),
            Err(_) => Vec::new(),
        };
        for (width, height) in sizes {
            let rates = match driver.intervals(fourcc, (width, height)) {
                Ok(OfferedIntervals::Listed(intervals)) => {
                    intervals.into_iter().map(|interval| Some(rate(interval))).collect()
                }
                // Any interval of the range can be requested.
                Ok(OfferedIntervals::Range { shortest, longest }) => {
                    vec![Some(rate(shortest)), Some((30, 1)), Some(rate(longest))]
                }
                Err(_) => vec![None],
            };
            for rate in rates {
                let mode = Mode { format, fourcc, width, height, rate };
                // Cameras list their preferred size twice, as the USB video class specification
                // requires.
                if !modes.contains(&mode) {
                    modes.push(mode);
                }
            }
        }
    }
    modes
}

/// Converts a frame interval into a frame rate; both are fractions.
fn rate((seconds, parts): (u32, u32)) -> (u32, u32) {
    (parts, seconds)
}

/// Result of the negotiation.
#[derive(Debug, Clone, PartialEq)]
pub struct Agreed {
    pub mode: Mode,
    /// Row stride, bytes; 0 for compressed formats.
    pub bytes_per_line: usize,
    pub warnings: Vec<String>,
}

/// Sets a camera to the mode that fits a request best.
///
/// # Errors
/// If it has no such mode, or the driver sets another mode than it listed.
pub fn set_up(driver: &mut dyn Driver, wish: &ModeWish, path: &Path) -> Result<Agreed> {
    let wished = choose(&modes(driver), wish).map_err(|error| error.at(path.display()))?;
    let given = driver
        .set_format(wished.fourcc, (wished.width, wished.height))
        .map_err(|error| failed(path, "cannot be set up", &error))?;
    let mode = Mode { width: given.width, height: given.height, ..wished };
    if given.fourcc != wished.fourcc || mode != wished {
        let letters = String::from_utf8_lossy(&given.fourcc);
        return Err(Error::input(format!(
            "{} promised {wished} and gives {}x{} {letters}",
            path.display(),
            given.width,
            given.height
        )));
    }
    let bytes_per_line = match mode.format {
        PixelFormat::Jpeg => 0,
        // Some drivers report 0 for rows without padding.
        PixelFormat::Gray => given.bytes_per_line.max(mode.width),
        PixelFormat::Yuyv => given.bytes_per_line.max(2 * mode.width),
    } as usize;
    let mut agreed = Agreed { mode, bytes_per_line, warnings: Vec::new() };
    agreed.set_rate(driver, path);
    Ok(agreed)
}

impl Agreed {
    fn set_rate(&mut self, driver: &mut dyn Driver, path: &Path) {
        let Some((frames, seconds)) = self.mode.rate.filter(|(frames, seconds)| *frames > 0 && *seconds > 0)
        else {
            return;
        };
        match driver.set_interval((seconds, frames)) {
            Ok(taken) => {
                let wished = self.mode.frames_per_second();
                self.mode.rate = Some(rate(taken));
                let got = self.mode.frames_per_second();
                // Drivers count in units of 100 ns; a difference of up to 2 %, as 29.97 for 30,
                // counts as equal.
                let same = wished.zip(got).is_some_and(|(wished, got)| (got - wished).abs() <= 0.02 * wished);
                if !same {
                    let offered = got.map_or("another rate".to_owned(), |got| format!("{got:.1} frames/s"));
                    self.warnings.push(format!(
                        "{}: {:.1} frames/s were asked for, it gives {offered}",
                        path.display(),
                        wished.unwrap_or_default()
                    ));
                }
            }
            Err(error) => self.warnings.push(format!("{}: the rate cannot be set ({error})", path.display())),
        }
    }
}

/// The message for a failed operation, with the system's reason.
pub fn failed(path: &Path, what: &str, error: &io::Error) -> Error {
    // EBUSY and EACCES, the two errors that the user can resolve.
    let why = match error.raw_os_error() {
        Some(16) => "it is in use by another program".to_owned(),
        Some(13) => "you have no permission to open it (usually the group `video` has)".to_owned(),
        _ => error.to_string(),
    };
    Error::input(format!("{} {what}: {why}", path.display()))
}

/// Fixes exposure and white balance at the values of the automatic control. Changes of either alter
/// the appearance of every corner, and long exposures blur the image.
///
/// # Errors
/// If the exposure cannot be fixed. A white balance that cannot be fixed is ignored, as the cost is
/// small.
pub fn hold_exposure(driver: &mut dyn Driver) -> io::Result<()> {
    // Read first: some cameras change the exposure when switched to manual.
    let found = driver.control(Control::Exposure);
    driver.set_control(Control::ExposureAuto, EXPOSURE_MANUAL)?;
    if let Ok(found) = found {
        driver.set_control(Control::Exposure, found)?;
    }
    let _ = driver.set_control(Control::WhiteBalanceAuto, 0);
    Ok(())
}

#[cfg(test)]
mod tests;
