//! Pictures from cameras and streams: JPEG, or uncompressed samples in a buffer.

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
    /// Four bytes per two pixels: luminance, blue chroma, luminance, red chroma (V4L2 `YUYV`).
    Yuyv,
    /// Three bytes per pixel: red, green, blue (V4L2 `RGB3`).
    Rgb,
}

impl SampleLayout {
    /// Bytes per pixel.
    pub fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Gray => 1,
            Self::Yuyv => 2,
            Self::Rgb => 3,
        }
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
        if bytes.len() < line * (height - 1) + row_bytes {
            return Err(Error::input(format!(
                "a picture of {width}x{height} needs {} bytes, but only {} came",
                line * (height - 1) + row_bytes,
                bytes.len()
            )));
        }
        let rows = bytes.chunks(line).take(height).map(|row| &row[..row_bytes]);
        let lost = || Error::input(format!("a picture of {width}x{height} cannot be made"));
        match layout {
            SampleLayout::Gray => {
                let mut samples = Vec::with_capacity(pixels);
                rows.for_each(|row| samples.extend_from_slice(row));
                GrayImage::from_samples(width, height, samples).map(Self::gray).ok_or_else(lost)
            }
            SampleLayout::Rgb => {
                let mut samples = Vec::with_capacity(3 * pixels);
                rows.for_each(|row| samples.extend_from_slice(row));
                picture_from_rgb(width, height, samples, color).ok_or_else(lost)
            }
            SampleLayout::Yuyv => {
                let across = width.div_ceil(2);
                let mut gray = Vec::with_capacity(pixels);
                let (mut blue, mut red) = (Vec::new(), Vec::new());
                for row in rows {
                    gray.extend(row.iter().step_by(2));
                    if color {
                        // An odd last pixel has only blue chroma; it takes the red chroma of the
                        // pair before.
                        blue.extend(row.iter().skip(1).step_by(4));
                        red.extend(row.iter().skip(3).step_by(4));
                        red.resize(blue.len(), red.last().copied().unwrap_or(128));
                    }
                }
                let chroma = color.then(|| {
                    let encoding = ColorEncoding { matrix: Matrix::Bt601, full_range: false };
                    Color::Chroma(Chroma { width: across, height, blue, red, encoding })
                });
                let gray = GrayImage::from_samples(width, height, gray).ok_or_else(lost)?;
                Ok(Self { gray, color: chroma })
            }
        }
    }
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
}
