//! Gradients of the cells and what becomes of them over time.

use super::image_mask::{CELL_PX, ImageMask, cells};
use crate::image::GrayImage;

/// The sums of the 16 samples of each cell, 0 to 4080.
#[derive(Debug)]
pub(super) struct Cells {
    columns: usize,
    rows: usize,
    sums: Vec<i16>,
    /// The sums of four rows along each column.
    band: Vec<u16>,
}

/// What the noise of a pixel comes to in the squared gradient of a cell: two differences of two sums of 16.
const GRADIENT_NOISE: f64 = 64.0;

impl Cells {
    pub fn new(size: (usize, usize)) -> Self {
        let (columns, rows) = cells(size);
        Self { columns, rows, sums: vec![0; columns * rows], band: vec![0; size.0] }
    }

    /// Takes an image of the size it was made for.
    pub fn fill(&mut self, image: &GrayImage) {
        let Self { columns, band, sums, .. } = self;
        for (row, sums) in sums.chunks_exact_mut(*columns).enumerate() {
            band.fill(0);
            for y in (row * CELL_PX..(row + 1) * CELL_PX).take_while(|&y| y < image.height()) {
                band.iter_mut().zip(image.row(y)).for_each(|(sum, &sample)| *sum += u16::from(sample));
            }
            for (sum, four) in sums.iter_mut().zip(band.chunks_exact(CELL_PX)) {
                *sum = four.iter().sum::<u16>() as i16;
            }
        }
    }

    /// The differences to the cells on the right and below, for the cells of a row that have both.
    fn gradients(&self, row: usize) -> impl Iterator<Item = (i16, i16)> {
        let here = &self.sums[row * self.columns..][..self.columns];
        let below = &self.sums[(row + 1) * self.columns..][..self.columns];
        let across = here.windows(2).map(|pair| pair[1] - pair[0]);
        across.zip(here.iter().zip(below).map(|(here, below)| below - here))
    }
}

/// How much has changed between two images, in blocks of 4x4 cells.
#[derive(Debug)]
pub(super) struct Change {
    /// How many blocks there are, and of those that are not masked how many have texture, and how many of these have moved.
    pub blocks: usize,
    pub textured: usize,
    pub moved: usize,
    /// For each block the squares of the differences of the gradients, the squares of both, and the sums of both along either side.
    differences: Vec<f32>,
    energies: Vec<f32>,
    slopes: Vec<[i32; 4]>,
    sorted: Vec<f32>,
    columns: usize,
}

/// Cells along the side of a block.
const BLOCK: usize = 4;

/// A block has texture when its squared gradients are so many times what noise makes of them.
const TEXTURED: f32 = 2.0;

/// It has moved when the squares of the differences are more than this part of those of both gradients: what is unrelated has all of them.
const MOVED: f32 = 0.5;

impl Change {
    pub fn new(size: (usize, usize)) -> Self {
        let (columns, rows) = cells(size);
        let (columns, rows) = (columns / BLOCK, rows / BLOCK);
        let blocks = columns * rows;
        let none = || vec![0.0; blocks];
        Self {
            blocks,
            textured: 0,
            moved: 0,
            differences: none(),
            energies: none(),
            slopes: vec![[0; 4]; blocks],
            sorted: none(),
            columns,
        }
    }

    /// Compares two images whose pixels have noise of this variance.
    pub fn between(&mut self, last: &Cells, now: &Cells, noise: f64, mask: Option<&ImageMask>) {
        self.differences.fill(0.0);
        self.energies.fill(0.0);
        self.slopes.fill([0; 4]);
        (self.textured, self.moved) = (0, 0);
        let columns = self.columns;
        if columns == 0 {
            return;
        }
        let rows = (now.rows - 1).min(self.blocks / columns * BLOCK);
        for row in 0..rows {
            let first = row / BLOCK * columns;
            let blocks = self.differences[first..][..columns].iter_mut();
            let blocks = blocks.zip(&mut self.energies[first..]).zip(&mut self.slopes[first..]);
            let mut gradients = last.gradients(row).zip(now.gradients(row));
            for ((difference, energy), slopes) in blocks {
                // The last block may lack a column.
                for ((ax, ay), (bx, by)) in gradients.by_ref().take(BLOCK) {
                    let square =
                        |x: i16, y: i16| (i32::from(x) * i32::from(x) + i32::from(y) * i32::from(y)) as f32;
                    *difference += square(bx - ax, by - ay);
                    *energy += square(ax, ay) + square(bx, by);
                    slopes.iter_mut().zip([ax, ay, bx, by]).for_each(|(sum, own)| *sum += i32::from(own));
                }
            }
        }
        // Soft light is a slope all over a block, and no texture.
        for ((difference, energy), slopes) in
            self.differences.iter_mut().zip(&mut self.energies).zip(&self.slopes)
        {
            let [ax, ay, bx, by] = slopes.map(|sum| sum as f32);
            let share = 1.0 / (BLOCK * BLOCK) as f32;
            *difference -= share * ((bx - ax).powi(2) + (by - ay).powi(2));
            *energy -= share * (ax * ax + ay * ay + bx * bx + by * by);
        }
        let by_noise = (2.0 * GRADIENT_NOISE * noise) as f32 * (BLOCK * BLOCK) as f32;
        for (block, (difference, energy)) in self.differences.iter().zip(&self.energies).enumerate() {
            let (column, row) = (block % columns * BLOCK, block / columns * BLOCK);
            let masked = |mask: &ImageMask| {
                mask.covers_cell(column + BLOCK / 2, row + BLOCK / 2) || mask.covers_cell(column, row)
            };
            if *energy > TEXTURED * by_noise && !mask.is_some_and(masked) {
                self.textured += 1;
                self.moved += usize::from(difference - by_noise > MOVED * (energy - by_noise));
            }
        }
    }

    /// At most how much noise the pixels of the two images have, gray levels²: that of the blocks that differ least.
    pub fn least_noise(&mut self) -> f64 {
        const FEW: usize = 20;
        // A twentieth of blocks of noise alone are below this part of their mean.
        const OF_MEAN: f64 = 0.6;
        self.sorted.copy_from_slice(&self.differences);
        let at = self.sorted.len() / FEW;
        if at >= self.sorted.len() {
            return f64::INFINITY;
        }
        let least = f64::from(*self.sorted.select_nth_unstable_by(at, f32::total_cmp).1);
        least / (OF_MEAN * 2.0 * GRADIENT_NOISE * (BLOCK * BLOCK) as f64)
    }
}

/// Mean and variance over time of the gradient of each cell.
#[derive(Debug)]
pub(super) struct Statistics {
    columns: usize,
    rows: usize,
    samples: u32,
    added: u32,
    mean_x: Vec<f32>,
    mean_y: Vec<f32>,
    square: Vec<f32>,
    /// Sums over the surroundings of a cell: the matrix of the fixed gradients (xx, xy, yy) and the variance.
    around: [Vec<f32>; 4],
    along: [Vec<f32>; 3],
    /// The same of what is fixed alone, within a larger reach.
    shape: [Vec<f32>; 3],
    fixed: Vec<bool>,
    grown: Vec<bool>,
    /// Whether a cell has fixed gradients that count beside a cell that is surely fixed.
    also: Vec<bool>,
}

/// Older samples are forgotten at this rate: dirt that comes on the way is found after about as many.
const MOST_SAMPLES: u32 = 48;

/// Cells from the middle to the edge of the surroundings that are judged at once: with those, 20 pixels are, as many as a patch has.
const REACH: usize = 2;

/// Something is fixed where its gradients are this many times above noise, and so many times what varies.
const OVER_NOISE: f32 = 1.5;
const OVER_VARIANCE: f32 = 4.0;

/// It is surely so where, within so many cells, such gradients have two directions: this part of their squares is across the stronger one. An edge along which
/// the camera drives, as the joint of a floor, stays where it is, too.
const SHAPE_REACH: usize = 5;
const TWO_DIRECTIONS: f32 = 0.05;

/// And this part within its own surroundings: beside a bumper a joint is still a joint.
const OWN_DIRECTIONS: f32 = 0.008;

/// Beside such a place (so many cells away) this part of the variance is enough, for there a patch would see both.
const ALSO_OVER_VARIANCE: f32 = 0.2;
const GROWN_CELLS: usize = 4;

/// What moves has fixed gradients below this part of the variance. At least this part of what has texture must: a camera that shakes about one place blurs
/// everything alike.
const MOVES: f32 = 0.5;
const LEAST_MOVING: f64 = 0.25;

impl Statistics {
    pub fn new(size: (usize, usize)) -> Self {
        let (columns, rows) = cells(size);
        let none = || vec![0.0f32; columns * rows];
        let no = || vec![false; columns * rows];
        Self {
            columns,
            rows,
            samples: 0,
            added: 0,
            mean_x: none(),
            mean_y: none(),
            square: none(),
            around: [(); 4].map(|()| none()),
            along: [(); 3].map(|()| none()),
            shape: [(); 3].map(|()| none()),
            fixed: no(),
            grown: no(),
            also: no(),
        }
    }

    /// How many samples the mean is of.
    pub fn samples(&self) -> u32 {
        self.samples
    }

    /// How many samples were ever added.
    pub fn added(&self) -> u32 {
        self.added
    }

    pub fn add(&mut self, cells: &Cells) {
        self.samples = (self.samples + 1).min(MOST_SAMPLES);
        self.added = self.added.wrapping_add(1);
        let weight = 1.0 / self.samples as f32;
        for row in 0..self.rows - 1 {
            let first = row * self.columns;
            let means = self.mean_x[first..].iter_mut().zip(&mut self.mean_y[first..]);
            let states = means.zip(&mut self.square[first..]);
            for (((mean_x, mean_y), square), (x, y)) in states.zip(cells.gradients(row)) {
                let (x, y) = (f32::from(x), f32::from(y));
                *mean_x += weight * (x - *mean_x);
                *mean_y += weight * (y - *mean_y);
                *square += weight * (x * x + y * y - *square);
            }
        }
    }

    /// Which cells are fixed, with what is so near to one that a patch there would see it.
    pub fn fixed_cells(&mut self, noise: f64) -> &[bool] {
        self.sum_up();
        let noise = (GRADIENT_NOISE * noise) as f32;
        let samples = self.samples as f32;
        let (mut textured, mut moving) = (0usize, 0usize);
        for at in 0..self.fixed.len() {
            let [xx, xy, yy, variance] = [0, 1, 2, 3].map(|i| self.around[i][at]);
            let energy = xx + yy;
            let ground = (variance - 1.5 * noise).max(0.0);
            let stays = energy > (OVER_NOISE * noise).max(OVER_VARIANCE * ground);
            self.fixed[at] = stays;
            for (shape, own) in self.shape.iter_mut().zip([xx, xy, yy]) {
                shape[at] = if stays { own } else { 0.0 };
            }
            // The mean of what moves has this left of its variance.
            let by_chance = variance / samples;
            self.also[at] = energy > noise.max(ALSO_OVER_VARIANCE * ground + by_chance);
            if energy + variance > 3.0 * noise {
                textured += 1;
                moving += usize::from(energy < MOVES * variance);
            }
        }
        if (moving as f64) < LEAST_MOVING * textured as f64 || !self.fixed.contains(&true) {
            self.fixed.fill(false);
            return &self.fixed;
        }
        for (shape, along) in self.shape.iter_mut().zip(&mut self.along) {
            mean_around(shape, along, (self.columns, self.rows), SHAPE_REACH);
        }
        for (at, fixed) in self.fixed.iter_mut().enumerate().filter(|(_, fixed)| **fixed) {
            let has = |part: f32, tensor: &[Vec<f32>]| {
                let (xx, xy, yy) = (tensor[0][at], tensor[1][at], tensor[2][at]);
                let (half, lean) = (0.5 * (xx + yy), (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt());
                half - lean > part * (half + lean)
            };
            *fixed = has(TWO_DIRECTIONS, &self.shape) && has(OWN_DIRECTIONS, &self.around);
        }
        for _ in 0..GROWN_CELLS {
            self.widen(true);
        }
        self.widen(false);
        &self.fixed
    }

    /// Takes the neighbours of fixed cells too; only those with fixed gradients, or all.
    fn widen(&mut self, only_also: bool) {
        self.grown.copy_from_slice(&self.fixed);
        for row in 0..self.rows {
            for column in 0..self.columns {
                let at = row * self.columns + column;
                if self.fixed[at] || only_also && !self.also[at] {
                    continue;
                }
                let columns = column.saturating_sub(1)..(column + 2).min(self.columns);
                self.grown[at] = (row.saturating_sub(1)..(row + 2).min(self.rows))
                    .any(|r| self.fixed[r * self.columns..][columns.clone()].contains(&true));
            }
        }
        std::mem::swap(&mut self.fixed, &mut self.grown);
    }

    /// The means over the surroundings of each cell.
    fn sum_up(&mut self) {
        let samples = self.samples as f32;
        let unbiased = samples / (samples - 1.0).max(1.0);
        for at in 0..self.fixed.len() {
            let (x, y) = (self.mean_x[at], self.mean_y[at]);
            let variance = unbiased * (self.square[at] - x * x - y * y).max(0.0);
            // So much of the squares of the means is chance.
            let chance = 0.5 * variance / samples;
            let own = [x * x - chance, x * y, y * y - chance, variance];
            self.around.iter_mut().zip(own).for_each(|(around, own)| around[at] = own);
            (self.shape[0][at], self.shape[1][at]) = (x, y);
        }
        let size = (self.columns, self.rows);
        let smoothed = self.around.iter_mut().chain(self.shape.iter_mut().take(2));
        smoothed.for_each(|values| mean_around(values, &mut self.along[0], size, REACH));
        // Light that falls off softly is a slope, which is the same all over a patch and moves nothing.
        for at in 0..self.fixed.len() {
            let (x, y) = (self.shape[0][at], self.shape[1][at]);
            for (around, slope) in self.around.iter_mut().zip([x * x, x * y, y * y]) {
                around[at] -= slope;
            }
        }
    }
}

/// Makes of each cell's value the mean of those within `reach` cells.
fn mean_around(values: &mut [f32], along: &mut [f32], (columns, rows): (usize, usize), reach: usize) {
    for (own, sums) in values.chunks_exact(columns).zip(along.chunks_exact_mut(columns)) {
        for (column, sum) in sums.iter_mut().enumerate() {
            let near = column.saturating_sub(reach)..(column + reach + 1).min(columns);
            *sum = own[near.clone()].iter().sum::<f32>() / near.len() as f32;
        }
    }
    for row in 0..rows {
        let near = row.saturating_sub(reach)..(row + reach + 1).min(rows);
        let share = 1.0 / near.len() as f32;
        let sums = &mut values[row * columns..][..columns];
        sums.fill(0.0);
        for other in near {
            let other = &along[other * columns..][..columns];
            sums.iter_mut().zip(other).for_each(|(sum, other)| *sum += share * other);
        }
    }
}
