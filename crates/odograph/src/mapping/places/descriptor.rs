//! From the view of the ground to its features: corners, the direction of the ground around them, and what they look like.

use super::view::View;
use super::{GroundFeature, MOST_FEATURES, PlacesConfig};
use crate::detection::{Corner, DetectionConfig, detect};
use crate::motion::Random;
use std::sync::LazyLock;

/// The comparisons reach this far around a corner, spots.
const REACH: usize = 12;

/// The direction is taken from the ground this far around a corner, spots.
const DIRECTION_REACH: isize = 9;

/// Samples are means over squares of this many spots to either side, which takes out noise and what a turn by less than a step moves.
const SMOOTHING: usize = 2;

/// How many of `config.features` a picture of the usual size gives at most and at least, where it shows more or less ground.
const MORE_GROUND: (f64, f64) = (0.1, 1.7);

/// The features of a view.
pub(super) fn features(view: &View, config: &PlacesConfig) -> Vec<GroundFeature> {
    let usual = (PlacesConfig::SPOTS.0 * PlacesConfig::SPOTS.1) as f64;
    let share = (view.area / usual).clamp(MORE_GROUND.0, MORE_GROUND.1);
    let count = (share * config.features as f64) as usize;
    let detection = DetectionConfig {
        corners: count.clamp(1, MOST_FEATURES),
        minimum_distance_px: 6.0,
        quality: 0.002,
        ..DetectionConfig::default()
    };
    let margin = REACH + SMOOTHING + 1;
    let corners = detect(&view.image, &detection, margin);
    let smooth = Smooth::new(view);
    let seen = corners.iter().filter(|corner| view.sees((corner.x, corner.y), margin as f32));
    seen.map(|corner| smooth.feature(view, corner)).collect()
}

/// The view with every sample the sum over the square around it.
struct Smooth {
    width: usize,
    sums: Vec<u16>,
    /// Offsets of a disc's places, with their weights for the moment to the right and down.
    disc: Vec<(isize, f32, f32)>,
}

impl Smooth {
    fn new(view: &View) -> Self {
        let (width, height) = (view.image.width(), view.image.height());
        let side = 2 * SMOOTHING + 1;
        // At most 255 · 5 · 5, which 16 bits hold. Sums stand at the middle of their squares; the border, which is never asked, stays 0.
        let mut sums = vec![0u16; width * height];
        let mut columns = vec![0u16; width];
        for row in 0..height {
            let add = |columns: &mut [u16], row: usize| {
                columns.iter_mut().zip(view.image.row(row)).for_each(|(sum, &s)| *sum += u16::from(s));
            };
            add(&mut columns, row);
            if row + 1 < side {
                continue;
            }
            let out = &mut sums[(row - SMOOTHING) * width..][SMOOTHING..width - SMOOTHING];
            for (out, window) in out.iter_mut().zip(columns.windows(side)) {
                *out = window.iter().sum();
            }
            let oldest = view.image.row(row + 1 - side);
            columns.iter_mut().zip(oldest).for_each(|(sum, &s)| *sum -= u16::from(s));
        }
        Self { width, sums, disc: disc(width) }
    }

    fn feature(&self, view: &View, corner: &Corner) -> GroundFeature {
        let centre = corner.y * self.width + corner.x;
        let (right, down) = self.moment(centre);
        // In the view, x is up and y is left.
        let (x, y) = (-down, -right);
        let length = x.hypot(y).max(1e-9);
        let (cos, sin) = (x / length, y / length);
        GroundFeature {
            descriptor: self.descriptor(centre, cos, sin),
            position_m: view.position_m((corner.x as f64, corner.y as f64)),
            direction_rad: y.atan2(x),
        }
    }

    /// The first moment of brightness over a disc: it points to where the ground is brighter (P. Rosin, "Measuring corner properties",
    /// 1999). Weights fall off towards the rim, so that what goes in or out over it turns the direction little.
    fn moment(&self, centre: usize) -> (f32, f32) {
        let (mut right, mut down) = (0.0, 0.0);
        for &(offset, weight_right, weight_down) in &self.disc {
            let sample = f32::from(self.sums[(centre as isize + offset) as usize]);
            right += weight_right * sample;
            down += weight_down * sample;
        }
        (right, down)
    }

    /// 256 comparisons of two places each around a corner, along the direction (`cos`, `sin`) of its pattern.
    fn descriptor(&self, centre: usize, cos: f32, sin: f32) -> [u64; 4] {
        let sample = |[along, across]: [f32; 2]| {
            let (x, y) = (cos * along - sin * across, sin * along + cos * across);
            let (right, down) = ((-y).round_ties_even() as isize, (-x).round_ties_even() as isize);
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

/// Which two places each bit compares: along the direction and across it, spots. Drawn once for all, normally distributed around the corner
/// (the best of the patterns tried by Calonder et al.), never changed: signatures in map files depend on it.
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
            // Nearer places share most of what they are means of.
            if (pair[0][0] - pair[1][0]).hypot(pair[0][1] - pair[1][1]) >= 4.0 {
                return pair;
            }
        }
    })
});
