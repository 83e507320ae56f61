//! Choice of the next keyframe: an older one if the camera has returned to it, otherwise a new one.

use super::found_corner::FoundCorner;
use super::frame_uncertainty::FrameUncertainty;
use super::keyframe::{Keyframe, KeyframeUpdate};
use super::keyframe_event::Before;
use super::{Odometry, tracking};
use crate::geometry::GroundPose;
use crate::image::Pyramid;
use crate::keyframe::{EdgeKind, KeyframeId};
use crate::motion::{MotionEstimate, MotionModel, PoseRates, Random};
use nalgebra::Matrix6;

/// A new keyframe is also made if less than this fraction of the corners is predicted to be in view
/// in the next frame.
const FORESEEN_SUPPORT: f64 = 0.3;

/// An older keyframe is accepted no further from its predicted place than this, pixels, beside the
/// two of any revisit: a checkerboard whose period was 12 px was taken up one square off with six.
/// What lies further off is left to loop closing, which compares rival places.
const UNAMBIGUOUS_PX: f64 = 2.0;

/// Number of frames of a keyframe after which the next one is prepared in two halves. A camera that
/// needs new keyframes all the time needs all corners at once.
const LEISURE_FRAMES: u64 = 8;

impl Odometry {
    /// Whether too little of the keyframe will be visible in the next frame, by the predicted
    /// motion.
    pub(super) fn leaves_the_keyframe(&self, found: &[FoundCorner], time_s: f64) -> bool {
        let (Some(keyframe), Some(last)) = (&self.keyframe, &self.last) else { return false };
        let next = last.extrapolated(time_s + last.step_s);
        tracking::still_seen(keyframe, &self.camera, found, &next)
            < FORESEEN_SUPPORT * self.learned.findable()
    }

    /// Changes the keyframe: to an older one if the camera has returned to it, otherwise to this
    /// frame.
    pub(super) fn change_keyframe(
        &mut self,
        pyramid: Pyramid,
        time_s: f64,
        estimate: &MotionEstimate,
        update: &KeyframeUpdate,
        uncertainty: &FrameUncertainty,
    ) {
        let FrameUncertainty { covariance, model_covariance, by_readout, by_mount_tilt } = *uncertainty;
        let pose = estimate.pose;
        self.learned.rig_prior.change_keyframe();
        let pyramid = match self.revisit(pyramid, estimate, &covariance) {
            Ok(()) => return,
            Err(pyramid) => pyramid,
        };
        let mut next =
            Keyframe::to_be_prepared(pyramid, pose, covariance, self.fixed.mask(), &self.config.detection);
        if !next.can_be_followed(2 * self.config.motion.minimum_inliers) {
            return; // better the rest of the old one than nothing
        }
        let before = self.keyframe.as_ref().and_then(|before| {
            let kind = EdgeKind::Odometry;
            // The edge starts from the keyframe as this frame corrects it.
            let pose = GroundPose::from_vector(&(before.pose.to_vector() + update.moved));
            let covariance = before.relative_covariance(estimate, self.config.motion.model);
            Some(Before { id: before.id?, pose, covariance, kind })
        });
        next.in_halves = self.frames - self.serves_since >= LEISURE_FRAMES;
        next.model_covariance = model_covariance;
        next.by_readout = by_readout;
        next.moving = self.keyframe.as_ref().map(Keyframe::moving_ground).unwrap_or_default();
        next.by_mount_tilt = by_mount_tilt;
        let relief_m2 = self.learned.relief_m2();
        next.set_surface(self.keyframe.as_ref().and_then(|before| before.surface_now(relief_m2)));
        if let Some(before) = &self.keyframe {
            next.set_seen_before(&before.pose);
        }
        self.expose(&mut next, estimate);
        self.number(&mut next, (self.frames, time_s), before);
        self.serve_from_here(next.id, pose);
        if let Some(before) = self.keyframe.replace(next) {
            self.memory.remember(before.retire());
        }
    }

    /// Reuses an older keyframe in view if the pose measured against it agrees with the present
    /// one. Returns the image if there is none.
    pub(super) fn revisit(
        &mut self,
        pyramid: Pyramid,
        estimate: &MotionEstimate,
        covariance: &Matrix6<f64>,
    ) -> std::result::Result<(), Pyramid> {
        let pose = &estimate.pose;
        if self.config.motion.model == MotionModel::Mean {
            return Err(pyramid);
        }
        let Some(old) = self.memory.take_best(&self.camera, pose, self.config.keyframe.revisit) else {
            return Err(pyramid);
        };
        let mut random = Random::new(self.frames);
        let pixel_m = pose.height_m / self.camera.focal_px().0;
        let spread_m = 4.0 * (covariance[(0, 0)] + covariance[(1, 1)]).sqrt();
        let position_m = spread_m.min(UNAMBIGUOUS_PX * pixel_m) + 2.0 * pixel_m;
        let heading_rad = 4.0 * covariance[(2, 2)].sqrt() + 0.005;
        // What is further off would not be accepted.
        let off_px = position_m / pixel_m + 0.5 * heading_rad * self.camera.width() as f64;
        let measured = tracking::measure_near(
            &old,
            &pyramid,
            &self.camera,
            pose,
            off_px,
            &self.config,
            &self.learned,
            &mut random,
        );
        let agreed = measured.ok().filter(|m| {
            let found = &m.estimate.pose;
            m.support >= self.enough_support()
                && (found.x_m - pose.x_m).hypot(found.y_m - pose.y_m) < position_m
                && (found.heading_rad - pose.heading_rad).abs() < heading_rad
        });
        let Some(measurement) = agreed else {
            self.memory.put_back(old);
            return Err(pyramid);
        };
        let found = measurement.estimate.pose;
        if let Some(present) = &self.keyframe {
            let by_present = present.relative_covariance(estimate, self.config.motion.model);
            let by_old = old.relative_covariance(&measurement.estimate, self.config.motion.model);
            self.record_revisit(&old, (pose, &by_present), (&found, &by_old));
        }
        self.serve_from_here(old.id, found);
        if let Some(before) = self.keyframe.replace(old) {
            self.memory.remember(before.retire());
        }
        // The revisited place is more certain than the path since: position and filter are
        // corrected, the velocity stays.
        if let Some(last) = &mut self.last {
            last.pose = found;
        }
        if let Some(filter) = &mut self.filter {
            filter.shift([found.x_m - pose.x_m, found.y_m - pose.y_m, found.heading_rad - pose.heading_rad]);
        }
        Ok(())
    }

    /// Makes another keyframe the reference of the following frames; its own pose of the present
    /// frame is `pose`.
    pub(super) fn serve_from_here(&mut self, keyframe: Option<KeyframeId>, pose: GroundPose) {
        self.serves_since = self.frames;
        self.keyframe_off = PoseRates::zeros();
        self.own_by_readout = PoseRates::zeros();
        self.learned.end_shutter_keyframe();
        if let (Some(reference), Some(keyframe)) = (&mut self.reference, keyframe) {
            reference.next = Some((keyframe, pose));
        }
    }
}
