//! Accuracy with parts of the image that do not move with the ground: the vehicle's bumper, dirt on
//! the lens, the vehicle's shadow or lamp. Rendered drives with exact ground truth; each result is
//! the median over several seeds and paths.
//!
//! `cargo run --release -p odograph --example fixed_in_image [-- [--seeds N] [--each] WORD…]` runs
//! the rows whose name contains all of the words; `--each` prints every drive.

#![allow(clippy::print_stdout)] // prints a table

use odograph::camera::{Camera, Distortion, Rig};
use odograph::error::Result;
use odograph::geometry::GroundPose;
use odograph::image::GrayImage;
use odograph::odometry::{Odometry, OdometryConfig};
use odograph_simulation::{Effects, Lighting, Path, PathKind, Shadow, Simulation, SimulationConfig, Texture};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

const RIG_HEIGHT_M: f64 = 0.75;

/// The pattern that is fixed in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Fixed {
    Nothing,
    /// The vehicle's bumper with printed stickers; the fraction of the image that it covers.
    Bumper(f64),
    /// Number of dirt specks on the lens, alternately with soft and sharp edges.
    Dirt(usize),
    /// A soft shadow of the vehicle.
    Shadow,
    /// A lamp of this strength with a highlight.
    Lamp(f64),
}

/// Path of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
enum DrivePath {
    Straight,
    Eight,
    Walk,
    /// Standing still for three seconds at the beginning and at the end.
    Stands,
}

/// One kind of drive.
#[derive(Debug, Clone, Copy)]
struct MaskedDrive {
    fixed: Fixed,
    texture: &'static str,
    way: DrivePath,
    speed_m_s: f64,
    /// Whether the illumination drifts and flickers.
    lit: bool,
}

/// Results of one drive.
#[derive(Debug, Clone, Copy)]
struct DriveFigures {
    lost_percent: f64,
    /// Frames of the first segment whose position error exceeds 10 % of the distance travelled, at
    /// least 20 mm.
    wrong_percent: f64,
    /// Relative translation error over 1 m of path, over pairs of frames in the same segment.
    drift_percent: f64,
    /// Estimated path length as a percentage of the true one.
    way_percent: f64,
    masked_percent: f64,
}

fn hash(seed: u64, x: i64, y: i64) -> f64 {
    let mut value = seed ^ (x as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (y as u64).rotate_left(32);
    for _ in 0..3 {
        value = (value ^ (value >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    }
    (value >> 11) as f64 / (1u64 << 53) as f64
}

/// Smooth value noise from -1 to 1 with a period of about 1.
fn value_noise(seed: u64, x: f64, y: f64) -> f64 {
    let (column, row) = (x.floor(), y.floor());
    let smooth = |t: f64| t * t * (3.0 - 2.0 * t);
    let (u, v) = (smooth(x - column), smooth(y - row));
    let at = |i: i64, j: i64| 2.0 * hash(seed, column as i64 + i, row as i64 + j) - 1.0;
    let upper = at(0, 0) + u * (at(1, 0) - at(0, 0));
    let lower = at(0, 1) + u * (at(1, 1) - at(0, 1));
    upper + v * (lower - upper)
}

/// Per pixel a factor and an offset: the output is `factor * input + offset`.
fn overlay(fixed: Fixed, (width, height): (usize, usize), seed: u64) -> Vec<(f32, f32)> {
    let (w, h) = (width as f64, height as f64);
    let mut out = vec![(1.0f32, 0.0f32); width * height];
    match fixed {
        Fixed::Nothing | Fixed::Shadow => {}
        Fixed::Bumper(share) => {
            let bracket = |u: f64, at: f64| (4.0 - 80.0 * (u - at).abs()).clamp(0.0, 1.0);
            let outline = |column: usize| {
                let u = (column as f64 + 0.5) / w;
                1.0 + 0.3 * value_noise(seed, 5.0 * u, 0.5)
                    + 0.1 * value_noise(seed, 31.0 * u, 9.5)
                    + 0.45 * (bracket(u, 0.22) + bracket(u, 0.71))
            };
            let scale = share * h * w / (0..width).map(outline).sum::<f64>();
            for (at, out) in out.iter_mut().enumerate() {
                let (column, row) = (at % width, at / width);
                let inside_px = row as f64 + 1.0 - (h - scale * outline(column));
                let covered = (0.5 * inside_px + 0.25).clamp(0.0, 1.0);
                let (x, y) = (column as f64 / w, (row as f64 - h) / w);
                // Stickers and print: blocks of 11 px of random gray levels.
                let stripe = hash(seed ^ 5, (column / 11) as i64, (row / 11) as i64);
                let scratches = 14.0 * value_noise(seed ^ 2, 110.0 * x, 30.0 * y)
                    + 12.0 * value_noise(seed ^ 3, 25.0 * x, 260.0 * y);
                let gray = (24.0 + 200.0 * stripe + scratches).clamp(4.0, 250.0);
                *out = ((1.0 - covered) as f32, (covered * gray) as f32);
            }
        }
        Fixed::Dirt(count) => {
            for speck in 0..count as i64 {
                let draw = |index: i64| hash(seed ^ 0xD127, speck, index);
                let (x0, y0) = (w * draw(0), h * draw(1));
                let soft = speck % 2 == 0;
                let radius_px = w * if soft { 0.02 + 0.035 * draw(2) } else { 0.006 + 0.018 * draw(2) };
                let darkness = if soft { 0.35 + 0.4 * draw(3) } else { 0.7 + 0.25 * draw(3) };
                for (at, out) in out.iter_mut().enumerate() {
                    let (dx, dy) =
                        (((at % width) as f64 - x0) / radius_px, ((at / width) as f64 - y0) / radius_px);
                    if dx.abs().max(dy.abs()) > 2.0 {
                        continue;
                    }
                    let uneven = 0.3 * value_noise(seed ^ speck as u64, 1.5 * dx, 1.5 * dy);
                    let distance = dx.hypot(dy) * (1.0 + uneven);
                    let covered = if soft {
                        (-distance.powi(4)).exp()
                    } else {
                        (0.4 * (1.0 - distance) * radius_px + 0.5).clamp(0.0, 1.0)
                    };
                    out.0 *= (1.0 - darkness * covered) as f32;
                }
            }
        }
        Fixed::Lamp(strength) => {
            let (cx, cy, radius) = (0.46 * w, 0.42 * h, 0.45 * h);
            for (at, out) in out.iter_mut().enumerate() {
                let (x, y) = ((at % width) as f64, (at / width) as f64);
                let distance = (x - cx).hypot(y - cy) / radius;
                let light = 1.0 - 0.85 * strength + 2.0 * strength * (-distance * distance).exp();
                let beside = (x - cx).hypot(y - cy - 0.12 * radius) / (0.14 * radius);
                *out = (light as f32, (700.0 * strength * (-beside * beside).exp()) as f32);
            }
        }
    }
    out
}

/// Applies the overlay to an image and adds sensor noise.
fn covered(image: &GrayImage, overlay: &[(f32, f32)], number: u64) -> GrayImage {
    let mut state = number.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut out = image.clone();
    for (sample, (times, plus)) in out.samples_mut().iter_mut().zip(overlay) {
        // Sum of four uniform 16-bit numbers, scaled to a standard deviation of 2 gray levels.
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        let sum: u64 = (0..4).map(|i| (state >> (16 * i)) & 0xffff).sum();
        let noise = (sum as f32 / 65536.0 - 2.0) * (2.0 / 0.577);
        *sample = (f32::from(*sample) * times + plus + noise + 0.5) as u8;
    }
    out
}

fn camera() -> Result<Camera> {
    let distortion = Distortion::from_opencv(&[-0.12, 0.03, 0.0005, -0.0003]).unwrap_or(Distortion::None);
    Camera::new((640, 480), (500.0, 500.0), (321.0, 238.5), distortion)
}

fn measure(drive: &MaskedDrive, seed: u64, each: bool) -> Result<DriveFigures> {
    let rig = Rig::level(RIG_HEIGHT_M);
    let way_m = (12.0 * drive.speed_m_s).min(4.0);
    let kind = match drive.way {
        DrivePath::Straight | DrivePath::Stands => PathKind::Straight { length_m: way_m },
        DrivePath::Eight => PathKind::FigureEight { length_m: way_m / 2.0, laps: 1.0 },
        DrivePath::Walk => PathKind::RandomWalk { length_m: way_m, seed: 100 + seed },
    };
    let shadow = (drive.fixed == Fixed::Shadow).then(Shadow::default);
    let lighting =
        drive.lit.then_some(Lighting { drift: 0.25, offset_gray: 8.0, flicker: 0.08, flicker_hz: 97.0 });
    let simulation = Simulation::new(SimulationConfig {
        camera: camera()?,
        rig,
        texture: Texture::named(drive.texture).unwrap_or(Texture::Asphalt),
        path: Path::new(kind, drive.speed_m_s, 1.0, true)?,
        effects: Effects { carrier_shadow: shadow, lighting, ..Effects::default() },
        fps: 30.0,
        duration_s: None,
        colored: false,
        seed: 1000 + seed,
    })?;
    let overlay = overlay(drive.fixed, (640, 480), seed);
    let config = OdometryConfig::default();
    let mut odometry = Odometry::new(camera()?, rig, config)?;
    let standing = if drive.way == DrivePath::Stands { 90 } else { 0 };
    let mut poses: Vec<(GroundPose, Option<(GroundPose, usize)>)> = Vec::new();
    let mut take = |image: &GrayImage, truth: GroundPose| -> Result<()> {
        let number = poses.len();
        let image = covered(image, &overlay, number as u64 + 1);
        let frame = odometry.process(image, number as f64 / 30.0)?;
        poses.push((truth, frame.estimate.map(|estimate| (estimate.pose, frame.segment))));
        Ok(())
    };
    let (mut first, mut last) = (true, None);
    for frame in (0..simulation.len()).map_while(|number| simulation.frame(number)) {
        for _ in 0..if first { standing } else { 0 } {
            take(&frame.image, frame.truth)?;
        }
        first = false;
        take(&frame.image, frame.truth)?;
        last = Some(frame);
    }
    for _ in 0..standing {
        if let Some(frame) = &last {
            take(&frame.image, frame.truth)?;
        }
    }
    let share = odometry.masked_share();
    let figures = figures(&poses, share);
    if each {
        println!("  {drive:?} seed {seed}: {figures:.2?}, {} keyframes", odometry.keyframes());
    }
    Ok(figures)
}

fn figures(poses: &[(GroundPose, Option<(GroundPose, usize)>)], share: f64) -> DriveFigures {
    let distance = |a: &GroundPose, b: &GroundPose| (a.x_m - b.x_m).hypot(a.y_m - b.y_m);
    let mut way = vec![0.0];
    for pair in poses.windows(2) {
        way.push(way[way.len() - 1] + distance(&pair[0].0, &pair[1].0));
    }
    let (mut begin, mut errors, mut lost, mut wrong, mut moved) = (0, Vec::new(), 0, 0, 0.0);
    for (now, (truth, found)) in poses.iter().enumerate() {
        let Some((pose, segment)) = found else {
            lost += 1;
            continue;
        };
        if let Some((_, Some((before, s)))) = now.checked_sub(1).map(|before| &poses[before])
            && s == segment
        {
            moved += distance(before, pose);
        }
        let off_m = distance(truth, pose);
        wrong += usize::from(*segment == 0 && off_m > 0.02f64.max(0.1 * way[now]));
        while begin < now && way[now] - way[begin + 1] >= 1.0 {
            begin += 1;
        }
        if way[now] - way[begin] < 1.0 {
            continue;
        }
        if let (then, Some((before, s))) = &poses[begin]
            && s == segment
        {
            // The displacement in the camera frame at its start, i.e. rotated by the heading there.
            let seen = |from: &GroundPose, to: &GroundPose| {
                let (sin, cos) = from.heading_rad.sin_cos();
                let (dx, dy) = (to.x_m - from.x_m, to.y_m - from.y_m);
                (cos * dx + sin * dy, cos * dy - sin * dx)
            };
            let (a, b) = (seen(then, truth), seen(before, pose));
            errors.push(100.0 * (a.0 - b.0).hypot(a.1 - b.1) / (way[now] - way[begin]));
        }
    }
    let count = poses.len() as f64;
    let mean = errors.iter().sum::<f64>() / errors.len().max(1) as f64;
    DriveFigures {
        lost_percent: 100.0 * lost as f64 / count,
        wrong_percent: 100.0 * wrong as f64 / count,
        drift_percent: if errors.is_empty() { f64::NAN } else { mean },
        way_percent: 100.0 * moved / way[way.len() - 1].max(1e-9),
        masked_percent: 100.0 * share,
    }
}

fn rows() -> Vec<(String, Vec<MaskedDrive>)> {
    let mut rows = Vec::new();
    let ways = |fixed, texture, speed_m_s, lit| {
        let drive = move |way| MaskedDrive { fixed, texture, way, speed_m_s, lit };
        [DrivePath::Straight, DrivePath::Eight, DrivePath::Walk].map(drive).to_vec()
    };
    for texture in ["concrete", "carpet", "tiles", "asphalt"] {
        for (name, fixed) in [
            ("nothing", Fixed::Nothing),
            ("bumper 5 %", Fixed::Bumper(0.05)),
            ("bumper 25 %", Fixed::Bumper(0.25)),
            ("dirt 20", Fixed::Dirt(20)),
            ("dirt 40", Fixed::Dirt(40)),
            ("shadow", Fixed::Shadow),
            ("lamp", Fixed::Lamp(0.7)),
        ] {
            rows.push((format!("{texture}: {name}"), ways(fixed, texture, 0.5, false)));
        }
    }
    let one = |fixed, texture, way, speed_m_s, lit| vec![MaskedDrive { fixed, texture, way, speed_m_s, lit }];
    for texture in ["concrete", "asphalt"] {
        let bumper = Fixed::Bumper(0.15);
        rows.push((format!("{texture}: bumper 60 %"), ways(Fixed::Bumper(0.6), texture, 0.5, false)));
        rows.push((
            format!("{texture}: bumper, stands"),
            one(bumper, texture, DrivePath::Stands, 0.5, false),
        ));
        rows.push((
            format!("{texture}: nothing, stands"),
            one(Fixed::Nothing, texture, DrivePath::Stands, 0.5, false),
        ));
        rows.push((
            format!("{texture}: bumper, 0.05 m/s"),
            one(bumper, texture, DrivePath::Straight, 0.05, false),
        ));
        rows.push((format!("{texture}: bumper, lit"), ways(bumper, texture, 0.5, true)));
        rows.push((
            format!("{texture}: dirt, 0.05 m/s"),
            one(Fixed::Dirt(20), texture, DrivePath::Walk, 0.05, false),
        ));
    }
    rows
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    odograph::numerics::median(&mut values).unwrap_or(f64::NAN)
}

fn main() -> Result<()> {
    let (mut seeds, mut each, mut words) = (3, false, Vec::new());
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--seeds" => seeds = arguments.next().and_then(|n| n.parse().ok()).unwrap_or(seeds),
            "--each" => each = true,
            _ => words.push(argument),
        }
    }
    let rows: Vec<(String, Vec<MaskedDrive>)> = rows()
        .into_iter()
        .filter(|(name, _)| words.iter().all(|word| name.contains(word.as_str())))
        .collect();
    println!("| recording | frames lost | frames wrong | error over each metre | worst | way | masked |");
    println!("|---|---|---|---|---|---|---|");
    for (name, drives) in &rows {
        let jobs: Vec<(MaskedDrive, u64)> =
            drives.iter().flat_map(|drive| (0..seeds).map(move |seed| (*drive, seed))).collect();
        let (found, next) = (Mutex::new(Vec::new()), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
                scope.spawn(|| {
                    while let Some((drive, seed)) = jobs.get(next.fetch_add(1, Ordering::Relaxed)) {
                        match (measure(drive, *seed, each), found.lock()) {
                            (Ok(figures), Ok(mut found)) => found.push(figures),
                            (Err(error), _) => println!("{error}"),
                            _ => {}
                        }
                    }
                });
            }
        });
        let Ok(found) = found.into_inner() else { continue };
        let of = |what: fn(&DriveFigures) -> f64| median(found.iter().map(what));
        let worst = found.iter().map(|f| f.drift_percent).fold(f64::NAN, f64::max);
        println!(
            "| {name} | {:.1} % | {:.1} % | {:.4} % | {worst:.4} % | {:.1} % | {:.1} % |",
            of(|f| f.lost_percent),
            of(|f| f.wrong_percent),
            of(|f| f.drift_percent),
            of(|f| f.way_percent),
            of(|f| f.masked_percent),
        );
    }
    Ok(())
}
