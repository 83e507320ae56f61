//! Planar PnP: the pose that re-projects ground points onto their tracks, by robust Gauss–Newton in
//! pixels. Derivation: `docs/math/frame-pose.md`.

use super::correlated_noise::{ResidualCorrelation, shared_covariance, shared_px};
use super::elevation::MeasuredElevation;
use super::model_error::model_covariance;
use super::normal_equations::{NormalEquations, POSE, Row, Unknowns, WITH_KEYFRAME, WITH_SHAPE, WITH_SKEW};
use super::nuisance::Nuisance;
use super::pose_covariance::{RobustFit, by_prior_tilt, pose_changes, well_constrained_scale};
use super::residual::{Axes, Residual, residual};
use super::rig_evidence::{WeightedRigPrior, evidence, widen};
use super::{
    KeyframeError, MotionConfig, MotionEstimate, MotionModel, Observation, Observations, RigEvidence,
    RigPrior, ShutterEstimate,
};
use crate::buffer::Buffer;
use crate::camera::Camera;
use crate::geometry::{GroundPose, wrap_angle};
use crate::numerics::{Loss, RAYLEIGH_MEDIAN, TUKEY_95, median, robust_variance};

/// The pose after a Gauss–Newton step. `None` where the camera would not face the ground.
fn moved(pose: &GroundPose, step: &Row) -> Option<GroundPose> {
    let next = GroundPose {
        x_m: pose.x_m - step[0],
        y_m: pose.y_m - step[1],
        heading_rad: pose.heading_rad - step[2],
        height_m: pose.height_m - step[3],
        roll_rad: pose.roll_rad - step[4],
        pitch_rad: pose.pitch_rad - step[5],
    };
    let is_valid = next.height_m > 0.0
        && next.roll_rad.abs() < 1.4
        && next.pitch_rad.abs() < 1.4
        && next.x_m.is_finite();
    is_valid.then_some(next)
}

/// One Gauss–Newton step on a minimal sample of at most four observations. `None` where they do not
/// determine the unknowns.
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
            let mut row = [0.0; WITH_SHAPE];
            row[..POSE].copy_from_slice(by_pose);
            equations.add(&row, *error, 1.0);
        }
    }
    (unknowns.count()..POSE).for_each(|i| equations.hold(i));
    moved(pose, &equations.factor()?.solve(equations.slope()))
}

/// Refines a pose from `start` on the `agreeing` observations by iteratively reweighted least
/// squares, with covariance. `None` where the fit does not converge or too few observations remain.
///
/// Tukey's biweight with its scale from the median residual (P. Huber, *Robust Statistics*; c =
/// 4.685) suppresses the few outliers left by RANSAC and keeps 95 % of the efficiency of least
/// squares.
pub fn refine(
    camera: &Camera,
    observations: Observations<'_>,
    start: &GroundPose,
    agreeing: &[bool],
    prediction: &GroundPose,
    prior: &RigPrior,
    config: &MotionConfig,
) -> Option<MotionEstimate> {
    let mut nuisance = Nuisance::new(camera, observations);
    let Observations { seen: observations, shutter, .. } = observations;
    let unknowns = Unknowns::new(config.model);
    let mut prior = *prior;
    let mut pose = GroundPose {
        // RANSAC's heading is in (−π, π]; the prediction's is unwrapped.
        heading_rad: prediction.heading_rad + wrap_angle(start.heading_rad - prediction.heading_rad),
        ..*start
    };
    let mut weights: Buffer<f64> = agreeing.iter().map(|&agrees| f64::from(u8::from(agrees))).collect();
    let mut scale_px = config.inlier_px;
    let mut residuals = Buffer::of(Residual::NONE, observations.len());
    let mut errors = Buffer::of(0.0, observations.len());
    let mut sorted = Buffer::new();
    let mut free_errors = Buffer::of([0.0; 2], observations.len());
    let (mut free_lengths, mut free_sorted) = (Buffer::of(0.0, observations.len()), Buffer::new());
    // Residuals and derivatives at a pose, and the robust scale of the residuals: one evaluation
    // gives the weights and the next step.
    let mut linearize = |pose: &GroundPose,
                         nuisance: &Nuisance<'_>,
                         noise_px: f64,
                         residuals: &mut [Residual],
                         errors: &mut [f64]|
     -> f64 {
        let axes = Axes::new(pose);
        for ((observation, kept), error) in observations.iter().zip(residuals).zip(&mut *errors) {
            let shaped = nuisance.shaped(observation);
            let observation = shaped.as_ref().unwrap_or(observation);
            *error = match residual(camera, observation, pose, &axes) {
                Some(mut residual) => {
                    nuisance.complete(observation, &mut residual);
                    nuisance.eliminate_elevation(observation, &mut residual, noise_px * noise_px);
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
    linearize(&pose, &nuisance, INITIAL_NOISE * config.inlier_px, &mut residuals, &mut errors);
    let mut cutoff_px = config.inlier_px;
    let mut equations = NormalEquations::new(nuisance.count);
    let (mut rig_evidence, mut explained) = (None, false);
    for iteration in 0..MAX_ITERATIONS {
        let tracks = nuisance.equations(&residuals, &weights, nuisance.count);
        equations = tracks;
        WeightedRigPrior::new(&prior, scale_px).add_to(&mut equations, &pose);
        nuisance.add_priors(&mut equations, scale_px);
        (unknowns.count()..POSE).for_each(|i| equations.hold(i));
        let step = equations.factor()?.solve(equations.slope());
        let before = pose;
        pose = moved(&pose, &step)?;
        nuisance.advance(&step);
        let rig_prior = WeightedRigPrior::new(&prior, scale_px);
        let noise_px = if iteration == 0 { INITIAL_NOISE * config.inlier_px } else { scale_px };
        scale_px = linearize(&pose, &nuisance, noise_px, &mut residuals, &mut errors);
        cutoff_px = (TUKEY_95 * scale_px).min(config.inlier_px.max(2.0 * scale_px));
        let per_cutoff = 1.0 / cutoff_px;
        weights.iter_mut().zip(&errors).for_each(|(weight, &error)| {
            *weight = Loss::Tukey(1.0).weight_of_square((error * per_cutoff).powi(2));
        });
        let moved = pose.distance_m(&before) / pose.height_m + (pose.heading_rad - before.heading_rad).abs();
        if iteration >= 2 && config.model == MotionModel::Auto {
            let mut tracks_alone = tracks;
            nuisance.add_priors(&mut tracks_alone, scale_px);
            (POSE..nuisance.count.min(WITH_KEYFRAME)).for_each(|i| tracks_alone.hold(i));
            let slope = *tracks_alone.slope();
            let tracks_alone = tracks_alone.factor()?;
            // A misfit by a prior that is too tight is not noise: as noise it would confirm that
            // prior. It is such a misfit where the fit without the prior explains most of it.
            let step = tracks_alone.solve(&slope);
            nuisance.errors_after(&step, &residuals, &mut free_errors);
            free_lengths
                .iter_mut()
                .zip(&*free_errors)
                .for_each(|(length, [x, y])| *length = (x * x + y * y).sqrt());
            let free_px = robust_scale(&free_lengths, config.inlier_px, &mut free_sorted);
            let is_explained = free_px < EXPLAINED * scale_px;
            let noise_px = if is_explained { free_px } else { scale_px };
            let held_px = well_constrained_scale(camera, &pose, &equations, &weights, noise_px);
            let shared_px = shared_px(noise_px, prior.shared_fraction * held_px);
            let evidence = evidence(camera, &tracks_alone, &pose, &rig_prior, noise_px, shared_px);
            if widen(&mut prior, &evidence) {
                continue;
            }
            explained = is_explained;
            rig_evidence = Some((evidence, tracks_alone));
        }
        // In units of the height: below 10⁻⁴ px.
        if iteration >= 3 && moved < 1e-7 {
            break;
        }
    }
    let count = weights.iter().filter(|&&weight| weight > 0.0).count();
    if count <= unknowns.count() {
        return None;
    }
    let squares: f64 = errors
        .iter()
        .zip(&weights)
        .filter(|(_, weight)| **weight > 0.0)
        .map(|(error, _)| error * error)
        .sum();
    let degrees_of_freedom = 2 * count - unknowns.count();
    let rig_prior = WeightedRigPrior::new(&prior, scale_px);
    let keyframe_error = nuisance.keyframe_error(&equations, scale_px);
    let keyframe_pose = nuisance.observations.keyframe_pose;
    if keyframe_error.as_ref().is_some_and(|error| !is_plausible(error, keyframe_pose)) {
        return None;
    }
    // From here on the covariance is conditional on the keyframe.
    (POSE..nuisance.count.min(WITH_KEYFRAME)).for_each(|i| equations.hold(i));
    let given_keyframe = equations.factor()?;
    let slopes = nuisance.slopes_by_keyframe(&residuals, &weights, nuisance.count, |_| 1.0);
    let shutter = match shutter {
        Some((prior, assumed)) => {
            let count = nuisance.count.max(WITH_SKEW);
            let mut with_skew = nuisance.equations(&residuals, &weights, count);
            rig_prior.add_to(&mut with_skew, &pose);
            nuisance.add_priors(&mut with_skew, scale_px);
            (unknowns.count()..POSE).for_each(|i| with_skew.hold(i));
            let by_skew = nuisance.slopes_by_keyframe(&residuals, &weights, nuisance.count, |observation| {
                observation.keyframe_row_fraction
            });
            let estimate = nuisance.shutter(&with_skew, prior, assumed, scale_px)?;
            let pose_by_keyframe_skew = pose_changes(&given_keyframe, &by_skew, &unknowns);
            Some(ShutterEstimate { pose_by_keyframe_skew, ..estimate })
        }
        None => None,
    };
    // The inlier test uses the unwhitened distance too: a wrong match has a large covariance, hence
    // a small whitened residual.
    let near = |(residual, &weight): (&Residual, &f64)| weight > 0.0 && residual.distance_px < cutoff_px;
    let inliers: Buffer<bool> = residuals.iter().zip(&weights).map(near).collect();
    let shaped = observations.iter().map(|seen| nuisance.shaped(seen).unwrap_or(*seen));
    let elevations = elevations(shaped, &residuals, pose.height_m);
    let shape = nuisance.shape_estimate(&equations, scale_px);
    let own = RobustFit {
        residuals: &residuals,
        weights: &weights,
        errors: &errors,
        cutoff_px,
        scale_px,
        nuisance: &nuisance,
    }
    .covariance(&equations, &rig_prior, &unknowns)?
        * (2 * count) as f64
        / degrees_of_freedom as f64;
    let held_px = well_constrained_scale(camera, &pose, &equations, &weights, scale_px);
    let shared_px = shared_px(scale_px, prior.shared_fraction * held_px);
    if !explained {
        free_errors.iter_mut().zip(&*residuals).for_each(|(free, residual)| *free = residual.error);
    }
    let rig_evidence = rig_evidence.map(|((value, covariance), tracks_alone)| {
        let by_keyframe = pose_changes(&tracks_alone, &slopes, &unknowns);
        RigEvidence { value, covariance, by_keyframe: by_keyframe.fixed_view::<3, 3>(3, 3).into_owned() }
    });
    let covariance = own + shared_covariance(camera, &pose, &unknowns, shared_px);
    if (0..2).any(|i| covariance[(i, i)].sqrt() > MAX_RELATIVE_SIGMA * pose.height_m) {
        return None;
    }
    let mut by_keyframe = pose_changes(&given_keyframe, &slopes, &unknowns);
    // Position and heading of the keyframe change neither height nor tilt of the frame: zero by
    // symmetry, and up to 1e-4 as linearised. With a position uncertain by a metre, as after a gap,
    // the path would jump as soon as the tilt is known better.
    by_keyframe.fixed_view_mut::<3, 3>(3, 0).fill(0.0);
    let model_covariance =
        model_covariance(camera, &nuisance, &residuals, &weights, &given_keyframe, &unknowns, scale_px);
    Some(MotionEstimate {
        pose,
        covariance,
        model_covariance,
        by_keyframe,
        by_prior_tilt: by_prior_tilt(&given_keyframe, &rig_prior, &unknowns),
        keyframe_error,
        inliers,
        residual_px: (squares / count as f64).sqrt(),
        noise_px: nuisance.observations.noise_px,
        residual_correlation: ResidualCorrelation::of(camera, observations, &free_errors, &weights),
        rig_evidence,
        elevations,
        shape,
        uneven: None,
        shutter,
    })
}

/// Whether a keyframe may have had the height and tilt that a fit finds for it. Tracks that fit
/// only a keyframe of quite another height or tilt are not of that ground.
fn is_plausible(error: &KeyframeError, keyframe_pose: &GroundPose) -> bool {
    let [height_m, roll_rad, pitch_rad] = error.mean.into();
    [height_m / keyframe_pose.height_m, roll_rad, pitch_rad].iter().all(|off| off.abs() < MAX_KEYFRAME_ERROR)
}

/// Largest error of a keyframe's height, as a part of it, and tilt, radians: three standard
/// deviations of the tilt of an unknown mount.
const MAX_KEYFRAME_ERROR: f64 = 0.15;

/// Elevations of the observed points given the pose.
fn elevations(
    observations: impl Iterator<Item = Observation>,
    residuals: &[Residual],
    height_m: f64,
) -> Buffer<MeasuredElevation> {
    // Across the parallax the residual is noise, whatever the elevation.
    let mut across_px2: Buffer<f64> =
        residuals.iter().map(|residual| residual.parallax.across_squared()).collect();
    let noise_px2 = robust_variance::<1>(&mut across_px2).unwrap_or(0.0).max(MIN_SCALE_PX * MIN_SCALE_PX);
    let measured = |(observation, residual): (Observation, &Residual)| {
        residual.parallax.measured(observation.elevation, noise_px2, super::MAX_KERB_HEIGHT * height_m)
    };
    observations.zip(residuals).map(measured).collect()
}

/// A prior is too tight where the residual without it is below this fraction of that with it. Not
/// derived; chosen: a wrong lens or shutter leaves more.
const EXPLAINED: f64 = 0.5;

/// Initial noise of a track, before residuals give the scale, as a fraction of the inlier distance.
/// Not derived; chosen.
const INITIAL_NOISE: f64 = 0.05;

/// A position that the tracks determine to no better than this part of the height is not measured.
/// The next keyframe and the velocity would be built on it. Not derived; chosen.
const MAX_RELATIVE_SIGMA: f64 = 0.1;

/// Most iterations of the robust fit. Not derived; chosen.
const MAX_ITERATIONS: usize = 12;

/// Lower bound of the scale of the residuals, pixels: neighbouring tracks share their errors. Not
/// derived; chosen.
const MIN_SCALE_PX: f64 = 0.01;

/// Robust standard deviation of one coordinate from the median length of the residuals within twice
/// the inlier distance.
fn robust_scale(errors: &[f64], inlier_px: f64, within: &mut Vec<f64>) -> f64 {
    within.clear();
    within.extend(errors.iter().copied().filter(|&e| e < 2.0 * inlier_px));
    let sigma_px = median(within).map(|median_px| median_px / RAYLEIGH_MEDIAN);
    sigma_px.map_or(inlier_px, |sigma_px| sigma_px.clamp(MIN_SCALE_PX, inlier_px))
}
