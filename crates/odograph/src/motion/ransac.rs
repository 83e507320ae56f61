//! RANSAC with the score of MSAC: the pose that most tracks agree on. Derivation:
//! `docs/math/frame-pose.md`.

use super::normal_equations::Unknowns;
use super::planar_pose::gauss_newton_step;
use super::{Elevation, MotionConfig, MotionModel, Observation, Observations, Random, RigPrior};
use crate::buffer::{Buffer, stored};
use crate::camera::Camera;
use crate::geometry::{GroundPoint, GroundPose, Ray, length};
use nalgebra::{Matrix3, Vector3};

stored!(Option<Ray>);

/// Most samples that are drawn. Not derived; chosen.
const MAX_SAMPLES: usize = 300;
/// Accepted probability that no sample is free of outliers. Not derived; chosen.
const MISS_PROBABILITY: f64 = 1e-4;

/// The best hypothesis and its inliers; `None` where no sample gives a pose.
///
/// Scores are those of MSAC (P. Torr and A. Zisserman, "MLESAC", 2000). Distances are measured on
/// undistorted rays, scaled by the focal length: within the inlier distance this differs from
/// pixels by the lens's local magnification only, and the refinement measures in pixels.
pub fn consensus(
    camera: &Camera,
    observations: Observations<'_>,
    prediction: &GroundPose,
    prior: &RigPrior,
    config: &MotionConfig,
    random: &mut Random,
) -> Option<(GroundPose, Buffer<bool>)> {
    let all = observations;
    let observations = all.seen;
    // Height and tilt are not refined yet, so the threshold is wider.
    let limit_px2 =
        if config.model == MotionModel::Auto { 2.0 * config.inlier_px } else { config.inlier_px }.powi(2);
    let predicted = inliers_of(camera, all, prediction, limit_px2);
    let count = predicted.iter().filter(|&&agrees| agrees).count();
    if count >= config.minimum_inliers && count as f64 >= MIN_PREDICTED_INLIERS * observations.len() as f64 {
        return Some((*prediction, predicted));
    }
    let model = sampled_model(prior, config.model);
    let rays: Buffer<Option<Ray>> = observations.iter().map(|o| camera.ray_from_pixel(o.pixel)).collect();
    let usable: Buffer<usize> = (0..rays.len()).filter(|&i| rays[i].is_some()).collect();
    let sample_size = if model == MotionModel::Free { 4 } else { 2 };
    if usable.len() < config.minimum_inliers.max(sample_size) {
        return None;
    }
    let (fx, fy) = camera.focal_px();
    let squared_errors = |pose: &GroundPose| -> Buffer<f64> {
        let camera_from_world = pose.world_from_camera_rotation().transpose();
        observations
            .iter()
            .zip(&rays)
            .map(|(observation, ray)| {
                let point = camera_from_world * from_camera(observation, pose);
                match ray {
                    Some(ray) if point.z > 1e-9 => {
                        let error_px = [fx * (point.x / point.z - ray.x), fy * (point.y / point.z - ray.y)];
                        squared_distance(observation, all, &point, &camera_from_world, (fx, fy), error_px)
                    }
                    _ => f64::INFINITY,
                }
            })
            .collect()
    };
    let mut best: Option<(f64, GroundPose, Buffer<f64>)> = None;
    let mut score = |pose: GroundPose| -> usize {
        let errors = squared_errors(&pose);
        let cost: f64 = errors.iter().map(|e| e.min(limit_px2)).sum();
        if best.as_ref().is_none_or(|(lowest, _, _)| cost < *lowest) {
            best = Some((cost, pose, errors));
        }
        best.as_ref().map_or(0, |(_, _, errors)| errors.iter().filter(|e| **e < limit_px2).count())
    };
    // The prediction is the first hypothesis.
    let mut inliers = score(*prediction);
    let mut samples = 0;
    while samples < samples_needed(inliers as f64 / usable.len() as f64, sample_size) {
        samples += 1;
        let sample: Buffer<usize> = (0..sample_size).map(|_| usable[random.below(usable.len())]).collect();
        if let Some(pose) = hypothesis(camera, observations, &rays, &sample, prediction, model) {
            inliers = score(pose);
        }
    }
    best.map(|(_, pose, errors)| (pose, errors.iter().map(|e| *e < limit_px2).collect()))
}

/// Inlier ratio of the prediction above which no samples are drawn: the refinement converges from
/// there. Not derived; chosen.
const MIN_PREDICTED_INLIERS: f64 = 0.8;

/// Which observations are within the limit, pixels², of their projections at a pose.
fn inliers_of(
    camera: &Camera,
    observations: Observations<'_>,
    pose: &GroundPose,
    limit_px2: f64,
) -> Buffer<bool> {
    let camera_from_world = pose.world_from_camera_rotation().transpose();
    let agrees = |observation: &Observation| {
        let point = camera_from_world * from_camera(observation, pose);
        if point.z <= 1e-9 {
            return false;
        }
        let seen = camera.pixel_from_ray(Ray::new(point.x / point.z, point.y / point.z));
        seen.is_some_and(|seen| {
            let error_px = [seen.x - observation.pixel.x, seen.y - observation.pixel.y];
            let focal_px = camera.focal_px();
            squared_distance(observation, observations, &point, &camera_from_world, focal_px, error_px)
                < limit_px2
        })
    };
    observations.seen.iter().map(agrees).collect()
}

/// Vector from the camera to an observed point, in world axes.
fn from_camera(observation: &Observation, pose: &GroundPose) -> Vector3<f64> {
    let Observation { ground, elevation, .. } = observation;
    Vector3::new(ground.x_m - pose.x_m, ground.y_m - pose.y_m, elevation.mean_m - pose.height_m)
}

/// Squared re-projection error, pixels², after the best elevation within three standard deviations.
fn squared_distance(
    observation: &Observation,
    Observations { shape, .. }: Observations<'_>,
    point: &Vector3<f64>,
    camera_from_world: &Matrix3<f64>,
    (fx, fy): (f64, f64),
    [x, y]: [f64; 2],
) -> f64 {
    let Elevation { mean_m, variance_m2 } = observation.elevation;
    let variance_m2 = variance_m2 + shape.map_or(0.0, |shape| shape.variance_m2(observation.ground));
    if variance_m2 <= 0.0 {
        return x * x + y * y;
    }
    // As its elevation changes the point stays on the ray of the keyframe.
    let Observation { ground, centre_of_projection: centre, .. } = observation;
    let ray = Vector3::new(ground.x_m, ground.y_m, mean_m) - centre;
    let by_elevation = camera_from_world * (ray / ray.z);
    let by_x = fx * (by_elevation.x - point.x / point.z * by_elevation.z) / point.z;
    let by_y = fy * (by_elevation.y - point.y / point.z * by_elevation.z) / point.z;
    let squared = (by_x * by_x + by_y * by_y).max(1e-12);
    let limit_m = 3.0 * variance_m2.sqrt();
    let elevation_m = ((x * by_x + y * by_y) / squared).clamp(-limit_m, limit_m);
    (x - elevation_m * by_x).powi(2) + (y - elevation_m * by_y).powi(2)
}

/// The motion model of the samples: `auto` frees what the prior leaves uncertain.
fn sampled_model(prior: &RigPrior, model: MotionModel) -> MotionModel {
    match model {
        MotionModel::Auto if prior.sigma[1].max(prior.sigma[2]) > 0.02 => MotionModel::Free,
        MotionModel::Auto if prior.sigma[0] > 0.01 * prior.mean[0] => MotionModel::Similarity,
        MotionModel::Auto => MotionModel::Rigid,
        other => other,
    }
}

/// Number of samples so that one without outliers is among them with probability 1 −
/// [`MISS_PROBABILITY`].
fn samples_needed(inlier_fraction: f64, sample_size: usize) -> usize {
    let all_inliers = inlier_fraction.powi(sample_size as i32);
    if all_inliers <= 1e-9 {
        return MAX_SAMPLES;
    }
    if all_inliers >= 1.0 {
        return 1;
    }
    ((MISS_PROBABILITY.ln() / (1.0 - all_inliers).ln()).ceil() as usize).clamp(1, MAX_SAMPLES)
}

/// The pose of a minimal sample.
fn hypothesis(
    camera: &Camera,
    observations: &[Observation],
    rays: &[Option<Ray>],
    sample: &[usize],
    prediction: &GroundPose,
    model: MotionModel,
) -> Option<GroundPose> {
    // The two points as seen by a camera of the predicted height and tilt at the origin.
    let here = GroundPose { x_m: 0.0, y_m: 0.0, heading_rad: 0.0, ..*prediction };
    let seen = |i: usize| rays[i].and_then(|ray| here.ground_from_ray(ray));
    let (first, second) = (sample[0], sample[1]);
    let pose = two_point_pose(
        [observations[first].ground, observations[second].ground],
        [seen(first)?, seen(second)?],
        prediction,
        model,
    )?;
    if model != MotionModel::Free {
        return Some(pose);
    }
    // Four points determine all six unknowns; the planar pose is solved for directly, without
    // decomposing a homography.
    let minimal: Buffer<Observation> = sample.iter().map(|&i| observations[i]).collect();
    let mut pose = pose;
    for _ in 0..5 {
        pose = gauss_newton_step(camera, &minimal, &pose, &Unknowns::new(model))?;
    }
    let is_plausible = pose.height_m > 0.2 * prediction.height_m && pose.height_m < 5.0 * prediction.height_m;
    is_plausible.then_some(pose)
}

/// Closed-form pose from two points: the rotation and shift (and, where the height is free, scale)
/// that map `seen`, placed by a camera at the origin, to `ground`.
fn two_point_pose(
    ground: [GroundPoint; 2],
    seen: [GroundPoint; 2],
    prediction: &GroundPose,
    model: MotionModel,
) -> Option<GroundPose> {
    let (ax, ay) = (ground[1].x_m - ground[0].x_m, ground[1].y_m - ground[0].y_m);
    let (bx, by) = (seen[1].x_m - seen[0].x_m, seen[1].y_m - seen[0].y_m);
    let (length, seen_length) = (length(ax, ay), length(bx, by));
    // Points closer than a tenth of the height determine the heading poorly.
    if length < 0.1 * prediction.height_m || seen_length < 1e-9 {
        return None;
    }
    let ratio = length / seen_length;
    let scale = if model == MotionModel::Rigid { 1.0 } else { ratio };
    if (model == MotionModel::Rigid && !(0.9..1.1).contains(&ratio)) || !(0.2..5.0).contains(&ratio) {
        return None;
    }
    let heading_rad = (bx * ay - by * ax).atan2(bx * ax + by * ay);
    let (sin, cos) = heading_rad.sin_cos();
    let centre = |a: GroundPoint, b: GroundPoint| (0.5 * (a.x_m + b.x_m), 0.5 * (a.y_m + b.y_m));
    let (to, from) = (centre(ground[0], ground[1]), centre(seen[0], seen[1]));
    Some(GroundPose {
        x_m: to.0 - scale * (cos * from.0 - sin * from.1),
        y_m: to.1 - scale * (sin * from.0 + cos * from.1),
        heading_rad,
        height_m: scale * prediction.height_m,
        roll_rad: prediction.roll_rad,
        pitch_rad: prediction.pitch_rad,
    })
}
