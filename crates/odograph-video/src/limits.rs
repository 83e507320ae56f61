//! Bounds on what untrusted input may ask for.

use odograph::error::{Error, Result};

/// Largest width or height of a frame, in pixels.
pub(crate) const MAX_SIDE: usize = 16_384;
/// Largest frame, in pixels.
pub(crate) const MAX_PIXELS: usize = 256 << 20;
/// Largest frame of a video, in pixels: a little more than 8K. Decoders keep up to 17 frames, so a header's word alone must not
/// ask for much.
pub(crate) const MAX_VIDEO_PIXELS: usize = 36 << 20;
/// Largest single compressed picture or video sample, in bytes.
pub(crate) const MAX_SAMPLE_BYTES: u64 = 256 << 20;
/// Largest index (the `moov` box of an MP4 file, the headers of a Matroska file), in bytes.
pub(crate) const MAX_INDEX_BYTES: u64 = 512 << 20;
/// Most samples of one video track: four days at 30 frames a second.
pub(crate) const MAX_SAMPLES: usize = 10_000_000;

/// Refuses a frame size that is empty or larger than this program takes; gives the number of pixels.
pub(crate) fn check_size(width: usize, height: usize) -> Result<usize> {
    if width == 0 || height == 0 {
        return Err(Error::input(format!("a frame of {width}x{height} pixels is empty")));
    }
    match width.checked_mul(height) {
        Some(pixels) if width <= MAX_SIDE && height <= MAX_SIDE && pixels <= MAX_PIXELS => Ok(pixels),
        _ => Err(Error::input(format!(
            "a frame of {width}x{height} pixels is larger than the {MAX_SIDE} pixels a side and {} megapixels this program takes",
            MAX_PIXELS >> 20
        ))),
    }
}

/// As [`check_size`], for the frames of a video before its decoder asks for memory.
pub(crate) fn check_video_size(width: usize, height: usize) -> Result<usize> {
    check_size(width, height).and_then(|pixels| {
        if pixels > MAX_VIDEO_PIXELS {
            return Err(Error::input(format!(
                "a video of {width}x{height} pixels is larger than the {} megapixels this program takes",
                MAX_VIDEO_PIXELS >> 20
            )));
        }
        Ok(pixels)
    })
}
