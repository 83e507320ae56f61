//! Pictures from cameras and streams: JPEG, or uncompressed samples in a buffer.

use crate::bayer::BayerPattern;
use crate::codec::jpeg;
use crate::frame::{Chroma, Color, ColorEncoding, Matrix, Picture, picture_from_rgb};
use crate::guard::guarded;
use crate::limits;
use odograph::error::{Error, Result};
use odograph::image::GrayImage;

/// Pixel format of an uncompressed picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SampleLayout {
    /// One byte per pixel: luminance (V4L2 `GREY`).
    Gray,
    /// Two bytes per pixel: luminance of 8 to 16 bits.
    Gray16 {
        /// Whether the high byte comes first.
        big_endian: bool,
        /// Number of bits, the low ones; more light than they can state is white.
        bits: u32,
    },
    /// Four bytes per two pixels: luminance, blue chroma, luminance, red chroma (V4L2 `YUYV`).
    Yuyv,
    /// Four bytes per two pixels: blue chroma, luminance, red chroma, luminance (V4L2 `UYVY`).
    Uyvy,
    /// A plane of luminance, then one of interleaved blue and red chroma for two by two pixels, at
    /// the same stride (V4L2 `NV12`).
    Nv12,
    /// Three bytes per pixel: red, green, blue (V4L2 `RGB3`).
    Rgb,
    /// Three bytes per pixel: blue, green, red (V4L2 `BGR3`).
    Bgr,
    /// Four bytes per pixel: red, green, blue, and one that is ignored.
    Rgba,
    /// Four bytes per pixel: blue, green, red, and one that is ignored.
    Bgra,
    /// One byte per pixel, behind a colour filter.
    Bayer(BayerPattern),
}

impl SampleLayout {
    /// Bytes per pixel of a row; of the luminance where chroma is in a plane of its own.
    pub fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Gray | Self::Nv12 | Self::Bayer(_) => 1,
            Self::Gray16 { .. } | Self::Yuyv | Self::Uyvy => 2,
            Self::Rgb | Self::Bgr => 3,
            Self::Rgba | Self::Bgra => 4,
        }
    }

    /// Name for people.
    pub fn name(self) -> &'static str {
        match self {
            Self::Gray => "gray",
            Self::Gray16 { .. } => "16-bit gray",
            Self::Yuyv => "YUYV",
            Self::Uyvy => "UYVY",
            Self::Nv12 => "NV12",
            Self::Rgb => "RGB",
            Self::Bgr => "BGR",
            Self::Rgba => "RGBA",
            Self::Bgra => "BGRA",
            Self::Bayer(_) => "Bayer",
        }
    }

    /// Number of rows in the buffer of a picture.
    fn rows(self, height: usize) -> usize {
        if self == Self::Nv12 { height + height.div_ceil(2) } else { height }
    }
}

impl Picture {
    /// Decodes a JPEG image; keeps the colour if `color` is set.
    ///
    /// # Errors
    /// If the bytes are not a JPEG image or are too damaged to decode.
    pub fn from_jpeg(bytes: &[u8], color: bool) -> Result<Self> {
        guarded("JPEG", || jpeg::decode(bytes, color))?
    }

    /// A picture from a buffer of samples, row by row at a stride of `bytes_per_line`; keeps the
    /// colour if `color` is set.
    ///
    /// # Errors
    /// If the size is invalid, or the buffer is shorter than the size requires.
    pub fn from_samples(
        layout: SampleLayout,
        width: usize,
        height: usize,
        bytes_per_line: usize,
        bytes: &[u8],
        color: bool,
    ) -> Result<Self> {
        let pixels = limits::check_size(width, height)?;
        let row_bytes = width * layout.bytes_per_pixel();
        let line = bytes_per_line.max(row_bytes);
        // The padding of the last line may be missing.
        let needed = line.checked_mul(layout.rows(height) - 1).and_then(|lines| lines.checked_add(row_bytes));
        if needed.is_none_or(|needed| bytes.len() < needed) {
            return Err(Error::input(format!(
                "a picture of {width}x{height} needs {} bytes, but only {} came",
                needed.unwrap_or(usize::MAX),
                bytes.len()
            )));
        }
        let rows = || bytes.chunks(line).take(height).map(|row| &row[..row_bytes]);
        let lost = || Error::input(format!("a picture of {width}x{height} cannot be made"));
        let gray = |samples| GrayImage::from_samples(width, height, samples).ok_or_else(lost);
        let colored = |rgb| picture_from_rgb(width, height, rgb, color).ok_or_else(lost);
        let chroma = |down: usize, blue: Vec<u8>, red: Vec<u8>| {
            let encoding = ColorEncoding { matrix: Matrix::Bt601, full_range: false };
            Color::Chroma(Chroma { width: width.div_ceil(2), height: down, blue, red, encoding })
        };
        match layout {
            SampleLayout::Gray => gray(joined(rows())).map(Self::gray),
            SampleLayout::Gray16 { big_endian, bits } => {
                gray(narrowed(rows(), pixels, big_endian, bits)).map(Self::gray)
            }
            SampleLayout::Rgb => colored(interleaved(rows(), pixels, 3, [0, 1, 2])),
            SampleLayout::Bgr => colored(interleaved(rows(), pixels, 3, [2, 1, 0])),
            SampleLayout::Rgba => colored(interleaved(rows(), pixels, 4, [0, 1, 2])),
            SampleLayout::Bgra => colored(interleaved(rows(), pixels, 4, [2, 1, 0])),
            SampleLayout::Bayer(_) if width < 2 || height < 2 => {
                Err(Error::input(format!("a Bayer picture of {width}x{height} is too small")))
            }
            SampleLayout::Bayer(pattern) => colored(pattern.rgb(width, height, rows())),
            SampleLayout::Yuyv | SampleLayout::Uyvy => {
                let at = if layout == SampleLayout::Yuyv { [0, 1, 3] } else { [1, 0, 2] };
                let [samples, blue, red] = packed_planes(rows(), at, color);
                Ok(Self { gray: gray(samples)?, color: color.then(|| chroma(height, blue, red)) })
            }
            SampleLayout::Nv12 => {
                let down = height.div_ceil(2);
                let color = color.then(|| {
                    let rows = bytes.chunks(line).skip(height).take(down);
                    let [blue, red] = interleaved_chroma(rows, width.div_ceil(2));
                    chroma(down, blue, red)
                });
                Ok(Self { gray: gray(joined(rows()))?, color })
            }
        }
    }
}

/// The samples of rows, one after another.
fn joined<'a>(rows: impl Iterator<Item = &'a [u8]>) -> Vec<u8> {
    rows.collect::<Vec<_>>().concat()
}

/// The samples of rows of samples of `bits` bits in two bytes, narrowed to 8 bits, rounded.
fn narrowed<'a>(rows: impl Iterator<Item = &'a [u8]>, pixels: usize, big_endian: bool, bits: u32) -> Vec<u8> {
    let white = (1 << bits.clamp(8, 16)) - 1;
    let read = if big_endian { u16::from_be_bytes } else { u16::from_le_bytes };
    let mut samples = Vec::with_capacity(pixels);
    for row in rows {
        samples.extend(row.chunks_exact(2).map(|pair| {
            let sample = u32::from(read([pair[0], pair[1]])).min(white);
            ((255 * sample + white / 2) / white) as u8
        }));
    }
    samples
}

/// Red, green and blue of rows of pixels of `size` bytes, which are `at` these positions.
fn interleaved<'a>(
    rows: impl Iterator<Item = &'a [u8]>,
    pixels: usize,
    size: usize,
    at: [usize; 3],
) -> Vec<u8> {
    let mut rgb = Vec::with_capacity(3 * pixels);
    for row in rows {
        rgb.extend(row.chunks_exact(size).flat_map(|pixel| at.map(|at| pixel[at])));
    }
    rgb
}

/// Luminance, blue and red chroma of rows with two pixels in four bytes, which are `at` these
/// positions; chroma only if `color` is set.
fn packed_planes<'a>(rows: impl Iterator<Item = &'a [u8]>, at: [usize; 3], color: bool) -> [Vec<u8>; 3] {
    let [luminance_at, blue_at, red_at] = at;
    let [mut luminance, mut blue, mut red] = [const { Vec::new() }; 3];
    for row in rows {
        luminance.extend(row.chunks_exact(2).map(|pair| pair[luminance_at]));
        if color {
            // An odd last pixel has only blue chroma; it takes the red chroma of the pair before.
            blue.extend(row.iter().skip(blue_at).step_by(4));
            red.extend(row.iter().skip(red_at).step_by(4));
            red.resize(blue.len(), red.last().copied().unwrap_or(128));
        }
    }
    [luminance, blue, red]
}

/// Blue and red chroma of rows of `across` pairs.
fn interleaved_chroma<'a>(rows: impl Iterator<Item = &'a [u8]>, across: usize) -> [Vec<u8>; 2] {
    let (mut blue, mut red) = (Vec::new(), Vec::new());
    for row in rows {
        // A row of an odd width may lack its last sample.
        let at = |index: usize| row.get(index).copied().unwrap_or(128);
        blue.extend((0..across).map(|x| at(2 * x)));
        red.extend((0..across).map(|x| at(2 * x + 1)));
    }
    [blue, red]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Frame;

    #[test]
    fn yuyv_with_a_stride_longer_than_the_row() {
        // Two rows of YUYV, each with two bytes of padding.
        let bytes = [10, 90, 20, 240, 0, 0, 30, 100, 40, 200, 0, 0];
        let picture = Picture::from_samples(SampleLayout::Yuyv, 2, 2, 6, &bytes, true).unwrap();
        assert_eq!(picture.gray.samples(), [10, 20, 30, 40]);
        let Some(Color::Chroma(chroma)) = &picture.color else { panic!("no colour") };
        assert_eq!((&chroma.blue[..], &chroma.red[..]), (&[90, 100][..], &[240, 200][..]));
        assert!(chroma.is_whole());
        // The padding of the last line may be missing, a sample may not.
        assert!(Picture::from_samples(SampleLayout::Yuyv, 2, 2, 6, &bytes[..10], false).is_ok());
        let short = Picture::from_samples(SampleLayout::Yuyv, 2, 2, 6, &bytes[..9], false).unwrap_err();
        assert_eq!(short.to_string(), "a picture of 2x2 needs 10 bytes, but only 9 came");
        assert!(Picture::from_samples(SampleLayout::Gray, 0, 2, 0, &bytes, false).is_err());
        let odd = Picture::from_samples(SampleLayout::Yuyv, 3, 1, 6, &[1, 2, 3, 4, 5, 6], true).unwrap();
        assert_eq!(odd.gray.samples(), [1, 3, 5]);
        assert!(Frame::new(0, 0.0, odd).rgb().width() == 3);
    }

    #[test]
    fn every_layout_gives_the_same_gray() {
        // Two by two pixels of gray levels; every layout with a stride of twelve bytes.
        let levels = [10, 20, 30, 40];
        let rows = |row: fn(u8, u8) -> Vec<u8>| -> Vec<u8> {
            let padded = |mut row: Vec<u8>| {
                row.resize(12, 99);
                row
            };
            [padded(row(levels[0], levels[1])), padded(row(levels[2], levels[3]))].concat()
        };
        for (layout, bytes) in [
            (SampleLayout::Gray, rows(|a, b| vec![a, b])),
            (SampleLayout::Gray16 { big_endian: false, bits: 16 }, rows(|a, b| vec![a, a, b, b])),
            (SampleLayout::Gray16 { big_endian: true, bits: 16 }, rows(|a, b| vec![a, a, b, b])),
            (SampleLayout::Gray16 { big_endian: false, bits: 8 }, rows(|a, b| vec![a, 0, b, 0])),
            (
                SampleLayout::Gray16 { big_endian: true, bits: 10 },
                rows(|a, b| vec![a >> 6, a << 2, b >> 6, b << 2]),
            ),
            (SampleLayout::Rgb, rows(|a, b| vec![a, a, a, b, b, b])),
            (SampleLayout::Bgr, rows(|a, b| vec![a, a, a, b, b, b])),
            (SampleLayout::Rgba, rows(|a, b| vec![a, a, a, 7, b, b, b, 7])),
            (SampleLayout::Bgra, rows(|a, b| vec![a, a, a, 7, b, b, b, 7])),
            (SampleLayout::Yuyv, rows(|a, b| vec![a, 128, b, 128])),
            (SampleLayout::Uyvy, rows(|a, b| vec![128, a, 128, b])),
            (SampleLayout::Nv12, [rows(|a, b| vec![a, b]), vec![128; 12]].concat()),
        ] {
            let picture = Picture::from_samples(layout, 2, 2, 12, &bytes, true).unwrap();
            assert_eq!(picture.gray.samples(), levels, "{layout:?}");
            if let Some(Color::Chroma(chroma)) = &picture.color {
                assert!(chroma.is_whole() && chroma.blue.iter().chain(&chroma.red).all(|&c| c == 128));
            }
            assert!(Picture::from_samples(layout, 2, 2, 12, &bytes[..12], true).is_err());
            assert!(Picture::from_samples(layout, 2, 2, usize::MAX, &bytes, true).is_err());
        }
        let red = Picture::from_samples(SampleLayout::Bgr, 1, 1, 3, &[0, 0, 255], true).unwrap();
        assert_eq!(Frame::new(0, 0.0, red).rgb().pixel(0, 0), [255, 0, 0]);
        let bayer = SampleLayout::Bayer(BayerPattern::Rggb);
        let plain = Picture::from_samples(bayer, 2, 2, 2, &[50; 4], false).unwrap();
        assert_eq!(plain.gray.samples(), [50; 4]);
        assert!(Picture::from_samples(bayer, 1, 2, 1, &[50; 2], false).is_err());
    }
}
