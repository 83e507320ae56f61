//! Corner strength of every pixel, row by row: the minimum eigenvalue of the structure tensor over
//! a window.

use super::{DetectionConfig, Window};
use crate::image::GrayImage;
use crate::image::simd::{
    add_weighted_products, roll_products, scharr_gradients, smaller_eigenvalues, smaller_eigenvalues_of_sums,
};

/// Scale of a product of two unnormalised Scharr gradients to (gray levels per pixel)².
const PER_PRODUCT: f32 = 1.0 / (32.0 * 32.0);

/// Corner strengths of an image, row by row from the top; 0 where the window exceeds the image.
#[derive(Debug)]
pub(super) struct Strengths {
    radius: usize,
    /// The rows whose window lies inside the image, as a half-open range.
    inner: (usize, usize),
    weights: Vec<f32>,
    /// Ring buffer of the x and y gradients of the last 2 r + 1 rows; `newest` is the buffer for
    /// the next row.
    ring: Vec<[Vec<i16>; 2]>,
    newest: [Vec<i16>; 2],
    /// The next row whose gradients are computed.
    next: usize,
    /// Whether the column sums of the gradient products are integer running sums, updated by adding
    /// the new row and subtracting the oldest. Requires that the sum over the whole window fits 32
    /// bits.
    rolls: bool,
    totals: [Vec<i32>; 3],
    columns: [Vec<f32>; 3],
    strengths: Vec<f32>,
}

impl Strengths {
    /// Strengths of images of this size.
    pub fn new((width, height): (usize, usize), config: &DetectionConfig) -> Self {
        let radius = config.window_radius_px;
        let rows = 2 * radius + 1;
        let (first, beyond) = (radius + 1, height.saturating_sub(radius + 1));
        let fits = width >= rows + 2 && first < beyond;
        let rolls = config.window == Window::Rectangular && rows <= 11;
        let row = |there: bool| if there { vec![0; width] } else { Vec::new() };
        Self {
            radius,
            inner: if fits { (first, beyond) } else { (height, height) },
            weights: window_weights(config),
            ring: vec![[vec![0i16; width], vec![0i16; width]]; rows],
            newest: [vec![0i16; width], vec![0i16; width]],
            next: 1,
            rolls,
            totals: [(); 3].map(|()| row(rolls)),
            columns: [(); 3].map(|()| if rolls { Vec::new() } else { vec![0.0; width] }),
            strengths: vec![0.0; width],
        }
    }

    /// The strengths of row `y`. Rows must be requested in ascending order from the first.
    pub fn row(&mut self, image: &GrayImage, y: usize) -> &[f32] {
        let (first, beyond) = self.inner;
        if (first..beyond).contains(&y) {
            while self.next <= y + self.radius {
                self.take(image);
            }
            self.judge(y);
        } else {
            self.strengths.fill(0.0);
        }
        &self.strengths
    }

    /// Computes the gradients of the next row.
    fn take(&mut self, image: &GrayImage) {
        let (y, rows) = (self.next, self.ring.len());
        self.next += 1;
        let [x_now, y_now] = &mut self.newest;
        scharr_gradients(image.row(y - 1), image.row(y), image.row(y + 1), x_now, y_now);
        if self.rolls {
            let [old_x, old_y] = &self.ring[y % rows];
            let [xx, xy, yy] = &mut self.totals;
            roll_products(x_now, y_now, old_x, old_y, xx, xy, yy);
        }
        std::mem::swap(&mut self.ring[y % rows], &mut self.newest);
    }

    /// Computes the strengths of a row; all gradients within its window are present.
    fn judge(&mut self, centre: usize) {
        let (weights, rows) = (&self.weights, self.ring.len());
        let (first, width) = (self.radius + 1, self.strengths.len());
        let inner = &mut self.strengths[first..width - first];
        if self.rolls {
            let [xx, xy, yy] = &self.totals;
            let scale = weights[0] * weights[0] * PER_PRODUCT;
            smaller_eigenvalues_of_sums(&xx[1..], &xy[1..], &yy[1..], rows, scale, inner);
        } else {
            let [xx, xy, yy] = &mut self.columns;
            for column in [&mut *xx, &mut *xy, &mut *yy] {
                column.fill(0.0);
            }
            for (k, weight) in weights.iter().enumerate() {
                // Row centre − radius + k.
                let [x, y] = &self.ring[(centre + k - self.radius) % rows];
                add_weighted_products(x, y, weight * PER_PRODUCT, xx, xy, yy);
            }
            smaller_eigenvalues(&xx[1..], &xy[1..], &yy[1..], weights, inner);
        }
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
