//! Interlaced video: even and odd rows of an image are of different times.

use super::GrayImage;
use super::simd::squared_differences;
use crate::numerics::median;

/// Finds out from the images themselves whether a recording is interlaced.
///
/// In an image of one time, rows next to each other are more alike than rows two apart; noise makes
/// both alike. Where the camera moves, an interlaced image is the other way round.
#[derive(Debug, Clone, Default)]
pub struct Interlacing {
    combed: u32,
    /// Reusable memory: per compared row, the squared differences from the next and the second row,
    /// and their sums.
    differences: Vec<[f64; 2]>,
    sums: Vec<f64>,
}

/// Ratio of the squared differences between rows next to each other and two apart from which an
/// image is combed. Of one time it is 0.3 to 0.7 on rendered grounds and 1 in noise alone;
/// interlaced asphalt has 2.5 where the camera moves.
const COMBED: f64 = 1.3;

/// Combed images in a row from which a recording is interlaced.
const SURE: u32 = 2;

/// Rows from one comparison to the next.
const EVERY: usize = 8;

impl Interlacing {
    /// Whether the recording is interlaced, as its images up to this one show.
    pub fn look(&mut self, image: &GrayImage) -> bool {
        if !self.is_found() {
            self.combed = if self.is_combed(image) { self.combed + 1 } else { 0 };
        }
        self.is_found()
    }

    /// Whether the recording has been found to be interlaced.
    pub fn is_found(&self) -> bool {
        self.combed >= SURE
    }

    fn is_combed(&mut self, image: &GrayImage) -> bool {
        let rows = (0..image.height().saturating_sub(2)).step_by(EVERY);
        let of_row = |y| [1, 2].map(|apart| squared_differences(image.row(y), image.row(y + apart)) as f64);
        // Rows of a black border say nothing, and a row counts no more than the median row: a few
        // that differ from all others, as those of a broken sensor do, are no second field.
        self.differences.clear();
        self.differences.extend(rows.map(of_row).filter(|[next, second]| next + second > 0.0));
        self.sums.clear();
        self.sums.extend(self.differences.iter().map(|[next, second]| next + second));
        let Some(most) = median(&mut self.sums) else { return false };
        let (mut next, mut second) = (0.0, 0.0);
        for [to_next, to_second] in &self.differences {
            let weight = (most / (to_next + to_second)).min(1.0);
            next += weight * to_next;
            second += weight * to_second;
        }
        next > COMBED * second
    }
}

/// The image of the time of the even rows: odd rows are the mean of their neighbours.
pub fn even_field(mut image: GrayImage) -> GrayImage {
    let width = image.width();
    for y in (1..image.height()).step_by(2) {
        let (before, rest) = image.samples_mut().split_at_mut(y * width);
        let (row, after) = rest.split_at_mut(width);
        let above = &before[(y - 1) * width..];
        let below = after.get(..width).unwrap_or(above);
        for ((sample, &a), &b) in row.iter_mut().zip(above).zip(below) {
            *sample = u16::from(a).midpoint(u16::from(b) + 1) as u8;
        }
    }
    image
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(shift_px: impl Fn(usize) -> usize) -> GrayImage {
        let sample = |at: usize| {
            let (x, y) = (at % 96 + shift_px(at / 96), at / 96);
            (128.0 + 60.0 * (0.9 * x as f64 + 0.2 * y as f64).sin() + 30.0 * (0.5 * y as f64).sin()) as u8
        };
        GrayImage::from_samples(96, 64, (0..96 * 64).map(sample).collect()).unwrap()
    }

    #[test]
    fn rows_of_two_times_are_found_and_replaced() {
        let (still, combed) = (picture(|_| 0), picture(|y| 3 * (y % 2)));
        let mut interlacing = Interlacing::default();
        assert!(!interlacing.look(&still) && !interlacing.look(&combed) && interlacing.look(&combed));
        assert!(interlacing.look(&still), "a recording that is interlaced stays so");
        let (field, truth) = (even_field(combed), still);
        // The last row has one neighbour only.
        let rows = 0..62 * 96;
        let most = rows.map(|at| field.samples()[at].abs_diff(truth.samples()[at])).max();
        assert!(most.unwrap() < 8, "{most:?}");
        assert!((0..64).step_by(2).all(|y| field.row(y) == truth.row(y)));
    }

    #[test]
    fn broken_rows_are_no_second_field() {
        let mut image = picture(|_| 0);
        for y in [9, 33] {
            image.samples_mut()[y * 96..][..96].fill(0);
        }
        let mut interlacing = Interlacing::default();
        assert!((0..10).all(|_| !interlacing.look(&image)));
    }

    #[test]
    fn noise_is_not_interlaced() {
        let mut random = crate::motion::Random::new(3);
        let mut interlacing = Interlacing::default();
        for _ in 0..50 {
            let samples = (0..96 * 64).map(|_| random.below(256) as u8).collect();
            assert!(!interlacing.look(&GrayImage::from_samples(96, 64, samples).unwrap()));
        }
    }
}
