//! The features of one image in a layout for matching: what is read together is stored together,
//! with a grid for lookup by position.

use super::GroundFeature;
use crate::image::simd::differing_bits;

/// Maximum Hamming distance, of 256 bits, at which descriptors of one image count as similar. On
/// asphalt, matches then keep two thirds of their weight; joints between tiles, which repeat,
/// hardly any.
const LOOKALIKE_DIFFERENCE: u32 = 40;

/// A picture's features in spots, ordered by x.
#[derive(Debug, Clone, Default)]
pub(super) struct Features {
    pub positions: Vec<[f32; 2]>,
    pub directions_rad: Vec<f32>,
    pub descriptors: Vec<[u64; 4]>,
    /// Weight of a match of each feature: one over the number of similar features in the image,
    /// including itself.
    pub worth: Vec<f32>,
    low: [f32; 2],
    high: [f32; 2],
    cells: FeatureCells,
}

/// The features in each cell of a grid.
#[derive(Debug, Clone, Default)]
struct FeatureCells {
    columns: usize,
    rows: usize,
    per_spot: f32,
    /// Where in `features` each cell begins, row by row, and where the last ends.
    first: Vec<u16>,
    features: Vec<u16>,
}

/// Side of a cell, spots: the search radius around a position.
const CELL: f32 = 12.0;

/// Maximum number of cells along a side, whatever the positions in a file are.
const MAX_CELLS: f32 = 64.0;

impl Features {
    pub fn new(features: &[GroundFeature], spot_m: f64) -> Self {
        let scale = (1.0 / spot_m) as f32;
        let in_spots = |feature: &GroundFeature| GroundFeature {
            position_m: feature.position_m.map(|metres| metres * scale),
            ..*feature
        };
        let mut features: Vec<_> = features.iter().take(super::MAX_FEATURES).map(in_spots).collect();
        features.sort_by(|a, b| {
            let by_place = |k: usize| a.position_m[k].total_cmp(&b.position_m[k]);
            by_place(0).then(by_place(1)).then(a.descriptor.cmp(&b.descriptor))
        });
        let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
        for feature in &features {
            for k in 0..2 {
                low[k] = low[k].min(feature.position_m[k]);
                high[k] = high[k].max(feature.position_m[k]);
            }
        }
        let positions: Vec<_> = features.iter().map(|feature| feature.position_m).collect();
        let descriptors: Vec<_> = features.iter().map(|feature| feature.descriptor).collect();
        Self {
            worth: worth(&descriptors),
            cells: FeatureCells::new(&positions, low, high),
            directions_rad: features.iter().map(|feature| feature.direction_rad).collect(),
            positions,
            descriptors,
            low,
            high,
        }
    }

    /// Number of features.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Centre of the bounding box.
    pub fn middle(&self) -> [f32; 2] {
        std::array::from_fn(|k| 0.5 * (self.low[k] + self.high[k]))
    }

    pub fn covers(&self, [x, y]: [f32; 2]) -> bool {
        x >= self.low[0] && x <= self.high[0] && y >= self.low[1] && y <= self.high[1]
    }

    /// The features within `radius` of a position and some around them, in no particular order.
    pub fn around(&self, [x, y]: [f32; 2], radius: f32) -> impl Iterator<Item = usize> {
        let cells = &self.cells;
        let cell = |k: usize, at: f32, count: usize| cells.along(at - self.low[k], count);
        let (left, right) = (cell(0, x - radius, cells.columns), cell(0, x + radius, cells.columns));
        let (top, bottom) = (cell(1, y - radius, cells.rows), cell(1, y + radius, cells.rows));
        let rows = (!cells.features.is_empty()).then_some(top..=bottom);
        rows.into_iter().flatten().flat_map(move |row| {
            let at = row * cells.columns;
            let features = cells.first[at + left] as usize..cells.first[at + right + 1] as usize;
            cells.features[features].iter().map(|&feature| feature as usize)
        })
    }
}

impl FeatureCells {
    fn new(positions: &[[f32; 2]], low: [f32; 2], high: [f32; 2]) -> Self {
        if positions.is_empty() {
            return Self::default();
        }
        let sides = [high[0] - low[0], high[1] - low[1]];
        let per_spot = 1.0 / CELL.max(sides[0].max(sides[1]) / MAX_CELLS);
        let [columns, rows] = sides.map(|side| (side * per_spot) as usize + 1);
        let mut cells = Self { columns, rows, per_spot, ..Self::default() };
        let cell_of = |position: &[f32; 2]| {
            cells.along(position[1] - low[1], rows) * columns + cells.along(position[0] - low[0], columns)
        };
        let cell_of: Vec<usize> = positions.iter().map(cell_of).collect();
        let mut first = vec![0u16; columns * rows + 1];
        cell_of.iter().for_each(|&cell| first[cell + 1] += 1);
        for cell in 0..columns * rows {
            first[cell + 1] += first[cell];
        }
        cells.features = (0..positions.len() as u16).collect();
        cells.features.sort_by_key(|&feature| cell_of[feature as usize]);
        cells.first = first;
        cells
    }

    /// Index along an axis of the cell, of `count`, at a coordinate in spots, clamped to the
    /// outermost.
    fn along(&self, spots: f32, count: usize) -> usize {
        ((spots * self.per_spot) as usize).min(count.saturating_sub(1))
    }
}

fn worth(descriptors: &[[u64; 4]]) -> Vec<f32> {
    let mut alike = vec![1u16; descriptors.len()];
    let mut differences = vec![0; descriptors.len()];
    for (i, one) in descriptors.iter().enumerate() {
        differing_bits(one, &descriptors[..i], &mut differences[..i]);
        for (j, _) in differences[..i].iter().enumerate().filter(|(_, bits)| **bits <= LOOKALIKE_DIFFERENCE) {
            alike[i] += 1;
            alike[j] += 1;
        }
    }
    alike.into_iter().map(|alike| 1.0 / f32::from(alike)).collect()
}
