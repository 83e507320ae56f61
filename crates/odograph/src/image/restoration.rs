//! Restoration of images whose defects can be seen in the image itself. Derivation:
//! `docs/math/image-restoration.md`.

use super::GrayImage;
use super::impulse_noise::{has_impulse_noise, remove_impulse_noise};
use super::interlacing::{Interlacing, even_field};
use super::row_noise::{COLUMNS_REACH, ROWS_REACH, RowNoise, remove_row_noise};
use serde::Serialize;

/// What is wrong with the images of a recording. What is not there is left out of a file.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct ImageDefects {
    /// Even and odd rows are of different times; the even ones are used.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub interlaced: bool,
    /// Rows are brighter or darker at random.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub row_noise: bool,
    /// Columns are.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub column_noise: bool,
    /// Single pixels are white or black at random.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub impulse_noise: bool,
    /// Single pixels are mostly noise; images of a coarser resolution are tracked.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub pixel_noise: bool,
}

/// Finds and corrects defects of the images of a recording, in the order of time. What was found
/// once is corrected from then on: frames must be corrected like the keyframe they are compared
/// with.
#[derive(Debug, Clone, Default)]
pub struct Restoration {
    images: u64,
    interlacing: Interlacing,
    row_noise: RowNoise,
    found: ImageDefects,
    /// Reusable memory: the transposed image.
    transposed: Option<GrayImage>,
}

/// Images from one that is examined for noise to the next.
const EXAMINED_EVERY: u64 = 16;

impl Restoration {
    /// The next image, corrected.
    pub fn restore(&mut self, mut image: GrayImage) -> GrayImage {
        let Self { found, row_noise, .. } = self;
        if self.images.is_multiple_of(EXAMINED_EVERY) {
            found.impulse_noise = found.impulse_noise || has_impulse_noise(&image);
            found.row_noise = found.row_noise || row_noise.is_in(&image);
            found.column_noise = found.column_noise || row_noise.is_in_columns(&image);
        }
        self.images += 1;
        if found.impulse_noise {
            remove_impulse_noise(&mut image);
        }
        if found.row_noise {
            remove_row_noise(&mut image, ROWS_REACH);
        }
        if found.column_noise {
            let transposed = self.transposed.get_or_insert_with(|| GrayImage::new(0, 0));
            image.transpose_into(transposed);
            remove_row_noise(transposed, COLUMNS_REACH);
            transposed.transpose_into(&mut image);
        }
        found.interlaced = self.interlacing.look(&image);
        if found.interlaced { even_field(image) } else { image }
    }

    /// What was wrong with any image so far.
    pub fn found(&self) -> ImageDefects {
        self.found
    }
}
