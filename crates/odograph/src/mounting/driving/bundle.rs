//! The common tilt of many pairs of views, each with a planar movement of its own.

use super::{Group, Pair};
use crate::camera::{Camera, Rig};
use crate::geometry::{GroundPoint, GroundPose};
use crate::mounting::combination::{Part, inverse};
use crate::mounting::reprojection::PosedCamera;
use nalgebra::{Matrix2, Matrix6, SMatrix, Vector2, Vector6};

/// The solution, and what each keyframe says about it.
pub struct Solved {
    pub roll_rad: f64,
    pub pitch_rad: f64,
    pub parts: Vec<Part<2>>,
    pub pairs: usize,
    pub rms_px: f64,
}

/// The movement of the camera between two views: x, y (heights), turn (radians); then by how much the second is higher than the first
/// (heights) and tilted against it in roll and pitch, which a steady mount leaves at zero.
type Movement = Vector6<f64>;

/// A pair that is being solved.
struct Work<'a> {
    pair: &'a Pair,
    group: usize,
    movement: Movement,
    weights: Vec<f64>,
    variance_px2: f64,
}

/// Rounds of Gauss–Newton; from ten degrees off it needs six.
const ROUNDS: usize = 30;

/// A step below this is a thousandth of what can be told, radians.
const SETTLED_RAD: f64 = 1e-8;

/// Neighbouring tracks share errors of about this, pixels: a smaller noise is not believed.
const SMALLEST_NOISE_PX: f64 = 0.01;

/// Fewer agreeing tracks than this are no pair.
const FEWEST_TRACKS: f64 = 12.0;

/// Rounds of those in which wrong tracks still lose their weight; what is left of them after it counts in full, so that the last
/// rounds are plain least squares.
const ROBUST_ROUNDS: usize = 15;

pub fn solve(camera: &Camera, groups: &[Group], start: &Rig) -> Option<Solved> {
    let (mut roll_rad, mut pitch_rad) = (start.roll_rad, start.pitch_rad);
    let mut work: Vec<Work<'_>> = groups
        .iter()
        .enumerate()
        .flat_map(|(group, pairs)| pairs.pairs.iter().map(move |pair| (group, pair)))
        .filter_map(|(group, pair)| begin(camera, group, pair, tilted(roll_rad, pitch_rad)))
        .collect();
    let mut sway = Sway { variance: FIRST_SWAY.map(|sigma| sigma * sigma) };
    for round in 0..ROUNDS {
        let rig = tilted(roll_rad, pitch_rad);
        let systems: Vec<System> = work.iter().map(|pair| System::new(camera, pair, &rig, &sway)).collect();
        let (mut information, mut slope) = (Matrix2::zeros(), Vector2::zeros());
        for reduced in systems.iter().filter_map(System::reduced) {
            information += reduced.information;
            slope += reduced.slope;
        }
        let step = inverse(&information)? * slope;
        roll_rad += step[0];
        pitch_rad += step[1];
        if !(roll_rad.abs() < 1.4 && pitch_rad.abs() < 1.4) {
            return None;
        }
        let rig = tilted(roll_rad, pitch_rad);
        for (pair, system) in work.iter_mut().zip(&systems) {
            if let Some(step) = system.movement_step(&step) {
                pair.movement += step;
            }
            pair.judge(camera, &rig, round);
        }
        // The first steps are long: what they leave is not the mount's.
        if round >= 2 {
            sway.learn(&work, &systems);
        }
        if round > ROBUST_ROUNDS && step.norm() < SETTLED_RAD {
            break;
        }
    }
    let rig = tilted(roll_rad, pitch_rad);
    let empty = Part { information: Matrix2::zeros(), slope: Vector2::zeros() };
    let mut parts = vec![empty; groups.len()];
    let (mut squares, mut kept, mut pairs) = (0.0, 0.0, 0);
    for pair in &work {
        let weight: f64 = pair.weights.iter().sum();
        let Some(reduced) =
            System::new(camera, pair, &rig, &sway).reduced().filter(|_| weight >= FEWEST_TRACKS)
        else {
            continue;
        };
        parts[pair.group].information += reduced.information;
        parts[pair.group].slope += reduced.slope;
        squares += 2.0 * weight * pair.variance_px2;
        kept += weight;
        pairs += 1;
    }
    parts.retain(|part| part.information.trace() > 0.0);
    Some(Solved { roll_rad, pitch_rad, parts, pairs, rms_px: (squares / f64::max(kept, 1.0)).sqrt() })
}

/// By how much the second view of a pair may be higher and tilted against the first: a Gaussian whose variances the recording itself
/// tells (empirical Bayes, as [`crate::motion::RigWander`] does for the odometry). On a steady mount nothing is left of them.
struct Sway {
    variance: [f64; 3],
}

/// Standard deviations to begin with: a part of the height, radians.
const FIRST_SWAY: [f64; 3] = [0.01, 0.01, 0.01];

/// Below this nothing changes that could be measured.
const LEAST_SWAY: f64 = 1e-6;

impl Sway {
    /// One step of expectation-maximisation (A. Dempster, N. Laird, D. Rubin, 1977).
    fn learn(&mut self, work: &[Work<'_>], systems: &[System]) {
        let mut squares = [0.0; 3];
        let mut count = 0.0;
        for (pair, system) in work.iter().zip(systems) {
            let Some(covariance) = inverse(&system.movement) else { continue };
            for k in 0..3 {
                squares[k] += pair.movement[3 + k] * pair.movement[3 + k] + covariance[(3 + k, 3 + k)];
            }
            count += 1.0;
        }
        if count > 0.0 {
            self.variance = squares.map(|sum| (sum / count).max(LEAST_SWAY * LEAST_SWAY));
        }
    }
}

/// The pose of the first view of every pair: the height is the unit of length.
fn tilted(roll_rad: f64, pitch_rad: f64) -> GroundPose {
    GroundPose { roll_rad, pitch_rad, ..GroundPose::level(1.0) }
}

/// The pose of the second view.
fn moved(rig: &GroundPose, movement: &Movement) -> GroundPose {
    GroundPose {
        x_m: movement[0],
        y_m: movement[1],
        heading_rad: movement[2],
        height_m: rig.height_m + movement[3],
        roll_rad: rig.roll_rad + movement[4],
        pitch_rad: rig.pitch_rad + movement[5],
    }
}

/// The planar movement that brings the ground points of the tracks best together (Umeyama, "Least-squares estimation of transformation
/// parameters", 1991, without scale), from those with which the odometry agreed.
fn begin<'a>(camera: &Camera, group: usize, pair: &'a Pair, rig: GroundPose) -> Option<Work<'a>> {
    let on_ground = |pixel| camera.ray_from_pixel(pixel).and_then(|ray| rig.ground_from_ray(ray));
    let agreeing: Vec<(GroundPoint, GroundPoint)> = pair
        .tracks
        .iter()
        .filter(|(_, _, agrees)| *agrees)
        .filter_map(|(first, second, _)| Some((on_ground(*first)?, on_ground(*second)?)))
        .collect();
    if (agreeing.len() as f64) < FEWEST_TRACKS {
        return None;
    }
    let n = agreeing.len() as f64;
    let mean = agreeing
        .iter()
        .fold([0.0; 4], |m, (a, b)| [m[0] + a.x_m / n, m[1] + a.y_m / n, m[2] + b.x_m / n, m[3] + b.y_m / n]);
    let (mut along, mut across) = (0.0, 0.0);
    for (a, b) in &agreeing {
        let (ax, ay, bx, by) = (a.x_m - mean[0], a.y_m - mean[1], b.x_m - mean[2], b.y_m - mean[3]);
        along += ax * bx + ay * by;
        across += ay * bx - ax * by;
    }
    // The world seems to turn against the camera.
    let turn_rad = across.atan2(along);
    let (sin, cos) = turn_rad.sin_cos();
    let movement = Vector6::new(
        mean[0] - cos * mean[2] + sin * mean[3],
        mean[1] - sin * mean[2] - cos * mean[3],
        turn_rad,
        0.0,
        0.0,
        0.0,
    );
    let mut work = Work { pair, group, movement, weights: vec![1.0; pair.tracks.len()], variance_px2: 1.0 };
    work.judge(camera, &rig, 0);
    Some(work)
}

impl Work<'_> {
    /// Weights and noise from how well the tracks are explained now.
    fn judge(&mut self, camera: &Camera, rig: &GroundPose, round: usize) {
        let second = moved(rig, &self.movement);
        let errors: Vec<f64> = self
            .pair
            .tracks
            .iter()
            .map(|(first, seen, _)| {
                camera
                    .ray_from_pixel(*first)
                    .and_then(|ray| rig.ground_from_ray(ray))
                    .and_then(|ground| second.ray_from_ground(ground))
                    .and_then(|ray| camera.pixel_from_ray(ray))
                    .map_or(f64::INFINITY, |pixel| pixel.distance(*seen))
            })
            .collect();
        if round > ROBUST_ROUNDS {
            let squares: f64 =
                errors.iter().zip(&self.weights).filter(|(_, w)| **w > 0.0).map(|(e, _)| e * e).sum();
            let kept: f64 = self.weights.iter().sum();
            self.variance_px2 =
                (squares / (2.0 * kept - 3.0).max(1.0)).max(SMALLEST_NOISE_PX * SMALLEST_NOISE_PX);
            return;
        }
        let mut sorted = errors.clone();
        let middle = sorted.len() / 2;
        let median = *sorted.select_nth_unstable_by(middle, f64::total_cmp).1;
        // Of a Rayleigh distribution the median is 1.1774 deviations of a coordinate. Tukey's c for 95 % efficiency is 4.685.
        let scale_px = (median / 1.1774).max(SMALLEST_NOISE_PX);
        if !scale_px.is_finite() {
            self.weights.fill(0.0);
            return;
        }
        let reach_px = scale_px * if round < ROBUST_ROUNDS { 4.685 } else { KEPT_DEVIATIONS };
        let biweight = |ratio: f64| if ratio < 1.0 { (1.0 - ratio * ratio).powi(2) } else { 0.0 };
        let weight = |error: f64| match round {
            ROBUST_ROUNDS => f64::from(u8::from(error < reach_px)),
            _ => biweight(error / reach_px),
        };
        self.weights = errors.iter().map(|&error| weight(error)).collect();
        self.variance_px2 = scale_px * scale_px;
    }
}

/// Tracks that are further off than this, in deviations of a coordinate, are wrong: 2 in 1000 of the others are.
const KEPT_DEVIATIONS: f64 = 3.5;

/// Normal equations of one pair in units of its noise: tilt first, movement second.
struct System {
    tilt: Matrix2<f64>,
    mixed: SMatrix<f64, 2, 6>,
    movement: Matrix6<f64>,
    tilt_slope: Vector2<f64>,
    movement_slope: Vector6<f64>,
}

impl System {
    fn new(camera: &Camera, work: &Work<'_>, rig: &GroundPose, sway: &Sway) -> Self {
        let first = PosedCamera::new(camera, *rig);
        let second = PosedCamera::new(camera, moved(rig, &work.movement));
        let mut system = Self {
            tilt: Matrix2::zeros(),
            mixed: SMatrix::zeros(),
            movement: Matrix6::zeros(),
            tilt_slope: Vector2::zeros(),
            movement_slope: Vector6::zeros(),
        };
        for ((corner, seen_at, _), &weight) in work.pair.tracks.iter().zip(&work.weights) {
            if weight <= 0.0 {
                continue;
            }
            let Some((ground, by_tilt)) = camera.ray_from_pixel(*corner).and_then(|ray| first.ground(ray))
            else {
                continue;
            };
            let Some(seen) = second.see(ground) else { continue };
            let weight = weight / work.variance_px2;
            let error = Vector2::new(seen_at.x - seen.pixel.x, seen_at.y - seen.pixel.y);
            let by_movement = seen.by_pose;
            let by_tilt = seen.by_pose.fixed_columns::<2>(4) + seen.by_ground * by_tilt;
            system.tilt += weight * by_tilt.transpose() * by_tilt;
            system.mixed += weight * by_tilt.transpose() * by_movement;
            system.movement += weight * by_movement.transpose() * by_movement;
            system.tilt_slope += weight * by_tilt.transpose() * error;
            system.movement_slope += weight * by_movement.transpose() * error;
        }
        for (k, variance) in sway.variance.iter().enumerate() {
            system.movement[(3 + k, 3 + k)] += 1.0 / variance;
            system.movement_slope[3 + k] -= work.movement[3 + k] / variance;
        }
        system
    }

    /// What is left for the tilt once the movement is free.
    fn reduced(&self) -> Option<Part<2>> {
        let movement = inverse(&self.movement)?;
        Some(Part {
            information: self.tilt - self.mixed * movement * self.mixed.transpose(),
            slope: self.tilt_slope - self.mixed * movement * self.movement_slope,
        })
    }

    /// The step of the movement that goes with one of the tilt.
    fn movement_step(&self, tilt_step: &Vector2<f64>) -> Option<Movement> {
        Some(inverse(&self.movement)? * (self.movement_slope - self.mixed.transpose() * tilt_step))
    }
}
