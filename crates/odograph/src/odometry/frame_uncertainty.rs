//! How certain the pose of a frame is: its own errors, those of the keyframe that it was measured
//! against, and those that all frames share.

use super::Odometry;
use super::keyframe::{Keyframe, KeyframeUpdate};
use crate::geometry::pose_index::{HEIGHT, PITCH, ROLL};
use crate::geometry::{GroundPose, propagated};
use crate::motion::{MotionEstimate, MotionModel, PoseRates, ShutterEstimate};
use nalgebra::{Matrix6, Matrix6x2};

/// Covariance of a pose by what is independent from keyframe to keyframe, and its derivatives by
/// what all frames share.
#[derive(Debug, Clone, Copy)]
pub(super) struct FrameUncertainty {
    /// Covariance by the noise of the images and the skew of the keyframe.
    pub covariance: Matrix6<f64>,
    /// Covariance by errors of the model.
    pub model_covariance: Matrix6<f64>,
    /// Derivative by the readout time.
    pub by_readout: PoseRates,
    /// Derivative by roll and pitch of the mount.
    pub by_mount_tilt: Matrix6x2<f64>,
}

/// Independent elevations in the view of a keyframe, as many as gravel and undulating ground were
/// measured to have.
const ELEVATIONS_IN_VIEW: f64 = 10.0;

impl Odometry {
    /// What a measured frame tells of its keyframe.
    pub(super) fn keyframe_update(&self, estimate: &MotionEstimate) -> KeyframeUpdate {
        let Some(keyframe) = &self.keyframe else { return KeyframeUpdate::default() };
        let mut update = keyframe.improved_by(estimate);
        if self.keyframes == 1 {
            // The first keyframe was taken to stand as the mount was said to.
            let [of_roll, of_pitch] = self.learned.rig_prior.mount_tilt_variance();
            update.covariance[(ROLL, ROLL)] += of_roll;
            update.covariance[(PITCH, PITCH)] += of_pitch;
            // The rig's height is above the mean elevation in view.
            update.covariance[(HEIGHT, HEIGHT)] += self.learned.relief_m2() / ELEVATIONS_IN_VIEW;
        }
        update
    }

    /// How certain a measured frame is.
    pub(super) fn uncertainty(
        &mut self,
        estimate: &MotionEstimate,
        update: &KeyframeUpdate,
    ) -> FrameUncertainty {
        if let (Some(keyframe), Some(seen)) = (&self.keyframe, &estimate.shutter) {
            self.own_by_readout = by_own_readout(keyframe, seen);
        }
        let uncertainty = match &self.keyframe {
            Some(keyframe) => self.uncertainty_against(keyframe, estimate, update),
            None => FrameUncertainty {
                covariance: estimate.covariance,
                model_covariance: estimate.model_covariance,
                by_readout: PoseRates::zeros(),
                by_mount_tilt: Matrix6x2::zeros(),
            },
        };
        self.by_mount_tilt = uncertainty.by_mount_tilt;
        uncertainty
    }

    /// How certain a frame is that was measured against a keyframe.
    pub(super) fn uncertainty_against(
        &self,
        keyframe: &Keyframe,
        estimate: &MotionEstimate,
        update: &KeyframeUpdate,
    ) -> FrameUncertainty {
        let from_keyframe = |covariance: &Matrix6<f64>| propagated(&estimate.by_keyframe, covariance);
        let own =
            estimate.shutter.as_ref().map_or(self.own_by_readout, |seen| by_own_readout(keyframe, seen));
        FrameUncertainty {
            covariance: from_keyframe(&update.covariance)
                + estimate.covariance
                + keyframe.covariance_by_skew(estimate),
            model_covariance: from_keyframe(&update.model_covariance) + estimate.model_covariance,
            by_readout: estimate.by_keyframe * keyframe.by_readout + own,
            by_mount_tilt: self.mount_tilt_against(keyframe, estimate),
        }
    }

    /// The covariance that is stated of a pose: by all of its errors.
    pub(super) fn stated_covariance(
        &self,
        uncertainty: &FrameUncertainty,
        pose: &GroundPose,
    ) -> Matrix6<f64> {
        uncertainty.covariance
            + uncertainty.model_covariance
            + self.learned.readout_covariance(&uncertainty.by_readout)
            + self.learned.mount_covariance(&uncertainty.by_mount_tilt)
            + self.learned.level_covariance(pose)
            + self.scale_covariance(pose)
    }

    /// How the pose of a frame that was measured against a keyframe changes with roll and pitch of
    /// the mount.
    fn mount_tilt_against(&self, keyframe: &Keyframe, estimate: &MotionEstimate) -> Matrix6x2<f64> {
        if self.config.motion.model != MotionModel::Auto {
            return Matrix6x2::zeros();
        }
        let [_, of_roll, of_pitch] =
            self.learned.rig_prior.prior(&estimate.pose, &self.config.motion).mount_share;
        let share = [of_roll, of_pitch];
        let mut by_prior = self.by_mount_tilt.fixed_rows::<2>(4).into_owned();
        for i in 0..2 {
            by_prior.row_mut(i).scale_mut(1.0 - share[i]);
            by_prior[(i, i)] += share[i];
        }
        estimate.by_keyframe * keyframe.by_mount_tilt + estimate.by_prior_tilt * by_prior
    }
}

/// How the pose of a frame changes with the readout time, that of the keyframe left out.
fn by_own_readout(keyframe: &Keyframe, seen: &ShutterEstimate) -> PoseRates {
    seen.pose_by_keyframe_skew * keyframe.shutter.rates + seen.pose_by_expected_skew * seen.expected_rates
}

impl FrameUncertainty {
    /// Uncertainty of `a + gain (b − a)`, whose covariance by noise is given. Errors of the model
    /// are taken to be the same in both measurements.
    pub fn fused(a: &Self, b: &Self, gain: &Matrix6<f64>, covariance: Matrix6<f64>) -> Self {
        let share = (gain.trace() / 6.0).clamp(0.0, 1.0);
        Self {
            covariance,
            model_covariance: (1.0 - share) * a.model_covariance + share * b.model_covariance,
            by_readout: a.by_readout + gain * (b.by_readout - a.by_readout),
            by_mount_tilt: a.by_mount_tilt + gain * (b.by_mount_tilt - a.by_mount_tilt),
        }
    }
}
