//! One frame on one screen: from an image to a pose, a step per line.
//!
//! The ground is held by a *keyframe*: an image whose corners lie on the ground as metric points. Every later frame is measured against
//! the keyframe, not against the frame before it, until too little of it is left in view; then that frame becomes the next keyframe. So
//! errors add up once per keyframe, not thirty times a second.

mod candidate;
mod follow;
mod keyframe;
mod keyframe_event;
mod last_pose;
mod limits;
pub(crate) mod matching;
mod recovery;
mod texture;

use crate::camera::{Camera, Rig};
use crate::detection::DetectionConfig;
use crate::error::{Error, Result};
use crate::filter::{ConstantAcceleration, FilterConfig};
use crate::flow::FlowConfig;
use crate::geometry::{GroundPose, Pixel};
use crate::image::{GrayImage, Pyramid};
use crate::mapping::{EdgeKind, KeyframeId};
use crate::motion::{MotionConfig, MotionEstimate, MotionModel, Random, RigWander};
use crate::trajectory::{FrameEstimate, LossReason, PlaneMeasurement, PoseEstimate, TrackStatus};
use candidate::{CONFIRMATIONS, Candidate, MOST_CONFIRMATIONS};
use follow::Measurement;
use keyframe::{Keyframe, KeyframeMemory};
use keyframe_event::Before;
pub use keyframe_event::{FrameReference, KeyframeEvent, NewKeyframe};
use last_pose::LastPose;
use nalgebra::Matrix6;
use recovery::{Lost, Recovery};
use serde::{Deserialize, Serialize};

/// Every parameter of the pipeline, by stage.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OdometryConfig {
    /// Objects of interest.
    pub detection: DetectionConfig,
    /// Optical flow.
    pub flow: FlowConfig,
    /// Movement parameters.
    pub motion: MotionConfig,
    /// When a frame becomes a keyframe.
    pub keyframe: KeyframeConfig,
    /// Estimation improvement.
    pub filter: FilterConfig,
}

/// When a frame becomes a keyframe.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct KeyframeConfig {
    /// A new keyframe is made when less than this part of the keyframe's corners still supports the movement.
    pub support: f64,
    /// An older keyframe of which at least this part of the corners is in view again is taken up instead of making a new one.
    pub revisit: f64,
    /// So many older keyframes are remembered.
    pub remembered: usize,
}

impl Default for KeyframeConfig {
    fn default() -> Self {
        Self { support: 0.5, revisit: 0.75, remembered: 32 }
    }
}

impl OdometryConfig {
    /// With what depends on the size of the image: blur, rolling shutters and what stands a little above the ground grow with it.
    fn for_camera(mut self, camera: &Camera) -> Self {
        self.motion.inlier_px *= (camera.width() as f64 / 640.0).max(1.0);
        self
    }
}

/// What one track looked like in the last frame, for pictures and pages.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackView {
    /// Where it is.
    pub pixel: Pixel,
    /// Where its corner is in the keyframe against which the frame was measured.
    pub corner: Pixel,
    /// Whether it agrees with the movement.
    pub inlier: bool,
}

/// The pipeline: gray images in, poses out.
#[derive(Debug)]
pub struct Odometry {
    camera: Camera,
    config: OdometryConfig,
    first_pose: GroundPose,
    keyframe: Option<Keyframe>,
    memory: KeyframeMemory,
    last: Option<LastPose>,
    /// How much height and tilt are seen to move.
    wander: RigWander,
    filter: Option<ConstantAcceleration>,
    /// A start of a new segment that has not proved itself yet.
    candidate: Option<Candidate>,
    recovery: Recovery,
    /// So many frames before this one were lost.
    lost_frames: usize,
    /// The part of the corners in view that agreed in the last frames: below 1 where not everything in view is ground.
    usual_presence: f64,
    frames: u64,
    keyframes: u64,
    segment: usize,
    tracks: Vec<TrackView>,
    /// The pyramid of an earlier frame, whose memory the next one takes over.
    spare: Option<Pyramid>,
    /// What happened to the keyframes and was not asked for yet, where it is asked for.
    events: Option<Vec<KeyframeEvent>>,
    reference: Option<FrameReference>,
}

/// A new keyframe is made too when less than this part of the keyframe's corners would be in view in the next frame.
const FORESEEN_SUPPORT: f64 = 0.3;

/// Where a smaller part of the corners in view agrees with a pose, it may be that of something else.
const DOUBTFUL_PRESENCE: f64 = 0.55;

/// Where a smaller part of the corners in view agrees, what agrees does so by chance.
const CHANCE_PRESENCE: f64 = 0.25;

/// Weight of the newest frame in the usual presence: about the last five count.
const PRESENCE_RATE: f64 = 0.2;

/// A measurement further than this from where it was expected is a surprise, pixels: a joint of the floor may have been taken for its neighbour.
const SURPRISE_PX: f64 = 12.0;

/// Where a smaller part of the corners in view agrees with a surprise, it may be something else.
const SURPRISING_PRESENCE: f64 = 0.7;

/// For so many frames after a loss, what stands still in the image is not taken for a camera that came to rest exactly where its keyframe was made.
const MOST_SHADOWED: usize = 15;

impl Odometry {
    /// A pipeline for one recording. Fails where the rig or a parameter cannot be.
    pub fn new(camera: Camera, rig: Rig, config: OdometryConfig) -> Result<Self> {
        let first_pose = rig.validated()?.first_pose();
        let config = config.validated()?.for_camera(&camera);
        Ok(Self {
            recovery: Recovery::new(&camera),
            camera,
            config,
            first_pose,
            wander: RigWander::new(&first_pose),
            keyframe: None,
            memory: KeyframeMemory::new(config.keyframe.remembered),
            last: None,
            filter: None,
            candidate: None,
            lost_frames: 0,
            usual_presence: 1.0,
            frames: 0,
            keyframes: 0,
            segment: 0,
            tracks: Vec::new(),
            spare: None,
            events: None,
            reference: None,
        })
    }

    /// Takes the next frame. Fails where the image has not the size the camera is calibrated for, or its time is not a number.
    pub fn process(&mut self, image: GrayImage, time_s: f64) -> Result<FrameEstimate> {
        self.check_input(&image, time_s)?;
        self.reference = None;
        let pyramid = match self.spare.take() {
            Some(mut pyramid) => {
                pyramid.replace(image);
                pyramid
            }
            None => Pyramid::new(image, self.config.flow.levels),
        };
        let frame = match self.measure(&pyramid, time_s) {
            Ok(measurement) => self.accept(pyramid, time_s, measurement),
            Err(reason) => self.lose(pyramid, time_s, reason),
        };
        self.frames += 1;
        Ok(frame)
    }

    /// The tracks of the last frame.
    pub fn tracks(&self) -> &[TrackView] {
        &self.tracks
    }

    /// How many keyframes were made.
    pub fn keyframes(&self) -> u64 {
        self.keyframes
    }

    fn check_input(&self, image: &GrayImage, time_s: f64) -> Result<()> {
        let (width, height) = (self.camera.width(), self.camera.height());
        if (image.width(), image.height()) != (width, height) {
            return Err(Error::input(format!(
                "frame {} is {}x{} but the camera is calibrated for {width}x{height}; calibrate at the recording's size",
                self.frames,
                image.width(),
                image.height(),
            )));
        }
        if !time_s.is_finite() {
            return Err(Error::input(format!("the time of frame {} is {time_s}", self.frames)));
        }
        Ok(())
    }

    /// The pose of a frame against what is known of the ground: near where it is expected, otherwise anywhere.
    fn measure(&mut self, pyramid: &Pyramid, time_s: f64) -> std::result::Result<Measurement, LossReason> {
        let near = self.measure_near(pyramid, time_s);
        let measured = match near {
            Ok(measurement) if !self.is_doubtful(&measurement) => Ok(measurement),
            near => self.recover(pyramid, time_s, near),
        };
        measured.map(|measurement| self.confirm(pyramid, measurement))
    }

    /// The pose of a frame near where it is expected, tried from several predictions.
    fn measure_near(&self, pyramid: &Pyramid, time_s: f64) -> std::result::Result<Measurement, LossReason> {
        let (Some(keyframe), Some(last)) = (&self.keyframe, &self.last) else {
            return Err(LossReason::Bare);
        };
        let mut random = Random::new(self.frames);
        let mut outcome = Err(LossReason::Jump);
        // The mean vector is measured from the last frame; poses are measured from where the camera is thought to be.
        let extrapolated = match self.config.motion.model {
            MotionModel::Mean => last.pose,
            _ => last.extrapolated(time_s),
        };
        if let Some(off_px) = self.prediction_off_px(last, time_s) {
            let mut random = Random::new(self.frames);
            let (camera, config, wander) = (&self.camera, &self.config, &self.wander);
            let near = follow::measure_near(
                keyframe,
                pyramid,
                camera,
                &extrapolated,
                off_px,
                config,
                wander,
                &mut random,
            );
            // What others will be built on is searched in full.
            if near.as_ref().is_ok_and(|near| near.settled || near.support >= config.keyframe.support) {
                return near;
            }
        }
        for prediction in [extrapolated, last.pose] {
            outcome = follow::measure(
                keyframe,
                pyramid,
                &self.camera,
                &prediction,
                &self.config,
                &self.wander,
                &mut random,
            );
            if outcome.is_ok() {
                break;
            }
        }
        outcome
    }

    /// How far off the extrapolated pose may be in the image; nothing where that is so much that the search is a full one anyway, or is
    /// not known.
    fn prediction_off_px(&self, last: &LastPose, time_s: f64) -> Option<f64> {
        const FULL_SEARCH_PX: f64 = 4.0;
        let usual_step = time_s - last.time_s <= 1.5 * last.step_s;
        let off_px = 0.5 + 2.0 * last.off_by() * self.camera.focal_px().0;
        (self.config.motion.model != MotionModel::Mean && usual_step && off_px < FULL_SEARCH_PX)
            .then_some(off_px)
    }

    /// Whether a measurement may have followed something beside the ground, as a shadow that moves along, or another part of the ground that
    /// looks alike: few of the corners in view agree with it, or not most of them although it is not where it was expected.
    fn is_doubtful(&self, measurement: &Measurement) -> bool {
        let (found, expected) = (&measurement.estimate.pose, &measurement.prediction);
        let off_m = (found.x_m - expected.x_m).hypot(found.y_m - expected.y_m);
        let surprising = off_m * self.camera.focal_px().0 > SURPRISE_PX * found.height_m;
        let wanted = self.usual_presence * if surprising { SURPRISING_PRESENCE } else { DOUBTFUL_PRESENCE };
        // The support counts corners out of view too: the presence is never below it.
        measurement.support < wanted
            && self
                .keyframe
                .as_ref()
                .is_some_and(|keyframe| follow::presence(keyframe, &self.camera, measurement) < wanted)
    }

    /// The pose of a frame anywhere over known ground. Takes up the keyframe in which it was found.
    fn recover(
        &mut self,
        pyramid: &Pyramid,
        time_s: f64,
        near: std::result::Result<Measurement, LossReason>,
    ) -> std::result::Result<Measurement, LossReason> {
        let (Some(keyframe), Some(last)) = (&mut self.keyframe, &self.last) else {
            return near;
        };
        if self.config.motion.model == MotionModel::Mean {
            return near;
        }
        let least = CHANCE_PRESENCE * self.usual_presence;
        let near = near.and_then(|measurement| {
            let presence = follow::presence(keyframe, &self.camera, &measurement);
            if presence < SURPRISING_PRESENCE * self.usual_presence
                && follow::stands_still(keyframe, &self.camera, &measurement)
            {
                return Err(LossReason::Shadow);
            }
            if presence >= least {
                return Ok(measurement);
            }
            let Measurement { found, prediction, .. } = &measurement;
            Err(follow::why_not(keyframe, &self.camera, found, prediction))
        });
        if texture::is_faint(pyramid) {
            return near;
        }
        let reason = near.as_ref().err().copied().unwrap_or(LossReason::NotPlanar);
        let (expected, frames) = (last.extrapolated(time_s), self.lost_frames);
        let lost = Lost { pyramid, last, expected, frames, doubtful: near.ok() };
        let (camera, config, mut random) = (&self.camera, &self.config, Random::new(self.frames));
        let found =
            self.recovery.find(lost, keyframe, &mut self.memory, camera, config, &self.wander, &mut random);
        let found = found.ok_or(reason)?;
        let shadow = self.lost_frames < MOST_SHADOWED
            && found.remembered.is_none()
            && follow::presence(keyframe, camera, &found.measurement)
                < SURPRISING_PRESENCE * self.usual_presence
            && follow::stands_still(keyframe, camera, &found.measurement);
        if shadow {
            return Err(LossReason::Shadow);
        }
        if let Some(old) = found.remembered.and_then(|index| self.memory.take(index, camera)) {
            self.memory.remember(std::mem::replace(keyframe, old).retire());
        }
        Ok(found.measurement)
    }

    /// Checks the tracks of a frame on which others may be built.
    fn confirm(&self, pyramid: &Pyramid, measurement: Measurement) -> Measurement {
        match &self.keyframe {
            Some(keyframe) if measurement.support < self.config.keyframe.support => {
                let mut random = Random::new(self.frames);
                follow::confirm(
                    keyframe,
                    pyramid,
                    &self.camera,
                    measurement,
                    &self.config,
                    &self.wander,
                    &mut random,
                )
            }
            _ => measurement,
        }
    }

    /// A measured frame: its pose improved by the filter, and perhaps the next keyframe.
    fn accept(&mut self, pyramid: Pyramid, time_s: f64, measurement: Measurement) -> FrameEstimate {
        let presence = self.keyframe.as_ref().map(|k| follow::presence(k, &self.camera, &measurement));
        let Measurement { estimate, found, support, .. } = measurement;
        let covariance = self.carried_covariance(&estimate.pose) + estimate.covariance;
        let inliers = estimate.inlier_count();
        let corners = self.keyframe.as_ref().map_or(&[][..], |keyframe| &keyframe.corners);
        let view = |(found, &inlier): (&follow::Found, &bool)| {
            let corner = corners.get(found.corner)?.template.centre();
            Some(TrackView { pixel: found.warp.position, corner, inlier })
        };
        self.tracks.clear();
        self.tracks.extend(found.iter().zip(&estimate.inliers).filter_map(view));
        self.wander.learn(&estimate);
        if let Some(presence) = presence {
            self.usual_presence += PRESENCE_RATE * (presence - self.usual_presence);
        }
        self.candidate = None;
        self.recovery.reset();
        if std::mem::take(&mut self.lost_frames) > 0 {
            self.filter = None; // how the camera moved meanwhile is not known
        }
        self.last = Some(match self.last.take() {
            Some(last) => last.moved(time_s, estimate.pose, covariance),
            None => LastPose::still(time_s, estimate.pose, covariance),
        });
        let improved = self.improve(time_s, &estimate);
        let measured_against = self.keyframe.as_ref().and_then(|keyframe| keyframe.id);
        self.reference = measured_against.map(|keyframe| FrameReference { keyframe, next: None });
        let keyframe = support < self.config.keyframe.support || self.leaves_the_keyframe(&found, time_s);
        if self.config.motion.model == MotionModel::Mean {
            self.keep_only(&found, covariance); // from here on what was found has other numbers
        }
        if keyframe {
            self.change_keyframe(pyramid, time_s, &estimate, covariance);
        } else {
            self.spare = Some(pyramid);
        }
        FrameEstimate {
            frame: self.frames,
            time_s,
            status: TrackStatus::Tracked,
            estimate: Some(PoseEstimate { covariance, ..improved }),
            tracks: estimate.inliers.len(),
            inliers,
            residual_px: estimate.residual_px,
            keyframe,
            segment: self.segment,
        }
    }

    /// Whether the next frame will show too little of the keyframe to be measured against it, if the camera goes on as it went.
    fn leaves_the_keyframe(&self, found: &[follow::Found], time_s: f64) -> bool {
        let (Some(keyframe), Some(last)) = (&self.keyframe, &self.last) else { return false };
        let next = last.extrapolated(time_s + last.step_s);
        follow::still_seen(keyframe, &self.camera, found, &next) < FORESEEN_SUPPORT
    }

    /// A frame that could not be measured: begins the map, or waits for the ground to come back.
    fn lose(&mut self, pyramid: Pyramid, time_s: f64, reason: LossReason) -> FrameEstimate {
        let bare = texture::is_bare(pyramid.base());
        if self.last.is_none() && !bare {
            return self.begin(pyramid, time_s);
        }
        self.tracks.clear();
        self.lost_frames += 1;
        let reason = self.cause(&pyramid, bare, reason);
        match self.confirm_candidate(&pyramid, time_s) {
            Some(found) if self.candidate_is_believed() => return self.begin_segment(pyramid, time_s, found),
            Some(found) if found.support < self.config.keyframe.support => {
                if let Some(candidate) = &mut self.candidate {
                    candidate.move_on(pyramid, self.frames, &self.camera, &self.config);
                }
            }
            Some(_) => {}
            None => {
                // Laid where the camera would be had it gone on as it went.
                let last = match &self.last {
                    Some(last) => last.carried_over_gap(time_s),
                    None => LastPose::still(time_s, self.first_pose, Matrix6::zeros()),
                };
                self.candidate = Candidate::new(pyramid, self.frames, last, &self.camera, &self.config);
            }
        }
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

    /// Why a frame was lost, as far as the image itself tells; otherwise what the measurement said.
    fn cause(&self, pyramid: &Pyramid, bare: bool, reason: LossReason) -> LossReason {
        match (&self.keyframe, reason) {
            _ if bare && texture::is_dark(pyramid.base()) => LossReason::Dark,
            _ if bare => LossReason::Bare,
            (Some(keyframe), LossReason::Jump | LossReason::NotPlanar)
                if texture::is_blurred(pyramid, &keyframe.pyramid) =>
            {
                LossReason::Blur
            }
            _ => reason,
        }
    }

    /// The first frame that shows ground is where the world begins.
    fn begin(&mut self, pyramid: Pyramid, time_s: f64) -> FrameEstimate {
        let (pose, covariance) = (self.first_pose, Matrix6::zeros());
        let mut keyframe = Keyframe::new(pyramid, pose, covariance, &self.camera, &self.config.detection);
        self.number(&mut keyframe, (self.frames, time_s), None);
        self.reference = keyframe.id.map(|keyframe| FrameReference { keyframe, next: None });
        let corners = keyframe.corners.len();
        self.tracks = keyframe
            .corners
            .iter()
            .map(|corner| corner.template.centre())
            .map(|corner| TrackView { pixel: corner, corner, inlier: true })
            .collect();
        self.keyframe = Some(keyframe);
        self.last = Some(LastPose::still(time_s, pose, covariance));
        FrameEstimate {
            frame: self.frames,
            time_s,
            status: TrackStatus::Tracked,
            estimate: Some(PoseEstimate {
                pose,
                velocity: Default::default(),
                covariance,
                measured: PlaneMeasurement::new(&pose, &covariance),
            }),
            tracks: corners,
            inliers: corners,
            residual_px: 0.0,
            keyframe: true,
            segment: self.segment,
        }
    }

    /// The measurement of a lost frame against the candidate, if there is one.
    fn confirm_candidate(&mut self, pyramid: &Pyramid, time_s: f64) -> Option<Measurement> {
        let mut random = Random::new(self.frames);
        let (camera, config, wander) = (&self.camera, &self.config, &self.wander);
        self.candidate.as_mut()?.confirm(pyramid, time_s, camera, config, wander, &mut random)
    }

    /// Whether enough frames agreed with the candidate. To come back to known ground is better than to begin anew.
    fn candidate_is_believed(&self) -> bool {
        let needed =
            if self.recovery.is_exhausted(&self.memory) { CONFIRMATIONS } else { MOST_CONFIRMATIONS };
        self.candidate.as_ref().is_some_and(|candidate| candidate.is_confirmed(needed))
    }

    /// The ground is back, but how the camera came here was not measured: a new segment.
    fn begin_segment(&mut self, pyramid: Pyramid, time_s: f64, measurement: Measurement) -> FrameEstimate {
        // The very first ground is not a new segment.
        self.segment += usize::from(self.last.is_some());
        let last = self.last.take();
        if let Some(mut candidate) = self.candidate.take() {
            let before = last.and_then(|last| self.across_the_gap(&last, &candidate.keyframe));
            self.number(&mut candidate.keyframe, candidate.made, before);
            if let Some(before) = self.keyframe.replace(candidate.keyframe) {
                self.memory.remember(before.retire());
            }
            self.last = Some(candidate.last);
        }
        self.memory.close_segment();
        self.filter = None;
        self.accept(pyramid, time_s, measurement)
    }

    /// How the first keyframe after a gap lies to the last one before.
    fn across_the_gap(&self, last: &LastPose, next: &Keyframe) -> Option<Before> {
        let before = self.keyframe.as_ref()?;
        Some(Before {
            id: before.id?,
            pose: before.pose,
            covariance: next.covariance - self.carried_covariance(&last.pose),
            kind: EdgeKind::Gap,
        })
    }

    /// The next reference: an older keyframe where the camera has come back to one, otherwise this frame.
    fn change_keyframe(
        &mut self,
        pyramid: Pyramid,
        time_s: f64,
        estimate: &MotionEstimate,
        covariance: Matrix6<f64>,
    ) {
        let pose = estimate.pose;
        let pyramid = match self.revisit(pyramid, estimate, &covariance) {
            Ok(()) => return,
            Err(pyramid) => pyramid,
        };
        let mut next = Keyframe::new(pyramid, pose, covariance, &self.camera, &self.config.detection);
        if !next.can_be_followed(2 * self.config.motion.minimum_inliers) {
            return; // better the rest of the old one than nothing
        }
        let before = self.keyframe.as_ref().and_then(|before| {
            let kind = EdgeKind::Odometry;
            Some(Before { id: before.id?, pose: before.pose, covariance: estimate.covariance, kind })
        });
        self.number(&mut next, (self.frames, time_s), before);
        self.serve_from_here(next.id, pose);
        if let Some(before) = self.keyframe.replace(next) {
            self.memory.remember(before.retire());
        }
    }

    /// Takes up an older keyframe that is in view again, where what it measures agrees with where we think we are. Gives the image back
    /// where there is none.
    fn revisit(
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
        let measured =
            follow::measure(&old, &pyramid, &self.camera, pose, &self.config, &self.wander, &mut random);
        let agreed = measured.ok().filter(|m| {
            let found = &m.estimate.pose;
            let pixel_m = pose.height_m / self.camera.focal_px().0;
            let position_m = 4.0 * (covariance[(0, 0)] + covariance[(1, 1)]).sqrt() + 2.0 * pixel_m;
            let heading_rad = 4.0 * covariance[(2, 2)].sqrt() + 0.005;
            m.support >= self.config.keyframe.support
                && (found.x_m - pose.x_m).hypot(found.y_m - pose.y_m) < position_m
                && (found.heading_rad - pose.heading_rad).abs() < heading_rad
        });
        let Some(measurement) = agreed else {
            self.memory.put_back(old);
            return Err(pyramid);
        };
        let found = measurement.estimate.pose;
        self.tell_revisit(&old, (pose, &estimate.covariance), (&found, &measurement.estimate.covariance));
        self.serve_from_here(old.id, found);
        if let Some(before) = self.keyframe.replace(old) {
            self.memory.remember(before.retire());
        }
        // The place is known better than the way that led here: position and filter are set right, the velocity stays.
        if let Some(last) = &mut self.last {
            last.pose = found;
        }
        if let Some(filter) = &mut self.filter {
            filter.shift([found.x_m - pose.x_m, found.y_m - pose.y_m, found.heading_rad - pose.heading_rad]);
        }
        Ok(())
    }

    /// Another keyframe is the reference of the frames after this one, whose pose that one has at `pose`.
    fn serve_from_here(&mut self, keyframe: Option<KeyframeId>, pose: GroundPose) {
        if let (Some(reference), Some(keyframe)) = (&mut self.reference, keyframe) {
            reference.next = Some((keyframe, pose));
        }
    }

    /// Position and heading improved by the filter, with the velocity it knows.
    fn improve(&mut self, time_s: f64, estimate: &MotionEstimate) -> PoseEstimate {
        let pose = estimate.pose;
        let measured = [pose.x_m, pose.y_m, pose.heading_rad];
        let variances = [0, 1, 2].map(|i| estimate.covariance[(i, i)]);
        let filtered = match &mut self.filter {
            Some(filter) => filter.update(time_s, measured, variances),
            None => self
                .filter
                .insert(ConstantAcceleration::new(time_s, measured, variances, &self.config.filter))
                .filtered(),
        };
        let plane = PlaneMeasurement::new(&pose, &estimate.covariance);
        let pose =
            GroundPose { x_m: filtered.x_m, y_m: filtered.y_m, heading_rad: filtered.heading_rad, ..pose };
        PoseEstimate { pose, velocity: filtered.velocity, covariance: estimate.covariance, measured: plane }
    }

    /// What the keyframe's own uncertainty does to a pose measured against it: the ground it laid out is shifted, turned about it, and scaled with
    /// its height.
    fn carried_covariance(&self, pose: &GroundPose) -> Matrix6<f64> {
        let Some(keyframe) = &self.keyframe else {
            return Matrix6::zeros();
        };
        let (dx, dy) = (pose.x_m - keyframe.pose.x_m, pose.y_m - keyframe.pose.y_m);
        let mut carry = Matrix6::identity();
        carry[(0, 2)] = -dy;
        carry[(1, 2)] = dx;
        carry[(0, 3)] = dx / keyframe.pose.height_m;
        carry[(1, 3)] = dy / keyframe.pose.height_m;
        carry * keyframe.covariance * carry.transpose()
    }

    /// For the mean vector, which is measured from frame to frame: only what was just seen can be seen again, and the covariance adds up.
    fn keep_only(&mut self, found: &[follow::Found], covariance: Matrix6<f64>) {
        if let Some(keyframe) = &mut self.keyframe {
            keyframe.keep_only(found.iter().map(|f| (f.corner, f.warp)));
            keyframe.covariance = covariance;
        }
    }
}

#[cfg(test)]
mod tests;
