//! The pose of a frame from the corners found: the motion model and the shape of the ground under
//! which they agree best.

use super::super::found_corner::{FoundCorner, FoundCorners};
use super::super::keyframe::Keyframe;
use super::{Measurement, Tracker};
use crate::buffer::Buffer;
use crate::geometry::GroundPose;
use crate::motion::{
    ExpectedRates, MAX_KERB_HEIGHT, MotionEstimate, MotionModel, Observations, PoseRates, Random, RigPrior,
    ShutterPrior, Unevenness, estimate,
};
use crate::trajectory::LossReason;
use nalgebra::{Matrix3, Vector3};

impl Tracker<'_> {
    /// The pose of the frame from the corners found.
    pub(super) fn fit_pose(
        &self,
        corners: FoundCorners,
        prediction: &GroundPose,
        random: &mut Random,
    ) -> Result<Measurement, LossReason> {
        let FoundCorners { found, probe_pose } = corners;
        if found.len() < self.config.motion.minimum_inliers {
            return Err(LossReason::Jump);
        }
        let estimate = if self.config.motion.model == MotionModel::Mean {
            self.mean_motion(&found, prediction, random)
        } else {
            let near = probe_pose.unwrap_or(*prediction);
            PoseFit { near, ..PoseFit::new(self, &found, prediction, random) }.on_likeliest_ground()
        };
        let estimate = estimate.ok_or_else(|| self.reason_of_loss(&found, prediction))?;
        let support = estimate.inlier_count() as f64 / self.keyframe.corners_at_first.max(1) as f64;
        let (refined, fixed) = (probe_pose.is_some(), Buffer::new());
        let (agreement, tiles) = (None, Vec::new());
        Ok(Measurement {
            estimate,
            prediction: *prediction,
            found,
            fixed,
            support,
            refined,
            agreement,
            tiles,
        })
    }
}

/// Fits of one frame under several hypotheses about the ground.
pub(super) struct PoseFit<'a> {
    tracker: &'a Tracker<'a>,
    found: &'a [FoundCorner],
    /// Where the pose is searched for.
    near: GroundPose,
    /// Priors of height and tilt, the likelier first.
    priors: [RigPrior; 2],
    random: &'a mut Random,
    /// The fit with a tilt and a skew that are unknown, once it was needed.
    tilted: Option<Option<MotionEstimate>>,
}

impl<'a> PoseFit<'a> {
    /// Fits about `prediction`.
    pub(super) fn new(
        tracker: &'a Tracker<'a>,
        found: &'a [FoundCorner],
        prediction: &GroundPose,
        random: &'a mut Random,
    ) -> Self {
        let prior = tracker.prior(prediction);
        // A keyframe that deviates from the mount by more than its scatter is still valid for its
        // frames.
        let priors = [prior, prior.reaching(&tracker.keyframe.pose)];
        Self { tracker, found, near: *prediction, priors, random, tilted: None }
    }

    /// The fit with ground as it is known, whose shape is left as it is.
    pub(super) fn on_known_ground(&mut self) -> Option<MotionEstimate> {
        let ground = GroundHypothesis { has_free_shape: false, ..self.known_ground() };
        let (near, [prior, _]) = (self.near, self.priors);
        self.fit_near(&near, &prior, ground)
    }

    /// The fit with ground as it is known; with uneven ground if only that explains the corners.
    fn on_likeliest_ground(&mut self) -> Option<MotionEstimate> {
        let Tracker { keyframe, config, learned, .. } = *self.tracker;
        let known = self.known_ground();
        let flat = self.fit(known);
        let is_flat = known.relief_m2 == 0.0;
        let explains =
            |flat: &MotionEstimate| flat.residual_px <= POOR_PX || is_noise(flat, learned.noise_ratio());
        let is_poor = !flat.as_ref().is_some_and(explains);
        let may_rise = keyframe.may_leave_plane();
        let highest_m2 = (MAX_KERB_HEIGHT * keyframe.pose.height_m).powi(2);
        if may_rise && (is_poor || new_ground_disagrees(keyframe, self.found, flat.as_ref())) {
            let raised = GroundHypothesis { new_ground_m2: highest_m2, ..known };
            let raised = self.fit_if_better(raised, Unevenness::NewGround, &flat);
            if raised.is_some() {
                return raised;
            }
        }
        // A skew that is not known would pass for relief.
        if is_flat && is_poor && learned.may_see_skew() {
            let rough = |relief_m2| GroundHypothesis { relief_m2, ..known };
            let low = self.fit_if_better(rough(learned.least_relief_m2()), Unevenness::Relief, &flat);
            if low.is_some() {
                return low;
            }
            // Elevations of any size would explain a wrong lens, too, but not down to the noise.
            let high = self.fit_if_better(rough(highest_m2), Unevenness::Relief, &flat);
            if high.as_ref().is_some_and(|high| is_noise(high, learned.noise_ratio())) {
                return high;
            }
            // A camera that is carried freely looks at its first ground with a tilt that no rig
            // states.
            if config.motion.model == MotionModel::Auto
                && !self.priors[0].holds_tilt()
                && let Some(tilted) = self.tilted().clone()
                && explains_better(&tilted, &flat, UNEVEN_FACTORS.over_plane)
            {
                return Some(tilted);
            }
        }
        flat
    }

    /// The ground as it is known: rough by as much as was seen.
    fn known_ground(&self) -> GroundHypothesis {
        let relief_m2 = self.tracker.learned.relief_m2();
        GroundHypothesis { relief_m2, new_ground_m2: 0.0, is_tilted: false, has_free_shape: true }
    }

    /// The fit with uneven ground if it explains the corners better than flat ground does, with or
    /// without an unknown tilt.
    fn fit_if_better(
        &mut self,
        ground: GroundHypothesis,
        by: Unevenness,
        flat: &Option<MotionEstimate>,
    ) -> Option<MotionEstimate> {
        let uneven = self.fit(ground)?;
        let learned = self.tracker.learned;
        let factors = if is_noise(&uneven, 1.0) {
            OVER_NOISE
        } else if uneven.residual_px < POOR_PX || is_noise(&uneven, learned.noise_ratio()) {
            UNEVEN_FACTORS
        } else {
            return None;
        };
        let is_better = |flat: &Option<MotionEstimate>, factor: f64| match by {
            Unevenness::Relief => explains_better(&uneven, flat, factor),
            Unevenness::NewGround => explains_better(&uneven, flat, factor) || explains_more(&uneven, flat),
        };
        let is_best = is_better(flat, factors.over_plane) && is_better(self.tilted(), factors.over_tilt);
        is_best.then_some(MotionEstimate { uneven: Some(by), ..uneven })
    }

    /// The fit with flat ground under a keyframe of unknown tilt.
    fn tilted(&mut self) -> &Option<MotionEstimate> {
        if self.tilted.is_none() {
            let ground = GroundHypothesis { is_tilted: true, ..self.known_ground() };
            self.tilted = Some(self.fit(ground));
        }
        self.tilted.as_ref().unwrap_or(&None)
    }

    /// The fit under a hypothesis about the ground.
    fn fit(&mut self, ground: GroundHypothesis) -> Option<MotionEstimate> {
        let (near, priors) = (self.near, self.priors);
        let (found, prior) =
            priors.iter().find_map(|prior| Some((self.fit_near(&near, prior, ground)?, prior)))?;
        if !self.tracker.learned.skew_is_fitted() {
            return Some(found);
        }
        // The rates were those of the predicted pose: once more with those of the measured.
        Some(self.fit_near(&found.pose, prior, ground).unwrap_or(found))
    }

    /// The same about a pose, with which a rolling shutter is corrected.
    fn fit_near(
        &mut self,
        near: &GroundPose,
        prior: &RigPrior,
        ground: GroundHypothesis,
    ) -> Option<MotionEstimate> {
        let Tracker { keyframe, camera, config, learned, .. } = *self.tracker;
        let shutter = learned.shutter_at(camera, near);
        let has_free_shape = ground.has_free_shape && ground.relief_m2 > 0.0;
        let shape = has_free_shape.then(|| learned.shape(keyframe, prior)).flatten();
        // The error of the keyframe's skew is the same in all frames, as that of a slope.
        let of_keyframe = shape.map_or(PoseRates::zeros(), |_| keyframe.rate_variance);
        let frame_shutter = learned.frame_shutter.map(|prior| ShutterPrior {
            applies: prior.applies || ground.is_tilted,
            expected: ExpectedRates {
                rate_variance: prior.expected.rate_variance + of_keyframe,
                ..prior.expected
            },
            ..prior
        });
        let shutter = frame_shutter.as_ref().zip(shutter.as_ref());
        let relief_m2 = (ground.relief_m2, ground.new_ground_m2);
        let (observations, noise_px) = self.tracker.observations(self.found, near, shutter, relief_m2);
        let observations = Observations {
            seen: &observations,
            noise_px,
            keyframe_pose: &keyframe.pose,
            keyframe_covariance: &(keyframe.rig_covariance() + ground.tilt_covariance()),
            shutter: shutter.map(|(prior, shutter)| (prior, shutter.rates)),
            shape: shape.as_ref(),
        };
        estimate(camera, observations, near, prior, &config.motion, self.random)
    }
}

/// Where tracks of flat ground are off by more than this, pixels, and by more than the noise of the
/// images, it may not be flat, or the shutter rolls, or images are blurred.
const POOR_PX: f64 = 0.1;

/// Factors by which a freer model must lower the residual.
struct UnevenFactors {
    over_plane: f64,
    /// Over a plane with a tilt and a rolling shutter that are not known, which are free, too.
    over_tilt: f64,
}

/// Noise along and across the parallax is alike, so that on flat ground elevations lower it by a
/// third; motion blur made that a half.
const UNEVEN_FACTORS: UnevenFactors = UnevenFactors { over_plane: 4.0, over_tilt: 2.0 };

/// The same where what is left is the noise of the images, which is known; by chance it is √2 over
/// a plane. A compromise, chosen on three drives and a gate row: undulating ground under noise of
/// 4 gray levels is missed at 3.2, and blur of 33 ms passes for relief in single frames below.
const OVER_NOISE: UnevenFactors = UnevenFactors { over_plane: 2.8, over_tilt: 1.8 };

/// Residuals up to this multiple of what the images predict are noise. Measured: 0.8 to 1.3 on
/// rendered ground, up to 3 on printed sheets and in lossy video.
const NOISE_RATIO: f64 = 1.35;

/// Where ground is off the plane and taken for it, a few outliers pass for inliers.
const INLIERS_KEPT: f64 = 0.9;

/// Where new ground is off the plane, a model that frees it raises the number of inliers by this
/// factor, if it does not lower the residual.
const INLIERS_GAINED: f64 = 1.25;

/// Whether what a fit leaves is the noise of the images, which leaves a multiple of what white
/// noise would. With elevations it shows in the component of a track across its parallax.
fn is_noise(fit: &MotionEstimate, ratio: f64) -> bool {
    fit.noise_px.is_finite() && fit.residual_px < NOISE_RATIO * ratio * fit.noise_px
}

/// Whether a fit with elevations leaves a residual smaller by a factor than that of one without,
/// and keeps a part of its inliers.
fn explains_better(uneven: &MotionEstimate, flat: &Option<MotionEstimate>, factor: f64) -> bool {
    flat.as_ref().is_none_or(|flat| {
        factor * uneven.residual_px < flat.residual_px
            && uneven.inlier_count() as f64 >= INLIERS_KEPT * flat.inlier_count() as f64
    })
}

/// Whether a fit explains many more tracks than another one.
fn explains_more(uneven: &MotionEstimate, flat: &Option<MotionEstimate>) -> bool {
    flat.as_ref()
        .is_some_and(|flat| uneven.inlier_count() as f64 >= INLIERS_GAINED * flat.inlier_count() as f64)
}

/// Whether as many tracks on new ground disagree with a pose as a freer model must gain.
fn new_ground_disagrees(keyframe: &Keyframe, found: &[FoundCorner], pose: Option<&MotionEstimate>) -> bool {
    let Some(pose) = pose else { return true };
    let disagrees = |(found, agrees): &(&FoundCorner, &bool)| {
        !**agrees && keyframe.corners[found.corner].is_on_new_ground
    };
    let count = found.iter().zip(&pose.inliers).filter(disagrees).count();
    count as f64 >= (INLIERS_GAINED - 1.0) * pose.inlier_count() as f64
}

/// What the ground may be beside the plane z = 0.
#[derive(Clone, Copy)]
struct GroundHypothesis {
    /// Variance of elevations, metres².
    relief_m2: f64,
    /// The same of ground that the keyframe before did not see, in addition.
    new_ground_m2: f64,
    /// Whether the keyframe may have had another tilt over it, and the shutter may roll.
    is_tilted: bool,
    /// Whether the shape of rough ground is estimated, too, where it can be.
    has_free_shape: bool,
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
