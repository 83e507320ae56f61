//! A keyframe's corners found again in a frame, and the movement they speak for.

use super::OdometryConfig;
use super::keyframe::{KeyCorner, Keyframe};
use super::learned::Learned;
use super::light_field::LightField;
use super::texture::Texture;
use crate::buffer::{Buffer, stored};
use crate::camera::Camera;
use crate::flow::{Noise, SEARCH_RADIUS_PX, Track, Warp, dissimilarity, forward_backward_px, track};
use crate::geometry::{GroundPoint, GroundPose, Pixel};
use crate::image::Pyramid;
use crate::motion::RigPrior;
use crate::motion::dense::{self, DenseEstimate, DenseImage};
use crate::motion::{
    Elevation, MotionEstimate, MotionModel, Observation, Observations, PatchWarp, Random, RollingShutter,
    ShutterPrior, Sighting, ViewingPose, estimate, mean_displacement, whitened,
};
use crate::trajectory::LossReason;
use nalgebra::{Matrix2, Matrix3, Matrix6, Matrix6x2, Vector2, Vector3};

/// A frame measured against a keyframe.
#[derive(Debug, Clone)]
pub struct Measurement {
    pub estimate: MotionEstimate,
    /// Where it was looked for.
    pub prediction: GroundPose,
    /// The corners found again, in step with the estimate's inliers.
    pub found: Buffer<Found>,
    /// The part of the keyframe's corners that supports the movement, 0 to 1.
    pub support: f64,
    /// Whether a subset of the corners agreed on a pose from which the rest was searched for: what
    /// was not found from there is not visible.
    pub settled: bool,
    /// Where the whole image was compared: the part of what is in view that agrees.
    pub agreement: Option<f64>,
}

/// A corner found again.
#[derive(Debug, Clone, Copy)]
pub struct Found {
    /// Which of the keyframe's corners.
    pub corner: usize,
    pub warp: Warp,
    /// Of the position, from the noise of the samples, pixels².
    pub covariance_px2: Matrix2<f64>,
    /// Logarithm of its brightness over that of its first appearance.
    pub light: f64,
    pub noise: Noise,
}

/// What was found, weighed by how well each patch holds in each direction.
/// Pixels of a rolling shutter are brought to where a global one would have seen them from `pose`.
fn observations(
    keyframe: &Keyframe,
    found: &[Found],
    camera: &Camera,
    pose: &GroundPose,
    shutter: Option<(&ShutterPrior, &RollingShutter)>,
    relief_m2: f64,
) -> Buffer<Observation> {
    let light = LightField::between(found);
    let sighting = |found: &Found| {
        let corner = &keyframe.corners[found.corner];
        let Warp { position, linear } = &found.warp;
        let pulled = light.as_ref().map_or_else(Vector2::zeros, |light| {
            corner.template.model_bias(found.noise).by_illumination(linear, light.slope(*position))
        });
        let pixel = Pixel::new(position.x - pulled.x, position.y - pulled.y);
        let (mut ground, mut pixel, mut row_fraction) = (corner.patch.ground, pixel, 0.0);
        let [x_by_readout, y_by_readout] = corner.patch.by_readout;
        if let Some((prior, shutter)) = shutter {
            let later_s = prior.readout.mean_s - keyframe.shutter.readout_s;
            ground.x_m += later_s * x_by_readout;
            ground.y_m += later_s * y_by_readout;
            row_fraction = shutter.row_fraction(pixel.y);
            pixel = shutter.global_pixel(camera, pose, pixel).unwrap_or(pixel);
        }
        let covariance_px2 = found.covariance_px2;
        let keyframe_row_fraction = keyframe.shutter.row_fraction(corner.template.centre().y);
        let unknown = Elevation { mean_m: corner.patch.elevation_m, variance_m2: relief_m2 };
        let elevation = corner.elevation.unwrap_or(unknown);
        Sighting { ground, elevation, pixel, covariance_px2, row_fraction, keyframe_row_fraction }
    };
    let sightings: Buffer<Sighting> = found.iter().map(sighting).collect();
    whitened(&sightings, SHARED_PX2).map_or_else(Buffer::new, |(observations, _)| observations)
}

/// Lower bound of a track's variance, pixels²: 0.02 px of interpolation and warp error. Where all
/// tracks are good, all have equal weight.
const SHARED_PX2: f64 = 4e-4;

stored!(Found);

/// Measures the pose of a frame against a keyframe, somewhere about `prediction`.
pub fn measure(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    prediction: &GroundPose,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> Result<Measurement, LossReason> {
    let first = measure_near(keyframe, pyramid, camera, prediction, f64::INFINITY, config, learned, random)?;
    if config.motion.model == MotionModel::Mean || first.settled {
        return Ok(first);
    }
    // Once more from where it was found: corners that were out of reach are now within.
    let found = first.estimate.pose;
    Ok(match measure_near(keyframe, pyramid, camera, &found, FOUND_WITHIN_PX, config, learned, random) {
        Ok(again) if again.support >= first.support => Measurement { prediction: first.prediction, ..again },
        _ => first,
    })
}

/// A pose that was found from few corners is still right to about this much in the image, pixels.
const FOUND_WITHIN_PX: f64 = 2.0;

/// Measures the pose of a frame against a keyframe if the prediction is off by at most `off_px` in
/// the image.
pub fn measure_near(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    prediction: &GroundPose,
    off_px: f64,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> Result<Measurement, LossReason> {
    if config.motion.model != MotionModel::Mean && keyframe.texture() == Texture::Faint {
        // A partly dark or blurred image looks faint, too, but has corners. Only corners determine
        // the skew of a rolling shutter.
        let whole = || measure_whole(keyframe, pyramid, camera, prediction, config, learned);
        let by_corners = |random: &mut Random| {
            if keyframe.corners.len() < 2 * config.motion.minimum_inliers {
                return Err(LossReason::Jump);
            }
            let followed = follow(keyframe, pyramid, camera, prediction, off_px, config, learned, random);
            let found = judge(keyframe, followed, camera, prediction, config, learned, random)?;
            let agrees = presence(keyframe, camera, &found) >= LEAST_ON_FAINT;
            if agrees { Ok(found) } else { Err(LossReason::Jump) }
        };
        return if learned.shutter_rolls() {
            by_corners(random).or_else(|_| whole())
        } else {
            whole().or_else(|lost| by_corners(random).map_err(|_| lost))
        };
    }
    let followed = if config.motion.model == MotionModel::Mean {
        Followed { found: follow_by_eye(keyframe, pyramid, off_px, config), settled: None }
    } else {
        follow(keyframe, pyramid, camera, prediction, off_px, config, learned, random)
    };
    judge(keyframe, followed, camera, prediction, config, learned, random)
}

/// On an image that looks faint this part of the corners in view must agree with a pose.
const LEAST_ON_FAINT: f64 = 0.5;

/// Registers a frame to a whole keyframe: on faint ground no single corner is reliable.
fn measure_whole(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    prediction: &GroundPose,
    config: &OdometryConfig,
    learned: &Learned,
) -> Result<Measurement, LossReason> {
    let image = DenseImage::new(pyramid.base()).without(keyframe.mask.clone());
    let prior = learned.rig_prior.prior(prediction, &config.motion);
    let found = dense::refine(camera, keyframe.dense(camera), &image, prediction, &prior, &config.motion);
    let found = found.filter(|found| found.score >= DenseEstimate::LEAST_SCORE).ok_or(LossReason::Jump)?;
    if found.agreement < config.motion.minimum_inlier_fraction {
        return Err(LossReason::NotPlanar);
    }
    Ok(Measurement {
        estimate: found.estimate,
        prediction: *prediction,
        found: Buffer::new(),
        support: found.agreement * found.overlap,
        settled: true,
        agreement: Some(found.agreement),
    })
}

/// Registers a frame to a whole keyframe whose corners do not exceed the noise, near one of two
/// predictions. `None` if they do exceed it, or if the ground is not found.
pub fn measure_drowned(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    predictions: [&GroundPose; 2],
    config: &OdometryConfig,
    learned: &Learned,
) -> Option<Measurement> {
    let by_corners = keyframe.texture() != Texture::Drowned || learned.shutter_rolls();
    if config.motion.model == MotionModel::Mean || by_corners {
        return None;
    }
    predictions
        .iter()
        .find_map(|prediction| measure_whole(keyframe, pyramid, camera, prediction, config, learned).ok())
}

/// Drops tracks that fail the forward-backward check and measures again: used where later frames
/// depend on this one.
pub fn confirm(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    measurement: Measurement,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> Measurement {
    if measurement.agreement.is_some() {
        return measurement;
    }
    let comes_back = |found: &&Found| {
        let template = &keyframe.corners[found.corner].template;
        forward_backward_px(template, &keyframe.pyramid, pyramid, &found.warp, &config.flow)
            .is_some_and(|distance| distance <= config.flow.forward_backward_px)
    };
    let found: Buffer<Found> = measurement.found.iter().filter(comes_back).copied().collect();
    if (found.len() as f64) < MIN_CONFIRMED * measurement.found.len() as f64 {
        return measurement;
    }
    let followed = Followed { found, settled: measurement.settled.then_some(measurement.estimate.pose) };
    judge(keyframe, followed, camera, &measurement.prediction, config, learned, random).unwrap_or(measurement)
}

/// Where fewer tracks than this fraction come back, blur keeps them from it, and the few that do
/// would give a worse pose. Not derived; chosen.
const MIN_CONFIRMED: f64 = 0.5;

/// Inlier ratio among the keyframe's corners that a camera at the measured pose should see, 0 to 1:
/// low if only something beside the ground was tracked.
pub fn presence(keyframe: &Keyframe, camera: &Camera, measurement: &Measurement) -> f64 {
    let estimate = &measurement.estimate;
    measurement.agreement.unwrap_or_else(|| {
        let expected = in_view(keyframe, keyframe.corners.iter(), camera, &estimate.pose);
        estimate.inlier_count() as f64 / expected.max(1) as f64
    })
}

/// Reason of a loss: most of what should be in view was found but does not move as one plane, or it
/// was found by chance.
pub fn why_not(keyframe: &Keyframe, camera: &Camera, found: &[Found], prediction: &GroundPose) -> LossReason {
    const MOST: f64 = 0.5;
    let expected = in_view(keyframe, keyframe.corners.iter(), camera, prediction);
    if found.len() as f64 >= MOST * expected as f64 { LossReason::NotPlanar } else { LossReason::Jump }
}

/// Whether the inliers stand still in the image although the camera should have moved since the
/// keyframe, as the shadow of the vehicle does.
pub fn stands_still(keyframe: &Keyframe, camera: &Camera, measurement: &Measurement) -> bool {
    const STILL_PX: f64 = 1.0;
    const MOVED_PX: f64 = 6.0;
    const MOST: f64 = 0.6;
    let (from, to) = (&keyframe.pose, &measurement.prediction);
    let moved_m = (to.x_m - from.x_m).hypot(to.y_m - from.y_m);
    if moved_m * camera.focal_px().0 < MOVED_PX * to.height_m {
        return false;
    }
    let agree = measurement.found.iter().zip(&measurement.estimate.inliers).filter(|(_, agrees)| **agrees);
    let still = agree.filter(|(found, _)| {
        found.warp.position.distance(keyframe.corners[found.corner].template.centre()) < STILL_PX
    });
    still.count() as f64 > MOST * measurement.estimate.inlier_count().max(1) as f64
}

/// How many of the corners a camera at `pose` should see.
fn in_view<'a>(
    keyframe: &Keyframe,
    corners: impl Iterator<Item = &'a KeyCorner>,
    camera: &Camera,
    pose: &GroundPose,
) -> usize {
    let pose = ViewingPose::new(*pose);
    let seen = |corner: &&KeyCorner| {
        let pixel = corner.patch.pixel(camera, &pose);
        pixel.is_some_and(|pixel| camera.contains(pixel, TEMPLATE_REACH_PX) && !keyframe.is_masked(pixel))
    };
    corners.filter(seen).count()
}

/// Fraction of the keyframe's tracked corners that a camera at `pose` would still see.
pub fn still_seen(keyframe: &Keyframe, camera: &Camera, found: &[Found], pose: &GroundPose) -> f64 {
    if found.is_empty() {
        return keyframe.dense(camera).overlap(camera, pose);
    }
    let pose = ViewingPose::new(*pose);
    let seen = |found: &&Found| {
        let pixel = keyframe.corners[found.corner].patch.pixel(camera, &pose);
        pixel.is_some_and(|pixel| camera.contains(pixel, TEMPLATE_REACH_PX) && !keyframe.is_masked(pixel))
    };
    found.iter().filter(seen).count() as f64 / keyframe.corners_at_first.max(1) as f64
}

/// A template nearer to the border than this cannot be found.
const TEMPLATE_REACH_PX: f64 = 10.0;

/// The corners found again, and the pose that the first of them agreed on.
struct Followed {
    found: Buffer<Found>,
    settled: Option<GroundPose>,
}

/// So many corners are looked for first.
const SCOUTS: usize = 64;

/// They show where all the others are when this part of those in view agrees.
const SETTLED: f64 = 0.6;

/// Typical error of the prediction, pixels, within the reach of the full-resolution image.
const LIKELY_NEAR_PX: f64 = 4.0;

/// From a pose that the scouts agree on, corners are off by less than this, pixels.
const SETTLED_PX: f64 = 0.75;

/// Searches for each corner at its predicted position and shape: a subset first, and the rest from
/// the pose that the subset gives, which is exact enough for the full-resolution image alone.
fn follow(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    prediction: &GroundPose,
    off_px: f64,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> Followed {
    let corners = keyframe.corners.len();
    let every = (corners as f64 * learned.findable()) as usize / SCOUTS;
    let mut found = Buffer::new();
    let from = learned.viewing(camera, prediction);
    let find = |index: usize, from: &ViewingPose, off_px: f64| {
        find(index, &keyframe.corners[index], keyframe, pyramid, camera, from, off_px, config)
    };
    if every < 2 || off_px <= SETTLED_PX {
        found.extend((0..corners).filter_map(|index| find(index, &from, off_px)));
        return Followed { found, settled: None };
    }
    let scouts = (0..corners).step_by(every);
    let mut settled = None;
    // Usually the prediction is good and the full-resolution image is enough: the coarser levels
    // are not even computed.
    let likely_near = off_px > SEARCH_RADIUS_PX && off_px <= LIKELY_NEAR_PX;
    let reaches: &[f64] = if likely_near { &[SEARCH_RADIUS_PX, off_px] } else { &[off_px] };
    for &off_px in reaches {
        found.clear();
        found.extend(scouts.clone().filter_map(|index| find(index, &from, off_px)));
        settled = agreement(keyframe, scouts.clone(), &found, camera, prediction, config, learned, random);
        if settled.is_some() {
            break;
        }
    }
    match settled.map(|pose| learned.viewing(camera, &pose)) {
        Some(from) => {
            // Scouts that were out of reach are looked for again.
            let scouts = found.len();
            let mut next = 0;
            for index in 0..corners {
                if found[..scouts].get(next).is_some_and(|scout| scout.corner == index) {
                    next += 1;
                } else {
                    found.extend(find(index, &from, SETTLED_PX));
                }
            }
        }
        None => {
            let others = (0..corners).filter(|index| index % every != 0);
            found.extend(others.filter_map(|index| find(index, &from, off_px)));
        }
    }
    Followed { found, settled }
}

/// The pose that the scouts agree on, where most of those that should be in view from there do.
fn agreement(
    keyframe: &Keyframe,
    scouts: impl Iterator<Item = usize>,
    found: &[Found],
    camera: &Camera,
    prediction: &GroundPose,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> Option<GroundPose> {
    let shutter = learned.shutter_at(camera, prediction);
    let shutter = learned.frame_shutter.as_ref().zip(shutter.as_ref());
    let observations = observations(keyframe, found, camera, prediction, shutter, learned.relief_m2());
    let prior = learned.rig_prior.prior(prediction, &config.motion);
    let shutter = shutter.map(|(prior, shutter)| (prior, shutter.rates));
    let keyframe_covariance = &keyframe.rig_covariance();
    let observations =
        Observations { seen: &observations, keyframe_pose: &keyframe.pose, keyframe_covariance, shutter };
    let estimate = estimate(camera, observations, prediction, &prior, &config.motion, random)?;
    let scouts = scouts.map(|index| &keyframe.corners[index]);
    let expected = in_view(keyframe, scouts, camera, &estimate.pose);
    let agree = estimate.inlier_count();
    (agree >= LEAST_SCOUTS && agree as f64 >= SETTLED * learned.findable() * expected as f64)
        .then_some(estimate.pose)
}

/// Fewer than this show nothing.
const LEAST_SCOUTS: usize = 20;

/// Searches a corner where and in which shape a pose expects it.
fn find(
    index: usize,
    corner: &KeyCorner,
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    pose: &ViewingPose,
    off_px: f64,
    config: &OdometryConfig,
) -> Option<Found> {
    let PatchWarp { warp, curvature, .. } = corner.patch.warp(camera, pose)?;
    let parallax = corner.parallax_px(camera, &keyframe.pose, pose);
    let warp =
        Warp { position: Pixel::new(warp.position.x + parallax.x, warp.position.y + parallax.y), ..warp };
    if keyframe.is_masked(warp.position) {
        return None;
    }
    if off_px > SEARCH_RADIUS_PX {
        corner.template.add_coarser_levels(&keyframe.pyramid);
    }
    let (warp, found) = match track(&corner.template, pyramid, &warp, off_px, &config.flow) {
        Ok(found) if found.dissimilarity <= config.flow.dissimilarity => {
            (Warp { position: found.position, ..warp }, found)
        }
        // The predicted shape alone may have been wrong. From a pose with inliers it is not.
        Ok(Track { position, .. }) if off_px > SETTLED_PX => {
            dissimilarity(&corner.template, pyramid, &Warp { position, ..warp })
                .filter(|(_, found)| found.dissimilarity <= config.flow.dissimilarity)?
        }
        Ok(_) | Err(_) => return None,
    };
    let bend = corner.template.model_bias(found.noise).by_curvature(&warp.linear, &curvature);
    let position = Pixel::new(warp.position.x - bend.x, warp.position.y - bend.y);
    let Track { covariance_px2, light, noise, .. } = found;
    Some(Found { corner: index, warp: Warp { position, ..warp }, covariance_px2, light, noise })
}

/// Searches for each corner where it was last seen; its shape is that of the affine comparison with
/// its first appearance. This is the paper's method, without a model of the camera's rotation.
fn follow_by_eye(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    off_px: f64,
    config: &OdometryConfig,
) -> Buffer<Found> {
    let search = |(index, corner): (usize, &KeyCorner)| {
        corner.template.add_coarser_levels(&keyframe.pyramid);
        let Track { position, .. } =
            track(&corner.template, pyramid, &corner.seen, off_px, &config.flow).ok()?;
        let (warp, judged) = dissimilarity(&corner.template, pyramid, &Warp { position, ..corner.seen })?;
        let Track { dissimilarity, covariance_px2, light, noise, .. } = judged;
        (dissimilarity <= config.flow.dissimilarity).then_some(Found {
            corner: index,
            warp,
            covariance_px2,
            light,
            noise,
        })
    };
    keyframe.corners.iter().enumerate().filter_map(search).collect()
}

fn judge(
    keyframe: &Keyframe,
    followed: Followed,
    camera: &Camera,
    prediction: &GroundPose,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> Result<Measurement, LossReason> {
    let Followed { found, settled } = followed;
    if found.len() < config.motion.minimum_inliers {
        return Err(LossReason::Jump);
    }
    let estimate = if config.motion.model == MotionModel::Mean {
        mean(keyframe, &found, camera, prediction, config, random)
    } else {
        let prior = learned.rig_prior.prior(prediction, &config.motion);
        let mut measure = |near: &GroundPose, prior: &RigPrior, plane: GroundHypothesis| {
            let shutter = learned.shutter_at(camera, near);
            let frame_shutter = learned
                .frame_shutter
                .map(|prior| ShutterPrior { applies: prior.applies || plane.is_tilted, ..prior });
            let shutter = frame_shutter.as_ref().zip(shutter.as_ref());
            let observations = observations(keyframe, &found, camera, near, shutter, plane.relief_m2);
            let shutter = shutter.map(|(prior, shutter)| (prior, shutter.rates));
            let keyframe_covariance = &(keyframe.rig_covariance() + plane.tilt_covariance());
            let observations = Observations {
                seen: &observations,
                keyframe_pose: &keyframe.pose,
                keyframe_covariance,
                shutter,
            };
            estimate(camera, observations, near, prior, &config.motion, random)
        };
        let near = settled.unwrap_or(*prediction);
        // A keyframe that deviates from the mount by more than its scatter is still valid for its
        // frames.
        let prior = [prior, prior.reaching(&keyframe.pose)];
        let mut best = |plane: GroundHypothesis| {
            let first = prior.iter().find_map(|prior| Some((measure(&near, prior, plane)?, prior)));
            match first {
                // The rates were those of the predicted pose: once more with those of the measured.
                Some((found, prior)) if learned.skew_is_fitted() => {
                    Some(measure(&found.pose, prior, plane).unwrap_or(found))
                }
                first => first.map(|(found, _)| found),
            }
        };
        let relief_m2 = learned.relief_m2();
        let found = best(GroundHypothesis { relief_m2, is_tilted: false });
        let is_poor = found.as_ref().is_none_or(|found| found.residual_px > POOR_PX);
        if is_poor && relief_m2 == 0.0 && learned.may_see_skew() {
            let rough = best(GroundHypothesis { relief_m2: learned.least_relief_m2(), is_tilted: false });
            let mut tilted = || best(GroundHypothesis { relief_m2: 0.0, is_tilted: true });
            match rough {
                Some(rough)
                    if rough.residual_px < POOR_PX
                        && is_better(&rough, &found, RELIEF_FACTOR)
                        && is_better(&rough, &tilted(), RELIEF_OVER_TILT) =>
                {
                    Some(MotionEstimate { needs_relief: true, ..rough })
                }
                _ => found,
            }
        } else {
            found
        }
    };
    let estimate = estimate.ok_or_else(|| why_not(keyframe, camera, &found, prediction))?;
    let support = estimate.inlier_count() as f64 / keyframe.corners_at_first.max(1) as f64;
    let settled = settled.is_some();
    Ok(Measurement { estimate, prediction: *prediction, found, support, settled, agreement: None })
}

/// Where tracks of flat ground are off by more than this, pixels, it may not be flat, or the
/// shutter rolls, or images are blurred.
pub const POOR_PX: f64 = 0.1;

/// Relief is a freer model: it must lower the residual by this factor. Noise along and across the
/// parallax is alike, so that on flat ground it lowers it by a third; motion blur made that a half.
const RELIEF_FACTOR: f64 = 4.0;

/// The same over a plane with a tilt and a rolling shutter that are not known, which are free, too.
const RELIEF_OVER_TILT: f64 = 2.0;

/// Whether a fit with relief leaves a residual smaller by a factor than that of one without.
fn is_better(rough: &MotionEstimate, flat: &Option<MotionEstimate>, factor: f64) -> bool {
    flat.as_ref().is_none_or(|flat| {
        factor * rough.residual_px < flat.residual_px && rough.inlier_count() >= flat.inlier_count()
    })
}

/// What the ground may be beside the plane z = 0.
#[derive(Clone, Copy)]
struct GroundHypothesis {
    /// Variance of elevations, metres².
    relief_m2: f64,
    /// Whether the keyframe may have had another tilt over it, and the shutter may roll.
    is_tilted: bool,
}

/// Standard deviation of a tilt that was not in the rig file, radians.
const UNKNOWN_TILT: f64 = 0.05;

impl GroundHypothesis {
    /// Covariance of height, roll and pitch of the keyframe.
    fn tilt_covariance(&self) -> Matrix3<f64> {
        let variance = if self.is_tilted { UNKNOWN_TILT * UNKNOWN_TILT } else { 0.0 };
        Matrix3::from_diagonal(&Vector3::new(0.0, variance, variance))
    }
}

/// The paper's mean vector from the last frame to this one.
fn mean(
    keyframe: &Keyframe,
    found: &[Found],
    camera: &Camera,
    last: &GroundPose,
    config: &OdometryConfig,
    random: &mut Random,
) -> Option<MotionEstimate> {
    let on_ground = |pixel: Pixel| -> Option<GroundPoint> {
        camera.ray_from_pixel(pixel).and_then(|ray| last.ground_from_ray(ray))
    };
    let pairs: Vec<(GroundPoint, GroundPoint)> = found
        .iter()
        .map(|f| Some((on_ground(keyframe.corners[f.corner].seen.position)?, on_ground(f.warp.position)?)))
        .collect::<Option<_>>()?;
    let metres_per_pixel = last.height_m / camera.focal_px().0;
    let within_m = config.motion.inlier_px * metres_per_pixel;
    let ((x_m, y_m), variance, inliers) = mean_displacement(&pairs, within_m, &config.motion, random)?;
    let mut covariance = Matrix6::zeros();
    covariance[(0, 0)] = variance;
    covariance[(1, 1)] = variance;
    let count = inliers.iter().filter(|&&a| a).count() as f64;
    Some(MotionEstimate {
        pose: GroundPose { x_m: last.x_m + x_m, y_m: last.y_m + y_m, ..*last },
        covariance,
        by_keyframe: Matrix6::identity(),
        by_prior_tilt: Matrix6x2::zeros(),
        keyframe_error: None,
        inliers,
        residual_px: (2.0 * variance * count).sqrt() / metres_per_pixel,
        residual_correlation: Default::default(),
        rig_evidence: None,
        elevations: Buffer::new(),
        needs_relief: false,
        shutter: None,
    })
}
