//! Effect of loop closures: rendered drives with exact ground truth, tracked with and without a
//! map.
//!
//! `cargo run --release -p odograph --example slam [-- WORD…]` runs the drives whose line contains
//! one of the words, or all except the long one, which must be named: `kilometre`.
//!
//! The kilometre is a random path within a circular yard of 30 m diameter. Times are the processor
//! times of the map's thread.
//!
//! The camera has 640x480 pixels, mild barrel distortion and image noise of 2 gray levels, 0.75 m
//! above the ground; a poor image has 320x240 pixels and noise of 10. Where a line says so, the rig
//! given to the program has a small error, the common cause of bent trajectories in practice.

#![allow(clippy::print_stdout)] // prints a table

mod processor_time;

use nalgebra::{SMatrix, SVector, Vector2};
use odograph::camera::{Camera, Distortion, Rig};
use odograph::error::Result;
use odograph::ground_map::MemoryImages;
use odograph::loop_closure::LoopClosureConfig;
use odograph::odometry::{KeyframeEvent, Odometry, OdometryConfig};
use odograph::slam::{Mapper, map_frames};
use odograph::trajectory::FrameEstimate;
use odograph_simulation::{Effects, Path, PathKind, Simulation, SimulationConfig, Texture};
use processor_time::busy_ms;

struct LoopDrive {
    name: &'static str,
    texture: &'static str,
    path: PathKind,
    /// Tilt error of the given rig: true roll and pitch of the camera, radians.
    unknown: (f64, f64),
    speed_m_s: f64,
    size: (usize, usize),
    height_m: f64,
    noise_gray: f64,
    fps: f64,
}

fn camera((width, height): (usize, usize)) -> Result<Camera> {
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
    let share = width as f64 / 640.0;
    let centre = (321.0 * share, 238.5 * height as f64 / 480.0);
    Camera::new((width, height), (500.0 * share, 500.0 * share), centre, distortion)
}

fn drives() -> Vec<LoopDrive> {
    let eight = PathKind::FigureEight { length_m: 3.0, laps: 2.0 };
    let lanes = PathKind::Lanes { length_m: 4.0, spacing_m: 0.4, count: 6 };
    let large = PathKind::FigureEight { length_m: 8.0, laps: 2.0 };
    let drive = |name, texture, path, unknown| LoopDrive {
        name,
        texture,
        path,
        unknown,
        speed_m_s: 0.6,
        size: (640, 480),
        height_m: 0.75,
        noise_gray: 2.0,
        fps: 30.0,
    };
    let degree = 1f64.to_radians();
    vec![
        drive("figure of eight", "asphalt", eight, (0.0, 0.0)),
        drive("figure of eight, rig off", "asphalt", eight, (0.3 * degree, -0.2 * degree)),
        drive("figure of eight, rig off", "carpet", eight, (0.3 * degree, -0.2 * degree)),
        drive("figure of eight, rig off", "tiles", eight, (0.3 * degree, -0.2 * degree)),
        drive("lanes", "grass", lanes, (0.0, 0.0)),
        drive("lanes, rig off", "grass", lanes, (0.3 * degree, -0.2 * degree)),
        drive("lanes, rig off", "concrete", lanes, (0.3 * degree, -0.2 * degree)),
        LoopDrive {
            size: (320, 240),
            noise_gray: 10.0,
            fps: 15.0,
            ..drive("lanes, poor picture", "concrete", lanes, (0.0, 0.0))
        },
        LoopDrive {
            size: (320, 240),
            noise_gray: 10.0,
            fps: 15.0,
            ..drive("lanes, poor picture", "carpet", lanes, (0.0, 0.0))
        },
        LoopDrive {
            size: (320, 240),
            noise_gray: 10.0,
            fps: 15.0,
            ..drive("large eight, poor picture", "asphalt", large, (0.0, 0.0))
        },
        LoopDrive {
            size: (320, 240),
            noise_gray: 10.0,
            fps: 15.0,
            ..drive("large eight, poor picture", "tiles", large, (0.0, 0.0))
        },
        LoopDrive {
            speed_m_s: 2.0,
            // A frame moves by a fifth to a quarter of the view, which can be tracked and takes a
            // minute or two.
            fps: 10.0,
            size: (320, 240),
            ..drive(
                "kilometre at random, rig off",
                "asphalt",
                PathKind::RandomWithin { length_m: 1000.0, radius_m: 15.0, seed: 3 },
                (0.1 * degree, -0.05 * degree),
            )
        },
    ]
}

/// RMSE and maximum of the position error, millimetres, after the rigid alignment that is common
/// for the absolute trajectory error (ATE).
///
/// An unknown mount tilt displaces the estimated camera position by a constant offset of some
/// millimetres in the vehicle frame. Loop closures cannot observe it, and it does not matter to a
/// vehicle that uses its own map, so this lever arm (two parameters) is estimated and subtracted as
/// well.
fn errors_mm(simulation: &Simulation, frames: &[FrameEstimate]) -> (f64, f64) {
    let off: Vec<(Vector2<f64>, SMatrix<f64, 2, 5>)> = frames
        .iter()
        .filter_map(|frame| {
            let found = frame.estimate.as_ref()?.pose;
            let truth = simulation.truth(frame.time_s);
            let (sin, cos) = truth.heading_rad.sin_cos();
            // Jacobian of the alignment: translation, small rotation, lever arm.
            let by = SMatrix::<f64, 2, 5>::from_row_slice(&[
                1.0, 0.0, -truth.y_m, cos, -sin, //
                0.0, 1.0, truth.x_m, sin, cos,
            ]);
            Some((Vector2::new(found.x_m - truth.x_m, found.y_m - truth.y_m), by))
        })
        .collect();
    // Regularised: the lever arm is not observable if the heading is constant.
    let mut normal = SMatrix::<f64, 5, 5>::identity() * 1e-9;
    let mut right = SVector::<f64, 5>::zeros();
    for (off, by) in &off {
        normal += by.transpose() * by;
        right += by.transpose() * off;
    }
    let alignment = normal.try_inverse().map_or(SVector::zeros(), |inverse| inverse * right);
    let squares: Vec<f64> = off.iter().map(|(off, by)| (off - by * alignment).norm_squared()).collect();
    let mean = squares.iter().sum::<f64>() / squares.len().max(1) as f64;
    (1e3 * mean.sqrt(), 1e3 * squares.iter().copied().fold(0.0, f64::max).sqrt())
}

fn line(drive: &LoopDrive) -> Result<String> {
    let message = Rig::level(drive.height_m);
    let rig = Rig { roll_rad: drive.unknown.0, pitch_rad: drive.unknown.1, ..message };
    let simulation = Simulation::new(SimulationConfig {
        camera: camera(drive.size)?,
        rig,
        texture: Texture::named(drive.texture).unwrap_or(Texture::Asphalt),
        path: Path::new(drive.path, drive.speed_m_s, 1.0, true)?,
        effects: Effects { noise_gray: drive.noise_gray, ..Effects::default() },
        fps: drive.fps,
        duration_s: None,
        colored: false,
        seed: 5,
    })?;
    let config = OdometryConfig::default();
    let mut odometry = Odometry::new(camera(drive.size)?, message, config)?;
    odometry.record_keyframes();
    let mut mapper = Mapper::new(&camera(drive.size)?, message, &config, LoopClosureConfig::default());
    let mut images = MemoryImages::default();
    let (mut frames, mut references, mut times_ms) = (Vec::new(), Vec::new(), Vec::new());
    for frame in (0..simulation.len()).map_while(|number| simulation.frame(number)) {
        frames.push(odometry.process(frame.image, frame.time_s)?);
        references.push(odometry.reference());
        for event in odometry.take_keyframe_events() {
            let made = matches!(event, KeyframeEvent::Made(_));
            let begun = busy_ms();
            mapper.take(event, None, &mut images)?;
            if made {
                times_ms.push(busy_ms() - begun);
                if times_ms.len() % 500 == 0 {
                    let (keyframes, loops) = (times_ms.len(), mapper.closures().len());
                    let mut last = times_ms[keyframes - 500..].to_vec();
                    println!(
                        "  {:.0} s: {keyframes} keyframes, {loops} loops; a keyframe of the last 500: {:.1} ms (median), {:.1} ms (most)",
                        frames.len() as f64 / drive.fps,
                        odometry_median(&mut last),
                        last[499],
                    );
                }
            }
        }
    }
    let begun = busy_ms();
    mapper.finish();
    let finish_ms = busy_ms() - begun;
    let straight = map_frames(&mapper, &frames, &references);
    let (without, with) = (errors_mm(&simulation, &frames), errors_mm(&simulation, &straight));
    let median = odometry_median(&mut times_ms);
    let ties = mapper.map().edges.iter().filter(|e| e.kind == odograph::keyframe::EdgeKind::Loop).count();
    // Error of a loop closure: its distance from the true relative pose of its keyframes.
    let truth = |id: odograph::keyframe::KeyframeId| {
        let found = mapper.map().keyframes.iter().find(|keyframe| keyframe.id == id);
        found.map_or(simulation.truth(0.0), |keyframe| simulation.truth(keyframe.time_s))
    };
    let off_mm = |closure: &odograph::loop_closure::LoopClosure| {
        let seen = odograph::keyframe::relative_pose::relative_motion(
            &truth(closure.edge.from),
            &truth(closure.edge.to),
        );
        1e3 * (seen[0] - closure.edge.motion[0]).hypot(seen[1] - closure.edge.motion[1])
    };
    let worst_loop_mm = mapper.closures().iter().map(off_mm).fold(0.0, f64::max);
    Ok(format!(
        "| {} | {} | {} | {} + {} | {worst_loop_mm:.1} mm | {:.2} ({:.2}) mm | {:.2} ({:.2}) mm | {:.0} | {median:.1} / {:.1} / {:.1} ms | {finish_ms:.0} ms | {:.1} {:.1} |",
        drive.name,
        drive.texture,
        mapper.map().keyframes.len(),
        mapper.closures().len(),
        ties - mapper.closures().len(),
        without.0,
        without.1,
        with.0,
        with.1,
        without.0 / with.0,
        times_ms.get(times_ms.len() * 99 / 100).copied().unwrap_or(0.0),
        times_ms.last().copied().unwrap_or(0.0),
        1e3 * mapper.turn_per_m().0,
        1e3 * mapper.turn_per_m().1,
    ))
}

/// Median; sorts the values.
fn odometry_median(times_ms: &mut [f64]) -> f64 {
    times_ms.sort_unstable_by(f64::total_cmp);
    times_ms.get(times_ms.len() / 2).copied().unwrap_or(0.0)
}

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    println!(
        "| drive | ground | keyframes | loops + revisits | loops off by at most | without loops: RMS (worst) | with | times better | a keyframe: median / 99 % / most | the end | turn of the mount, mrad/m |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|");
    for drive in drives() {
        let all = format!("{} {}", drive.name, drive.texture);
        let chosen = if words.is_empty() {
            !all.contains("kilometre")
        } else {
            words.iter().any(|word| all.contains(word.as_str()))
        };
        if chosen {
            println!("{}", line(&drive)?);
        }
    }
    Ok(())
}
