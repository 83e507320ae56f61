//! Encoding of keyframe images: one JPEG each, with gray and colour.
//!
//! The luminance component of the JPEG is the gray image that measurements use. The chroma
//! components have half the resolution, as in the source video. Colour therefore costs little, and
//! any program can display the image.

use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use odograph::error::{Error, Result};
use odograph::ground_map::KeyframeImage;
use odograph::image::{GrayImage, RgbImage};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// JPEG quality of keyframes, 1 to 100: higher makes loop closure more accurate and the map larger.
const QUALITY: u8 = 95;

/// A keyframe image as stored in the file.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredImage {
    /// Whether the JPEG has colour.
    pub colored: bool,
    /// Luma of the colour image = `luma_scale · gray + luma_offset`: the gray of limited-range
    /// video does not span black to white.
    pub luma_scale: f64,
    /// The offset of that line.
    pub luma_offset: f64,
    /// The JPEG file.
    pub jpeg: Vec<u8>,
}

impl StoredImage {
    /// Decodes the image, which must have this width and height. The error is the end of a sentence
    /// that begins with the image.
    pub fn decode(&self, size: (usize, usize)) -> std::result::Result<KeyframeImage, String> {
        let space = if self.colored { ColorSpace::YCbCr } else { ColorSpace::Luma };
        let options =
            DecoderOptions::default().set_strict_mode(true).set_max_width(size.0).set_max_height(size.1);
        let mut decoder =
            JpegDecoder::new_with_options(ZCursor::new(&self.jpeg), options.jpeg_set_out_colorspace(space));
        let samples = decoder.decode().map_err(|error| {
            format!("cannot be decoded: {}", format!("{error:?}").replace('\n', " ").trim_end())
        })?;
        let info = decoder.info().ok_or("cannot be decoded")?;
        let found = (usize::from(info.width), usize::from(info.height));
        let channels = if self.colored { 3 } else { 1 };
        if found != size || samples.len() != channels * size.0 * size.1 {
            return Err(format!("has {}x{} pixels, the camera {}x{}", found.0, found.1, size.0, size.1));
        }
        if !self.colored {
            let gray = GrayImage::from_samples(size.0, size.1, samples).ok_or("cannot be decoded")?;
            return Ok(KeyframeImage { gray, color: None });
        }
        let (scale, offset) = (self.luma_scale as f32, self.luma_offset as f32);
        if !scale.is_finite() || !offset.is_finite() {
            return Err("has colours that are not finite".to_owned());
        }
        let gray = samples.as_chunks::<3>().0.iter().map(|pixel| pixel[0]).collect();
        let mut rgb = samples;
        // In blocks of independent pixels, which the compiler can vectorise.
        let (many, rest) = rgb.as_chunks_mut::<{ 3 * AT_ONCE }>();
        many.iter_mut().for_each(|pixels| color(pixels.as_chunks_mut::<3>().0, scale, offset));
        rest.as_chunks_mut::<3>()
            .0
            .iter_mut()
            .for_each(|pixel| color(std::slice::from_mut(pixel), scale, offset));
        let gray = GrayImage::from_samples(size.0, size.1, gray).ok_or("cannot be decoded")?;
        Ok(KeyframeImage { gray, color: RgbImage::from_samples(size.0, size.1, rgb) })
    }
}

/// Encodes an image. Fails if its colour and gray differ in size, or if it exceeds the maximum size
/// of a JPEG.
pub(crate) fn encode(image: &KeyframeImage) -> Result<StoredImage> {
    let (width, height) = (image.gray.width(), image.gray.height());
    let large = || Error::usage(format!("an image of {width}x{height} pixels is too large for a map"));
    let size = (u16::try_from(width).map_err(|_| large())?, u16::try_from(height).map_err(|_| large())?);
    let mut jpeg = Vec::new();
    let mut encoder = Encoder::new(&mut jpeg, QUALITY);
    let Some(color) = &image.color else {
        encoder.encode(image.gray.samples(), size.0, size.1, ColorType::Luma).map_err(cannot)?;
        return Ok(StoredImage { colored: false, luma_scale: 1.0, luma_offset: 0.0, jpeg });
    };
    if (color.width(), color.height()) != (width, height) {
        return Err(Error::usage(format!(
            "an image has {}x{} pixels in colour and {width}x{height} in gray",
            color.width(),
            color.height()
        )));
    }
    let (luma_scale, luma_offset) = luma_of_gray(&image.gray, color);
    let mut samples = vec![0; 3 * width * height];
    let pixels = image.gray.samples().chunks(AT_ONCE).zip(color.samples().as_chunks::<3>().0.chunks(AT_ONCE));
    for ((gray, rgb), samples) in pixels.zip(samples.as_chunks_mut::<3>().0.chunks_mut(AT_ONCE)) {
        differences(gray, rgb, samples);
    }
    encoder.set_sampling_factor(SamplingFactor::F_2_2);
    encoder.encode(&samples, size.0, size.1, ColorType::Ycbcr).map_err(cannot)?;
    Ok(StoredImage { colored: true, luma_scale, luma_offset, jpeg })
}

fn cannot(error: jpeg_encoder::EncodingError) -> Error {
    Error::output(format!("a keyframe's image cannot be encoded: {error}"))
}

/// Least-squares line of the colour image's luma over gray, from every seventh pixel.
fn luma_of_gray(gray: &GrayImage, color: &RgbImage) -> (f64, f64) {
    let (mut n, mut x, mut y, mut xx, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (&gray, rgb) in gray.samples().iter().zip(color.samples().chunks_exact(3)).step_by(7) {
        let gray = f64::from(gray);
        let luma = 0.299 * f64::from(rgb[0]) + 0.587 * f64::from(rgb[1]) + 0.114 * f64::from(rgb[2]);
        (n, x, y, xx, xy) = (n + 1.0, x + gray, y + luma, xx + gray * gray, xy + gray * luma);
    }
    let spread = n * xx - x * x;
    if spread <= n * n {
        return (1.0, if n > 0.0 { (y - x) / n } else { 0.0 });
    }
    let scale = ((n * xy - x * y) / spread).clamp(0.25, 4.0);
    (scale, (y - scale * x) / n)
}

/// Block size, pixels.
const AT_ONCE: usize = 16;

/// Adds the chroma of up to [`AT_ONCE`] RGB pixels to their gray values (Y'CbCr).
#[inline(always)]
fn differences(gray: &[u8], rgb: &[[u8; 3]], samples: &mut [[u8; 3]]) {
    let mut differences = [[0.0_f32; AT_ONCE]; 2];
    for (i, rgb) in rgb.iter().enumerate().take(AT_ONCE) {
        let [r, g, b] = rgb.map(f32::from);
        differences[0][i] = 128.0 - 0.168_736 * r - 0.331_264 * g + 0.5 * b + 0.5;
        differences[1][i] = 128.0 + 0.5 * r - 0.418_688 * g - 0.081_312 * b + 0.5;
    }
    let [blue, red] = differences.map(|difference| difference.map(|value| value.min(255.0) as i32 as u8));
    for (i, (sample, gray)) in samples.iter_mut().zip(gray).enumerate().take(AT_ONCE) {
        *sample = [*gray, blue[i], red[i]];
    }
}

/// Converts up to [`AT_ONCE`] Y'CbCr pixels to RGB.
#[inline(always)]
fn color(pixels: &mut [[u8; 3]], scale: f32, offset: f32) {
    let mut colors = [[0.0_f32; AT_ONCE]; 3];
    for (i, pixel) in pixels.iter().enumerate().take(AT_ONCE) {
        let luma = scale * f32::from(pixel[0]) + offset;
        let (blue, red) = (f32::from(pixel[1]) - 128.0, f32::from(pixel[2]) - 128.0);
        colors[0][i] = luma + 1.402 * red + 0.5;
        colors[1][i] = luma - 0.344_136 * blue - 0.714_136 * red + 0.5;
        colors[2][i] = luma + 1.772 * blue + 0.5;
    }
    let bytes = colors.map(|color| color.map(|value| value.clamp(0.0, 255.0) as i32 as u8));
    for (i, pixel) in pixels.iter_mut().enumerate().take(AT_ONCE) {
        *pixel = [bytes[0][i], bytes[1][i], bytes[2][i]];
    }
}
