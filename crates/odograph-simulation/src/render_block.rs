//! A block of pixels: intersection of its rays with the ground, and sampling of the texture there.

use super::ground::{CHUNK, Chunk, Ground, SAMPLE_SCALE, STRIDE};
use super::photograph::cubic_weights;
use super::scene::{RowView, Scene};
use super::sway::Swaying;
use super::terrain::TerrainSurface;
use odograph::geometry::GroundPoint;
use std::sync::Arc;

/// Side length of the blocks in which an image is rendered, pixels.
pub(super) const BLOCK: usize = 32;
/// Ground farther away than this many camera heights is not rendered; no texture detail is resolved
/// there.
const REACH_IN_HEIGHTS: f32 = 40.0;
/// Minimum and maximum of a set of numbers; ignores NaN.
#[derive(Clone, Copy)]
struct Span {
    least: f32,
    most: f32,
}

impl Span {
    const EMPTY: Self = Self { least: f32::INFINITY, most: f32::NEG_INFINITY };

    fn add(&mut self, value: f32) {
        self.least = self.least.min(value);
        self.most = self.most.max(value);
    }
}

/// Working memory of a block of pixels, reused from block to block.
#[derive(Default)]
pub(super) struct RenderBlock {
    pub(super) left: usize,
    pub(super) top: usize,
    pub(super) columns: usize,
    pub(super) rows: usize,
    /// Ground position of each pixel, in texels from the corner of the first chunk.
    pub(super) x: Vec<f32>,
    pub(super) y: Vec<f32>,
    chunks: Vec<Arc<Chunk>>,
    first_chunk: (i64, i64),
    chunk_columns: usize,
    chunk_rows: usize,
    x_m: Vec<f32>,
    y_m: Vec<f32>,
    /// Relative brightness of the surface at each pixel's intersection, 1 where it is flat.
    pub(super) shade: Vec<f32>,
}

/// Where the pixels of a row sample the texture: the first of 4 × 4 samples of each, and their
/// interpolation weights. An array each, because loops over them are computed four at a time.
pub(super) struct RowSamples {
    is_ground: [bool; BLOCK],
    chunk: [u32; BLOCK],
    start: [u32; BLOCK],
    weights_x: [[f32; BLOCK]; 4],
    weights_y: [[f32; BLOCK]; 4],
}

/// Largest integer not above `x`, and what remains; of numbers from 0 to 4 million, which no block
/// exceeds.
#[inline]
fn texel_and_rest(x: f32) -> (u32, f32) {
    // To this sum, integers are exact and lie in the lowest bits: a conversion saturates, and is
    // therefore not computed four at a time.
    const SHIFT: f32 = (1 << 23) as f32;
    let shifted = x + SHIFT;
    let nearest = shifted - SHIFT;
    let is_above = nearest > x;
    let floor = if is_above { nearest - 1.0 } else { nearest };
    (((shifted.to_bits() & 0x7F_FFFF).wrapping_sub(u32::from(is_above))) & 0x3F_FFFF, x - floor)
}

impl RenderBlock {
    /// Intersects every pixel's ray with the level plane, in metres from the scene's origin; NaN
    /// without an intersection.
    pub(super) fn meet_ground(&mut self, rays: &[[f32; 2]], width: usize, scene: &Scene<'_>) {
        for buffer in [&mut self.x_m, &mut self.y_m, &mut self.x, &mut self.y] {
            buffer.resize(BLOCK * BLOCK, f32::NAN);
        }
        for row in 0..self.rows {
            let RowView { rotation, height, x_m: row_x_m, y_m: row_y_m, .. } = scene.row(self.top + row);
            let rays = &rays[(self.top + row) * width + self.left..][..self.columns];
            let x_m = &mut self.x_m[row * BLOCK..][..self.columns];
            let y_m = &mut self.y_m[row * BLOCK..][..self.columns];
            for ((ray, x_m), y_m) in rays.iter().zip(x_m).zip(y_m) {
                let [x, y] = *ray;
                let down = -(rotation[(2, 0)] * x + rotation[(2, 1)] * y + rotation[(2, 2)]);
                let reach = if down * REACH_IN_HEIGHTS > 1.0 { *height / down } else { f32::NAN };
                *x_m = row_x_m + reach * (rotation[(0, 0)] * x + rotation[(0, 1)] * y + rotation[(0, 2)]);
                *y_m = row_y_m + reach * (rotation[(1, 0)] * x + rotation[(1, 1)] * y + rotation[(1, 2)]);
            }
        }
    }

    /// Moves every point from the level plane to the first intersection of its ray with the
    /// surface, and evaluates the shading there.
    pub(super) fn meet_surface(&mut self, surface: &TerrainSurface, scene: &Scene<'_>) {
        self.shade.resize(BLOCK * BLOCK, 1.0);
        let Some(bounds) = self.bounds(surface, scene) else { return };
        for row in 0..self.rows {
            let view = scene.row(self.top + row);
            let height = f64::from(view.height);
            let camera = [
                scene.origin.x_m + f64::from(view.x_m),
                scene.origin.y_m + f64::from(view.y_m),
                scene.level_m + height,
            ];
            for at in row * BLOCK..row * BLOCK + self.columns {
                let (x_m, y_m) = (self.x_m[at] - view.x_m, self.y_m[at] - view.y_m);
                if x_m.is_nan() {
                    continue;
                }
                let per_drop = [f64::from(x_m) / height, f64::from(y_m) / height];
                let drop = camera[2] - surface.meet(camera, per_drop, bounds);
                let (x_m, y_m) = (drop * per_drop[0], drop * per_drop[1]);
                self.shade[at] = surface.shade(camera[0] + x_m, camera[1] + y_m);
                self.x_m[at] = view.x_m + x_m as f32;
                self.y_m[at] = view.y_m + y_m as f32;
            }
        }
    }

    /// Bounds, in metres above z = 0, of the heights at which all rays of this block intersect the
    /// surface; `None` where no ray looks down.
    fn bounds(&self, surface: &TerrainSurface, scene: &Scene<'_>) -> Option<(f64, f64)> {
        let (mut x, mut y) = (Span::EMPTY, Span::EMPTY);
        let (mut rows_x, mut rows_y, mut rows_height) = (Span::EMPTY, Span::EMPTY, Span::EMPTY);
        for row in 0..self.rows {
            let view = scene.row(self.top + row);
            rows_x.add(view.x_m);
            rows_y.add(view.y_m);
            rows_height.add(view.height);
            for at in row * BLOCK..row * BLOCK + self.columns {
                x.add(self.x_m[at]);
                y.add(self.y_m[at]);
            }
        }
        if x.least > x.most {
            return None;
        }
        // Extent of the rays between two heights: the points on the level plane, scaled about the
        // camera.
        let over = |(low, high): (f64, f64), points: &Span, cameras: &Span| {
            let mut area = Span::EMPTY;
            for z in [low, high] {
                for height in [rows_height.least, rows_height.most] {
                    let scale = ((f64::from(height) - (z - scene.level_m)) / f64::from(height)) as f32;
                    for camera in [cameras.least, cameras.most] {
                        area.add(camera + scale * (points.least - camera));
                        area.add(camera + scale * (points.most - camera));
                    }
                }
            }
            area
        };
        let mut bounds = (scene.level_m, scene.level_m);
        // Grows the bounds until they contain the surface over the whole extent of the rays between
        // them.
        for _ in 0..12 {
            let (area_x, area_y) = (over(bounds, &x, &rows_x), over(bounds, &y, &rows_y));
            let world =
                |span: Span, origin: f64| (origin + f64::from(span.least), origin + f64::from(span.most));
            let (low, high) =
                surface.bounds(world(area_x, scene.origin.x_m), world(area_y, scene.origin.y_m));
            if bounds.0 <= low && high <= bounds.1 {
                return Some((low, high));
            }
            bounds = (bounds.0.min(low), bounds.1.max(high));
        }
        Some(bounds)
    }

    /// Backward mapping of the sway: moves every point to the rest position of the ground that is
    /// displaced under the pixel.
    pub(super) fn displace(&mut self, sway: &Swaying, scene: &Scene<'_>) {
        for row in 0..self.rows {
            let time_s = scene.row(self.top + row).time_s;
            for at in row * BLOCK..row * BLOCK + self.columns {
                if self.x_m[at].is_nan() {
                    continue;
                }
                let x_m = scene.origin.x_m + f64::from(self.x_m[at]);
                let y_m = scene.origin.y_m + f64::from(self.y_m[at]);
                if let Some((dx_m, dy_m)) = sway.displacement_m(x_m, y_m, time_s) {
                    self.x_m[at] -= dx_m as f32;
                    self.y_m[at] -= dy_m as f32;
                }
            }
        }
    }

    /// Raster level whose texel size matches the footprint of the pixels in the middle of this
    /// block.
    pub(super) fn level(&self, ground: &Ground) -> i32 {
        let (row, column) = ((self.rows - 1) / 2, (self.columns - 1) / 2);
        let at = row * BLOCK + column;
        let step = |next: usize| (self.x_m[next] - self.x_m[at], self.y_m[next] - self.y_m[at]);
        let right = step(if self.columns > 1 { at + 1 } else { at });
        let below = step(if self.rows > 1 { at + BLOCK } else { at });
        let footprint_m = (right.0 * below.1 - right.1 * below.0).abs().sqrt();
        let level = (f64::from(footprint_m) / ground.footprint_m()).log2().round();
        if level.is_finite() { level.clamp(-8.0, 16.0) as i32 } else { 0 }
    }

    /// Converts metres to texels of `level` and determines the required chunks; returns the larger
    /// number of chunks along x or y.
    pub(super) fn place_in_chunks(&mut self, ground: &Ground, origin: GroundPoint, level: i32) -> i64 {
        let texel_m = ground.texel_m(level);
        let per_metre = (1.0 / texel_m) as f32;
        // The origin is split into whole chunks and a remainder, for which single precision
        // suffices.
        let split = |metres: f64| {
            let chunks = (metres / texel_m / CHUNK as f64).floor();
            (chunks as i64, (metres / texel_m - chunks * CHUNK as f64) as f32)
        };
        let ((chunk_x, rest_x), (chunk_y, rest_y)) = (split(origin.x_m), split(origin.y_m));
        // Of each column, because that is computed four columns at a time. NaN is ignored.
        let (mut least_x, mut least_y) = ([f32::INFINITY; BLOCK], [f32::INFINITY; BLOCK]);
        let (mut most_x, mut most_y) = ([f32::NEG_INFINITY; BLOCK], [f32::NEG_INFINITY; BLOCK]);
        for row in 0..self.rows {
            let of_row = row * BLOCK..row * BLOCK + self.columns;
            let metres = self.x_m[of_row.clone()].iter().zip(&self.y_m[of_row.clone()]);
            let texels = self.x[of_row.clone()].iter_mut().zip(&mut self.y[of_row]);
            let least = least_x.iter_mut().zip(&mut least_y);
            let most = most_x.iter_mut().zip(&mut most_y);
            for ((((x_m, y_m), texel), least), most) in metres.zip(texels).zip(least).zip(most) {
                let x = x_m * per_metre + rest_x;
                let y = y_m * per_metre + rest_y;
                (*texel.0, *texel.1) = (x, y);
                *least.0 = if x < *least.0 { x } else { *least.0 };
                *least.1 = if y < *least.1 { y } else { *least.1 };
                *most.0 = if x > *most.0 { x } else { *most.0 };
                *most.1 = if y > *most.1 { y } else { *most.1 };
            }
        }
        let least = [least_x, least_y].map(|of_columns| of_columns.into_iter().fold(f32::INFINITY, f32::min));
        let most =
            [most_x, most_y].map(|of_columns| of_columns.into_iter().fold(f32::NEG_INFINITY, f32::max));
        if !(least[0].is_finite() && least[1].is_finite()) {
            (self.chunk_columns, self.chunk_rows) = (0, 0);
            return 0;
        }
        let chunk_of = |texel: f32| (texel / CHUNK as f32).floor() as i64;
        let (first_x, first_y) = (chunk_of(least[0]), chunk_of(least[1]));
        self.chunk_columns = (chunk_of(most[0]) - first_x + 1) as usize;
        self.chunk_rows = (chunk_of(most[1]) - first_y + 1) as usize;
        self.first_chunk = (chunk_x + first_x, chunk_y + first_y);
        let (shift_x, shift_y) = ((first_x * CHUNK as i64) as f32, (first_y * CHUNK as i64) as f32);
        for row in 0..self.rows {
            let of_row = row * BLOCK..row * BLOCK + self.columns;
            self.x[of_row.clone()].iter_mut().for_each(|x| *x -= shift_x);
            self.y[of_row].iter_mut().for_each(|y| *y -= shift_y);
        }
        self.chunk_columns.max(self.chunk_rows) as i64
    }

    pub(super) fn fetch_chunks(&mut self, ground: &Ground, level: i32) {
        self.chunks.clear();
        for j in 0..self.chunk_rows {
            for i in 0..self.chunk_columns {
                let index = (level, self.first_chunk.0 + i as i64, self.first_chunk.1 + j as i64);
                self.chunks.push(ground.chunk(index));
            }
        }
    }

    /// Where the pixels of a row sample the texture.
    pub(super) fn row_samples(&self, row: usize) -> RowSamples {
        let mut samples = RowSamples {
            is_ground: [false; BLOCK],
            chunk: [0; BLOCK],
            start: [0; BLOCK],
            weights_x: [[0.0; BLOCK]; 4],
            weights_y: [[0.0; BLOCK]; 4],
        };
        let x: &[f32; BLOCK] = self.x[row * BLOCK..].first_chunk().unwrap_or(&[f32::NAN; BLOCK]);
        let y: &[f32; BLOCK] = self.y[row * BLOCK..].first_chunk().unwrap_or(&[f32::NAN; BLOCK]);
        let chunk_columns = self.chunk_columns as u32;
        for i in 0..BLOCK {
            let ((column, right), (row, below)) = (texel_and_rest(x[i]), texel_and_rest(y[i]));
            let (weights_x, weights_y) = (cubic_weights(right), cubic_weights(below));
            for k in 0..4 {
                samples.weights_x[k][i] = weights_x[k];
                samples.weights_y[k][i] = weights_y[k];
            }
            samples.is_ground[i] = x[i] >= 0.0 && y[i] >= 0.0; // false for NaN
            samples.chunk[i] = row / CHUNK as u32 * chunk_columns + column / CHUNK as u32;
            // The stored chunk begins one texel before its own first.
            samples.start[i] = (row % CHUNK as u32) * STRIDE as u32 + column % CHUNK as u32;
        }
        samples
    }

    /// The texture at the pixels of a row, gray levels of a channel; NaN where no ground is seen.
    pub(super) fn texture_row(&self, samples: &RowSamples, channel: usize) -> [f32; BLOCK] {
        let mut sums = [[f32::NAN; 4]; BLOCK];
        for (i, sum) in sums.iter_mut().enumerate().take(self.columns) {
            if !samples.is_ground[i] {
                continue;
            }
            let Some(chunk) = self.chunks.get(samples.chunk[i] as usize) else { continue };
            let plane = &chunk.plane(channel)[samples.start[i] as usize..];
            let Some(window) = plane.first_chunk::<{ 3 * STRIDE + 4 }>() else { continue };
            let mut lanes = [0.0f32; 4];
            for j in 0..4 {
                let weight = samples.weights_y[j][i];
                for (k, lane) in lanes.iter_mut().enumerate() {
                    *lane += weight * f32::from(window[j * STRIDE + k]);
                }
            }
            *sum = lanes;
        }
        std::array::from_fn(|i| {
            let value: f32 = (0..4).map(|k| sums[i][k] * samples.weights_x[k][i]).sum();
            (value * (1.0 / SAMPLE_SCALE)).clamp(0.0, 255.0)
        })
    }
}
