//! How certain the pose of a frame is: its own errors, those of the keyframe that it was measured
//! against, and those that all frames share.

use super::Odometry;
use super::keyframe::KeyframeUpdate;
use crate::geometry::pose_index::{HEIGHT, PITCH, ROLL};
use crate::geometry::{GroundPose, propagated};
use crate::motion::{MotionEstimate, MotionModel, PoseRates};
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
        let from_keyframe = |covariance: &Matrix6<f64>| propagated(&estimate.by_keyframe, covariance);
        let (by_skew, by_readout) = self.shutter_errors(estimate);
        FrameUncertainty {
            covariance: from_keyframe(&update.covariance) + estimate.covariance + by_skew,
            model_covariance: from_keyframe(&update.model_covariance) + estimate.model_covariance,
            by_readout,
            by_mount_tilt: self.by_mount_tilt(estimate),
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
    }

    /// What the skew of the keyframe adds to the covariance of a frame, and how the frame's pose
    /// changes with the readout time.
    fn shutter_errors(&mut self, estimate: &MotionEstimate) -> (Matrix6<f64>, PoseRates) {
        let Some(keyframe) = &self.keyframe else { return Default::default() };
        let of_keyframe = estimate.by_keyframe * keyframe.by_readout;
        let Some(seen) = &estimate.shutter else {
            return (Matrix6::zeros(), of_keyframe + self.own_by_readout);
        };
        self.own_by_readout = seen.pose_by_keyframe_skew * keyframe.shutter.rates
            + seen.pose_by_expected_skew * seen.expected_rates;
        (keyframe.covariance_by_skew(estimate), of_keyframe + self.own_by_readout)
    }

    /// How the frame's pose changes with roll and pitch of the mount.
    fn by_mount_tilt(&mut self, estimate: &MotionEstimate) -> Matrix6x2<f64> {
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
        let of_keyframe =
            self.keyframe.as_ref().map_or_else(Matrix6x2::zeros, |keyframe| keyframe.by_mount_tilt);
        self.by_mount_tilt = estimate.by_keyframe * of_keyframe + estimate.by_prior_tilt * by_prior;
        self.by_mount_tilt
    }
}
