//! From ground to image: every pixel is the ground at the point its ray meets.

use super::ground::{CHUNK, Chunk, Ground, SAMPLE_SCALE, STRIDE};
use super::photograph::cubic_weights;
use super::texture::luminance;
use crate::camera::Camera;
use crate::geometry::{GroundPoint, GroundPose, Pixel, Ray};
use crate::image::GrayImage;
use std::sync::Arc;

/// Pixels along the side of the blocks that an image is rendered in.
const BLOCK: usize = 32;
/// Ground further away than this many heights is not drawn: it lies beyond the last texture detail a pixel could show.
const REACH_IN_HEIGHTS: f32 = 40.0;
/// What pixels see that do not look at the ground, gray levels.
const SKY: f32 = 150.0;

/// A camera made ready to look at the ground: the undistorted ray of every pixel is found once.
#[derive(Debug, Clone)]
pub struct Renderer {
    width: usize,
    height: usize,
    /// Ray of every pixel in row order; NaN where the lens model has none.
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

    /// Image width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Image height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// How much ground a pixel at the principal point covers from a height, metres: what a [`Ground`] for this camera is made with.
    pub fn footprint_m(&self, height_m: f64) -> f64 {
        height_m / self.focal_px
    }

    /// Adds `weight` times what the camera sees from `pose` to `image`: one plane of `width` × `height` gray levels a channel of
    /// the ground. Adding the views of several poses makes motion blur. Panics where `image` has another size.
    pub fn add_view(&self, ground: &Ground, pose: &GroundPose, weight: f32, image: &mut [f32]) {
        assert_eq!(
            image.len(),
            self.width * self.height * ground.channels(),
            "one sample a pixel and channel"
        );
        let mut block = Block::default();
        for top in (0..self.height).step_by(BLOCK) {
            for left in (0..self.width).step_by(BLOCK) {
                block.left = left;
                block.top = top;
                block.columns = BLOCK.min(self.width - left);
                block.rows = BLOCK.min(self.height - top);
                self.add_block(ground, pose, weight, &mut block, image);
            }
        }
    }

    /// What the camera sees from `pose`, without any effects, in gray.
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

    /// Covers parts of a view that [`Renderer::add_view`] put into an empty image with something that lies on the ground: `cover` tells for a ground point
    /// and a pixel's footprint (metres) the colour that covers it and which share of the pixel is covered, if any is.
    pub(super) fn cover(
        &self,
        ground: &Ground,
        pose: &GroundPose,
        weight: f32,
        image: &mut [f32],
        cover: impl Fn(GroundPoint, f64) -> Option<([f32; 3], f32)>,
    ) {
        let pixels = self.width * self.height;
        let footprint_m = self.footprint_m(pose.height_m);
        for (i, [x, y]) in self.rays.iter().enumerate() {
            let Some(point) = pose.ground_from_ray(Ray::new(f64::from(*x), f64::from(*y))) else { continue };
            let Some((color, share)) = cover(point, footprint_m) else { continue };
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
        pose: &GroundPose,
        weight: f32,
        block: &mut Block,
        image: &mut [f32],
    ) {
        block.meet_ground(self, pose);
        let mut level = block.level(ground);
        // A block that looks far out may span so much ground that a coarser level serves it better.
        while block.place_in_chunks(ground, pose, level) > 12 {
            level += 1;
        }
        block.fetch_chunks(ground, level);
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
                for channel in 0..ground.channels() {
                    image[channel * pixels + start + column] += weight * sampler.sample(channel);
                }
            }
        }
    }
}

/// A block of pixels on its way to the ground, kept from block to block for its memory.
#[derive(Default)]
struct Block {
    left: usize,
    top: usize,
    columns: usize,
    rows: usize,
    /// Where each pixel meets the ground: metres from the point below the camera, then texels from the corner of the first chunk.
    x: Vec<f32>,
    y: Vec<f32>,
    chunks: Vec<Arc<Chunk>>,
    first_chunk: (i64, i64),
    chunk_columns: usize,
    chunk_rows: usize,
    x_m: Vec<f32>,
    y_m: Vec<f32>,
}

/// Four by four samples of a chunk and their weights.
struct Sampler<'a> {
    chunk: &'a Chunk,
    start: usize,
    weights_x: [f32; 4],
    weights_y: [f32; 4],
}

impl Block {
    /// Finds the ground point of every pixel, in metres from the point below the camera; NaN where there is none.
    fn meet_ground(&mut self, renderer: &Renderer, pose: &GroundPose) {
        let rotation = pose.world_from_camera_rotation().map(|v| v as f32);
        let height = pose.height_m as f32;
        for buffer in [&mut self.x_m, &mut self.y_m, &mut self.x, &mut self.y] {
            buffer.resize(BLOCK * BLOCK, f32::NAN);
        }
        for row in 0..self.rows {
            let rays = &renderer.rays[(self.top + row) * renderer.width + self.left..][..self.columns];
            let x_m = &mut self.x_m[row * BLOCK..][..self.columns];
            let y_m = &mut self.y_m[row * BLOCK..][..self.columns];
            for ((ray, x_m), y_m) in rays.iter().zip(x_m).zip(y_m) {
                let [x, y] = *ray;
                let down = -(rotation[(2, 0)] * x + rotation[(2, 1)] * y + rotation[(2, 2)]);
                let reach = if down * REACH_IN_HEIGHTS > 1.0 { height / down } else { f32::NAN };
                *x_m = reach * (rotation[(0, 0)] * x + rotation[(0, 1)] * y + rotation[(0, 2)]);
                *y_m = reach * (rotation[(1, 0)] * x + rotation[(1, 1)] * y + rotation[(1, 2)]);
            }
        }
    }

    /// The level of the ground whose texels suit the footprint of the pixels in the middle of this block.
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

    /// Turns metres into texels of `level` and finds the chunks around; gives the larger number of chunks along x or y.
    fn place_in_chunks(&mut self, ground: &Ground, pose: &GroundPose, level: i32) -> i64 {
        let texel_m = ground.texel_m(level);
        let per_metre = (1.0 / texel_m) as f32;
        // The camera's own place is split into whole chunks and a small rest, so that single precision is enough for the rest.
        let split = |metres: f64| {
            let chunks = (metres / texel_m / CHUNK as f64).floor();
            (chunks as i64, (metres / texel_m - chunks * CHUNK as f64) as f32)
        };
        let ((chunk_x, rest_x), (chunk_y, rest_y)) = (split(pose.x_m), split(pose.y_m));
        let (mut least, mut most) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
        for row in 0..self.rows {
            for at in row * BLOCK..row * BLOCK + self.columns {
                let x = self.x_m[at] * per_metre + rest_x;
                let y = self.y_m[at] * per_metre + rest_y;
                (self.x[at], self.y[at]) = (x, y);
                // NaN leaves both as they are.
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
    fn sampler(&self, [x, y]: [f32; 2]) -> Option<Sampler<'_>> {
        let inside = x >= 0.0 && y >= 0.0; // false for NaN
        if !inside {
            return None;
        }
        let (column, row) = (x as usize, y as usize);
        let (chunk_column, chunk_row) = (column / CHUNK, row / CHUNK);
        let chunk = self.chunks.get(chunk_row * self.chunk_columns + chunk_column)?;
        Some(Sampler {
            chunk,
            // The stored chunk begins one texel before its own first.
            start: (row % CHUNK) * STRIDE + column % CHUNK,
            weights_x: cubic_weights(x - column as f32),
            weights_y: cubic_weights(y - row as f32),
        })
    }
}

impl Sampler<'_> {
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
