//! Local cameras (V4L2).
//!
//! A camera's capabilities are a list of [`Mode`]s, and [`choose`] selects one of them without
//! access to the device. The dialogue with the driver (`negotiation`) is tested against recorded
//! answers of real cameras, so the part that accesses the device is thin.

#[cfg(target_os = "linux")]
mod device;
#[cfg(any(target_os = "linux", test))]
mod negotiation;

#[cfg(target_os = "linux")]
pub use device::{CameraDevice, list};

use odograph::error::{Error, Result};
use odograph_video::SampleLayout;
use std::fmt;

/// Pixel format of a camera's images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum PixelFormat {
    /// Luminance only, `GREY`.
    Gray,
    /// Uncompressed colour, `YUYV`.
    Yuyv,
    /// One JPEG per image, `MJPG` or `JPEG`.
    Jpeg,
}

impl PixelFormat {
    /// Converts from a V4L2 FourCC; `None` for formats that are not supported.
    pub fn from_fourcc(letters: [u8; 4]) -> Option<Self> {
        match &letters {
            b"GREY" => Some(Self::Gray),
            b"YUYV" => Some(Self::Yuyv),
            b"MJPG" | b"JPEG" => Some(Self::Jpeg),
            _ => None,
        }
    }

    /// Sample layout; `None` for compressed formats.
    pub fn layout(self) -> Option<SampleLayout> {
        match self {
            Self::Gray => Some(SampleLayout::Gray),
            Self::Yuyv => Some(SampleLayout::Yuyv),
            Self::Jpeg => None,
        }
    }
}

impl fmt::Display for PixelFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Gray => "grey",
            Self::Yuyv => "yuyv",
            Self::Jpeg => "mjpeg",
        })
    }
}

impl std::str::FromStr for PixelFormat {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        match text.to_ascii_lowercase().as_str() {
            "grey" | "gray" | "y8" => Ok(Self::Gray),
            "yuyv" => Ok(Self::Yuyv),
            "mjpeg" | "mjpg" | "jpeg" => Ok(Self::Jpeg),
            _ => Err("one of grey, yuyv and mjpeg".to_owned()),
        }
    }
}

/// An operating mode of a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mode {
    /// Pixel format.
    pub format: PixelFormat,
    /// FourCC under which the driver lists the format.
    pub fourcc: [u8; 4],
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Frame rate in frames per second, as a fraction, e.g. 30/1; `None` if the driver does not
    /// report it.
    pub rate: Option<(u32, u32)>,
}

impl Mode {
    /// Frame rate, frames per second; `None` if unknown or not positive.
    pub fn frames_per_second(&self) -> Option<f64> {
        let (frames, seconds) = self.rate?;
        (frames > 0 && seconds > 0).then(|| f64::from(frames) / f64::from(seconds))
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{} {}", self.width, self.height, self.format)?;
        match self.frames_per_second() {
            Some(rate) => write!(f, " at {} frames/s", (100.0 * rate).round() / 100.0),
            None => Ok(()),
        }
    }
}

/// The requested mode; fields that are `None` are chosen automatically.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ModeWish {
    /// Pixel format.
    pub format: Option<PixelFormat>,
    /// Width and height, pixels; mostly the size for which the camera was calibrated.
    pub size: Option<(u32, u32)>,
    /// Frame rate, frames per second.
    pub frames_per_second: Option<f64>,
}

/// Default image size in pixels: larger images cost time and improve the tracking little.
const USUAL_PIXELS: f64 = 640.0 * 480.0;
/// Default frame rate, frames per second: higher rates improve the tracking little.
const USUAL_RATE: f64 = 30.0;

/// Selects the mode that fits a request best.
///
/// A requested format or size is binding; the nearest available frame rate is used. The defaults
/// are about 640x480 at 30 frames per second. Uncompressed is preferred to JPEG, whose artefacts
/// move with the image, unless it halves the frame rate, as it does over USB 2.
///
/// # Errors
/// If no mode has the requested format and size; the message lists the available ones.
pub fn choose(modes: &[Mode], wish: &ModeWish) -> Result<Mode> {
    let fits = |mode: &&Mode| {
        wish.format.is_none_or(|format| mode.format == format)
            && wish.size.is_none_or(|size| (mode.width, mode.height) == size)
    };
    let rate = |mode: &Mode| mode.frames_per_second().unwrap_or(USUAL_RATE);
    let wanted = wish.frames_per_second.unwrap_or(USUAL_RATE);
    let cost = |mode: &Mode| {
        let octaves = |value: f64, best: f64| (value / best).log2().abs();
        let size = octaves(f64::from(mode.width) * f64::from(mode.height), USUAL_PIXELS);
        let format = match mode.format {
            PixelFormat::Gray => 0.0,
            PixelFormat::Yuyv => 0.1,
            PixelFormat::Jpeg => 0.9,
        };
        2.0 * size + octaves(rate(mode), wanted) + format
    };
    let best = modes.iter().filter(fits).min_by(|a, b| cost(a).total_cmp(&cost(b)));
    best.copied().ok_or_else(|| {
        let mut sizes: Vec<String> =
            modes.iter().map(|mode| format!("{}x{} {}", mode.width, mode.height, mode.format)).collect();
        sizes.dedup();
        let wished = wish.size.map_or(String::new(), |(width, height)| format!(" {width}x{height}"));
        let format = wish.format.map_or(String::new(), |format| format!(" {format}"));
        if sizes.is_empty() {
            Error::input("the camera has no mode that is read here (GREY, YUYV or MJPEG)")
        } else {
            Error::usage(format!("the camera has no mode{wished}{format}; it has {}", sizes.join(", ")))
        }
    })
}

/// Representative sizes of a range that a driver supports in steps: common sizes within it, and its
/// two ends.
pub fn sizes_in_range(least: (u32, u32), most: (u32, u32), step: (u32, u32)) -> Vec<(u32, u32)> {
    const COMMON: [(u32, u32); 6] =
        [(320, 240), (640, 480), (800, 600), (1280, 720), (1280, 960), (1920, 1080)];
    let on_step = |value: u32, least: u32, step: u32| step <= 1 || (value - least).is_multiple_of(step);
    let possible = |&(width, height): &(u32, u32)| {
        (least.0..=most.0).contains(&width)
            && (least.1..=most.1).contains(&height)
            && on_step(width, least.0, step.0)
            && on_step(height, least.1, step.1)
    };
    let mut sizes: Vec<_> = COMMON.into_iter().filter(possible).collect();
    sizes.extend([least, most]);
    sizes.sort_unstable();
    sizes.dedup();
    sizes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mode(fourcc: &[u8; 4], width: u32, height: u32, rate: u32) -> Mode {
        let format = PixelFormat::from_fourcc(*fourcc).unwrap();
        Mode { format, fourcc: *fourcc, width, height, rate: Some((rate, 1)) }
    }

    /// The modes of a common USB 2 camera, which delivers large images fast only as JPEG.
    fn usb_camera() -> Vec<Mode> {
        vec![
            mode(b"MJPG", 1920, 1080, 30),
            mode(b"MJPG", 1280, 720, 30),
            mode(b"MJPG", 640, 480, 30),
            mode(b"YUYV", 1280, 720, 10),
            mode(b"YUYV", 640, 480, 30),
            mode(b"YUYV", 640, 480, 15),
            mode(b"YUYV", 320, 240, 30),
        ]
    }

    fn chosen(wish: ModeWish) -> String {
        choose(&usb_camera(), &wish).map_or_else(|error| error.to_string(), |mode| mode.to_string())
    }

    #[test]
    fn requested_modes_are_kept_and_defaults_fill_the_rest() {
        let wish = ModeWish::default();
        assert_eq!(chosen(wish), "640x480 yuyv at 30 frames/s");
        // Uncompressed only if it does not reduce the frame rate.
        assert_eq!(chosen(ModeWish { size: Some((1280, 720)), ..wish }), "1280x720 mjpeg at 30 frames/s");
        assert_eq!(
            chosen(ModeWish { size: Some((1280, 720)), frames_per_second: Some(10.0), ..wish }),
            "1280x720 yuyv at 10 frames/s"
        );
        assert_eq!(
            chosen(ModeWish { format: Some(PixelFormat::Jpeg), ..wish }),
            "640x480 mjpeg at 30 frames/s"
        );
        assert_eq!(chosen(ModeWish { frames_per_second: Some(12.0), ..wish }), "640x480 yuyv at 15 frames/s");
        let none = chosen(ModeWish { size: Some((1024, 768)), format: Some(PixelFormat::Gray), ..wish });
        assert!(none.starts_with("the camera has no mode 1024x768 grey; it has 1920x1080 mjpeg,"), "{none}");
        assert!(choose(&[], &wish).unwrap_err().to_string().contains("GREY, YUYV or MJPEG"));
    }

    #[test]
    fn a_size_range_is_sampled_at_common_sizes() {
        assert_eq!(
            sizes_in_range((16, 16), (1600, 1200), (16, 8)),
            [(16, 16), (320, 240), (640, 480), (800, 600), (1280, 720), (1280, 960), (1600, 1200)]
        );
        assert_eq!(sizes_in_range((640, 480), (640, 480), (0, 0)), [(640, 480)]);
    }
}
