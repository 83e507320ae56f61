//! Robustness benchmark: rendered drives with disturbances and exact ground truth. Only the camera
//! height is given; the motion model is chosen automatically. Each result is the median over
//! several seeds (ground, noise, disturbance and path).
//!
//! `cargo run --release -p odograph --example effects [-- [--seeds N] [--first-seed N] WORD…]` runs
//! the rows whose name contains one of the words, or all rows. Another first seed gives other
//! recordings; parameters must not be tuned on the seeds that are reported.
//!
//! 640x480 at 30 frames per second, mild barrel distortion, 0.75 m above the ground, image noise of
//! 2 gray levels unless the row says otherwise.

#![allow(clippy::print_stdout)] // prints a table

use odograph::camera::{Camera, Distortion, Rig};
use odograph::error::Result;
use odograph::evaluation::{Alignment, EvaluationOptions, evaluate};
use odograph::geometry::{GroundPose, Pixel, wrap_angle};
use odograph::odometry::{Odometry, OdometryConfig};
use odograph::trajectory::{StampedPose, Trajectory};
use odograph_simulation::{
    Blackout, Effects, Lighting, MovingObject, Path, PathKind, Simulation, SimulationConfig, SlowVariation,
    Texture, Timing, Vibration,
};
use std::f64::consts::TAU;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

const RIG_HEIGHT_M: f64 = 0.75;

/// One kind of recording, with a different drive for each seed.
struct EffectRow {
    name: &'static str,
    texture: &'static str,
    /// Speed over ground, metres per second.
    speed_m_s: f64,
    /// Turn rate for turns on the spot or about a point, radians per second.
    turn_rate_rad_s: f64,
    path: fn(u64) -> PathKind,
    effects: Effects,
}

/// Results of one recording.
#[derive(Debug, Clone, Copy, Default)]
struct EffectFigures {
    posed_percent: f64,
    drift_percent: f64,
    heading_deg_per_m: f64,
    end_mm: f64,
    end_deg: f64,
    /// Normalised estimation error squared (NEES) of x, y and heading, averaged over the frames;
    /// its expected value is 3 if the covariance is consistent.
    nees: f64,
}

fn camera() -> Result<Camera> {
    let distortion = Distortion::from_opencv(&[-0.12, 0.03, 0.0005, -0.0003]).unwrap_or(Distortion::None);
    Camera::new((640, 480), (500.0, 500.0), (321.0, 238.5), distortion)
}

/// A random walk of 6 m with continuous turning.
fn wandering(seed: u64) -> PathKind {
    PathKind::RandomWalk { length_m: 6.0, seed: 100 + seed }
}

fn eight(_: u64) -> PathKind {
    PathKind::FigureEight { length_m: 2.0, laps: 1.0 }
}

fn straight(_: u64) -> PathKind {
    PathKind::Straight { length_m: 60.0 }
}

/// Ten turns about the ground point in a corner of the image; the corner depends on the seed.
fn ten_turns(seed: u64) -> PathKind {
    let corner = [(0.0, 0.0), (639.0, 0.0), (0.0, 479.0), (639.0, 479.0)][seed as usize % 4];
    let ray = camera().ok().and_then(|camera| camera.ray_from_pixel(Pixel::new(corner.0, corner.1)));
    let about = ray.and_then(|ray| Rig::level(RIG_HEIGHT_M).first_pose().ground_from_ray(ray));
    about.map_or(PathKind::Still { duration_s: 1.0 }, |about| PathKind::Pivot { about, turn_rad: 10.0 * TAU })
}

fn rows() -> Vec<EffectRow> {
    let noise = Effects { noise_gray: 2.0, ..Effects::default() };
    let vibration = Vibration { shift_m: 0.004, turn_rad: 0.01, frequency_hz: 7.0 };
    let light = Lighting { drift: 0.25, offset_gray: 8.0, flicker: 0.08, flicker_hz: 97.0 };
    let object = MovingObject { radius_m: 0.09, speed_m_s: 0.3, every_s: 2.5 };
    let row = |name, texture, path, effects: Effects| EffectRow {
        name,
        texture,
        speed_m_s: 0.6,
        turn_rate_rad_s: TAU / 2.0,
        path,
        effects,
    };
    let with = |change: fn(&mut Effects)| {
        let mut effects = noise.clone();
        change(&mut effects);
        effects
    };
    let shaken = Effects { vibration: Some(vibration), ..noise.clone() };
    let lit = Effects {
        lighting: Some(light),
        ground_shadow: 0.35,
        carrier_shadow: Some(Default::default()),
        ..noise.clone()
    };
    let in_hand = Effects {
        vibration: Some(Vibration { shift_m: 0.006, turn_rad: 0.012, frequency_hz: 4.0 }),
        height_change: Some(SlowVariation { amplitude: 0.1, period_s: 5.0 }),
        tilt_change: Some(SlowVariation { amplitude: 3f64.to_radians(), period_s: 4.0 }),
        exposure_s: 0.004,
        object: Some(object),
        noise_gray: 3.0,
        ..lit.clone()
    };
    vec![
        row("clean", "asphalt", wandering, noise.clone()),
        row("clean", "carpet", wandering, noise.clone()),
        row("clean", "grass", wandering, noise.clone()),
        row("clean, crossing itself", "asphalt", eight, noise.clone()),
        row("ten turns about a corner", "asphalt", ten_turns, noise.clone()),
        row("vibration", "asphalt", wandering, shaken),
        row("noise of 6 gray levels", "asphalt", wandering, with(|e| e.noise_gray = 6.0)),
        row("moving light and shadow", "asphalt", wandering, lit),
        row("moving object", "asphalt", wandering, Effects { object: Some(object), ..noise.clone() }),
        row(
            "a third of the frames dropped",
            "asphalt",
            wandering,
            with(|e| e.timing = Timing { dropped: 0.33, jitter_s: 0.003 }),
        ),
        row("repeating tiles", "tiles", wandering, noise.clone()),
        row("repeating bricks", "bricks", wandering, noise.clone()),
        row("low texture", "concrete", wandering, noise.clone()),
        row("very low texture", "bare", wandering, with(|e| e.noise_gray = 1.0)),
        row("very low texture in noise", "bare", wandering, noise.clone()),
        row("exposure of 10 ms", "asphalt", wandering, with(|e| e.exposure_s = 0.010)),
        row("exposure of 33 ms", "asphalt", wandering, with(|e| e.exposure_s = 0.033)),
        row(
            "height ±10 %",
            "asphalt",
            wandering,
            with(|e| e.height_change = Some(SlowVariation { amplitude: 0.1, period_s: 5.0 })),
        ),
        row(
            "height ±50 %",
            "asphalt",
            wandering,
            with(|e| e.height_change = Some(SlowVariation { amplitude: 0.5, period_s: 8.0 })),
        ),
        row(
            "tilt ±3°",
            "asphalt",
            wandering,
            with(|e| e.tilt_change = Some(SlowVariation { amplitude: 3f64.to_radians(), period_s: 4.0 })),
        ),
        row(
            "tilt ±10°",
            "asphalt",
            wandering,
            with(|e| e.tilt_change = Some(SlowVariation { amplitude: 10f64.to_radians(), period_s: 5.0 })),
        ),
        row("in the hand, all of it at once", "grass", wandering, in_hand),
        EffectRow {
            // 0.58 m per frame is 60 % of the image width of 0.96 m; during an exposure of 0.9 ms
            // the image moves 10 px.
            speed_m_s: 17.3,
            ..row("60 % of the image a frame", "asphalt", straight, with(|e| e.exposure_s = 0.0009))
        },
        row(
            "two seconds of darkness",
            "asphalt",
            wandering,
            with(|e| e.blackouts = vec![Blackout { from_s: 4.0, to_s: 6.0 }]),
        ),
    ]
}

/// Renders and tracks one recording.
fn measure(row: &EffectRow, seed: u64) -> Result<EffectFigures> {
    let rig = Rig::level(RIG_HEIGHT_M);
    let simulation = Simulation::new(SimulationConfig {
        camera: camera()?,
        rig,
        texture: Texture::named(row.texture).unwrap_or(Texture::Asphalt),
        path: Path::new((row.path)(seed), row.speed_m_s, row.turn_rate_rad_s, true)?,
        effects: row.effects.clone(),
        fps: 30.0,
        duration_s: None,
        colored: false,
        seed: 1000 + seed,
    })?;
    let mut odometry = Odometry::new(camera()?, rig, OdometryConfig::default())?;
    let (mut estimate, mut truth) = (Trajectory::default(), Trajectory::default());
    let (mut squares, mut compared) = (0.0, 0usize);
    for frame in (0..simulation.len()).map_while(|number| simulation.frame(number)) {
        let stamped = |pose: GroundPose| StampedPose {
            time_s: frame.time_s,
            world_from_camera: pose.world_from_camera(),
        };
        truth.poses.push(stamped(frame.truth));
        let tracked = odometry.process(frame.image, frame.time_s)?;
        let Some(known) = tracked.estimate else { continue };
        estimate.poses.push(stamped(known.pose));
        let error = nalgebra::Vector3::new(
            known.pose.x_m - frame.truth.x_m,
            known.pose.y_m - frame.truth.y_m,
            wrap_angle(known.pose.heading_rad - frame.truth.heading_rad),
        );
        // The first pose is exact by definition.
        if frame.number > 30
            && let Some(information) = known.covariance.fixed_view::<3, 3>(0, 0).into_owned().try_inverse()
        {
            squares += error.dot(&(information * error));
            compared += 1;
        }
    }
    let options = EvaluationOptions {
        alignment: Alignment::Origin,
        segment_lengths_m: vec![1.0],
        ..EvaluationOptions::default()
    };
    let found = evaluate(&estimate, &truth, &options)?;
    let drift = found.drift.first();
    Ok(EffectFigures {
        posed_percent: 100.0 * estimate.poses.len() as f64 / truth.poses.len() as f64,
        drift_percent: drift.map_or(f64::NAN, |d| d.translation_percent),
        heading_deg_per_m: drift.map_or(f64::NAN, |d| d.heading_deg_per_m),
        end_mm: 1e3 * found.final_position_error_m,
        end_deg: found.final_heading_error_rad.to_degrees().abs(),
        nees: squares / compared.max(1) as f64,
    })
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    odograph::numerics::median(&mut values).unwrap_or(f64::NAN)
}

/// Formats the medians of a row as a line of the table.
fn line(row: &EffectRow, results: &[std::result::Result<EffectFigures, String>]) -> String {
    let of = |what: fn(&EffectFigures) -> f64| median(results.iter().flatten().map(what));
    let failed = results.iter().find_map(|result| result.as_ref().err());
    format!(
        "| {} | {} | {:.1} % | {:.4} % | {:.4}° | {:.2} mm | {:.3}° | {:.2} |{}",
        row.name,
        row.texture,
        of(|f| f.posed_percent),
        of(|f| f.drift_percent),
        of(|f| f.heading_deg_per_m),
        of(|f| f.end_mm),
        of(|f| f.end_deg),
        of(|f| f.nees),
        failed.map_or(String::new(), |error| format!(" {error}")),
    )
}

fn main() -> Result<()> {
    let (mut first_seed, mut seeds) = (0, 5);
    let mut words = Vec::new();
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--first-seed" => {
                first_seed = arguments.next().and_then(|n| n.parse().ok()).unwrap_or(first_seed)
            }
            "--seeds" => seeds = arguments.next().and_then(|n| n.parse().ok()).unwrap_or(seeds),
            _ => words.push(argument),
        }
    }
    let rows: Vec<EffectRow> = rows()
        .into_iter()
        .filter(|row| {
            let all = format!("{} {}", row.name, row.texture);
            words.is_empty() || words.iter().any(|word| all.contains(word.as_str()))
        })
        .collect();
    let jobs: Vec<(usize, u64)> = (0..rows.len())
        .flat_map(|row| (first_seed..first_seed + seeds).map(move |seed| (row, seed)))
        .collect();
    println!("Medians over {seeds} seeds from {first_seed}.\n");
    println!(
        "| recording | ground | frames posed | error over each metre | heading over each metre | at the end | heading at the end | NEES (3 is true) |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    // A line is printed as soon as it and all lines above it are complete.
    let results = Mutex::new((vec![Vec::new(); rows.len()], 0));
    let next = AtomicUsize::new(0);
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                while let Some(&(row, seed)) = jobs.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let result = measure(&rows[row], seed);
                    let Ok(mut known) = results.lock() else { continue };
                    let (results, printed) = &mut *known;
                    results[row].push(result.map_err(|error| error.to_string()));
                    while results.get(*printed).is_some_and(|results| results.len() as u64 == seeds) {
                        println!("{}", line(&rows[*printed], &results[*printed]));
                        *printed += 1;
                    }
                }
            });
        }
    });
    Ok(())
}
