//! Row noise: each row of each image is brighter or darker by a random amount, as where a sensor
//! reads its rows in the dark, or in an analog video with interference. Column noise, of amplifiers
//! that differ from column to column, is the same in the transposed image.

use super::GrayImage;
use crate::numerics::{NORMAL_MEDIAN, median};

/// Rows from one comparison of neighbouring rows to the next, and columns from one sample of a row
/// to the next.
const EVERY_ROW: usize = 4;
const EVERY_COLUMN: usize = 2;

/// Least deviation of the rows, gray levels.
const LEAST_GRAY: f64 = 1.5;

/// Least ratio of the differences between rows to what the pixels' own differences leave in their
/// medians. Of real photographs of ground it is at most 2.1 where differences are independent, and
/// of rendered ground 1.7; row noise of 3 gray levels has 3 to 5.4 on carpet, asphalt and grass,
/// and 9 to 16 on bricks, tiles and concrete.
const LEAST_RATIO: f64 = 4.0;

/// The correlation between a difference and the next is -1/2 of independent rows; edges in the
/// scene are smooth.
const INDEPENDENT: f64 = -0.25;

/// Rows on both sides with which a row is compared. The noise averaged over them is left; the wider
/// it is, the better the gain and offset of a track absorb it. What is left of row noise differs
/// from image to image. That of columns is static and biases the tracks, hence more columns.
pub const ROWS_REACH: usize = 8;
pub const COLUMNS_REACH: usize = 32;

/// Looks for row noise.
#[derive(Debug, Clone, Default)]
pub struct RowNoise {
    /// Reusable memory: the medians of the differences for all pairs of rows, as they come and to
    /// be sorted, and their spreads.
    medians: Vec<f64>,
    sorted: Vec<f64>,
    spreads: Vec<f64>,
}

impl RowNoise {
    /// Whether an image has row noise.
    pub fn is_in(&mut self, image: &GrayImage) -> bool {
        self.is_in_lines((image.height(), image.width()), (image.width(), 1), image.samples())
    }

    /// Whether an image has column noise.
    pub fn is_in_columns(&mut self, image: &GrayImage) -> bool {
        self.is_in_lines((image.width(), image.height()), (1, image.width()), image.samples())
    }

    /// The same for lines of this number and length, with the distances in memory from one line to
    /// the next and from one sample of a line to the next.
    fn is_in_lines(
        &mut self,
        (lines, length): (usize, usize),
        strides: (usize, usize),
        image: &[u8],
    ) -> bool {
        self.compare_lines((lines, length), strides, image);
        let samples = (length / EVERY_COLUMN).max(1) as f64;
        self.sorted.clone_from(&self.medians);
        let (Some(slope), Some(spread)) = (median(&mut self.sorted), median(&mut self.spreads)) else {
            return false;
        };
        self.medians.iter_mut().for_each(|value| *value -= slope);
        self.sorted.clear();
        self.sorted.extend(self.medians.iter().map(|value| value.abs()));
        let sigma = median(&mut self.sorted).unwrap_or(0.0) / NORMAL_MEDIAN;
        let is_strong = sigma > LEAST_GRAY * std::f64::consts::SQRT_2
            && sigma > LEAST_RATIO * std::f64::consts::SQRT_2 * spread / (NORMAL_MEDIAN * samples).sqrt();
        is_strong && correlation(&self.medians, 3.0 * sigma) < INDEPENDENT
    }

    /// Medians and spreads of the differences between lines, of two pairs with a line in common at
    /// a time.
    fn compare_lines(
        &mut self,
        (lines, length): (usize, usize),
        (to_next_line, to_next): (usize, usize),
        image: &[u8],
    ) {
        self.medians.clear();
        self.spreads.clear();
        if length == 0 {
            return;
        }
        for line in (0..lines.saturating_sub(2)).step_by(EVERY_ROW) {
            let [first, second, third] =
                [0, 1, 2].map(|i| image[(line + i) * to_next_line..].iter().step_by(EVERY_COLUMN * to_next));
            let mut pairs = [Histogram::default(), Histogram::default()];
            let samples = first.zip(second).zip(third).take(length.div_ceil(EVERY_COLUMN));
            for ((&a, &b), &c) in samples {
                pairs[0].add(i32::from(b) - i32::from(a));
                pairs[1].add(i32::from(c) - i32::from(b));
            }
            for differences in &pairs {
                let middle = differences.median();
                self.medians.push(f64::from(middle));
                self.spreads.push(f64::from(differences.median_distance(middle)) / NORMAL_MEDIAN);
            }
        }
    }
}

/// Differences of gray levels, by number.
struct Histogram {
    counts: [u32; BLOCK * BLOCKS],
    total: u32,
}

/// Counts are added up in blocks first, to find the median.
const BLOCK: usize = 16;
const BLOCKS: usize = 512 / BLOCK;

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: [0; BLOCK * BLOCKS], total: 0 }
    }
}

impl Histogram {
    fn add(&mut self, difference: i32) {
        self.counts[(255 + difference) as usize] += 1;
        self.total += 1;
    }

    /// How many differences have this value.
    fn count(&self, difference: i32) -> u32 {
        self.counts.get((255 + difference) as usize).copied().unwrap_or(0)
    }

    /// The median, the greater of the middle two; 0 of nothing.
    fn median(&self) -> i32 {
        let mut below = 0;
        for (block, counts) in self.counts.as_chunks::<BLOCK>().0.iter().enumerate() {
            let with_block = below + counts.iter().sum::<u32>();
            if with_block > self.total / 2 {
                let values = (BLOCK * block) as i32 - 255..;
                return self.middle(below, values.zip(counts.iter().copied()));
            }
            below = with_block;
        }
        0
    }

    /// The median of the distances from a value.
    fn median_distance(&self, from: i32) -> i32 {
        let both = |distance| self.count(from + distance) + self.count(from - distance);
        let counts = (0..=510)
            .map(|distance| (distance, if distance == 0 { self.count(from) } else { both(distance) }));
        self.middle(0, counts)
    }

    /// The first value up to which more than half of the numbers lie, of which `below` are less
    /// than the first one.
    fn middle(&self, mut below: u32, mut counts: impl Iterator<Item = (i32, u32)>) -> i32 {
        let is_middle = |&(_, count): &(i32, u32)| {
            below += count;
            below > self.total / 2
        };
        counts.find(is_middle).map_or(0, |(value, _)| value)
    }
}

/// The correlation of the first with the second of each pair, after clamping to a limit.
fn correlation(differences: &[f64], limit: f64) -> f64 {
    let clamped = |value: f64| value.clamp(-limit, limit);
    let (mut common, mut squares) = (0.0, 0.0);
    for pair in differences.chunks_exact(2) {
        let (first, second) = (clamped(pair[0]), clamped(pair[1]));
        common += first * second;
        squares += 0.5 * (first * first + second * second);
    }
    if squares > 0.0 { common / squares } else { 0.0 }
}

/// Subtracts from each row the median of its difference from the mean of the rows within `reach`.
pub fn remove_row_noise(image: &mut GrayImage, reach: usize) {
    let (width, height) = (image.width(), image.height());
    let mut sums = vec![0u32; width];
    let add = |sums: &mut [u32], row: &[u8]| sums.iter_mut().zip(row).for_each(|(s, &v)| *s += u32::from(v));
    (0..height.min(reach)).for_each(|y| add(&mut sums, image.row(y)));
    let offsets: Vec<i32> = (0..height)
        .map(|y| {
            if y + reach < height {
                add(&mut sums, image.row(y + reach));
            }
            if y > reach {
                sums.iter_mut().zip(image.row(y - reach - 1)).for_each(|(s, &v)| *s -= u32::from(v));
            }
            let count = ((y + reach + 1).min(height) - y.saturating_sub(reach)) as i32;
            median_difference(image.row(y), &sums, count)
        })
        .collect();
    for (row, offset) in image.samples_mut().chunks_exact_mut(width.max(1)).zip(offsets) {
        row.iter_mut().for_each(|sample| *sample = (i32::from(*sample) - offset).clamp(0, 255) as u8);
    }
}

/// The median of the differences between samples and the means of `count` samples, gray levels.
fn median_difference(row: &[u8], sums: &[u32], count: i32) -> i32 {
    let mut differences = Histogram::default();
    for (&sample, &sum) in row.iter().zip(sums) {
        differences.add(i32::from(sample) - (sum as i32 + count / 2) / count);
    }
    differences.median()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Random;

    /// Smooth ground with noise, and rows that are off by up to `rows` gray levels.
    fn image(rows: usize) -> GrayImage {
        let mut random = Random::new(5);
        let mut image = GrayImage::new(320, 96);
        for y in 0..96 {
            let row = random.below(2 * rows + 1) as f64 - rows as f64;
            for x in 0..320 {
                let ground = 128.0 + 30.0 * (0.11 * x as f64).sin() * (0.13 * y as f64).cos();
                image.samples_mut()[y * 320 + x] = (ground + row + random.below(5) as f64 - 2.0) as u8;
            }
        }
        image
    }

    #[test]
    fn rows_that_are_off_are_found_and_corrected() {
        let mut noise = RowNoise::default();
        assert!(!noise.is_in(&image(0)) && noise.is_in(&image(20)));
        let (clean, mut noisy) = (image(0), image(20));
        let off = |image: &GrayImage| {
            let rows = (8..88).map(|y| image.row(y).iter().zip(clean.row(y)));
            let squares = rows.flatten().map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2));
            (squares.sum::<f64>() / (80.0 * 320.0)).sqrt()
        };
        let before = off(&noisy);
        remove_row_noise(&mut noisy, ROWS_REACH);
        // What is left is the mean of 17 rows, a quarter, and the noise of both images.
        assert!(off(&noisy) < 0.4 * before, "{before} {}", off(&noisy));
    }

    #[test]
    fn joints_and_stripes_of_the_ground_are_no_row_noise() {
        let striped = |period: usize| {
            let sample = |at: usize| if at / 320 % period < 3 { 60 } else { 160 };
            GrayImage::from_samples(320, 96, (0..320 * 96).map(sample).collect()).unwrap()
        };
        for period in [6, 7, 12, 40] {
            assert!(!RowNoise::default().is_in(&striped(period)), "{period}");
        }
    }

    #[test]
    fn columns_that_are_off_are_rows_of_the_transposed_image() {
        let (mut noisy, mut transposed) = (GrayImage::new(0, 0), GrayImage::new(0, 0));
        image(20).transpose_into(&mut noisy);
        assert_eq!((noisy.width(), noisy.height()), (96, 320));
        assert!(!RowNoise::default().is_in(&noisy));
        noisy.transpose_into(&mut transposed);
        assert_eq!(transposed, image(20));
        assert!(RowNoise::default().is_in(&transposed));
        assert!(RowNoise::default().is_in_columns(&noisy));
        assert!(!RowNoise::default().is_in_columns(&transposed));
    }

    #[test]
    fn images_of_any_size_are_taken() {
        for (width, height) in [(0, 0), (1, 1), (3, 2), (9, 40)] {
            let mut image = GrayImage::new(width, height);
            RowNoise::default().is_in(&image);
            remove_row_noise(&mut image, ROWS_REACH);
            assert_eq!((image.width(), image.height()), (width, height));
        }
    }
}
