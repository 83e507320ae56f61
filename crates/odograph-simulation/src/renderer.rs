//! Rendering: every pixel is the ground texture at the intersection of its ray.

use super::ground::Ground;
use super::render_block::{BLOCK, RenderBlock};
use super::scene::Scene;
use super::texture::luminance;
use odograph::camera::Camera;
use odograph::geometry::{GroundPoint, GroundPose, Pixel, Ray};
use odograph::image::GrayImage;

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
        block.meet_ground(&self.rays, self.width, scene);
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
            let samples = block.row_samples(row);
            for channel in 0..ground.channels() {
                let texture = block.texture_row(&samples, channel);
                let image = &mut image[channel * pixels + start..][..block.columns];
                for (column, (sample, gray)) in image.iter_mut().zip(texture).enumerate() {
                    *sample += if gray.is_nan() {
                        weight * SKY
                    } else if shaded {
                        weight * block.shade[row * BLOCK + column] * gray
                    } else {
                        weight * gray
                    };
                }
            }
        }
    }
}
