//! Photographs of floors from PNG and JPEG files.

use odograph::error::{Error, Result};
use odograph::image::{GrayImage, RgbImage};
use odograph_simulation::Texture;
use odograph_video::read_regular_file;
use std::io::{Cursor, ErrorKind};
use std::path::Path;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// Photographs of more pixels than this are refused: they would need gigabytes.
const MAX_PIXELS: u64 = 100_000_000;

/// Largest size of a photograph's file, bytes.
const MAX_BYTES: u64 = 512 << 20;

/// Reads a photograph. The error names the file and, if it does not exist, the named textures.
pub fn read(name: &str) -> Result<RgbImage> {
    let bytes = read_regular_file(Path::new(name), MAX_BYTES).map_err(|error| match error.kind() {
        ErrorKind::FileTooLarge => Error::input(format!("{name} is larger than {} MiB", MAX_BYTES >> 20)),
        ErrorKind::NotFound if !name.contains(['.', '/', '\\']) => {
            let names: Vec<_> = Texture::names().collect();
            Error::usage(format!(
                "there is no texture named '{name}' and no file of that name; textures are {}",
                names.join(", ")
            ))
        }
        _ => Error::input(format!("{name} cannot be read: {error}")),
    })?;
    let image = if bytes.starts_with(b"\x89PNG") {
        png(&bytes)
    } else if bytes.starts_with(b"\xff\xd8") {
        jpeg(&bytes)
    } else {
        Err("it is neither PNG nor JPEG".to_string())
    };
    image.map_err(|why| Error::input(format!("{name} is not a photograph that can be read: {why}")))
}

fn png(bytes: &[u8]) -> std::result::Result<RgbImage, String> {
    let mut decoder = png::Decoder::new(Cursor::new(bytes));
    // Palettes and few-bit grays become 8 bits, 16 bits are cut to 8.
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    let mut reader = decoder.read_info().map_err(|error| error.to_string())?;
    let (width, height) = reader.info().size();
    checked_size(u64::from(width), u64::from(height))?;
    let size = reader.output_buffer_size().ok_or("it is too large")?;
    let mut samples = vec![0; size];
    let info = reader.next_frame(&mut samples).map_err(|error| error.to_string())?;
    samples.truncate(info.buffer_size());
    let rgb: Vec<u8> = match info.color_type {
        png::ColorType::Grayscale => samples.iter().flat_map(|&s| [s; 3]).collect(),
        png::ColorType::GrayscaleAlpha => samples.chunks_exact(2).flat_map(|p| [p[0]; 3]).collect(),
        png::ColorType::Rgb => samples,
        png::ColorType::Rgba => samples.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect(),
        png::ColorType::Indexed => return Err("its palette is missing".to_string()),
    };
    RgbImage::from_samples(info.width as usize, info.height as usize, rgb).ok_or("it is cut off".to_string())
}

fn jpeg(bytes: &[u8]) -> std::result::Result<RgbImage, String> {
    let options = DecoderOptions::default().jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = JpegDecoder::new_with_options(Cursor::new(bytes), options);
    decoder.decode_headers().map_err(|error| error.to_string())?;
    let (width, height) = decoder.dimensions().ok_or("it has no size")?;
    checked_size(width as u64, height as u64)?;
    let samples = decoder.decode().map_err(|error| error.to_string())?;
    if samples.len() == width * height {
        let gray = GrayImage::from_samples(width, height, samples).ok_or("it is cut off")?;
        return Ok(RgbImage::from(&gray));
    }
    RgbImage::from_samples(width, height, samples)
        .ok_or("its colours are not red, green and blue".to_string())
}

fn checked_size(width: u64, height: u64) -> std::result::Result<(), String> {
    if width.saturating_mul(height) > MAX_PIXELS {
        return Err(format!("{width}x{height} pixels are too many; reduce it"));
    }
    Ok(())
}
