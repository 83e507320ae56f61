//! Tiles as PNG: grayscale if all pixels are gray, without alpha if all are opaque.

use odograph::error::{Error, Result};
use odograph::mosaic::MOSAIC_TILE_PX;
use png::{BitDepth, ColorType};
use std::borrow::Cow;
use std::io::Cursor;

const SIDE: usize = MOSAIC_TILE_PX;
/// Memory limit for decoding a tile, bytes.
const MAX_MEMORY: usize = 8 << 20;

/// Encodes an RGBA tile as PNG.
pub(super) fn encode(rgba: &[u8]) -> Result<Vec<u8>> {
    let gray = rgba.chunks_exact(4).all(|pixel| pixel[0] == pixel[1] && pixel[1] == pixel[2]);
    let opaque = rgba.chunks_exact(4).all(|pixel| pixel[3] == 255);
    let (color, samples) = match (gray, opaque) {
        (true, true) => (ColorType::Grayscale, kept(rgba, |[gray, ..]| [gray])),
        (true, false) => (ColorType::GrayscaleAlpha, kept(rgba, |[gray, _, _, opacity]| [gray, opacity])),
        (false, true) => (ColorType::Rgb, kept(rgba, |[red, green, blue, _]| [red, green, blue])),
        (false, false) => (ColorType::Rgba, Cow::Borrowed(rgba)),
    };
    let encode = || -> std::result::Result<Vec<u8>, png::EncodingError> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, SIDE as u32, SIDE as u32);
        encoder.set_color(color);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_compression(png::Compression::Fast);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&samples)?;
        writer.finish()?;
        Ok(bytes)
    };
    encode().map_err(|error| Error::output(format!("a tile of the mosaic cannot be encoded: {error}")))
}

/// Selects some of the channels of every pixel.
fn kept<const N: usize>(rgba: &[u8], of: impl Fn([u8; 4]) -> [u8; N]) -> Cow<'_, [u8]> {
    let pixels: Vec<[u8; N]> = rgba.as_chunks::<4>().0.iter().map(|pixel| of(*pixel)).collect();
    Cow::Owned(pixels.into_flattened())
}

/// Decodes a PNG to RGBA; the error is the end of a sentence.
pub(super) fn decode(bytes: &[u8]) -> std::result::Result<Vec<u8>, String> {
    let broken = |error: png::DecodingError| format!("cannot be decoded: {error}");
    let limits = png::Limits { bytes: MAX_MEMORY };
    let mut decoder = png::Decoder::new_with_limits(Cursor::new(bytes), limits);
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    let mut reader = decoder.read_info().map_err(broken)?;
    if (reader.info().width, reader.info().height) != (SIDE as u32, SIDE as u32) {
        return Err(format!(
            "has {}x{} pixels, not {SIDE}x{SIDE}",
            reader.info().width,
            reader.info().height
        ));
    }
    let mut samples =
        vec![0; reader.output_buffer_size().filter(|size| *size <= MAX_MEMORY).ok_or("is too large")?];
    let frame = reader.next_frame(&mut samples).map_err(broken)?;
    let channels = match frame.color_type {
        ColorType::Grayscale => 1,
        ColorType::GrayscaleAlpha => 2,
        ColorType::Rgb => 3,
        ColorType::Rgba => 4,
        ColorType::Indexed => return Err("has a palette".to_owned()),
    };
    let rgba = |pixel: &[u8]| match *pixel {
        [gray] => [gray, gray, gray, 255],
        [gray, opacity] => [gray, gray, gray, opacity],
        [red, green, blue] => [red, green, blue, 255],
        [red, green, blue, opacity, ..] => [red, green, blue, opacity],
        [] => [0; 4],
    };
    Ok(samples.chunks_exact(channels).take(SIDE * SIDE).flat_map(rgba).collect())
}

/// Reduces four tiles (upper left, upper right, lower left, lower right) to one of half the
/// resolution: each pixel is the mean of the up to four pixels that show ground.
pub(super) fn halved(children: [Option<Vec<u8>>; 4]) -> Vec<u8> {
    let mut rgba = [255, 255, 255, 0].repeat(SIDE * SIDE);
    for (k, child) in children.iter().enumerate() {
        let Some(child) = child else { continue };
        for y in 0..SIDE / 2 {
            for x in 0..SIDE / 2 {
                let at = |dx: usize, dy: usize| 4 * ((2 * y + dy) * SIDE + 2 * x + dx);
                let seen =
                    [at(0, 0), at(1, 0), at(0, 1), at(1, 1)].into_iter().filter(|at| child[at + 3] > 0);
                let (mut sum, mut count) = ([0_u32; 3], 0);
                for at in seen {
                    (0..3).for_each(|c| sum[c] += u32::from(child[at + c]));
                    count += 1;
                }
                if count > 0 {
                    let to = 4 * ((y + k / 2 * SIDE / 2) * SIDE + x + k % 2 * SIDE / 2);
                    (0..3).for_each(|c| rgba[to + c] = ((sum[c] + count / 2) / count) as u8);
                    rgba[to + 3] = 255;
                }
            }
        }
    }
    rgba
}
