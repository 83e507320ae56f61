//! Tracking: a keyframe's corners are found again in a frame, and the motion on which they agree
//! is its pose.

mod mean_motion;
mod observations;
mod pose_fit;
mod search;
mod visibility;

use super::OdometryConfig;
use super::found_corner::{FoundCorner, FoundCorners};
use super::keyframe::Keyframe;
use super::learned::Learned;
use super::texture::TextureClass;
use crate::buffer::Buffer;
use crate::camera::Camera;
use crate::flow::forward_backward_px;
use crate::geometry::GroundPose;
use crate::image::Pyramid;
use crate::motion::dense::{self, DenseEstimate, DenseImage, TileTrack};
use crate::motion::{MotionEstimate, MotionModel, Random, RigPrior};
use crate::trajectory::LossReason;
pub use observations::track_whitenings;
pub use visibility::still_seen;

/// A frame measured against a keyframe.
#[derive(Debug, Clone)]
pub struct Measurement {
    pub estimate: MotionEstimate,
    /// Where it was looked for.
    pub prediction: GroundPose,
    /// The corners found again, in step with the estimate's inliers.
    pub found: Buffer<FoundCorner>,
    /// Corners of the keyframe that stay in the image while the camera moves.
    pub fixed: Buffer<usize>,
    /// Overlap times inlier ratio: inliers over all corners that the keyframe had, 0 to 1.
    pub support: f64,
    /// Whether the probe corners agreed on a pose from which the rest was searched for: what was
    /// not found from there is not visible.
    pub refined: bool,
    /// Where the whole image was compared: the part of what is in view that agrees, and the tiles
    /// in step with the estimate's inliers.
    pub agreement: Option<f64>,
    pub tiles: Vec<TileTrack>,
}

/// A frame, the keyframe that it is measured against, and what is known of both.
#[derive(Debug, Clone, Copy)]
pub struct Tracker<'a> {
    pub keyframe: &'a Keyframe,
    /// The image of the frame, and the camera that took it.
    pub pyramid: &'a Pyramid,
    pub camera: &'a Camera,
    pub config: &'a OdometryConfig,
    pub learned: &'a Learned,
}

/// A pose that was found from few corners is still right to about this much in the image, pixels.
const FOUND_WITHIN_PX: f64 = 2.0;

/// On an image that looks faint this part of the corners in view must agree with a pose.
const LEAST_ON_FAINT: f64 = 0.5;

/// Where fewer tracks than this fraction come back, blur keeps them from it, and the few that do
/// would give a worse pose. Not derived; chosen.
const MIN_CONFIRMED: f64 = 0.25;

impl Tracker<'_> {
    /// Measures the pose of the frame, somewhere about `prediction`.
    pub fn measure(&self, prediction: &GroundPose, random: &mut Random) -> Result<Measurement, LossReason> {
        let first = self.measure_near(prediction, f64::INFINITY, random)?;
        if self.config.motion.model == MotionModel::Mean || first.refined {
            return Ok(first);
        }
        // Once more from where it was found: corners that were out of reach are now within.
        Ok(match self.measure_near(&first.estimate.pose, FOUND_WITHIN_PX, random) {
            Ok(again) if again.support >= first.support => {
                Measurement { prediction: first.prediction, ..again }
            }
            _ => first,
        })
    }

    /// Measures the pose of the frame if the prediction is off by at most `off_px` in the image.
    pub fn measure_near(
        &self,
        prediction: &GroundPose,
        off_px: f64,
        random: &mut Random,
    ) -> Result<Measurement, LossReason> {
        if self.config.motion.model == MotionModel::Mean {
            return self.fit_pose(self.search_where_last_seen(off_px), prediction, random);
        }
        if self.keyframe.texture() != TextureClass::Faint {
            return self.fit_pose(self.search(prediction, off_px, random), prediction, random);
        }
        // A partly dark or blurred image looks faint, too, but has corners. Only corners determine
        // the skew of a rolling shutter.
        let whole = || self.measure_whole(prediction);
        let mut by_corners = || {
            self.measure_corners(prediction, off_px, random)
                .filter(|found| found.inlier_ratio(self.keyframe, self.camera) >= LEAST_ON_FAINT)
                .ok_or(LossReason::Jump)
        };
        if self.learned.shutter_rolls() {
            by_corners().or_else(|_| whole())
        } else {
            whole().or_else(|lost| by_corners().map_err(|_| lost))
        }
    }

    /// Measures the frame by the corners of the keyframe, whatever its texture; `None` where it has
    /// too few or too few agree.
    pub fn measure_corners(
        &self,
        prediction: &GroundPose,
        off_px: f64,
        random: &mut Random,
    ) -> Option<Measurement> {
        if self.keyframe.corners.len() < 2 * self.config.motion.minimum_inliers {
            return None;
        }
        self.fit_pose(self.search(prediction, off_px, random), prediction, random).ok()
    }

    /// Registers the frame to the whole keyframe: on faint ground no single corner is reliable.
    fn measure_whole(&self, prediction: &GroundPose) -> Result<Measurement, LossReason> {
        let Self { keyframe, camera, .. } = *self;
        let image = DenseImage::new(self.pyramid.base()).without(keyframe.mask.clone());
        let reference = (keyframe.dense(camera), &keyframe.rig_covariance());
        let prior = self.prior(prediction);
        let found = dense::refine(camera, reference, &image, prediction, &prior, &self.config.motion);
        let found =
            found.filter(|found| found.score >= DenseEstimate::LEAST_SCORE).ok_or(LossReason::Jump)?;
        if found.agreement < DenseEstimate::LEAST_AGREEMENT {
            return Err(LossReason::NotPlanar);
        }
        Ok(Measurement {
            estimate: found.estimate,
            prediction: *prediction,
            found: Buffer::new(),
            fixed: Buffer::new(),
            support: found.agreement * found.overlap,
            refined: true,
            agreement: Some(found.agreement),
            tiles: found.tracks,
        })
    }

    /// Registers the frame to the whole keyframe where its corners do not exceed the noise, near
    /// one of the predictions. `None` if they do exceed it, or if the ground is not found.
    pub fn measure_drowned(&self, predictions: [&GroundPose; 2]) -> Option<Measurement> {
        let by_corners = self.keyframe.texture() != TextureClass::Drowned || self.learned.shutter_rolls();
        if self.config.motion.model == MotionModel::Mean || by_corners {
            return None;
        }
        predictions.into_iter().find_map(|prediction| self.measure_whole(prediction).ok())
    }

    /// Drops tracks that fail the forward-backward check and measures again: used where later
    /// frames depend on this one.
    pub fn confirm(&self, measurement: Measurement, random: &mut Random) -> Measurement {
        if measurement.agreement.is_some() {
            return measurement;
        }
        let Self { keyframe, config: OdometryConfig { flow, .. }, .. } = *self;
        let comes_back = |found: &&FoundCorner| {
            let template = &keyframe.corners[found.corner].template;
            forward_backward_px(template, &keyframe.pyramid, self.pyramid, &found.warp, flow)
                .is_some_and(|distance| distance <= flow.forward_backward_px)
        };
        let found: Buffer<FoundCorner> = measurement.found.iter().filter(comes_back).copied().collect();
        if (found.len() as f64) < MIN_CONFIRMED * measurement.found.len() as f64 {
            return measurement;
        }
        let probe_pose = measurement.refined.then_some(measurement.estimate.pose);
        match self.fit_pose(FoundCorners { found, probe_pose }, &measurement.prediction, random) {
            Ok(again) if again.fixed.is_empty() => again.beside(measurement.fixed, keyframe),
            Ok(again) => again,
            Err(_) => measurement,
        }
    }

    /// The prior of height and tilt.
    fn prior(&self, prediction: &GroundPose) -> RigPrior {
        self.learned.rig_prior.prior(prediction, &self.config.motion)
    }
}
