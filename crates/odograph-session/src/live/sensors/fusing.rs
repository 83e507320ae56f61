//! Fusion of a live run: what is published, mapped and kept are the poses of camera and sensors
//! together.

use super::LiveSensors;
use nalgebra::{Matrix3, Matrix6};
use odograph::filter::fusion::{FusedFrame, OnlineFusion, SensorCalibration, SensorKind, Sensors};
use odograph::geometry::pose_index::LN_SCALE;
use odograph::geometry::{GroundPose, PlaneTransform, Se2, Sim2, propagated};
use odograph::keyframe::relative_pose::{compose, inverse, motion_covariance, relative_motion};
use odograph::keyframe::{EdgeKind, MapEdge};
use odograph::odometry::{FrameReference, KeyframeEvent, NewKeyframe};
use odograph::trajectory::FrameEstimate;
use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::thread;
use std::time::Instant;

/// Frames of this time are what sensors are calibrated against, seconds: longer follows a change of
/// temperature later, shorter knows scale and mounting less well.
const WINDOW_S: f64 = 60.0;
/// Time before the first calibration, seconds, and how much later the next is in comparison.
const FIRST_S: f64 = 2.2;
const LATER: f64 = 1.3;
/// Longest time between calibrations, seconds.
const EVERY_S: f64 = 10.0;
/// Clock offset of a sensor, and time before a gap that it is compared with the camera, seconds.
const BEFORE_GAP_S: f64 = 3.5;

/// Fuses the frames of a live run with its sensors.
pub struct LiveFusion {
    sensors: LiveSensors,
    fusion: OnlineFusion,
    calibration: SensorCalibration,
    /// Frames of the camera alone.
    recent: VecDeque<FrameEstimate>,
    begun_s: Option<f64>,
    next_s: f64,
    calibrating: Option<Receiver<SensorCalibration>>,
    /// Sensors that the newest calibration has rejected, and those of which that was said.
    rejected: Vec<SensorKind>,
    told: Vec<SensorKind>,
    news: Vec<String>,
    /// Time of the newest frame with a pose of the camera, seconds.
    tracked_s: f64,
}

impl LiveFusion {
    pub fn new(sensors: LiveSensors) -> Self {
        Self {
            sensors,
            fusion: OnlineFusion::default(),
            calibration: SensorCalibration::default(),
            recent: VecDeque::new(),
            begun_s: None,
            next_s: f64::NEG_INFINITY,
            calibrating: None,
            rejected: Vec::new(),
            told: Vec::new(),
            news: Vec::new(),
            tracked_s: f64::NEG_INFINITY,
        }
    }

    /// Tells when a frame was captured, and its time, seconds.
    pub fn frame(&self, at: Instant, time_s: f64) {
        self.sensors.frame(at, time_s);
    }

    /// The frame after fusion, a lost one with its dead-reckoned pose where there is one; what
    /// happened to the keyframes, and what the frame was measured against, move with it.
    pub fn fuse(
        &mut self,
        estimate: FrameEstimate,
        events: &mut [KeyframeEvent],
        reference: &mut Option<FrameReference>,
    ) -> FrameEstimate {
        if self.sensors.is_empty() {
            return estimate;
        }
        self.calibrate(&estimate);
        let is_needed = estimate.estimate.is_none()
            || self.recent.back().is_some_and(|one| one.segment != estimate.segment);
        let sensors = match is_needed {
            true => self.sensors.since(self.tracked_s - BEFORE_GAP_S),
            false => Cow::Owned(Sensors::default()),
        };
        if estimate.estimate.is_some() {
            self.tracked_s = estimate.time_s;
        }
        let fused = self.fusion.add(&estimate, &sensors);
        if fused.distrusted {
            self.news.push(format!(
                "the sensors contradict the camera just before it was lost at {:.1} s: they are not used until it sees the ground again",
                estimate.time_s
            ));
        }
        // Also while the camera sees nothing, however long.
        while self.recent.front().is_some_and(|first| first.time_s < estimate.time_s - WINDOW_S) {
            self.recent.pop_front();
        }
        self.recent.push_back(estimate);
        let world = Sim2::rigid(&fused.fused_from_odometry);
        if world == Sim2::IDENTITY {
            return fused.frame;
        }
        for event in events {
            if let KeyframeEvent::Made(keyframe) = event {
                place(keyframe, &world, &fused);
            }
        }
        if let Some(FrameReference { next: Some((_, pose)), .. }) = reference {
            *pose = world.apply_to_pose(pose);
        }
        fused.frame
    }

    /// Calibrates the sensors from time to time, on a thread unless the result must not depend on
    /// its speed.
    fn calibrate(&mut self, frame: &FrameEstimate) {
        let begun_s = *self.begun_s.get_or_insert(frame.time_s);
        if self.next_s == f64::NEG_INFINITY {
            self.next_s = begun_s + FIRST_S;
        }
        match self.calibrating.as_ref().map(Receiver::try_recv) {
            Some(Ok(calibration)) => self.use_calibration(calibration),
            Some(Err(TryRecvError::Empty)) => return,
            Some(Err(TryRecvError::Disconnected)) => self.calibrating = None,
            None => {}
        }
        if frame.time_s < self.next_s || frame.estimate.is_none() {
            return;
        }
        self.next_s = (begun_s + LATER * (frame.time_s - begun_s)).min(frame.time_s + EVERY_S);
        let frames: Vec<FrameEstimate> = self.recent.iter().cloned().collect();
        let sensors = self.sensors.since(frame.time_s - WINDOW_S - BEFORE_GAP_S);
        if self.sensors.is_recorded() {
            let calibration = SensorCalibration::of(&frames, &sensors);
            self.use_calibration(calibration);
            return;
        }
        let sensors = sensors.into_owned();
        let (sender, receiver) = channel();
        self.calibrating = Some(receiver);
        thread::spawn(move || drop(sender.send(SensorCalibration::of(&frames, &sensors))));
    }

    fn use_calibration(&mut self, calibration: SensorCalibration) {
        self.calibrating = None;
        // Twice in a row: the first seconds of a drive may be unlike the others.
        let before = std::mem::take(&mut self.rejected);
        for (sensor, reason) in calibration.rejected().iter().filter(|(_, reason)| !reason.is_preliminary()) {
            if before.contains(sensor) && !self.told.contains(sensor) {
                self.told.push(*sensor);
                self.news
                    .push(format!("the {sensor} is not used for the poses that are published: {reason}"));
            }
            self.rejected.push(*sensor);
        }
        self.calibration = calibration.after(&self.calibration);
        self.fusion.calibrate(self.calibration.clone());
    }

    /// Sentences since the last call.
    pub fn take_news(&mut self) -> Vec<String> {
        let mut news = self.sensors.take_news();
        news.append(&mut self.news);
        news
    }

    /// All readings, and sentences about what was left out.
    pub fn finish(&self) -> (Sensors, Vec<String>) {
        self.sensors.finish()
    }
}

/// Moves a new keyframe along with its segment. The first of a segment that the sensors placed is
/// tied to the one before as they say.
fn place(keyframe: &mut NewKeyframe, world: &Sim2, fused: &FusedFrame) {
    let measured = keyframe.pose;
    keyframe.pose = world.apply_to_pose(&measured);
    let turned = Se2::rotation(world.heading_rad).product_by_right();
    rotate(&mut keyframe.covariance, &turned);
    rotate(&mut keyframe.systematic, &turned);
    if let Some(known) = &fused.frame.estimate {
        let own = known.covariance.fixed_view::<3, 3>(0, 0) - known.measured.covariance;
        keyframe.covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&own);
    }
    if let (Some((before_gap, gap)), Some(tie)) = (&fused.bridged, &mut keyframe.tie)
        && tie.kind == EdgeKind::Gap
    {
        across(tie, &measured, &keyframe.pose, &Sim2::rigid(before_gap), gap);
    }
}

/// The tie across a gap, of which the sensors know more than the camera's velocity before it.
fn across(
    tie: &mut MapEdge,
    measured: &GroundPose,
    placed: &GroundPose,
    before_gap: &Sim2,
    gap: &Matrix3<f64>,
) {
    let back = inverse(&tie.motion, [1.0, 1.0]);
    let before = before_gap.apply_to_pose(&compose(measured, &back, 1.0));
    let (height, motion) = (tie.covariance[(LN_SCALE, LN_SCALE)], relative_motion(&before, placed));
    let mut covariance = Matrix6::zeros();
    covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(gap);
    tie.covariance = motion_covariance(&before, placed, &covariance);
    (tie.motion, tie.covariance[(LN_SCALE, LN_SCALE)]) = (motion, height);
}

fn rotate(covariance: &mut Matrix6<f64>, turned: &Matrix3<f64>) {
    let mut whole = Matrix6::identity();
    whole.fixed_view_mut::<3, 3>(0, 0).copy_from(turned);
    *covariance = propagated(&whole, covariance);
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use odograph::filter::fusion::{Quantity, SensorRecord};
    use odograph::trajectory::{LossReason, TrackStatus};

    #[test]
    fn hours_without_ground_are_not_kept() {
        let record = SensorRecord::new(Quantity::TurnRate, vec![0.0, 1.0], vec![vec![0.0; 2]]).unwrap();
        let recorded = Sensors { gyro: Some(record), ..Sensors::default() };
        let mut fusion = LiveFusion::new(LiveSensors { recorded, heard: Vec::new() });
        for number in 0..20_000 {
            let frame = FrameEstimate {
                frame: number,
                time_s: 0.1 * number as f64,
                status: TrackStatus::Lost { reason: LossReason::Dark },
                estimate: None,
                tracks: 0,
                inliers: 0,
                residual_px: 0.0,
                keyframe: false,
                segment: 0,
            };
            assert!(fusion.fuse(frame, &mut [], &mut None).estimate.is_none());
        }
        assert!(fusion.recent.len() as f64 <= 10.0 * WINDOW_S + 2.0, "{} frames", fusion.recent.len());
    }
}
