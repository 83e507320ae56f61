//! Scalar references that define the kernels; also the fallback without SIMD.
//!
//! `inline(always)`, so that the copies compiled for wider registers contain these bodies.

use super::{
    Grid, Moments, Orthogonal, PATCH_SIDE, Patch, PatchSums, Plane, Shift, TemplateSamples, WeightedSums,
};
use crate::image::GrayImage;

/// Number of partial sums of a product. It is part of the definition, since it fixes the order of
/// additions.
const SUMS: usize = PATCH_SIDE;

#[inline(always)]
pub fn sample_patch(image: &GrayImage, grid: &Grid, samples: &mut Patch) {
    let (all, width) = (image.samples(), image.width());
    let last = all.len() - width - 2;
    let (dx, dy) = (grid.along_row[0] as f32, grid.along_row[1] as f32);
    for (j, row) in samples.chunks_exact_mut(PATCH_SIDE).enumerate() {
        let (x0, y0) = row_start(grid, j);
        for (i, sample) in row.iter_mut().enumerate() {
            let (x, y) = (x0 + dx * i as f32, y0 + dy * i as f32);
            let (column, line) = (x as usize, y as usize);
            let (fx, fy) = (x - column as f32, y - line as f32);
            let at = (line.saturating_mul(width).saturating_add(column)).min(last);
            let between = |left: u8, right: u8| f32::from(left) + fx * (f32::from(right) - f32::from(left));
            let upper = between(all[at], all[at + 1]);
            let lower = between(all[at + width], all[at + width + 1]);
            *sample = upper + fy * (lower - upper);
        }
    }
}

/// Position of the first sample of row `j` of a grid.
#[inline(always)]
pub fn row_start(grid: &Grid, j: usize) -> (f32, f32) {
    let at = |axis: usize| (grid.first[axis] + grid.along_column[axis] * j as f64) as f32;
    (at(0), at(1))
}

#[inline(always)]
pub fn sample_and_multiply(
    image: &GrayImage,
    grid: &Grid,
    appearance: &TemplateSamples,
    samples: &mut Patch,
) -> [f64; 3] {
    sample_patch(image, grid, samples);
    let mut sums = [[0.0f32; PATCH_SIDE]; 3];
    for (j, row) in samples.as_chunks::<PATCH_SIDE>().0.iter().enumerate() {
        add_products(&mut sums, appearance, j, row);
    }
    sums.map(total)
}

/// Adds the products of row `j` of a patch to partial sums, one per column.
#[inline(always)]
fn add_products(
    sums: &mut [[f32; PATCH_SIDE]; 3],
    appearance: &TemplateSamples,
    j: usize,
    row: &[f32; PATCH_SIDE],
) {
    let factors = [&appearance.contrast, &appearance.gradient_x, &appearance.gradient_y];
    for (sums, factor) in sums.iter_mut().zip(factors) {
        let factor = &factor.as_chunks::<PATCH_SIDE>().0[j];
        for i in 0..PATCH_SIDE {
            sums[i] += factor[i] * row[i];
        }
    }
}

#[inline(always)]
pub fn sample_shifted(image: &GrayImage, shift: &Shift, samples: &mut Patch) {
    let mut upper = between_columns(image, shift, 0);
    for (j, row) in samples.as_chunks_mut::<PATCH_SIDE>().0.iter_mut().enumerate() {
        let lower = between_columns(image, shift, j + 1);
        for i in 0..PATCH_SIDE {
            row[i] = upper[i] + shift.fy * (lower[i] - upper[i]);
        }
        upper = lower;
    }
}

#[inline(always)]
pub fn multiply_shifted(
    image: &GrayImage,
    shift: &Shift,
    appearance: &TemplateSamples,
    samples: &mut Patch,
) -> [f64; 3] {
    let mut sums = [[0.0f32; PATCH_SIDE]; 3];
    let mut upper = between_columns(image, shift, 0);
    for (j, row) in samples.as_chunks_mut::<PATCH_SIDE>().0.iter_mut().enumerate() {
        let lower = between_columns(image, shift, j + 1);
        for i in 0..PATCH_SIDE {
            row[i] = upper[i] + shift.fy * (lower[i] - upper[i]);
        }
        add_products(&mut sums, appearance, j, row);
        upper = lower;
    }
    sums.map(total)
}

/// Row `j` of a translated patch, interpolated along x only.
#[inline(always)]
fn between_columns(image: &GrayImage, shift: &Shift, j: usize) -> [f32; PATCH_SIDE] {
    let row: &[u8] = &image.row(shift.top + j)[shift.left..][..PATCH_SIDE + 1];
    let mut between = [0.0; PATCH_SIDE];
    for i in 0..PATCH_SIDE {
        let (left, right) = (f32::from(row[i]), f32::from(row[i + 1]));
        between[i] = left + shift.fx * (right - left);
    }
    between
}

/// Total of the partial sums by pairwise summation: the second half is added to the first until one
/// is left.
#[inline(always)]
pub fn total(sums: [f32; SUMS]) -> f64 {
    let eight: [f64; 8] = std::array::from_fn(|i| f64::from(sums[i]) + f64::from(sums[i + 8]));
    let four: [f64; 4] = std::array::from_fn(|i| eight[i] + eight[i + 4]);
    (four[0] + four[2]) + (four[1] + four[3])
}

#[inline(always)]
pub fn dot(a: &Patch, b: &Patch) -> f64 {
    let mut sums = [0.0f32; SUMS];
    for (a, b) in a.as_chunks::<SUMS>().0.iter().zip(b.as_chunks::<SUMS>().0) {
        for i in 0..SUMS {
            sums[i] += a[i] * b[i];
        }
    }
    total(sums)
}

/// Sums of a function of row number and sample over each column.
#[inline(always)]
fn summed(rows: &[Columns], term: impl Fn(usize, f32) -> f32) -> Columns {
    let mut sums = [0.0f32; SUMS];
    for (j, row) in rows.iter().enumerate() {
        for i in 0..SUMS {
            sums[i] += term(j, row[i]);
        }
    }
    sums
}

#[inline(always)]
pub fn plane_and_energy(samples: &Patch) -> (Plane, f64) {
    let rows = samples.as_chunks::<SUMS>().0;
    let mean = total(summed(rows, |_, sample| sample)) / samples.len() as f64;
    let middle = mean as f32;
    // One loop for each sum: the compiler does not vectorise all in one.
    let columns = summed(rows, |_, sample| sample - middle);
    let down = summed(rows, |j, sample| PLACES[1][j] * (sample - middle));
    let squares = summed(rows, |_, sample| (sample - middle) * (sample - middle));
    let plane = Plane::of_sums(0.0, [sum_along(&columns, 1), total(down)]);
    (Plane { mean, ..plane }, total(squares) - plane.dot(&plane))
}

/// The image rows around row `j` of the patch whose first sample is (`left`, `top`), with one more
/// sample on either side.
#[inline(always)]
pub fn rows_about(image: &GrayImage, left: usize, top: usize, j: usize) -> [&[u8; PATCH_SIDE + 2]; 3] {
    let row = |y: usize| image.row(y)[left - 1..].first_chunk().expect("the samples about a patch");
    [row(top + j - 1), row(top + j), row(top + j + 1)]
}

#[inline(always)]
pub fn patch_sums(image: &GrayImage, left: usize, top: usize) -> PatchSums {
    // Partial sums, one per column. Integer addition is exact, so the order is irrelevant.
    let mut singles = [[0i16; PATCH_SIDE]; 3];
    let mut products = [[0i32; PATCH_SIDE]; 6];
    for j in 0..PATCH_SIDE {
        let [above, here, below] = rows_about(image, left, top, j);
        let (mut sample, mut x, mut y) = ([0i16; PATCH_SIDE], [0i16; PATCH_SIDE], [0i16; PATCH_SIDE]);
        for i in 0..PATCH_SIDE {
            sample[i] = i16::from(here[i + 1]);
            x[i] = i16::from(here[i + 2]) - i16::from(here[i]);
            y[i] = i16::from(below[i + 1]) - i16::from(above[i + 1]);
        }
        for (sums, terms) in singles.iter_mut().zip([&sample, &x, &y]) {
            for i in 0..PATCH_SIDE {
                sums[i] += terms[i];
            }
        }
        let pairs = [(&sample, &sample), (&sample, &x), (&sample, &y), (&x, &x), (&x, &y), (&y, &y)];
        for (sums, (a, b)) in products.iter_mut().zip(pairs) {
            for i in 0..PATCH_SIDE {
                sums[i] += i32::from(a[i]) * i32::from(b[i]);
            }
        }
    }
    let [sample, x, y] = singles.map(|sums| sums.iter().map(|&sum| i32::from(sum)).sum());
    let [sample_sample, sample_x, sample_y, x_x, x_y, y_y] = products.map(|sums| sums.iter().sum());
    PatchSums { sample, x, y, sample_sample, sample_x, sample_y, x_x, x_y, y_y }
}

#[inline(always)]
pub fn weighted_sums(image: &GrayImage, left: usize, top: usize) -> WeightedSums {
    // Partial sums, one per column. Integer addition is exact, so the order is irrelevant.
    let mut columns = [[0i16; PATCH_SIDE]; 3];
    let mut down = [[0i32; PATCH_SIDE]; 3];
    for j in 0..PATCH_SIDE {
        let [above, here, below] = rows_about(image, left, top, j);
        let [mut sample, mut x, mut y] = [[0i16; PATCH_SIDE]; 3];
        for i in 0..PATCH_SIDE {
            sample[i] = i16::from(here[i + 1]);
            x[i] = i16::from(here[i + 2]) - i16::from(here[i]);
            y[i] = i16::from(below[i + 1]) - i16::from(above[i + 1]);
        }
        let place = twice_from_centre(j);
        for ((columns, down), terms) in columns.iter_mut().zip(&mut down).zip([&sample, &x, &y]) {
            for i in 0..PATCH_SIDE {
                columns[i] += terms[i];
                down[i] += i32::from(place * terms[i]);
            }
        }
    }
    let across = columns.map(|sums| {
        (0..PATCH_SIDE).map(|i| i32::from(twice_from_centre(i)) * i32::from(sums[i])).sum::<i32>()
    });
    let down = down.map(|sums| sums.iter().sum::<i32>());
    WeightedSums { sample: [across[0], down[0]], x: [across[1], down[1]], y: [across[2], down[2]] }
}

/// Twice the coordinate of a row or column relative to the centre of a patch.
#[inline(always)]
fn twice_from_centre(index: usize) -> i16 {
    2 * index as i16 - (PATCH_SIDE as i16 - 1)
}

#[inline(always)]
pub fn bend_products(
    image: &GrayImage,
    left: usize,
    top: usize,
    appearance: &TemplateSamples,
) -> [[f64; 2]; 2] {
    let mut sums = [[[0.0f32; PATCH_SIDE]; 2]; 2];
    let gradients_x = appearance.gradient_x.as_chunks::<PATCH_SIDE>().0;
    let gradients_y = appearance.gradient_y.as_chunks::<PATCH_SIDE>().0;
    for j in 0..PATCH_SIDE {
        let [above, here, below] = rows_about(image, left, top, j);
        for i in 0..PATCH_SIDE {
            let twice = 2 * i16::from(here[i + 1]);
            let along = f32::from(i16::from(here[i]) + i16::from(here[i + 2]) - twice);
            let down = f32::from(i16::from(above[i + 1]) + i16::from(below[i + 1]) - twice);
            let (x, y) = (gradients_x[j][i], gradients_y[j][i]);
            sums[0][0][i] += along * x;
            sums[0][1][i] += along * y;
            sums[1][0][i] += down * x;
            sums[1][1][i] += down * y;
        }
    }
    sums.map(|axis| axis.map(total))
}

#[inline(always)]
pub fn write_appearance(
    image: &GrayImage,
    left: usize,
    top: usize,
    less: &Orthogonal,
    appearance: &mut TemplateSamples,
) {
    let TemplateSamples { contrast, gradient_x, gradient_y } = appearance;
    let [contrast, gradient_x, gradient_y] =
        [contrast, gradient_x, gradient_y].map(|patch| patch.as_chunks_mut::<PATCH_SIDE>().0);
    let planes = less.planes.each_ref().map(PlaneRows::of);
    let [share_x, share_y] = less.shares.map(|share| share as f32);
    for j in 0..PATCH_SIDE {
        let [above, here, below] = rows_about(image, left, top, j);
        let (contrast, gradient_x, gradient_y) = (&mut contrast[j], &mut gradient_x[j], &mut gradient_y[j]);
        let [plane, plane_x, plane_y] = planes.each_ref().map(|plane| plane.row(j));
        for i in 0..PATCH_SIDE {
            let value = f32::from(here[i + 1]) - plane[i];
            let x = 0.5 * (f32::from(here[i + 2]) - f32::from(here[i]));
            let y = 0.5 * (f32::from(below[i + 1]) - f32::from(above[i + 1]));
            contrast[i] = value;
            gradient_x[i] = x - plane_x[i] - share_x * value;
            gradient_y[i] = y - plane_y[i] - share_y * value;
        }
    }
}

/// A plane as the values of its middle row and the growth from row to row.
struct PlaneRows {
    middle: Columns,
    down: f32,
}

impl PlaneRows {
    #[inline(always)]
    fn of(plane: &Plane) -> Self {
        let (mean, across) = (plane.mean as f32, plane.slope[0] as f32);
        Self { middle: std::array::from_fn(|i| mean + across * PLACES[1][i]), down: plane.slope[1] as f32 }
    }

    #[inline(always)]
    fn row(&self, j: usize) -> Columns {
        let more = self.down * PLACES[1][j];
        std::array::from_fn(|i| self.middle[i] + more)
    }
}

#[inline(always)]
pub fn moments(appearance: &TemplateSamples, less: &Orthogonal) -> Moments {
    let TemplateSamples { contrast, gradient_x, gradient_y } = appearance;
    // What was removed is added again.
    let whole = |of: &Patch, share: f64, plane: &Plane| -> Patch {
        let (mut whole, share, plane) = (*of, share as f32, PlaneRows::of(plane));
        let rows = whole.as_chunks_mut::<PATCH_SIDE>().0.iter_mut().zip(contrast.as_chunks::<PATCH_SIDE>().0);
        for (j, (whole, contrast)) in rows.enumerate() {
            let plane = plane.row(j);
            for i in 0..PATCH_SIDE {
                whole[i] += share * contrast[i] + plane[i];
            }
        }
        whole
    };
    let Orthogonal { planes: [_, plane_x, plane_y], shares: [share_x, share_y] } = less;
    let whole_x = whole(gradient_x, *share_x, plane_x);
    let whole_y = whole(gradient_y, *share_y, plane_y);
    [
        second_moments(sums_down(gradient_x, &whole_x)),
        second_moments(sums_down(gradient_x, &whole_y)),
        second_moments(sums_down(gradient_y, &whole_x)),
        second_moments(sums_down(gradient_y, &whole_y)),
    ]
}

/// Moments of x x, x y and y y.
#[inline(always)]
fn second_moments([ones, lower, lowest]: [Columns; 3]) -> [f64; 3] {
    [sum_along(&ones, 2), sum_along(&lower, 1), sum_along(&lowest, 0)]
}

/// Sum of the columns, weighted with a power of their x coordinate.
#[inline(always)]
fn sum_along(columns: &Columns, power: usize) -> f64 {
    let mut weighted = *columns;
    for i in 0..PATCH_SIDE {
        weighted[i] *= PLACES[power][i];
    }
    total(weighted)
}

type Columns = [f32; PATCH_SIDE];

/// Coordinate of a row or column relative to the centre of a patch, to the powers 0, 1 and 2.
const PLACES: [Columns; 3] = {
    let mut places = [[1.0; PATCH_SIDE]; 3];
    let mut i = 0;
    while i < PATCH_SIDE {
        let place = i as f32 - (PATCH_SIDE as f32 - 1.0) / 2.0;
        places[1][i] = place;
        places[2][i] = place * place;
        i += 1;
    }
    places
};

/// Per column: sums of a b, weighted with the powers 0, 1 and 2 of the row's coordinate.
#[inline(always)]
fn sums_down(a: &Patch, b: &Patch) -> [Columns; 3] {
    let [mut ones, mut lower, mut lowest] = [[0.0; PATCH_SIDE]; 3];
    let rows = a.chunks_exact(PATCH_SIDE).zip(b.chunks_exact(PATCH_SIDE));
    for (j, (a, b)) in rows.enumerate() {
        let (down, squared) = (PLACES[1][j], PLACES[2][j]);
        for i in 0..PATCH_SIDE {
            let product = a[i] * b[i];
            ones[i] += product;
            lower[i] += down * product;
            lowest[i] += squared * product;
        }
    }
    [ones, lower, lowest]
}

#[inline(always)]
pub fn blur_rows(a: &[u8], b: &[u8], c: &[u8], d: &[u8], e: &[u8], sums: &mut [u16]) {
    let n = sums.len();
    let (a, b, c, d, e) = (&a[..n], &b[..n], &c[..n], &d[..n], &e[..n]);
    for x in 0..n {
        let outer = u16::from(a[x]) + u16::from(e[x]);
        let inner = u16::from(b[x]) + u16::from(d[x]);
        sums[x] = outer + 4 * inner + 6 * u16::from(c[x]);
    }
}

#[inline(always)]
pub fn blur_and_halve(sums: &[u16], out: &mut [u8]) {
    if out.is_empty() {
        return;
    }
    // The largest total, 16 · 16 · 255 + 128, just fits 16 bits.
    let n = out.len();
    let sums = &sums[..2 * n + 3];
    let pairs = |from: usize| sums[from..][..2 * n].chunks_exact(2);
    for ((sample, first), (second, third)) in
        out.iter_mut().zip(pairs(0)).zip(pairs(2).zip(sums[4..].iter().step_by(2)))
    {
        let total = first[0] + third + 4 * (first[1] + second[1]) + 6 * second[0];
        *sample = ((total + 128) >> 8) as u8;
    }
}

#[inline(always)]
pub fn scharr_gradients(above: &[u8], here: &[u8], below: &[u8], x: &mut [i16], y: &mut [i16]) {
    let n = here.len() - 2;
    let [(a0, a1, a2), (h0, _, h2), (b0, b1, b2)] =
        [above, here, below].map(|row| (&row[..n], &row[1..][..n], &row[2..][..n]));
    let [x, y] = [x, y].map(|row| &mut row[1..][..n]);
    // At most 16 · 255, which fits 16 bits.
    for i in 0..n {
        let v = |row: &[u8]| i16::from(row[i]);
        x[i] = 3 * (v(a2) - v(a0) + v(b2) - v(b0)) + 10 * (v(h2) - v(h0));
        y[i] = 3 * (v(b0) - v(a0) + v(b2) - v(a2)) + 10 * (v(b1) - v(a1));
    }
}

#[inline(always)]
pub fn roll_products(
    x: &[i16],
    y: &[i16],
    old_x: &[i16],
    old_y: &[i16],
    total_xx: &mut [i32],
    total_xy: &mut [i32],
    total_yy: &mut [i32],
) {
    let n = x.len();
    let (y, old_x, old_y) = (&y[..n], &old_x[..n], &old_y[..n]);
    let [total_xx, total_xy, total_yy] = [total_xx, total_xy, total_yy].map(|row| &mut row[..n]);
    for i in 0..n {
        let [x, y, old_x, old_y] = [x[i], y[i], old_x[i], old_y[i]].map(i32::from);
        total_xx[i] += x * x - old_x * old_x;
        total_xy[i] += x * y - old_x * old_y;
        total_yy[i] += y * y - old_y * old_y;
    }
}

#[inline(always)]
pub fn smaller_eigenvalues_of_sums(
    xx: &[i32],
    xy: &[i32],
    yy: &[i32],
    window: usize,
    scale: f32,
    out: &mut [f32],
) {
    // The common window sizes as compile-time constants.
    match window {
        3 => eigenvalues_of_sums([xx, xy, yy], 3, scale, out),
        5 => eigenvalues_of_sums([xx, xy, yy], 5, scale, out),
        _ => eigenvalues_of_sums([xx, xy, yy], window, scale, out),
    }
}

#[inline(always)]
fn eigenvalues_of_sums(rows: [&[i32]; 3], window: usize, scale: f32, out: &mut [f32]) {
    let n = out.len();
    let [xx, xy, yy] = rows.map(|row| &row[..n + window - 1]);
    for (x, out) in out.iter_mut().enumerate() {
        let (mut a, mut b, mut c) = (0i32, 0i32, 0i32);
        for i in 0..window {
            a += xx[x + i];
            b += xy[x + i];
            c += yy[x + i];
        }
        *out = smaller_eigenvalue(a as f32 * scale, b as f32 * scale, c as f32 * scale);
    }
}

#[inline(always)]
pub fn add_weighted_products(
    x: &[i16],
    y: &[i16],
    weight: f32,
    xx: &mut [f32],
    xy: &mut [f32],
    yy: &mut [f32],
) {
    let n = x.len();
    let y = &y[..n];
    let [xx, xy, yy] = [xx, xy, yy].map(|row| &mut row[..n]);
    for i in 0..n {
        let [x, y] = [x[i], y[i]].map(i32::from);
        xx[i] += weight * (x * x) as f32;
        xy[i] += weight * (x * y) as f32;
        yy[i] += weight * (y * y) as f32;
    }
}

#[inline(always)]
pub fn smaller_eigenvalues(xx: &[f32], xy: &[f32], yy: &[f32], weights: &[f32], out: &mut [f32]) {
    const BLOCK: usize = 16; // positions at a time whose sums stay in registers
    let whole = out.len() / BLOCK * BLOCK;
    let (blocks, rest) = out.split_at_mut(whole);
    for (block, out) in blocks.chunks_exact_mut(BLOCK).enumerate() {
        let mut sums = [[0.0f32; BLOCK]; 3];
        for (sums, row) in sums.iter_mut().zip([xx, xy, yy]) {
            for (i, &weight) in weights.iter().enumerate() {
                let row = &row[block * BLOCK + i..][..BLOCK];
                for x in 0..BLOCK {
                    sums[x] += weight * row[x];
                }
            }
        }
        for x in 0..BLOCK {
            out[x] = smaller_eigenvalue(sums[0][x], sums[1][x], sums[2][x]);
        }
    }
    for (x, out) in rest.iter_mut().enumerate() {
        let sum = |row: &[f32]| {
            let row = &row[whole + x..][..weights.len()];
            weights.iter().zip(row).fold(0.0f32, |sum, (weight, value)| sum + weight * value)
        };
        *out = smaller_eigenvalue(sum(xx), sum(xy), sum(yy));
    }
}

/// Smaller eigenvalue of the symmetric matrix (xx xy; xy yy).
#[inline(always)]
fn smaller_eigenvalue(xx: f32, xy: f32, yy: f32) -> f32 {
    let half_trace = 0.5 * (xx + yy);
    let half_difference = 0.5 * (xx - yy);
    half_trace - (half_difference * half_difference + xy * xy).sqrt()
}

#[inline(always)]
pub fn mark_local_maxima(above: &[f32], here: &[f32], below: &[f32], least: f32, marks: &mut [u8]) {
    marks.fill(0);
    if marks.len() < 3 {
        return;
    }
    let n = marks.len() - 2;
    let (a0, a1, a2) = (&above[..n], &above[1..][..n], &above[2..][..n]);
    let (h0, h1, h2) = (&here[..n], &here[1..][..n], &here[2..][..n]);
    let (b0, b1, b2) = (&below[..n], &below[1..][..n], &below[2..][..n]);
    let marks = &mut marks[1..][..n];
    for x in 0..n {
        let s = h1[x];
        // `&` instead of `&&`: branch-free, so that the loop can be vectorised.
        let before = (s > a0[x]) & (s > a1[x]) & (s > a2[x]) & (s > h0[x]);
        let after = (s >= h2[x]) & (s >= b0[x]) & (s >= b1[x]) & (s >= b2[x]);
        marks[x] = u8::from((s >= least) & before & after);
    }
}

#[inline(always)]
pub fn squared_differences(a: &[u8], b: &[u8]) -> u64 {
    // Parts whose sums 32 bits hold.
    let parts = a.chunks(1 << 12).zip(b.chunks(1 << 12));
    let sum = |(a, b): (&[u8], &[u8])| -> u32 {
        let squares = a.iter().zip(b).map(|(&a, &b)| u16::from(a.abs_diff(b)) * u16::from(a.abs_diff(b)));
        squares.map(u32::from).sum()
    };
    parts.map(|part| u64::from(sum(part))).sum()
}

#[inline(always)]
pub fn differing_bits(one: &[u64; 4], others: &[[u64; 4]], out: &mut [u32]) {
    for (other, out) in others.iter().zip(out) {
        *out = (0..4).map(|word| (one[word] ^ other[word]).count_ones()).sum();
    }
}

#[inline(always)]
pub fn differing_bits_of_pairs(pairs: &[[[u64; 4]; 2]], out: &mut [u32]) {
    for ([one, other], out) in pairs.iter().zip(out) {
        *out = (0..4).map(|word| (one[word] ^ other[word]).count_ones()).sum();
    }
}
