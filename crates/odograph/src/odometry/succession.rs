//! Choice of the next keyframe: an older one if the camera has returned to it, otherwise a new one.

use super::Odometry;
use super::ambiguity::CHANCE_INLIER_RATIO;
use super::cover::Trial;
use super::found_corner::FoundCorner;
use super::frame_uncertainty::FrameUncertainty;
use super::keyframe::{Keyframe, KeyframeUpdate};
use super::keyframe_event::Before;
use super::tracking::{self, Measurement};
use crate::geometry::{GroundPose, propagated};
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

/// Result of measuring a frame against an older keyframe, with the image of the frame.
enum Revisit {
    /// The older keyframe becomes the reference again.
    BecomesReference(Pyramid),
    /// Too little of the older keyframe is in view, but the measurement improves the frame's pose.
    Improves(Pyramid, Box<(GroundPose, FrameUncertainty)>),
    /// No older keyframe is in view, or the measurement does not agree with the present one.
    No(Pyramid),
}

/// Least part of an older keyframe that must be in view for a frame to be measured against it.
/// Chosen on variants of one real flight, where 0.3 was about as good
/// (`docs/math/frame-pose.md`).
const LEAST_OVERLAP: f64 = 0.5;

/// The nearest covariance to a symmetric matrix.
fn positive_part(matrix: &Matrix6<f64>) -> Matrix6<f64> {
    let mut eigen = (0.5 * (matrix + matrix.transpose())).symmetric_eigen();
    eigen.eigenvalues.apply(|value| *value = value.max(0.0));
    eigen.recompose()
}

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
    /// frame, on trial if it `may_be_covered`. Returns the image if it is no part of a keyframe.
    pub(super) fn change_keyframe(
        &mut self,
        pyramid: Pyramid,
        time_s: f64,
        estimate: &MotionEstimate,
        update: &KeyframeUpdate,
        uncertainty: &FrameUncertainty,
        may_be_covered: bool,
    ) -> Option<Pyramid> {
        self.learned.rig_prior.change_keyframe();
        let (pyramid, improved) = match self.revisit(pyramid, estimate, uncertainty) {
            Revisit::BecomesReference(pyramid) => return Some(pyramid),
            Revisit::Improves(pyramid, improved) => (pyramid, Some(improved)),
            Revisit::No(pyramid) => (pyramid, None),
        };
        let (pose, uncertainty) = improved.map_or((estimate.pose, *uncertainty), |improved| *improved);
        let FrameUncertainty { covariance, model_covariance, by_readout, by_mount_tilt } = uncertainty;
        let mut next =
            Keyframe::to_be_prepared(pyramid, pose, covariance, self.fixed.mask(), &self.config.detection);
        if let Some(stale) = &self.stale {
            next.leave_out(stale, &self.config.detection);
        }
        if !next.can_be_followed(2 * self.config.motion.minimum_inliers) {
            return Some(next.pyramid); // better the rest of the old one than nothing
        }
        let before = self.keyframe.as_ref().and_then(|before| {
            let kind = EdgeKind::Odometry;
            // The edge starts from the keyframe as this frame corrects it.
            let pose = GroundPose::from_vector(&(before.pose.to_vector() + update.moved));
            let covariance = before.relative_covariance(estimate, self.config.motion.model);
            Some(Before { id: before.id?, pose, frame: estimate.pose, covariance, kind })
        });
        next.in_halves = self.frames - self.reference_since >= LEISURE_FRAMES;
        next.model_covariance = model_covariance;
        next.by_readout = by_readout;
        next.moving = self.keyframe.as_ref().map(Keyframe::moving_ground).unwrap_or_default();
        next.by_mount_tilt = by_mount_tilt;
        let relief_m2 = self.learned.relief_m2();
        next.set_surface(self.keyframe.as_ref().and_then(|before| before.surface_now(relief_m2)));
        if let Some(before) = self.keyframe.as_ref().filter(|_| self.learned.fits_ground()) {
            next.set_seen_before(&before.pose);
        }
        self.expose(&mut next, estimate);
        let made = (self.frames, time_s);
        next.was_on_trial = may_be_covered;
        let trial = if may_be_covered {
            next.id = Some(self.next_id());
            Some(Trial { made, before })
        } else {
            self.number(&mut next, made, before);
            None
        };
        self.set_reference(next.id, pose);
        self.replace_keyframe(next);
        self.trial = trial;
        None
    }

    /// Measures the frame against an older keyframe in view. If that agrees with the present one,
    /// the older one serves for the following frames or, if too little of it is in view, improves
    /// the pose of this one.
    fn revisit(
        &mut self,
        pyramid: Pyramid,
        estimate: &MotionEstimate,
        uncertainty: &FrameUncertainty,
    ) -> Revisit {
        let (pose, covariance) = (&estimate.pose, &uncertainty.covariance);
        if self.config.motion.model == MotionModel::Mean {
            return Revisit::No(pyramid);
        }
        let parts = (LEAST_OVERLAP, self.config.keyframe.revisit);
        let Some((overlap, old)) = self.memory.take_best(&self.camera, pose, parts) else {
            return Revisit::No(pyramid);
        };
        let pixel_m = pose.height_m / self.camera.focal_px().0;
        let spread_m = 4.0 * (covariance[(0, 0)] + covariance[(1, 1)]).sqrt();
        let position_m = spread_m.min(UNAMBIGUOUS_PX * pixel_m) + 2.0 * pixel_m;
        let heading_rad = 4.0 * covariance[(2, 2)].sqrt() + 0.005;
        // What is further off would not be accepted.
        let off_px = position_m / pixel_m + 0.5 * heading_rad * self.camera.width() as f64;
        let random = &mut Random::new(self.frames);
        let measured = self.tracker(&old, &pyramid).measure_near(pose, off_px, random);
        let agrees = |m: &Measurement| {
            let found = &m.estimate.pose;
            m.inlier_ratio(&old, &self.camera) >= CHANCE_INLIER_RATIO * self.learned.usual_inlier_ratio()
                && found.distance_m(pose) < position_m
                && (found.heading_rad - pose.heading_rad).abs() < heading_rad
        };
        let Some(measurement) = measured.ok().filter(agrees) else {
            self.memory.remember(old);
            return Revisit::No(pyramid);
        };
        let by_old = &measurement.estimate;
        if let Some(present) = &self.keyframe {
            let by_present = present.relative_covariance(estimate, self.config.motion.model);
            let covariance = old.relative_covariance(by_old, self.config.motion.model);
            self.record_revisit(&old, (pose, &by_present), (&by_old.pose, &covariance));
        }
        let becomes_reference =
            overlap >= self.config.keyframe.revisit && measurement.support >= self.enough_support();
        let result = if becomes_reference {
            let found = by_old.pose;
            self.set_reference(old.id, found);
            self.replace_keyframe(old);
            (found, Revisit::BecomesReference(pyramid))
        } else {
            let improved = self.improved_by_older(&old, by_old, (pose, uncertainty));
            self.memory.remember(old);
            (improved.0, Revisit::Improves(pyramid, Box::new(improved)))
        };
        let (found, revisit) = result;
        // The revisited place is more certain than the path since: position and filter are
        // corrected, the velocity stays.
        if let Some(last) = &mut self.last {
            last.pose = found;
        }
        if let Some(filter) = &mut self.filter {
            filter.shift([found.x_m - pose.x_m, found.y_m - pose.y_m, found.heading_rad - pose.heading_rad]);
        }
        revisit
    }

    /// The pose measured against the present keyframe, fused with the one measured against an older
    /// keyframe. Both contain the error of the older keyframe.
    fn improved_by_older(
        &self,
        old: &Keyframe,
        by_old: &MotionEstimate,
        (pose, present): (&GroundPose, &FrameUncertainty),
    ) -> (GroundPose, FrameUncertainty) {
        let update = old.improved_by(by_old);
        let older = self.uncertainty_against(old, by_old, &update);
        let moved = by_old.by_keyframe * update.moved;
        let moved = PoseRates::new(moved[0], moved[1], moved[2], 0.0, 0.0, 0.0);
        let common = propagated(&by_old.by_keyframe, &update.covariance);
        let since = positive_part(&(present.covariance - common));
        let own = older.covariance - common;
        let Some(information) = (since + own).try_inverse() else { return (*pose, *present) };
        let gain = since * information;
        let covariance = common + since - gain * since;
        let difference = by_old.pose.to_vector() + moved - pose.to_vector();
        let improved = GroundPose::from_vector(&(pose.to_vector() + gain * difference));
        (
            improved,
            FrameUncertainty::fused(present, &older, &gain, 0.5 * (covariance + covariance.transpose())),
        )
    }

    /// Replaces the present keyframe, which is remembered.
    pub(super) fn replace_keyframe(&mut self, keyframe: Keyframe) {
        self.trial = None;
        if let Some(before) = self.keyframe.replace(keyframe) {
            self.memory.remember(before);
        }
    }

    /// Makes another keyframe the reference of the following frames; its own pose of the present
    /// frame is `pose`.
    pub(super) fn set_reference(&mut self, keyframe: Option<KeyframeId>, pose: GroundPose) {
        self.reference_since = self.frames;
        self.keyframe_off = PoseRates::zeros();
        self.own_by_readout = PoseRates::zeros();
        if let (Some(reference), Some(keyframe)) = (&mut self.reference, keyframe) {
            reference.next = Some((keyframe, pose));
        }
    }
}
