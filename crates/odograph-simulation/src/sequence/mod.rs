//! A simulated image sequence.

use super::applied_effects::{Disturbance, Exposure, MovingDisc, MovingDiscs, row_offset_s};
use super::effects::{Breathing, Effects};
use super::floor_markers::FloorMarkers;
use super::ground::Ground;
use super::noise::{GaussianStream, mix, uniform};
use super::path::Path;
use super::renderer::Renderer;
use super::scene::Scene;
use super::sway::Swaying;
use super::terrain::TerrainSurface;
use super::texture::{Texture, luminance};
use odograph::camera::{Camera, Rig};
use odograph::error::{Error, Result};
use odograph::geometry::{GroundPoint, GroundPose, Pixel, Se2, wrap_angle};
use odograph::image::{GrayImage, RgbImage};
use odograph::landmark::ControlPoint;
use odograph_calibration::MarkerFamily;

/// Configuration of a simulated sequence.
#[derive(Debug, Clone)]
pub struct SimulationConfig {
    /// Intrinsics and distortion of the camera.
    pub camera: Camera,
    /// Mounting of the camera (extrinsics).
    pub rig: Rig,
    /// Texture of the ground.
    pub texture: Texture,
    /// Path of the camera.
    pub path: Path,
    /// Disturbances and image degradations.
    pub effects: Effects,
    /// Frame rate, frames per second.
    pub fps: f64,
    /// Duration, seconds; `None` is the duration of the path.
    pub duration_s: Option<f64>,
    /// Whether frames are also rendered in colour.
    pub colored: bool,
    /// Seed of all random effects.
    pub seed: u64,
}

/// A simulated image sequence. Each frame can be rendered independently, in any order and from any
/// thread.
#[derive(Debug)]
pub struct Simulation {
    config: SimulationConfig,
    renderer: Renderer,
    /// With focus breathing: renderers at the shortest and at the longest focal length.
    refocused: Option<[Renderer; 2]>,
    ground: Ground,
    surface: Option<TerrainSurface>,
    sway: Option<Swaying>,
    disturbance: Disturbance,
    exposure: Exposure,
    discs: Option<MovingDiscs>,
    times_s: Vec<f64>,
    markers: Vec<ControlPoint>,
}

/// A rendered frame with its ground truth.
#[derive(Debug, Clone)]
pub struct RenderedFrame {
    /// Frame index, from 0, without gaps.
    pub number: u64,
    /// Time of the middle of the exposure, seconds.
    pub time_s: f64,
    /// Luminance image.
    pub image: GrayImage,
    /// Colour image, where configured.
    pub color: Option<RgbImage>,
    /// True pose of the camera at `time_s`.
    pub truth: GroundPose,
}

/// Maximum number of frames; a day at 60 frames per second is below it.
const MAX_FRAMES: f64 = 6e6;
/// Maximum motion between the sub-exposures of motion blur, pixels.
const BLUR_STEP_PX: f64 = 0.7;

impl Simulation {
    /// Precomputes the rays of all pixels and the times of all frames.
    ///
    /// Fails where the rig, the effects, the frame rate or the duration are out of range.
    pub fn new(config: SimulationConfig) -> Result<Self> {
        let rig = config.rig.validated()?;
        let effects = config.effects.clone().validated()?;
        let config = SimulationConfig { rig, effects, ..config };
        if config.effects.readout_s * config.fps > 1.0 {
            return Err(Error::usage(format!(
                "a readout time of {} s is longer than the time between frames, {} s",
                config.effects.readout_s,
                1.0 / config.fps
            )));
        }
        let renderer = Renderer::new(&config.camera);
        let refocused = match config.effects.breathing {
            Some(Breathing { share, .. }) if share > 0.0 => {
                let other = |share: f64| refocused(&config.camera, share).map(|lens| Renderer::new(&lens));
                Some([other(-share)?, other(share)?])
            }
            _ => None,
        };
        let ground = Ground::new(
            config.texture.clone(),
            renderer.footprint_m(config.rig.height_m),
            config.colored,
            mix(config.seed ^ 0x6_7071),
        )?
        .with_shadows(config.effects.ground_shadow);
        let simulation = Self {
            renderer,
            refocused,
            ground,
            surface: TerrainSurface::new(&config.effects.terrain, config.seed),
            sway: config.effects.sway.map(|sway| Swaying::new(sway, config.seed)),
            disturbance: Disturbance::new(&config.effects, config.seed),
            exposure: Exposure::new(
                &config.effects,
                config.camera.width(),
                config.camera.height(),
                config.seed,
            ),
            discs: config.effects.object.map(|object| MovingDiscs::new(object, config.seed)),
            times_s: times_s(&config)?,
            markers: Vec::new(),
            config,
        };
        simulation.above_ground()?;
        Ok(simulation)
    }

    /// Lays markers under the path, one every `spacing_m` metres of it from its start, numbered
    /// from 0 and turned by 37° from one to the next; where the path comes back to a marker there
    /// is no second one.
    ///
    /// Fails where the spacing is too small for the markers, or the family has too few of them.
    pub fn with_markers(mut self, family: &MarkerFamily, spacing_m: f64) -> Result<Self> {
        let least_m = 2.0 * family.side_m();
        if !(spacing_m.is_finite() && spacing_m >= least_m) {
            return Err(Error::usage(format!(
                "markers every {spacing_m} m would lie on each other; {least_m} m is the least for {family}"
            )));
        }
        let path = &self.config.path;
        let steps = (path.duration_s() * 100.0).ceil().clamp(1.0, 1e7) as usize;
        let place = |step: usize| path.pose(path.duration_s() * step as f64 / steps as f64, &self.config.rig);
        let mut placed: Vec<(usize, Se2)> = Vec::new();
        let (mut before, mut length_m) = (place(0), 0.0);
        for step in 0..=steps {
            let pose = place(step);
            length_m += (pose.x_m - before.x_m).hypot(pose.y_m - before.y_m);
            before = pose;
            let due = length_m >= spacing_m * (1.0 - 1e-9) || step == 0;
            let near = |other: &Se2| (other.x_m - pose.x_m).hypot(other.y_m - pose.y_m) < 0.5 * spacing_m;
            if !due || placed.iter().any(|(_, other)| near(other)) {
                continue;
            }
            length_m = 0.0;
            let number = placed.len();
            if number == family.markers() {
                return Err(Error::usage(format!(
                    "the path needs more markers than the {number} of {family}; lay them further apart"
                )));
            }
            let turned_rad = number as f64 * 37f64.to_radians();
            placed.push((number, Se2::new(pose.x_m, pose.y_m, wrap_angle(turned_rad))));
        }
        self.markers = placed
            .iter()
            .map(|(number, pose)| ControlPoint {
                number: *number as u32,
                x_m: pose.x_m,
                y_m: pose.y_m,
                sigma_m: 0.001,
                heading_rad: Some(pose.heading_rad),
            })
            .collect();
        self.ground = self.ground.with_markers(FloorMarkers::new(*family, placed));
        Ok(self)
    }

    /// The true places of the markers in the world frame, with a millimetre as standard deviation.
    pub fn markers(&self) -> &[ControlPoint] {
        &self.markers
    }

    /// Fails where the camera comes closer to the ground than a tenth of its mounting height.
    fn above_ground(&self) -> Result<()> {
        let least_m = 0.1 * self.config.rig.height_m;
        let too_low = |time_s: &&f64| self.over_ground(self.truth(**time_s)).height_m < least_m;
        match self.times_s.iter().find(too_low).filter(|_| self.surface.is_some()) {
            None => Ok(()),
            Some(time_s) => Err(Error::usage(format!(
                "at {time_s:.2} s the camera is less than {least_m} m above the ground; let it ride, or lower the terrain"
            ))),
        }
    }

    /// The configuration of this simulation.
    pub fn config(&self) -> &SimulationConfig {
        &self.config
    }

    /// Number of frames, at least 1.
    #[allow(clippy::len_without_is_empty)] // never empty
    pub fn len(&self) -> usize {
        self.times_s.len()
    }

    /// Times of all frames, seconds, ascending.
    pub fn times_s(&self) -> &[f64] {
        &self.times_s
    }

    /// True camera pose at a time, seconds; `height_m` is measured from z = 0, not from the local
    /// ground.
    pub fn truth(&self, time_s: f64) -> GroundPose {
        let carrier = self.config.path.pose(time_s, &self.config.rig);
        let pose = self.disturbance.applied(carrier, time_s);
        self.surface.as_ref().map_or(pose, |surface| surface.ridden(&carrier, pose))
    }

    /// Mid-exposure time of a row of the frame at `time_s`, seconds (rolling shutter).
    pub fn row_time_s(&self, time_s: f64, row: usize) -> f64 {
        time_s + row_offset_s(self.config.effects.readout_s, row, self.renderer.height())
    }

    /// Level of the ground at a point, metres above z = 0: undulation, kerb and ramp without
    /// relief.
    pub fn ground_level_m(&self, point: GroundPoint) -> f64 {
        self.surface.as_ref().map_or(0.0, |surface| surface.level_m(point.x_m, point.y_m))
    }

    /// The pose with its height measured from the level of the ground below the camera.
    fn over_ground(&self, pose: GroundPose) -> GroundPose {
        let level_m = self.ground_level_m(GroundPoint::new(pose.x_m, pose.y_m));
        GroundPose { height_m: pose.height_m - level_m, ..pose }
    }

    /// The camera model at a time, seconds; with focus breathing it varies.
    pub fn camera(&self, time_s: f64) -> Result<Camera> {
        match self.config.effects.breathing {
            Some(breathing) => refocused(&self.config.camera, breathing.share_at(time_s)),
            None => Ok(self.config.camera.clone()),
        }
    }

    /// Renders a frame by its index; `None` beyond the last.
    pub fn frame(&self, number: usize) -> Option<RenderedFrame> {
        let time_s = *self.times_s.get(number)?;
        let truth = self.truth(time_s);
        let (width, height) = (self.renderer.width(), self.renderer.height());
        let mut planes = vec![0.0f32; width * height * self.ground.channels()];
        if !self.exposure.covered(time_s) {
            let renderer = self.refocused.as_ref().zip(self.config.effects.breathing);
            let renderer = renderer.map(|(ends, breathing)| {
                self.renderer.refocused(ends, breathing.share_at(time_s), breathing.share)
            });
            let renderer = renderer.as_ref().unwrap_or(&self.renderer);
            let moments = self.moments_s(time_s);
            let weight = 1.0 / moments.len() as f32;
            for moment_s in moments {
                self.add_moment(renderer, moment_s, weight, &mut planes);
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

    /// Accumulates one sub-exposure, each row at its own time, into `planes`.
    fn add_moment(&self, renderer: &Renderer, moment_s: f64, weight: f32, planes: &mut [f32]) {
        let rows = if self.config.effects.readout_s > 0.0 { renderer.height() } else { 1 };
        let times_s: Vec<f64> = match rows {
            1 => vec![moment_s],
            _ => (0..rows).map(|row| self.row_time_s(moment_s, row)).collect(),
        };
        let poses: Vec<GroundPose> = times_s.iter().map(|time_s| self.truth(*time_s)).collect();
        let scene = Scene::new(&poses, &times_s, self.surface.as_ref(), self.sway.as_ref());
        let Some(discs) = &self.discs else {
            renderer.add_scene(&self.ground, &scene, weight, planes);
            return;
        };
        let mut view = vec![0.0; planes.len()];
        renderer.add_scene(&self.ground, &scene, weight, &mut view);
        let carrier = |time_s: f64| self.config.path.pose(time_s, &self.config.rig);
        let discs: Vec<Vec<MovingDisc>> = times_s.iter().map(|time_s| discs.at(*time_s, carrier)).collect();
        let pose_of_row = |row: usize| self.over_ground(poses[row.min(rows - 1)]);
        renderer.cover(&self.ground, pose_of_row, weight, &mut view, |row, point, footprint_m| {
            discs[row.min(rows - 1)].iter().find_map(|disc| disc.color(point, footprint_m))
        });
        planes.iter_mut().zip(view).for_each(|(sum, sample)| *sum += sample);
    }

    /// Times of the sub-exposures of a frame, evenly spaced over the exposure. Each row has the
    /// same offsets from its own time.
    fn moments_s(&self, time_s: f64) -> Vec<f64> {
        let exposure_s = self.config.effects.exposure_s;
        if exposure_s <= 0.0 {
            return vec![time_s];
        }
        let at = |share: f64| time_s + exposure_s * (share - 0.5);
        let last_row = self.renderer.height() - 1;
        let way_px = [0, last_row]
            .into_iter()
            .flat_map(|row| [0, self.renderer.width() - 1].map(|column| (column, row)))
            .filter_map(|(column, row)| {
                let ray = self.config.camera.ray_from_pixel(Pixel::new(column as f64, row as f64))?;
                let met = |share: f64| {
                    self.over_ground(self.truth(self.row_time_s(at(share), row))).ground_from_ray(ray)
                };
                // Vibration may reverse within an exposure, so the path length is summed over eight
                // steps.
                let mut way_m = 0.0;
                let mut before = met(0.0)?;
                for step in 1..=8 {
                    let next = met(f64::from(step) / 8.0)?;
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

/// The camera with its focal length scaled by `1 + share`.
fn refocused(camera: &Camera, share: f64) -> Result<Camera> {
    let (size, (fx, fy)) = ((camera.width(), camera.height()), camera.focal_px());
    let focal_px = (fx * (1.0 + share), fy * (1.0 + share));
    Camera::new(size, focal_px, camera.principal_px(), *camera.distortion())
}

/// Times of the frames that are not dropped, with jitter.
fn times_s(config: &SimulationConfig) -> Result<Vec<f64>> {
    let fps = config.fps;
    if !(fps.is_finite() && fps > 0.0 && fps <= 100_000.0) {
        return Err(Error::usage(format!(
            "the frame rate is {fps:?}; it must be above 0 and at most 100000 frames per second"
        )));
    }
    let duration_s = config.duration_s.unwrap_or(config.path.duration_s());
    if !(duration_s.is_finite() && duration_s >= 0.0 && duration_s * fps < MAX_FRAMES) {
        return Err(Error::usage(format!(
            "{duration_s:?} s at {fps:?} frames per second is not a recording that can be made; {MAX_FRAMES:.0} frames are the limit"
        )));
    }
    let last = (duration_s * fps + 1e-6).floor() as u64;
    let timing = config.effects.timing;
    let mut jitter = GaussianStream::new(mix(config.seed ^ 0x71E));
    Ok((0..=last)
        .map(|tick| (tick, f64::from(jitter.sample())))
        // The first frame defines the world origin: never dropped, never late.
        .filter(|(tick, _)| *tick == 0 || uniform(config.seed ^ 0xD209, *tick) >= timing.dropped)
        .map(|(tick, late)| {
            let late_s = if tick == 0 { 0.0 } else { (late * timing.jitter_s).clamp(-0.4 / fps, 0.4 / fps) };
            tick as f64 / fps + late_s
        })
        .collect())
}

#[cfg(test)]
mod tests;
#[cfg(test)]
mod world_tests;
