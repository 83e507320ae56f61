//! Feature extraction from the orthorectified view: corners, orientation and descriptors.

use super::view::OrthoView;
use super::{GroundFeature, MAX_FEATURES, PlacesConfig};
use crate::detection::{Corner, DetectionConfig, detect};
use crate::image::GrayImage;
use crate::motion::Random;
use crate::numerics::median;
use std::sync::LazyLock;

/// Radius of the comparisons around a corner, spots: larger tells more places apart, and loses
/// corners near the edge of the view.
const REACH: usize = 12;

/// Radius of the disc that determines the direction of a corner, spots.
const DIRECTION_REACH: isize = 9;

/// Samples are means over squares of this many spots to either side: less noise, and less effect of
/// small rotations.
const SMOOTHING: usize = 2;

/// Radius of the neighbourhood whose mean is subtracted, spots. With it 40 of 40 pairs of views of
/// blurred, tilted concrete under uneven light with 30 % overlap are recognised, without it 30.
const SURROUNDINGS: usize = 15;

/// Minimum of the median absolute sum over a smoothing square, in gray levels times its 25 samples:
/// a gray level and a half per sample. Below it the sums are noise, which is not amplified.
const MIN_USUAL: f32 = 35.0;

/// Contrast, in standard deviations, at which the normalised image is half way to white or black:
/// lower suppresses highlights more, higher keeps more contrast.
const STRONG: f32 = 3.0;

/// Minimum and maximum number of features, as a factor of `config.features`: it grows with the
/// ground shown, between these bounds.
const MORE_GROUND: (f64, f64) = (0.1, 1.7);

/// The features of a view.
pub(super) fn features(view: &OrthoView<'_>, config: &PlacesConfig) -> Vec<GroundFeature> {
    let usual = (PlacesConfig::SPOTS.0 * PlacesConfig::SPOTS.1) as f64;
    let share = (view.area / usual).clamp(MORE_GROUND.0, MORE_GROUND.1);
    let count = (share * config.features as f64) as usize;
    let detection = DetectionConfig {
        corners: count.clamp(1, MAX_FEATURES),
        minimum_distance_px: 6.0,
        quality: 0.002,
        ..DetectionConfig::default()
    };
    let margin = REACH + SMOOTHING + 1;
    let smooth = Smooth::new(view);
    let corners = detect(&smooth.image(), &detection, margin);
    let seen = corners.iter().filter(|corner| view.sees((corner.x, corner.y), margin as f32));
    seen.map(|corner| smooth.feature(view, corner)).collect()
}

/// The view with every sample replaced by the sum over the square around it minus the mean of such
/// sums over a larger neighbourhood: slow changes of illumination would rotate all orientations.
struct Smooth {
    width: usize,
    sums: Vec<i16>,
    /// Offsets of a disc's places, with their weights for the moment to the right and down.
    disc: Vec<(isize, f32, f32)>,
}

impl Smooth {
    fn new(view: &OrthoView<'_>) -> Self {
        let (width, height) = (view.image.width(), view.image.height());
        let samples: Vec<i32> = view.image.samples().iter().map(|&sample| i32::from(sample)).collect();
        let near = box_sums(&samples, width, height, SMOOTHING);
        let far = box_sums(&samples, width, height, SURROUNDINGS);
        let near_area = (2 * SMOOTHING + 1).pow(2) as f32;
        let share = near_area / (2 * SURROUNDINGS + 1).pow(2) as f32;
        let mut sums: Vec<i16> =
            near.iter().zip(&far).map(|(&near, &far)| (near as f32 - share * far as f32) as i16).collect();
        if view.has_mask() {
            // No corners of a bumper in place of some of the ground.
            let place = |at: usize| ((at % width) as f32, (at / width) as f32);
            let masked = sums.iter_mut().enumerate().filter(|(at, _)| view.is_masked(place(*at)));
            masked.for_each(|(_, sum)| *sum = 0);
        }
        Self { width, sums, disc: disc(width) }
    }

    /// As gray levels around 128 with compressed contrast: typical deviations become some tens of
    /// levels, far stronger ones not much more. So corners are also detected in the faces of
    /// bricks, not only at the joints: those distinguish one brick from the next.
    fn image(&self) -> GrayImage {
        let usual = 1.48 * self.median().max(MIN_USUAL);
        let half = STRONG * usual;
        let gray = |&sum: &i16| {
            let sum = f32::from(sum);
            (128.5 + 127.0 * sum / (sum.abs() + half)) as u8
        };
        let samples = self.sums.iter().map(gray).collect();
        GrayImage::from_samples(self.width, self.sums.len() / self.width, samples)
            .unwrap_or(GrayImage::new(0, 0))
    }

    /// The median magnitude of every seventh sum, as precise as that of all.
    fn median(&self) -> f32 {
        let mut sizes: Vec<f64> = self.sums.iter().step_by(7).map(|sum| sum.unsigned_abs().into()).collect();
        median(&mut sizes).unwrap_or(0.0) as f32
    }

    fn feature(&self, view: &OrthoView<'_>, corner: &Corner) -> GroundFeature {
        let centre = corner.y * self.width + corner.x;
        let (right, down) = self.moment(centre);
        // In the view, x is up and y is left.
        let (x, y) = (-down, -right);
        let length = x.hypot(y).max(1e-9);
        let (cos, sin) = (x / length, y / length);
        GroundFeature {
            descriptor: self.descriptor(centre, cos, sin),
            position_m: view.position_m((corner.x as f64, corner.y as f64)),
            // Through `f64`, whose result is the same on every platform; that of `f32` is not.
            direction_rad: f64::from(y).atan2(f64::from(x)) as f32,
        }
    }

    /// The first moment of brightness over a disc: it points towards brighter ground (P. Rosin,
    /// "Measuring corner properties", 1999). Weights fall off towards the rim, so that what enters
    /// or leaves the disc rotates the direction little.
    fn moment(&self, centre: usize) -> (f32, f32) {
        let (mut right, mut down) = (0.0, 0.0);
        for &(offset, weight_right, weight_down) in &self.disc {
            let sample = f32::from(self.sums[(centre as isize + offset) as usize]);
            right += weight_right * sample;
            down += weight_down * sample;
        }
        (right, down)
    }

    /// 256 comparisons of two positions each around a corner, rotated to its orientation (`cos`,
    /// `sin`).
    fn descriptor(&self, centre: usize, cos: f32, sin: f32) -> [u64; 4] {
        let sample = |[along, across]: [f32; 2]| {
            let (x, y) = (cos * along - sin * across, sin * along + cos * across);
            // Rounded to nearest by truncation of a positive number.
            let (right, down) = ((64.5 - y) as isize - 64, (64.5 - x) as isize - 64);
            self.sums[(centre as isize + down * self.width as isize + right) as usize]
        };
        let mut words = [0u64; 4];
        for (bit, [a, b]) in COMPARISONS.iter().enumerate() {
            words[bit / 64] |= u64::from(sample(*a) < sample(*b)) << (bit % 64);
        }
        words
    }
}

/// The disc for an image of this width.
fn disc(width: usize) -> Vec<(isize, f32, f32)> {
    let reach = DIRECTION_REACH;
    let places = (-reach..=reach).flat_map(|down| (-reach..=reach).map(move |right| (right, down)));
    let weighted = places.map(|(right, down)| {
        let share = (right * right + down * down) as f32 / (reach * reach) as f32;
        let weight = 1.0 - share;
        (down * width as isize + right, weight, weight * right as f32, weight * down as f32)
    });
    weighted.filter(|place| place.1 > 0.0).map(|(offset, _, right, down)| (offset, right, down)).collect()
}

/// The two positions that each bit compares, along the orientation and across it, spots. Drawn once
/// from a normal distribution around the corner (the best pattern of Calonder et al.) and never
/// changed: signatures in map files depend on it.
static COMPARISONS: LazyLock<[[[f32; 2]; 2]; 256]> = LazyLock::new(|| {
    let mut random = Random::new(0x6f64_6f67);
    let mut normal =
        move || (0..8).map(|_| random.below(1 << 16) as f32 / 65536.0 - 0.5).sum::<f32>() * 1.2247;
    let reach = REACH as f32 - 0.5;
    let mut place = move || {
        loop {
            let place = [0.45 * reach * normal(), 0.45 * reach * normal()];
            if place[0].hypot(place[1]) <= reach {
                return place;
            }
        }
    };
    std::array::from_fn(|_| {
        loop {
            let pair = [place(), place()];
            // All ground is brighter along the orientation by definition; comparisons across it are
            // distinctive. Near positions share most of their squares.
            if (pair[0][0] - pair[1][0]).abs() <= 2.0 && (pair[0][1] - pair[1][1]).abs() >= 4.0 {
                return pair;
            }
        }
    })
});

/// Sums over squares of `reach` to either side of every sample, with the border replicated.
fn box_sums(samples: &[i32], width: usize, height: usize, reach: usize) -> Vec<i32> {
    let side = 2 * reach + 1;
    let row = |y: isize| {
        let y = y.clamp(0, height as isize - 1) as usize;
        &samples[y * width..][..width]
    };
    let mut sums = vec![0; width * height];
    // The sums of columns, with the border replicated on both sides.
    let mut columns = vec![0i32; width + 2 * reach];
    for y in -(reach as isize)..=(reach as isize) {
        columns[reach..reach + width].iter_mut().zip(row(y)).for_each(|(sum, sample)| *sum += sample);
    }
    for (y, out) in sums.chunks_exact_mut(width).enumerate() {
        let (first, last) = (columns[reach], columns[reach + width - 1]);
        columns[..reach].fill(first);
        columns[reach + width..].fill(last);
        let mut sum: i32 = columns[..side - 1].iter().sum();
        for (x, out) in out.iter_mut().enumerate() {
            sum += columns[x + side - 1];
            *out = sum;
            sum -= columns[x];
        }
        let y = y as isize;
        let (enters, leaves) = (row(y + 1 + reach as isize), row(y - reach as isize));
        let change = enters.iter().zip(leaves);
        columns[reach..reach + width].iter_mut().zip(change).for_each(|(sum, (a, b))| *sum += a - b);
    }
    sums
}
