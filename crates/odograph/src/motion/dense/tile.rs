//! Tiles: the squares of samples into which a reference image is cut, each indifferent to gain, offset and slope of its light.
//!
//! Samples are taken with cubic B-splines and without the filter that would make them interpolate: reference and image are smoothed alike, which
//! costs nothing, and what is left of the bias at fractions of a sample is a tenth of that of bilinear or Catmull–Rom interpolation, whose
//! phases are wrong by the third power of the frequency (P. Thévenaz, T. Blu and M. Unser, "Interpolation revisited", 2000).

use super::plane::Plane;
use crate::camera::Camera;
use crate::geometry::Pixel;
use crate::motion::{GroundFromRay, GroundPatch, PatchWarp, ViewingPose};
use nalgebra::{Matrix2, Vector2};

/// Samples along the side of a tile: those for which [`GroundPatch`] is made.
pub(super) const SIDE: usize = 16;
/// Samples of a tile.
pub(super) const AREA: usize = SIDE * SIDE;

/// To how many samples' worth the noise of a tile comes, once smoothed and less a plane: of smoothed noise much is slow, and goes with the plane.
pub(super) const NOISE_OF_CONTRAST: f64 = AREA as f64 - NOISE_OF_PLANE;
pub(super) const NOISE_OF_GRADIENT: f64 = AREA as f64 - 1.2;
/// What the plane takes of it, wherever between the samples of the image the tile lies.
pub(super) const NOISE_OF_PLANE: f64 = 10.6;

/// From the first sample of a row or column to the centre.
const TO_CENTRE: f64 = (SIDE as f64 - 1.0) / 2.0;

type Samples = [f32; AREA];

/// A tile of the reference.
#[derive(Debug, Clone)]
pub(super) struct Tile {
    pub patch: GroundPatch,
    /// The samples less a plane of light.
    contrast: Samples,
    /// Derivatives along the two sides, orthogonal to planes of light and to the contrast.
    gradient: [Samples; 2],
    /// Products of the two derivatives.
    pub hessian: Matrix2<f64>,
    /// Sum of the squared contrast.
    pub energy: f64,
}

/// What a tile makes of an image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Look {
    pub warp: PatchWarp,
    /// Product of the image with the tile's contrast.
    pub product: f64,
    /// Products of the image with the tile's derivatives.
    pub slope: Vector2<f64>,
    /// Sum of the squares of the image's own contrast.
    pub energy: f64,
    /// The noise of a sample of the image, as a part of that of a sample of the reference: variances.
    pub noise: f64,
}

impl Tile {
    /// The tile whose first sample is at (`left`, `top`); `None` where it does not lie on ground. One sample around it is read.
    pub fn new(
        plane: &Plane,
        (left, top): (usize, usize),
        camera: &Camera,
        from: &GroundFromRay<'_>,
    ) -> Option<Self> {
        let centre = Self::centre(plane, (left, top));
        let patch = GroundPatch::new(camera, from, centre, plane.pixels_per_sample)?;
        let mut contrast = [0.0; AREA];
        let mut gradient = [[0.0; AREA]; 2];
        for j in 0..SIDE {
            for i in 0..SIDE {
                let at = j * SIDE + i;
                let row = |k: usize| {
                    let row = &plane.samples[(top + j + k - 1) * plane.width + left + i - 1..][..3];
                    [(row[0] + 4.0 * row[1] + row[2]) / 6.0, 0.5 * (row[2] - row[0])]
                };
                let [above, here, below] = [row(0), row(1), row(2)];
                contrast[at] = (above[0] + 4.0 * here[0] + below[0]) / 6.0;
                gradient[0][at] = (above[1] + 4.0 * here[1] + below[1]) / 6.0;
                gradient[1][at] = 0.5 * (below[0] - above[0]);
            }
        }
        remove_plane(&mut contrast);
        let energy = dot(&contrast, &contrast);
        for gradient in &mut gradient {
            remove_plane(gradient);
            let share = (dot(gradient, &contrast) / energy.max(1e-6)) as f32;
            gradient.iter_mut().zip(&contrast).for_each(|(g, c)| *g -= share * c);
        }
        let [x, y] = &gradient;
        let (xx, xy, yy) = (dot(x, x), dot(x, y), dot(y, y));
        Some(Self { patch, contrast, gradient, hessian: Matrix2::new(xx, xy, xy, yy), energy })
    }

    /// The middle of the tile whose first sample is at (`left`, `top`).
    pub fn centre(plane: &Plane, (left, top): (usize, usize)) -> Pixel {
        let at = |first: usize| plane.pixel_of_sample(first as f64 + TO_CENTRE);
        Pixel::new(at(left), at(top))
    }

    /// The tile as a camera at `pose` would have it, compared with the image; `None` where that is not all in the image.
    pub fn look(&self, camera: &Camera, pose: &ViewingPose, plane: &Plane) -> Option<Look> {
        let warp = self.patch.warp(camera, pose)?;
        let mut samples = [0.0; AREA];
        sample(plane, &warp, &mut samples).map(|noise| {
            remove_plane(&mut samples);
            Look {
                warp,
                noise,
                product: dot(&self.contrast, &samples),
                slope: Vector2::new(dot(&self.gradient[0], &samples), dot(&self.gradient[1], &samples)),
                energy: dot(&samples, &samples),
            }
        })
    }
}

fn dot(a: &Samples, b: &Samples) -> f64 {
    crate::image::simd::dot(a, b)
}

/// Takes off the plane that fits the samples best.
fn remove_plane(samples: &mut Samples) {
    let mean = samples.iter().sum::<f32>() / AREA as f32;
    samples.iter_mut().for_each(|sample| *sample -= mean);
    // The places along a side, about the middle: their squares sum up to this over a tile.
    let squares = (AREA * (AREA - 1)) as f32 / 12.0;
    let place = |i: usize| i as f32 - TO_CENTRE as f32;
    let (mut along, mut down) = (0.0, 0.0);
    for (j, row) in samples.chunks_exact(SIDE).enumerate() {
        along += row.iter().enumerate().map(|(i, sample)| place(i) * sample).sum::<f32>();
        down += place(j) * row.iter().sum::<f32>();
    }
    let (along, down) = (along / squares, down / squares);
    for (j, row) in samples.chunks_exact_mut(SIDE).enumerate() {
        row.iter_mut().enumerate().for_each(|(i, sample)| *sample -= along * place(i) + down * place(j));
    }
}

/// Samples a plane under a warp and says how much of the noise is left ([`Look::noise`]); `None` unless everything that is read lies in it.
fn sample(plane: &Plane, expected: &PatchWarp, samples: &mut Samples) -> Option<f64> {
    let linear = &expected.warp.linear;
    let position = expected.warp.position;
    let centre = Vector2::new(plane.sample_of_pixel(position.x), plane.sample_of_pixel(position.y));
    let extent = TO_CENTRE * Vector2::new(linear.row(0).abs().sum(), linear.row(1).abs().sum());
    // Not so either where a number is none.
    let inside = centre.x - extent.x >= 1.0
        && centre.y - extent.y >= 1.0
        && centre.x + extent.x < plane.width as f64 - 2.01
        && centre.y + extent.y < plane.height as f64 - 2.01;
    if !inside {
        return None;
    }
    // Within a tile single precision is enough, from a corner near it.
    let corner = Vector2::new((centre.x - extent.x).floor(), (centre.y - extent.y).floor());
    let begin = (corner.y as usize - 1) * plane.width + corner.x as usize - 1;
    let linear = linear.map(|entry| entry as f32);
    let first = (centre - corner).map(|entry| entry as f32) - linear * Vector2::repeat(TO_CENTRE as f32);
    for (j, row) in samples.chunks_exact_mut(SIDE).enumerate() {
        let start = first + linear.column(1) * j as f32;
        for (i, out) in row.iter_mut().enumerate() {
            let (x, y) = (start.x + linear[(0, 0)] * i as f32, start.y + linear[(1, 0)] * i as f32);
            let (x, y) = (x.max(0.0), y.max(0.0)); // rounding
            let (column, line) = (x as usize, y as usize);
            *out = spline(plane, begin + line * plane.width + column, x - column as f32, y - line as f32);
        }
    }
    // The samples have their places between those of the image from tile to tile, or, where it is turned, all over a tile: a few stand for all.
    let places = (0..AREA).step_by(NOISE_STEP).map(|at| Vector2::new((at % SIDE) as f32, (at / SIDE) as f32));
    let left =
        places.map(|place| first + linear * place).map(|place| noise_left(place.x) * noise_left(place.y));
    Some(f64::from(left.sum::<f32>()) / AREA.div_ceil(NOISE_STEP) as f64)
}

/// Of so many samples one is asked for its noise: odd, so that these are all over a tile.
const NOISE_STEP: usize = 15;

/// How much of the variance of white noise the spline leaves at a place along a side, as a part of what it leaves at whole ones: 1 there, 0.92 halfway.
fn noise_left(place: f32) -> f32 {
    let squares = |weights: [f32; 4]| weights.iter().map(|weight| weight * weight).sum::<f32>();
    squares(weights(place - place.floor())) / squares(weights(0.0))
}

/// The cubic B-spline of the four by four samples from `first` on.
#[inline]
fn spline(plane: &Plane, first: usize, x: f32, y: f32) -> f32 {
    let (across, down) = (weights(x), weights(y));
    let mut sums = [0.0f32; 4];
    for (j, weight) in down.iter().enumerate() {
        let row = &plane.samples[first + j * plane.width..][..4];
        for i in 0..4 {
            sums[i] += weight * row[i];
        }
    }
    (across[0] * sums[0] + across[1] * sums[1]) + (across[2] * sums[2] + across[3] * sums[3])
}

/// Of the samples from one before to two after a place.
#[inline]
fn weights(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    let (t2, s2) = (t * t, s * s);
    [s2 * s / 6.0, (4.0 - 6.0 * t2 + 3.0 * t2 * t) / 6.0, (4.0 - 6.0 * s2 + 3.0 * s2 * s) / 6.0, t2 * t / 6.0]
}
