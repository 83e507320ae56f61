//! Letters on a canvas: each is rendered once from the embedded typeface.

use crate::raster::gray_picture;
use odograph::drawing::canvas::{Canvas, Colour};
use odograph::drawing::svg::escape;
use odograph::error::Result;
use odograph::image::GrayImage;
use std::collections::BTreeMap;
use std::fmt::Write;

/// What can be written besides ASCII.
const SPECIAL: &str = "°±−–µ·";

/// The letters of one size.
pub struct Lettering {
    size_px: usize,
    letters: BTreeMap<char, Letter>,
}

/// The picture of a letter, black on white, in a cell of twice the size, where it begins a quarter
/// from the left; the columns that it fills.
struct Letter {
    cell: GrayImage,
    first: usize,
    width: usize,
}

impl Lettering {
    /// Letters of this size, pixels.
    pub fn new(size_px: u32) -> Result<Self> {
        let size = size_px as usize;
        let all: Vec<char> = ('!'..='~').chain(SPECIAL.chars()).collect();
        let cell = 2 * size;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {0} {cell}\" width=\"{0}\" height=\"{cell}\" \
             font-family=\"Roboto\" font-weight=\"500\" font-size=\"{size}\">",
            cell * all.len()
        );
        for (number, letter) in all.iter().enumerate() {
            let (x, y) = (cell * number + size / 2, size + size / 3);
            let _ = write!(svg, "<text x=\"{x}\" y=\"{y}\">{}</text>", escape(&letter.to_string()));
        }
        svg.push_str("</svg>");
        let picture = gray_picture(&svg, (cell * all.len()) as u32)?;
        let mut letters: BTreeMap<char, Letter> = all
            .iter()
            .enumerate()
            .map(|(number, letter)| (*letter, Letter::cut(&picture, number, cell)))
            .collect();
        // Figures stay where they are while they change.
        let widest = ('0'..='9').filter_map(|digit| Some(letters.get(&digit)?.width)).max().unwrap_or(0);
        for digit in '0'..='9' {
            if let Some(letter) = letters.get_mut(&digit) {
                letter.first = letter.first.saturating_sub((widest - letter.width) / 2);
                letter.width = widest;
            }
        }
        Ok(Self { size_px: size, letters })
    }

    /// Their size, pixels.
    pub fn height_px(&self) -> usize {
        self.size_px
    }

    /// Distance of lines, pixels.
    pub fn line_px(&self) -> usize {
        self.size_px * 5 / 4
    }

    /// Width of a text, pixels.
    pub fn width_px(&self, text: &str) -> usize {
        text.chars().map(|letter| self.advance_px(letter)).sum()
    }

    /// Writes a line of text; letters that are not known are left out.
    pub fn write(&self, canvas: &mut Canvas, (left, top): (usize, usize), text: &str, colour: Colour) {
        let mut x = left;
        // The base line is a third of the size below the middle of the cell.
        let raised = self.size_px / 3;
        for character in text.chars() {
            if let Some(Letter { cell, first, width }) = self.letters.get(&character) {
                canvas.stamp(cell, *first..first + width, raised..cell.height(), (x, top), colour);
            }
            x += self.advance_px(character);
        }
    }

    fn advance_px(&self, letter: char) -> usize {
        match self.letters.get(&letter) {
            Some(known) => known.width + self.size_px.div_ceil(16),
            None => self.size_px * 7 / 24,
        }
    }
}

impl Letter {
    fn cut(picture: &GrayImage, number: usize, cell: usize) -> Self {
        let mut samples = Vec::with_capacity(cell * cell);
        for row in 0..cell {
            samples.extend((0..cell).map(|column| {
                picture.row(row.min(picture.height() - 1)).get(number * cell + column).copied().unwrap_or(255)
            }));
        }
        let is_inked = |column: &usize| (0..cell).any(|row| samples[row * cell + column] < 200);
        let first = (0..cell).find(is_inked).unwrap_or(0);
        let last = (0..cell).rev().find(is_inked).unwrap_or(0);
        let cell = GrayImage::from_samples(cell, cell, samples).unwrap_or_else(|| GrayImage::new(cell, cell));
        Self { cell, first, width: last + 1 - first }
    }
}
