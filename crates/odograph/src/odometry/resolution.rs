//! Working resolution: where the noise of single pixels competes with the texture, a coarser
//! pyramid level is tracked in place of the image (`docs/math/working-resolution.md`).

use super::learned::NOISE_CHANGES;
use super::pattern_noise::PatternNoise;
use super::recovery::Recovery;
use super::standing::Standing;
use super::{FoundCorner, Odometry, OdometryConfig, TrackView};
use crate::camera::Camera;
use crate::fixed_pattern::ImageMask;
use crate::geometry::Pixel;
use crate::image::{GrayImage, Halving};
use std::sync::Arc;

/// Which level of each image's pyramid is tracked.
#[derive(Debug)]
pub struct WorkingResolution {
    /// The camera and the configuration of the images as they come in.
    full: Camera,
    config: OdometryConfig,
    /// How often the images are halved.
    level: u32,
    halving: Halving,
    /// Memory of the last halved image.
    spare: Option<GrayImage>,
    /// Mean dissimilarity of the inliers of the frame where it is least, which grows slowly, and
    /// the number of frames.
    dissimilarity: Option<f64>,
    frames: u32,
}

/// Frames after which the dissimilarity decides. It is that of the frame where it is least: ground
/// seen from elsewhere, or by a camera whose tilt is not known yet, is dissimilar for a while, too.
/// Ground below a pattern is until the pattern is found, whose search begins after 16 to 24 frames.
const LEAST_FRAMES: u32 = 30;

/// Least number of inliers of a frame whose dissimilarity counts.
const LEAST_INLIERS: usize = 8;

/// Single pixels are mostly noise if more than a quarter (the square of this) of a patch's contrast
/// is not the keyframe's, and the residuals are more than this many times those of white noise.
/// White noise on faint concrete has 0.6 and 1.4 to 1.7, and full resolution is twice as exact
/// there. Chosen on 26 random drives, seven of which, of at least 640x360 pixels, are halved: one
/// is lost no more, four gained by factors of 4 to 9, and two changed by at most 8 %.
const NOISY: f64 = 0.5;
const NOT_WHITE: f64 = 2.0;

/// Least length of the shorter side of an image that is halved, and of what comes out, pixels.
/// Smaller images have no pixels to spare: of five noisy drives at 320x240, one was 94 % off when
/// halved, and one by more than stated.
const LEAST_FULL_SIDE: usize = 320;
const LEAST_SIDE: usize = 110;

impl WorkingResolution {
    /// Images as they come in.
    pub fn full(camera: &Camera, config: OdometryConfig) -> Self {
        Self {
            full: camera.clone(),
            config,
            level: 0,
            halving: Halving::default(),
            spare: None,
            dissimilarity: None,
            frames: 0,
        }
    }

    /// The camera of the images as they come in.
    pub fn full_camera(&self) -> &Camera {
        &self.full
    }

    /// The configuration for the images as they come in.
    pub fn config(&self) -> OdometryConfig {
        self.config
    }

    /// Whether another level than the images themselves is tracked.
    pub fn is_reduced(&self) -> bool {
        self.level > 0
    }

    /// Sets the camera of the images as they come in; returns that of the working images.
    pub fn recalibrate(&mut self, camera: Camera) -> Camera {
        self.full = camera;
        self.full.halved(self.level)
    }

    /// Pixels of an image as it comes in along a pixel of the working image.
    pub fn scale(&self) -> f64 {
        f64::from(1u32 << self.level)
    }

    /// The working image of an image.
    pub fn reduce(&mut self, mut image: GrayImage) -> GrayImage {
        for _ in 0..self.level {
            let mut half = self.spare.take().unwrap_or_else(|| GrayImage::new(0, 0));
            self.halving.halve(&image, &mut half);
            self.spare = Some(std::mem::replace(&mut image, half));
        }
        image
    }

    /// A track in the pixels of the image as it came in.
    pub fn track_view(&self, view: TrackView) -> TrackView {
        if self.level == 0 {
            return view;
        }
        let scale = self.scale();
        let enlarged = |pixel: Pixel| Pixel::new(scale * pixel.x, scale * pixel.y);
        TrackView {
            pixel: enlarged(view.pixel),
            corner: enlarged(view.corner),
            covariance_px2: scale * scale * view.covariance_px2,
            ..view
        }
    }

    /// A working image at the size of the images as they come in.
    pub fn enlarged(&self, image: GrayImage) -> GrayImage {
        if self.level == 0 {
            return image;
        }
        let (width, height) = (self.full.width(), self.full.height());
        let (right, below) = ((image.width() - 1) as f64 - 1e-6, (image.height() - 1) as f64 - 1e-6);
        let scale = self.scale();
        let mut large = GrayImage::new(width, height);
        for (index, sample) in large.samples_mut().iter_mut().enumerate() {
            let (x, y) = ((index % width) as f64 / scale, (index / width) as f64 / scale);
            *sample = image.bilinear(x.min(right), y.min(below)).unwrap_or(0.0).round() as u8;
        }
        large
    }

    /// A mask of working images as one of the images as they come in.
    pub fn enlarged_mask(&self, mask: &Arc<ImageMask>) -> Arc<ImageMask> {
        match self.level {
            0 => Arc::clone(mask),
            level => Arc::new(mask.scaled((self.full.width(), self.full.height()), -(level as i32))),
        }
    }

    /// A mask of images as they come in as one of working images.
    pub fn reduced_mask(&self, mask: &ImageMask) -> ImageMask {
        let working = self.full.halved(self.level);
        mask.scaled((working.width(), working.height()), self.level as i32)
    }

    /// Learns how much of the corners' patches is not the keyframe's from a measured frame.
    pub fn watch(&mut self, found: &[FoundCorner], inliers: &[bool]) {
        let agree = || found.iter().zip(inliers).filter(|(_, inlier)| **inlier);
        let count = agree().count();
        if count < LEAST_INLIERS {
            return;
        }
        let sum: f64 = agree().map(|(found, _)| f64::from(found.dissimilarity)).sum();
        self.frames += 1;
        let now = sum / count as f64;
        self.dissimilarity = Some(self.dissimilarity.map_or(now, |least| now.min(NOISE_CHANGES * least)));
    }

    /// Whether single pixels are mostly noise, and a coarser level is large enough. A lost frame
    /// decides at once: there may be no more that are measured.
    fn is_too_fine(&self, noise_ratio: f64, is_lost: bool) -> bool {
        let least_frames = if is_lost { 1 } else { LEAST_FRAMES };
        let shorter_side = self.full.width().min(self.full.height());
        self.frames >= least_frames
            && self.dissimilarity.is_some_and(|least| least > NOISY)
            && noise_ratio > NOT_WHITE
            && shorter_side >= LEAST_FULL_SIDE
            && shorter_side >> (self.level + 1) >= LEAST_SIDE
    }
}

impl Odometry {
    /// Tracks a coarser level from the next frame on if single pixels are mostly noise, and are no
    /// pattern of the camera.
    pub(super) fn choose_resolution(&mut self) {
        let may_be_pattern = self.fixed.is_everywhere() || self.pattern_noise.is_suspected();
        if !may_be_pattern && self.resolution.is_too_fine(self.learned.noise_ratio(), self.lost_frames > 0) {
            self.halve_resolution();
        }
    }

    /// How often the images are halved before they are tracked.
    pub fn halvings(&self) -> u32 {
        self.resolution.level
    }

    /// Tracks images of half the resolution from the next one on.
    pub(super) fn halve_resolution(&mut self) {
        self.resolution.level += 1;
        (self.resolution.frames, self.resolution.dissimilarity, self.resolution.spare) = (0, None, None);
        let WorkingResolution { full, level, config, .. } = &self.resolution;
        self.camera = full.halved(*level);
        self.config = config.for_camera(&self.camera);
        self.fixed = self.fixed.halved();
        self.recovery = Recovery::new(&self.camera);
        self.spare = None;
        self.stale = None;
        self.candidate = None;
        self.standing = Standing::default();
        self.pattern_noise = PatternNoise::default();
        self.learned.forget_noise();
        let mask = self.fixed.mask().cloned();
        if let Some(keyframe) = self.keyframe.take() {
            let mut keyframe = keyframe.halved(mask.as_ref(), &self.config);
            keyframe.prepare(&self.camera);
            self.keyframe = Some(keyframe);
        }
        self.memory.halve(mask.as_ref(), &self.config);
    }
}
