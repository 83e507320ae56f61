//! Mask of the image regions that are not ground.

use crate::geometry::Pixel;
use crate::image::GrayImage;

/// Side length of a cell, pixels.
pub const CELL_PX: usize = 4;

/// Radius of a patch around a corner, pixels: a corner nearer than this to a masked region would
/// include it.
const PATCH_REACH_PX: usize = 10;

/// Mask in cells of 4x4 pixels: masked cells are not ground and contain no corners.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ImageMask {
    size: (usize, usize),
    columns: usize,
    covered: Vec<bool>,
    count: usize,
}

impl ImageMask {
    /// An empty mask for an image of this size: everything is ground.
    pub fn nothing(size: (usize, usize)) -> Self {
        let (columns, rows) = cells(size);
        Self { size, columns, covered: vec![false; columns * rows], count: 0 }
    }

    /// A mask from an image: pixels darker than middle gray (128) are masked, dilated by the radius
    /// of a patch.
    pub fn from_picture(picture: &GrayImage) -> Self {
        let mut mask = Self::nothing((picture.width(), picture.height()));
        let rows = mask.covered.len() / mask.columns;
        for y in 0..picture.height() {
            for x in (0..picture.width()).filter(|&x| picture.row(y)[x] < 128) {
                let (column, row) = ((x / CELL_PX).min(mask.columns - 1), (y / CELL_PX).min(rows - 1));
                mask.covered[row * mask.columns + column] = true;
            }
        }
        mask.with_patches()
    }

    /// The mask of a picture that [`ImageMask::picture`] has made, without dilation.
    pub fn from_own_picture(picture: &GrayImage) -> Self {
        let mut mask = Self::nothing((picture.width(), picture.height()));
        for (at, covered) in mask.covered.iter_mut().enumerate() {
            let (column, row) = (at % mask.columns, at / mask.columns);
            *covered = picture.row(row * CELL_PX)[column * CELL_PX] < 128;
        }
        mask.counted()
    }

    /// The mask dilated by the radius of a patch.
    pub(super) fn with_patches(mut self) -> Self {
        let rows = self.covered.len() / self.columns;
        let reach = PATCH_REACH_PX.div_ceil(CELL_PX);
        let covered = self.covered.clone();
        for (at, _) in covered.iter().enumerate().filter(|(_, covered)| **covered) {
            let (column, row) = (at % self.columns, at / self.columns);
            for r in row.saturating_sub(reach)..(row + reach + 1).min(rows) {
                let from = r * self.columns + column.saturating_sub(reach);
                let to = r * self.columns + (column + reach + 1).min(self.columns);
                self.covered[from..to].fill(true);
            }
        }
        self.counted()
    }

    /// What either of two masks of the same size covers.
    pub fn union(&self, other: &Self) -> Self {
        Self::of_cells(self.size, &self.covered, Some(other))
    }

    /// The union of the cells found to be static and the mask given by the user.
    pub(super) fn of_cells(size: (usize, usize), found: &[bool], given: Option<&Self>) -> Self {
        let mut mask = Self::nothing(size);
        mask.covered.copy_from_slice(found);
        if let Some(given) = given {
            mask.covered.iter_mut().zip(&given.covered).for_each(|(covered, given)| *covered |= given);
        }
        mask.counted()
    }

    /// The mask of an image of another size whose pixels are 2^`halvings` times as large: a cell is
    /// masked if the nearest cell of this one is.
    pub(crate) fn scaled(&self, size: (usize, usize), halvings: i32) -> Self {
        let scale = 2f64.powi(halvings);
        let mut mask = Self::nothing(size);
        for (at, covered) in mask.covered.iter_mut().enumerate() {
            let (column, row) = (at % mask.columns, at / mask.columns);
            let from = |cell: usize| (scale * (cell as f64 + 0.5) * CELL_PX as f64) as usize;
            *covered = self.covers(from(column), from(row));
        }
        mask.counted()
    }

    fn counted(mut self) -> Self {
        self.count = self.covered.iter().filter(|covered| **covered).count();
        self
    }

    /// Width and height of the masked image, pixels.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Whether nothing is masked.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// The masked fraction of the image, 0 to 1.
    pub fn share(&self) -> f64 {
        self.count as f64 / self.covered.len().max(1) as f64
    }

    /// Whether a pixel is masked; pixels outside the image belong to the nearest cell.
    pub fn covers(&self, x: usize, y: usize) -> bool {
        let rows = self.covered.len() / self.columns;
        self.covered[(y / CELL_PX).min(rows - 1) * self.columns + (x / CELL_PX).min(self.columns - 1)]
    }

    /// Whether a position in the image, rounded to the nearest pixel, is masked.
    pub fn covers_pixel(&self, pixel: Pixel) -> bool {
        self.covers(pixel.x.max(0.0).round() as usize, pixel.y.max(0.0).round() as usize)
    }

    /// Whether a cell is masked.
    pub(super) fn covers_cell(&self, column: usize, row: usize) -> bool {
        self.covered[row * self.columns + column]
    }

    /// The mask as an image: ground is white, masked pixels are black.
    pub fn picture(&self) -> GrayImage {
        let mut picture = GrayImage::new(self.size.0, self.size.1);
        let width = self.size.0;
        for (at, sample) in picture.samples_mut().iter_mut().enumerate() {
            *sample = if self.covers(at % width, at / width) { 0 } else { 255 };
        }
        picture
    }
}

/// Numbers of columns and rows of whole cells; at least one each.
pub(super) fn cells((width, height): (usize, usize)) -> (usize, usize) {
    ((width / CELL_PX).max(1), (height / CELL_PX).max(1))
}
