//! Decodes an image file.

use super::{exif_data, portable};
use crate::codec::narrow_full_scale;
use crate::frame::{Picture, picture_from_rgb};
use crate::guard::guarded;
use crate::limits;
use crate::regular_file::read_regular_file;
use crate::rotation::Orientation;
use odograph::error::{Error, Result};
use odograph::image::GrayImage;
use std::io::{Cursor, ErrorKind};
use std::path::Path;

/// Image format, detected from the first bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Png,
    Jpeg,
    Tiff,
    Portable,
}

fn kind(bytes: &[u8]) -> Option<Kind> {
    match bytes {
        [0x89, b'P', b'N', b'G', ..] => Some(Kind::Png),
        [0xff, 0xd8, 0xff, ..] => Some(Kind::Jpeg),
        [b'I', b'I', 42 | 43, 0, ..] | [b'M', b'M', 0, 42 | 43, ..] => Some(Kind::Tiff),
        [b'P', b'2' | b'3' | b'5' | b'6', c, ..] if c.is_ascii_whitespace() || *c == b'#' => {
            Some(Kind::Portable)
        }
        _ => None,
    }
}

/// Whether a file with these first bytes is an image in a supported format.
pub(crate) fn is_picture(bytes: &[u8]) -> bool {
    kind(bytes).is_some()
}

/// Reads and decodes an image file and rotates it upright.
pub(super) fn picture(path: &Path, color: bool) -> Result<Picture> {
    let bytes = read_regular_file(path, limits::MAX_SAMPLE_BYTES).map_err(|error| {
        Error::input(match error.kind() {
            ErrorKind::FileTooLarge => "the picture file is larger than 256 MB".to_owned(),
            _ => format!("cannot be read: {error}"),
        })
    })?;
    guarded("picture", || decode(&bytes, color))?
}

/// Decodes the bytes of an image file and rotates the image upright.
///
/// The decoders may panic; callers must guard the call ([`guarded`]).
pub(crate) fn decode(bytes: &[u8], color: bool) -> Result<Picture> {
    let kind =
        kind(bytes).ok_or_else(|| Error::input("this is not a PNG, JPEG, TIFF, PGM or PPM picture"))?;
    let (picture, orientation) = match kind {
        Kind::Png => (png(bytes, color), Orientation::default()),
        Kind::Jpeg if jpeg_is_cut_off(bytes) => {
            (Err(Error::input("the JPEG picture is cut off")), Orientation::default())
        }
        Kind::Jpeg => (crate::codec::jpeg::decode(bytes, color), exif_data::orientation(bytes)),
        Kind::Tiff => (tiff(bytes, color), exif_data::orientation(bytes)),
        Kind::Portable => (portable::decode(bytes, color), Orientation::default()),
    };
    Ok(orientation.upright(picture?))
}

/// Whether a JPEG image is truncated: its end marker is missing after the last scan. The decoder
/// would fill in the missing part, which must not be tracked.
fn jpeg_is_cut_off(bytes: &[u8]) -> bool {
    let last = |marker: u8| bytes.windows(2).rposition(|pair| pair == [0xff, marker]);
    last(0xd9) < last(0xda)
}

fn png(bytes: &[u8], color: bool) -> Result<Picture> {
    let damaged =
        |error: png::DecodingError| Error::input(format!("the PNG picture cannot be decoded: {error}"));
    let limits = png::Limits { bytes: 8 * limits::MAX_PIXELS };
    let mut decoder = png::Decoder::new_with_limits(Cursor::new(bytes), limits);
    decoder.set_transformations(png::Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(damaged)?;
    let (width, height) = (reader.info().width as usize, reader.info().height as usize);
    limits::check_size(width, height)?;
    let size = reader.output_buffer_size().ok_or_else(|| Error::input("the PNG picture is too large"))?;
    let mut samples = vec![0; size];
    let info = reader.next_frame(&mut samples).map_err(damaged)?;
    samples.truncate(info.buffer_size());
    if info.bit_depth == png::BitDepth::Sixteen {
        samples =
            samples.chunks_exact(2).map(|s| narrow_full_scale(u16::from_be_bytes([s[0], s[1]]))).collect();
    }
    assemble(width, height, info.color_type.samples(), samples, color)
}

fn tiff(bytes: &[u8], color: bool) -> Result<Picture> {
    use tiff::ColorType;
    use tiff::decoder::DecodingResult;
    let damaged =
        |error: tiff::TiffError| Error::input(format!("the TIFF picture cannot be decoded: {error}"));
    let mut allowed = tiff::decoder::Limits::default();
    allowed.decoding_buffer_size = 8 * limits::MAX_PIXELS;
    let mut decoder = tiff::decoder::Decoder::new(Cursor::new(bytes)).map_err(damaged)?.with_limits(allowed);
    let (width, height) = decoder.dimensions().map_err(damaged)?;
    let (width, height) = (width as usize, height as usize);
    limits::check_size(width, height)?;
    let channels = match decoder.colortype().map_err(damaged)? {
        ColorType::Gray(8 | 16) => 1,
        ColorType::GrayA(8 | 16) => 2,
        ColorType::RGB(8 | 16) => 3,
        ColorType::RGBA(8 | 16) => 4,
        other => {
            return Err(Error::input(format!(
                "a TIFF picture of the kind {other:?} is not taken; gray or RGB with 8 or 16 bits is"
            )));
        }
    };
    let samples = match decoder.read_image().map_err(damaged)? {
        DecodingResult::U8(samples) => samples,
        DecodingResult::U16(samples) => samples.into_iter().map(narrow_full_scale).collect(),
        _ => return Err(Error::input("a TIFF picture with signed or fractional samples is not taken")),
    };
    assemble(width, height, channels, samples, color)
}

/// A picture from interleaved gray, gray and alpha, RGB, or RGBA samples. Transparency is blended
/// over black.
fn assemble(width: usize, height: usize, channels: usize, samples: Vec<u8>, color: bool) -> Result<Picture> {
    let picture = match channels {
        1 => GrayImage::from_samples(width, height, samples).map(Picture::gray),
        2 => {
            let over_black = samples.chunks_exact(2).map(|p| blend(p[0], p[1])).collect();
            GrayImage::from_samples(width, height, over_black).map(Picture::gray)
        }
        3 => picture_from_rgb(width, height, samples, color),
        _ => {
            let over_black = samples
                .chunks_exact(4)
                .flat_map(|p| [blend(p[0], p[3]), blend(p[1], p[3]), blend(p[2], p[3])]);
            picture_from_rgb(width, height, over_black.collect(), color)
        }
    };
    picture.ok_or_else(|| Error::input("the picture does not have as many samples as its size says"))
}

/// Blends a sample over black.
fn blend(sample: u8, alpha: u8) -> u8 {
    ((u32::from(sample) * u32::from(alpha) + 127) / 255) as u8
}
