//! Frames that could not be measured, and how the ground comes back after them.

use super::candidate::{CONFIRMATIONS, MOST_CONFIRMATIONS, SegmentCandidate};
use super::keyframe::Keyframe;
use super::keyframe_event::Before;
use super::last_pose::LastPose;
use super::tracking::Measurement;
use super::{Odometry, OdometryConfig, texture};
use crate::fixed_pattern::ImageMask;
use crate::image::Pyramid;
use crate::keyframe::EdgeKind;
use crate::motion::Random;
use crate::trajectory::{FrameEstimate, LossReason, TrackStatus};
use nalgebra::Matrix6;
use std::sync::Arc;

impl Odometry {
    /// A frame that could not be measured: begins the map, or waits for the ground to come back.
    pub(super) fn lose(&mut self, pyramid: Pyramid, time_s: f64, reason: LossReason) -> FrameEstimate {
        let bare = texture::is_bare(pyramid.base());
        if self.last.is_none() && !bare {
            return self.begin(pyramid, time_s);
        }
        self.tracks.clear();
        self.lost_frames += 1;
        self.learned.rig_prior.interrupt();
        let reason = self.cause(&pyramid, bare, reason);
        let shows_nothing = matches!(reason, LossReason::Dark | LossReason::Bare);
        if self.standing.is_suspected() {
            // What could be found again would be what stands still, too.
            self.candidate = None;
            self.spare = Some(pyramid);
            return self.lost(time_s, reason);
        }
        match self.confirm_candidate(&pyramid, time_s) {
            Some(found) if self.candidate_is_accepted() => return self.begin_segment(pyramid, time_s, found),
            Some(found) if found.support < self.enough_support() => {
                let next = self.candidate.as_ref().and_then(|candidate| {
                    self.textured_keyframe(pyramid, &candidate.last, candidate.keyframe.mask.as_ref())
                });
                if let (Some(candidate), Some(next)) = (&mut self.candidate, next) {
                    candidate.move_on(next, self.frames);
                }
            }
            Some(_) => {}
            // An image without light shows nothing that speaks against the candidate.
            None if self.candidate.is_some() && shows_nothing => {}
            None => {
                // Placed where the camera would be at constant velocity.
                let last = match &self.last {
                    Some(last) => last.extrapolated_over_gap(time_s),
                    None => LastPose::still(time_s, self.first_pose, Matrix6::zeros()),
                };
                let keyframe = self.textured_keyframe(pyramid, &last, self.fixed.mask());
                self.candidate = keyframe.map(|mut keyframe| {
                    self.expose_first(&mut keyframe, time_s);
                    SegmentCandidate::new(keyframe, self.frames, last)
                });
            }
        }
        self.lost(time_s, reason)
    }

    /// A keyframe from a frame at the pose of `last`; `None` if the frame has too little texture.
    fn textured_keyframe(
        &self,
        pyramid: Pyramid,
        last: &LastPose,
        mask: Option<&Arc<ImageMask>>,
    ) -> Option<Keyframe> {
        let (camera, OdometryConfig { detection, motion, .. }) = (&self.camera, &self.config);
        let mut keyframe = Keyframe::new(pyramid, last.pose, last.covariance, mask, camera, detection);
        keyframe.can_be_followed(2 * motion.minimum_inliers).then_some(keyframe)
    }

    fn lost(&self, time_s: f64, reason: LossReason) -> FrameEstimate {
        FrameEstimate {
            frame: self.frames,
            time_s,
            status: TrackStatus::Lost { reason },
            estimate: None,
            tracks: 0,
            inliers: 0,
            residual_px: 0.0,
            keyframe: false,
            segment: self.segment,
        }
    }

    /// Why a frame was lost, as far as the image itself shows; otherwise what the measurement said.
    pub(super) fn cause(&self, pyramid: &Pyramid, bare: bool, reason: LossReason) -> LossReason {
        match (&self.keyframe, reason) {
            // Some ground may show through the noise; the light is what is missing.
            _ if texture::is_dark(pyramid.base()) => LossReason::Dark,
            _ if bare => LossReason::Bare,
            (Some(keyframe), LossReason::Jump | LossReason::NotPlanar)
                if texture::is_blurred(pyramid, &keyframe.pyramid) =>
            {
                LossReason::Blur
            }
            _ => reason,
        }
    }

    /// The measurement of a lost frame against the candidate, if there is one.
    pub(super) fn confirm_candidate(&mut self, pyramid: &Pyramid, time_s: f64) -> Option<Measurement> {
        // How the frame is exposed is predicted by the frames that confirmed the candidate.
        let last = self.candidate.as_ref().map(|candidate| &candidate.last);
        self.learned.predict_shutter(last, time_s, self.motion.at(time_s));
        let candidate = self.candidate.as_ref()?;
        let tracker = self.tracker(&candidate.keyframe, pyramid);
        let found = candidate.measure(&tracker, time_s, &mut Random::new(self.frames))?;
        if self.goes_along(&candidate.keyframe.pose, &found.estimate.pose) {
            return None;
        }
        self.candidate.as_mut()?.confirm(time_s, &found.estimate);
        Some(found)
    }

    /// Whether enough frames agreed with the candidate. Known ground is preferred to a new segment.
    pub(super) fn candidate_is_accepted(&self) -> bool {
        let needed =
            if self.recovery.is_exhausted(&self.memory) { CONFIRMATIONS } else { MOST_CONFIRMATIONS };
        self.candidate.as_ref().is_some_and(|candidate| candidate.is_confirmed(needed))
    }

    /// The ground is back, but how the camera came here was not measured: a new segment.
    pub(super) fn begin_segment(
        &mut self,
        pyramid: Pyramid,
        time_s: f64,
        measurement: Measurement,
    ) -> FrameEstimate {
        // The very first ground is not a new segment.
        self.segment += usize::from(self.last.is_some());
        let last = self.last.take();
        if let Some(mut candidate) = self.candidate.take() {
            let before = last.and_then(|last| self.across_the_gap(&last, &candidate.keyframe));
            let model_covariance = self.keyframe.as_ref().map(|before| before.model_covariance);
            candidate.keyframe.model_covariance = model_covariance.unwrap_or_default();
            self.number(&mut candidate.keyframe, candidate.made, before);
            self.replace_keyframe(candidate.keyframe);
            self.last = Some(candidate.last);
        }
        self.memory.close_segment();
        self.filter = None;
        self.accept(pyramid, time_s, measurement)
    }

    /// Relative pose of the first keyframe after a gap and the last one before it.
    pub(super) fn across_the_gap(&self, last: &LastPose, next: &Keyframe) -> Option<Before> {
        let before = self.keyframe.as_ref()?;
        // The gap made the position less certain; height and tilt were measured anew and may be
        // more certain than before.
        let mut covariance = next.covariance - self.propagated_covariance(&last.pose);
        for k in 3..6 {
            covariance.row_mut(k).fill(0.0);
            covariance.column_mut(k).fill(0.0);
            covariance[(k, k)] = next.covariance[(k, k)];
        }
        let (pose, frame) = (before.pose, next.pose);
        Some(Before { id: before.id?, pose, frame, covariance, kind: EdgeKind::Gap })
    }
}
