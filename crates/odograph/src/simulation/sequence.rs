//! A whole simulated recording.

use super::effects::{Discs, Disturbance, Effects, Exposure};
use super::ground::Ground;
use super::noise::{GaussianStream, mix, uniform};
use super::path::Path;
use super::renderer::Renderer;
use super::texture::{Texture, luminance};
use crate::camera::{Camera, Rig};
use crate::error::{Error, Result};
use crate::geometry::{GroundPose, Pixel};
use crate::image::{GrayImage, RgbImage};

/// Everything a simulated recording is made from.
#[derive(Debug, Clone)]
pub struct SimulationConfig {
    /// The camera.
    pub camera: Camera,
    /// How it is mounted.
    pub rig: Rig,
    /// What the ground looks like.
    pub texture: Texture,
    /// Where it goes.
    pub path: Path,
    /// What makes it hard.
    pub effects: Effects,
    /// Frames per second.
    pub fps: f64,
    /// How long it records, seconds; `None` is to the end of the path.
    pub duration_s: Option<f64>,
    /// Whether frames have colours.
    pub colored: bool,
    /// Decides everything that is random.
    pub seed: u64,
}

/// A simulated recording, of which every frame may be rendered on its own, in any order, from any thread.
#[derive(Debug)]
pub struct Simulation {
    config: SimulationConfig,
    renderer: Renderer,
    ground: Ground,
    disturbance: Disturbance,
    exposure: Exposure,
    discs: Option<Discs>,
    times_s: Vec<f64>,
}

/// One frame with its truth.
#[derive(Debug, Clone)]
pub struct RenderedFrame {
    /// Its number, from 0, without gaps.
    pub number: u64,
    /// When the middle of its exposure was, seconds.
    pub time_s: f64,
    /// Its luminance.
    pub image: GrayImage,
    /// Its colours, where they were asked for.
    pub color: Option<RgbImage>,
    /// Where the camera was.
    pub truth: GroundPose,
}

/// More frames than this are refused; a day at 60 frames a second is below it.
const MOST_FRAMES: f64 = 6e6;
/// Sub-exposures are taken so densely that nothing moves further between them than this, pixels.
const BLUR_STEP_PX: f64 = 0.7;

impl Simulation {
    /// Makes ready to render: finds the rays of all pixels and the times of all frames.
    ///
    /// Fails where the rig, the effects, the frame rate or the duration are out of their ranges.
    pub fn new(config: SimulationConfig) -> Result<Self> {
        let rig = config.rig.validated()?;
        let effects = config.effects.clone().validated()?;
        let config = SimulationConfig { rig, effects, ..config };
        let renderer = Renderer::new(&config.camera);
        let ground = Ground::new(
            config.texture.clone(),
            renderer.footprint_m(config.rig.height_m),
            config.colored,
            mix(config.seed ^ 0x6_7071),
        )?;
        let ground = match config.effects.ground_shadow {
            0.0 => ground,
            darkness => ground.with_shadows(darkness),
        };
        Ok(Self {
            renderer,
            ground,
            disturbance: Disturbance::new(&config.effects, config.seed),
            exposure: Exposure::new(
                &config.effects,
                config.camera.width(),
                config.camera.height(),
                config.seed,
            ),
            discs: config.effects.object.map(|object| Discs::new(object, config.seed)),
            times_s: times_s(&config)?,
            config,
        })
    }

    /// What it is made from.
    pub fn config(&self) -> &SimulationConfig {
        &self.config
    }

    /// Number of frames, at least 1.
    #[allow(clippy::len_without_is_empty)] // never empty
    pub fn len(&self) -> usize {
        self.times_s.len()
    }

    /// The times of all frames, seconds, rising.
    pub fn times_s(&self) -> &[f64] {
        &self.times_s
    }

    /// Where the camera is at a time, seconds.
    pub fn truth(&self, time_s: f64) -> GroundPose {
        self.disturbance.applied(self.config.path.pose(time_s, &self.config.rig), time_s)
    }

    /// Renders a frame by its number; `None` beyond the last.
    pub fn frame(&self, number: usize) -> Option<RenderedFrame> {
        let time_s = *self.times_s.get(number)?;
        let truth = self.truth(time_s);
        let (width, height) = (self.renderer.width(), self.renderer.height());
        let mut planes = vec![0.0f32; width * height * self.ground.channels()];
        if !self.exposure.covered(time_s) {
            let moments = self.moments_s(time_s);
            let weight = 1.0 / moments.len() as f32;
            for moment_s in moments {
                let pose = self.truth(moment_s);
                let Some(discs) = &self.discs else {
                    self.renderer.add_view(&self.ground, &pose, weight, &mut planes);
                    continue;
                };
                let mut view = vec![0.0; planes.len()];
                self.renderer.add_view(&self.ground, &pose, weight, &mut view);
                let discs = discs.at(moment_s, |t| self.config.path.pose(t, &self.config.rig));
                self.renderer.cover(&self.ground, &pose, weight, &mut view, |point, footprint_m| {
                    discs.iter().find_map(|disc| disc.color(point, footprint_m))
                });
                planes.iter_mut().zip(view).for_each(|(sum, sample)| *sum += sample);
            }
        }
        let samples = self.exposure.develop(&planes, number as u64, time_s);
        let (image, color) = if self.config.colored {
            let gray = samples
                .chunks_exact(3)
                .map(|p| (luminance([f32::from(p[0]), f32::from(p[1]), f32::from(p[2])]) + 0.5) as u8)
                .collect();
            (GrayImage::from_samples(width, height, gray)?, RgbImage::from_samples(width, height, samples))
        } else {
            (GrayImage::from_samples(width, height, samples)?, None)
        };
        Some(RenderedFrame { number: number as u64, time_s, image, color, truth })
    }

    /// All frames in order.
    pub fn frames(&self) -> impl Iterator<Item = RenderedFrame> + '_ {
        (0..self.len()).filter_map(|number| self.frame(number))
    }

    /// The moments within the exposure of a frame, evenly spread around its time.
    fn moments_s(&self, time_s: f64) -> Vec<f64> {
        let exposure_s = self.config.effects.exposure_s;
        if exposure_s <= 0.0 {
            return vec![time_s];
        }
        // Vibration may turn around within an exposure: the way is measured in eight steps.
        let at = |share: f64| time_s + exposure_s * (share - 0.5);
        let corners = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(x, y)| {
            let (w, h) = (self.renderer.width() - 1, self.renderer.height() - 1);
            Pixel::new((x * w) as f64, (y * h) as f64)
        });
        let way_px = corners
            .into_iter()
            .filter_map(|corner| {
                let ray = self.config.camera.ray_from_pixel(corner)?;
                let mut way_m = 0.0;
                let mut before = self.truth(at(0.0)).ground_from_ray(ray)?;
                for step in 1..=8 {
                    let next = self.truth(at(f64::from(step) / 8.0)).ground_from_ray(ray)?;
                    way_m += next.distance(before);
                    before = next;
                }
                Some(way_m / self.ground.footprint_m())
            })
            .fold(0.0, f64::max);
        let count = (way_px / BLUR_STEP_PX).ceil().clamp(1.0, 64.0) as usize;
        (0..count).map(|i| at((i as f64 + 0.5) / count as f64)).collect()
    }
}

/// The times at which frames are taken and delivered.
fn times_s(config: &SimulationConfig) -> Result<Vec<f64>> {
    let fps = config.fps;
    if !(fps.is_finite() && fps > 0.0 && fps <= 100_000.0) {
        return Err(Error::usage(format!(
            "the frame rate is {fps}; it must be a positive number of frames per second"
        )));
    }
    let duration_s = config.duration_s.unwrap_or(config.path.duration_s());
    if !(duration_s.is_finite() && duration_s >= 0.0 && duration_s * fps < MOST_FRAMES) {
        return Err(Error::usage(format!(
            "{duration_s} s at {fps} frames per second is not a recording that can be made; {MOST_FRAMES:.0} frames are the limit"
        )));
    }
    let last = (duration_s * fps + 1e-6).floor() as u64;
    let timing = config.effects.timing;
    let mut jitter = GaussianStream::new(mix(config.seed ^ 0x71E));
    Ok((0..=last)
        .map(|tick| (tick, f64::from(jitter.sample())))
        // The first frame is the origin of the world: it is always there and on time.
        .filter(|(tick, _)| *tick == 0 || uniform(config.seed ^ 0xD209, *tick) >= timing.dropped)
        .map(|(tick, late)| {
            let late_s = if tick == 0 { 0.0 } else { (late * timing.jitter_s).clamp(-0.4 / fps, 0.4 / fps) };
            tick as f64 / fps + late_s
        })
        .collect())
}

#[cfg(test)]
mod tests;
