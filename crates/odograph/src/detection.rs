//! Subsystem 3: objects of interest. Corners that can be found again, by the criterion of J. Shi and C. Tomasi, "Good features to track", 1994:
//! the smaller eigenvalue of the gradient matrix over a window.

use crate::image::GrayImage;
use crate::image::simd::{
    add_weighted_products, mark_local_maxima, roll_products, scharr_gradients, smaller_eigenvalues,
    smaller_eigenvalues_of_sums,
};
use serde::{Deserialize, Serialize};

/// Over which window the gradient matrix is summed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Window {
    /// All samples count alike.
    Rectangular,
    /// Samples count by a binomial (near Gaussian) weight of the same extent.
    Gaussian,
}

/// How corners are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DetectionConfig {
    /// At most this many corners.
    pub corners: usize,
    /// Corners are at least this far apart, pixels.
    pub minimum_distance_px: f64,
    /// Corners weaker than this part of the strongest are not taken.
    pub quality: f32,
    /// The window of the gradient matrix.
    pub window: Window,
    /// Samples from the window's centre to its edge; the window is 2 r + 1 wide.
    pub window_radius_px: usize,
}

impl Default for DetectionConfig {
    fn default() -> Self {
        Self {
            corners: 400,
            minimum_distance_px: 12.0,
            quality: 0.005,
            window: Window::Rectangular,
            window_radius_px: 2,
        }
    }
}

/// A corner: its pixel and its strength.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corner {
    /// Column.
    pub x: usize,
    /// Row.
    pub y: usize,
    /// Smaller eigenvalue of the mean gradient matrix over the window, (gray levels per pixel)².
    pub strength: f32,
}

/// The N best corners at least `margin_px` inside the image, spread over it, strongest first within each round.
///
/// "Spread" means: the image is divided into cells of equal area and cells take turns, each giving its best corner that
/// keeps the minimum distance, until N are found. A texture that is strong in one place does not draw all corners there.
/// The image is at most 65,536 pixels wide and high, as is every camera's.
pub fn detect(image: &GrayImage, config: &DetectionConfig, margin_px: usize) -> Vec<Corner> {
    let candidates = local_maxima(image, config, margin_px);
    spread(&candidates, (image.width(), image.height()), config)
}

/// Gradients weaker than this (gray levels per pixel, squared) are 8-bit rounding, not texture.
const SMALLEST_STRENGTH: f32 = 0.02;

/// Gives the strengths of all pixels, row by row from the top. Pixels whose window does not fit into the image have none: 0.
fn for_each_row_of_strengths(
    image: &GrayImage,
    config: &DetectionConfig,
    mut visit: impl FnMut(usize, &[f32]),
) {
    let (width, height) = (image.width(), image.height());
    let radius = config.window_radius_px;
    let rows = 2 * radius + 1;
    let mut strengths = vec![0.0; width];
    let (first, beyond) = (radius + 1, height.saturating_sub(radius + 1));
    if width < rows + 2 || first >= beyond {
        return (0..height).for_each(|y| visit(y, &strengths));
    }
    let weights = window_weights(config);
    // A ring of the gradients of the last 2 r + 1 rows.
    let mut ring = vec![[vec![0i16; width], vec![0i16; width]]; rows];
    let mut newest = [vec![0i16; width], vec![0i16; width]];
    // The sums of their products along the columns: whole numbers, which are kept up by adding the row that comes and taking off the one
    // that goes, where 32 bits hold the sum over the whole window.
    let rolls = config.window == Window::Rectangular && rows <= 11;
    let mut totals = [vec![0i32; width], vec![0i32; width], vec![0i32; width]];
    let mut columns = if rolls { Default::default() } else { [(); 3].map(|()| vec![0.0f32; width]) };
    (0..first).for_each(|y| visit(y, &strengths));
    for y in 1..height - 1 {
        let [x_now, y_now] = &mut newest;
        scharr_gradients(image.row(y - 1), image.row(y), image.row(y + 1), x_now, y_now);
        if rolls {
            let [old_x, old_y] = &ring[y % rows];
            let [xx, xy, yy] = &mut totals;
            roll_products(x_now, y_now, old_x, old_y, xx, xy, yy);
        }
        std::mem::swap(&mut ring[y % rows], &mut newest);
        if y < rows {
            continue;
        }
        let centre = y - radius;
        let inner = &mut strengths[first..width - first];
        if rolls {
            let [xx, xy, yy] = &totals;
            let scale = weights[0] * weights[0] * PER_PRODUCT;
            smaller_eigenvalues_of_sums(&xx[1..], &xy[1..], &yy[1..], rows, scale, inner);
        } else {
            let [xx, xy, yy] = &mut columns;
            for column in [&mut *xx, &mut *xy, &mut *yy] {
                column.fill(0.0);
            }
            for (k, weight) in weights.iter().enumerate() {
                // Row centre − radius + k.
                let [x, y] = &ring[(centre + k - radius) % rows];
                add_weighted_products(x, y, weight * PER_PRODUCT, xx, xy, yy);
            }
            smaller_eigenvalues(&xx[1..], &xy[1..], &yy[1..], &weights, inner);
        }
        visit(centre, &strengths);
    }
    strengths.fill(0.0);
    (beyond..height).for_each(|y| visit(y, &strengths));
}

/// A product of two Scharr gradients in (gray levels per pixel)².
const PER_PRODUCT: f32 = 1.0 / (32.0 * 32.0);

/// Pixels that are stronger than their eight neighbours and strong enough beside the strongest of them, in reading order.
fn local_maxima(image: &GrayImage, config: &DetectionConfig, margin_px: usize) -> Vec<Ranked> {
    let (width, height) = (image.width(), image.height());
    let margin = margin_px.max(1);
    let mut maxima = Vec::new();
    if width <= 2 * margin || height <= 2 * margin {
        return maxima;
    }
    let mut last = [vec![0.0f32; width], vec![0.0f32; width], vec![0.0f32; width]];
    // A multiple of the blocks in which marks are looked through.
    let mut marks = vec![0u8; width.next_multiple_of(MARKS)];
    let mut strongest = 0.0f32;
    for_each_row_of_strengths(image, config, |read, strengths| {
        last.rotate_left(1);
        last[2].copy_from_slice(strengths);
        let Some(y) = read.checked_sub(1).filter(|y| (margin..height - margin).contains(y)) else {
            return;
        };
        let [above, here, below] = &last;
        // Ties go to the first in reading order. What is too weak beside the strongest so far is so beside the strongest of all.
        let least = SMALLEST_STRENGTH.max(config.quality * strongest);
        mark_local_maxima(above, here, below, least, &mut marks[..width]);
        for (block, marks) in marks.as_chunks::<MARKS>().0.iter().enumerate() {
            // A mark is 0 or 1, and nearly all are 0.
            let mut bits = u64::from_le_bytes(*marks);
            while bits != 0 {
                let x = block * MARKS + bits.trailing_zeros() as usize / 8;
                bits &= bits - 1;
                if (margin..width - margin).contains(&x) {
                    maxima.push(Ranked::new(x, y, here[x]));
                    strongest = strongest.max(here[x]);
                }
            }
        }
    });
    maxima.retain(|candidate| candidate.strength() >= config.quality * strongest);
    maxima
}

/// So many marks are looked through at a time: as many as there are bytes in a word.
const MARKS: usize = 8;

fn window_weights(config: &DetectionConfig) -> Vec<f32> {
    let n = 2 * config.window_radius_px;
    let mut weights = vec![1.0f32; n + 1];
    if config.window == Window::Gaussian {
        for i in 1..=n {
            weights[i] = weights[i - 1] * (n + 1 - i) as f32 / i as f32;
        }
    }
    let total: f32 = weights.iter().sum();
    weights.iter().map(|w| w / total).collect()
}

/// Takes the best candidates cell by cell; see [`detect`].
fn spread(candidates: &[Ranked], size: (usize, usize), config: &DetectionConfig) -> Vec<Corner> {
    if candidates.is_empty() {
        return Vec::new();
    }
    // About four corners a cell: fine enough to spread, coarse enough to choose.
    let cell_px = ((size.0 * size.1) as f64 * 4.0 / config.corners.max(1) as f64).sqrt().max(1.0);
    let columns = (size.0 as f64 / cell_px).ceil() as usize;
    let rows = (size.1 as f64 / cell_px).ceil() as usize;
    let cell_along = |size: usize, cells: usize| -> Vec<usize> {
        (0..size).map(|at| ((at as f64 / cell_px) as usize).min(cells - 1)).collect()
    };
    let (column_of, row_of) = (cell_along(size.0, columns), cell_along(size.1, rows));
    let cell_of = |candidate: &Ranked| row_of[candidate.y()] * columns + column_of[candidate.x()];
    // Sorted into the cells by counting.
    let mut ends = vec![0; columns * rows];
    candidates.iter().for_each(|candidate| ends[cell_of(candidate)] += 1);
    let mut total = 0;
    for end in &mut ends {
        total += *end;
        *end = total - *end; // where the cell begins, until it is filled
    }
    let mut in_cells = vec![Ranked(0); candidates.len()];
    for candidate in candidates {
        let end = &mut ends[cell_of(candidate)];
        in_cells[*end] = *candidate;
        *end += 1;
    }
    let mut rest = in_cells.as_mut_slice();
    let mut cells = Vec::with_capacity(ends.len());
    let mut begin = 0;
    for end in ends {
        let (cell, others) = rest.split_at_mut(end - begin);
        cells.push(Cell { candidates: cell, sorted: 0 });
        (rest, begin) = (others, end);
    }
    let mut taken = TakenCorners::new(size, config.minimum_distance_px);
    let mut chosen = Vec::with_capacity(config.corners);
    loop {
        let before = chosen.len();
        for cell in &mut cells {
            while chosen.len() < config.corners {
                let Some(corner) = cell.next().map(Ranked::corner) else { break };
                if taken.keeps_distance(corner) {
                    taken.take(corner);
                    chosen.push(corner);
                    break;
                }
            }
        }
        if chosen.len() == before {
            return chosen;
        }
    }
}

/// A corner as one number that orders as corners do: the stronger is the larger; of equals the first in reading order. The bits of a
/// positive strength, which order as it does, then those of the place.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Ranked(u64);

impl Ranked {
    /// Places are below 2¹⁶: no camera has more pixels along a side.
    fn new(x: usize, y: usize, strength: f32) -> Self {
        let place = !(((y as u32) << 16) | x as u32);
        Self((u64::from(strength.to_bits()) << 32) | u64::from(place))
    }

    fn strength(self) -> f32 {
        f32::from_bits((self.0 >> 32) as u32)
    }

    fn x(self) -> usize {
        (!self.0 & 0xffff) as usize
    }

    fn y(self) -> usize {
        (!self.0 >> 16 & 0xffff) as usize
    }

    fn corner(self) -> Corner {
        Corner { x: self.x(), y: self.y(), strength: self.strength() }
    }
}

/// The corners of one cell, given from the strongest to the weakest; few are asked for, so that few are sorted at a time.
struct Cell<'a> {
    /// Those not given yet; the strongest at the end.
    candidates: &'a mut [Ranked],
    /// So many at the end are sorted, and stronger than the others.
    sorted: usize,
}

impl Cell<'_> {
    fn next(&mut self) -> Option<Ranked> {
        const AT_A_TIME: usize = 12;
        if self.sorted == 0 {
            let from = self.candidates.len().saturating_sub(AT_A_TIME);
            if from > 0 {
                self.candidates.select_nth_unstable(from);
            }
            self.candidates[from..].sort_unstable();
            self.sorted = self.candidates.len() - from;
        }
        let (strongest, others) = std::mem::take(&mut self.candidates).split_last_mut()?;
        self.candidates = others;
        self.sorted -= 1;
        Some(*strongest)
    }
}

/// Corners already taken, in a grid whose cells are as wide as the minimum distance: only nine cells need looking at.
struct TakenCorners {
    minimum_distance_px: f64,
    columns: usize,
    rows: usize,
    cell_px: f64,
    cells: Vec<Vec<(f64, f64)>>,
}

impl TakenCorners {
    fn new(size: (usize, usize), minimum_distance_px: f64) -> Self {
        let cell_px = minimum_distance_px.max(1.0);
        let columns = (size.0 as f64 / cell_px) as usize + 1;
        let rows = (size.1 as f64 / cell_px) as usize + 1;
        Self { minimum_distance_px, columns, rows, cell_px, cells: vec![Vec::new(); columns * rows] }
    }

    fn cell(&self, corner: Corner) -> (usize, usize) {
        ((corner.x as f64 / self.cell_px) as usize, (corner.y as f64 / self.cell_px) as usize)
    }

    fn keeps_distance(&self, corner: Corner) -> bool {
        let (column, row) = self.cell(corner);
        let (x, y) = (corner.x as f64, corner.y as f64);
        (row.saturating_sub(1)..(row + 2).min(self.rows)).all(|r| {
            (column.saturating_sub(1)..(column + 2).min(self.columns)).all(|c| {
                self.cells[r * self.columns + c]
                    .iter()
                    .all(|&(tx, ty)| (tx - x).powi(2) + (ty - y).powi(2) >= self.minimum_distance_px.powi(2))
            })
        })
    }

    fn take(&mut self, corner: Corner) {
        let (column, row) = self.cell(corner);
        self.cells[row * self.columns + column].push((corner.x as f64, corner.y as f64));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// White squares on black: their corners are the corners.
    fn squares() -> GrayImage {
        let mut image = GrayImage::new(200, 150);
        for (x0, y0) in [(40, 40), (120, 40), (40, 90), (120, 90)] {
            for y in y0..y0 + 25 {
                for x in x0..x0 + 25 {
                    image.samples_mut()[y * 200 + x] = 200;
                }
            }
        }
        image
    }

    #[test]
    fn the_corners_of_squares_are_found_and_nothing_else() {
        for window in [Window::Rectangular, Window::Gaussian] {
            let config = DetectionConfig { window, quality: 0.3, ..Default::default() };
            let corners = detect(&squares(), &config, 10);
            assert_eq!(corners.len(), 16, "{window:?}");
            for corner in corners {
                let near = |v: usize, edges: [usize; 4]| edges.iter().any(|&e| v.abs_diff(e) <= 2);
                assert!(
                    near(corner.x, [40, 64, 120, 144]) && near(corner.y, [40, 64, 90, 114]),
                    "{corner:?}"
                );
            }
        }
    }

    #[test]
    fn strength_is_the_smaller_eigenvalue_of_the_mean_gradient_matrix() {
        let mut state = 7u32;
        let samples = (0..40 * 40)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8
            })
            .collect();
        let image = GrayImage::from_samples(40, 40, samples).unwrap();
        let config = DetectionConfig::default();
        let mut strengths = Vec::new();
        for_each_row_of_strengths(&image, &config, |_, row| strengths.extend_from_slice(row));
        for (cx, cy) in [(10usize, 12usize), (20, 5), (33, 30)] {
            let mut m = nalgebra::Matrix2::<f64>::zeros();
            for y in cy - 2..=cy + 2 {
                for x in cx - 2..=cx + 2 {
                    let v = |x: usize, y: usize| f64::from(image.row(y)[x]);
                    let gx = (3.0 * (v(x + 1, y - 1) - v(x - 1, y - 1) + v(x + 1, y + 1) - v(x - 1, y + 1))
                        + 10.0 * (v(x + 1, y) - v(x - 1, y)))
                        / 32.0;
                    let gy = (3.0 * (v(x - 1, y + 1) - v(x - 1, y - 1) + v(x + 1, y + 1) - v(x + 1, y - 1))
                        + 10.0 * (v(x, y + 1) - v(x, y - 1)))
                        / 32.0;
                    m += nalgebra::Matrix2::new(gx * gx, gx * gy, gx * gy, gy * gy) / 25.0;
                }
            }
            let expected = m.symmetric_eigenvalues().min();
            let found = f64::from(strengths[cy * 40 + cx]);
            assert!((found - expected).abs() < 1e-3 * expected.abs().max(1.0), "{found} {expected}");
        }
    }

    #[test]
    fn corners_keep_their_distance_and_their_number() {
        let mut state = 1u32;
        let samples = (0..320 * 240)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8
            })
            .collect();
        let image = GrayImage::from_samples(320, 240, samples).unwrap();
        let config = DetectionConfig { corners: 100, ..Default::default() };
        let corners = detect(&image, &config, 10);
        assert_eq!(corners.len(), 100);
        for (i, a) in corners.iter().enumerate() {
            assert!(a.x >= 10 && a.y >= 10 && a.x < 310 && a.y < 230);
            for b in &corners[..i] {
                let d = (a.x as f64 - b.x as f64).hypot(a.y as f64 - b.y as f64);
                assert!(d >= config.minimum_distance_px);
            }
        }
        // Spread: every quarter of the image has its share.
        let quarter = |c: &Corner| usize::from(c.x >= 160) + 2 * usize::from(c.y >= 120);
        for q in 0..4 {
            let count = corners.iter().filter(|c| quarter(c) == q).count();
            assert!(count >= 15, "quarter {q} has {count}");
        }
    }

    #[test]
    fn a_blank_image_has_no_corners() {
        assert!(detect(&GrayImage::new(100, 100), &DetectionConfig::default(), 5).is_empty());
        assert!(detect(&GrayImage::new(3, 3), &DetectionConfig::default(), 5).is_empty());
    }
}
