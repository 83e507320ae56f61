//! Generates a table of the motion models: rendered drives with exact ground truth, tracked by
//! the odometry, with the error at the end.
//!
//! `cargo run --release -p odograph --example accuracy [-- WORD…]` runs the drives whose line
//! contains one of the words, or all drives.
//!
//! 640x480 at 30 frames per second, mild barrel distortion, image noise of 2 gray levels, 0.75 m
//! above the ground.

#![allow(clippy::print_stdout)] // prints a table

use odograph::camera::{Camera, Distortion, Rig};
use odograph::error::Result;
use odograph::evaluation::{Alignment, EvaluationOptions, evaluate};
use odograph::geometry::Pixel;
use odograph::motion::MotionModel;
use odograph::odometry::{Odometry, OdometryConfig};
use odograph::trajectory::{StampedPose, Trajectory};
use odograph_simulation::{Effects, Path, PathKind, Simulation, SimulationConfig, Texture};
use std::f64::consts::TAU;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

const RIG_HEIGHT_M: f64 = 0.75;

struct AccuracyDrive {
    name: &'static str,
    texture: &'static str,
    path: PathKind,
    model: MotionModel,
}

fn camera() -> Result<Camera> {
    let distortion = Distortion::BrownConrady {
        k1: -0.12,
        k2: 0.03,
        p1: 0.0005,
        p2: -0.0003,
        k3: 0.0,
        k4: 0.0,
        k5: 0.0,
        k6: 0.0,
    };
    Camera::new((640, 480), (500.0, 500.0), (321.0, 238.5), distortion)
}

fn drives() -> Result<Vec<AccuracyDrive>> {
    let rig = Rig::level(RIG_HEIGHT_M);
    let corner =
        camera()?.ray_from_pixel(Pixel::new(0.0, 0.0)).and_then(|ray| rig.first_pose().ground_from_ray(ray));
    let pivot = corner.map(|about| PathKind::Pivot { about, turn_rad: TAU });
    let straight = PathKind::Straight { length_m: 10.0 };
    let square = PathKind::SquareByTranslation { side_m: 2.5 };
    let eight = PathKind::FigureEight { length_m: 3.0, laps: 1.0 };
    let mut drives = Vec::new();
    let mut add = |name, textures: &[&'static str], path, model| {
        drives.extend(textures.iter().map(|&texture| AccuracyDrive { name, texture, path, model }));
    };
    let rich = ["asphalt", "carpet", "grass", "concrete"];
    add("straight 10 m", &rich, straight, MotionModel::Rigid);
    add("square without turning", &rich, square, MotionModel::Rigid);
    add("figure of eight", &rich, eight, MotionModel::Rigid);
    add("figure of eight", &["tiles", "bricks"], eight, MotionModel::Rigid);
    add("figure of eight", &["asphalt"], eight, MotionModel::Auto);
    add("figure of eight", &["asphalt"], eight, MotionModel::Free);
    add("square without turning", &["asphalt"], square, MotionModel::Mean);
    if let Some(pivot) = pivot {
        add("a turn about an image corner", &rich, pivot, MotionModel::Rigid);
        add("a turn about an image corner", &["asphalt"], pivot, MotionModel::Mean);
    }
    Ok(drives)
}

/// Renders and tracks one drive; returns its line of the table.
fn line(drive: &AccuracyDrive) -> Result<String> {
    let rig = Rig::level(RIG_HEIGHT_M);
    let simulation = Simulation::new(SimulationConfig {
        camera: camera()?,
        rig,
        texture: Texture::named(drive.texture).unwrap_or(Texture::Asphalt),
        path: Path::new(drive.path, 0.6, 1.0, true)?,
        effects: Effects { noise_gray: 2.0, ..Effects::default() },
        fps: 30.0,
        duration_s: None,
        colored: false,
        seed: 5,
    })?;
    let mut config = OdometryConfig::default();
    config.motion.model = drive.model;
    let mut odometry = Odometry::new(camera()?, rig, config)?;
    let (mut estimate, mut truth) = (Trajectory::default(), Trajectory::default());
    for frame in (0..simulation.len()).map_while(|number| simulation.frame(number)) {
        let stamped = |pose: odograph::geometry::GroundPose| StampedPose {
            time_s: frame.time_s,
            world_from_camera: pose.world_from_camera(),
        };
        truth.poses.push(stamped(frame.truth));
        let tracked = odometry.process(frame.image, frame.time_s)?;
        estimate.poses.extend(tracked.estimate.map(|known| stamped(known.pose)));
    }
    let options = EvaluationOptions {
        alignment: Alignment::Origin,
        segment_lengths_m: vec![1.0],
        ..EvaluationOptions::default()
    };
    let found = evaluate(&estimate, &truth, &options)?;
    let drift = found.drift.first();
    let percent = drift.map_or("–".to_owned(), |d| format!("{:.4} %", d.translation_percent));
    let degrees = drift.map_or("–".to_owned(), |d| format!("{:.4}°", d.heading_deg_per_m));
    Ok(format!(
        "| {} | {} | `{}` | {} of {} | {percent} | {degrees} | {:.2} mm | {:.3}° |",
        drive.name,
        drive.texture,
        drive.model,
        estimate.poses.len(),
        truth.poses.len(),
        1e3 * found.final_position_error_m,
        found.final_heading_error_rad.to_degrees().abs(),
    ))
}

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let drives = drives()?;
    let chosen: Vec<&AccuracyDrive> = drives
        .iter()
        .filter(|d| {
            let all = format!("{} {} {}", d.name, d.texture, d.model);
            words.is_empty() || words.iter().any(|word| all.contains(word.as_str()))
        })
        .collect();
    println!(
        "| drive | ground | model | frames posed | error over each metre | heading over each metre | at the end | heading at the end |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    let lines = Mutex::new(vec![None; chosen.len()]);
    let next = AtomicUsize::new(0);
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                while let Some((index, drive)) = {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    chosen.get(index).map(|drive| (index, drive))
                } {
                    let text = line(drive).unwrap_or_else(|error| format!("| {} | {error} |", drive.name));
                    if let Ok(mut lines) = lines.lock() {
                        lines[index] = Some(text);
                    }
                }
            });
        }
    });
    let lines = lines.into_inner().unwrap_or_default();
    lines.into_iter().flatten().for_each(|line| println!("{line}"));
    Ok(())
}
