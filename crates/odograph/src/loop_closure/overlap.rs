//! The ground that two registered images show, and the logarithm of the ratio of their brightness.

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

/// Sides of the squares over which brightness is averaged, spots: samples of a view of
/// [`PlacesConfig::SPOTS`]. A cell is the unit in which the overlap is taken; the mapping between
/// the images is exact at its corners.
const FINE: usize = 2;
const CELL: usize = 8;

/// Range of brightness, gray levels, in which ratios are taken: below it they are noise, above it
/// saturated.
const DARKEST: f64 = 4.0;
const BRIGHTEST: f64 = 250.0;

/// The common ground, cell by cell of the first image.
#[derive(Debug, Clone)]
pub struct OverlapGrid {
    pub columns: usize,
    pub cells: Vec<Option<OverlapCell>>,
}

/// A square of [`CELL`] spots.
#[derive(Debug, Clone, Copy)]
pub struct OverlapCell {
    /// Logarithms of the ratios of brightness over its squares of [`FINE`] spots.
    pub ratios: [f64; GROUPS],
    /// What a black level adds to these, for [`USUAL`] gray levels.
    lifts: [f64; GROUPS],
    /// Differences of the second and fourth power of the distance from the optical axis.
    pub radial: [f64; 2],
    /// Difference of the places in the two images, as rays: what darkening adds whose centre is not
    /// the optical axis.
    pub shift: [f64; 2],
}

/// Squares of [`FINE`] spots in a cell.
pub const GROUPS: usize = (CELL / FINE) * (CELL / FINE);

/// The unit of a black level, gray levels, only for conditioning.
const USUAL: f64 = 100.0;

impl OverlapCell {
    /// The logarithm of the ratio of brightness.
    pub fn mean(&self) -> f64 {
        self.ratios.iter().sum::<f64>() / GROUPS as f64
    }

    /// What a black level adds to it, for [`USUAL`] gray levels.
    pub fn lift(&self) -> f64 {
        self.lifts.iter().sum::<f64>() / GROUPS as f64
    }

    /// What gain, the two terms of darker corners, and black level add.
    fn light(&self, lift: f64) -> Vector4<f64> {
        Vector4::new(1.0, self.radial[0], self.radial[1], lift)
    }

    pub fn residuals(&self, fitted: &Vector4<f64>) -> [f64; GROUPS] {
        std::array::from_fn(|i| self.ratios[i] - fitted.dot(&self.light(self.lifts[i])))
    }
}

/// Where a sample of one image lies in the other.
#[derive(Clone, Copy)]
struct GridNode {
    x: f64,
    y: f64,
    radial: [f64; 2],
    shift: [f64; 2],
}

/// The level of a pyramid whose samples are about a spot wide, and its step in pixels.
fn level(image: &RegisteredImage<'_>) -> (usize, f64) {
    let long_side = image.camera.width().max(image.camera.height()) as f64;
    let spot_px = long_side / PlacesConfig::SPOTS.0 as f64;
    let level = (spot_px.log2().round().max(0.0) as usize).min(image.pyramid.levels() - 1);
    (level, (1u64 << level) as f64)
}

impl OverlapGrid {
    pub fn new(one: &RegisteredImage<'_>, other: &RegisteredImage<'_>) -> Self {
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
            let shift = [ray.x - seen.x, ray.y - seen.y];
            is_ground.then_some(GridNode { x: found.x / step_there, y: found.y / step_there, radial, shift })
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
    pub fn fitted_light(&self) -> Option<Vector4<f64>> {
        let (mut normal, mut right) = (Matrix4::zeros(), Vector4::zeros());
        for cell in self.cells.iter().flatten() {
            let light = cell.light(cell.lift());
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
    let mean = |value: fn(&GridNode) -> [f64; 2]| {
        [0, 1].map(|k| 0.25 * corners.iter().map(|corner| value(corner)[k]).sum::<f64>())
    };
    let (radial, shift) = (mean(|corner| corner.radial), mean(|corner| corner.shift));
    let ratios = sums.map(|[here, there]| (here / there).ln());
    Some(OverlapCell { ratios, lifts: sums.map(|[_, there]| USUAL * all / there - 1.0), radial, shift })
}
