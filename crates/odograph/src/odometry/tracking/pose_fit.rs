//! The pose of a frame from the corners found: the motion model and the shape of the ground under
//! which they agree best.

use super::super::OdometryConfig;
use super::super::keyframe::Keyframe;
use super::super::learned::Learned;
use super::Measurement;
use super::mean_motion::mean_motion;
use super::observations::observations;
use super::search::FoundCorners;
use super::visibility::reason_of_loss;
use crate::camera::Camera;
use crate::geometry::GroundPose;
use crate::motion::{MotionEstimate, MotionModel, Observations, Random, RigPrior, ShutterPrior, estimate};
use crate::trajectory::LossReason;
use nalgebra::{Matrix3, Vector3};

/// The pose of a frame from the corners found.
pub(super) fn fit_pose(
    keyframe: &Keyframe,
    corners: FoundCorners,
    camera: &Camera,
    prediction: &GroundPose,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> Result<Measurement, LossReason> {
    let FoundCorners { found, probe_pose } = corners;
    if found.len() < config.motion.minimum_inliers {
        return Err(LossReason::Jump);
    }
    let estimate = if config.motion.model == MotionModel::Mean {
        mean_motion(keyframe, &found, camera, prediction, config, random)
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
        let near = probe_pose.unwrap_or(*prediction);
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
    let estimate = estimate.ok_or_else(|| reason_of_loss(keyframe, camera, &found, prediction))?;
    let support = estimate.inlier_count() as f64 / keyframe.corners_at_first.max(1) as f64;
    let refined = probe_pose.is_some();
    Ok(Measurement { estimate, prediction: *prediction, found, support, refined, agreement: None })
}

/// Where tracks of flat ground are off by more than this, pixels, it may not be flat, or the
/// shutter rolls, or images are blurred.
const POOR_PX: f64 = 0.1;

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
