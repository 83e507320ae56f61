//! Tiles: square patches of a reference image, invariant to gain, offset and gradient of the
//! illumination.
//!
//! Samples are taken with cubic B-splines without prefilter: reference and image are smoothed
//! alike, at no cost, and the remaining interpolation bias is a tenth of that of bilinear or
//! Catmull–Rom interpolation, whose phase error is of third order in the frequency (P. Thévenaz, T.
//! Blu and M. Unser, "Interpolation revisited", 2000).

use super::plane::DensePlane;
use crate::camera::Camera;
use crate::geometry::Pixel;
use crate::motion::{GroundFromRay, GroundPatch, PatchWarp, ViewingPose};
use nalgebra::{Matrix2, Vector2};

/// Samples along the side of a tile: the size of a [`GroundPatch`].
pub(super) const SIDE: usize = 16;
/// Samples of a tile.
pub(super) const AREA: usize = SIDE * SIDE;

/// Effective number of samples of white noise in a tile's contrast and in its gradients, after
/// smoothing and removal of a plane: much of smoothed noise is of low frequency and part of the
/// plane.
pub(super) const CONTRAST_NOISE_SAMPLES: f64 = AREA as f64 - PLANE_NOISE_SAMPLES;
pub(super) const GRADIENT_NOISE_SAMPLES: f64 = AREA as f64 - 1.2;
/// Effective number of samples of noise that the plane removes, at any subpixel position of the
/// tile.
pub(super) const PLANE_NOISE_SAMPLES: f64 = 10.6;

/// From the first sample of a row or column to the centre.
const TO_CENTRE: f64 = (SIDE as f64 - 1.0) / 2.0;

type Samples = [f32; AREA];

/// A tile of the reference.
#[derive(Debug, Clone)]
pub(super) struct Tile {
    pub patch: GroundPatch,
    /// Its centre in the reference image.
    pub centre: Pixel,
    /// Samples without their best-fitting plane.
    contrast: Samples,
    /// Gradients along both sides, orthogonal to planes and to the contrast.
    gradient: [Samples; 2],
    /// Gauss–Newton Hessian: products of the gradients.
    pub hessian: Matrix2<f64>,
    /// Sum of the squared contrast.
    pub energy: f64,
}

/// Comparison of a tile with an image.
#[derive(Debug, Clone, Copy)]
pub(super) struct TileMatch {
    pub warp: PatchWarp,
    /// Product of the image with the tile's contrast.
    pub product: f64,
    /// Products of the image with the tile's gradients.
    pub slope: Vector2<f64>,
    /// Sum of the image's squared contrast.
    pub energy: f64,
    /// Noise variance of an image sample over that of a reference sample.
    pub noise: f64,
}

impl Tile {
    /// The tile with its first sample at (`left`, `top`), from samples up to one beyond it; `None`
    /// where it does not lie on ground.
    pub fn new(
        plane: &DensePlane,
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
        Some(Self { patch, centre, contrast, gradient, hessian: Matrix2::new(xx, xy, xy, yy), energy })
    }

    /// Centre of the tile with its first sample at (`left`, `top`).
    pub fn centre(plane: &DensePlane, (left, top): (usize, usize)) -> Pixel {
        let at = |first: usize| plane.pixel_of_sample(first as f64 + TO_CENTRE);
        Pixel::new(at(left), at(top))
    }

    /// Compares the tile with the image of a camera at `pose`; `None` unless it lies entirely in
    /// the image.
    pub fn compare(&self, camera: &Camera, pose: &ViewingPose, plane: &DensePlane) -> Option<TileMatch> {
        let warp = self.patch.warp(camera, pose)?;
        let mut samples = [0.0; AREA];
        sample(plane, &warp, &mut samples).map(|noise| {
            remove_plane(&mut samples);
            TileMatch {
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

/// Subtracts the best-fitting plane.
fn remove_plane(samples: &mut Samples) {
    let mean = samples.iter().sum::<f32>() / AREA as f32;
    samples.iter_mut().for_each(|sample| *sample -= mean);
    // Sum of the squared coordinates about the centre.
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

/// Samples a pyramid level under a warp and returns the noise ratio ([`TileMatch::noise`]); `None`
/// unless all it reads lies in the image.
fn sample(plane: &DensePlane, expected: &PatchWarp, samples: &mut Samples) -> Option<f64> {
    let linear = &expected.warp.linear;
    let position = expected.warp.position;
    let centre = Vector2::new(plane.sample_of_pixel(position.x), plane.sample_of_pixel(position.y));
    let extent = TO_CENTRE * Vector2::new(linear.row(0).abs().sum(), linear.row(1).abs().sum());
    // Also false for NaN.
    let inside = centre.x - extent.x >= 1.0
        && centre.y - extent.y >= 1.0
        && centre.x + extent.x < plane.width as f64 - 2.01
        && centre.y + extent.y < plane.height as f64 - 2.01;
    if !inside {
        return None;
    }
    // Single precision suffices within a tile, relative to a nearby corner.
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
    // Subpixel positions are equal over a tile, or mixed where it is rotated: a subset represents
    // all.
    let places = (0..AREA).step_by(NOISE_STEP).map(|at| Vector2::new((at % SIDE) as f32, (at / SIDE) as f32));
    let left =
        places.map(|place| first + linear * place).map(|place| noise_ratio(place.x) * noise_ratio(place.y));
    Some(f64::from(left.sum::<f32>()) / AREA.div_ceil(NOISE_STEP) as f64)
}

/// Stride of the subset for the noise ratio: odd, so that it is spread over the tile.
const NOISE_STEP: usize = 15;

/// Variance of white noise after the spline at a position along one axis, relative to that at
/// integer positions: 1 there, 0.92 halfway.
fn noise_ratio(place: f32) -> f32 {
    let squares = |weights: [f32; 4]| weights.iter().map(|weight| weight * weight).sum::<f32>();
    squares(weights(place - place.floor())) / squares(weights(0.0))
}

/// Cubic B-spline of the 4×4 samples from `first` on.
#[inline]
fn spline(plane: &DensePlane, first: usize, x: f32, y: f32) -> f32 {
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

/// Weights of the samples from one before to two after a position.
#[inline]
fn weights(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    let (t2, s2) = (t * t, s * s);
    [s2 * s / 6.0, (4.0 - 6.0 * t2 + 3.0 * t2 * t) / 6.0, (4.0 - 6.0 * s2 + 3.0 * s2 * s) / 6.0, t2 * t / 6.0]
}
