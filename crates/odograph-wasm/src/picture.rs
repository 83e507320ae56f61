//! Frames as browsers give them.

use odograph_core::error::{Error, Result};
use odograph_core::{GrayImage, RgbImage};

/// How the pixels of a frame lie in memory, without padding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// Luminance alone.
    Gray,
    /// Luminance, then blue and red chroma of half its width and height (I420).
    Planar,
    /// Luminance, then both chromas in turn (NV12).
    SemiPlanar,
    /// Red, green, blue and opacity.
    Rgba,
}

impl Layout {
    /// The layout of a number, 0 to 3 in the order above.
    pub fn numbered(number: u32) -> Option<Self> {
        [Self::Gray, Self::Planar, Self::SemiPlanar, Self::Rgba].get(number as usize).copied()
    }
}

/// A frame: its luminance, which is measured, and its colour for the mosaic.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Luminance.
    pub gray: GrayImage,
    /// `None` for a gray frame.
    pub chroma: Option<Chroma>,
}

/// Colour of a frame at half its width and height, rounded up.
#[derive(Debug, Clone, PartialEq)]
pub struct Chroma {
    blue: Vec<u8>,
    red: Vec<u8>,
    full_range: bool,
}

/// Shares of red and blue in the luminance: BT.601, and BT.709 from 720 lines on, where a video
/// says nothing else.
fn shares(height: usize) -> (f32, f32) {
    if height < 720 { (0.299, 0.114) } else { (0.2126, 0.0722) }
}

impl Picture {
    /// The frame of `size` pixels in `bytes`. `full_range`: luminance is 0 to 255 and not 16 to
    /// 235.
    ///
    /// # Errors
    /// If there are more or fewer bytes than the layout has.
    pub fn new(
        layout: Layout,
        full_range: bool,
        (width, height): (usize, usize),
        bytes: &[u8],
    ) -> Result<Self> {
        let pixels = width * height;
        let quarter = width.div_ceil(2) * height.div_ceil(2);
        let length = match layout {
            Layout::Gray => pixels,
            Layout::Planar | Layout::SemiPlanar => pixels + 2 * quarter,
            Layout::Rgba => 4 * pixels,
        };
        if bytes.len() != length {
            return Err(Error::input(format!(
                "a frame of {width}x{height} has {} bytes instead of {length}; the video changes its size or its format",
                bytes.len()
            )));
        }
        let gray = |samples: Vec<u8>| {
            GrayImage::from_samples(width, height, samples)
                .ok_or_else(|| Error::input(format!("a frame of {width}x{height} is no picture")))
        };
        let chroma = match layout {
            Layout::Gray => None,
            Layout::Planar => {
                let (blue, red) = bytes[pixels..].split_at(quarter);
                Some((blue.to_vec(), red.to_vec()))
            }
            Layout::SemiPlanar => {
                Some(bytes[pixels..].chunks_exact(2).map(|both| (both[0], both[1])).unzip())
            }
            Layout::Rgba => {
                return Ok(Self {
                    gray: gray(luminance(bytes))?,
                    chroma: Some(Chroma::of_rgba(bytes, width)),
                });
            }
        };
        let chroma = chroma.map(|(blue, red)| Chroma { blue, red, full_range });
        Ok(Self { gray: gray(bytes[..pixels].to_vec())?, chroma })
    }
}

/// Luminance of red, green, blue and opacity (BT.601, full range).
fn luminance(rgba: &[u8]) -> Vec<u8> {
    let of = |pixel: &[u8]| {
        let [red, green, blue] = [0, 1, 2].map(|channel| u32::from(pixel[channel]));
        ((19_595 * red + 38_470 * green + 7_471 * blue + 32_768) >> 16) as u8
    };
    rgba.chunks_exact(4).map(of).collect()
}

impl Chroma {
    /// Of every second pixel of every second row.
    fn of_rgba(rgba: &[u8], width: usize) -> Self {
        let rows = rgba.chunks_exact(4 * width).step_by(2);
        let of = |pixel: &[u8]| {
            let [red, green, blue] = [0, 1, 2].map(|channel| f32::from(pixel[channel]));
            let luma = 0.299 * red + 0.587 * green + 0.114 * blue;
            let level = |difference: f32| (difference + 128.5) as u8;
            (level((blue - luma) / 1.772), level((red - luma) / 1.402))
        };
        let (blue, red) = rows.flat_map(|row| row.chunks_exact(4).step_by(2).map(of)).unzip();
        Self { blue, red, full_range: true }
    }

    /// The picture in colour.
    pub fn rgb(&self, gray: &GrayImage) -> RgbImage {
        let (width, height) = (gray.width(), gray.height());
        let (red_share, blue_share) = shares(height);
        let green_share = 1.0 - red_share - blue_share;
        let (offset, luma_scale, chroma_scale) =
            if self.full_range { (0.0, 1.0, 1.0) } else { (16.0, 255.0 / 219.0, 255.0 / 224.0) };
        let half = width.div_ceil(2);
        let mut image = RgbImage::new(width, height);
        for (y, row) in image.samples_mut().chunks_exact_mut(3 * width).enumerate() {
            let line = y / 2 * half;
            for (x, (pixel, &luma)) in row.chunks_exact_mut(3).zip(gray.row(y)).enumerate() {
                let chroma = |plane: &[u8]| (f32::from(plane[line + x / 2]) - 128.0) * chroma_scale;
                let luma = (f32::from(luma) - offset) * luma_scale;
                let red = luma + 2.0 * (1.0 - red_share) * chroma(&self.red);
                let blue = luma + 2.0 * (1.0 - blue_share) * chroma(&self.blue);
                let green = (luma - red_share * red - blue_share * blue) / green_share;
                pixel.copy_from_slice(&[red, green, blue].map(|value| (value + 0.5) as u8));
            }
        }
        image
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test fails by panicking
mod tests {
    use super::*;

    #[test]
    fn every_layout_gives_the_same_picture() {
        // An odd size: chroma is rounded up.
        let size = (5, 3);
        let luma: Vec<u8> = (0..15).map(|k| 60 + 7 * k).collect();
        let (blue, red) = ([100, 110, 120, 130, 140, 150], [160, 150, 140, 130, 120, 110]);
        let planar = [&luma[..], &blue, &red].concat();
        let in_turn = blue.iter().zip(&red).flat_map(|(blue, red)| [*blue, *red]);
        let semi: Vec<u8> = luma.iter().copied().chain(in_turn).collect();
        let picture = Picture::new(Layout::Planar, true, size, &planar).unwrap();
        assert_eq!(picture, Picture::new(Layout::SemiPlanar, true, size, &semi).unwrap());
        assert_eq!(picture.gray, Picture::new(Layout::Gray, true, size, &luma).unwrap().gray);
        let rgb = picture.chroma.as_ref().unwrap().rgb(&picture.gray);
        let rgba: Vec<u8> = rgb.samples().chunks_exact(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect();
        let again = Picture::new(Layout::Rgba, true, size, &rgba).unwrap();
        let same = again.chroma.unwrap().rgb(&again.gray);
        for (a, b) in rgb.samples().iter().zip(same.samples()) {
            // Rounded to whole levels twice.
            assert!(a.abs_diff(*b) <= 3, "{a} {b}");
        }
    }

    #[test]
    fn gray_stays_gray_and_white_white() {
        for (full_range, white) in [(true, 255), (false, 235)] {
            let bytes = [vec![white; 4], vec![128; 2]].concat();
            let picture = Picture::new(Layout::Planar, full_range, (2, 2), &bytes).unwrap();
            assert_eq!(picture.chroma.unwrap().rgb(&picture.gray).samples(), [255; 12]);
        }
    }

    #[test]
    fn too_few_bytes_are_refused() {
        let error = Picture::new(Layout::Planar, false, (4, 4), &[0; 16]).unwrap_err().to_string();
        assert!(error.contains("16 bytes instead of 24"), "{error}");
    }
}
