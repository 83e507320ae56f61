//! Gradients of the cells and their temporal statistics.

use super::MIN_NOISE;
use super::image_mask::{CELL_PX, ImageMask, cells};
use crate::image::GrayImage;

/// The sums of the 16 samples of each cell, 0 to 4080, and the noise of each block of cells.
#[derive(Debug)]
pub(super) struct Cells {
    columns: usize,
    rows: usize,
    sums: Vec<i16>,
    /// Sums of four rows along each column.
    band: Vec<u16>,
    /// Variance of what is uncorrelated between neighbouring pixels of each block, gray levels²; at
    /// least the median of all blocks, as one block alone has few samples.
    noise: Vec<f32>,
    sorted: Vec<f32>,
}

/// Expected squared gradient of a cell per unit of pixel noise variance: two components, each the
/// difference of two sums of 16 samples.
const GRADIENT_NOISE: f64 = 64.0;

impl Cells {
    pub fn new(size: (usize, usize)) -> Self {
        let (columns, rows) = cells(size);
        let noise = vec![0.0; (columns / BLOCK) * (rows / BLOCK)];
        let (sums, band, sorted) = (vec![0; columns * rows], vec![0; size.0], noise.clone());
        Self { columns, rows, sums, band, noise, sorted }
    }

    /// Computes the sums of an image, which must have the size given to [`Cells::new`].
    pub fn fill(&mut self, image: &GrayImage) {
        let Self { columns, band, sums, noise, sorted, .. } = self;
        for (row, sums) in sums.chunks_exact_mut(*columns).enumerate() {
            band.fill(0);
            for y in (row * CELL_PX..(row + 1) * CELL_PX).take_while(|&y| y < image.height()) {
                band.iter_mut().zip(image.row(y)).for_each(|(sum, &sample)| *sum += u16::from(sample));
            }
            for (sum, four) in sums.iter_mut().zip(band.chunks_exact(CELL_PX)) {
                *sum = four.iter().sum::<u16>() as i16;
            }
        }
        if noise.is_empty() {
            return;
        }
        for (row, noise) in noise.chunks_exact_mut(*columns / BLOCK).enumerate() {
            noise.fill(0.0);
            for y in (row * BLOCK_PX..(row + 1) * BLOCK_PX).skip(1).step_by(NOISE_ROWS) {
                if y + 1 < image.height() {
                    add_noise(noise, [image.row(y - 1), image.row(y), image.row(y + 1)]);
                }
            }
        }
        sorted.copy_from_slice(noise);
        let median = *sorted.select_nth_unstable_by(noise.len() / 2, f32::total_cmp).1;
        noise.iter_mut().for_each(|noise| *noise = noise.max(median));
    }

    /// Forward differences (to the right and below) of the cells of a row that have both
    /// neighbours.
    fn gradients(&self, row: usize) -> impl Iterator<Item = (i16, i16)> {
        let here = &self.sums[row * self.columns..][..self.columns];
        let below = &self.sums[(row + 1) * self.columns..][..self.columns];
        let across = here.windows(2).map(|pair| pair[1] - pair[0]);
        across.zip(here.iter().zip(below).map(|(here, below)| below - here))
    }
}

/// Change between two images, in blocks of 4x4 cells.
#[derive(Debug)]
pub(super) struct Change {
    /// Number of blocks; number of unmasked blocks with texture; number of those that have moved.
    pub blocks: usize,
    pub textured: usize,
    pub moved: usize,
    /// Per block: squared gradient differences, sum of the squared gradients of both images, and
    /// sums of the gradients (x and y of each image).
    differences: Vec<f32>,
    energies: Vec<f32>,
    slopes: Vec<[i32; 4]>,
    sorted: Vec<f32>,
    columns: usize,
}

/// Side length of a block, cells and pixels.
const BLOCK: usize = 4;
const BLOCK_PX: usize = BLOCK * CELL_PX;

/// The noise of a block is measured in every fourth row: 56 samples, a third of which are
/// independent.
const NOISE_ROWS: usize = 4;

/// Adds to each block its share of the noise variance in the middle one of three rows of pixels:
/// the mean square of the mask of Immerkær (see [`crate::image::noise_variance`]).
fn add_noise(blocks: &mut [f32], [above, here, below]: [&[u8]; 3]) {
    const WEIGHTS_SQUARED: usize = 36;
    const SAMPLES: usize = (BLOCK_PX - 2) * (BLOCK_PX / NOISE_ROWS);
    let rows = [above, here, below].map(|row| row.as_chunks::<BLOCK_PX>().0);
    for (block, ((above, here), below)) in blocks.iter_mut().zip(rows[0].iter().zip(rows[1]).zip(rows[2])) {
        let across: [i16; BLOCK_PX] =
            std::array::from_fn(|i| i16::from(above[i]) - 2 * i16::from(here[i]) + i16::from(below[i]));
        let square = |i: usize| i32::from(across[i] - 2 * across[i + 1] + across[i + 2]).pow(2);
        let squares: i32 = (0..BLOCK_PX - 2).map(square).sum();
        *block += squares as f32 / (WEIGHTS_SQUARED * SAMPLES) as f32;
    }
}

/// Minimum ratio of a block's squared gradients to their noise expectation for it to have texture.
const TEXTURED: f32 = 2.0;

/// Minimum ratio of the squared gradient differences to the squared gradients of both images for a
/// block to have moved; for uncorrelated gradients the ratio is 1.
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

    /// Compares two images. The noise is that of each block itself: its variance over the image and
    /// over time varies with exposure, and noise that exceeds its estimate looks like moved
    /// texture.
    pub fn between(&mut self, last: &Cells, now: &Cells, mask: Option<&ImageMask>) {
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
                // The last block of a row may lack a column.
                for ((ax, ay), (bx, by)) in gradients.by_ref().take(BLOCK) {
                    let square =
                        |x: i16, y: i16| (i32::from(x) * i32::from(x) + i32::from(y) * i32::from(y)) as f32;
                    *difference += square(bx - ax, by - ay);
                    *energy += square(ax, ay) + square(bx, by);
                    slopes.iter_mut().zip([ax, ay, bx, by]).for_each(|(sum, own)| *sum += i32::from(own));
                }
            }
        }
        // Subtract the mean gradient of the block: smooth shading is a constant slope, not texture.
        for ((difference, energy), slopes) in
            self.differences.iter_mut().zip(&mut self.energies).zip(&self.slopes)
        {
            let [ax, ay, bx, by] = slopes.map(|sum| sum as f32);
            let share = 1.0 / (BLOCK * BLOCK) as f32;
            *difference -= share * ((bx - ax).powi(2) + (by - ay).powi(2));
            *energy -= share * (ax * ax + ay * ay + bx * bx + by * by);
        }
        let (gains, least) = ((GRADIENT_NOISE * (BLOCK * BLOCK) as f64) as f32, MIN_NOISE as f32);
        let noises =
            last.noise.iter().zip(&now.noise).map(|(last, now)| gains * (last.max(least) + now.max(least)));
        let blocks = self.differences.iter().zip(&self.energies).zip(noises);
        for (block, ((difference, energy), by_noise)) in blocks.enumerate() {
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

    /// Upper bound of the pixel noise variance of the two images, gray levels²: from the blocks
    /// that differ least (5th percentile).
    pub fn least_noise(&mut self) -> f64 {
        const FEW: usize = 20;
        // Of blocks that contain noise alone, 5 % are below this fraction of their mean.
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

/// Temporal mean and variance of the gradient of each cell.
#[derive(Debug)]
pub(super) struct GradientStatistics {
    columns: usize,
    rows: usize,
    samples: u32,
    added: u32,
    mean_x: Vec<f32>,
    mean_y: Vec<f32>,
    square: Vec<f32>,
    /// Means over the neighbourhood of a cell: the structure tensor of the static gradients (xx,
    /// xy, yy) and the variance.
    around: [Vec<f32>; 4],
    along: [Vec<f32>; 3],
    /// The structure tensor of the static cells alone, over a larger neighbourhood.
    shape: [Vec<f32>; 3],
    fixed: Vec<bool>,
    grown: Vec<bool>,
    /// Whether a cell is static by the weaker criterion that applies next to a static cell.
    also: Vec<bool>,
    /// One where a cell is static and no ground moves below it, else zero; then its mean.
    hides: Vec<f32>,
}

/// Memory of the exponential moving average, samples: dirt that appears during the drive is found
/// after about this many.
const MAX_SAMPLES: u32 = 48;

/// Neighbourhood radius, cells: 5x5 cells are 20 pixels, the size of a patch.
const REACH: usize = 2;

/// A cell is static where its mean squared gradient exceeds the noise and the temporal variance by
/// these factors.
const OVER_NOISE: f32 = 1.5;
const OVER_VARIANCE: f32 = 4.0;

/// Minimum ratio of the smaller to the larger eigenvalue of the structure tensor within
/// `SHAPE_REACH` cells: static gradients must have two directions. An edge along the direction of
/// travel, such as a floor joint, is static as well (aperture problem).
const SHAPE_REACH: usize = 5;
const TWO_DIRECTIONS: f32 = 0.05;

/// The same ratio within `REACH` cells: a joint beside a bumper is not static.
const OWN_DIRECTIONS: f32 = 0.008;

/// A static thing continues where this part of the cells within `HIDING_REACH` is static and hides
/// the ground, whatever the directions there, as over the stripes of a bumper. A joint beside it is
/// narrow: with [`REACH`], six of the thirteen cells across. Chosen on two bumpers with stripes.
const HIDING_REACH: usize = 6;
const HIDING_SHARE: f32 = 0.6;

/// Weaker variance factor for up to `GROWN_CELLS` cells around a static cell, where a patch would
/// include both.
const ALSO_OVER_VARIANCE: f32 = 0.2;
const GROWN_CELLS: usize = 4;

/// A cell moves where its mean squared gradient is below `MOVES` times its variance. At least
/// `MIN_MOVING` of the textured cells must move: a camera that vibrates about one position blurs
/// everything alike.
const MOVES: f32 = 0.5;
const MIN_MOVING: f64 = 0.25;

/// Ground moves in a cell whose variance is more than this multiple of what noise explains.
const MOVING_OVER_NOISE: f32 = 1.5;

/// A pattern that lies over moving ground covers at least this part of the image. Ten dead lines
/// had 0.36 to 0.46. Chosen on two drives with these and one of a thermal camera.
const MUCH: f64 = 0.3;

/// Static gradients are everywhere if their square exceeds this part of the variance in most cells.
/// Measured after twelve samples: 0.8 of the cells of a sensor in the dark; of clean drives at most
/// 0.02, and half of those along bricks, whose joints have one direction.
const PATTERN_OVER_VARIANCE: f32 = 0.25;
const MOST: f64 = 0.6;

impl GradientStatistics {
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
            hides: none(),
        }
    }

    /// Effective number of samples of the moving average.
    pub fn samples(&self) -> u32 {
        self.samples
    }

    /// Total number of samples added.
    pub fn added(&self) -> u32 {
        self.added
    }

    pub fn add(&mut self, cells: &Cells) {
        self.samples = (self.samples + 1).min(MAX_SAMPLES);
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

    /// Whether the static gradients are not those of a thing, but are all over the image: a pattern
    /// that the camera adds. Known after [`GradientStatistics::find_fixed_cells`].
    pub fn is_everywhere(&self) -> bool {
        let cells = self.fixed.len() as f64;
        let has = |at: &usize| {
            let [xx, _, yy, variance] = [0, 1, 2, 3].map(|i| self.around[i][*at]);
            xx + yy > PATTERN_OVER_VARIANCE * variance
        };
        let [xx, xy, yy] =
            [0, 1, 2].map(|i| self.around[i].iter().map(|&value| f64::from(value)).sum::<f64>());
        (0..self.fixed.len()).filter(has).count() as f64 > MOST * cells
            && has_two_directions((xx, xy, yy), f64::from(TWO_DIRECTIONS))
    }

    /// Whether much of the image is static, and ground moves below most of that: unlike a thing, a
    /// pattern that the camera adds hides nothing. Known after
    /// [`GradientStatistics::find_fixed_cells`], which takes the same `noise`.
    pub fn lies_over_moving_ground(&self, noise: f64) -> bool {
        let noise = (GRADIENT_NOISE * noise) as f32;
        let (mut fixed, mut varying) = (0usize, 0usize);
        for (_, variance) in self.fixed.iter().zip(&self.around[3]).filter(|(fixed, _)| **fixed) {
            fixed += 1;
            varying += usize::from(*variance > MOVING_OVER_NOISE * noise);
        }
        fixed as f64 > MUCH * self.fixed.len() as f64 && 2 * varying > fixed
    }

    /// Finds the static cells, dilated so that no patch outside them includes static texture.
    /// `noise` is the pixel noise variance, gray levels².
    pub fn find_fixed_cells(&mut self, noise: f64) {
        self.sum_up();
        let noise = (GRADIENT_NOISE * noise) as f32;
        let samples = self.samples as f32;
        let (mut textured, mut moving) = (0usize, 0usize);
        for at in 0..self.fixed.len() {
            let [xx, xy, yy, variance] = [0, 1, 2, 3].map(|i| self.around[i][at]);
            let energy = xx + yy;
            let ground = (variance - MOVING_OVER_NOISE * noise).max(0.0);
            let stays = energy > (OVER_NOISE * noise).max(OVER_VARIANCE * ground);
            self.fixed[at] = stays;
            self.hides[at] = f32::from(u8::from(stays && variance < MOVING_OVER_NOISE * noise));
            for (shape, own) in self.shape.iter_mut().zip([xx, xy, yy]) {
                shape[at] = if stays { own } else { 0.0 };
            }
            // Variance of the mean of independent samples: the remaining energy of a moving cell.
            let by_chance = variance / samples;
            self.also[at] = energy > noise.max(ALSO_OVER_VARIANCE * ground + by_chance);
            if energy + variance > 3.0 * noise {
                textured += 1;
                moving += usize::from(energy < MOVES * variance);
            }
        }
        if (moving as f64) < MIN_MOVING * textured as f64 || !self.fixed.contains(&true) {
            self.fixed.fill(false);
            return;
        }
        for (shape, along) in self.shape.iter_mut().zip(&mut self.along) {
            mean_around(shape, along, (self.columns, self.rows), SHAPE_REACH);
        }
        for (at, fixed) in self.fixed.iter_mut().enumerate().filter(|(_, fixed)| **fixed) {
            let has = |part: f32, tensor: &[Vec<f32>]| {
                let [xx, xy, yy] = [0, 1, 2].map(|i| f64::from(tensor[i][at]));
                has_two_directions((xx, xy, yy), f64::from(part))
            };
            *fixed = has(TWO_DIRECTIONS, &self.shape) && has(OWN_DIRECTIONS, &self.around);
        }
        self.grow();
        if self.continue_where_ground_is_hidden() {
            self.grow();
        }
        self.widen(false);
        self.continue_to_the_border();
    }

    /// The last row and column have no neighbours, hence no gradients of their own.
    fn continue_to_the_border(&mut self) {
        for row in self.fixed.chunks_exact_mut(self.columns) {
            if let [.., before, last] = row {
                *last |= *before;
            }
        }
        if self.rows > 1 {
            let (before, last) = self.fixed.split_at_mut((self.rows - 1) * self.columns);
            let before = &before[(self.rows - 2) * self.columns..];
            last.iter_mut().zip(before).for_each(|(last, before)| *last |= before);
        }
    }

    /// Dilates the static cells by those next to them that pass the weaker criterion.
    fn grow(&mut self) {
        for _ in 0..GROWN_CELLS {
            self.widen(true);
        }
    }

    /// Continues the static cells over all near cells around which the ground is hidden. Returns
    /// whether there are any: their border, where ground is near, is not among them.
    fn continue_where_ground_is_hidden(&mut self) -> bool {
        let mut continues = false;
        mean_around(&mut self.hides, &mut self.along[0], (self.columns, self.rows), HIDING_REACH);
        let mut open: Vec<usize> = (0..self.fixed.len()).filter(|&at| self.fixed[at]).collect();
        while let Some(at) = open.pop() {
            let near =
                |at: usize, end: usize| at.saturating_sub(HIDING_REACH)..(at + HIDING_REACH + 1).min(end);
            for row in near(at / self.columns, self.rows) {
                for column in near(at % self.columns, self.columns) {
                    let next = row * self.columns + column;
                    if !self.fixed[next] && self.hides[next] > HIDING_SHARE {
                        self.fixed[next] = true;
                        continues = true;
                        open.push(next);
                    }
                }
            }
        }
        continues
    }

    /// The static cells that were found.
    pub fn fixed(&self) -> &[bool] {
        &self.fixed
    }

    /// Dilates the static cells by one cell; with `only_also` restricted to cells that pass the
    /// weaker criterion.
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

    /// Computes the neighbourhood means of each cell.
    fn sum_up(&mut self) {
        let samples = self.samples as f32;
        let unbiased = samples / (samples - 1.0).max(1.0);
        for at in 0..self.fixed.len() {
            let (x, y) = (self.mean_x[at], self.mean_y[at]);
            let variance = unbiased * (self.square[at] - x * x - y * y).max(0.0);
            // Bias of the squared mean: half of the variance (two components) over the number of
            // samples.
            let chance = 0.5 * variance / samples;
            let own = [x * x - chance, x * y, y * y - chance, variance];
            self.around.iter_mut().zip(own).for_each(|(around, own)| around[at] = own);
            (self.shape[0][at], self.shape[1][at]) = (x, y);
        }
        let size = (self.columns, self.rows);
        let smoothed = self.around.iter_mut().chain(self.shape.iter_mut().take(2));
        smoothed.for_each(|values| mean_around(values, &mut self.along[0], size, REACH));
        // Subtract the tensor of the mean gradient: smooth shading is a constant slope over a patch
        // and does not affect tracking.
        for at in 0..self.fixed.len() {
            let (x, y) = (self.shape[0][at], self.shape[1][at]);
            for (around, slope) in self.around.iter_mut().zip([x * x, x * y, y * y]) {
                around[at] -= slope;
            }
        }
    }
}

/// Whether the smaller eigenvalue of a structure tensor (xx, xy, yy) is more than this part of the
/// larger one.
fn has_two_directions((xx, xy, yy): (f64, f64, f64), part: f64) -> bool {
    let (half, lean) = (0.5 * (xx + yy), (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt());
    half - lean > part * (half + lean)
}

/// Box filter: replaces each value by the mean of those within `reach` cells.
fn mean_around(values: &mut [f32], along: &mut [f32], (columns, rows): (usize, usize), reach: usize) {
    for (own, sums) in values.chunks_exact(columns).zip(along.chunks_exact_mut(columns)) {
        sums.fill(0.0);
        for shift in 0..=2 * reach {
            let (from, to) = (shift.saturating_sub(reach), reach.saturating_sub(shift));
            let others = own.get(from..).unwrap_or_default();
            sums.iter_mut().skip(to).zip(others).for_each(|(sum, other)| *sum += other);
        }
        for (column, sum) in sums.iter_mut().enumerate() {
            *sum /= ((column + reach + 1).min(columns) - column.saturating_sub(reach)) as f32;
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
