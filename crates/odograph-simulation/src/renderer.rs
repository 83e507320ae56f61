//! Rendering: every pixel is the ground texture at the intersection of its ray.

use super::ground::{CHUNK, Chunk, Ground, SAMPLE_SCALE, STRIDE};
use super::photograph::cubic_weights;
use super::sway::Swaying;
use super::terrain::TerrainSurface;
use super::texture::luminance;
use nalgebra::Matrix3;
use odograph::camera::Camera;
use odograph::geometry::{GroundPoint, GroundPose, Pixel, Ray};
use odograph::image::GrayImage;
use std::sync::Arc;

/// Side length of the blocks in which an image is rendered, pixels.
const BLOCK: usize = 32;
/// Ground farther away than this many camera heights is not rendered; no texture detail is resolved
/// there.
const REACH_IN_HEIGHTS: f32 = 40.0;
/// Gray level of pixels that do not see the ground.
const SKY: f32 = 150.0;

/// A renderer for one camera; the undistorted ray of every pixel is precomputed.
#[derive(Debug, Clone)]
pub struct Renderer {
    width: usize,
    height: usize,
    /// Rays of all pixels in row order; NaN where the lens model has none.
    rays: Vec<[f32; 2]>,
    focal_px: f64,
}

impl Renderer {
    /// A renderer for this camera.
    pub fn new(camera: &Camera) -> Self {
        let (width, height) = (camera.width(), camera.height());
        let rays = (0..width * height)
            .map(|i| {
                let pixel = Pixel::new((i % width) as f64, (i / width) as f64);
                camera.ray_from_pixel(pixel).map_or([f32::NAN; 2], |ray| [ray.x as f32, ray.y as f32])
            })
            .collect();
        let (fx, fy) = camera.focal_px();
        Self { width, height, rays, focal_px: (fx * fy).sqrt() }
    }

    /// The renderer with its focal length scaled by `1 + share`, interpolated quadratically between
    /// this one and those at −`largest` (`shorter`) and +`largest` (`longer`). The error is of
    /// third order in the share: less than 0.001 px for 5 %.
    pub(super) fn refocused(&self, [shorter, longer]: &[Self; 2], share: f64, largest: f64) -> Self {
        let t = (share / largest) as f32;
        // Lagrange weights for the nodes −1, 0 and 1.
        let [before, here, after] = [0.5 * t * (t - 1.0), (1.0 - t) * (1.0 + t), 0.5 * t * (t + 1.0)];
        let rays = self.rays.iter().zip(&shorter.rays).zip(&longer.rays);
        let rays = rays.map(|((now, short), long)| {
            std::array::from_fn(|i| before * short[i] + here * now[i] + after * long[i])
        });
        Self { rays: rays.collect(), focal_px: self.focal_px * (1.0 + share), ..*self }
    }

    /// Image width, pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Image height, pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Ground footprint of a pixel at the principal point from a height, metres; the resolution of
    /// a [`Ground`] for this camera.
    pub fn footprint_m(&self, height_m: f64) -> f64 {
        height_m / self.focal_px
    }

    /// Adds `weight` times the view from `pose` to `image`, which has one plane of `width` ×
    /// `height` gray levels per channel of the ground. Accumulating the views of several poses
    /// renders motion blur.
    ///
    /// # Panics
    ///
    /// Panics where `image` has another size.
    pub fn add_view(&self, ground: &Ground, pose: &GroundPose, weight: f32, image: &mut [f32]) {
        self.add_scene(ground, &Scene::flat(std::slice::from_ref(pose)), weight, image);
    }

    /// [`Renderer::add_view`] of a scene with row-wise poses, uneven or swaying ground.
    pub(super) fn add_scene(&self, ground: &Ground, scene: &Scene<'_>, weight: f32, image: &mut [f32]) {
        assert_eq!(
            image.len(),
            self.width * self.height * ground.channels(),
            "one sample a pixel and channel"
        );
        let mut block = RenderBlock::default();
        for top in (0..self.height).step_by(BLOCK) {
            for left in (0..self.width).step_by(BLOCK) {
                block.left = left;
                block.top = top;
                block.columns = BLOCK.min(self.width - left);
                block.rows = BLOCK.min(self.height - top);
                self.add_block(ground, scene, weight, &mut block, image);
            }
        }
    }

    /// Gray image from `pose`, without effects.
    pub fn gray_view(&self, ground: &Ground, pose: &GroundPose) -> GrayImage {
        let pixels = self.width * self.height;
        let mut planes = vec![0.0; pixels * ground.channels()];
        self.add_view(ground, pose, 1.0, &mut planes);
        let mut image = GrayImage::new(self.width, self.height);
        for (i, sample) in image.samples_mut().iter_mut().enumerate() {
            let gray = match ground.channels() {
                1 => planes[i],
                _ => luminance([planes[i], planes[pixels + i], planes[2 * pixels + i]]),
            };
            *sample = (gray + 0.5) as u8;
        }
        image
    }

    /// Composites an object on the ground over a view rendered by [`Renderer::add_view`] into an
    /// empty image. `cover` maps an image row, a ground point and a pixel footprint (metres) to the
    /// colour of the object and the covered fraction of the pixel, if any. `pose_of_row` is the
    /// camera pose of an image row relative to that ground.
    pub(super) fn cover(
        &self,
        ground: &Ground,
        pose_of_row: impl Fn(usize) -> GroundPose,
        weight: f32,
        image: &mut [f32],
        cover: impl Fn(usize, GroundPoint, f64) -> Option<([f32; 3], f32)>,
    ) {
        let pixels = self.width * self.height;
        let mut pose = pose_of_row(0);
        let mut footprint_m = self.footprint_m(pose.height_m);
        for (i, [x, y]) in self.rays.iter().enumerate() {
            let row = i / self.width;
            if i % self.width == 0 {
                pose = pose_of_row(row);
                footprint_m = self.footprint_m(pose.height_m);
            }
            let Some(point) = pose.ground_from_ray(Ray::new(f64::from(*x), f64::from(*y))) else { continue };
            let Some((color, share)) = cover(row, point, footprint_m) else { continue };
            let mut blend = |channel: usize, value: f32| {
                let sample = &mut image[channel * pixels + i];
                *sample += share * (weight * value - *sample);
            };
            if ground.channels() == 1 {
                blend(0, luminance(color));
            } else {
                color.into_iter().enumerate().for_each(|(channel, value)| blend(channel, value));
            }
        }
    }

    fn add_block(
        &self,
        ground: &Ground,
        scene: &Scene<'_>,
        weight: f32,
        block: &mut RenderBlock,
        image: &mut [f32],
    ) {
        block.meet_ground(self, scene);
        // Computed on the level ground: relief would distort the footprint of single pixels.
        let mut level = block.level(ground);
        if let Some(surface) = scene.surface {
            block.meet_surface(surface, scene);
        }
        if let Some(sway) = scene.sway {
            block.displace(sway, scene);
        }
        // A block with an oblique view may span so much ground that a coarser level suffices.
        while block.place_in_chunks(ground, scene.origin, level) > 12 {
            level += 1;
        }
        block.fetch_chunks(ground, level);
        let shaded = scene.surface.is_some();
        let pixels = self.width * self.height;
        for row in 0..block.rows {
            let start = (block.top + row) * self.width + block.left;
            for column in 0..block.columns {
                let at = row * BLOCK + column;
                let texel = [block.x[at], block.y[at]];
                let Some(sampler) = block.sampler(texel) else {
                    for channel in 0..ground.channels() {
                        image[channel * pixels + start + column] += weight * SKY;
                    }
                    continue;
                };
                let weight = if shaded { weight * block.shade[at] } else { weight };
                for channel in 0..ground.channels() {
                    image[channel * pixels + start + column] += weight * sampler.sample(channel);
                }
            }
        }
    }
}

/// One instant or one readout: the camera pose of each row and the state of the ground.
pub(super) struct Scene<'a> {
    rows: Vec<RowView>,
    /// Ground point relative to which the row positions are given, so that single precision
    /// suffices.
    origin: GroundPoint,
    /// Height of the level plane near the camera, metres.
    level_m: f64,
    surface: Option<&'a TerrainSurface>,
    sway: Option<&'a Swaying>,
}

/// The camera during the exposure of one row.
struct RowView {
    rotation: Matrix3<f32>,
    /// Height above the level plane, metres.
    height: f32,
    x_m: f32,
    y_m: f32,
    time_s: f64,
}

impl<'a> Scene<'a> {
    /// Flat, static ground; one pose for all rows or one per row.
    fn flat(poses: &[GroundPose]) -> Self {
        Self::new(poses, &[0.0], None, None)
    }

    /// One pose and time for all rows or one per row. The origin is the ground point below the
    /// middle row's camera.
    pub(super) fn new(
        poses: &[GroundPose],
        times_s: &[f64],
        surface: Option<&'a TerrainSurface>,
        sway: Option<&'a Swaying>,
    ) -> Self {
        let middle = &poses[poses.len() / 2];
        let origin = GroundPoint::new(middle.x_m, middle.y_m);
        let level_m = surface.map_or(0.0, |surface| surface.level_m(origin.x_m, origin.y_m));
        let rows = poses.iter().zip(times_s).map(|(pose, time_s)| RowView {
            rotation: pose.world_from_camera_rotation().map(|v| v as f32),
            height: (pose.height_m - level_m) as f32,
            x_m: (pose.x_m - origin.x_m) as f32,
            y_m: (pose.y_m - origin.y_m) as f32,
            time_s: *time_s,
        });
        Self { rows: rows.collect(), origin, level_m, surface, sway }
    }

    fn row(&self, row: usize) -> &RowView {
        &self.rows[row.min(self.rows.len() - 1)]
    }
}

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
struct RenderBlock {
    left: usize,
    top: usize,
    columns: usize,
    rows: usize,
    /// Ground position of each pixel, in texels from the corner of the first chunk.
    x: Vec<f32>,
    y: Vec<f32>,
    chunks: Vec<Arc<Chunk>>,
    first_chunk: (i64, i64),
    chunk_columns: usize,
    chunk_rows: usize,
    x_m: Vec<f32>,
    y_m: Vec<f32>,
    /// Relative brightness of the surface at each pixel's intersection, 1 where it is flat.
    shade: Vec<f32>,
}

/// 4 × 4 samples of a chunk and their interpolation weights.
struct TextureSampler<'a> {
    chunk: &'a Chunk,
    start: usize,
    weights_x: [f32; 4],
    weights_y: [f32; 4],
}

impl RenderBlock {
    /// Intersects every pixel's ray with the level plane, in metres from the scene's origin; NaN
    /// without an intersection.
    fn meet_ground(&mut self, renderer: &Renderer, scene: &Scene<'_>) {
        for buffer in [&mut self.x_m, &mut self.y_m, &mut self.x, &mut self.y] {
            buffer.resize(BLOCK * BLOCK, f32::NAN);
        }
        for row in 0..self.rows {
            let RowView { rotation, height, x_m: row_x_m, y_m: row_y_m, .. } = scene.row(self.top + row);
            let rays = &renderer.rays[(self.top + row) * renderer.width + self.left..][..self.columns];
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
    fn meet_surface(&mut self, surface: &TerrainSurface, scene: &Scene<'_>) {
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
    fn displace(&mut self, sway: &Swaying, scene: &Scene<'_>) {
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
    fn level(&self, ground: &Ground) -> i32 {
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
    fn place_in_chunks(&mut self, ground: &Ground, origin: GroundPoint, level: i32) -> i64 {
        let texel_m = ground.texel_m(level);
        let per_metre = (1.0 / texel_m) as f32;
        // The origin is split into whole chunks and a remainder, for which single precision
        // suffices.
        let split = |metres: f64| {
            let chunks = (metres / texel_m / CHUNK as f64).floor();
            (chunks as i64, (metres / texel_m - chunks * CHUNK as f64) as f32)
        };
        let ((chunk_x, rest_x), (chunk_y, rest_y)) = (split(origin.x_m), split(origin.y_m));
        let (mut least, mut most) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
        for row in 0..self.rows {
            for at in row * BLOCK..row * BLOCK + self.columns {
                let x = self.x_m[at] * per_metre + rest_x;
                let y = self.y_m[at] * per_metre + rest_y;
                (self.x[at], self.y[at]) = (x, y);
                // `min` and `max` ignore NaN.
                least = [least[0].min(x), least[1].min(y)];
                most = [most[0].max(x), most[1].max(y)];
            }
        }
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
            for at in row * BLOCK..row * BLOCK + self.columns {
                self.x[at] -= shift_x;
                self.y[at] -= shift_y;
            }
        }
        self.chunk_columns.max(self.chunk_rows) as i64
    }

    fn fetch_chunks(&mut self, ground: &Ground, level: i32) {
        self.chunks.clear();
        for j in 0..self.chunk_rows {
            for i in 0..self.chunk_columns {
                let index = (level, self.first_chunk.0 + i as i64, self.first_chunk.1 + j as i64);
                self.chunks.push(ground.chunk(index));
            }
        }
    }

    #[inline]
    fn sampler(&self, [x, y]: [f32; 2]) -> Option<TextureSampler<'_>> {
        let inside = x >= 0.0 && y >= 0.0; // false for NaN
        if !inside {
            return None;
        }
        let (column, row) = (x as usize, y as usize);
        let (chunk_column, chunk_row) = (column / CHUNK, row / CHUNK);
        let chunk = self.chunks.get(chunk_row * self.chunk_columns + chunk_column)?;
        Some(TextureSampler {
            chunk,
            // The stored chunk begins one texel before its own first.
            start: (row % CHUNK) * STRIDE + column % CHUNK,
            weights_x: cubic_weights(x - column as f32),
            weights_y: cubic_weights(y - row as f32),
        })
    }
}

impl TextureSampler<'_> {
    #[inline]
    fn sample(&self, channel: usize) -> f32 {
        let plane = self.chunk.plane(channel);
        let mut sum = [0.0f32; 4];
        for j in 0..4 {
            let row = &plane[self.start + j * STRIDE..][..4];
            for i in 0..4 {
                sum[i] += self.weights_y[j] * f32::from(row[i]);
            }
        }
        let value: f32 = (0..4).map(|i| sum[i] * self.weights_x[i]).sum();
        (value * (1.0 / SAMPLE_SCALE)).clamp(0.0, 255.0)
    }
}
