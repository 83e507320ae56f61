//! SIMD kernels for per-sample loops. The only module of the library that may contain `unsafe`.
//!
//! Each kernel is defined by its scalar reference in [`scalar`] and is bit-identical to it on every
//! machine:
//!
//! * Most kernels are their reference, compiled a second time for AVX2 and selected at run time.
//!   The compiler vectorises the loops and never reorders or fuses floating-point operations. On
//!   64-bit ARM it vectorises the reference itself, since every such processor has NEON.
//! * Kernels that the compiler vectorises badly or not at all are hand-written and tested against
//!   their reference. On x86-64 these are patch sampling, orthorectification and rectification with
//!   their gathered loads, the sums over patches and the decimation of rows (`avx2`, `avx512`,
//!   `wide` in [`ground`] and [`remap`]). On ARM they are the same except for the sampling of
//!   purely translated patches, and in addition the sums of products (`neon`, here and in these two
//!   modules). Multiply-adds are never fused, and the order of additions is the reference's.
#![allow(unsafe_code)]

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
pub mod ground;
#[cfg(target_arch = "aarch64")]
mod neon;
pub mod remap;
mod scalar;
#[cfg(test)]
mod tests;

use super::GrayImage;
#[cfg(target_arch = "aarch64")]
use std::arch::is_aarch64_feature_detected;

/// Side length of a patch, samples. Even, so that a row fills whole SIMD registers; the centre lies
/// between the middle samples.
pub const PATCH_SIDE: usize = 16;

/// The samples of a patch in row order, gray levels.
pub type Patch = [f32; PATCH_SIDE * PATCH_SIDE];

/// Sampling grid of a patch: sample (i, j) is at `first + i · along_row + j · along_column`, (x, y)
/// in pixels.
#[derive(Debug, Clone, Copy)]
pub struct Grid {
    pub first: [f64; 2],
    pub along_row: [f64; 2],
    pub along_column: [f64; 2],
}

/// Template of a patch for Lucas–Kanade tracking: contrast and gradients along x and y, the factors
/// of the products with an image.
#[derive(Debug, Clone)]
#[repr(align(32))]
pub struct TemplateSamples {
    pub contrast: Patch,
    pub gradient_x: Patch,
    pub gradient_y: Patch,
}

impl TemplateSamples {
    /// All zero.
    pub const ZERO: Self = {
        let zero = [0.0; PATCH_SIDE * PATCH_SIDE];
        Self { contrast: zero, gradient_x: zero, gradient_y: zero }
    };
}

/// Whether hand-written sampling is available: AVX2 or NEON, and an image whose offsets fit 32
/// bits.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
fn samples_wide(image: &GrayImage) -> bool {
    #[cfg(target_arch = "x86_64")]
    let is_here = is_x86_feature_detected!("avx2");
    #[cfg(target_arch = "aarch64")]
    let is_here = is_aarch64_feature_detected!("neon");
    is_here && i32::try_from(image.samples().len()).is_ok()
}

/// The number of image rows, one of `choices` (ascending), that covers `count` neighbouring samples
/// along a row of the grid together with the samples below them, at any position in the grid. In
/// addition, `chunk` bytes of an image row must contain them with their right neighbours, and all
/// chunks that begin at their first column and row must lie inside the image. `None` where no
/// choice suffices: the grid is strongly rotated, wide, or at the very end of the image.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
fn rows_about_neighbours(
    image: &GrayImage,
    grid: &Grid,
    count: usize,
    chunk: usize,
    choices: &[usize],
) -> Option<usize> {
    let [columns, lines] = grid.along_row.map(|step| (count - 1) as f64 * step.abs());
    // Includes the neighbour below or to the right, one more for sub-pixel positions, and rounding.
    let rows = *choices.iter().find(|rows| lines < **rows as f64 - 2.01)?;
    let across = (PATCH_SIDE - 1) as f64;
    let ends = |axis: usize| {
        let [row, column] = [grid.along_row[axis] * across, grid.along_column[axis] * across];
        let first = grid.first[axis];
        (first + row.min(0.0) + column.min(0.0), first + row.max(0.0) + column.max(0.0))
    };
    let (x, y) = (ends(0), ends(1));
    // NaN makes this false as well.
    let fits = columns < chunk as f64 - 2.1 && x.0 > -0.5 && y.0 > -0.5 && x.1 < 1e6 && y.1 < 1e6;
    // One more row and column than needed, for rounding.
    let end = || (y.1 as usize + rows) * image.width() + x.1 as usize + 1 + chunk;
    (fits && end() <= image.samples().len()).then_some(rows)
}

/// Defines a kernel that runs its scalar reference compiled for AVX2 where available; with
/// `neon::name` also a hand-written one for NEON.
macro_rules! widened {
    ($(#[$doc:meta])* neon::$name:ident($($argument:ident: $kind:ty),* $(,)?) $(-> $result:ty)?) => {
        $(#[$doc])*
        pub fn $name($($argument: $kind),*) $(-> $result)? {
            #[cfg(target_arch = "aarch64")]
            if is_aarch64_feature_detected!("neon") {
                // SAFETY: the processor has NEON.
                return unsafe { neon::$name($($argument),*) };
            }
            widened! { $name($($argument: $kind),*) $(-> $result)? }
            $name($($argument),*)
        }
    };
    ($(#[$doc:meta])* $name:ident($($argument:ident: $kind:ty),* $(,)?) $(-> $result:ty)?) => {
        $(#[$doc])*
        pub fn $name($($argument: $kind),*) $(-> $result)? {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,popcnt")]
                fn wide($($argument: $kind),*) $(-> $result)? {
                    scalar::$name($($argument),*)
                }
                if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("popcnt") {
                    // SAFETY: the processor has AVX2 and POPCNT, the only features `wide` requires.
                    return unsafe { wide($($argument),*) };
                }
            }
            scalar::$name($($argument),*)
        }
    };
}

/// A purely translated grid: all samples have the same sub-pixel offset, so their positions are
/// implicit.
#[derive(Debug, Clone, Copy)]
pub struct Shift {
    left: usize,
    top: usize,
    fx: f32,
    fy: f32,
}

impl Shift {
    /// The grid as a translation; `None` where it is not one. Inside the image wherever the grid
    /// is, up to rounding.
    fn of(image: &GrayImage, grid: &Grid) -> Option<Self> {
        let still = grid.along_row == [1.0, 0.0] && grid.along_column == [0.0, 1.0];
        let room = |size: usize| size.checked_sub(PATCH_SIDE + 1);
        let (right, bottom) = (room(image.width())?, room(image.height())?);
        still.then(|| {
            let [x, y] = grid.first;
            let (left, top) = ((x as usize).min(right), (y as usize).min(bottom));
            Self { left, top, fx: (x - left as f64) as f32, fy: (y - top as f64) as f32 }
        })
    }
}

/// Samples an image on a grid by bilinear interpolation.
///
/// The grid must lie inside the image: 0 ≤ x ≤ width − 1 and 0 ≤ y ≤ height − 1, up to rounding.
/// Otherwise the values are unspecified, but nothing outside the image is read.
///
/// # Panics
///
/// Panics where the image is smaller than 2x2.
pub fn sample_patch(image: &GrayImage, grid: &Grid, samples: &mut Patch) {
    assert!(image.width() >= 2 && image.height() >= 2, "a patch is sampled between four samples");
    if let Some(shift) = Shift::of(image, grid) {
        return sample_shifted(image, &shift, samples);
    }
    #[cfg(target_arch = "x86_64")]
    if let Some(rows) = avx512::rows(image, grid).filter(|_| avx512::is_here()) {
        // SAFETY: `is_here` checked the required features.
        return unsafe { avx512::sample_patch(image, grid, rows, samples) };
    }
    #[cfg(target_arch = "x86_64")]
    if samples_wide(image) {
        // SAFETY: the processor has AVX2.
        return unsafe { avx2::sample_patch(image, grid, samples) };
    }
    #[cfg(target_arch = "aarch64")]
    if samples_wide(image) {
        // SAFETY: the processor has NEON.
        return unsafe { neon::sample_patch(image, grid, samples) };
    }
    scalar::sample_patch(image, grid, samples);
}

widened! {
    /// [`sample_patch`] of a purely translated grid.
    sample_shifted(image: &GrayImage, shift: &Shift, samples: &mut Patch)
}

widened! {
    /// [`sample_and_multiply`] of a purely translated grid.
    multiply_shifted(
        image: &GrayImage, shift: &Shift, appearance: &TemplateSamples, samples: &mut Patch,
    ) -> [f64; 3]
}

/// [`sample_patch`], and the products of the samples with contrast, x gradient and y gradient (see
/// [`dot`]).
pub fn sample_and_multiply(
    image: &GrayImage,
    grid: &Grid,
    appearance: &TemplateSamples,
    samples: &mut Patch,
) -> [f64; 3] {
    assert!(image.width() >= 2 && image.height() >= 2, "a patch is sampled between four samples");
    if let Some(shift) = Shift::of(image, grid) {
        #[cfg(target_arch = "x86_64")]
        if avx512::is_here() {
            // SAFETY: `is_here` checked the required features.
            return unsafe { avx512::multiply_shifted(image, &shift, appearance, samples) };
        }
        return multiply_shifted(image, &shift, appearance, samples);
    }
    #[cfg(target_arch = "x86_64")]
    if let Some(rows) = avx512::rows(image, grid).filter(|_| avx512::is_here()) {
        // SAFETY: `is_here` checked the required features.
        return unsafe { avx512::sample_and_multiply(image, grid, rows, appearance, samples) };
    }
    #[cfg(target_arch = "x86_64")]
    if samples_wide(image) {
        // SAFETY: the processor has AVX2.
        return unsafe { avx2::sample_and_multiply(image, grid, appearance, samples) };
    }
    #[cfg(target_arch = "aarch64")]
    if samples_wide(image) {
        // SAFETY: the processor has NEON.
        return unsafe { neon::sample_and_multiply(image, grid, appearance, samples) };
    }
    scalar::sample_and_multiply(image, grid, appearance, samples)
}

widened! {
    /// Scalar product of two patches. Sixteen partial sums, one per column, are added at the end.
    neon::dot(a: &Patch, b: &Patch) -> f64
}

widened! {
    /// The plane that fits a patch best, and the sum of the squared deviations from it.
    plane_and_energy(samples: &Patch) -> (Plane, f64)
}

/// Gray levels that change linearly over a patch: uneven illumination.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Plane {
    /// At the centre, gray levels.
    pub mean: f64,
    /// Growth along x and y, gray levels per sample.
    pub slope: [f64; 2],
}

/// Sum of the squared distances of a patch's samples from its centre along one axis.
pub const SQUARED_DISTANCES: f64 = (AREA * (PATCH_SIDE * PATCH_SIDE - 1)) as f64 / 12.0;

const AREA: usize = PATCH_SIDE * PATCH_SIDE;

impl Plane {
    /// The plane with least squared distances from samples with these sums: their own, and weighted
    /// with the coordinates x and y.
    pub fn of_sums(sum: f64, weighted: [f64; 2]) -> Self {
        Self { mean: sum / AREA as f64, slope: weighted.map(|sum| sum / SQUARED_DISTANCES) }
    }

    /// The same without its mean.
    pub fn sloping(&self) -> Self {
        Self { mean: 0.0, ..*self }
    }

    /// Its scalar product with another.
    pub fn dot(&self, other: &Self) -> f64 {
        let [[x, y], [other_x, other_y]] = [self.slope, other.slope];
        AREA as f64 * self.mean * other.mean + SQUARED_DISTANCES * (x * other_x + y * other_y)
    }
}

/// Sums over a patch of the samples, and of their central differences along x and y in half gray
/// levels per pixel, each weighted with twice the coordinates x and y from the centre.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WeightedSums {
    pub sample: [i32; 2],
    pub x: [i32; 2],
    pub y: [i32; 2],
}

widened! {
    /// The weighted sums over the patch whose first sample is (`left`, `top`). Reads a border of
    /// one sample around the patch; panics where that is outside the image.
    weighted_sums(image: &GrayImage, left: usize, top: usize) -> WeightedSums
}

/// Sums over a patch of the samples, of their central differences along x and y in half gray levels
/// per pixel, and of all products of samples and differences.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PatchSums {
    pub sample: i32,
    pub x: i32,
    pub y: i32,
    pub sample_sample: i32,
    pub sample_x: i32,
    pub sample_y: i32,
    pub x_x: i32,
    pub x_y: i32,
    pub y_y: i32,
}

/// What makes a template and its gradients orthogonal to planes, and its gradients to its contrast:
/// the planes of samples and gradients, and then the projections of the gradients onto the
/// contrast.
#[derive(Debug, Clone, Copy)]
pub struct Orthogonal {
    /// Of the samples and of the gradients along x and y.
    pub planes: [Plane; 3],
    /// Of the gradients along x and y.
    pub shares: [f64; 2],
}

/// The sums over the patch whose first sample is (`left`, `top`). Reads a border of one sample
/// around the patch; panics where that is outside the image.
pub fn patch_sums(image: &GrayImage, left: usize, top: usize) -> PatchSums {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { avx2::patch_sums(image, left, top) };
    }
    #[cfg(target_arch = "aarch64")]
    if is_aarch64_feature_detected!("neon") {
        // SAFETY: the processor has NEON.
        return unsafe { neon::patch_sums(image, left, top) };
    }
    scalar::patch_sums(image, left, top)
}

widened! {
    /// Products of the second differences along x and along y of the patch whose first sample is
    /// (`left`, `top`) with the gradients of its template: along x with both gradients, then along
    /// y. Reads a border of one sample around the patch; panics where that is outside the image.
    bend_products(image: &GrayImage, left: usize, top: usize, appearance: &TemplateSamples) -> [[f64; 2]; 2]
}

widened! {
    /// Contrast and central differences (gray levels per pixel) of the patch whose first sample is
    /// (`left`, `top`), orthogonalised by `less`. Reads a border of one sample around the patch;
    /// panics where that is outside the image.
    write_appearance(image: &GrayImage, left: usize, top: usize, less: &Orthogonal, appearance: &mut TemplateSamples)
}

/// Spatial moments of a patch, which determine its response to displacement that varies over the
/// patch: sums of g p, g q, h p and h q, each times x x, x y and y y. (x, y) is the position of a
/// sample relative to the centre, (g, h) its orthogonalised gradient and (p, q) its raw gradient.
pub type Moments = [[f64; 3]; 4];

widened! {
    /// The moments of a template that was orthogonalised by `less`.
    moments(appearance: &TemplateSamples, less: &Orthogonal) -> Moments
}

widened! {
    /// Binomial filter 1 4 6 4 1 across five rows; `sums` is as long as each of them.
    blur_rows(a: &[u8], b: &[u8], c: &[u8], d: &[u8], e: &[u8], sums: &mut [u16])
}

/// Binomial filter 1 4 6 4 1 along a row of [`blur_rows`], decimated by two and rounded to gray
/// levels: output x is centred on input 2 x + 2.
///
/// # Panics
///
/// Panics unless there are at least `2 · out.len() + 3` sums.
pub fn blur_and_halve(sums: &[u16], out: &mut [u8]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { avx2::blur_and_halve(sums, out) };
    }
    #[cfg(target_arch = "aarch64")]
    if is_aarch64_feature_detected!("neon") {
        // SAFETY: the processor has NEON.
        return unsafe { neon::blur_and_halve(sums, out) };
    }
    scalar::blur_and_halve(sums, out);
}

widened! {
    /// Scharr gradients of the middle one of three rows, in 1/32 gray levels per pixel. The first
    /// and last element of a row are not written.
    scharr_gradients(above: &[u8], here: &[u8], below: &[u8], x: &mut [i16], y: &mut [i16])
}

widened! {
    /// Running sums: adds the gradient products of a new row to the totals and subtracts those of
    /// the oldest row.
    roll_products(
        x: &[i16], y: &[i16], old_x: &[i16], old_y: &[i16],
        total_xx: &mut [i32], total_xy: &mut [i32], total_yy: &mut [i32],
    )
}

widened! {
    /// Minimum eigenvalue of the structure tensor at each position of a row. Its three entries are
    /// the sums of the columns `x .. x + window`, times `scale`. Panics where there are fewer
    /// columns than `out` and the window need.
    smaller_eigenvalues_of_sums(
        xx: &[i32], xy: &[i32], yy: &[i32], window: usize, scale: f32, out: &mut [f32]
    )
}

widened! {
    /// Adds the weighted gradient products of a row.
    add_weighted_products(
        x: &[i16], y: &[i16], weight: f32, xx: &mut [f32], xy: &mut [f32], yy: &mut [f32],
    )
}

widened! {
    /// Minimum eigenvalue of the structure tensor at each position of a row. Its three entries are
    /// the weighted sums of the columns `x .. x + weights.len()`. Panics where there are fewer
    /// columns than `out` and the window need.
    smaller_eigenvalues(xx: &[f32], xy: &[f32], yy: &[f32], weights: &[f32], out: &mut [f32])
}

widened! {
    /// Local maxima of the middle row: marks with 1 the positions that are at least `least`,
    /// greater than the neighbours before them in reading order and not less than those after. All
    /// others, and both ends, are 0.
    mark_local_maxima(above: &[f32], here: &[f32], below: &[f32], least: f32, marks: &mut [u8])
}

widened! {
    /// Sum of the squared differences of two rows; as many as the shorter one has.
    squared_differences(a: &[u8], b: &[u8]) -> u64
}

widened! {
    /// Hamming distances of `one` to each of `others`; as many as the shorter of `others` and
    /// `out`.
    differing_bits(one: &[u64; 4], others: &[[u64; 4]], out: &mut [u32])
}

widened! {
    /// Hamming distance of each pair; as many as the shorter of `pairs` and `out`.
    differing_bits_of_pairs(pairs: &[[[u64; 4]; 2]], out: &mut [u32])
}
