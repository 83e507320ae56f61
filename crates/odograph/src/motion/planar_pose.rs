//! The pose that re-projects ground points onto their tracks: robust Gauss–Newton in pixels.

use super::nuisance::{Elimination, ShutterFit};
use super::sharing::{Neighbours, shared_errors, shared_errors_of_rig, shared_px};
use super::{
    MotionConfig, MotionEstimate, MotionModel, Observation, Observations, RigEvidence, RigPrior,
    ShutterEstimate,
};
use crate::buffer::{Buffer, stored};
use crate::camera::Camera;
use crate::geometry::{GroundPoint, GroundPose, wrap_angle};
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

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

    /// The matrix with the rows and columns of what is not solved for replaced by those of the identity.
    fn of(&self, matrix: &Matrix6<f64>) -> Matrix6<f64> {
        let solved = |i: usize, j: usize| i < self.count && j < self.count;
        Matrix6::from_fn(|i, j| if solved(i, j) { matrix[(i, j)] } else { f64::from(u8::from(i == j)) })
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
}

/// Where an observation's ground point is seen from a pose, less where it was seen, whitened (pixels of a usual track), and the derivative of
/// that by the six numbers of the pose.
#[derive(Debug, Clone, Copy)]
pub(super) struct Residual {
    pub error: [f64; 2],
    /// The distance before whitening, pixels.
    pub distance_px: f64,
    pub by_pose: [[f64; 6]; 2],
}

stored!(Residual);

impl Residual {
    /// Of a point that is not seen: no length, and nothing that it could change.
    pub const NONE: Self = Self { error: [0.0; 2], distance_px: f64::INFINITY, by_pose: [[0.0; 6]; 2] };

    fn length(&self) -> f64 {
        (self.error[0] * self.error[0] + self.error[1] * self.error[1]).sqrt()
    }
}

/// `None` where the point is not in front of the lens.
#[inline]
fn residual(camera: &Camera, observation: &Observation, pose: &GroundPose, axes: &Axes) -> Option<Residual> {
    let from_camera =
        Vector3::new(observation.ground.x_m - pose.x_m, observation.ground.y_m - pose.y_m, -pose.height_m);
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
    Some(Residual { error: whitened(x, y), distance_px: (x * x + y * y).sqrt(), by_pose })
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
        let (sin_heading, cos_heading) = pose.heading_rad.sin_cos();
        let (sin_pitch, cos_pitch) = pose.pitch_rad.sin_cos();
        Self {
            camera_from_world: pose.world_from_camera_rotation().transpose(),
            pitch: Vector3::new(-sin_heading, cos_heading, 0.0),
            roll: Vector3::new(cos_heading * cos_pitch, sin_heading * cos_pitch, -sin_pitch),
        }
    }
}

/// What a step of Gauss–Newton gives.
pub struct Step {
    /// The improved pose.
    pub pose: GroundPose,
    /// Information matrix of the unknowns, in units of one over the squared pixel noise.
    information: Matrix6<f64>,
    /// The same without the prior.
    tracks_alone: Matrix6<f64>,
}

/// One step of Gauss–Newton on a minimal sample of at most four observations. `None` where they do not determine the unknowns.
pub fn gauss_newton_step(
    camera: &Camera,
    observations: &[Observation],
    pose: &GroundPose,
    unknowns: &Unknowns,
) -> Option<GroundPose> {
    let axes = Axes::new(pose);
    let residuals: [Option<Residual>; 4] =
        std::array::from_fn(|i| observations.get(i).and_then(|seen| residual(camera, seen, pose, &axes)));
    let residuals = residuals.each_ref().map(|residual| residual.unwrap_or(Residual::NONE));
    step(&residuals, &[1.0; 4], pose, unknowns, None, None).map(|step| step.pose)
}

/// One step of Gauss–Newton from residuals with their weights. `None` where they do not determine the unknowns.
fn step(
    residuals: &[Residual],
    weights: &[f64],
    pose: &GroundPose,
    unknowns: &Unknowns,
    pull: Option<&Pull>,
    eliminated: Option<&Elimination>,
) -> Option<Step> {
    // The upper triangle, row by row.
    let mut sums = [[0.0; 6]; 6];
    let mut slope = [0.0; 6];
    for (Residual { error, by_pose, .. }, &weight) in residuals.iter().zip(weights) {
        if weight <= 0.0 {
            continue;
        }
        for (error, row) in error.iter().zip(by_pose) {
            let weighted = row.map(|entry| weight * entry);
            for i in 0..6 {
                for j in i..6 {
                    sums[i][j] += weighted[i] * row[j];
                }
                slope[i] += weighted[i] * error;
            }
        }
    }
    let mut tracks_alone = Matrix6::from_fn(|i, j| sums[i.min(j)][i.max(j)]);
    if let Some(eliminated) = eliminated {
        tracks_alone += eliminated.information;
        slope.iter_mut().zip(&eliminated.slope).for_each(|(slope, more)| *slope += more);
    }
    let mut information = tracks_alone;
    if let Some(prior) = pull {
        let here = [pose.height_m, pose.roll_rad, pose.pitch_rad];
        for i in 0..3 {
            information[(3 + i, 3 + i)] += prior.weight[i];
            slope[3 + i] += prior.weight[i] * (here[i] - prior.mean[i]);
        }
    }
    let slope = Vector6::from_fn(|i, _| if i < unknowns.count { slope[i] } else { 0.0 });
    let step = unknowns.of(&information).cholesky()?.solve(&slope);
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
    sound.then_some(Step { pose: next, information, tracks_alone })
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
    let Observations { seen: observations, laid_from, shutter } = observations;
    let expected = shutter.map(|(prior, assumed)| ShutterFit::new(prior, assumed));
    let mut shutter = expected.clone().filter(|_| shutter.is_some_and(|(prior, _)| prior.applies));
    let unknowns = Unknowns::new(config.model);
    let mut prior = *prior;
    let mut pose = GroundPose {
        // Whole turns are kept: RANSAC's heading is in (−π, π].
        heading_rad: prediction.heading_rad + wrap_angle(start.heading_rad - prediction.heading_rad),
        ..*start
    };
    let mut weights: Buffer<f64> = agreeing.iter().map(|&agrees| f64::from(u8::from(agrees))).collect();
    let mut scale_px = config.inlier_px;
    let mut information = Matrix6::identity();
    let mut rig_evidence = None;
    let mut residuals = Buffer::of(Residual::NONE, observations.len());
    let mut errors = Buffer::of(0.0, observations.len());
    let mut sorted = Buffer::new();
    // Each pose is looked at once: what is left of the observations there weighs them and leads to the next.
    let mut look = |pose: &GroundPose,
                    shutter: Option<&ShutterFit<'_>>,
                    residuals: &mut [Residual],
                    errors: &mut [f64]|
     -> f64 {
        let axes = Axes::new(pose);
        for ((observation, kept), error) in observations.iter().zip(residuals).zip(&mut *errors) {
            *error = match residual(camera, observation, pose, &axes) {
                Some(mut residual) => {
                    if let Some(shutter) = shutter {
                        shutter.correct(observation, &mut residual);
                    }
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
    look(&pose, shutter.as_ref(), &mut residuals, &mut errors);
    let mut reach_px = config.inlier_px;
    for round in 0..ROUNDS {
        let pull = Pull::new(&prior, scale_px);
        let before = pose;
        let eliminated = match &shutter {
            Some(shutter) => Some(shutter.eliminate(observations, &mut residuals, &weights, scale_px)?),
            None => None,
        };
        let step = step(&residuals, &weights, &pose, &unknowns, Some(&pull), eliminated.as_ref())?;
        (pose, information) = (step.pose, step.information);
        if let (Some(shutter), Some(eliminated)) = (&mut shutter, &eliminated) {
            shutter.advance(eliminated, &before, &pose);
        }
        scale_px = look(&pose, shutter.as_ref(), &mut residuals, &mut errors);
        reach_px = (4.685 * scale_px).min(config.inlier_px.max(2.0 * scale_px));
        let per_reach = 1.0 / reach_px;
        weights.iter_mut().zip(&errors).for_each(|(weight, &error)| *weight = biweight(error * per_reach));
        let moved = (pose.x_m - before.x_m).hypot(pose.y_m - before.y_m) / pose.height_m
            + (pose.heading_rad - before.heading_rad).abs();
        if round >= 2 && config.model == MotionModel::Auto {
            let held_px = scale_where_held(camera, &pose, &information, &weights, scale_px);
            let shared_px = shared_px(scale_px, prior.shared_part * held_px);
            let evidence = evidence(camera, &step.tracks_alone, &pose, &pull, scale_px, shared_px)?;
            if widen(&mut prior, &evidence) {
                continue;
            }
            rig_evidence = Some((evidence, step.tracks_alone));
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
    let aside = shutter.is_none();
    let shutter = match shutter.as_ref().or(expected.as_ref()) {
        Some(shutter) => {
            // A skew that is only looked at leaves the rows of the pose as they are.
            let kept = aside.then(|| -> Buffer<Residual> { residuals.iter().copied().collect() });
            let eliminated = shutter.eliminate(observations, &mut residuals, &weights, scale_px)?;
            let pose_covariance = unknowns.of(&information).cholesky()?.inverse();
            let estimate = match kept {
                Some(kept) => {
                    residuals = kept;
                    shutter.clone().estimate_aside(&eliminated, &pose_covariance, scale_px)
                }
                None => shutter.estimate(&eliminated, &pose_covariance, scale_px),
            };
            let by_keyframe_skew = pose_covariance
                * slopes_by_keyframe(
                    observations,
                    &residuals,
                    &weights,
                    laid_from,
                    &unknowns,
                    |observation| observation.keyframe_row_fraction,
                );
            Some(ShutterEstimate { pose_by_keyframe_skew: by_keyframe_skew, ..estimate })
        }
        None => None,
    };
    // To agree is to be near, not only to be uncertain: of what is unlike the ground all is uncertain.
    let near = |(residual, &weight): (&Residual, &f64)| weight > 0.0 && residual.distance_px < reach_px;
    let inliers: Buffer<bool> = residuals.iter().zip(&weights).map(near).collect();
    let pull = Pull::new(&prior, scale_px);
    let own = Fit { residuals: &residuals, weights: &weights, errors: &errors, reach_px, scale_px }
        .covariance(&information, &pull, &unknowns)?
        * (2 * count) as f64
        / spare as f64;
    let held_px = scale_where_held(camera, &pose, &information, &weights, scale_px);
    let shared_px = shared_px(scale_px, prior.shared_part * held_px);
    let slopes = slopes_by_keyframe(observations, &residuals, &weights, laid_from, &unknowns, |_| 1.0);
    let rig_evidence = rig_evidence.and_then(|(evidence, tracks_alone)| {
        let by_keyframe = tracks_alone.cholesky()?.solve(&slopes);
        Some(RigEvidence {
            value: evidence.map(|(value, _)| value),
            variance: evidence.map(|(_, variance)| variance),
            by_keyframe: by_keyframe.fixed_view::<3, 3>(3, 3).into_owned(),
        })
    });
    Some(MotionEstimate {
        pose,
        covariance: own + shared_errors(camera, &pose, &unknowns, shared_px),
        by_keyframe: unknowns.of(&information).cholesky()?.solve(&slopes),
        inliers,
        residual_px: (squares / count as f64).sqrt(),
        neighbours: Neighbours::of(camera, observations, &residuals, &weights),
        rig_evidence,
        shutter,
    })
}

/// The error of a track in the directions in which it is held, pixels: along the joints between tiles tracks are off by far more, and hold nothing there.
fn scale_where_held(
    camera: &Camera,
    pose: &GroundPose,
    information: &Matrix6<f64>,
    weights: &[f64],
    scale_px: f64,
) -> f64 {
    let pixels_per_m = camera.focal_px().0 / pose.height_m;
    let all_alike = pixels_per_m * pixels_per_m * weights.iter().sum::<f64>();
    scale_px * (2.0 * all_alike / (information[(0, 0)] + information[(1, 1)])).sqrt()
}

/// How the slope of the fit changes with the pose from which the ground points were laid, of which each moves
/// by a share.
fn slopes_by_keyframe(
    observations: &[Observation],
    residuals: &[Residual],
    weights: &[f64],
    laid_from: &GroundPose,
    unknowns: &Unknowns,
    share: impl Fn(&Observation) -> f64,
) -> Matrix6<f64> {
    let axes = Axes::new(laid_from);
    let mut slopes = [[0.0; 6]; 6];
    for ((observation, Residual { by_pose, .. }), &weight) in observations.iter().zip(residuals).zip(weights)
    {
        if weight <= 0.0 {
            continue;
        }
        let [along_x, along_y] = ground_by_pose(&observation.ground, laid_from, &axes);
        let weight = weight * share(observation);
        for row in by_pose {
            // The point moves as the camera would move the other way.
            let change: [f64; 6] = std::array::from_fn(|k| row[0] * along_x[k] + row[1] * along_y[k]);
            for i in 0..6 {
                for k in 0..6 {
                    slopes[i][k] += weight * row[i] * change[k];
                }
            }
        }
    }
    Matrix6::from_fn(|i, k| if i < unknowns.count { slopes[i][k] } else { 0.0 })
}

/// How x and y of the ground point that a ray meets, metres, change with the six numbers of the pose
/// of the camera whose ray it is.
pub fn ground_by_pose(ground: &GroundPoint, laid_from: &GroundPose, axes: &Axes) -> [[f64; 6]; 2] {
    let height_m = laid_from.height_m;
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
    tracks_alone: &Matrix6<f64>,
    pose: &GroundPose,
    pull: &Pull,
    scale_px: f64,
    shared_px: f64,
) -> Option<[(f64, f64); 3]> {
    let covariance = tracks_alone.cholesky()?.inverse();
    let here = [pose.height_m, pose.roll_rad, pose.pitch_rad];
    let mut force = Vector6::zeros();
    for i in 0..3 {
        force[3 + i] = pull.weight[i] * (here[i] - pull.mean[i]);
    }
    let step = covariance * force;
    let shared = shared_errors_of_rig(camera, pose, shared_px);
    Some([0, 1, 2].map(|i| {
        let at = 3 + i;
        (here[i] + step[at], covariance[(at, at)] * scale_px * scale_px + shared[i])
    }))
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
}

impl Fit<'_> {
    /// The covariance of the unknowns, from how far off the tracks really are (P. Huber, "The behavior of maximum likelihood estimates under nonstandard
    /// conditions", 1967): what is far off counts little and is not taken for the noise of all.
    fn covariance(
        &self,
        information: &Matrix6<f64>,
        pull: &Pull,
        unknowns: &Unknowns,
    ) -> Option<Matrix6<f64>> {
        let mut scatter = [[0.0; 6]; 6];
        let (mut weights, mut answers) = (0.0, 0.0);
        for ((Residual { error, by_pose, .. }, &weight), &length) in
            self.residuals.iter().zip(self.weights).zip(self.errors)
        {
            if weight <= 0.0 {
                continue;
            }
            let force: [f64; 6] =
                std::array::from_fn(|i| weight * (error[0] * by_pose[0][i] + error[1] * by_pose[1][i]));
            for i in 0..6 {
                for j in i..6 {
                    scatter[i][j] += force[i] * force[j];
                }
            }
            // How the weighted residual grows with the residual, the mean of all directions.
            let part = (length / self.reach_px).powi(2);
            weights += weight;
            answers += (1.0 - part) * (1.0 - 3.0 * part);
        }
        let answer = (answers / weights).max(LEAST_ANSWER);
        let mut scatter = Matrix6::from_fn(|i, j| scatter[i.min(j)][i.max(j)]);
        for i in 0..3 {
            let at = 3 + i;
            // The prior is as it is said to be, and no more robust than that.
            scatter[(at, at)] += pull.weight[i] * self.scale_px * self.scale_px;
        }
        let mut information = information * answer;
        for i in 0..3 {
            information[(3 + i, 3 + i)] += (1.0 - answer) * pull.weight[i];
        }
        let n = unknowns.count;
        let inverse = unknowns.of(&information).cholesky()?.inverse();
        let covariance = inverse * unknowns.of(&scatter) * inverse;
        // Rounding leaves it not quite symmetric.
        let entry = |i: usize, j: usize| 0.5 * (covariance[(i, j)] + covariance[(j, i)]);
        Some(Matrix6::from_fn(|i, j| if i < n && j < n { entry(i, j) } else { 0.0 }))
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
