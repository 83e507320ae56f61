//! Rotates and mirrors pictures upright, as specified by the container or the image metadata.

use crate::frame::{Chroma, Color, Picture};
use odograph::image::GrayImage;

/// Transformation of a stored picture to upright: mirrored first (left to right), then rotated
/// clockwise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Orientation {
    pub mirrored: bool,
    /// Clockwise quarter turns, 0 to 3.
    pub quarter_turns: u8,
}

impl Orientation {
    pub fn turned(quarter_turns: u8) -> Self {
        Self { mirrored: false, quarter_turns: quarter_turns % 4 }
    }

    /// From the EXIF tag `Orientation` (CIPA DC-008, 4.6.5), 1 to 8.
    pub fn from_exif(value: u32) -> Self {
        let (mirrored, quarter_turns) = match value {
            2 => (true, 0),
            3 => (false, 2),
            4 => (true, 2),
            5 => (true, 3),
            6 => (false, 1),
            7 => (true, 1),
            8 => (false, 3),
            _ => (false, 0),
        };
        Self { mirrored, quarter_turns }
    }

    pub fn is_upright(self) -> bool {
        self == Self::default()
    }

    /// Size of the upright picture for a given stored size.
    pub fn size(self, width: usize, height: usize) -> (usize, usize) {
        if self.quarter_turns % 2 == 1 { (height, width) } else { (width, height) }
    }

    pub fn upright(self, picture: Picture) -> Picture {
        if self.is_upright() {
            return picture;
        }
        let (width, height) = (picture.gray.width(), picture.gray.height());
        let turned = self.plane::<1>(width, height, picture.gray.samples());
        let (new_width, new_height) = self.size(width, height);
        let gray =
            GrayImage::from_samples(new_width, new_height, turned).unwrap_or_else(|| GrayImage::new(0, 0));
        let turned = |chroma: Chroma| {
            let (new_width, new_height) = self.size(chroma.width, chroma.height);
            Color::Chroma(Chroma {
                width: new_width,
                height: new_height,
                blue: self.plane::<1>(chroma.width, chroma.height, &chroma.blue),
                red: self.plane::<1>(chroma.width, chroma.height, &chroma.red),
                encoding: chroma.encoding,
            })
        };
        let color = picture.color.and_then(|color| match color {
            Color::Rgb(samples) => Some(Color::Rgb(self.plane::<3>(width, height, &samples))),
            Color::Chroma(chroma) => Some(turned(chroma)),
            Color::Deferred(deferred) => deferred.chroma().map(turned),
        });
        Picture { gray, color }
    }

    fn plane<const CHANNELS: usize>(self, width: usize, height: usize, samples: &[u8]) -> Vec<u8> {
        let (new_width, new_height) = self.size(width, height);
        let mut turned = Vec::with_capacity(samples.len());
        for y in 0..new_height {
            for x in 0..new_width {
                let (mut column, row) = match self.quarter_turns {
                    1 => (y, height - 1 - x),
                    2 => (width - 1 - x, height - 1 - y),
                    3 => (width - 1 - y, x),
                    _ => (x, y),
                };
                if self.mirrored {
                    column = width - 1 - column;
                }
                let at = CHANNELS * (row * width + column);
                turned.extend_from_slice(&samples[at..at + CHANNELS]);
            }
        }
        turned
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn letters(orientation: Orientation) -> (usize, String) {
        // A B C
        // D E F
        let picture = Picture::gray(GrayImage::from_samples(3, 2, b"ABCDEF".to_vec()).unwrap());
        let upright = orientation.upright(picture).gray;
        (upright.width(), String::from_utf8(upright.into_samples()).unwrap())
    }

    #[test]
    fn quarter_turns_are_clockwise() {
        assert_eq!(letters(Orientation::turned(1)), (2, "DAEBFC".into()));
        assert_eq!(letters(Orientation::turned(2)), (3, "FEDCBA".into()));
        assert_eq!(letters(Orientation::turned(3)), (2, "CFBEAD".into()));
    }

    #[test]
    fn exif_orientations() {
        assert_eq!(letters(Orientation::from_exif(1)).1, "ABCDEF");
        assert_eq!(letters(Orientation::from_exif(2)).1, "CBAFED");
        assert_eq!(letters(Orientation::from_exif(3)).1, "FEDCBA");
        assert_eq!(letters(Orientation::from_exif(4)).1, "DEFABC");
        // 5 is a transposition; 7 is a transposition across the other diagonal.
        assert_eq!(letters(Orientation::from_exif(5)).1, "ADBECF");
        assert_eq!(letters(Orientation::from_exif(6)).1, "DAEBFC");
        assert_eq!(letters(Orientation::from_exif(7)).1, "FCEBDA");
        assert_eq!(letters(Orientation::from_exif(8)).1, "CFBEAD");
    }
}
