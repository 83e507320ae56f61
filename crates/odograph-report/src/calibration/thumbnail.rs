//! Small pictures of the views.

use odograph::drawing::svg::data_uri;
use odograph::image::GrayImage;
use odograph_video::jpeg_from_gray;

/// Longest side, pixels: the board and its tilt can be recognised.
const SIDE_PX: usize = 176;
/// JPEG quality (1 to 100); sixty views must not make the page large.
const QUALITY: u8 = 62;

/// An image, small enough to keep one of each view.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Thumbnail {
    width: usize,
    height: usize,
    jpeg: Vec<u8>,
}

impl Thumbnail {
    /// The image, averaged down; `None` for an image without pixels.
    pub fn new(image: &GrayImage) -> Option<Self> {
        let (width, height) = (image.width(), image.height());
        let longest = width.max(height);
        let shrunk = |length: usize| (length * SIDE_PX.min(longest) / longest.max(1)).max(1);
        if width == 0 || height == 0 {
            return None;
        }
        let (columns, rows) = (shrunk(width), shrunk(height));
        // Mean of the pixels of each cell.
        let cell =
            |at: usize, cells: usize, length: usize| at * length / cells..((at + 1) * length).div_ceil(cells);
        let mut small = Vec::with_capacity(columns * rows);
        for row in 0..rows {
            for column in 0..columns {
                let across = cell(column, columns, width);
                let (mut sum, mut count) = (0u64, 0);
                for y in cell(row, rows, height) {
                    let line = &image.row(y)[across.clone()];
                    sum += line.iter().map(|&sample| u64::from(sample)).sum::<u64>();
                    count += line.len() as u64;
                }
                small.push((sum / count) as u8);
            }
        }
        let jpeg = jpeg_from_gray(&GrayImage::from_samples(columns, rows, small)?, QUALITY).ok()?;
        Some(Self { width: columns, height: rows, jpeg })
    }

    /// The image element of a page; `alt` is escaped.
    pub fn element(&self, alt: &str) -> String {
        format!(
            "<img width=\"{}\" height=\"{}\" loading=\"lazy\" alt=\"{alt}\" src=\"{}\">",
            self.width,
            self.height,
            data_uri("image/jpeg", &self.jpeg)
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thumbnails_keep_the_shape_and_stay_small() {
        let noisy = (0..1280 * 960).map(|at: usize| (at.wrapping_mul(2_654_435_761) >> 13) as u8 & 63);
        let image = GrayImage::from_samples(1280, 960, noisy.collect()).unwrap();
        let thumbnail = Thumbnail::new(&image).unwrap();
        assert_eq!((thumbnail.width, thumbnail.height), (176, 132));
        assert!(thumbnail.element("a").len() < 12_000, "{}", thumbnail.element("a").len());
        // An image that is small already stays as it is.
        let tiny = Thumbnail::new(&GrayImage::new(40, 1)).unwrap();
        assert_eq!((tiny.width, tiny.height), (40, 1));
        assert_eq!(Thumbnail::new(&GrayImage::new(0, 0)), None);
    }
}
