//! Impulse noise ("salt and pepper"): single pixels that have nothing in common with those about
//! them, as of a bad transmission or of hot pixels in the heat.

use super::GrayImage;

/// Least difference of an impulse from the pixels about it, gray levels.
const LEAST_GRAY: i32 = 20;

/// An impulse differs from its neighbours by more than this multiple of their range. A lens blurs
/// what is in the scene over more than one pixel.
const CLEAR: i32 = 3;

/// Of real photographs of ground, at most 2·10^-5 of the pixels are such impulses, of noise of 30
/// gray levels 4·10^-5, and of images of which a hundredth of the pixels is black or white 10^-2.
const LEAST_SHARE: f64 = 5e-4;

/// Range of equal neighbours, gray levels: that of quantization.
const LEAST_RANGE: i32 = 12;

/// Rows from one in which impulses are counted to the next.
const EVERY_ROW: usize = 8;

/// Whether an image has impulse noise.
pub fn has_impulse_noise(image: &GrayImage) -> bool {
    let (mut count, mut pixels) = (0, 0);
    for y in (1..image.height().saturating_sub(1)).step_by(EVERY_ROW) {
        count += (1..image.width().saturating_sub(1)).filter(|&x| is_impulse(image, x, y, CLEAR, 0)).count();
        pixels += image.width();
    }
    count as f64 > LEAST_SHARE * pixels as f64
}

/// Replaces impulses by the median of their neighbours (a switching median filter). Where there is
/// such noise, less clear impulses count too, and two may touch.
pub fn remove_impulse_noise(image: &mut GrayImage) {
    let width = image.width();
    let mut replaced = Vec::new();
    for y in 1..image.height().saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            if is_impulse(image, x, y, 1, 1) {
                replaced.push((y * width + x, neighbours(image, x, y)[4]));
            }
        }
    }
    for (at, median) in replaced {
        image.samples_mut()[at] = median;
    }
}

/// Whether a pixel, not at the border, is above or below its neighbours, but for `others` of them,
/// by more than a multiple of the range of the rest.
fn is_impulse(image: &GrayImage, x: usize, y: usize, multiple: i32, others: usize) -> bool {
    // The neighbours in the row rule out most pixels.
    let row = &image.row(y)[x - 1..x + 2];
    let (left, here, right) = (i32::from(row[0]), i32::from(row[1]), i32::from(row[2]));
    let is_far = |other: i32| (here - other).abs() > LEAST_GRAY;
    let needed = 2 - others;
    if usize::from(is_far(left)) + usize::from(is_far(right)) < needed {
        return false;
    }
    let sorted = neighbours(image, x, y);
    let (least, most) = (i32::from(sorted[others]), i32::from(sorted[7 - others]));
    let range = (most - least).max(LEAST_RANGE);
    (here - most).max(least - here) > LEAST_GRAY.max(multiple * range)
}

/// The eight neighbours of a pixel that is not at the border, sorted.
fn neighbours(image: &GrayImage, x: usize, y: usize) -> [u8; 8] {
    let [above, here, below] = [y - 1, y, y + 1].map(|y| &image.row(y)[x - 1..x + 2]);
    let mut all = [above[0], above[1], above[2], here[0], here[2], below[0], below[1], below[2]];
    all.sort_unstable();
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Random;

    fn ground() -> GrayImage {
        let sample = |at: usize| {
            let (x, y) = ((at % 160) as f64, (at / 160) as f64);
            (128.0 + 50.0 * (0.8 * x + 0.3 * y).sin() * (0.7 * y).cos()) as u8
        };
        GrayImage::from_samples(160, 120, (0..160 * 120).map(sample).collect()).unwrap()
    }

    #[test]
    fn impulses_are_found_and_replaced() {
        let clean = ground();
        assert!(!has_impulse_noise(&clean));
        let (mut noisy, mut random) = (clean.clone(), Random::new(1));
        let hit: Vec<usize> = (0..400).map(|_| random.below(160 * 120)).collect();
        for &at in &hit {
            noisy.samples_mut()[at] = if at % 2 == 0 { 0 } else { 255 };
        }
        assert!(has_impulse_noise(&noisy));
        remove_impulse_noise(&mut noisy);
        let off = |at: usize| noisy.samples()[at].abs_diff(clean.samples()[at]);
        let inside = |at: &usize| (1..159).contains(&(at % 160)) && (1..119).contains(&(at / 160));
        let left = hit.iter().copied().filter(inside).filter(|&at| off(at) > 60).count();
        assert!(left < 40, "{left} of 400 left");
        let others = (0..160 * 120).filter(|at| !hit.contains(at) && off(*at) > 0).count();
        assert!(others < 40, "{others} others changed");
    }

    #[test]
    fn noise_and_small_images_are_left_alone() {
        let mut random = Random::new(2);
        let samples = (0..160 * 120).map(|_| random.below(256) as u8).collect();
        assert!(!has_impulse_noise(&GrayImage::from_samples(160, 120, samples).unwrap()));
        for (width, height) in [(0, 0), (1, 1), (2, 5), (3, 3)] {
            let mut image = GrayImage::new(width, height);
            assert!(!has_impulse_noise(&image));
            remove_impulse_noise(&mut image);
        }
    }
}
