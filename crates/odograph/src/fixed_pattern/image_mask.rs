//! Which parts of the image are not ground.

use crate::geometry::Pixel;
use crate::image::GrayImage;

/// Pixels along the side of a cell.
pub const CELL_PX: usize = 4;

/// A patch about a corner reaches this many pixels: corners nearer than that to what is told not to be ground would see it.
const PATCH_REACH_PX: usize = 10;

/// Which cells of 4x4 pixels are not ground, so that no corner may lie there.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ImageMask {
    size: (usize, usize),
    columns: usize,
    covered: Vec<bool>,
    count: usize,
}

impl ImageMask {
    /// All of an image of this size is ground.
    pub fn nothing(size: (usize, usize)) -> Self {
        let (columns, rows) = cells(size);
        Self { size, columns, covered: vec![false; columns * rows], count: 0 }
    }

    /// From a picture in which what is not ground is darker than middle gray. Corners keep away from it by the reach of a patch.
    pub fn from_picture(picture: &GrayImage) -> Self {
        let mut mask = Self::nothing((picture.width(), picture.height()));
        let rows = mask.covered.len() / mask.columns;
        let reach = PATCH_REACH_PX.div_ceil(CELL_PX);
        for y in 0..picture.height() {
            for x in (0..picture.width()).filter(|&x| picture.row(y)[x] < 128) {
                let (column, row) = ((x / CELL_PX).min(mask.columns - 1), (y / CELL_PX).min(rows - 1));
                mask.covered[row * mask.columns + column] = true;
            }
        }
        let black = mask.covered.clone();
        for (at, _) in black.iter().enumerate().filter(|(_, black)| **black) {
            let (column, row) = (at % mask.columns, at / mask.columns);
            for r in row.saturating_sub(reach)..(row + reach + 1).min(rows) {
                let from = r * mask.columns + column.saturating_sub(reach);
                let to = r * mask.columns + (column + reach + 1).min(mask.columns);
                mask.covered[from..to].fill(true);
            }
        }
        mask.counted()
    }

    /// Of the cells that were found to be fixed, and what was told beside.
    pub(super) fn of_cells(size: (usize, usize), found: &[bool], told: Option<&Self>) -> Self {
        let mut mask = Self::nothing(size);
        mask.covered.copy_from_slice(found);
        if let Some(told) = told {
            mask.covered.iter_mut().zip(&told.covered).for_each(|(covered, told)| *covered |= told);
        }
        mask.counted()
    }

    fn counted(mut self) -> Self {
        self.count = self.covered.iter().filter(|covered| **covered).count();
        self
    }

    /// Width and height of the image it is for.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Whether all of the image is ground.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// The part of the image that is not ground, 0 to 1.
    pub fn share(&self) -> f64 {
        self.count as f64 / self.covered.len().max(1) as f64
    }

    /// Whether a pixel is not ground; what is outside the image belongs to the nearest cell.
    pub fn covers(&self, x: usize, y: usize) -> bool {
        let rows = self.covered.len() / self.columns;
        self.covered[(y / CELL_PX).min(rows - 1) * self.columns + (x / CELL_PX).min(self.columns - 1)]
    }

    /// Whether a place in the image is not ground.
    pub fn covers_pixel(&self, pixel: Pixel) -> bool {
        self.covers(pixel.x.max(0.0).round() as usize, pixel.y.max(0.0).round() as usize)
    }

    /// Whether a cell is not ground.
    pub(super) fn covers_cell(&self, column: usize, row: usize) -> bool {
        self.covered[row * self.columns + column]
    }

    /// White is ground, black is not.
    pub fn picture(&self) -> GrayImage {
        let mut picture = GrayImage::new(self.size.0, self.size.1);
        let width = self.size.0;
        for (at, sample) in picture.samples_mut().iter_mut().enumerate() {
            *sample = if self.covers(at % width, at / width) { 0 } else { 255 };
        }
        picture
    }
}

/// Columns and rows of whole cells; at least one each.
pub(super) fn cells((width, height): (usize, usize)) -> (usize, usize) {
    ((width / CELL_PX).max(1), (height / CELL_PX).max(1))
}
