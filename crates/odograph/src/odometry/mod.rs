//! Visual odometry: from an image to a pose, one frame on one screen, one step per line.
//!
//! The ground is represented by a *keyframe*: an image whose corners lie on the ground as metric
//! points. Every later frame is measured against the keyframe, not against the previous frame,
//! until too little of it is in view; then that frame becomes the next keyframe. Errors thus
//! accumulate per keyframe, not per frame.

mod candidate;
mod config;
mod ambiguity;
mod cover;
mod earlier_pass;
mod exposure;
mod found_corner;
mod frame_uncertainty;
pub(crate) mod tracking;
pub(crate) mod keyframe;
mod keyframe_event;
mod last_pose;
pub(crate) mod learned;
mod limits;
mod loss;
mod moving_ground;
mod pattern_noise;
mod pose_hypotheses;
mod rate_filter;
mod recalibration;
mod recovery;
mod repeated;
mod resolution;
mod shutter;
mod standing;
mod succession;
mod surface;
mod texture;
mod track_view;

use crate::camera::{CalibrationDeviations, Camera, Rig};
use crate::error::{Error, Result};
use crate::filter::ConstantAcceleration;
use crate::fixed_pattern::{FixedPattern, ImageMask, NonuniformityCorrection, SinceLast};
use crate::geometry::{GroundPoint, GroundPose, propagated};
use crate::image::{GrayImage, ImageDefects, Pyramid, Restoration};
use crate::motion::{MeasuredMotion, MotionEstimate, MotionModel, PoseRates, Readout};
use crate::trajectory::{FrameEstimate, LossReason, PlaneMeasurement, PoseEstimate, TrackStatus};
use candidate::SegmentCandidate;
pub use config::{KeyframeConfig, OdometryConfig};
use cover::Trial;
pub use earlier_pass::EarlierPass;
use found_corner::FoundCorner;
use keyframe::{Keyframe, KeyframeMemory, KeyframeUpdate};
pub use keyframe_event::{FrameReference, KeyframeEvent, NewKeyframe};
use last_pose::LastPose;
use learned::Learned;
use nalgebra::{Matrix6, Matrix6x2};
use pattern_noise::PatternNoise;
use recovery::Recovery;
use resolution::WorkingResolution;
use standing::Standing;
use std::sync::Arc;
pub use track_view::TrackView;
use tracking::Measurement;

/// The pipeline: gray images in, poses out.
#[derive(Debug)]
pub struct Odometry {
    /// The camera of the images that are tracked.
    camera: Camera,
    config: OdometryConfig,
    resolution: WorkingResolution,
    first_pose: GroundPose,
    /// What is known of the errors of the calibration.
    deviations: CalibrationDeviations,
    keyframe: Option<Keyframe>,
    /// Where something may cover the ground in the present keyframe.
    trial: Option<Trial>,
    memory: KeyframeMemory,
    last: Option<LastPose>,
    learned: Learned,
    filter: Option<ConstantAcceleration>,
    /// A start of a new segment that has not proved itself yet.
    candidate: Option<SegmentCandidate>,
    recovery: Recovery,
    /// Pixels that do not move with the ground.
    fixed: FixedPattern,
    standing: Standing,
    pattern_noise: PatternNoise,
    restoration: Restoration,
    /// The motion within the images, as far as an earlier pass has measured it.
    motion: Arc<MeasuredMotion>,
    /// Number of consecutive lost frames before this one.
    lost_frames: usize,
    /// Whether the rates of the present frame were predicted by poses on a plane that the ground
    /// has turned out not to be.
    rates_are_of_plane: bool,
    /// Number of repeated images before this frame.
    repeated: usize,
    /// What of the present image is a copy of the last one.
    stale: Option<Arc<ImageMask>>,
    frames: u64,
    /// Time of the first frame, seconds.
    first_time_s: Option<f64>,
    keyframes: u64,
    /// Change of the last pose by the estimated error of the keyframe's height and tilt.
    keyframe_off: PoseRates,
    /// Change of the last pose by the readout time, the keyframe's left out.
    own_by_readout: PoseRates,
    /// Change of the last pose by roll and pitch of the mount.
    by_mount_tilt: Matrix6x2<f64>,
    /// The frame from which the present keyframe is the reference.
    reference_since: u64,
    segment: usize,
    tracks: Vec<TrackView>,
    /// The pyramid of an earlier frame, whose memory the next one takes over.
    spare: Option<Pyramid>,
    /// What happened to the keyframes and was not asked for yet, where it is asked for.
    events: Option<Vec<KeyframeEvent>>,
    reference: Option<FrameReference>,
}

/// Of a mask that covers more than this, no ground is left to follow.
const MOST_MASKED: f64 = 0.95;

/// Number of steps that determine the time between frames, and the longest readout as a fraction of
/// it: times are rounded.
const STEPS_BEFORE_JUDGING: u64 = 10;
const LONGEST_READOUT: f64 = 1.05;

/// Frames from one look at the elevation below a keyframe to the next, where the ground is rough.
const LEVELLED_EVERY: u64 = 4;

impl Odometry {
    /// A pipeline for one recording. Fails where the rig or a parameter cannot be.
    pub fn new(camera: Camera, rig: Rig, config: OdometryConfig) -> Result<Self> {
        let first_pose = rig.validated()?.first_pose();
        Ok(Self::starting_at(first_pose, camera, config.validated()?))
    }

    fn starting_at(first_pose: GroundPose, camera: Camera, config: OdometryConfig) -> Self {
        let fixed = FixedPattern::new((camera.width(), camera.height()));
        Self {
            recovery: Recovery::new(&camera),
            resolution: WorkingResolution::full(&camera, config),
            config: config.for_camera(&camera),
            first_pose,
            deviations: CalibrationDeviations::default(),
            learned: Learned::with_rolling_shutter(&first_pose, &camera, config.motion.model),
            camera,
            keyframe: None,
            trial: None,
            memory: KeyframeMemory::new(config.keyframe.remembered),
            last: None,
            filter: None,
            candidate: None,
            fixed,
            standing: Standing::default(),
            pattern_noise: PatternNoise::default(),
            restoration: Restoration::default(),
            motion: Arc::default(),
            lost_frames: 0,
            repeated: 0,
            stale: None,
            rates_are_of_plane: false,
            frames: 0,
            first_time_s: None,
            keyframes: 0,
            keyframe_off: PoseRates::zeros(),
            own_by_readout: PoseRates::zeros(),
            by_mount_tilt: Matrix6x2::zeros(),
            reference_since: 0,
            segment: 0,
            tracks: Vec::new(),
            spare: None,
            events: None,
            reference: None,
        }
    }

    /// Adds a mask: pixels darker than middle gray, in a picture of the size of the frames, are not
    /// ground. What is detected while tracking is added.
    ///
    /// # Errors
    ///
    /// If the picture has another size.
    pub fn with_mask(mut self, picture: &GrayImage) -> Result<Self> {
        let full = self.resolution.full_camera();
        let size = (full.width(), full.height());
        if (picture.width(), picture.height()) != size {
            return Err(Error::input(format!(
                "the mask is {}x{} but the camera is calibrated for {}x{}; make it at the size of the frames",
                picture.width(),
                picture.height(),
                size.0,
                size.1,
            )));
        }
        let mask = ImageMask::from_picture(picture);
        if mask.share() > MOST_MASKED {
            return Err(Error::input(format!(
                "the mask leaves {:.0} % of the image; white is ground, black is not",
                100.0 * (1.0 - mask.share()),
            )));
        }
        let mask = self.resolution.reduced_mask(&mask);
        self.fixed = FixedPattern::new(mask.size()).with_given(mask);
        Ok(self)
    }

    /// Begins with a mask of what is static in the images.
    pub fn with_fixed(self, mask: &ImageMask) -> Self {
        let mask = self.resolution.reduced_mask(mask);
        Self { fixed: self.fixed.with_known(&mask), ..self }
    }

    /// The pattern that the camera adds to its images, where it is stronger than the ground.
    pub fn correction(&self) -> Option<&NonuniformityCorrection> {
        self.pattern_noise.correction()
    }

    /// Mask of the pixels that do not move with the ground; `None` where all do, as far as it is
    /// known.
    pub fn mask(&self) -> Option<Arc<ImageMask>> {
        self.fixed.mask().map(|mask| self.resolution.enlarged_mask(mask))
    }

    /// The masked fraction of the image, 0 to 1.
    pub fn masked_share(&self) -> f64 {
        self.fixed.share()
    }

    /// The mask, where a later pass over the same images should begin with it: a large one that
    /// does not change any more.
    pub fn settled_mask(&self) -> Option<Arc<ImageMask>> {
        self.fixed.settled_mask().map(|mask| self.resolution.enlarged_mask(mask))
    }

    /// Processes the next frame.
    ///
    /// # Errors
    ///
    /// If the image has another size than the calibration, or the time is not a number.
    pub fn process(&mut self, image: GrayImage, time_s: f64) -> Result<FrameEstimate> {
        self.check_input(&image, time_s)?;
        self.check_readout(time_s)?;
        let image = self.restoration.restore(image);
        let mut image = self.resolution.reduce(image);
        let seen = self.pattern_noise.keep(&image, self.frames);
        if let Some(correction) = self.pattern_noise.correction() {
            correction.apply(&mut image);
        }
        if self.is_repeated(&image)
            && let Some(frame) = self.repeat(time_s)
        {
            self.frames += 1;
            return Ok(frame);
        }
        self.repeated = 0;
        self.reference = None;
        self.leave_out_stale_blocks(&image, time_s);
        let since_last = self.look_for_what_is_fixed(&image);
        if let Some(keyframe) = &mut self.keyframe {
            keyframe.prepare(&self.camera);
        }
        let pyramid = match self.spare.take() {
            Some(mut pyramid) => {
                pyramid.replace(image);
                pyramid
            }
            None => Pyramid::new(image, self.config.flow.levels),
        };
        self.learned.predict_shutter(self.last.as_ref(), time_s, self.motion.at(time_s));
        let measured = self.measure(&pyramid, time_s).and_then(|found| self.distrust(found, since_last));
        let frame = match measured.map(|found| self.with_elevations(&pyramid, time_s, found)) {
            Ok(measurement) => self.accept(pyramid, time_s, measurement),
            Err(reason) => self.lose(pyramid, time_s, reason),
        };
        if since_last == SinceLast::Moved || self.frames == 0 {
            self.standing.counts_from(frame.estimate.as_ref().map(|estimate| estimate.pose));
        }
        self.learn_pattern(seen, frame.estimate.as_ref().map(|estimate| estimate.pose), since_last);
        self.choose_resolution();
        self.frames += 1;
        Ok(frame)
    }

    /// Elevations of the ground at the keyframe's corners, where it is not flat: places in the
    /// odometry frame and metres above the plane. Empty on flat ground.
    pub fn elevations(&self) -> Vec<(GroundPoint, f64)> {
        let corners = self.keyframe.iter().flat_map(|keyframe| &keyframe.corners);
        corners.filter_map(|corner| Some((corner.patch.ground, corner.elevation?.mean_m))).collect()
    }

    /// Whether the tracks of the last frame look like those of ground that is not flat. A tilt, a
    /// lens or a shutter that is another than it was given may look so, too.
    pub fn sees_relief(&self) -> bool {
        let has_relief = self.keyframe.as_ref().is_some_and(|keyframe| keyframe.surface.is_some());
        has_relief || self.learned.relief_m2() > 0.0
    }

    /// The readout time of the image as it is known now.
    pub fn readout(&self) -> Option<Readout> {
        self.learned.shutter().map(|state| state.readout())
    }

    /// Whether the readout time has mattered so far: the camera has moved by some heights.
    pub fn readout_matters(&self) -> bool {
        self.learned.shutter().is_some_and(|state| state.has_moved())
    }

    /// Defects of the images that were found and corrected.
    pub fn image_defects(&self) -> ImageDefects {
        ImageDefects { pixel_noise: self.resolution.is_reduced(), ..self.restoration.found() }
    }

    /// How many keyframes were made.
    pub fn keyframes(&self) -> u64 {
        self.keyframes
    }

    /// A readout that takes longer than the frames are apart cannot be.
    fn check_readout(&mut self, time_s: f64) -> Result<()> {
        let first_s = *self.first_time_s.get_or_insert(time_s);
        // An estimated readout time has a deviation, and is no mistake of who gives it.
        let is_given = self.camera.readout_deviation_s() == 0.0;
        let is_due = is_given && self.frames == STEPS_BEFORE_JUDGING;
        let Some(readout_s) = self.camera.readout_s().filter(|_| is_due) else {
            return Ok(());
        };
        let step_s = (time_s - first_s) / STEPS_BEFORE_JUDGING as f64;
        if step_s > 0.0 && readout_s.abs() > LONGEST_READOUT * step_s {
            return Err(Error::input(format!(
                "the readout time of {:.1} ms is longer than the {:.1} ms between two frames; give the right one, \
                 or leave it out and it is learned",
                1e3 * readout_s,
                1e3 * step_s
            )));
        }
        Ok(())
    }

    fn check_input(&self, image: &GrayImage, time_s: f64) -> Result<()> {
        let full = self.resolution.full_camera();
        let (width, height) = (full.width(), full.height());
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

    /// The pose of a frame against known ground: near the prediction, otherwise anywhere.
    fn measure(&mut self, pyramid: &Pyramid, time_s: f64) -> std::result::Result<Measurement, LossReason> {
        let near = self.measure_near(pyramid, time_s);
        let near = self.on_trial(near, pyramid, time_s);
        let measured = match near {
            Ok(measurement) if !self.is_ambiguous(&measurement, time_s) => Ok(measurement),
            near => self.recover(pyramid, time_s, near),
        };
        measured.map(|measurement| self.confirm(pyramid, measurement))
    }

    /// Learns the elevations of the ground from a measured frame. If it is not flat, the frame is
    /// measured once more: its pose, and with it all elevations, had a plane forced on them.
    fn with_elevations(&mut self, pyramid: &Pyramid, time_s: f64, measured: Measurement) -> Measurement {
        let Some(keyframe) = &mut self.keyframe else { return measured };
        let Measurement { found, estimate, .. } = &measured;
        if !self.learned.saw_elevations(keyframe, found, estimate, &self.camera) {
            return measured;
        }
        keyframe.forget_elevations(&self.camera);
        let prior = self.learned.rig_prior.prior(&measured.prediction, &self.config.motion);
        if self.learned.shape(keyframe, &prior).is_some() {
            self.expose_on_slope();
        }
        let Ok(again) = self.measure_near(pyramid, time_s) else { return measured };
        self.rates_are_of_plane = true;
        if let Some(keyframe) = &mut self.keyframe {
            self.learned.saw_elevations(keyframe, &again.found, &again.estimate, &self.camera);
            if keyframe.surface.is_none() {
                keyframe.set_level(&self.camera, self.learned.relief_m2());
            }
        }
        again
    }

    /// A measured frame: its pose improved by the filter, and perhaps the next keyframe.
    fn accept(&mut self, pyramid: Pyramid, time_s: f64, measurement: Measurement) -> FrameEstimate {
        let inlier_ratio = self.keyframe.as_ref().map(|k| measurement.inlier_ratio(k, &self.camera));
        let Measurement { mut estimate, found, fixed, support, tiles, .. } = measurement;
        let update = self.keyframe_update(&estimate);
        self.move_with_keyframe(&mut estimate, &update);
        let uncertainty = self.uncertainty(&estimate, &update);
        let stated_covariance = self.stated_covariance(&uncertainty, &estimate.pose);
        self.show_tracks(&found, &tiles, &estimate);
        self.resolution.watch(&found, &estimate.inliers);
        self.learn(&found, &estimate, &update, inlier_ratio);
        self.follow(time_s, &estimate, uncertainty.covariance);
        let improved = self.improve(time_s, &estimate);
        let keyframe = support < self.enough_support() || self.leaves_the_keyframe(&found, time_s);
        self.end_trial();
        let measured_against = self.keyframe.as_ref().and_then(|keyframe| keyframe.id);
        self.reference = measured_against.map(|keyframe| FrameReference { keyframe, next: None });
        let is_mean = self.config.motion.model == MotionModel::Mean;
        if is_mean {
            self.keep_only(&found, uncertainty.covariance); // from here on what was found has other numbers
        }
        if keyframe {
            let may_be_covered = self.may_be_covered(inlier_ratio);
            self.spare =
                self.change_keyframe(pyramid, time_s, &estimate, &update, &uncertainty, may_be_covered);
        } else {
            self.spare = Some(pyramid);
            // The mean follows its corners from frame to frame, under numbers of their own.
            if let Some(keyframe) = self.keyframe.as_mut().filter(|_| !is_mean) {
                if fixed.is_empty() {
                    keyframe.drop_moving(&found, &estimate);
                } else {
                    keyframe.drop_corners(&fixed);
                }
            }
        }
        FrameEstimate {
            frame: self.frames,
            time_s,
            status: TrackStatus::Tracked,
            estimate: Some(PoseEstimate { covariance: stated_covariance, ..improved }),
            tracks: estimate.inliers.len(),
            inliers: estimate.inlier_count(),
            residual_px: self.resolution.scale() * estimate.residual_px,
            keyframe,
            segment: self.segment,
        }
    }

    /// Moves a pose by the estimated error of its keyframe's position and heading; height and tilt
    /// of the keyframe are in the fit.
    fn move_with_keyframe(&mut self, estimate: &mut MotionEstimate, update: &KeyframeUpdate) {
        let KeyframeUpdate { moved, .. } = update;
        self.keyframe_off = estimate.by_keyframe * moved;
        let moved = PoseRates::new(moved[0], moved[1], moved[2], 0.0, 0.0, 0.0);
        estimate.pose = GroundPose::from_vector(&(estimate.pose.to_vector() + estimate.by_keyframe * moved));
    }

    /// Learns from a measured frame how height and tilt vary, the level of the ground and how much
    /// is usually found.
    fn learn(
        &mut self,
        found: &[FoundCorner],
        estimate: &MotionEstimate,
        update: &KeyframeUpdate,
        inlier_ratio: Option<f64>,
    ) {
        let Some(keyframe) = &mut self.keyframe else { return };
        let from_keyframe = propagated(&estimate.by_keyframe, &update.covariance);
        let improved = GroundPose::from_vector(&(keyframe.pose.to_vector() + update.moved));
        self.learned.rig_prior.learn(estimate, &improved, &from_keyframe);
        self.learned.saw_level(keyframe, found, estimate, self.last.as_ref());
        if keyframe.surface.is_none() && self.frames.is_multiple_of(LEVELLED_EVERY) {
            keyframe.set_level(&self.camera, self.learned.relief_m2());
        }
        if let Some(inlier_ratio) = inlier_ratio {
            self.learned.saw(inlier_ratio, estimate);
        }
    }

    /// The camera is where a frame was measured: the next frame is predicted from here.
    fn follow(&mut self, time_s: f64, estimate: &MotionEstimate, covariance: Matrix6<f64>) {
        self.candidate = None;
        self.recovery.reset();
        if std::mem::take(&mut self.lost_frames) > 0 {
            self.filter = None; // how the camera moved meanwhile is not known
        }
        self.last = Some(match self.last.take() {
            Some(last) => last.moved(time_s, estimate.pose, covariance),
            None => LastPose::still(time_s, estimate.pose, covariance),
        });
        self.learned.saw_step(estimate, self.last.as_ref());
        self.refine_exposure(estimate);
    }

    /// The first frame that shows ground is where the world begins.
    fn begin(&mut self, pyramid: Pyramid, time_s: f64) -> FrameEstimate {
        let (pose, covariance) = (self.first_pose, Matrix6::zeros());
        let (mask, detection) = (self.fixed.mask(), &self.config.detection);
        let mut keyframe = Keyframe::new(pyramid, pose, covariance, mask, &self.camera, detection);
        self.expose_first(&mut keyframe, time_s);
        keyframe.by_mount_tilt.fixed_rows_mut::<2>(4).fill_with_identity();
        self.by_mount_tilt = keyframe.by_mount_tilt;
        self.number(&mut keyframe, (self.frames, time_s), None);
        self.reference = keyframe.id.map(|keyframe| FrameReference { keyframe, next: None });
        let corners = keyframe.corners.len();
        self.show_corners(&keyframe);
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

    /// Where a smaller part of a keyframe's corners supports the movement, it is used up.
    fn enough_support(&self) -> f64 {
        self.config.keyframe.support * self.learned.findable()
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

    /// Propagates the keyframe's covariance to a pose measured against it.
    fn propagated_covariance(&self, pose: &GroundPose) -> Matrix6<f64> {
        let keyframe = self.keyframe.as_ref();
        keyframe.map_or_else(Matrix6::zeros, |keyframe| {
            propagated(&keyframe.pose.lever_arm_to(pose), &keyframe.covariance)
        })
    }

    /// For the mean vector, measured from frame to frame: only the corners just seen are kept, and
    /// covariances add up.
    fn keep_only(&mut self, found: &[FoundCorner], covariance: Matrix6<f64>) {
        if let Some(keyframe) = &mut self.keyframe {
            keyframe.keep_only(found.iter().map(|f| (f.corner, f.warp)));
            keyframe.covariance = covariance;
        }
    }
}

#[cfg(test)]
mod tests;
