//! Adaptive threshold: dark pixels relative to their surroundings.

use odograph::image::GrayImage;

/// Side of the tiles on which the threshold is computed, pixels.
const TILE: usize = 4;
/// Standard deviation below which an area is uniform, gray levels: noise of 4 levels must not be
/// detected as print.
const PLAIN: f64 = 6.0;

/// A binarised image.
pub(super) struct Dark {
    pub width: usize,
    pub height: usize,
    /// 1 for dark pixels, in row-major order.
    pub dark: Vec<u8>,
    /// The threshold of each tile; 0 in uniform areas.
    thresholds: Vec<u8>,
    tiles_across: usize,
}

impl Dark {
    /// Binarises an image. A pixel is dark if it is below the mean of the tiles within `reach`
    /// minus `below` standard deviations (W. Niblack, "An introduction to digital image
    /// processing", 1986, page 115); the threshold is computed per tile. Uniform areas are never
    /// dark, so a marker larger than the window becomes a ring, whose outer outline is still that
    /// of the marker.
    ///
    /// The threshold is below the midpoint on purpose: it separates squares that touch at their
    /// corners.
    pub fn new(image: &GrayImage, reach: usize, below: f64) -> Self {
        let (width, height) = (image.width(), image.height());
        let (across, down) = (width.div_ceil(TILE), height.div_ceil(TILE));
        // Integral images of the sum and of the sum of squares over tiles, with a margin of one at
        // the left and top.
        let stride = across + 1;
        let mut sums = vec![(0u64, 0u64); stride * (down + 1)];
        let mut row_of_tiles = vec![(0u32, 0u32); across];
        for tile_y in 0..down {
            row_of_tiles.fill((0, 0));
            for y in tile_y * TILE..((tile_y + 1) * TILE).min(height) {
                for (tile, samples) in row_of_tiles.iter_mut().zip(image.row(y).chunks(TILE)) {
                    for &sample in samples {
                        let sample = u32::from(sample);
                        tile.0 += sample;
                        tile.1 += sample * sample;
                    }
                }
            }
            let mut row = (0u64, 0u64);
            for (tile_x, tile) in row_of_tiles.iter().enumerate() {
                row.0 += u64::from(tile.0);
                row.1 += u64::from(tile.1);
                let above = sums[tile_y * stride + tile_x + 1];
                sums[(tile_y + 1) * stride + tile_x + 1] = (above.0 + row.0, above.1 + row.1);
            }
        }
        let mut thresholds = vec![0u8; across * down];
        for tile_y in 0..down {
            let (top, bottom) = (tile_y.saturating_sub(reach), (tile_y + reach + 1).min(down));
            let rows = (bottom * TILE).min(height) - top * TILE;
            for tile_x in 0..across {
                let (left, right) = (tile_x.saturating_sub(reach), (tile_x + reach + 1).min(across));
                let count = (rows * ((right * TILE).min(width) - left * TILE)) as f64;
                let corner = |x: usize, y: usize| sums[y * stride + x];
                let (a, b, c, d) =
                    (corner(left, top), corner(right, top), corner(left, bottom), corner(right, bottom));
                let mean = (d.0 + a.0 - b.0 - c.0) as f64 / count;
                let variance = (d.1 + a.1 - b.1 - c.1) as f64 / count - mean * mean;
                if variance > PLAIN * PLAIN {
                    thresholds[tile_y * across + tile_x] =
                        (mean - below * variance.sqrt()).clamp(0.0, 255.0) as u8;
                }
            }
        }
        let mut dark = vec![0u8; width * height];
        for (y, row) in dark.chunks_exact_mut(width.max(1)).enumerate() {
            let of_tiles = &thresholds[y / TILE * across..][..across];
            for ((out, samples), &threshold) in
                row.chunks_mut(TILE).zip(image.row(y).chunks(TILE)).zip(of_tiles)
            {
                for (out, &sample) in out.iter_mut().zip(samples) {
                    *out = u8::from(sample < threshold);
                }
            }
        }
        Self { width, height, dark, thresholds, tiles_across: across }
    }

    /// Whether a pixel is dark; false outside the image.
    pub fn at(&self, x: i32, y: i32) -> bool {
        (x as u32 as usize) < self.width
            && (y as u32 as usize) < self.height
            && self.dark[y as usize * self.width + x as usize] != 0
    }

    /// The threshold applied to a pixel of the image.
    pub fn threshold(&self, x: usize, y: usize) -> u8 {
        self.thresholds[y / TILE * self.tiles_across + x / TILE]
    }
}
