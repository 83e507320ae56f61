//! The pose that re-projects ground points onto their tracks: robust Gauss–Newton in pixels.

use super::elevation::{MeasuredElevation, Parallax};
use super::normal_equations::{Factor, NormalEquations, POSE, Row, WITH_KEYFRAME, WITH_SKEW};
use super::sharing::{Neighbours, shared_errors, shared_errors_of_rig, shared_px};
use super::{
    KeyframeError, MotionConfig, MotionEstimate, MotionModel, Observation, Observations, PoseRates,
    RigEvidence, RigPrior, ShutterEstimate, ShutterPrior,
};
use crate::buffer::{Buffer, stored};
use crate::camera::Camera;
use crate::geometry::{GroundPoint, GroundPose, wrap_angle};
use nalgebra::{Matrix3, Matrix6, Vector3};

/// Which of (x, y, heading, height, roll, pitch) are solved for: the first `count` of them.
#[derive(Debug, Clone, Copy)]
pub struct Unknowns {
    count: usize,
}

impl Unknowns {
    /// All six.
    pub const ALL: Self = Self { count: 6 };

    pub fn new(model: MotionModel) -> Self {
        Self { count: model.unknowns() }
    }

    /// How many.
    pub fn count(&self) -> usize {
        self.count
    }
}

/// A prior with its weight in units of one over the squared pixel noise.
#[derive(Debug, Clone, Copy)]
pub struct Pull {
    mean: [f64; 3],
    weight: [f64; 3],
}

impl Pull {
    fn new(prior: &RigPrior, scale_px: f64) -> Self {
        Self { mean: prior.mean, weight: prior.sigma.map(|sigma| (scale_px / sigma).powi(2)) }
    }

    fn add_to(&self, equations: &mut NormalEquations, pose: &GroundPose) {
        let here = [pose.height_m, pose.roll_rad, pose.pitch_rad];
        for (i, here) in here.into_iter().enumerate() {
            equations.add_prior(3 + i, here - self.mean[i], self.weight[i]);
        }
    }
}

/// Where an observation's ground point is seen from a pose, less where it was seen, whitened (pixels of a usual track), and the derivative of
/// that by the six numbers of the pose.
#[derive(Debug, Clone, Copy)]
pub(super) struct Residual {
    pub error: [f64; 2],
    /// The distance before whitening, pixels.
    pub distance_px: f64,
    pub by_pose: [[f64; 6]; 2],
    /// Its derivative by height, roll and pitch of the keyframe that laid the point, whitened.
    pub by_keyframe: [[f64; 3]; 2],
    /// Its parts along and across the parallax of the point.
    pub parallax: Parallax,
}

stored!(Residual);

impl Residual {
    /// Of a point that is not seen: no length, and nothing that it could change.
    pub const NONE: Self = Self {
        error: [0.0; 2],
        distance_px: f64::INFINITY,
        by_pose: [[0.0; 6]; 2],
        by_keyframe: [[0.0; 3]; 2],
        parallax: Parallax::NONE,
    };

    fn length(&self) -> f64 {
        (self.error[0] * self.error[0] + self.error[1] * self.error[1]).sqrt()
    }
}

/// `None` where the point is not in front of the lens.
#[inline]
fn residual(camera: &Camera, observation: &Observation, pose: &GroundPose, axes: &Axes) -> Option<Residual> {
    let from_camera = Vector3::new(
        observation.ground.x_m - pose.x_m,
        observation.ground.y_m - pose.y_m,
        observation.elevation.mean_m - pose.height_m,
    );
    let p = axes.camera_from_world * from_camera;
    if p.z <= 1e-9 {
        return None;
    }
    let part = 1.0 / p.z;
    let ray = crate::geometry::Ray::new(p.x * part, p.y * part);
    let (pixel, pixel_by_ray) = camera.pixel_and_derivative(ray)?;
    // One row a coordinate of the pixel. The point moves against the camera; a turn of the camera about a world axis a moves it by
    // −R (a × d), so that a coordinate whose derivative by the point is g, in world axes, changes by −a · (d × g).
    let row = |i: usize| {
        let (by_x, by_y) = (pixel_by_ray[(i, 0)] * part, pixel_by_ray[(i, 1)] * part);
        let by_point = Vector3::new(by_x, by_y, -(by_x * ray.x + by_y * ray.y));
        let in_world = axes.camera_from_world.tr_mul(&by_point);
        let turned = from_camera.cross(&in_world);
        [-in_world.x, -in_world.y, -turned.z, -in_world.z, -axes.roll.dot(&turned), -axes.pitch.dot(&turned)]
    };
    let [[xx, yx], [xy, yy]] = observation.whitening.data.0; // by columns
    let whitened = |x: f64, y: f64| [xx * x + xy * y, yx * x + yy * y];
    let (first, second) = (row(0), row(1));
    let mut by_pose = [[0.0; 6]; 2];
    for i in 0..6 {
        [by_pose[0][i], by_pose[1][i]] = whitened(first[i], second[i]);
    }
    let (x, y) = (pixel.x - observation.pixel.x, pixel.y - observation.pixel.y);
    let distance_px = (x * x + y * y).sqrt();
    Some(Residual { error: whitened(x, y), distance_px, by_pose, ..Residual::NONE })
}

/// The rotation of a pose and the world axes about which its angles turn; heading turns about z.
#[derive(Debug, Clone, Copy)]
pub struct Axes {
    camera_from_world: Matrix3<f64>,
    /// About which roll turns.
    pub roll: Vector3<f64>,
    /// About which pitch turns.
    pub pitch: Vector3<f64>,
}

impl Axes {
    /// Those of a pose.
    pub fn new(pose: &GroundPose) -> Self {
        let axes = pose.rotation_axes();
        Self {
            camera_from_world: pose.world_from_camera_rotation().transpose(),
            roll: axes.column(1).into_owned(),
            pitch: axes.column(2).into_owned(),
        }
    }
}

/// The pose after a Gauss–Newton step; `None` where the camera would not face the ground.
fn moved(pose: &GroundPose, step: &Row) -> Option<GroundPose> {
    let next = GroundPose {
        x_m: pose.x_m - step[0],
        y_m: pose.y_m - step[1],
        heading_rad: pose.heading_rad - step[2],
        height_m: pose.height_m - step[3],
        roll_rad: pose.roll_rad - step[4],
        pitch_rad: pose.pitch_rad - step[5],
    };
    let sound = next.height_m > 0.0
        && next.roll_rad.abs() < 1.4
        && next.pitch_rad.abs() < 1.4
        && next.x_m.is_finite();
    sound.then_some(next)
}

/// One step of Gauss–Newton on a minimal sample of at most four observations. `None` where they do not determine the unknowns.
pub fn gauss_newton_step(
    camera: &Camera,
    observations: &[Observation],
    pose: &GroundPose,
    unknowns: &Unknowns,
) -> Option<GroundPose> {
    let axes = Axes::new(pose);
    let mut equations = NormalEquations::new(POSE);
    for observation in observations {
        let Some(residual) = residual(camera, observation, pose, &axes) else { continue };
        for (error, by_pose) in residual.error.iter().zip(&residual.by_pose) {
            let mut row = [0.0; WITH_SKEW];
            row[..POSE].copy_from_slice(by_pose);
            equations.add(&row, *error, 1.0);
        }
    }
    (unknowns.count..POSE).for_each(|i| equations.hold(i));
    moved(pose, &equations.factor()?.solve(equations.slope()))
}

/// Unknowns beside the pose of a frame: height and tilt of the keyframe that defines the ground
/// points, and the skew of a rolling shutter.
struct Beside<'a> {
    observations: Observations<'a>,
    laid_from: Axes,
    /// Root of the covariance of the keyframe's height, roll and pitch: zero where they are known.
    keyframe_root: Matrix3<f64>,
    skew_sigma: PoseRates,
    /// How many unknowns the fit has.
    count: usize,
    /// What is found of those beside the pose, whitened.
    values: [f64; WITH_SKEW - POSE],
}

/// The highest elevation of a kerb, a part of the height above the ground.
pub const HIGHEST_KERB: f64 = 0.15;

/// What moves no point of the image by more than this need not be solved for, pixels.
const NOTHING_PX: f64 = 0.01;

impl<'a> Beside<'a> {
    fn new(camera: &Camera, observations: Observations<'a>) -> Self {
        let Observations { laid_from, laid_covariance, shutter, .. } = observations;
        let reach = Vector3::new(1.0 / laid_from.height_m, 1.0, 1.0) * camera.focal_px().0;
        let is_known = (0..3).all(|i| laid_covariance[(i, i)].sqrt() * reach[i] < NOTHING_PX);
        let keyframe_root = if is_known { Matrix3::zeros() } else { root(laid_covariance) };
        let skew_sigma = shutter
            .map_or(PoseRates::zeros(), |(prior, assumed)| prior.skew_sigma(&assumed).map(|s| s.max(1e-12)));
        let count = match shutter {
            Some((prior, _)) if prior.applies => WITH_SKEW,
            _ if is_known => POSE,
            _ => WITH_KEYFRAME,
        };
        let values = [0.0; WITH_SKEW - POSE];
        Self { observations, laid_from: Axes::new(laid_from), keyframe_root, skew_sigma, count, values }
    }

    /// Adds to a residual what the values beside the pose make of it.
    fn complete(&self, observation: &Observation, residual: &mut Residual) {
        if self.count == POSE {
            return;
        }
        let [along_x, along_y] = ground_by_pose(observation, self.observations.laid_from, &self.laid_from);
        let (keyframe, skew) = self.values.split_at(WITH_KEYFRAME - POSE);
        for k in 0..2 {
            let row = &residual.by_pose[k];
            let by_rig = Vector3::from_fn(|i, _| -row[0] * along_x[3 + i] - row[1] * along_y[3 + i]);
            let by_keyframe = self.keyframe_root.tr_mul(&by_rig);
            residual.error[k] += by_keyframe.iter().zip(keyframe).map(|(by, value)| by * value).sum::<f64>();
            let by_skew = row.iter().zip(&self.skew_sigma).zip(skew);
            residual.error[k] += observation.row_fraction
                * by_skew.map(|((by, sigma), value)| by * sigma * value).sum::<f64>();
            residual.by_keyframe[k] = by_keyframe.into();
        }
        let error = nalgebra::Vector2::from(residual.error);
        residual.distance_px =
            observation.whitening.try_inverse().map_or(error, |inverse| inverse * error).norm();
    }

    /// Eliminates the elevation of the point: along its parallax the residual counts less.
    fn eliminate_elevation(&self, observation: &Observation, residual: &mut Residual, noise_px2: f64) {
        let Observation { ground, elevation, .. } = observation;
        // A point that rises keeps to the ray of the keyframe.
        let laid_from = self.observations.laid_from;
        let reach_m = laid_from.height_m - elevation.mean_m;
        let (x, y) = ((laid_from.x_m - ground.x_m) / reach_m, (laid_from.y_m - ground.y_m) / reach_m);
        let by_elevation = residual.by_pose.map(|row| -(row[0] * x + row[1] * y + row[3]));
        let parallax = Parallax::new(residual.error, by_elevation);
        residual.parallax = parallax;
        let variance_m2 = elevation.variance_m2;
        if variance_m2 <= 0.0 {
            return;
        }
        let left_px = parallax.left_px(variance_m2, noise_px2);
        residual.distance_px *= left_px / residual.length().max(1e-12);
        let whiten = parallax.whitener(variance_m2, noise_px2);
        let [first, second] = &mut residual.error;
        whiten(first, second);
        let [first, second] = &mut residual.by_pose;
        first.iter_mut().zip(second).for_each(|(first, second)| whiten(first, second));
        let [first, second] = &mut residual.by_keyframe;
        first.iter_mut().zip(second).for_each(|(first, second)| whiten(first, second));
    }

    /// The derivatives of a coordinate of a residual by the first `count` unknowns.
    fn row(&self, observation: &Observation, residual: &Residual, k: usize, count: usize) -> Row {
        let mut row = [0.0; WITH_SKEW];
        row[..POSE].copy_from_slice(&residual.by_pose[k]);
        row[POSE..WITH_KEYFRAME].copy_from_slice(&residual.by_keyframe[k]);
        if count == WITH_SKEW {
            for i in 0..POSE {
                row[WITH_KEYFRAME + i] = observation.row_fraction * self.skew_sigma[i] * row[i];
            }
        }
        row
    }

    /// What the tracks say of the first `count` unknowns.
    fn equations(&self, residuals: &[Residual], weights: &[f64], count: usize) -> NormalEquations {
        let mut equations = NormalEquations::new(count);
        for ((observation, residual), &weight) in self.observations.seen.iter().zip(residuals).zip(weights) {
            if weight > 0.0 {
                for (k, &error) in residual.error.iter().enumerate() {
                    equations.add(&self.row(observation, residual, k, count), error, weight);
                }
            }
        }
        equations
    }

    /// Adds what is known of the unknowns beside the pose.
    fn add_priors(&self, equations: &mut NormalEquations, scale_px: f64) {
        for i in POSE..equations.count() {
            equations.add_prior(i, self.values[i - POSE], scale_px * scale_px);
        }
    }

    fn advance(&mut self, step: &Row) {
        self.values.iter_mut().zip(&step[POSE..self.count]).for_each(|(value, step)| *value -= step);
    }

    /// Height, roll and pitch of the keyframe as the fit has them, with the covariance in units of
    /// the squared pixel noise.
    fn keyframe_error(&self, equations: &NormalEquations, scale_px: f64) -> Option<KeyframeError> {
        let root = &self.keyframe_root;
        if *root == Matrix3::zeros() || equations.count() == POSE {
            return None;
        }
        let factor = equations.factor()?;
        let columns = [0, 1, 2].map(|i| factor.column(POSE + i));
        let whitened = Matrix3::from_fn(|i, k| columns[i][POSE + k] * scale_px * scale_px);
        let mean = root * Vector3::from_fn(|i, _| self.values[i]);
        Some(KeyframeError { mean, covariance: root * whitened * root.transpose() })
    }

    /// What the tracks tell of the shutter. `equations` hold the priors, too.
    fn shutter(
        &self,
        equations: &NormalEquations,
        prior: &ShutterPrior,
        assumed: PoseRates,
        scale_px: f64,
    ) -> Option<ShutterEstimate> {
        let factor = equations.factor()?;
        // A skew that was only looked at is one step away.
        let (inverse, step) = (factor.inverse(), factor.solve(equations.slope()));
        let (squared, sigma) = (scale_px * scale_px, &self.skew_sigma);
        let expected = prior.readout.mean_s * assumed;
        let (mut skew, mut skew_variance) = (expected, PoseRates::zeros());
        let (mut evidence, mut evidence_variance) = (expected, PoseRates::repeat(f64::INFINITY));
        for i in 0..6 {
            let at = WITH_KEYFRAME + i;
            let difference = sigma[i] * (self.values[at - POSE] - step[at]);
            let posterior = 1.0 / inverse[at][at];
            skew[i] += difference;
            skew_variance[i] = sigma[i] * sigma[i] * squared / posterior;
            // Less than a thousandth of the prior's is rounding.
            let alone = posterior - squared;
            if alone > 1e-3 * posterior {
                evidence[i] += difference * posterior / alone;
                evidence_variance[i] = sigma[i] * sigma[i] * squared / alone;
            }
        }
        let mut without = *equations;
        (WITH_KEYFRAME..WITH_SKEW).for_each(|i| without.hold(i));
        let without = without.factor()?;
        let mut pose_by_expected_skew = Matrix6::zeros();
        for i in 0..6 {
            let at = WITH_KEYFRAME + i;
            // A prior that is off pulls the skew, and the skew the pose; a skew left out does so in
            // full.
            let column = if prior.applies {
                inverse[at].map(|entry| entry * squared)
            } else {
                without.solve(&std::array::from_fn(|k| {
                    if k < WITH_KEYFRAME { -equations.entry(k, at) } else { 0.0 }
                }))
            };
            (0..6).for_each(|k| pose_by_expected_skew[(k, i)] = column[k] / sigma[i]);
        }
        Some(ShutterEstimate {
            expected_rates: assumed,
            skew,
            skew_variance,
            evidence,
            evidence_variance,
            pose_by_expected_skew,
            pose_by_keyframe_skew: Matrix6::zeros(),
        })
    }

    /// How the slope of the fit changes with the pose from which the ground points were laid, of
    /// which each moves by a share: a column for each number of that pose.
    fn slopes_by_keyframe(
        &self,
        residuals: &[Residual],
        weights: &[f64],
        count: usize,
        share: impl Fn(&Observation) -> f64,
    ) -> [Row; POSE] {
        let mut slopes = [[0.0; WITH_SKEW]; POSE];
        let Observations { seen, laid_from, .. } = self.observations;
        for ((observation, residual), &weight) in seen.iter().zip(residuals).zip(weights) {
            if weight <= 0.0 {
                continue;
            }
            let [along_x, along_y] = ground_by_pose(observation, laid_from, &self.laid_from);
            let weight = weight * share(observation);
            for k in 0..2 {
                let row = self.row(observation, residual, k, count);
                // The point moves as the camera would move the other way.
                let change: [f64; 6] = std::array::from_fn(|n| row[0] * along_x[n] + row[1] * along_y[n]);
                for (slope, change) in slopes.iter_mut().zip(change) {
                    let weighted = weight * change;
                    slope.iter_mut().zip(&row).take(count).for_each(|(sum, by)| *sum += weighted * by);
                }
            }
        }
        slopes
    }
}

/// A lower triangular root of a covariance that may have zeros on its diagonal.
fn root(covariance: &Matrix3<f64>) -> Matrix3<f64> {
    let mut root = Matrix3::zeros();
    for i in 0..3 {
        for k in 0..=i {
            let left = covariance[(i, k)] - (0..k).map(|m| root[(i, m)] * root[(k, m)]).sum::<f64>();
            root[(i, k)] = match i == k {
                true => left.max(0.0).sqrt(),
                false if root[(k, k)] > 0.0 => left / root[(k, k)],
                false => 0.0,
            };
        }
    }
    root
}

/// The best pose near `start` on the observations that agree with it, and its covariance.
///
/// Tukey's biweight with its scale from the median residual (P. Huber, "Robust statistics"; c = 4.685) makes the few wrong
/// tracks that RANSAC let through harmless and leaves 95 % of the efficiency of least squares.
pub fn refine(
    camera: &Camera,
    observations: Observations<'_>,
    start: &GroundPose,
    agreeing: &[bool],
    prediction: &GroundPose,
    prior: &RigPrior,
    config: &MotionConfig,
) -> Option<MotionEstimate> {
    let mut beside = Beside::new(camera, observations);
    let Observations { seen: observations, shutter, .. } = observations;
    let unknowns = Unknowns::new(config.model);
    let mut prior = *prior;
    let mut pose = GroundPose {
        // Whole turns are kept: RANSAC's heading is in (−π, π].
        heading_rad: prediction.heading_rad + wrap_angle(start.heading_rad - prediction.heading_rad),
        ..*start
    };
    let mut weights: Buffer<f64> = agreeing.iter().map(|&agrees| f64::from(u8::from(agrees))).collect();
    let mut scale_px = config.inlier_px;
    let mut residuals = Buffer::of(Residual::NONE, observations.len());
    let mut errors = Buffer::of(0.0, observations.len());
    let mut sorted = Buffer::new();
    // Each pose is looked at once: what is left of the observations there weighs them and leads to the next.
    let mut look = |pose: &GroundPose,
                    beside: &Beside<'_>,
                    noise_px: f64,
                    residuals: &mut [Residual],
                    errors: &mut [f64]|
     -> f64 {
        let axes = Axes::new(pose);
        for ((observation, kept), error) in observations.iter().zip(residuals).zip(&mut *errors) {
            *error = match residual(camera, observation, pose, &axes) {
                Some(mut residual) => {
                    beside.complete(observation, &mut residual);
                    beside.eliminate_elevation(observation, &mut residual, noise_px * noise_px);
                    *kept = residual;
                    residual.length()
                }
                None => {
                    *kept = Residual::NONE;
                    f64::INFINITY
                }
            };
        }
        robust_scale(errors, config.inlier_px, &mut sorted)
    };
    look(&pose, &beside, USUAL_NOISE * config.inlier_px, &mut residuals, &mut errors);
    let mut reach_px = config.inlier_px;
    let mut equations = NormalEquations::new(beside.count);
    let mut rig_evidence = None;
    for round in 0..ROUNDS {
        let tracks = beside.equations(&residuals, &weights, beside.count);
        equations = tracks;
        Pull::new(&prior, scale_px).add_to(&mut equations, &pose);
        beside.add_priors(&mut equations, scale_px);
        (unknowns.count..POSE).for_each(|i| equations.hold(i));
        let step = equations.factor()?.solve(equations.slope());
        let before = pose;
        pose = moved(&pose, &step)?;
        beside.advance(&step);
        let pull = Pull::new(&prior, scale_px);
        let noise_px = if round == 0 { USUAL_NOISE * config.inlier_px } else { scale_px };
        scale_px = look(&pose, &beside, noise_px, &mut residuals, &mut errors);
        reach_px = (4.685 * scale_px).min(config.inlier_px.max(2.0 * scale_px));
        let per_reach = 1.0 / reach_px;
        weights.iter_mut().zip(&errors).for_each(|(weight, &error)| *weight = biweight(error * per_reach));
        let moved = (pose.x_m - before.x_m).hypot(pose.y_m - before.y_m) / pose.height_m
            + (pose.heading_rad - before.heading_rad).abs();
        if round >= 2 && config.model == MotionModel::Auto {
            let mut tracks_alone = tracks;
            beside.add_priors(&mut tracks_alone, scale_px);
            (POSE..beside.count.min(WITH_KEYFRAME)).for_each(|i| tracks_alone.hold(i));
            let tracks_alone = tracks_alone.factor()?;
            let held_px = scale_where_held(camera, &pose, &equations, &weights, scale_px);
            let shared_px = shared_px(scale_px, prior.shared_part * held_px);
            let evidence = evidence(camera, &tracks_alone, &pose, &pull, scale_px, shared_px);
            if widen(&mut prior, &evidence) {
                continue;
            }
            rig_evidence = Some((evidence, tracks_alone));
        }
        // Of the height; less than a ten-thousandth of a pixel, and what is left is less.
        if round >= 3 && moved < 1e-7 {
            break;
        }
    }
    let count = weights.iter().filter(|&&weight| weight > 0.0).count();
    if count <= unknowns.count {
        return None;
    }
    let squares: f64 = errors
        .iter()
        .zip(&weights)
        .filter(|(_, weight)| **weight > 0.0)
        .map(|(error, _)| error * error)
        .sum();
    let spare = 2 * count - unknowns.count;
    let pull = Pull::new(&prior, scale_px);
    let keyframe_error = beside.keyframe_error(&equations, scale_px);
    // The pose given the keyframe.
    (POSE..beside.count.min(WITH_KEYFRAME)).for_each(|i| equations.hold(i));
    let given = equations.factor()?;
    let slopes = beside.slopes_by_keyframe(&residuals, &weights, beside.count, |_| 1.0);
    let shutter = match shutter {
        Some((prior, assumed)) => {
            let mut with_skew = beside.equations(&residuals, &weights, WITH_SKEW);
            pull.add_to(&mut with_skew, &pose);
            beside.add_priors(&mut with_skew, scale_px);
            (unknowns.count..POSE).for_each(|i| with_skew.hold(i));
            let by_skew = beside.slopes_by_keyframe(&residuals, &weights, beside.count, |observation| {
                observation.keyframe_row_fraction
            });
            let estimate = beside.shutter(&with_skew, prior, assumed, scale_px)?;
            let pose_by_keyframe_skew = solutions(&given, &by_skew, &unknowns);
            Some(ShutterEstimate { pose_by_keyframe_skew, ..estimate })
        }
        None => None,
    };
    // To agree is to be near, not only to be uncertain: of what is unlike the ground all is uncertain.
    let near = |(residual, &weight): (&Residual, &f64)| weight > 0.0 && residual.distance_px < reach_px;
    let inliers: Buffer<bool> = residuals.iter().zip(&weights).map(near).collect();
    let elevations = elevations(observations, &residuals, pose.height_m);
    let own = Fit {
        residuals: &residuals,
        weights: &weights,
        errors: &errors,
        reach_px,
        scale_px,
        beside: &beside,
    }
    .covariance(&equations, &pull, &unknowns)?
        * (2 * count) as f64
        / spare as f64;
    let held_px = scale_where_held(camera, &pose, &equations, &weights, scale_px);
    let shared_px = shared_px(scale_px, prior.shared_part * held_px);
    let rig_evidence = rig_evidence.map(|(evidence, tracks_alone)| {
        let by_keyframe = solutions(&tracks_alone, &slopes, &unknowns);
        RigEvidence {
            value: evidence.map(|(value, _)| value),
            variance: evidence.map(|(_, variance)| variance),
            by_keyframe: by_keyframe.fixed_view::<3, 3>(3, 3).into_owned(),
        }
    });
    Some(MotionEstimate {
        pose,
        covariance: own + shared_errors(camera, &pose, &unknowns, shared_px),
        by_keyframe: solutions(&given, &slopes, &unknowns),
        keyframe_error,
        inliers,
        residual_px: (squares / count as f64).sqrt(),
        neighbours: Neighbours::of(camera, observations, &residuals, &weights),
        rig_evidence,
        elevations,
        needs_relief: false,
        shutter,
    })
}

/// The elevations of the observed points given the pose.
fn elevations(
    observations: &[Observation],
    residuals: &[Residual],
    height_m: f64,
) -> Buffer<MeasuredElevation> {
    // Across its parallax a residual is noise, whatever the elevation.
    let mut across: Buffer<f64> =
        residuals.iter().map(|residual| residual.parallax.across_squared()).collect();
    let middle = across.len() / 2;
    let median = across.select_nth_unstable_by(middle, f64::total_cmp).1;
    let noise_px2 = (*median / MEDIAN_OF_SQUARE).max(SMALLEST_SCALE_PX * SMALLEST_SCALE_PX);
    let measured = |(observation, residual): (&Observation, &Residual)| {
        residual.parallax.measured(observation.elevation, noise_px2, HIGHEST_KERB * height_m)
    };
    observations.iter().zip(residuals).map(measured).collect()
}

/// The median of the square of a normally distributed number over its variance.
const MEDIAN_OF_SQUARE: f64 = 0.455;

/// Noise of usual tracks before the residuals tell, as a part of the distance of inliers.
const USUAL_NOISE: f64 = 0.05;

/// The changes of the pose that belong to changes of the slope.
fn solutions(factor: &Factor, slopes: &[Row; POSE], unknowns: &Unknowns) -> Matrix6<f64> {
    let mut solutions = Matrix6::zeros();
    for (i, slope) in slopes.iter().enumerate() {
        let mut slope = *slope;
        slope[unknowns.count..POSE].fill(0.0);
        slope[POSE..WITH_KEYFRAME].fill(0.0);
        let solution = factor.solve(&slope);
        (0..POSE).for_each(|k| solutions[(k, i)] = solution[k]);
    }
    solutions
}

/// The error of a track in the directions in which it is held, pixels: along the joints between tiles tracks are off by far more, and hold nothing there.
fn scale_where_held(
    camera: &Camera,
    pose: &GroundPose,
    information: &NormalEquations,
    weights: &[f64],
    scale_px: f64,
) -> f64 {
    let pixels_per_m = camera.focal_px().0 / pose.height_m;
    let all_alike = pixels_per_m * pixels_per_m * weights.iter().sum::<f64>();
    scale_px * (2.0 * all_alike / (information.entry(0, 0) + information.entry(1, 1))).sqrt()
}

/// How x and y of the ground point that a ray meets, metres, change with the six numbers of the pose
/// of the camera whose ray it is.
pub fn ground_by_pose(observation: &Observation, laid_from: &GroundPose, axes: &Axes) -> [[f64; 6]; 2] {
    let Observation { ground, elevation, .. } = observation;
    ray_by_pose(ground, elevation.mean_m, laid_from, axes)
}

/// The same of a ray that meets the ground at an elevation, metres.
pub fn ray_by_pose(
    ground: &GroundPoint,
    elevation_m: f64,
    laid_from: &GroundPose,
    axes: &Axes,
) -> [[f64; 6]; 2] {
    let height_m = laid_from.height_m - elevation_m;
    let (x, y) = (ground.x_m - laid_from.x_m, ground.y_m - laid_from.y_m);
    // A turn about an axis swings the ray, which then meets the ground elsewhere.
    let swung = |axis: &Vector3<f64>| {
        let by = axis.cross(&Vector3::new(x, y, -height_m));
        [by.x + x * by.z / height_m, by.y + y * by.z / height_m]
    };
    let (roll, pitch) = (swung(&axes.roll), swung(&axes.pitch));
    [[1.0, 0.0, -y, x / height_m, roll[0], pitch[0]], [0.0, 1.0, x, y / height_m, roll[1], pitch[1]]]
}

/// Height, roll and pitch without the prior's pull, and their variances. At the end of the iteration the tracks pull with the same force as the
/// prior, the other way: from there it is one step to where they alone would be.
fn evidence(
    camera: &Camera,
    tracks_alone: &Factor,
    pose: &GroundPose,
    pull: &Pull,
    scale_px: f64,
    shared_px: f64,
) -> [(f64, f64); 3] {
    let here = [pose.height_m, pose.roll_rad, pose.pitch_rad];
    let force = [0, 1, 2].map(|i| pull.weight[i] * (here[i] - pull.mean[i]));
    let shared = shared_errors_of_rig(camera, pose, shared_px);
    [0, 1, 2].map(|i| {
        let covariance = tracks_alone.column(3 + i);
        let step: f64 = (0..3).map(|k| covariance[3 + k] * force[k]).sum();
        (here[i] + step, covariance[3 + i] * scale_px * scale_px + shared[i])
    })
}

/// Opens the prior where the evidence lies more than four of its standard deviations off: a kerb, a push, a hand that lifts the camera. Says whether
/// it did.
fn widen(prior: &mut RigPrior, evidence: &[(f64, f64); 3]) -> bool {
    let mut widened = false;
    for (i, (value, variance)) in evidence.iter().enumerate() {
        let off = (value - prior.mean[i]).abs();
        if off > 4.0 * (variance + prior.sigma[i] * prior.sigma[i]).sqrt() {
            prior.sigma[i] = off;
            widened = true;
        }
    }
    widened
}

/// The robust fit settles within this many steps or not at all.
const ROUNDS: usize = 12;

/// Pixel noise below this is not believed: tracks of neighbouring corners share their errors.
const SMALLEST_SCALE_PX: f64 = 0.01;

/// A robust fit as it ended.
struct Fit<'a> {
    residuals: &'a [Residual],
    weights: &'a [f64],
    errors: &'a [f64],
    reach_px: f64,
    scale_px: f64,
    beside: &'a Beside<'a>,
}

impl Fit<'_> {
    /// The covariance of the pose given its keyframe, from how far off the tracks really are (P.
    /// Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 1967):
    /// what is far off counts little and is not taken for the noise of all.
    fn covariance(
        &self,
        information: &NormalEquations,
        pull: &Pull,
        unknowns: &Unknowns,
    ) -> Option<Matrix6<f64>> {
        let n = information.count();
        let mut scatter = NormalEquations::new(n);
        let (mut weights, mut answers) = (0.0, 0.0);
        let tracks = self.beside.observations.seen.iter().zip(self.residuals).zip(self.weights);
        for (((observation, residual), &weight), &length) in tracks.zip(self.errors) {
            if weight <= 0.0 {
                continue;
            }
            let [x, y] = [0, 1].map(|k| self.beside.row(observation, residual, k, n));
            let force = std::array::from_fn(|i| residual.error[0] * x[i] + residual.error[1] * y[i]);
            scatter.add(&force, 0.0, weight * weight);
            // How the weighted residual grows with the residual, the mean of all directions.
            let part = (length / self.reach_px).powi(2);
            weights += weight;
            answers += (1.0 - part) * (1.0 - 3.0 * part);
        }
        let answer = (answers / weights).max(LEAST_ANSWER);
        // Priors are as they are said to be, and no more robust than that.
        let mut information = *information;
        information.scale(answer);
        let squared = self.scale_px * self.scale_px;
        let of_rig = (0..3).map(|i| (3 + i, pull.weight[i]));
        for (i, weight) in of_rig.chain((WITH_KEYFRAME..n).map(|i| (i, squared))) {
            scatter.add_prior(i, 0.0, weight * squared);
            information.add_prior(i, 0.0, (1.0 - answer) * weight);
        }
        let held = (unknowns.count..POSE).chain(POSE..n.min(WITH_KEYFRAME));
        held.for_each(|i| {
            scatter.hold(i);
            information.hold(i);
        });
        let inverse = information.factor()?.inverse();
        let solved = unknowns.count;
        let mut half = [[0.0; WITH_SKEW]; POSE];
        for (i, half) in half.iter_mut().enumerate().take(solved) {
            for (k, half) in half.iter_mut().enumerate().take(n) {
                *half = (0..n).map(|m| inverse[i][m] * scatter.entry(m, k)).sum();
            }
        }
        let covariance = Matrix6::from_fn(|i, k| match i < solved && k < solved {
            true => (0..n).map(|m| half[i][m] * inverse[m][k]).sum(),
            false => 0.0,
        });
        // Rounding leaves it not quite symmetric.
        Some(0.5 * (covariance + covariance.transpose()))
    }
}

/// The least part of its weight with which a track answers: where most are far off, this is not told any more.
const LEAST_ANSWER: f64 = 0.4;

/// Standard deviation of one coordinate from the median distance of the observations that could be inliers (Rayleigh: median = 1.1774 σ).
fn robust_scale(errors: &[f64], inlier_px: f64, within: &mut Vec<f64>) -> f64 {
    within.clear();
    within.extend(errors.iter().copied().filter(|&e| e < 2.0 * inlier_px));
    if within.is_empty() {
        return inlier_px;
    }
    let middle = within.len() / 2;
    let (_, median, _) = within.select_nth_unstable_by(middle, f64::total_cmp);
    (*median / 1.1774).clamp(SMALLEST_SCALE_PX, inlier_px)
}

/// Tukey's biweight of a residual in units of its reach.
fn biweight(ratio: f64) -> f64 {
    if ratio < 1.0 { (1.0 - ratio * ratio).powi(2) } else { 0.0 }
}
