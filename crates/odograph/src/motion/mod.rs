//! Subsystem 5: motion estimation. The pose of the camera, with covariance, from corners whose
//! positions on the ground are known and that were tracked into the present frame.
//!
//! All models but `mean` are one estimator, planar PnP: the pose that re-projects the ground points
//! onto their tracks, found by RANSAC (M. Fischler and R. Bolles, 1981) and refined by robust
//! Gauss–Newton, with a prior on height and tilt. `mean` is the mean vector of the paper, kept for
//! comparison. Derivation: `docs/math/frame-pose.md`.

mod coarse;
pub mod dense;
mod elevation;
mod global_image;
mod ground_patch;
mod ground_shape;
mod mean;
mod model_error;
mod mount_tilt;
mod normal_equations;
mod nuisance;
mod planar_pose;
mod pose_covariance;
mod random;
mod ransac;
mod residual;
mod rig_evidence;
mod rig_prior;
mod rolling_shutter;
mod measured_motion;
mod correlated_noise;

pub use coarse::{CoarseOptions, CoarseRegistration, GroundView, Hypothesis};
pub use correlated_noise::ResidualCorrelation;
pub use elevation::{Elevation, MAX_KERB_HEIGHT, MeasuredElevation, Roughness, SIGNIFICANT_SQUARED};
pub use global_image::global_image;
pub use ground_patch::{GroundFromRay, GroundPatch, PatchWarp, ViewingPose};
pub use ground_shape::{GroundShape, ShapeEstimate, UNKNOWN_SLOPE};
pub use mean::mean_displacement;
pub use measured_motion::{ImageMotion, MeasuredMotion};
pub use random::Random;
pub use residual::Axes;
pub(crate) use residual::{ground_by_pose, residual};
pub use rig_prior::{RigPrior, RigPriorEstimator};
pub use rolling_shutter::{ExpectedRates, PoseRates, Readout, RollingShutter, ShutterEstimate, ShutterPrior};

use crate::buffer::{Buffer, stored};
use crate::camera::Camera;
use crate::geometry::{GroundPoint, GroundPose, Pixel};
use crate::numerics::median;
use nalgebra::{Matrix2, Matrix3, Matrix6, Matrix6x2, Vector3};
use serde::{Deserialize, Serialize};

/// Degrees of freedom between frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MotionModel {
    /// x, y and heading; height and tilt with a prior that is learned from the recording.
    Auto,
    /// The mean vector of the paper: x and y without heading. Kept for comparison and teaching.
    Mean,
    /// x, y and heading; height and tilt are the rig's.
    Rigid,
    /// x, y, heading and height; the tilt is the rig's.
    Similarity,
    /// All six: a hand-held or flying camera.
    Free,
}

impl std::fmt::Display for MotionModel {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Auto => "auto",
            Self::Mean => "mean",
            Self::Rigid => "rigid",
            Self::Similarity => "similarity",
            Self::Free => "free",
        })
    }
}

impl MotionModel {
    /// Number of unknowns among (x, y, heading, height, roll, pitch), in this order.
    fn unknowns(self) -> usize {
        match self {
            Self::Mean => 2,
            Self::Rigid => 3,
            Self::Similarity => 4,
            Self::Auto | Self::Free => 6,
        }
    }

    /// Whether nothing holds the height, so that scale drifts.
    pub fn scale_is_free(self) -> bool {
        matches!(self, Self::Similarity | Self::Free)
    }
}

/// Configuration of motion estimation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MotionConfig {
    /// Degrees of freedom between frames.
    pub model: MotionModel,
    /// Largest re-projection error of an inlier, pixels of an image 640 wide; the pipeline scales
    /// it in proportion to the width.
    pub inlier_px: f64,
    /// Minimum number of inliers of a measurement.
    pub minimum_inliers: usize,
    /// Minimum inlier ratio of a measurement.
    pub minimum_inlier_fraction: f64,
    /// Standard deviation of the height against the previous frame, as a fraction of the height
    /// (`similarity` and `free`).
    pub height_prior: f64,
    /// Standard deviation of roll and pitch against the previous frame, radians (`free`).
    pub tilt_prior_rad: f64,
}

impl Default for MotionConfig {
    fn default() -> Self {
        Self {
            model: MotionModel::Auto,
            inlier_px: 2.0,
            minimum_inliers: 12,
            minimum_inlier_fraction: 0.2,
            height_prior: 0.2,
            tilt_prior_rad: 0.2,
        }
    }
}

/// A 2D–3D correspondence: a ground point and the pixel at which it is seen in the present frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// The ground point, as its keyframe places it.
    pub ground: GroundPoint,
    /// Elevation of the point.
    pub elevation: Elevation,
    /// Pixel of the track in the present frame.
    pub pixel: Pixel,
    /// Whitening matrix: the inverse square root of the covariance of the pixel, relative to a
    /// median track. The identity weighs both coordinates alike; a track on a straight edge has
    /// weight across the edge only.
    pub whitening: Matrix2<f64>,
    /// Row of the pixel relative to the image, −1/2 at the top to 1/2 at the bottom: its exposure
    /// time in units of the readout time.
    pub row_fraction: f64,
    /// Row of the corner in the keyframe, in the same units.
    pub keyframe_row_fraction: f64,
    /// Position of the keyframe's camera when that row was exposed, metres.
    pub centre_of_projection: Vector3<f64>,
    /// Elevation for which the pixel was corrected to a global shutter, metres.
    pub corrected_at_m: f64,
}

stored!(Observation);

/// All correspondences with one keyframe.
#[derive(Debug, Clone, Copy)]
pub struct Observations<'a> {
    /// The correspondences.
    pub seen: &'a [Observation],
    /// Standard deviation of the median track by the noise of the images, pixels; infinite if
    /// all scatter is treated as noise.
    pub noise_px: f64,
    /// Pose of the keyframe, which defines the ground points.
    pub keyframe_pose: &'a GroundPose,
    /// Covariance of height, roll and pitch of the keyframe, metres and radians.
    pub keyframe_covariance: &'a Matrix3<f64>,
    /// Prior of a rolling shutter, and the pose rates with which the pixels were corrected to a
    /// global shutter; `None` for a global shutter.
    pub shutter: Option<(&'a ShutterPrior, PoseRates)>,
    /// The error that the elevations of all points share, only beside a skew that is fitted; `None`
    /// where their errors are independent.
    pub shape: Option<&'a GroundShape>,
}

/// A ground point found in an image, with the covariance of its pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correspondence {
    /// The ground point.
    pub ground: GroundPoint,
    /// Elevation of the point.
    pub elevation: Elevation,
    /// Pixel at which it was found.
    pub pixel: Pixel,
    /// Covariance of the pixel, pixels².
    pub covariance_px2: Matrix2<f64>,
    /// See [`Observation::row_fraction`].
    pub row_fraction: f64,
    /// See [`Observation::keyframe_row_fraction`].
    pub keyframe_row_fraction: f64,
    /// See [`Observation::centre_of_projection`].
    pub centre_of_projection: Vector3<f64>,
}

stored!(Correspondence);

/// Whitened observations, and the standard deviation of the median track, pixels. `shared_px2` is
/// added to the variance of each coordinate: noise that tracks share, so that no track dominates.
/// `None` without correspondences.
pub fn whitened(correspondences: &[Correspondence], shared_px2: f64) -> Option<(Buffer<Observation>, f64)> {
    let covariance = |seen: &Correspondence| seen.covariance_px2 + shared_px2 * Matrix2::identity();
    let mut variances: Buffer<f64> =
        correspondences.iter().map(|seen| 0.5 * covariance(seen).trace()).collect();
    let median_px2 = median(&mut variances)?;
    Some((observations(correspondences, shared_px2, median_px2), median_px2.sqrt()))
}

/// Observations whitened relative to one with the variance `unit_px2` in each coordinate.
fn observations(correspondences: &[Correspondence], shared_px2: f64, unit_px2: f64) -> Buffer<Observation> {
    let covariance = |seen: &Correspondence| seen.covariance_px2 + shared_px2 * Matrix2::identity();
    let observation = |seen: &Correspondence| Observation {
        ground: seen.ground,
        elevation: seen.elevation,
        pixel: seen.pixel,
        whitening: whitening(&covariance(seen), unit_px2),
        row_fraction: seen.row_fraction,
        keyframe_row_fraction: seen.keyframe_row_fraction,
        centre_of_projection: seen.centre_of_projection,
        corrected_at_m: seen.elevation.mean_m,
    };
    correspondences.iter().map(observation).collect()
}

/// Whitening matrix of a pixel with this covariance, relative to one with the variance `unit_px2`
/// in each coordinate.
pub fn whitening(covariance_px2: &Matrix2<f64>, unit_px2: f64) -> Matrix2<f64> {
    let information = covariance_px2.try_inverse().map(|inverse| unit_px2 * inverse);
    let root = information.and_then(|information| information.cholesky());
    root.map_or(Matrix2::identity(), |root| root.l().transpose())
}

/// An estimated pose.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionEstimate {
    /// The pose of the camera.
    pub pose: GroundPose,
    /// Covariance of (x, y, heading, height, roll, pitch) given the ground points; rows of fixed
    /// unknowns are zero.
    pub covariance: Matrix6<f64>,
    /// The same by errors of the model, which the fit does not account for: considered errors
    /// (S. Schmidt, 1966).
    pub model_covariance: Matrix6<f64>,
    /// Derivative of the pose by the pose of the keyframe, through which the keyframe's covariance
    /// propagates.
    pub by_keyframe: Matrix6<f64>,
    /// Derivative of the pose by roll and pitch of the prior's mean.
    pub by_prior_tilt: Matrix6x2<f64>,
    /// Estimated error of the keyframe's height and tilt; `None` where these are known.
    pub keyframe_error: Option<KeyframeError>,
    /// For each observation, whether it is an inlier.
    pub inliers: Buffer<bool>,
    /// Root mean square re-projection error of the inliers, pixels.
    pub residual_px: f64,
    /// [`Observations::noise_px`].
    pub noise_px: f64,
    /// Correlation of the residuals of neighbouring tracks.
    pub residual_correlation: ResidualCorrelation,
    /// Height and tilt from the tracks alone, without the prior; only where all three are unknowns
    /// of the fit.
    pub rig_evidence: Option<RigEvidence>,
    /// Elevation of each observation given the pose; empty where observations are not single
    /// points.
    pub elevations: Buffer<MeasuredElevation>,
    /// Estimate of [`Observations::shape`].
    pub shape: Option<ShapeEstimate>,
    /// Whether only ground that is not flat explains the tracks.
    pub uneven: Option<Unevenness>,
    /// Estimate of the shutter's skew, where the shutter may roll.
    pub shutter: Option<ShutterEstimate>,
}

/// How ground is not flat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unevenness {
    /// All of it is rough, or undulates.
    Relief,
    /// What has come into view since the last keyframe is off the plane that it saw.
    NewGround,
}

/// Error of a keyframe's height (metres), roll and pitch (radians), as a frame measured against it
/// observes it: the homography of a plane determines its tilt in both views.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframeError {
    /// Mean.
    pub mean: Vector3<f64>,
    /// Posterior covariance.
    pub covariance: Matrix3<f64>,
}

/// Height (metres), roll and pitch (radians) from the tracks of a frame alone: the likelihood
/// without the prior.
#[derive(Debug, Clone, PartialEq)]
pub struct RigEvidence {
    /// Maximum of the likelihood.
    pub value: Vector3<f64>,
    /// Covariance given the keyframe.
    pub covariance: Matrix3<f64>,
    /// Derivative of the three by those of the keyframe's pose.
    pub by_keyframe: Matrix3<f64>,
}

impl MotionEstimate {
    /// Number of inliers.
    pub fn inlier_count(&self) -> usize {
        self.inliers.iter().filter(|&&agrees| agrees).count()
    }
}

/// Estimates the pose of the camera from `observations`. `prediction` starts the search and has the
/// height and tilt that the model holds fixed; `prior` is the prior of what it estimates. `None`
/// where too few observations agree on any pose.
///
/// `random` draws the samples of RANSAC: the same state gives the same result.
pub fn estimate(
    camera: &Camera,
    observations: Observations<'_>,
    prediction: &GroundPose,
    prior: &RigPrior,
    config: &MotionConfig,
    random: &mut Random,
) -> Option<MotionEstimate> {
    let (initial, inliers) = ransac::consensus(camera, observations, prediction, prior, config, random)?;
    let are_enough = |count: usize| {
        count >= config.minimum_inliers
            && count as f64 >= config.minimum_inlier_fraction * observations.seen.len() as f64
    };
    if !are_enough(inliers.iter().filter(|&&agrees| agrees).count()) {
        return None;
    }
    let estimate = planar_pose::refine(camera, observations, &initial, &inliers, prediction, prior, config)?;
    are_enough(estimate.inlier_count()).then_some(estimate)
}

#[cfg(test)]
mod tests;
