//! How two registered images of the ground differ: by noise, or by what is peculiar to a place.
//!
//! On ground that repeats, such as tiles or a printed floor, the corners of a place are found at
//! its lookalikes too. What remains when registered images are divided by each other tells them
//! apart: the repeating part cancels, at every period alike. Over one place noise remains, whose
//! mean over a square falls with the side of the square. Over a lookalike the differences of grain,
//! stains and wear remain too, whose mean falls much less.
//!
//! The images may differ by a gain, a black level (a picture of full range beside a video of
//! limited range) and darker corners, all of which are fitted and subtracted. On the demo's bricks
//! the black level had left 0.0145 where 0.005 remain without it, and a lookalike has 0.006 to
//! 0.02.

use crate::camera::Camera;
use crate::fixed_pattern::ImageMask;
use crate::geometry::{GroundPose, Pixel};
use crate::image::{GrayImage, Pyramid};
use crate::place_recognition::PlacesConfig;
use nalgebra::{Matrix4, Vector4};

/// An image of the ground with the pose of its camera.
#[derive(Debug, Clone, Copy)]
pub struct RegisteredImage<'a> {
    pub camera: &'a Camera,
    pub pyramid: &'a Pyramid,
    pub pose: GroundPose,
    pub mask: Option<&'a ImageMask>,
}

/// How two registered images of the ground differ: root mean squares of the logarithm of the ratio
/// of their brightness, without gain, black level and the darkening towards the corners of the
/// image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Likeness {
    /// Over squares of [`FINE`] spots.
    fine: f64,
    /// Over squares of twice the side of a [`CELL`].
    coarse: f64,
    /// The bands that the latter is made of, finest first.
    bands: [Band; 3],
}

/// The differences of one range of sizes: squares of 16 spots from the mean of four, squares of 32
/// spots likewise, and squares of 64 spots.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Band {
    mean_square: f64,
    /// Degrees of freedom. Four squares have three differences, which count as one, as grain and
    /// noise of neighbours are correlated; of the largest squares each counts, but for four that
    /// the light is fitted by.
    freedom: usize,
}

/// Sides of the squares over which brightness is averaged, spots: samples of a view of
/// [`PlacesConfig::SPOTS`]. A cell is the unit in which the overlap is taken; the mapping between
/// the images is exact at its corners.
const FINE: usize = 2;
const CELL: usize = 8;

/// Minimum number of coarse squares in the overlap; a whole view has 300. Fewer judge smaller
/// overlaps, with more scatter of the two measures.
const MIN_SQUARES: usize = 60;

/// Range of brightness, gray levels, in which ratios are taken: below it they are noise, above it
/// saturated.
const DARKEST: f64 = 4.0;
const BRIGHTEST: f64 = 250.0;

/// Largest ratio of the coarse to the fine difference of two images of one place. White noise has
/// 0.125; of rendered tiles of 20 cm 19 in 20 images have less, and 0.65 to 0.76 at any other
/// period.
const MAX_STRUCTURE: f64 = 0.35;

/// Largest coarse difference: noise does not hide another place. Rendered tiles have 0.0007 to
/// 0.0044, and 0.015 to 0.020 at any other period.
const MAX_DIFFERENCE: f64 = 0.008;

impl Likeness {
    /// Compares the ground that both images show; `None` if that is too little.
    pub fn of(one: &RegisteredImage<'_>, other: &RegisteredImage<'_>) -> Option<Self> {
        let cells = OverlapGrid::new(one, other);
        let fitted = cells.fitted_light()?;
        let (mut fine, mut groups) = (0.0, 0usize);
        for cell in cells.cells.iter().flatten() {
            fine += cell.residuals(&fitted).map(|residual| residual * residual).iter().sum::<f64>();
            groups += cell.ratios.len();
        }
        let cell = |cell: &Option<OverlapCell>| {
            cell.as_ref().map(|cell| cell.residuals(&fitted).iter().sum::<f64>() / cell.ratios.len() as f64)
        };
        let cells = SquareGrid { columns: cells.columns, means: cells.cells.iter().map(cell).collect() };
        let grid = cells.halved().0;
        let known = || grid.means.iter().flatten();
        let (squares, coarse) = (known().count(), known().map(|mean| mean * mean).sum::<f64>());
        if squares < MIN_SQUARES {
            return None;
        }
        let (grid, small) = grid.halved();
        let (grid, middle) = grid.halved();
        let (fine, coarse) = ((fine / groups as f64).sqrt(), (coarse / squares as f64).sqrt());
        Some(Self { fine, coarse, bands: [small, middle, grid.rest()] })
    }

    /// Whether the large squares differ by no more than white noise does whose small squares differ
    /// as these do: an F test that would refuse one in a hundred pictures of one place. Noise of
    /// lossy video is not white: it refuses half of the demo's frames. Of their lookalikes 1.6 m
    /// away, where only the light differs, it refuses six in seven.
    pub fn is_white(&self) -> bool {
        const REFUSED: f64 = 0.01;
        // The mean of 16 squares has a sixteenth of their variance.
        let [small, _, large] = self.bands;
        large.freedom >= 2
            && small.freedom >= 2
            && f_distribution(16.0 * large.mean_square / small.mean_square, large.freedom, small.freedom)
                <= 1.0 - REFUSED
    }

    /// The probability of differences so much smaller than those of a rival, if neither image shows
    /// the place. Then both differ by equally distributed grain, and the ratio of their mean
    /// squares has an F distribution in every band; the bands are combined by R. Fisher's method
    /// ("Statistical methods for research workers", 1925, §21.1).
    pub fn false_alarm(&self, rival: &Self) -> f64 {
        let pairs = self.bands.iter().zip(&rival.bands);
        let shown = pairs.filter(|(here, there)| here.freedom.min(there.freedom) >= 2);
        let probabilities = shown.map(|(here, there)| {
            let ratio = here.mean_square / there.mean_square.max(f64::MIN_POSITIVE);
            f_distribution(ratio, here.freedom, there.freedom)
        });
        let (mut logarithm, mut count) = (0.0, 0);
        for probability in probabilities {
            logarithm -= probability.max(f64::MIN_POSITIVE).ln();
            count += 1;
        }
        // The χ² distribution with two degrees of freedom for each.
        let term = |order: u32| (1..=order).map(|k| logarithm / f64::from(k)).product::<f64>();
        if count == 0 { 1.0 } else { (-logarithm).exp() * (0..count).map(term).sum::<f64>() }
    }

    /// Whether the images differ by little more than noise.
    pub fn is_of_one_place(&self) -> bool {
        self.coarse <= MAX_DIFFERENCE && self.coarse <= MAX_STRUCTURE * self.fine
    }
}

/// The probability that a variance ratio with these degrees of freedom is at most `ratio`: the
/// regularised incomplete beta function, which is a binomial tail where both are even. Odd ones are
/// rounded down.
fn f_distribution(ratio: f64, above: usize, below: usize) -> f64 {
    let (a, b) = (above / 2, below / 2);
    let (above, below) = (2.0 * a as f64, 2.0 * b as f64);
    let share = (above * ratio / (above * ratio + below)).min(1.0 - f64::EPSILON);
    let trials = a + b - 1;
    let mut term = (1.0 - share).powi(trials as i32);
    let mut below = 0.0;
    for successes in 0..a {
        below += term;
        term *= (trials - successes) as f64 / (successes + 1) as f64 * share / (1.0 - share);
    }
    let mut tail = 0.0;
    for successes in a..=trials {
        tail += term;
        term *= (trials - successes) as f64 / (successes + 1) as f64 * share / (1.0 - share);
    }
    // The smaller of the two is the exact one.
    if tail < below { tail } else { 1.0 - below }
}

/// Mean differences of squares.
struct SquareGrid {
    columns: usize,
    means: Vec<Option<f64>>,
}

impl SquareGrid {
    /// The grid of squares twice as large, where all four are known, and what these differ by.
    fn halved(&self) -> (Self, Band) {
        let (columns, rows) = (self.columns / 2, self.means.len() / self.columns.max(1) / 2);
        let (mut sum, mut fours) = (0.0, 0usize);
        let mut mean = |i: usize| {
            let first = 2 * (i / columns) * self.columns + 2 * (i % columns);
            let at = [first, first + 1, first + self.columns, first + self.columns + 1];
            let [Some(a), Some(b), Some(c), Some(d)] = at.map(|at| self.means[at]) else { return None };
            let mean = 0.25 * (a + b + c + d);
            sum += [a, b, c, d].map(|one| (one - mean).powi(2)).iter().sum::<f64>();
            fours += 1;
            Some(mean)
        };
        let means = (0..columns * rows).map(&mut mean).collect();
        let mean_square = sum / (3 * fours.max(1)) as f64;
        (Self { columns, means }, Band { mean_square, freedom: fours })
    }

    /// What the squares themselves are.
    fn rest(&self) -> Band {
        let known = || self.means.iter().flatten();
        let sum: f64 = known().map(|mean| mean * mean).sum();
        let count = known().count();
        Band { mean_square: sum / count.max(1) as f64, freedom: count.saturating_sub(4) }
    }
}

/// The common ground, cell by cell.
struct OverlapGrid {
    columns: usize,
    cells: Vec<Option<OverlapCell>>,
}

/// A square of [`CELL`] spots.
struct OverlapCell {
    /// Logarithms of the ratios of brightness over its squares of [`FINE`] spots.
    ratios: [f64; GROUPS],
    /// What a black level adds to these, for [`USUAL`] gray levels.
    lifts: [f64; GROUPS],
    /// Differences of the second and fourth power of the distance from the optical axis.
    radial: [f64; 2],
}

/// Squares of [`FINE`] spots in a cell.
const GROUPS: usize = (CELL / FINE) * (CELL / FINE);

/// The unit of a black level, gray levels, only for conditioning.
const USUAL: f64 = 100.0;

impl OverlapCell {
    fn mean(&self) -> f64 {
        self.ratios.iter().sum::<f64>() / self.ratios.len() as f64
    }

    /// What gain, the two terms of darker corners, and black level add.
    fn light(&self, lift: f64) -> Vector4<f64> {
        Vector4::new(1.0, self.radial[0], self.radial[1], lift)
    }

    fn residuals(&self, fitted: &Vector4<f64>) -> [f64; GROUPS] {
        std::array::from_fn(|i| self.ratios[i] - fitted.dot(&self.light(self.lifts[i])))
    }
}

/// Where a sample of one image lies in the other.
#[derive(Clone, Copy)]
struct GridNode {
    x: f64,
    y: f64,
    radial: [f64; 2],
}

/// The level of a pyramid whose samples are about a spot wide, and its step in pixels.
fn level(image: &RegisteredImage<'_>) -> (usize, f64) {
    let long_side = image.camera.width().max(image.camera.height()) as f64;
    let spot_px = long_side / PlacesConfig::SPOTS.0 as f64;
    let level = (spot_px.log2().round().max(0.0) as usize).min(image.pyramid.levels() - 1);
    (level, (1u64 << level) as f64)
}

impl OverlapGrid {
    fn new(one: &RegisteredImage<'_>, other: &RegisteredImage<'_>) -> Self {
        let ((level_here, step), (level_there, step_there)) = (level(one), level(other));
        let (here, there) = (one.pyramid.level(level_here), other.pyramid.level(level_there));
        let (columns, rows) = ((here.width() - 1) / CELL, (here.height() - 1) / CELL);
        let node = |i: usize| {
            let (column, row) = (i % (columns + 1), i / (columns + 1));
            let pixel = Pixel::new((column * CELL) as f64 * step, (row * CELL) as f64 * step);
            let ray = one.camera.ray_from_pixel(pixel)?;
            let seen = other.pose.ray_from_ground(one.pose.ground_from_ray(ray)?)?;
            let found = other.camera.pixel_from_ray(seen)?;
            let is_masked =
                |image: &RegisteredImage<'_>, pixel| image.mask.is_some_and(|m| m.covers_pixel(pixel));
            let is_ground = other.camera.contains(found, step_there)
                && !is_masked(one, pixel)
                && !is_masked(other, found);
            let squares = [ray, seen].map(|ray| ray.x * ray.x + ray.y * ray.y);
            let radial = [squares[0] - squares[1], squares[0].powi(2) - squares[1].powi(2)];
            is_ground.then_some(GridNode { x: found.x / step_there, y: found.y / step_there, radial })
        };
        let nodes: Vec<Option<GridNode>> = (0..(columns + 1) * (rows + 1)).map(node).collect();
        let cell = |i: usize| {
            let (column, row) = (i % columns, i / columns);
            let at = |down: usize, right: usize| nodes[(row + down) * (columns + 1) + column + right];
            let corners = [at(0, 0)?, at(0, 1)?, at(1, 0)?, at(1, 1)?];
            compared((here, column * CELL, row * CELL), there, &corners)
        };
        Self { columns, cells: (0..columns * rows).map(cell).collect() }
    }

    /// Gain, darkening towards the corners and black level, by least squares.
    fn fitted_light(&self) -> Option<Vector4<f64>> {
        let (mut normal, mut right) = (Matrix4::zeros(), Vector4::zeros());
        for cell in self.cells.iter().flatten() {
            let light = cell.light(cell.lifts.iter().sum::<f64>() / GROUPS as f64);
            normal += light * light.transpose();
            right += light * cell.mean();
        }
        // Images from nearly the same place do not show the darkening, and even ground shows no
        // black level; they need no correction.
        let weak = Matrix4::from_diagonal(&Vector4::new(0.0, 1e-3, 1e-3, 1e-3));
        (normal + weak).try_inverse().map(|inverse| inverse * right)
    }
}

/// The cell of an image with its first sample at (`left`, `top`), compared with the other image.
fn compared(
    (here, left, top): (&GrayImage, usize, usize),
    there: &GrayImage,
    corners: &[GridNode; 4],
) -> Option<OverlapCell> {
    let mut sums = [[0.0f64; 2]; GROUPS];
    let [a, b, c, d] = corners;
    for j in 0..CELL {
        let v = j as f64 / CELL as f64;
        let between = |above: f64, below: f64| above + v * (below - above);
        let (x, y) = (between(a.x, c.x), between(a.y, c.y));
        let per_sample = 1.0 / CELL as f64;
        let (dx, dy) = (per_sample * (between(b.x, d.x) - x), per_sample * (between(b.y, d.y) - y));
        let row = &here.row(top + j)[left..left + CELL];
        for (i, &sample) in row.iter().enumerate() {
            let sums = &mut sums[j / FINE * (CELL / FINE) + i / FINE];
            sums[0] += f64::from(sample);
            sums[1] += there.bilinear(x + i as f64 * dx, y + i as f64 * dy)?;
        }
    }
    let all = (FINE * FINE) as f64;
    let usable = |sum: f64| (DARKEST * all..BRIGHTEST * all).contains(&sum);
    if !sums.as_flattened().iter().all(|&sum| usable(sum)) {
        return None;
    }
    let radial = [0, 1].map(|k| 0.25 * corners.iter().map(|corner| corner.radial[k]).sum::<f64>());
    let ratios = sums.map(|[here, there]| (here / there).ln());
    Some(OverlapCell { ratios, lifts: sums.map(|[_, there]| USUAL * all / there - 1.0), radial })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Distortion;
    use crate::motion::Random;
    use crate::simulation::{Ground, Renderer, Texture};

    #[test]
    fn a_tile_further_differs_by_more_than_noise() {
        let camera = Camera::new((320, 240), (250.0, 250.0), (160.5, 119.0), Distortion::None).unwrap();
        let renderer = Renderer::new(&camera);
        let ground = Ground::new(Texture::Tiles, renderer.footprint_m(0.9), false, 9).unwrap();
        let mut random = Random::new(4);
        let mut picture = |pose: &GroundPose, gain: f64| {
            let mut image = renderer.gray_view(&ground, pose);
            for sample in image.samples_mut() {
                // The sum of four uniform numbers deviates by 0.577 of their width: 2 gray levels.
                let noise: f64 = (0..4).map(|_| random.below(1 << 16) as f64 / 65536.0 - 0.5).sum();
                *sample = (gain * f64::from(*sample) + 3.5 * noise).round().clamp(0.0, 255.0) as u8;
            }
            Pyramid::new(image, 3)
        };
        for turn in [0.0, 0.8, 2.5] {
            let here = GroundPose { x_m: turn, ..GroundPose::level(0.9) };
            let there = GroundPose { x_m: turn + 0.05, y_m: -0.08, heading_rad: turn, ..here };
            let further = GroundPose { x_m: there.x_m + 0.2, ..there };
            let (query, place) = (picture(&here, 1.0), picture(&there, 0.8));
            let lookalike = picture(&further, 0.9);
            let registered = |pyramid, pose| RegisteredImage { camera: &camera, pyramid, pose, mask: None };
            let compared = |pyramid| Likeness::of(&registered(&query, here), &registered(pyramid, there));
            let (one, other) = (compared(&place).unwrap(), compared(&lookalike).unwrap());
            assert!(one.is_of_one_place() && !other.is_of_one_place(), "{one:?} {other:?}");
            assert!(one.false_alarm(&other) < 1e-6 && other.false_alarm(&one) > 0.9, "{one:?} {other:?}");
        }
    }

    #[test]
    fn a_black_level_is_no_difference() {
        let camera = Camera::new((320, 240), (250.0, 250.0), (160.5, 119.0), Distortion::None).unwrap();
        let renderer = Renderer::new(&camera);
        let ground = Ground::new(Texture::Bricks, renderer.footprint_m(0.9), false, 9).unwrap();
        let (here, there) = (GroundPose::level(0.9), GroundPose { x_m: 0.1, ..GroundPose::level(0.9) });
        let image = renderer.gray_view(&ground, &here);
        // Limited range, as a video has it.
        let mut limited = renderer.gray_view(&ground, &there);
        limited
            .samples_mut()
            .iter_mut()
            .for_each(|sample| *sample = (16 + u32::from(*sample) * 219 / 255) as u8);
        let [one, other] = [image, limited].map(|image| Pyramid::new(image, 3));
        let registered = |pyramid, pose| RegisteredImage { camera: &camera, pyramid, pose, mask: None };
        let likeness = Likeness::of(&registered(&one, here), &registered(&other, there)).unwrap();
        assert!(likeness.coarse < 0.003, "{likeness:?}");
    }

    #[test]
    fn the_f_distribution_has_its_tabulated_quantiles() {
        // M. Abramowitz and I. Stegun, "Handbook of mathematical functions", 1964, table 26.9.
        for (quantile, above, below, probability) in [(4.53, 4, 6, 0.95), (3.35, 10, 8, 0.95)] {
            let found = f_distribution(quantile, above, below);
            assert!((found - probability).abs() < 2e-3, "{quantile} {found}");
        }
        assert!((f_distribution(1.0, 8, 8) - 0.5).abs() < 1e-12);
    }

    #[test]
    fn images_without_common_ground_are_not_compared() {
        let camera = Camera::new((320, 240), (250.0, 250.0), (160.5, 119.0), Distortion::None).unwrap();
        let pyramid = Pyramid::new(GrayImage::from_samples(320, 240, vec![100; 320 * 240]).unwrap(), 3);
        let at = |x_m: f64| RegisteredImage {
            camera: &camera,
            pyramid: &pyramid,
            pose: GroundPose { x_m, ..GroundPose::level(0.9) },
            mask: None,
        };
        assert!(Likeness::of(&at(0.0), &at(2.0)).is_none());
        assert!(Likeness::of(&at(0.0), &at(0.0)).is_some());
    }
}
