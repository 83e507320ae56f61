//! The kernels that run on every sample, made wide. The only room of the library where `unsafe` may stand.
//!
//! Each kernel has one meaning, its scalar reference in [`scalar`], and gives the same bits on every machine:
//!
//! * most are their reference, compiled a second time for AVX2 and chosen at run time: the compiler widens the loops and never
//!   reorders or fuses operations on floating-point numbers. On 64-bit ARM it widens the reference itself, since every such processor
//!   has NEON;
//! * what the compiler cannot widen, or widens badly, is written by hand and held equal to its reference by tests: on x86-64 the sampling
//!   of patches and of frames that are laid on the ground or straightened, with its gathered loads, the sums over patches and the halving of
//!   rows (`avx2`, `avx512`, `wide` in [`ground`] and [`remap`]), on ARM the same but for patches that are only moved, and the sums of products
//!   besides (`neon`, here and in these two). No multiply-add is fused, and the order of additions is the reference's.
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

/// Side of a patch in samples. Even, so that a row fills whole SIMD registers; its centre lies between the middle samples.
pub const PATCH_SIDE: usize = 16;

/// The samples of a patch, row by row, in gray levels.
pub type Patch = [f32; PATCH_SIDE * PATCH_SIDE];

/// Where the samples of a patch lie in an image: sample (i, j) is at `first + i · along_row + j · along_column`, (x, y) in pixels.
#[derive(Debug, Clone, Copy)]
pub struct Grid {
    pub first: [f64; 2],
    pub along_row: [f64; 2],
    pub along_column: [f64; 2],
}

/// The appearance of a patch, in what Lucas–Kanade multiplies with an image: contrast and gradients along x and y.
#[derive(Debug, Clone)]
#[repr(align(32))]
pub struct Appearance {
    pub contrast: Patch,
    pub gradient_x: Patch,
    pub gradient_y: Patch,
}

impl Appearance {
    /// All zero.
    pub const ZERO: Self = {
        let zero = [0.0; PATCH_SIDE * PATCH_SIDE];
        Self { contrast: zero, gradient_x: zero, gradient_y: zero }
    };
}

/// What the hand-written sampling needs: the processor's AVX2 or NEON, and an image whose offsets fit into 32 bits.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
fn samples_wide(image: &GrayImage) -> bool {
    #[cfg(target_arch = "x86_64")]
    let is_here = is_x86_feature_detected!("avx2");
    #[cfg(target_arch = "aarch64")]
    let is_here = is_aarch64_feature_detected!("neon");
    is_here && i32::try_from(image.samples().len()).is_ok()
}

/// On which of so many rows of the image (`choices`, rising) `count` neighbours along a row of the grid lie wherever they are in it, with the samples
/// below them, where `chunk` bytes of a row hold them with the samples to their right, and where all the chunks that begin at their first column and
/// row are inside the image. `None` where none is enough: the grid is turned far, is wide, or is at the very end of the image.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
fn rows_about_neighbours(
    image: &GrayImage,
    grid: &Grid,
    count: usize,
    chunk: usize,
    choices: &[usize],
) -> Option<usize> {
    let [columns, lines] = grid.along_row.map(|step| (count - 1) as f64 * step.abs());
    // With the neighbour below or to the right, one more for where they lie between samples, and rounding.
    let rows = *choices.iter().find(|rows| lines < **rows as f64 - 2.01)?;
    let across = (PATCH_SIDE - 1) as f64;
    let ends = |axis: usize| {
        let [row, column] = [grid.along_row[axis] * across, grid.along_column[axis] * across];
        let first = grid.first[axis];
        (first + row.min(0.0) + column.min(0.0), first + row.max(0.0) + column.max(0.0))
    };
    let (x, y) = (ends(0), ends(1));
    // Not so either where a number is not one.
    let fits = columns < chunk as f64 - 2.1 && x.0 > -0.5 && y.0 > -0.5 && x.1 < 1e6 && y.1 < 1e6;
    // One row and one column more than needed, for rounding.
    let end = || (y.1 as usize + rows) * image.width() + x.1 as usize + 1 + chunk;
    (fits && end() <= image.samples().len()).then_some(rows)
}

/// Makes of a scalar reference a kernel that uses AVX2 where the processor has it; of `neon::name` one that is written by hand for NEON.
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
                    // SAFETY: the processor has AVX2 and counts bits, which is all that `wide` asks for.
                    return unsafe { wide($($argument),*) };
                }
            }
            scalar::$name($($argument),*)
        }
    };
}

/// A grid that is only moved: all its samples lie at the same place between those of the image, which are known without looking for each.
#[derive(Debug, Clone, Copy)]
pub struct Shift {
    left: usize,
    top: usize,
    fx: f32,
    fy: f32,
}

impl Shift {
    /// The grid as a shift, where it is one; inside the image as far as the grid is, up to rounding.
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

/// Samples an image bilinearly on a grid.
///
/// The grid must lie inside the image: 0 ≤ x ≤ width − 1 and 0 ≤ y ≤ height − 1 up to rounding. Elsewhere the values mean nothing (nothing
/// outside the image is read). Panics where the image is smaller than 2x2.
pub fn sample_patch(image: &GrayImage, grid: &Grid, samples: &mut Patch) {
    assert!(image.width() >= 2 && image.height() >= 2, "a patch is sampled between four samples");
    if let Some(shift) = Shift::of(image, grid) {
        return sample_shifted(image, &shift, samples);
    }
    #[cfg(target_arch = "x86_64")]
    if let Some(rows) = avx512::rows(image, grid).filter(|_| avx512::is_here()) {
        // SAFETY: the processor has what it needs.
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
    /// [`sample_patch`] of a grid that is only moved.
    sample_shifted(image: &GrayImage, shift: &Shift, samples: &mut Patch)
}

widened! {
    /// [`sample_and_multiply`] of a grid that is only moved.
    multiply_shifted(
        image: &GrayImage, shift: &Shift, appearance: &Appearance, samples: &mut Patch,
    ) -> [f64; 3]
}

/// [`sample_patch`], and the products of the samples with contrast, gradient along x and gradient along y (see [`dot`]).
pub fn sample_and_multiply(
    image: &GrayImage,
    grid: &Grid,
    appearance: &Appearance,
    samples: &mut Patch,
) -> [f64; 3] {
    assert!(image.width() >= 2 && image.height() >= 2, "a patch is sampled between four samples");
    if let Some(shift) = Shift::of(image, grid) {
        #[cfg(target_arch = "x86_64")]
        if avx512::is_here() {
            // SAFETY: the processor has what it needs.
            return unsafe { avx512::multiply_shifted(image, &shift, appearance, samples) };
        }
        return multiply_shifted(image, &shift, appearance, samples);
    }
    #[cfg(target_arch = "x86_64")]
    if let Some(rows) = avx512::rows(image, grid).filter(|_| avx512::is_here()) {
        // SAFETY: the processor has what it needs.
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
    /// The sum of products of two patches. Sixteen running sums, one a column, added in the end.
    neon::dot(a: &Patch, b: &Patch) -> f64
}

widened! {
    /// The mean of a patch and the sum of the squared differences from it.
    neon::mean_and_energy(samples: &Patch) -> (f64, f64)
}

/// Sums over a patch of samples, of their central differences along x and y in half gray levels per pixel, and of the products of these.
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

/// What is taken off samples and gradients to make them orthogonal to constants, and the gradients to the contrast: their means, and then
/// the gradients' shares of the contrast.
#[derive(Debug, Clone, Copy)]
pub struct Orthogonal {
    pub mean: f32,
    pub mean_x: f32,
    pub mean_y: f32,
    pub share_x: f32,
    pub share_y: f32,
}

/// The sums over the patch whose first sample is (`left`, `top`). One sample around the patch is read; panics where that is outside.
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

/// Sums over a patch of its second differences along x and along y (one of each pair), and of their products with samples and with central differences along x and y
/// in half gray levels per pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BendSums {
    pub bend: [i32; 2],
    pub sample_bend: [i32; 2],
    pub x_bend: [i32; 2],
    pub y_bend: [i32; 2],
}

/// The sums over the patch whose first sample is (`left`, `top`). One sample around the patch is read; panics where that is outside.
pub fn bend_sums(image: &GrayImage, left: usize, top: usize) -> BendSums {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { avx2::bend_sums(image, left, top) };
    }
    scalar::bend_sums(image, left, top)
}

widened! {
    /// Contrast and central differences (gray levels per pixel) of the patch whose first sample is (`left`, `top`), less `less`. One sample
    /// around the patch is read; panics where that is outside.
    write_appearance(image: &GrayImage, left: usize, top: usize, less: &Orthogonal, appearance: &mut Appearance)
}

/// Sums over a patch, (x, y) being a sample's place from the middle, (g, h) its gradients as they are matched and (p, q) as they are: how the patch answers to
/// what is not the same all over it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Moments {
    /// Of g p, g q, h p and h q, each times x x, x y and y y.
    pub squares: [[f64; 3]; 4],
    /// Of g and h times the gray level, each times x and y.
    pub light: [[f64; 2]; 2],
}

widened! {
    /// The moments of a patch that was written with `less`.
    moments(appearance: &Appearance, less: &Orthogonal) -> Moments
}

widened! {
    /// The binomial 1 4 6 4 1 across five rows, `sums` as long as each of them.
    blur_rows(a: &[u8], b: &[u8], c: &[u8], d: &[u8], e: &[u8], sums: &mut [u16])
}

/// The binomial 1 4 6 4 1 along a row of [`blur_rows`], of every second place, rounded to gray levels: output x is about input 2 x + 2.
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
    /// Scharr gradients of the middle one of three rows, in 1/32 gray levels per pixel; the first and last of a row stay as they are.
    scharr_gradients(above: &[u8], here: &[u8], below: &[u8], x: &mut [i16], y: &mut [i16])
}

widened! {
    /// Adds the products of a row of gradients to the totals and takes those of an older row off.
    roll_products(
        x: &[i16], y: &[i16], old_x: &[i16], old_y: &[i16],
        total_xx: &mut [i32], total_xy: &mut [i32], total_yy: &mut [i32],
    )
}

widened! {
    /// The smaller eigenvalue of the gradient matrix at each place of a row: its three entries are the sums of the columns
    /// `x .. x + window`, times `scale`. Panics unless there are as many columns as `out` and the window need.
    smaller_eigenvalues_of_sums(
        xx: &[i32], xy: &[i32], yy: &[i32], window: usize, scale: f32, out: &mut [f32]
    )
}

widened! {
    /// Adds the products of a row of gradients, weighted.
    add_weighted_products(
        x: &[i16], y: &[i16], weight: f32, xx: &mut [f32], xy: &mut [f32], yy: &mut [f32],
    )
}

widened! {
    /// The smaller eigenvalue of the gradient matrix at each place of a row: its three entries are the sums of the columns
    /// `x .. x + weights.len()`, weighted. Panics unless there are as many columns as `out` and the window need.
    smaller_eigenvalues(xx: &[f32], xy: &[f32], yy: &[f32], weights: &[f32], out: &mut [f32])
}

widened! {
    /// Marks with 1 the places of the middle row that are at least `least`, above the neighbours read before them and not below those
    /// read after; with 0 the others, and the ends.
    mark_local_maxima(above: &[f32], here: &[f32], below: &[f32], least: f32, marks: &mut [u8])
}

widened! {
    /// In how many bits each of `others` differs from `one`; as many as there are in the shorter of `others` and `out`.
    differing_bits(one: &[u64; 4], others: &[[u64; 4]], out: &mut [u32])
}

widened! {
    /// In how many bits the two of each pair differ; as many as there are in the shorter of `pairs` and `out`.
    differing_bits_of_pairs(pairs: &[[[u64; 4]; 2]], out: &mut [u32])
}
