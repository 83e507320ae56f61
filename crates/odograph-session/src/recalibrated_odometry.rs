//! Odometry of a source that is read once, which recalibrates itself on the way.

use crate::found::{FoundLens, FoundMount};
use crate::plan::RunPlan;
use odograph::camera::Rig;
use odograph::error::Result;
use odograph::fixed_pattern::ImageMask;
use odograph::motion::MotionModel;
use odograph::mounting::OnlineCalibration;
use odograph::odometry::{KeyframeEvent, Odometry};
use odograph::pose_frame::PoseFrames;
use odograph::trajectory::FrameEstimate;
use odograph_video::Frame;
use std::sync::Arc;

/// An odometry, its calibration where that may change from frame to frame, and the frames whose
/// poses are written.
pub struct RecalibratedOdometry {
    pub odometry: Odometry,
    pub pose_frames: PoseFrames,
    calibration: Option<OnlineCalibration>,
    /// The rig from a frame on, at each recalibration.
    pub recalibrated: Vec<(u64, Rig)>,
}

impl RecalibratedOdometry {
    /// Of a source that can be read again, which is rather tracked again: nothing recalibrates it.
    pub fn fixed(plan: &RunPlan) -> Result<Self> {
        let mut odometry = plan.odometry()?;
        odometry.record_keyframes();
        let pose_frames = plan.pose_frame()?.into();
        Ok(Self { odometry, pose_frames, calibration: None, recalibrated: Vec::new() })
    }

    /// Of a source that is read once. The lens is kept if `lens_is_known`; nothing is calibrated
    /// where the plan fixes the motion model.
    pub fn online(plan: &RunPlan, lens_is_known: bool) -> Result<Self> {
        let calibration = (plan.odometry.motion.model == MotionModel::Auto)
            .then(|| OnlineCalibration::new(&plan.camera, &plan.rig, lens_is_known));
        Ok(Self { calibration, ..Self::fixed(plan)? })
    }

    /// Begins with what earlier sessions of a map have found in the images that is not ground.
    pub fn expecting(self, mask: Option<&Arc<ImageMask>>) -> Self {
        match mask {
            Some(mask) => Self { odometry: self.odometry.with_fixed(mask), ..self },
            None => self,
        }
    }

    /// The estimate of the next frame, and what happened to the keyframes.
    pub fn process(&mut self, frame: &Frame) -> Result<(FrameEstimate, Vec<KeyframeEvent>)> {
        let estimate = self.odometry.process(frame.gray.clone(), frame.time_s)?;
        let estimate = FrameEstimate { frame: frame.number, ..estimate };
        let events = self.odometry.take_keyframe_events();
        if let Some(calibration) = &mut self.calibration
            && calibration.watch(&frame.gray, &estimate, &mut self.odometry)?
        {
            let (next, rig) = (frame.number + 1, calibration.rig());
            self.pose_frames.recalibrate(next, &rig);
            self.recalibrated.push((next, rig));
        }
        Ok((estimate, events))
    }

    /// Mount and lens, where they were found to differ from the plan.
    pub fn found(&self, plan: &RunPlan) -> (Option<FoundMount>, Option<FoundLens>) {
        let found = self.calibration.as_ref().and_then(OnlineCalibration::found);
        (FoundMount::of(&plan.rig, found), FoundLens::of(&plan.camera, found))
    }
}
