//! Corner detection (subsystem 3, objects of interest): the minimum eigenvalue of the structure
//! tensor over a window (J. Shi and C. Tomasi, "Good features to track", 1994).

mod strengths;

use crate::fixed_pattern::ImageMask;
use crate::image::GrayImage;
use crate::image::simd::mark_local_maxima;
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use strengths::Strengths;

/// Weighting of the window over which the structure tensor is summed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Window {
    /// Uniform weights.
    Rectangular,
    /// Binomial weights (approximately Gaussian) of the same extent.
    Gaussian,
}

/// Parameters of the corner detector.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DetectionConfig {
    /// Maximum number of corners.
    pub corners: usize,
    /// Minimum distance between corners, pixels.
    pub minimum_distance_px: f64,
    /// Minimum corner strength as a fraction of the strongest corner's. Where fewer than a quarter
    /// of `corners` pass, the threshold is lowered to a tenth of this: on plain tiles the crossings
    /// of joints are strong, and all alike.
    pub quality: f32,
    /// Weighting of the window.
    pub window: Window,
    /// Window radius r: the window is 2 r + 1 pixels wide.
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
    /// Column, pixels.
    pub x: usize,
    /// Row, pixels.
    pub y: usize,
    /// Minimum eigenvalue of the mean structure tensor over the window, (gray levels per pixel)².
    pub strength: f32,
}

/// Detects up to `config.corners` corners at least `margin_px` from the image border, spread over
/// the image; strongest first within each round.
///
/// The image is divided into cells of equal area. In each round every cell contributes its
/// strongest remaining corner that keeps the minimum distance, until enough are chosen. A texture
/// that is strong in one part of the image thus does not attract all corners. The image is at most
/// 65,536 pixels wide and high.
pub fn detect(image: &GrayImage, config: &DetectionConfig, margin_px: usize) -> Vec<Corner> {
    Detection::new((image.width(), image.height()), config, margin_px).corners(image)
}

/// Minimum corner strength, (gray levels per pixel)²; weaker ones are 8-bit quantisation, not
/// texture.
const SMALLEST_STRENGTH: f32 = 0.02;

/// Upper bound of the corner strength in an 8-bit image, (gray levels per pixel)²: half of the
/// largest sum of squares of both Scharr gradients at one pixel.
const GREATEST_STRENGTH: f32 = 11_304.0;

/// Incremental corner detection, a part of the image at a time; the result equals that of
/// [`detect`].
#[derive(Debug)]
pub struct Detection {
    size: (usize, usize),
    config: DetectionConfig,
    margin: usize,
    strengths: Strengths,
    /// The next row whose strengths are computed.
    next: usize,
    /// The strengths of the last three rows.
    last: [Vec<f32>; 3],
    /// Local-maximum flags of a row, 0 or 1; the length is rounded up to a multiple of [`MARKS`].
    marks: Vec<u8>,
    /// Local maxima of 8-neighbourhoods that pass the threshold relative to the strongest before
    /// them, in reading order.
    maxima: Vec<Ranked>,
    strongest: f32,
    /// Pixels without corners, and the pyramid level (number of halvings) of the detection image
    /// relative to the mask.
    mask: Option<(Arc<ImageMask>, u32)>,
}

impl Detection {
    /// A detection in images of this size. No row is processed yet.
    pub fn new(size: (usize, usize), config: &DetectionConfig, margin_px: usize) -> Self {
        let (width, height) = size;
        let margin = margin_px.max(1);
        let none = width <= 2 * margin || height <= 2 * margin;
        Self {
            size,
            config: *config,
            margin,
            strengths: Strengths::new(size, config),
            next: if none { height } else { 0 },
            last: [(); 3].map(|()| vec![0.0; width]),
            marks: vec![0; width.next_multiple_of(MARKS)],
            maxima: Vec::new(),
            strongest: 0.0,
            mask: None,
        }
    }

    /// Excludes masked pixels from detection. `halvings` is the pyramid level of the detection
    /// image; the mask is for level 0.
    pub fn without(mut self, mask: Option<Arc<ImageMask>>, halvings: u32) -> Self {
        self.mask = mask.map(|mask| (mask, halvings));
        self
    }

    /// Processes the rows before row `until`.
    pub fn look(&mut self, image: &GrayImage, until: usize) {
        for read in self.next..until.min(self.size.1) {
            let strengths = self.strengths.row(image, read);
            self.last.rotate_left(1);
            self.last[2].copy_from_slice(strengths);
            self.next = read + 1;
            if let Some(y) = read.checked_sub(1) {
                self.find_maxima(y);
            }
        }
    }

    fn find_maxima(&mut self, y: usize) {
        let ((width, height), margin) = (self.size, self.margin);
        if !(margin..height - margin).contains(&y) {
            return;
        }
        let [above, here, below] = &self.last;
        // Ties go to the first in reading order. The threshold grows with the strongest maximum so
        // far, so no maximum is rejected here that would pass the final one.
        let least = SMALLEST_STRENGTH.max(FAINTER * self.config.quality * self.strongest);
        mark_local_maxima(above, here, below, least, &mut self.marks[..width]);
        for (block, marks) in self.marks.as_chunks::<MARKS>().0.iter().enumerate() {
            let mut bits = bits_of(marks);
            while bits != 0 {
                let x = block * MARKS + bits.trailing_zeros() as usize;
                bits &= bits - 1;
                let masked =
                    |(mask, halvings): &(Arc<ImageMask>, u32)| mask.covers(x << halvings, y << halvings);
                if (margin..width - margin).contains(&x) && !self.mask.as_ref().is_some_and(masked) {
                    self.maxima.push(Ranked::new(x, y, here[x]));
                    self.strongest = self.strongest.max(here[x]);
                }
            }
        }
    }

    /// Whether at least `count` corners are certain to be found, whatever the remaining rows
    /// contain.
    ///
    /// This holds where `count` maxima that pass any possible threshold are at least twice the
    /// minimum distance apart. As long as corners are wanted, each of these maxima is either chosen
    /// or suppressed by a chosen one within the minimum distance, and that corner cannot suppress
    /// any other of them.
    pub fn will_find(&self, count: usize) -> bool {
        if count > self.config.corners {
            return false;
        }
        let apart_px = 2.0 * self.config.minimum_distance_px;
        let mut taken: Vec<Corner> = Vec::with_capacity(count);
        for maximum in &self.maxima {
            if taken.len() >= count {
                break;
            }
            let corner = maximum.corner();
            let away = |other: &Corner| {
                (other.x as f64 - corner.x as f64).powi(2) + (other.y as f64 - corner.y as f64).powi(2)
            };
            if corner.strength >= self.config.quality * GREATEST_STRENGTH
                && taken.iter().all(|other| away(other) >= apart_px.powi(2))
            {
                taken.push(corner);
            }
        }
        taken.len() >= count
    }

    /// Processes the remaining rows and selects the corners.
    pub fn corners(mut self, image: &GrayImage) -> Vec<Corner> {
        self.look(image, self.size.1);
        let (least, faintest) =
            (self.config.quality * self.strongest, FAINTER * self.config.quality * self.strongest);
        self.maxima.retain(|candidate| candidate.strength() >= faintest);
        let strong: Vec<Ranked> =
            self.maxima.iter().copied().filter(|candidate| candidate.strength() >= least).collect();
        let chosen = spread(&strong, self.size, &self.config);
        let few = FEW * chosen.len() < self.config.corners;
        if few && strong.len() < self.maxima.len() {
            spread(&self.maxima, self.size, &self.config)
        } else {
            chosen
        }
    }
}

/// If fewer than 1/`FEW` of the wanted corners are found, the threshold is multiplied by `FAINTER`.
const FEW: usize = 4;
const FAINTER: f32 = 0.1;

/// Number of flags processed at a time: the bits of a word.
const MARKS: usize = 64;

/// Packs flags (each 0 or 1) into bits. The multiplication gathers the lowest bits of eight bytes
/// in the highest byte.
fn bits_of(marks: &[u8; MARKS]) -> u64 {
    const GATHER: u64 = 0x0102_0408_1020_4080;
    let eight =
        |(at, marks): (usize, &[u8; 8])| (u64::from_le_bytes(*marks).wrapping_mul(GATHER) >> 56) << (8 * at);
    marks.as_chunks::<8>().0.iter().enumerate().map(eight).fold(0, |bits, eight| bits | eight)
}

/// Selects the strongest candidates cell by cell; see [`detect`].
fn spread(candidates: &[Ranked], size: (usize, usize), config: &DetectionConfig) -> Vec<Corner> {
    if candidates.is_empty() {
        return Vec::new();
    }
    // About four corners per cell: fine enough to spread them, coarse enough to have a choice.
    let cell_px = ((size.0 * size.1) as f64 * 4.0 / config.corners.max(1) as f64).sqrt().max(1.0);
    let columns = (size.0 as f64 / cell_px).ceil() as usize;
    let rows = (size.1 as f64 / cell_px).ceil() as usize;
    let cell_along = |size: usize, cells: usize| -> Vec<usize> {
        (0..size).map(|at| ((at as f64 / cell_px) as usize).min(cells - 1)).collect()
    };
    let (column_of, row_of) = (cell_along(size.0, columns), cell_along(size.1, rows));
    let cell_of = |candidate: &Ranked| row_of[candidate.y()] * columns + column_of[candidate.x()];
    // Counting sort of the candidates by cell.
    let mut ends = vec![0; columns * rows];
    candidates.iter().for_each(|candidate| ends[cell_of(candidate)] += 1);
    let mut total = 0;
    for end in &mut ends {
        total += *end;
        *end = total - *end; // start of the cell until it is filled, then its end
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

/// A corner packed into one integer whose order is the corner order: stronger is larger, and of
/// equals the first in reading order is larger. The high 32 bits are the strength, whose float bits
/// order as the value does because it is positive; the low 32 bits are the inverted position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Ranked(u64);

impl Ranked {
    /// `x` and `y` are below 2¹⁶.
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

/// Candidates of one cell, returned from strongest to weakest. Sorted in parts, because only few of
/// them are requested.
struct Cell<'a> {
    /// Candidates not yet returned; the strongest is last.
    candidates: &'a mut [Ranked],
    /// Number of candidates at the end that are sorted, and stronger than all others.
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

/// Chosen corners in a grid with cells as wide as the minimum distance: a distance check visits
/// nine cells.
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
mod tests;
