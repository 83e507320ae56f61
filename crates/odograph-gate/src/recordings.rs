//! The real recordings with ground truth. They are not part of the repository: they are read from
//! the folder in `ODOGRAPH_DATA`, by default `../shared/data` beside the checkout.

use crate::clip::Clip;
use crate::rows::Follow;
use nalgebra::{Isometry3, Rotation3, Translation3, UnitQuaternion, Vector3};
use odograph::camera::{Camera, Distortion, Rig};
use odograph::error::{Error, Result};
use odograph::evaluation::Alignment;
use odograph::formats::{camera_file, rig_file, trajectory_file};
use odograph::geometry::GroundPose;
use odograph::motion::MotionModel;
use odograph::trajectory::{StampedPose, Trajectory};
use odograph_video::SourceOptions;
use std::f64::consts::PI;
use std::io::Write;
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

/// A real recording and the definition of its error.
#[derive(Debug, Clone, Copy)]
pub struct RealRecording {
    /// Name of its folder.
    pub name: &'static str,
    /// How it is tracked.
    pub follow: Follow,
    /// The motion model.
    pub model: MotionModel,
    /// Alignment of the estimate with the ground truth.
    pub alignment: Alignment,
    /// Reads it from its folder.
    read: fn(&Path) -> Result<Clip>,
}

impl RealRecording {
    /// Reads the frames and the ground truth.
    pub fn open(&self, data: &Path) -> Result<Clip> {
        (self.read)(&data.join(self.name))
    }
}

/// The folder of the recordings.
pub fn folder() -> PathBuf {
    std::env::var_os("ODOGRAPH_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from)
}

/// All real recordings.
pub fn all() -> Vec<RealRecording> {
    let recording = |name, alignment, read| RealRecording {
        name,
        follow: Follow::Mapped,
        model: MotionModel::Auto,
        alignment,
        read,
    };
    vec![
        recording("floor_flight", Alignment::Se3, floor_flight),
        recording("planar_checker_a", Alignment::Se3, planar_checker),
        recording("static_euroc_v101", Alignment::Origin, static_euroc),
        recording("kylehart_ground", Alignment::Origin, kylehart),
        RealRecording {
            model: MotionModel::Free,
            ..recording("nadir_caliterra", Alignment::Sim3, nadir_caliterra)
        },
    ]
}

/// A camera carried over sheets of checkerboard, with motion blur and gaps. The initial pose is
/// given.
fn floor_flight(folder: &Path) -> Result<Clip> {
    let camera = camera_file::parse(&text(&folder.join("camera.yaml"))?, None)?;
    let rig = rig_file::parse(&text(&folder.join("rig.toml"))?)?;
    let truth = trajectory_file::parse_tum(&text(&folder.join("truth.tum"))?)?;
    let options = SourceOptions { timestamps: Some(folder.join("frames.txt")), ..SourceOptions::default() };
    clip(&folder.join("frames"), &options, camera, rig, truth)
}

/// A hand-held camera over a checkerboard: `X_camera = R X_world + t`, the world's z axis into the
/// board.
fn planar_checker(folder: &Path) -> Result<Clip> {
    let flip = Isometry3::rotation(Vector3::x() * PI);
    let mut truth = Trajectory::default();
    for (number, line) in text(&folder.join("poses_omega_t.txt"))?.lines().enumerate() {
        let [wx, wy, wz, tx, ty, tz] = numbers(line)[..] else { continue };
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::new(Vector3::new(wx, wy, wz)));
        let pose = Isometry3::from_parts(Translation3::new(tx, ty, tz), rotation).inverse();
        let world_from_camera = if pose.translation.z < 0.0 { flip * pose } else { pose };
        truth.poses.push(StampedPose { time_s: number as f64 / 30.0, world_from_camera });
    }
    let distortion = Distortion::from_opencv(&[-0.31418, 0.10884, 0.0, 0.0]).unwrap_or(Distortion::None);
    let camera = Camera::new((752, 480), (419.97, 419.31), (353.93, 250.78), distortion)?;
    let first = truth.poses.first().ok_or_else(|| Error::input("the checkerboard has no truth"))?;
    let first = GroundPose::from_world_from_camera(&first.world_from_camera);
    let rig = Rig { roll_rad: first.roll_rad, pitch_rad: first.pitch_rad, ..Rig::level(first.height_m) };
    let options = SourceOptions { fps: Some(30.0), ..SourceOptions::default() };
    clip(&folder.join("images"), &options, camera, rig, truth)
}

/// A stationary drone, taken as 1 m above the ground: any estimated motion is an error.
fn static_euroc(folder: &Path) -> Result<Clip> {
    let camera = camera_file::parse(&text(&folder.join("sensor.yaml"))?, None)?;
    let still = Rig::level(1.0);
    let options = SourceOptions::default();
    let mut clip = clip(&folder.join("cam0"), &options, camera, still, Trajectory::default())?;
    let world_from_camera = still.first_pose().world_from_camera();
    let pose = |(time_s, _): &(f64, _)| StampedPose { time_s: *time_s, world_from_camera };
    clip.truth.poses = clip.frames.iter().map(pose).collect();
    Ok(clip)
}

/// Steps of half an image and turns of 45° over bricks, with the robot's own shadow in view.
fn kylehart(folder: &Path) -> Result<Clip> {
    let camera = Camera::new((1280, 960), (1108.7, 1108.7), (640.0, 480.0), Distortion::None)?;
    let mut truth = Trajectory::default();
    // The folder contains pose files beside the images, so the images are listed explicitly.
    let mut list = String::new();
    while let Ok(line) = text(&folder.join(format!("{:06}.txt", truth.poses.len()))) {
        let [x_m, y_m, _, _, _, heading_rad, ..] = numbers(&line)[..] else { break };
        let pose = GroundPose { x_m, y_m, heading_rad, ..GroundPose::level(0.25) };
        let number = truth.poses.len();
        list += &format!("{number} {number:06}.png\n");
        truth.poses.push(StampedPose { time_s: number as f64, world_from_camera: pose.world_from_camera() });
    }
    let times = list_of_pictures(&list)?;
    let timestamps = Some(times.path().to_owned());
    clip(folder, &SourceOptions { timestamps, ..Default::default() }, camera, Rig::level(0.25), truth)
}

/// Drone still images of a field, with the drone's GPS. Lens and height are unknown; a pinhole
/// model and 1 m are assumed, so only the shape of the trajectory is compared.
fn nadir_caliterra(folder: &Path) -> Result<Clip> {
    let camera = Camera::new((1000, 750), (729.3, 729.3), (499.5, 374.5), Distortion::None)?;
    let mut truth = Trajectory::default();
    let mut list = String::new();
    for (number, line) in text(&folder.join("gps.csv"))?.lines().skip(1).enumerate() {
        let fields: Vec<&str> = line.split(',').collect();
        let [name, _, _, up, east, north, ..] = fields[..] else { continue };
        let number_of = |field: &str| field.trim().parse::<f64>().unwrap_or(f64::NAN);
        let pose =
            GroundPose { x_m: number_of(east), y_m: number_of(north), ..GroundPose::level(number_of(up)) };
        list += &format!("{number} {name}\n");
        truth.poses.push(StampedPose { time_s: number as f64, world_from_camera: pose.world_from_camera() });
    }
    let times = list_of_pictures(&list)?;
    let timestamps = Some(times.path().to_owned());
    let options = SourceOptions { timestamps, ..SourceOptions::default() };
    clip(&folder.join("images"), &options, camera, Rig::level(1.0), truth)
}

/// Reads all frames of a source.
fn clip(path: &Path, options: &SourceOptions, camera: Camera, rig: Rig, truth: Trajectory) -> Result<Clip> {
    let mut source = odograph_video::open(path, options)?;
    let mut frames = Vec::new();
    while let Some(frame) = source.next_frame()? {
        frames.push((frame.time_s, frame.gray));
    }
    let span_s = frames.last().map_or(0.0, |(last, _)| last - frames[0].0);
    let fps = (frames.len() as f64 - 1.0) / span_s;
    Ok(Clip { camera, rig, frames, truth, fps })
}

/// Writes a temporary file of `time name` lines for the reader; deleted when the returned value is
/// dropped.
fn list_of_pictures(list: &str) -> Result<NamedTempFile> {
    let unwritten = |error: std::io::Error| Error::output(format!("a list of pictures: {error}"));
    let mut file = NamedTempFile::new().map_err(unwritten)?;
    file.write_all(list.as_bytes()).map_err(unwritten)?;
    Ok(file)
}

fn text(path: &Path) -> Result<String> {
    std::fs::read_to_string(path).map_err(|error| Error::input(format!("{}: {error}", path.display())))
}

fn numbers(line: &str) -> Vec<f64> {
    line.split([',', ' ', '\n']).filter_map(|word| word.trim().parse().ok()).collect()
}
