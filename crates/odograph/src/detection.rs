//! Subsystem 3: objects of interest. Corners that can be found again, by the criterion of J. Shi and C. Tomasi, "Good features to track", 1994:
//! the smaller eigenvalue of the gradient matrix over a window.

use crate::image::GrayImage;
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
pub fn detect(image: &GrayImage, config: &DetectionConfig, margin_px: usize) -> Vec<Corner> {
    let strengths = StrengthMap::new(image, config);
    let candidates = strengths.local_maxima(margin_px);
    spread(&candidates, (image.width(), image.height()), config)
}

/// Gradients weaker than this (gray levels per pixel, squared) are 8-bit rounding, not texture.
const SMALLEST_STRENGTH: f32 = 0.02;

/// The strength of every pixel of an image.
struct StrengthMap {
    width: usize,
    height: usize,
    strengths: Vec<f32>,
}

impl StrengthMap {
    fn new(image: &GrayImage, config: &DetectionConfig) -> Self {
        let (width, height) = (image.width(), image.height());
        let weights = window_weights(config);
        let radius = config.window_radius_px;
        let mut strengths = vec![0.0; width * height];
        if width < 2 * radius + 3 || height < 2 * radius + 3 {
            return Self { width, height, strengths };
        }
        // A ring of the last 2 r + 1 rows of products, each already summed along x, so that no full-size plane is kept.
        let rows = 2 * radius + 1;
        let mut ring = vec![[vec![0.0f32; width], vec![0.0f32; width], vec![0.0f32; width]]; rows];
        let mut products = [vec![0.0f32; width], vec![0.0f32; width], vec![0.0f32; width]];
        for y in 1..height - 1 {
            gradient_products(image, y, &mut products);
            for (sums, products) in ring[y % rows].iter_mut().zip(&products) {
                sum_along_row(products, &weights, sums);
            }
            if y < rows {
                continue;
            }
            let centre = y - radius;
            let out = &mut strengths[centre * width..][..width];
            let mut totals = [vec![0.0f32; width], vec![0.0f32; width], vec![0.0f32; width]];
            for (i, weight) in weights.iter().enumerate() {
                // Row centre − radius + i.
                let row = &ring[(centre + i - radius) % rows];
                for (total, sums) in totals.iter_mut().zip(row) {
                    total.iter_mut().zip(sums).for_each(|(t, s)| *t += weight * s);
                }
            }
            let [xx, xy, yy] = &totals;
            for x in radius + 1..width - radius - 1 {
                let half_trace = 0.5 * (xx[x] + yy[x]);
                let half_difference = 0.5 * (xx[x] - yy[x]);
                out[x] = half_trace - (half_difference * half_difference + xy[x] * xy[x]).sqrt();
            }
        }
        Self { width, height, strengths }
    }

    /// Pixels that are stronger than their eight neighbours, strongest first.
    fn local_maxima(&self, margin_px: usize) -> Vec<Corner> {
        let margin = margin_px.max(1);
        let mut maxima = Vec::new();
        if self.width <= 2 * margin || self.height <= 2 * margin {
            return maxima;
        }
        for y in margin..self.height - margin {
            let row = |y: usize| &self.strengths[y * self.width..][..self.width];
            let (above, here, below) = (row(y - 1), row(y), row(y + 1));
            for x in margin..self.width - margin {
                let s = here[x];
                // Ties go to the first in reading order: strictly above what was read before, not below what comes after.
                let highest = s >= SMALLEST_STRENGTH
                    && s > above[x - 1]
                    && s > above[x]
                    && s > above[x + 1]
                    && s > here[x - 1]
                    && s >= here[x + 1]
                    && s >= below[x - 1]
                    && s >= below[x]
                    && s >= below[x + 1];
                if highest {
                    maxima.push(Corner { x, y, strength: s });
                }
            }
        }
        maxima.sort_by(|a, b| b.strength.total_cmp(&a.strength).then((a.y, a.x).cmp(&(b.y, b.x))));
        maxima
    }
}

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

/// The products gx², gx gy, gy² of Scharr gradients (gray levels per pixel) along row `y`, which must not be the first or last.
fn gradient_products(image: &GrayImage, y: usize, products: &mut [Vec<f32>; 3]) {
    let width = image.width();
    let (above, here, below) = (image.row(y - 1), image.row(y), image.row(y + 1));
    let [xx, xy, yy] = products;
    let v = |row: &[u8], x: usize| i32::from(row[x]);
    for x in 1..width - 1 {
        let dx = 3 * (v(above, x + 1) - v(above, x - 1) + v(below, x + 1) - v(below, x - 1))
            + 10 * (v(here, x + 1) - v(here, x - 1));
        let dy = 3 * (v(below, x - 1) - v(above, x - 1) + v(below, x + 1) - v(above, x + 1))
            + 10 * (v(below, x) - v(above, x));
        let (gx, gy) = (dx as f32 * (1.0 / 32.0), dy as f32 * (1.0 / 32.0));
        xx[x] = gx * gx;
        xy[x] = gx * gy;
        yy[x] = gy * gy;
    }
}

fn sum_along_row(values: &[f32], weights: &[f32], sums: &mut [f32]) {
    let radius = weights.len() / 2;
    let inner = &mut sums[radius..values.len() - radius];
    inner.fill(0.0);
    for (i, weight) in weights.iter().enumerate() {
        inner.iter_mut().zip(&values[i..]).for_each(|(s, v)| *s += weight * v);
    }
}

/// Takes the best candidates cell by cell; see [`detect`].
fn spread(candidates: &[Corner], size: (usize, usize), config: &DetectionConfig) -> Vec<Corner> {
    let Some(strongest) = candidates.first() else {
        return Vec::new();
    };
    let weakest = config.quality * strongest.strength;
    let strong = &candidates[..candidates.partition_point(|c| c.strength >= weakest)];
    // About four corners a cell: fine enough to spread, coarse enough to choose.
    let cell_px = ((size.0 * size.1) as f64 * 4.0 / config.corners.max(1) as f64).sqrt().max(1.0);
    let columns = (size.0 as f64 / cell_px).ceil() as usize;
    let rows = (size.1 as f64 / cell_px).ceil() as usize;
    let mut cells: Vec<Vec<Corner>> = vec![Vec::new(); columns * rows];
    for &corner in strong {
        let column = ((corner.x as f64 / cell_px) as usize).min(columns - 1);
        let row = ((corner.y as f64 / cell_px) as usize).min(rows - 1);
        cells[row * columns + column].push(corner);
    }
    let mut taken = TakenCorners::new(size, config.minimum_distance_px);
    let mut next = vec![0; cells.len()];
    let mut chosen = Vec::with_capacity(config.corners);
    loop {
        let before = chosen.len();
        for (cell, next) in cells.iter().zip(&mut next) {
            while *next < cell.len() && chosen.len() < config.corners {
                let corner = cell[*next];
                *next += 1;
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
                    .all(|&(tx, ty)| (tx - x).hypot(ty - y) >= self.minimum_distance_px)
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
        let map = StrengthMap::new(&image, &config);
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
            let found = f64::from(map.strengths[cy * 40 + cx]);
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
