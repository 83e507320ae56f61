//! Rendered worlds for the unit tests.
//!
//! `odograph-simulation` is built on this library as it is without its unit tests, so in a unit
//! test its cameras, poses and images are types of another crate. They are converted here; the
//! names are those of `odograph-simulation`.

pub use odograph_simulation::{
    Blackout, Effects, Ground, Kerb, Path, PathKind, SensorErrors, SlowVariation, Sway, Terrain, Texture,
    Undulation, Vibration,
};

use crate::camera::{Camera, Distortion, Rig};
use crate::error::Result;
use crate::filter::fusion::{Quantity, SensorRecord, Sensors};
use crate::geometry::GroundPose;
use crate::image::GrayImage;
use odograph_simulation::odograph as built;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

/// A ground of this texture, the same one for all tests: most of the time of rendering is that of
/// rasterising ground that no test has looked at before.
pub fn shared_ground(texture: &str, footprint_m: f64, seed: u64) -> Arc<Ground> {
    static GROUNDS: Mutex<BTreeMap<(String, u64, u64), Arc<Ground>>> = Mutex::new(BTreeMap::new());
    let known_as = (texture.to_owned(), footprint_m.to_bits(), seed);
    let new = || Ground::new(Texture::named(texture).unwrap(), footprint_m, false, seed).unwrap();
    GROUNDS.lock().unwrap().entry(known_as).or_insert_with(|| Arc::new(new())).clone()
}

/// Renders views of a ground.
pub struct Renderer(odograph_simulation::Renderer);

impl Renderer {
    pub fn new(camera: &Camera) -> Self {
        Self(odograph_simulation::Renderer::new(&built_camera(camera)))
    }

    pub fn footprint_m(&self, height_m: f64) -> f64 {
        self.0.footprint_m(height_m)
    }

    pub fn add_view(&self, ground: &Ground, pose: &GroundPose, weight: f32, image: &mut [f32]) {
        self.0.add_view(ground, &built_pose(pose), weight, image);
    }

    pub fn gray_view(&self, ground: &Ground, pose: &GroundPose) -> GrayImage {
        gray(&self.0.gray_view(ground, &built_pose(pose)))
    }
}

#[derive(Clone)]
pub struct SimulationConfig {
    pub camera: Camera,
    pub rig: Rig,
    pub texture: Texture,
    pub path: Path,
    pub effects: Effects,
    pub fps: f64,
    pub duration_s: Option<f64>,
    pub colored: bool,
    pub seed: u64,
}

pub struct Simulation {
    config: SimulationConfig,
    built: odograph_simulation::Simulation,
}

pub struct RenderedFrame {
    pub time_s: f64,
    pub image: GrayImage,
    pub truth: GroundPose,
}

pub struct SimulatedSensors {
    pub records: Sensors,
    pub gyro: SensorErrors,
    pub heading: SensorErrors,
    pub wheel: SensorErrors,
    pub range: SensorErrors,
}

impl Simulation {
    pub fn new(config: SimulationConfig) -> Result<Self> {
        let Rig { height_m, roll_rad, pitch_rad, yaw_rad, .. } = config.rig;
        let built = odograph_simulation::Simulation::new(odograph_simulation::SimulationConfig {
            camera: built_camera(&config.camera),
            rig: built::camera::Rig { roll_rad, pitch_rad, yaw_rad, ..built::camera::Rig::level(height_m) },
            texture: config.texture.clone(),
            path: config.path.clone(),
            effects: config.effects.clone(),
            fps: config.fps,
            duration_s: config.duration_s,
            colored: config.colored,
            seed: config.seed,
        })
        .unwrap();
        Ok(Self { config, built })
    }

    pub fn config(&self) -> &SimulationConfig {
        &self.config
    }

    pub fn times_s(&self) -> &[f64] {
        self.built.times_s()
    }

    pub fn truth(&self, time_s: f64) -> GroundPose {
        pose(&self.built.truth(time_s))
    }

    pub fn frames(&self) -> impl Iterator<Item = RenderedFrame> + '_ {
        self.built.frames().map(|frame| RenderedFrame {
            time_s: frame.time_s,
            image: gray(&frame.image),
            truth: pose(&frame.truth),
        })
    }

    pub fn sensors(&self) -> Result<SimulatedSensors> {
        let built = self.built.sensors().unwrap();
        let records = built.records;
        Ok(SimulatedSensors {
            records: Sensors {
                gyro: records.gyro.as_ref().map(record),
                heading: records.heading.as_ref().map(record),
                wheel: records.wheel.as_ref().map(record),
                range: records.range.as_ref().map(record),
            },
            gyro: built.gyro,
            heading: built.heading,
            wheel: built.wheel,
            range: built.range,
        })
    }
}

fn built_camera(camera: &Camera) -> built::camera::Camera {
    use built::camera::Distortion as Built;
    let distortion = match *camera.distortion() {
        Distortion::None => Built::None,
        Distortion::BrownConrady { k1, k2, p1, p2, k3, k4, k5, k6 } => {
            Built::BrownConrady { k1, k2, p1, p2, k3, k4, k5, k6 }
        }
        Distortion::DoubleSphere { xi, alpha } => Built::DoubleSphere { xi, alpha },
        Distortion::KannalaBrandt { k1, k2, k3, k4 } => Built::KannalaBrandt { k1, k2, k3, k4 },
    };
    let size = (camera.width(), camera.height());
    let built = built::camera::Camera::new(size, camera.focal_px(), camera.principal_px(), distortion);
    built.unwrap().with_readout_s(camera.readout_s()).unwrap()
}

fn built_pose(pose: &GroundPose) -> built::geometry::GroundPose {
    let GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad } = *pose;
    built::geometry::GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad }
}

fn pose(pose: &built::geometry::GroundPose) -> GroundPose {
    let built::geometry::GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad } = *pose;
    GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad }
}

fn gray(image: &built::image::GrayImage) -> GrayImage {
    GrayImage::from_samples(image.width(), image.height(), image.samples().to_vec()).unwrap()
}

fn record(record: &built::filter::fusion::SensorRecord) -> SensorRecord {
    use built::filter::fusion::Quantity as Built;
    let quantity = match record.quantity() {
        Built::TurnRate => Quantity::TurnRate,
        Built::TurnRates => Quantity::TurnRates,
        Built::Heading => Quantity::Heading,
        Built::Speed => Quantity::Speed,
        Built::Way => Quantity::Way,
        Built::Height => Quantity::Height,
        Built::AxisDistance => Quantity::AxisDistance,
    };
    let (times_s, readings): (Vec<f64>, Vec<Vec<f64>>) = record.samples().unzip();
    let channel = |index: usize| readings.iter().map(|reading| reading[index]).collect();
    let channels = readings.first().map_or(0, Vec::len);
    SensorRecord::new(quantity, times_s, (0..channels).map(channel).collect()).unwrap()
}
