//! How two registered images of the ground differ: by noise, or by what is peculiar to a place.
//!
//! On ground that repeats, such as tiles or a printed floor, the corners of a place are found at
//! its lookalikes too. What remains when registered images are divided by each other tells them
//! apart: the repeating part cancels, at every period alike. Over one place noise remains, whose
//! mean over a square falls with the side of the square. Over a lookalike the differences of grain,
//! stains and wear remain too, whose mean falls much less.

use crate::camera::Camera;
use crate::fixed_pattern::ImageMask;
use crate::geometry::{GroundPose, Pixel};
use crate::image::{GrayImage, Pyramid};
use crate::place_recognition::PlacesConfig;
use nalgebra::{Matrix3, Vector3};

/// An image of the ground with the pose of its camera.
#[derive(Debug, Clone, Copy)]
pub struct RegisteredImage<'a> {
    pub camera: &'a Camera,
    pub pyramid: &'a Pyramid,
    pub pose: GroundPose,
    pub mask: Option<&'a ImageMask>,
}

/// How two registered images of the ground differ: root mean squares of the logarithm of the ratio
/// of their brightness, without a common gain and the darkening towards the corners of the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Likeness {
    /// Over squares of [`FINE`] spots.
    fine: f64,
    /// Over squares of [`COARSE`] spots.
    coarse: f64,
}

/// Sides of the squares over which brightness is averaged, spots: samples of a view of
/// [`PlacesConfig::SPOTS`]. A cell is the unit in which the overlap is taken; the mapping between
/// the images is exact at its corners.
const FINE: usize = 2;
const CELL: usize = 8;
const COARSE: usize = 16;

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
            let light = fitted.dot(&cell.light());
            fine += cell.ratios.iter().map(|ratio| (ratio - light).powi(2)).sum::<f64>();
            groups += cell.ratios.len();
        }
        let (mut coarse, mut squares) = (0.0, 0usize);
        for row in (0..cells.rows.saturating_sub(1)).step_by(COARSE / CELL) {
            for column in (0..cells.columns.saturating_sub(1)).step_by(COARSE / CELL) {
                let at = |i: usize| cells.cells[(row + i / 2) * cells.columns + column + i % 2].as_ref();
                let [Some(a), Some(b), Some(c), Some(d)] = [at(0), at(1), at(2), at(3)] else { continue };
                let off = [a, b, c, d].map(|cell| cell.mean() - fitted.dot(&cell.light()));
                coarse += (0.25 * off.iter().sum::<f64>()).powi(2);
                squares += 1;
            }
        }
        (squares >= MIN_SQUARES)
            .then(|| Self { fine: (fine / groups as f64).sqrt(), coarse: (coarse / squares as f64).sqrt() })
    }

    /// Whether the images differ by little more than noise.
    pub fn is_of_one_place(&self) -> bool {
        self.coarse <= MAX_DIFFERENCE && self.coarse <= MAX_STRUCTURE * self.fine
    }
}

/// The common ground, cell by cell.
struct OverlapGrid {
    columns: usize,
    rows: usize,
    cells: Vec<Option<OverlapCell>>,
}

/// A square of [`CELL`] spots.
struct OverlapCell {
    /// Logarithms of the ratios of brightness over its squares of [`FINE`] spots.
    ratios: [f64; (CELL / FINE) * (CELL / FINE)],
    /// Differences of the second and fourth power of the distance from the optical axis.
    radial: [f64; 2],
}

impl OverlapCell {
    fn mean(&self) -> f64 {
        self.ratios.iter().sum::<f64>() / self.ratios.len() as f64
    }

    fn light(&self) -> Vector3<f64> {
        Vector3::new(1.0, self.radial[0], self.radial[1])
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
        Self { columns, rows, cells: (0..columns * rows).map(cell).collect() }
    }

    /// Gain and darkening towards the corners, by least squares.
    fn fitted_light(&self) -> Option<Vector3<f64>> {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for cell in self.cells.iter().flatten() {
            let light = cell.light();
            normal += light * light.transpose();
            right += light * cell.mean();
        }
        // Images from nearly the same place do not show the darkening, and need no correction.
        let weak = Matrix3::from_diagonal(&Vector3::new(0.0, 1e-3, 1e-3));
        (normal + weak).try_inverse().map(|inverse| inverse * right)
    }
}

/// The cell of an image with its first sample at (`left`, `top`), compared with the other image.
fn compared(
    (here, left, top): (&GrayImage, usize, usize),
    there: &GrayImage,
    corners: &[GridNode; 4],
) -> Option<OverlapCell> {
    const GROUPS: usize = CELL / FINE;
    let mut sums = [[0.0f64; 2]; GROUPS * GROUPS];
    let [a, b, c, d] = corners;
    for j in 0..CELL {
        let v = j as f64 / CELL as f64;
        let between = |above: f64, below: f64| above + v * (below - above);
        let (x, y) = (between(a.x, c.x), between(a.y, c.y));
        let per_sample = 1.0 / CELL as f64;
        let (dx, dy) = (per_sample * (between(b.x, d.x) - x), per_sample * (between(b.y, d.y) - y));
        let row = &here.row(top + j)[left..left + CELL];
        for (i, &sample) in row.iter().enumerate() {
            let sums = &mut sums[j / FINE * GROUPS + i / FINE];
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
    Some(OverlapCell { ratios: sums.map(|[here, there]| (here / there).ln()), radial })
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
        }
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
