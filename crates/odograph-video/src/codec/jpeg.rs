//! JPEG (ITU-T T.81): still images and the frames of Motion JPEG.

use super::{DecodeResult, Decoded, Decoder, Refusal, Stamp, StreamFacts};
use crate::frame::{Chroma, Color, ColorEncoding, Deferred, Matrix, Picture, picture_from_rgb};
use crate::guard::guarded;
use crate::limits;
use odograph::error::{Error, Result};
use odograph::image::GrayImage;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

fn options() -> DecoderOptions {
    DecoderOptions::default()
        .set_max_width(limits::MAX_SIDE)
        .set_max_height(limits::MAX_SIDE)
        .set_strict_mode(false)
}

/// Decodes a JPEG image. For Y'CbCr the luminance is used unconverted and the chroma is decoded on
/// demand; other colour spaces are converted from RGB.
///
/// The decoder may panic; callers must guard the call ([`guarded`]).
pub(crate) fn decode(bytes: &[u8], color: bool) -> Result<Picture> {
    let damaged =
        |error: &dyn std::fmt::Display| Error::input(format!("the JPEG picture cannot be decoded: {error}"));
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options());
    decoder.decode_headers().map_err(|e| damaged(&e))?;
    let info = decoder.info().ok_or_else(|| damaged(&"it has no head"))?;
    let (width, height) = (usize::from(info.width), usize::from(info.height));
    limits::check_size(width, height)?;
    // A block of 8x8 samples takes at least one bit (ITU-T T.81, F.1.2). The decoder would fill in
    // what is missing, for seconds.
    if width.div_ceil(8) * height.div_ceil(8) > 8 * bytes.len() {
        return Err(damaged(&format_args!("{} bytes are too few for {width}x{height} pixels", bytes.len())));
    }
    let (wanted, deferred) = match decoder.input_colorspace() {
        Some(ColorSpace::Luma) => (ColorSpace::Luma, false),
        Some(ColorSpace::YCbCr) => (ColorSpace::Luma, color),
        _ => (ColorSpace::RGB, false),
    };
    decoder.set_options(options().jpeg_set_out_colorspace(wanted));
    let samples = decoder.decode().map_err(|e| damaged(&e))?;
    let picture = match wanted {
        ColorSpace::Luma => GrayImage::from_samples(width, height, samples).map(|gray| {
            let color = deferred.then(|| Color::Deferred(Deferred::new(bytes, chroma)));
            Picture { gray, color }
        }),
        _ => picture_from_rgb(width, height, samples, color),
    };
    picture.ok_or_else(|| damaged(&"it does not have as many samples as its size says"))
}

/// Decodes the chroma of an image whose luminance has been decoded; `None` on failure.
fn chroma(bytes: &[u8]) -> Option<Chroma> {
    let whole = || {
        let options = options().jpeg_set_out_colorspace(ColorSpace::YCbCr);
        let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
        let samples = decoder.decode().ok()?;
        let info = decoder.info()?;
        let plane = |channel: usize| samples.chunks_exact(3).map(|pixel| pixel[channel]).collect();
        let encoding = ColorEncoding { matrix: Matrix::Bt601, full_range: true };
        let (width, height) = (usize::from(info.width), usize::from(info.height));
        Some(Chroma { width, height, blue: plane(1), red: plane(2), encoding }).filter(Chroma::is_whole)
    };
    guarded("JPEG", whole).ok()?
}

/// Motion JPEG: every sample is an independent image.
pub(crate) struct MotionJpeg {
    color: bool,
    /// Frame height in the container; a sample of half that height is one field of an interlaced
    /// frame.
    height: usize,
    number: i64,
}

impl MotionJpeg {
    pub fn new(height: usize, color: bool) -> Self {
        Self { color, height, number: 0 }
    }
}

impl Decoder for MotionJpeg {
    fn decode(&mut self, data: &[u8], stamp: Stamp, out: &mut Vec<Decoded>) -> DecodeResult {
        let picture = guarded("JPEG", || decode(data, self.color))?;
        let picture = picture.map_err(|error| Refusal::Damaged(error.to_string()))?;
        if self.height > 0 && picture.gray.height() * 2 <= self.height {
            return Err(Refusal::Unsupported("interlaced".into()));
        }
        self.number += 1;
        out.push(Decoded { picture, stamp, order: self.number, starts_group: false });
        Ok(())
    }

    fn stream(&self) -> StreamFacts {
        StreamFacts::named("Motion JPEG")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_size_that_its_bytes_cannot_have_is_refused() {
        let mut bytes = include_bytes!("../../tests/data/ramp.jpg").to_vec();
        assert!(decode(&bytes, false).is_ok());
        // Height and width in the frame header.
        let at = 5 + bytes.windows(2).position(|pair| pair == [0xff, 0xc0]).unwrap();
        bytes[at..at + 4].copy_from_slice(&[16, 8, 47, 16]);
        let message = decode(&bytes, false).unwrap_err().to_string();
        assert!(message.ends_with("219 bytes are too few for 12048x4104 pixels"), "{message}");
    }
}
