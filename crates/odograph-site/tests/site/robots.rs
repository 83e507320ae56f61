//! Robots with their own cameras and heights over the same rendered ground, and their maps.

use odograph::camera::{Camera, Distortion, Rig};
use odograph::error::Result;
use odograph::geometry::GroundPose;
use odograph::ground_map::{KeyframeImage, KeyframeImages, KeyframeStore, MapKeyframe};
use odograph::image::GrayImage;
use odograph::keyframe::{KeyframeId, MapEdge};
use odograph::loop_closure::LoopClosureConfig;
use odograph::odometry::{Odometry, OdometryConfig};
use odograph::slam::Mapper;
use odograph_map::{MapFile, SessionOrigin};
use odograph_simulation::{Ground, Renderer, Texture};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

pub const HEIGHT_M: f64 = 0.75;

/// The ground of all robots.
static GROUND: LazyLock<Ground> = LazyLock::new(|| {
    let footprint_m = Renderer::new(&Robot::first().camera).footprint_m(HEIGHT_M);
    Ground::new(Texture::named("asphalt").unwrap(), footprint_m, false, 3).unwrap()
});

pub struct Robot {
    pub name: &'static str,
    pub camera: Camera,
    /// The calibration that it was given.
    pub told: Camera,
    /// Whether its images are mirrored.
    pub is_mirrored: bool,
    /// Time between two frames as it states it, seconds.
    pub step_s: f64,
    pub height_m: f64,
    /// The height that it was given.
    pub told_m: f64,
    /// Begin, heading and number of frames of its lane.
    pub lane: ((f64, f64), f64, usize),
    /// Whether its bumper covers the lowest quarter of its images.
    pub sees_bumper: bool,
}

pub fn camera(size: (usize, usize), focal_px: f64, distortion: Distortion) -> Camera {
    let principal = (0.5 * (size.0 as f64 - 1.0), 0.5 * (size.1 as f64 - 1.0));
    Camera::new(size, (focal_px, focal_px), principal, distortion).unwrap()
}

impl Robot {
    pub fn first() -> Self {
        let camera = camera((320, 240), 250.0, Distortion::None);
        Self {
            name: "one",
            told: camera.clone(),
            camera,
            is_mirrored: false,
            step_s: 1.0 / 15.0,
            height_m: HEIGHT_M,
            told_m: HEIGHT_M,
            lane: ((0.0, 0.0), 0.0, 100),
            sees_bumper: false,
        }
    }

    /// With another camera, higher up, on a lane back beside the first one's.
    pub fn second() -> Self {
        let camera = camera((400, 300), 330.0, Distortion::None);
        Self {
            name: "two",
            told: camera.clone(),
            camera,
            height_m: 0.9,
            told_m: 0.9,
            lane: ((3.2, -0.15), 3.0, 70),
            ..Self::first()
        }
    }

    /// As the first, beside it or from elsewhere, with the same bumper in view as others.
    pub fn with_bumper(name: &'static str, from: (f64, f64)) -> Self {
        Self { name, lane: (from, 0.0, 100), sees_bumper: true, ..Self::first() }
    }

    /// As the second, with a height that is wrong by 6 %.
    pub fn wrong() -> Self {
        Self { name: "three", told_m: 1.06 * 0.9, lane: ((0.4, 0.1), 0.05, 70), ..Self::second() }
    }

    /// Where it is after some distance.
    pub fn pose(&self, along_m: f64) -> GroundPose {
        let ((x, y), heading_rad, _) = self.lane;
        let (sin, cos) = heading_rad.sin_cos();
        GroundPose {
            x_m: x + along_m * cos,
            y_m: y + along_m * sin,
            heading_rad,
            ..GroundPose::level(self.height_m)
        }
    }

    /// Drives its lane, and writes its map as a run would.
    pub fn drive(&self, folder: &Path) -> PathBuf {
        self.drive_part(folder, &SessionOrigin::new(self.name).unwrap(), self.lane.2)
    }

    /// Drives the first frames of its lane only, as this session.
    pub fn drive_part(&self, folder: &Path, origin: &SessionOrigin, frames: usize) -> PathBuf {
        let path = folder.join(format!("{}.gpkg", self.name));
        let rig = Rig::level(self.told_m);
        let mut file = MapFile::create(&path, &self.told, &rig).unwrap();
        file.begin_session_by(origin, "drive.mp4", None).unwrap();
        let config = OdometryConfig::default();
        let mut mapper = Mapper::new(&self.told, rig, &config, LoopClosureConfig::default());
        let mut odometry = Odometry::new(self.told.clone(), rig, config).unwrap();
        odometry.record_keyframes();
        let renderer = Renderer::new(&self.camera);
        let mut store = Store(file);
        for frame in 0..frames {
            let mut image = renderer.gray_view(&GROUND, &self.pose(0.04 * frame as f64));
            if self.sees_bumper {
                cover_with_bumper(&mut image);
            }
            if self.is_mirrored {
                let width = image.width();
                image.samples_mut().chunks_exact_mut(width).for_each(|row| row.reverse());
            }
            odometry.process(image, frame as f64 * self.step_s).unwrap();
            for event in odometry.take_keyframe_events() {
                mapper.take(event, None, &mut store).unwrap();
            }
        }
        mapper.finish();
        store.0.close().unwrap();
        path
    }
}

/// Draws a bumper, rough all over, into the lowest quarter of an image.
fn cover_with_bumper(image: &mut GrayImage) {
    let (width, height) = (image.width(), image.height());
    for (index, sample) in image.samples_mut().iter_mut().enumerate().skip(width * height / 4 * 3) {
        let patch = (index % width / 5 + 1000 * (index / width / 5)) as u64;
        *sample = 40 + (patch.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 57) as u8;
    }
}

struct Store(MapFile);

impl KeyframeImages for Store {
    fn load(&mut self, keyframe: KeyframeId) -> Result<KeyframeImage> {
        self.0.load(keyframe)
    }
}

impl KeyframeStore for Store {
    fn keep(&mut self, keyframe: &MapKeyframe, image: KeyframeImage, ties: &[MapEdge]) -> Result<()> {
        self.0.add_keyframe(keyframe, &image, ties)
    }

    fn add_edge(&mut self, edge: &MapEdge) -> Result<()> {
        self.0.add_edges(std::slice::from_ref(edge))
    }
}
