//! Bayer patterns: one colour per pixel, interpolated to three.

/// Colours of the first two pixels of the first two rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BayerPattern {
    /// Red, green; green, blue.
    Rggb,
    /// Blue, green; green, red.
    Bggr,
    /// Green, blue; red, green.
    Gbrg,
    /// Green, red; blue, green.
    Grbg,
}

impl BayerPattern {
    /// Parity of column and row of the red pixels.
    fn red(self) -> (usize, usize) {
        match self {
            Self::Rggb => (0, 0),
            Self::Bggr => (1, 1),
            Self::Gbrg => (0, 1),
            Self::Grbg => (1, 0),
        }
    }

    /// Interpolates bilinearly to interleaved RGB. Neighbours beyond the border are mirrored at the
    /// border pixel, which keeps their colour.
    ///
    /// `rows` yields `height` rows of `width` samples; both must be at least 2.
    pub(crate) fn rgb<'a>(
        self,
        width: usize,
        height: usize,
        rows: impl Iterator<Item = &'a [u8]>,
    ) -> Vec<u8> {
        let rows: Vec<&[u8]> = rows.collect();
        let (red_x, red_y) = self.red();
        let mut rgb = vec![0; 3 * width * height];
        for (y, line) in rgb.chunks_exact_mut(3 * width).enumerate() {
            let above = rows[if y == 0 { 1 } else { y - 1 }];
            let below = rows[if y + 1 == height { y - 1 } else { y + 1 }];
            let row = rows[y];
            let in_red_row = y % 2 == red_y;
            for (x, pixel) in line.chunks_exact_mut(3).enumerate() {
                let left = if x == 0 { 1 } else { x - 1 };
                let right = if x + 1 == width { x - 1 } else { x + 1 };
                let of = |row: &[u8], x: usize| u16::from(row[x]);
                let across = (of(row, left) + of(row, right)).div_ceil(2);
                let down = (of(above, x) + of(below, x)).div_ceil(2);
                let own = of(row, x);
                let in_red_column = x % 2 == red_x;
                let (red, green, blue) = if in_red_row == in_red_column {
                    // A red or a blue pixel.
                    let four = of(row, left) + of(row, right) + of(above, x) + of(below, x);
                    let diagonal = of(above, left) + of(above, right) + of(below, left) + of(below, right);
                    let (green, other) = ((four + 2) / 4, (diagonal + 2) / 4);
                    if in_red_row { (own, green, other) } else { (other, green, own) }
                } else if in_red_row {
                    (across, own, down)
                } else {
                    (down, own, across)
                };
                pixel.copy_from_slice(&[red as u8, green as u8, blue as u8]);
            }
        }
        rgb
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plain_colour_stays_plain_in_every_pattern() {
        let color = [200, 100, 50];
        for (pattern, quad) in [
            (BayerPattern::Rggb, [0, 1, 1, 2]),
            (BayerPattern::Bggr, [2, 1, 1, 0]),
            (BayerPattern::Gbrg, [1, 2, 0, 1]),
            (BayerPattern::Grbg, [1, 0, 2, 1]),
        ] {
            for (width, height) in [(2, 2), (5, 4), (4, 7)] {
                let samples: Vec<u8> =
                    (0..width * height).map(|at| color[quad[at / width % 2 * 2 + at % width % 2]]).collect();
                let rgb = pattern.rgb(width, height, samples.chunks_exact(width));
                assert!(rgb.chunks_exact(3).all(|pixel| pixel == color), "{pattern:?} {width}x{height}");
            }
        }
    }
}
