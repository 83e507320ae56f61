//! A picture to draw on pixel by pixel, with smooth edges. Only exact operations of floating point
//! are used, so that it has the same bytes on every machine.

use crate::image::{GrayImage, RgbImage};

/// Red, green, blue.
pub type Colour = [u8; 3];

/// An RGB image to draw on. What lies outside of it is not drawn.
#[derive(Debug, Clone)]
pub struct Canvas {
    image: RgbImage,
}

impl Canvas {
    /// A black one.
    pub fn new(width: usize, height: usize) -> Self {
        Self { image: RgbImage::new(width, height) }
    }

    /// An image, each of its pixels enlarged to a square of `up` by `up`.
    pub fn enlarged(image: &RgbImage, up: usize) -> Self {
        let up = up.max(1);
        let mut canvas = Self::new(image.width() * up, image.height() * up);
        for (y, row) in canvas.image.samples_mut().chunks_exact_mut(3 * image.width() * up).enumerate() {
            let first = 3 * image.width() * (y / up);
            let pixels = image.samples()[first..].chunks_exact(3);
            for (square, pixel) in row.chunks_exact_mut(3 * up).zip(pixels) {
                square.chunks_exact_mut(3).for_each(|there| there.copy_from_slice(pixel));
            }
        }
        canvas
    }

    /// An image reduced by a whole factor: means of squares of `down` by `down` pixels. What is
    /// left over at the right and at the bottom is cut off.
    pub fn reduced(image: &RgbImage, down: usize) -> Self {
        let down = down.max(1);
        let mut canvas = Self::new(image.width() / down, image.height() / down);
        let count = (down * down) as u32;
        for y in 0..canvas.height() {
            for x in 0..canvas.width() {
                let mut sums = [0_u32; 3];
                for row in y * down..(y + 1) * down {
                    let first = 3 * (row * image.width() + x * down);
                    for pixel in image.samples()[first..first + 3 * down].chunks_exact(3) {
                        sums.iter_mut().zip(pixel).for_each(|(sum, sample)| *sum += u32::from(*sample));
                    }
                }
                canvas.set(x, y, sums.map(|sum| (sum / count) as u8));
            }
        }
        canvas
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.image.width()
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.image.height()
    }

    /// The image.
    pub fn image(&self) -> &RgbImage {
        &self.image
    }

    /// The image without the canvas.
    pub fn into_image(self) -> RgbImage {
        self.image
    }

    /// Copies another picture to a place.
    pub fn place(&mut self, other: &Self, (left, top): (usize, usize)) {
        let (width, height) = (self.width(), self.height());
        let columns = other.width().min(width.saturating_sub(left));
        for (row, from) in other.image.samples().chunks_exact(3 * other.width().max(1)).enumerate() {
            let y = top + row;
            if y < height {
                let first = 3 * (y * width + left);
                self.image.samples_mut()[first..first + 3 * columns].copy_from_slice(&from[..3 * columns]);
            }
        }
    }

    /// Draws in a colour what is dark in these columns and rows of a stencil: white is left out.
    pub fn stamp(
        &mut self,
        stencil: &GrayImage,
        columns: std::ops::Range<usize>,
        rows: std::ops::Range<usize>,
        (left, top): (usize, usize),
        colour: Colour,
    ) {
        for (y, row) in rows.filter(|row| *row < stencil.height()).enumerate() {
            let row = stencil.row(row);
            for (x, column) in columns.clone().filter(|column| *column < row.len()).enumerate() {
                self.blend(left + x, top + y, colour, f32::from(255 - row[column]) / 255.0);
            }
        }
    }

    /// Sets a pixel.
    pub fn set(&mut self, x: usize, y: usize, colour: Colour) {
        if x < self.width() && y < self.height() {
            let at = 3 * (y * self.width() + x);
            self.image.samples_mut()[at..at + 3].copy_from_slice(&colour);
        }
    }

    /// Mixes a colour into a pixel; `share` is 0 to 1.
    pub fn blend(&mut self, x: usize, y: usize, colour: Colour, share: f32) {
        if x < self.width() && y < self.height() && share > 0.0 {
            let at = 3 * (y * self.width() + x);
            for (sample, colour) in self.image.samples_mut()[at..at + 3].iter_mut().zip(colour) {
                let (from, to) = (f32::from(*sample), f32::from(colour));
                *sample = (from + share.min(1.0) * (to - from) + 0.5) as u8;
            }
        }
    }

    /// Mixes a colour into a rectangle.
    pub fn shade(
        &mut self,
        (left, top): (usize, usize),
        (width, height): (usize, usize),
        colour: Colour,
        share: f32,
    ) {
        for y in top..(top + height).min(self.height()) {
            for x in left..(left + width).min(self.width()) {
                self.blend(x, y, colour, share);
            }
        }
    }

    /// A filled circle.
    pub fn disc(&mut self, centre: (f32, f32), radius: f32, colour: Colour) {
        self.stroke(centre, centre, radius, colour);
    }

    /// A line with round ends and this half width.
    pub fn stroke(&mut self, from: (f32, f32), to: (f32, f32), half: f32, colour: Colour) {
        let numbers = [from.0, from.1, to.0, to.1];
        if !numbers.iter().all(|number| number.is_finite() && number.abs() < 1e6) {
            return;
        }
        let reach = half + 1.0;
        let within = |low: f32, high: f32, end: usize| {
            (low - reach).floor().max(0.0) as usize
                ..((high + reach).ceil().max(-1.0) + 1.0).min(end as f32) as usize
        };
        let along = (to.0 - from.0, to.1 - from.1);
        let length2 = along.0 * along.0 + along.1 * along.1;
        for y in within(from.1.min(to.1), from.1.max(to.1), self.height()) {
            for x in within(from.0.min(to.0), from.0.max(to.0), self.width()) {
                let (dx, dy) = (x as f32 - from.0, y as f32 - from.1);
                let share = if length2 > 0.0 {
                    ((dx * along.0 + dy * along.1) / length2).clamp(0.0, 1.0)
                } else {
                    0.0
                };
                let (u, v) = (dx - share * along.0, dy - share * along.1);
                self.blend(x, y, colour, half + 0.5 - (u * u + v * v).sqrt());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    #[test]
    fn a_stroke_is_as_wide_as_asked_and_ends_at_the_edge() {
        let mut canvas = Canvas::new(20, 10);
        canvas.stroke((-50.0, 5.0), (50.0, 5.0), 1.5, [255; 3]);
        let column =
            |x: usize| (0..10).map(|y| u32::from(canvas.image().samples()[3 * (20 * y + x)])).sum::<u32>();
        assert_eq!([column(0), column(19)], [3 * 255; 2]);
        let before = canvas.clone();
        canvas.stroke((f32::NAN, 0.0), (1.0, 1.0), 1.0, [255; 3]);
        canvas.stroke((100.0, 100.0), (200.0, 100.0), 1.0, [255; 3]);
        assert_eq!(canvas.image().samples(), before.image().samples());
    }

    #[test]
    fn an_enlarged_image_reduced_again_is_that_image() {
        let samples: Vec<u8> = (0..3 * 7 * 5).map(|number| (number * 37 % 251) as u8).collect();
        let image = RgbImage::from_samples(7, 5, samples).unwrap();
        let large = Canvas::enlarged(&image, 3);
        assert_eq!((large.width(), large.height()), (21, 15));
        assert_eq!(Canvas::reduced(&large.into_image(), 3).image().samples(), image.samples());
        assert_eq!(Canvas::enlarged(&image, 1).image().samples(), image.samples());
        let cut = Canvas::reduced(&image, 2);
        assert_eq!((cut.width(), cut.height()), (3, 2));
    }

    #[test]
    fn what_is_placed_beyond_the_edge_is_cut_off() {
        let mut canvas = Canvas::new(4, 3);
        let mut white = Canvas::new(2, 2);
        white.shade((0, 0), (2, 2), [255; 3], 1.0);
        canvas.place(&white, (3, 2));
        canvas.place(&white, (9, 9));
        canvas.stamp(&GrayImage::new(2, 2), 0..2, 0..2, (0, 0), [9; 3]);
        assert_eq!(canvas.image().samples().iter().filter(|sample| **sample == 255).count(), 3);
        assert_eq!(canvas.image().samples().iter().filter(|sample| **sample == 9).count(), 12);
    }
}
