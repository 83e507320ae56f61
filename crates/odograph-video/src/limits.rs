//! Limits on the resources that untrusted input may claim.

use odograph::error::{Error, Result};

/// Largest width or height of a frame, pixels.
pub(crate) const MAX_SIDE: usize = 16_384;
/// Largest frame, pixels.
pub(crate) const MAX_PIXELS: usize = 256 << 20;
/// Largest video frame, pixels: slightly more than 8K. Decoders hold up to 17 frames, and the size
/// is claimed by a header alone.
pub(crate) const MAX_VIDEO_PIXELS: usize = 36 << 20;
/// Largest compressed image or video sample, bytes.
pub(crate) const MAX_SAMPLE_BYTES: u64 = 256 << 20;
/// Largest index (the `moov` box of an MP4 file, the headers of a Matroska file), bytes.
pub(crate) const MAX_INDEX_BYTES: u64 = 512 << 20;
/// Largest number of samples of a video track: four days at 30 frames per second.
pub(crate) const MAX_SAMPLES: usize = 10_000_000;

/// Returns the number of pixels of a frame. Fails if the frame is empty or exceeds a limit.
pub(crate) fn check_size(width: usize, height: usize) -> Result<usize> {
    if width == 0 || height == 0 {
        return Err(Error::input(format!(
            "a frame of {width}x{height} pixels is empty: the size is missing, or the file is damaged; record or \
             copy it again"
        )));
    }
    match width.checked_mul(height) {
        Some(pixels) if width <= MAX_SIDE && height <= MAX_SIDE && pixels <= MAX_PIXELS => Ok(pixels),
        _ => Err(Error::input(format!(
            "a frame of {width}x{height} pixels is larger than the {MAX_SIDE} pixels a side and {} megapixels this program takes",
            MAX_PIXELS >> 20
        ))),
    }
}

/// As [`check_size`], with the lower limit for video frames; to be called before a decoder
/// allocates memory.
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
