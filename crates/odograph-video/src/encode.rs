//! Pictures as the bytes of JPEG and PNG files.

use jpeg_encoder::{ColorType, Encoder};
use odograph::error::{Error, Result};
use odograph::image::{GrayImage, RgbImage};
use std::io::Write;

/// A gray picture as the bytes of a JPEG file; `quality` is 1 to 100.
///
/// # Errors
/// If the picture exceeds the size limits of JPEG, 65535 pixels on a side.
pub fn jpeg_from_gray(picture: &GrayImage, quality: u8) -> Result<Vec<u8>> {
    jpeg(picture.width(), picture.height(), picture.samples(), ColorType::Luma, quality)
}

/// A colour picture as the bytes of a JPEG file; `quality` is 1 to 100. Chroma has half the size
/// below 90, as players of Motion JPEG expect.
///
/// # Errors
/// As [`jpeg_from_gray`].
pub fn jpeg_from_rgb(picture: &RgbImage, quality: u8) -> Result<Vec<u8>> {
    jpeg(picture.width(), picture.height(), picture.samples(), ColorType::Rgb, quality)
}

fn jpeg(width: usize, height: usize, samples: &[u8], color: ColorType, quality: u8) -> Result<Vec<u8>> {
    let cannot = |why: String| Error::output(format!("a {width}x{height} JPEG cannot be encoded: {why}"));
    let side = |pixels: usize| u16::try_from(pixels).map_err(|error| cannot(error.to_string()));
    let mut bytes = Vec::with_capacity(width * height / 3);
    let encoded = Encoder::new(&mut bytes, quality).encode(samples, side(width)?, side(height)?, color);
    encoded.map_err(|error| cannot(error.to_string()))?;
    Ok(bytes)
}

/// A gray image as the bytes of a PNG file.
///
/// # Errors
/// If the image has no pixels, or too many for a PNG file; so it is for all kinds of PNG files.
pub fn png_from_gray(image: &GrayImage) -> Result<Vec<u8>> {
    let samples = image.samples();
    png(image.width(), image.height(), png::ColorType::Grayscale, None, |file| file.write_image_data(samples))
}

/// A gray image as the bytes of a PNG file with its print resolution.
///
/// # Errors
/// As [`png_from_gray`].
pub fn png_to_print(image: &GrayImage, pixels_per_metre: u32) -> Result<Vec<u8>> {
    let unit = png::Unit::Meter;
    let resolution = Some(png::PixelDimensions { xppu: pixels_per_metre, yppu: pixels_per_metre, unit });
    png(image.width(), image.height(), png::ColorType::Grayscale, resolution, |file| {
        file.write_image_data(image.samples())
    })
}

/// A colour image as the bytes of a PNG file.
///
/// # Errors
/// As [`png_from_gray`].
pub fn png_from_rgb(image: &RgbImage) -> Result<Vec<u8>> {
    png_from_rgb_samples(image.width(), image.height(), image.samples())
}

/// Interleaved RGB in row order as the bytes of a PNG file.
///
/// # Errors
/// As [`png_from_gray`].
pub fn png_from_rgb_samples(width: usize, height: usize, rgb: &[u8]) -> Result<Vec<u8>> {
    png(width, height, png::ColorType::Rgb, None, |file| file.write_image_data(rgb))
}

/// An image with alpha channel, interleaved RGBA in row order, as the bytes of a PNG file.
///
/// # Errors
/// As [`png_from_gray`].
pub fn png_from_rgba(width: usize, height: usize, rgba: &[u8]) -> Result<Vec<u8>> {
    png(width, height, png::ColorType::Rgba, None, |file| file.write_image_data(rgba))
}

/// An image with alpha channel that arrives in bands of whole rows from top to bottom, as the bytes
/// of a PNG file.
///
/// # Errors
/// As [`png_from_gray`].
pub fn png_from_rgba_bands(
    width: usize,
    height: usize,
    mut bands: impl Iterator<Item = Vec<u8>>,
) -> Result<Vec<u8>> {
    png(width, height, png::ColorType::Rgba, None, |file| {
        let mut rows = file.stream_writer_with_size(CHUNK_BYTES)?;
        bands.try_for_each(|band| rows.write_all(&band))?;
        rows.finish()
    })
}

/// Bytes of a chunk of a PNG file that is written in several.
const CHUNK_BYTES: usize = 1 << 18;

fn png(
    width: usize,
    height: usize,
    color: png::ColorType,
    resolution: Option<png::PixelDimensions>,
    write: impl FnOnce(&mut png::Writer<&mut Vec<u8>>) -> std::result::Result<(), png::EncodingError>,
) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width as u32, height as u32);
    encoder.set_color(color);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_pixel_dims(resolution);
    encoder.set_compression(png::Compression::Fast);
    let encoded = encoder.write_header().and_then(|mut file| {
        write(&mut file)?;
        file.finish()
    });
    encoded.map_err(|error| {
        Error::output(format!("a {width}x{height} PNG cannot be encoded: {error}")).caused_by(error)
    })?;
    Ok(bytes)
}
