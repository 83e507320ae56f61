//! Statistics of earlier frames that predict the next one.

use super::found_corner::FoundCorner;
use super::keyframe::Keyframe;
use super::last_pose::LastPose;
use super::shutter::{PoseChange, ShutterState};
use crate::camera::Camera;
use crate::geometry::GroundPose;
use crate::motion::{
    GroundShape, ImageMotion, MotionEstimate, MotionModel, PoseRates, RigPrior, RigPriorEstimator,
    RollingShutter, Roughness, ShutterPrior, Unevenness, ViewingPose,
};
use nalgebra::{Matrix2, Matrix6, Matrix6x2, Vector2};

/// What is learned on the way.
#[derive(Debug, Clone)]
pub struct Learned {
    /// How much height and tilt are seen to move.
    pub rig_prior: RigPriorEstimator,
    /// Recent inlier ratio among the corners in view: below 1 where not everything in view is
    /// ground, or where corners are noise.
    inlier_ratio: Option<f64>,
    /// Recent residual of the inliers, pixels.
    residual_px: Option<f64>,
    /// The smallest residual so far over what white noise of the images explains; grows slowly.
    least_noise_ratio: Option<f64>,
    /// The shutter; `None` where it is taken to be global.
    shutter: Option<ShutterState>,
    /// How rough the ground is.
    roughness: Roughness,
    least_relief_m2: f64,
    /// Variance of the relative scale where the ground may be rough: the mean over this number of
    /// frames.
    scale_variance: f64,
    uneven_frames: f64,
    /// The path so far times the length over which the scale is the same, metres².
    path_m2: Matrix2<f64>,
    /// What is expected of the shutter in the present frame; `None` where it is global.
    pub frame_shutter: Option<ShutterPrior>,
}

/// Weight of the newest frame in the moving average of the inlier ratio: a memory of five frames.
const INLIER_RATIO_RATE: f64 = 0.2;

/// Standard deviation of the elevations of rough ground, at least, a part of the height. A wide one
/// costs nothing: elevations within it are determined by their parallax.
const LEAST_RELIEF: f64 = 0.01;

/// Length of the path over which rough ground has the same error of the scale, in heights: twice
/// what is in view.
const SAME_SCALE: f64 = 2.0;

/// Where at least this part of the tracks agrees, all of them are on the ground.
const ALL_GROUND: f64 = 0.9;

/// Error across the path relative to that along it: slopes that are not known turn steps, too.
/// Measured on undulations of 3 cm over 2 m: a fifth.
const ACROSS_PATH: f64 = 0.2;

/// What is expected before any frame was measured.
const UNKNOWN_INLIER_RATIO: f64 = 0.5;

/// Inlier ratio from which all corners count as found: a few are always missed.
const ALL_FOUND_INLIER_RATIO: f64 = 0.75;

impl Learned {
    /// Nothing yet, of a camera that begins here.
    pub fn new(first: &GroundPose) -> Self {
        Self {
            rig_prior: RigPriorEstimator::new(first),
            inlier_ratio: None,
            residual_px: None,
            least_noise_ratio: None,
            shutter: None,
            roughness: Roughness::default(),
            least_relief_m2: (LEAST_RELIEF * first.height_m).powi(2),
            scale_variance: 0.0,
            uneven_frames: 0.0,
            path_m2: Matrix2::zeros(),
            frame_shutter: None,
        }
    }

    /// The same with a shutter that may roll.
    pub fn with_rolling_shutter(first: &GroundPose, camera: &Camera, model: MotionModel) -> Self {
        let may_roll = model != MotionModel::Mean;
        let shutter = may_roll.then(|| ShutterState::new(camera, first.height_m, model));
        Self { shutter, ..Self::new(first) }
    }

    /// Replaces what depends on the calibration by `fresh`, the rig prior only `with_mount`. The
    /// motion of the camera and the inlier ratio are kept.
    pub fn recalibrate(&mut self, fresh: Self, with_mount: bool) {
        let before = std::mem::replace(self, fresh);
        if !with_mount {
            self.rig_prior = before.rig_prior;
        }
        self.inlier_ratio = before.inlier_ratio;
        self.residual_px = before.residual_px;
        self.least_noise_ratio = before.least_noise_ratio;
        self.scale_variance = before.scale_variance;
        self.uneven_frames = before.uneven_frames;
        self.path_m2 = before.path_m2;
        if let (Some(shutter), Some(before)) = (&mut self.shutter, &before.shutter) {
            shutter.move_as(before);
        }
    }

    /// The shutter; `None` where it is taken to be global.
    pub fn shutter(&self) -> Option<&ShutterState> {
        self.shutter.as_ref()
    }

    /// Predicts how the image at `time_s` is exposed; its motion may have been measured.
    pub fn predict_shutter(&mut self, last: Option<&LastPose>, time_s: f64, measured: Option<&ImageMotion>) {
        let both = last.zip(self.shutter.as_ref());
        self.frame_shutter = both.and_then(|(last, shutter)| shutter.prior(last, time_s, measured));
    }

    /// Learns the elevations of a keyframe's corners, and how rough the ground is, from a measured
    /// frame. Whether the ground was taken to be flat until now and is not.
    pub fn saw_elevations(
        &mut self,
        keyframe: &mut Keyframe,
        found: &[FoundCorner],
        estimate: &MotionEstimate,
        camera: &Camera,
    ) -> bool {
        let was_flat = self.relief_m2() == 0.0;
        let noise_share = (self.noise_ratio() * estimate.noise_px / estimate.residual_px).powi(2).min(1.0);
        self.roughness.learn(&keyframe.learn_elevations(found, estimate, camera), noise_share);
        match estimate.uneven {
            Some(Unevenness::Relief) => self.roughness.begin(),
            Some(Unevenness::NewGround) => keyframe.leave_plane(),
            None => {}
        }
        let becomes_rough = was_flat && self.relief_m2() > 0.0;
        if becomes_rough {
            // What was taken for a skew was the shape of the ground.
            self.shutter.iter_mut().for_each(ShutterState::take_for_global);
        }
        becomes_rough
    }

    /// Learns the level of the ground below the camera from a measured frame.
    pub fn saw_level(
        &mut self,
        keyframe: &Keyframe,
        found: &[FoundCorner],
        estimate: &MotionEstimate,
        last: Option<&LastPose>,
    ) {
        last.into_iter().for_each(|last| self.walk(estimate, last));
        let (mut level, mut weights) = (0.0, 0.0);
        let mut quadrants = [(0.0, 0.0); 4];
        for ((found, seen), agrees) in found.iter().zip(&estimate.elevations).zip(&estimate.inliers) {
            if *agrees {
                let elevation_m = seen.elevation.mean_m;
                let weight = keyframe.level_weight(found.corner, &estimate.pose);
                (level, weights) = (level + weight * elevation_m, weights + weight);
                let (sum, count) = &mut quadrants[keyframe.quadrant(found.corner)];
                (*sum, *count) = (*sum + elevation_m, *count + 1.0);
            }
        }
        let level_m = if weights > 0.0 { level / weights } else { 0.0 };
        let means = quadrants.iter().filter(|(_, count)| *count > 0.0).map(|(sum, count)| sum / count);
        let squares = means.map(|mean_m| (mean_m - level_m).powi(2)).sum::<f64>();
        self.rig_prior.set_ground_level(level_m, 0.25 * squares);
        // Outliers may be a bumper that slides over the ground.
        let agree = estimate.inlier_count() as f64 >= ALL_GROUND * estimate.inliers.len() as f64;
        let is_suspected = self.relief_m2() == 0.0 && agree && !keyframe.undulates();
        let suspected_m2 = if is_suspected { self.roughness.suspected_m2() } else { 0.0 };
        let relative = suspected_m2 / estimate.pose.height_m.powi(2);
        self.uneven_frames += 1.0;
        self.scale_variance += (relative - self.scale_variance) / self.uneven_frames;
    }

    /// What ground that may be rough, and is taken for flat, adds to the covariance of a pose.
    /// Steps are too long or too short by a scale that is the same over some length of the path and
    /// independent beyond it.
    pub fn level_covariance(&self, pose: &GroundPose) -> Matrix6<f64> {
        let mut covariance = Matrix6::zeros();
        let across_m2 = ACROSS_PATH * ACROSS_PATH * self.path_m2.trace();
        let path_m2 = self.path_m2 + Matrix2::from_diagonal_element(across_m2);
        covariance.fixed_view_mut::<2, 2>(0, 0).copy_from(&(self.scale_variance * path_m2));
        covariance[(3, 3)] = self.scale_variance * pose.height_m.powi(2);
        covariance
    }

    /// Adds a step of the path, metres.
    fn walk(&mut self, estimate: &MotionEstimate, last: &LastPose) {
        let (from, to) = (&last.pose, &estimate.pose);
        let step = Vector2::new(to.x_m - from.x_m, to.y_m - from.y_m);
        if step.norm() > 0.0 {
            let over_m = SAME_SCALE * to.height_m;
            self.path_m2 += step * step.transpose() * (over_m / step.norm());
        }
    }

    /// The variance of the elevations of points of which nothing else is known, metres²: zero where
    /// the ground is flat.
    pub fn relief_m2(&self) -> f64 {
        match self.roughness.variance_m2() {
            0.0 => 0.0,
            variance_m2 => variance_m2.max(self.least_relief_m2),
        }
    }

    /// The same where the ground is rough, at least.
    pub fn least_relief_m2(&self) -> f64 {
        self.least_relief_m2
    }

    /// Learns how the camera moves from a measured frame.
    pub fn saw_step(&mut self, estimate: &MotionEstimate, last: Option<&LastPose>) {
        let Some(shutter) = &mut self.shutter else { return };
        let change = last.and_then(|last| {
            let variance = estimate.covariance.diagonal();
            Some(PoseChange { rates: last.pose_rates?, step_s: last.step_s, variance })
        });
        shutter.saw_step(change.as_ref(), estimate.pose.height_m);
    }

    /// The readout time that images are taken to have, seconds.
    pub fn assumed_readout_s(&self) -> f64 {
        self.shutter.as_ref().map_or(0.0, |shutter| shutter.readout().mean_s)
    }

    /// The mean square of what that may be off by, seconds².
    pub fn readout_errors_s2(&self) -> f64 {
        self.shutter.as_ref().map_or(0.0, |shutter| shutter.readout().variance_s2)
    }

    /// What the uncertainty of the readout time adds to the covariance of a pose that changes with
    /// it by `by_readout`.
    pub fn readout_covariance(&self, by_readout: &PoseRates) -> Matrix6<f64> {
        by_readout * by_readout.transpose() * self.readout_errors_s2()
    }

    /// Covariance of a pose from the mean squared errors of the mount's roll and pitch;
    /// `by_mount_tilt` is its derivative by them.
    pub fn mount_covariance(&self, by_mount_tilt: &Matrix6x2<f64>) -> Matrix6<f64> {
        by_mount_tilt * self.rig_prior.mount_tilt_errors() * by_mount_tilt.transpose()
    }

    /// How the present frame is exposed where it was taken at `pose`; `None` for a global shutter.
    pub fn shutter_at(&self, camera: &Camera, pose: &GroundPose) -> Option<RollingShutter> {
        self.frame_shutter.as_ref().map(|prior| prior.shutter_at(camera, pose))
    }

    /// Whether a skew of the present frame would be seen, or there is none.
    pub fn may_see_skew(&self) -> bool {
        self.frame_shutter.is_some() || self.shutter.as_ref().is_none_or(ShutterState::is_global)
    }

    /// Whether the pose of the present frame is fitted with a skew.
    pub fn skew_is_fitted(&self) -> bool {
        self.frame_shutter.as_ref().is_some_and(|prior| prior.applies)
    }

    /// The shape of a keyframe's ground where it is to be estimated: beside a skew, for which an
    /// unknown slope would pass.
    pub fn shape(&self, keyframe: &Keyframe, prior: &RigPrior) -> Option<GroundShape> {
        self.shutter_rolls().then(|| keyframe.shape(prior.holds_tilt())).flatten()
    }

    /// Whether the present frame is taken to be skewed by a rolling shutter.
    pub fn shutter_rolls(&self) -> bool {
        self.frame_shutter.as_ref().is_some_and(|prior| prior.readout.mean_s != 0.0)
    }

    /// The present frame's view from `pose`.
    pub fn viewing(&self, camera: &Camera, pose: &GroundPose) -> ViewingPose {
        match self.shutter_at(camera, pose) {
            Some(shutter) => ViewingPose::with_rolling_shutter(*pose, &shutter),
            None => ViewingPose::new(*pose),
        }
    }

    /// The images have another noise from here on.
    pub fn forget_noise(&mut self) {
        (self.residual_px, self.least_noise_ratio) = (None, None);
    }

    /// A frame was measured, and this part of the corners in view agreed.
    pub fn saw(&mut self, inlier_ratio: f64, estimate: &MotionEstimate) {
        let residual_px = estimate.residual_px;
        for (usual, now) in [(&mut self.inlier_ratio, inlier_ratio), (&mut self.residual_px, residual_px)] {
            let usual = usual.get_or_insert(now);
            *usual += INLIER_RATIO_RATE * (now - *usual);
        }
        // Whole images that were registered predict no noise.
        if estimate.noise_px.is_finite() {
            let ratio = residual_px / estimate.noise_px;
            let least = self.least_noise_ratio.map_or(ratio, |least| ratio.min(NOISE_CHANGES * least));
            self.least_noise_ratio = Some(least);
        }
    }

    /// What the noise of the images leaves in a fit, over what it would leave if it were white: a
    /// camera that sharpens, denoises, scales or compresses its images correlates their noise. It
    /// is what is left in the frame whose residual is least, which shows the ground from nearly
    /// where its keyframe does.
    pub fn noise_ratio(&self) -> f64 {
        self.least_noise_ratio.map_or(1.0, |least| least.max(1.0))
    }

    /// Whether the last frames fitted the ground as it is known. A wrong lens is like curved
    /// ground, but leaves residuals on known ground, too.
    pub fn fits_ground(&self) -> bool {
        self.residual_px.is_some_and(|usual_px| usual_px < EXACT_PX)
    }

    /// The part of the corners in view that usually agrees, 0 to 1.
    pub fn usual_inlier_ratio(&self) -> f64 {
        self.inlier_ratio.unwrap_or(UNKNOWN_INLIER_RATIO)
    }

    /// Fraction of a keyframe's corners that can be expected to be found again, 0 to 1. On plain
    /// tiles in noise most apparent corners are noise; their absence neither ends a keyframe nor a
    /// search.
    pub fn findable(&self) -> f64 {
        self.inlier_ratio.map_or(1.0, |usual| (usual / ALL_FOUND_INLIER_RATIO).min(1.0))
    }
}

/// Growth of the smallest ratio of residual and noise in a frame: noise that changes is learned
/// within a hundred frames.
pub const NOISE_CHANGES: f64 = 1.01;

/// Residual, pixels, below which the ground as it is known explains the tracks: half of what shows
/// a kerb (`POOR_PX`).
const EXACT_PX: f64 = 0.05;
