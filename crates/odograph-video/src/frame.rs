//! A frame and its decoded picture.

use odograph::image::{GrayImage, RgbImage};
use std::sync::Arc;

/// One frame of a recording.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Index of the frame in the source, from 0 in presentation order, including frames that
    /// [`SourceOptions`](crate::SourceOptions) excludes.
    pub number: u64,
    /// Timestamp in seconds, from the container or the timestamps file; strictly increasing, not
    /// necessarily starting at 0.
    pub time_s: f64,
    /// File name of the image, without its folder; `None` for frames of a video.
    pub name: Option<String>,
    /// Luminance plane as decoded.
    pub gray: GrayImage,
    pub(crate) color: Option<Color>,
}

impl Frame {
    /// A frame of an external source, such as a camera or a stream.
    pub fn new(number: u64, time_s: f64, picture: Picture) -> Self {
        Self { number, time_s, name: None, gray: picture.gray, color: picture.color }
    }

    /// Whether the frame has colour: the source has it, and
    /// [`SourceOptions::color`](crate::SourceOptions::color) keeps it.
    pub fn has_color(&self) -> bool {
        self.color.is_some()
    }

    /// The frame as RGB; gray if it has no colour ([`Frame::has_color`]).
    ///
    /// Video is converted with the matrix (BT.601, BT.709 or BT.2020) and range of its stream. If
    /// the matrix is unspecified, it is BT.709 for 720 lines or more and BT.601 below, limited
    /// range (ITU-R BT.601-7 section 2.5, BT.709-6 section 3).
    pub fn rgb(&self) -> RgbImage {
        match &self.color {
            None => RgbImage::from(&self.gray),
            Some(Color::Rgb(samples)) => {
                RgbImage::from_samples(self.gray.width(), self.gray.height(), samples.clone())
                    .unwrap_or_else(|| RgbImage::from(&self.gray))
            }
            Some(Color::Chroma(chroma)) => chroma.rgb(&self.gray),
            Some(Color::Deferred(deferred)) => {
                deferred.chroma().map_or_else(|| RgbImage::from(&self.gray), |chroma| chroma.rgb(&self.gray))
            }
        }
    }
}

/// A picture from a decoder or a camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    /// Luminance.
    pub gray: GrayImage,
    pub(crate) color: Option<Color>,
}

impl Picture {
    /// A picture without colour.
    pub fn gray(gray: GrayImage) -> Self {
        Self { gray, color: None }
    }

    /// A picture from decoded planes; without colour if its chroma is not whole, `None` if there
    /// are not as many samples as pixels.
    pub(crate) fn from_planes(
        (width, height): (usize, usize),
        luminance: Vec<u8>,
        chroma: Option<Chroma>,
    ) -> Option<Self> {
        let gray = GrayImage::from_samples(width, height, luminance)?;
        Some(Self { gray, color: chroma.filter(Chroma::is_whole).map(Color::Chroma) })
    }
}

/// Colour of a picture, in addition to its luminance.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Color {
    Chroma(Chroma),
    /// Interleaved RGB at the size of the gray image.
    Rgb(Vec<u8>),
    /// Chroma that is decoded on demand: colour is needed for few frames, and costs as much to
    /// decode as the luminance.
    Deferred(Deferred),
}

/// Undecoded chroma, in the bytes of its picture.
#[derive(Debug, Clone)]
pub(crate) struct Deferred {
    bytes: Arc<[u8]>,
    /// Decodes the chroma; `None` on failure.
    decode: fn(&[u8]) -> Option<Chroma>,
}

impl Deferred {
    pub fn new(bytes: &[u8], decode: fn(&[u8]) -> Option<Chroma>) -> Self {
        Self { bytes: bytes.into(), decode }
    }

    pub fn chroma(&self) -> Option<Chroma> {
        (self.decode)(&self.bytes)
    }
}

impl PartialEq for Deferred {
    fn eq(&self, other: &Self) -> bool {
        self.bytes == other.bytes
    }
}

impl Eq for Deferred {}

/// Chroma planes (colour differences) of a video, as decoded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Chroma {
    pub width: usize,
    pub height: usize,
    pub blue: Vec<u8>,
    pub red: Vec<u8>,
    pub encoding: ColorEncoding,
}

/// Encoding of luminance and chroma (Y'CbCr).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct ColorEncoding {
    pub matrix: Matrix,
    /// Full range 0–255 instead of limited range 16–235 (luminance) and 16–240 (chroma).
    pub full_range: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Matrix {
    /// Not specified: BT.709 for 720 lines or more, BT.601 below.
    #[default]
    Unspecified,
    Bt601,
    Bt709,
    Bt2020,
}

impl Matrix {
    /// From `matrix_coefficients` of ITU-T H.273, table 4.
    pub fn from_h273(code: u64) -> Self {
        match code {
            1 => Self::Bt709,
            4..=6 => Self::Bt601,
            9 | 10 => Self::Bt2020,
            _ => Self::Unspecified,
        }
    }

    /// Luma coefficients of red and blue.
    fn red_and_blue(self, lines: usize) -> (f32, f32) {
        match self {
            Self::Unspecified if lines < 720 => (0.299, 0.114),
            Self::Bt601 => (0.299, 0.114),
            Self::Unspecified | Self::Bt709 => (0.2126, 0.0722),
            Self::Bt2020 => (0.2627, 0.0593),
        }
    }
}

impl Chroma {
    /// Whether the lengths of both planes match their size.
    pub fn is_whole(&self) -> bool {
        let samples = self.width * self.height;
        self.blue.len() == samples && self.red.len() == samples
    }

    fn rgb(&self, gray: &GrayImage) -> RgbImage {
        let (width, height) = (gray.width(), gray.height());
        let mut image = RgbImage::new(width, height);
        if self.width == 0 || self.height == 0 {
            return RgbImage::from(gray);
        }
        let (red_share, blue_share) = self.encoding.matrix.red_and_blue(height);
        let green_share = 1.0 - red_share - blue_share;
        let (offset, luma_scale, chroma_scale) =
            if self.encoding.full_range { (0.0, 1.0, 1.0) } else { (16.0, 255.0 / 219.0, 255.0 / 224.0) };
        let red_from_red = 2.0 * (1.0 - red_share) * chroma_scale;
        let blue_from_blue = 2.0 * (1.0 - blue_share) * chroma_scale;
        let green_from_red = -red_from_red * red_share / green_share;
        let green_from_blue = -blue_from_blue * blue_share / green_share;
        // Contributions of a chroma row to red, to green (from either plane) and to blue; then row
        // by row in loops that the compiler can vectorise.
        let mut added = [(); 4].map(|()| vec![0.0f32; width]);
        let mut planes = [(); 3].map(|()| vec![0u8; width]);
        for (y, row) in image.samples_mut().chunks_exact_mut(3 * width).enumerate() {
            let line = y * self.height / height;
            if y == 0 || line != (y - 1) * self.height / height {
                let factors = [red_from_red, green_from_red, green_from_blue, blue_from_blue];
                let from = [&self.red, &self.red, &self.blue, &self.blue];
                for ((added, samples), factor) in added.iter_mut().zip(from).zip(factors) {
                    widen(&samples[line * self.width..][..self.width], factor, added);
                }
            }
            // Slices of equal, known length remove the bounds checks in the loop.
            let luma = &gray.row(y)[..width];
            let [to_red, red_to_green, blue_to_green, to_blue] =
                added.each_ref().map(|added| &added[..width]);
            let [red, green, blue] = planes.each_mut().map(|plane| &mut plane[..width]);
            for x in 0..width {
                let luma = (f32::from(luma[x]) - offset) * luma_scale;
                red[x] = (luma + to_red[x] + 0.5) as u8;
                green[x] = (luma + red_to_green[x] + blue_to_green[x] + 0.5) as u8;
                blue[x] = (luma + to_blue[x] + 0.5) as u8;
            }
            for ((pixel, &red), (&green, &blue)) in
                row.chunks_exact_mut(3).zip(&*red).zip(green.iter().zip(&*blue))
            {
                pixel.copy_from_slice(&[red, green, blue]);
            }
        }
        image
    }
}

/// Scales a row of chroma samples by `factor` and upsamples it to the luminance width by
/// repetition.
fn widen(samples: &[u8], factor: f32, to: &mut [f32]) {
    let value = |sample: u8| factor * (f32::from(sample) - 128.0);
    let width = to.len();
    if width == 2 * samples.len() {
        for (pair, &sample) in to.chunks_exact_mut(2).zip(samples) {
            pair.fill(value(sample));
        }
    } else {
        to.iter_mut().enumerate().for_each(|(x, to)| *to = value(samples[x * samples.len() / width]));
    }
}

/// BT.601 luminance of full-range RGB, rounded: `0.299 R + 0.587 G + 0.114 B` in 16-bit fixed
/// point.
pub(crate) fn luminance(red: u8, green: u8, blue: u8) -> u8 {
    ((19_595 * u32::from(red) + 38_470 * u32::from(green) + 7_471 * u32::from(blue) + 32_768) >> 16) as u8
}

/// A picture from interleaved RGB; keeps the colour if `color` is set.
pub(crate) fn picture_from_rgb(width: usize, height: usize, rgb: Vec<u8>, color: bool) -> Option<Picture> {
    let samples = rgb.chunks_exact(3).map(|p| luminance(p[0], p[1], p[2])).collect();
    let gray = GrayImage::from_samples(width, height, samples)?;
    Some(Picture { gray, color: color.then_some(Color::Rgb(rgb)) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn luminance_of_gray_is_itself() {
        for value in 0..=255 {
            assert_eq!(luminance(value, value, value), value);
        }
    }

    #[test]
    fn limited_range_white_and_red() {
        let encoding = ColorEncoding { matrix: Matrix::Bt601, full_range: false };
        // In limited-range BT.601, white is (235, 128, 128) and pure red is (81, 90, 240).
        let frame = Frame {
            number: 0,
            time_s: 0.0,
            name: None,
            gray: GrayImage::from_samples(2, 1, vec![235, 81]).unwrap(),
            color: Some(Color::Chroma(Chroma {
                width: 2,
                height: 1,
                blue: vec![128, 90],
                red: vec![128, 240],
                encoding,
            })),
        };
        let rgb = frame.rgb();
        assert_eq!(rgb.pixel(0, 0), [255, 255, 255]);
        let [r, g, b] = rgb.pixel(1, 0);
        assert!(r >= 253 && g <= 2 && b <= 2, "{r} {g} {b}");
    }

    #[test]
    fn no_color_repeats_gray() {
        let gray = GrayImage::from_samples(1, 1, vec![9]).unwrap();
        let frame = Frame { number: 0, time_s: 0.0, name: None, gray, color: None };
        assert!(!frame.has_color());
        assert_eq!(frame.rgb().pixel(0, 0), [9, 9, 9]);
    }
}
