//! Subsystem 5: movement parameters. From corners whose place on the ground is known and that were found again, where the camera is
//! now, with its covariance.
//!
//! The models are one estimator: the pose that re-projects the ground points onto their tracks (a planar PnP), found by RANSAC
//! (M. Fischler and R. Bolles, 1981) and refined by robust Gauss–Newton, with a prior that says how far height and tilt may be from
//! what they were. Only `mean` is different: it is the paper's mean vector, kept for comparison.

mod coarse;
pub mod dense;
mod elevation;
mod global_image;
mod ground_patch;
mod mean;
mod normal_equations;
mod planar_pose;
mod random;
mod ransac;
mod rig_prior;
mod rolling_shutter;
mod sharing;

pub use coarse::{CoarseOptions, CoarseRegistration, GroundView, Hypothesis};
pub use elevation::{BEYOND_CHANCE, Elevation, MeasuredElevation, Roughness};
pub use global_image::global_image;
pub use ground_patch::{GroundFromRay, GroundPatch, PatchWarp, ViewingPose};
pub use mean::mean_displacement;
pub use planar_pose::{Axes, HIGHEST_KERB};
pub use random::Random;
pub use rig_prior::{RigPrior, RigWander};
pub use rolling_shutter::{PoseRates, Readout, RollingShutter, ShutterEstimate, ShutterPrior};
pub use sharing::Neighbours;

use crate::buffer::{Buffer, stored};
use crate::camera::Camera;
use crate::geometry::{GroundPoint, GroundPose, Pixel};
use nalgebra::{Matrix2, Matrix3, Matrix6, Matrix6x2, Vector3};
use serde::{Deserialize, Serialize};

/// What may change between frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MotionModel {
    /// x, y and heading; height and tilt as far as the recording shows that they change.
    Auto,
    /// The mean vector of the paper: x and y only, heading never. Kept for comparison and teaching.
    Mean,
    /// x, y and heading; height and tilt are those of the rig.
    Rigid,
    /// x, y, heading and height; the tilt is that of the rig.
    Similarity,
    /// All six: the camera is held by hand, or flies.
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
    /// How many of (x, y, heading, height, roll, pitch), in this order, with height before tilt, are unknown.
    fn unknowns(self) -> usize {
        match self {
            Self::Mean => 2,
            Self::Rigid => 3,
            Self::Similarity => 4,
            Self::Auto | Self::Free => 6,
        }
    }
}

/// How movement is estimated.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MotionConfig {
    /// What may change between frames.
    pub model: MotionModel,
    /// A track further than this from where a movement puts it speaks against that movement, pixels of an image 640 wide; the
    /// pipeline takes more for wider ones, in proportion.
    pub inlier_px: f64,
    /// Fewer agreeing tracks than this are no measurement.
    pub minimum_inliers: usize,
    /// A smaller part of the tracks than this is no agreement.
    pub minimum_inlier_fraction: f64,
    /// Standard deviation of the height against the frame before, as a part of it (`similarity` and `free`).
    pub height_prior: f64,
    /// Standard deviation of roll and pitch against the frame before, radians (`free`).
    pub tilt_prior_rad: f64,
}

impl Default for MotionConfig {
    fn default() -> Self {
        Self {
            model: MotionModel::Auto,
            inlier_px: 2.0,
            minimum_inliers: 12,
            minimum_inlier_fraction: 0.35,
            height_prior: 0.2,
            tilt_prior_rad: 0.2,
        }
    }
}

/// A ground point and the pixel at which it is seen now.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Where the point lies, as its keyframe placed it.
    pub ground: GroundPoint,
    /// How high.
    pub elevation: Elevation,
    /// Where the track is in the present frame.
    pub pixel: Pixel,
    /// What a distance from there is multiplied with to be as uncertain in every direction as that of a usual track: the identity weighs both
    /// coordinates alike, a track on a straight edge counts across it only.
    pub whitening: Matrix2<f64>,
    /// Where its row lies in the image, −1/2 to 1/2: when it was exposed, in units of the readout time.
    pub row_fraction: f64,
    /// The same of its corner in the keyframe.
    pub keyframe_row_fraction: f64,
}

stored!(Observation);

/// All that was found again of what one keyframe shows.
#[derive(Debug, Clone, Copy)]
pub struct Observations<'a> {
    /// Ground points where they are seen now.
    pub seen: &'a [Observation],
    /// The pose from which the keyframe laid them on the ground.
    pub laid_from: &'a GroundPose,
    /// Covariance of the height, roll and pitch of that, metres and radians.
    pub laid_covariance: &'a Matrix3<f64>,
    /// What is known of a rolling shutter, and the rates of the pose with which the pixels were brought
    /// to a global one; `None` where the shutter is global.
    pub shutter: Option<(&'a ShutterPrior, PoseRates)>,
}

/// Where a ground point was found, and how exactly.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sighting {
    /// Where the point lies.
    pub ground: GroundPoint,
    /// How high.
    pub elevation: Elevation,
    /// Where it was found.
    pub pixel: Pixel,
    /// Covariance of that, pixels².
    pub covariance_px2: Matrix2<f64>,
    /// As [`Observation::row_fraction`].
    pub row_fraction: f64,
    /// As [`Observation::keyframe_row_fraction`].
    pub keyframe_row_fraction: f64,
}

stored!(Sighting);

/// The observations that sightings make, each weighed by how well it is known in each direction, and the standard deviation of a usual one (the
/// median), pixels. `shared_px2` is the variance of what all are off by anyway, in either direction; where that is more than their noise all count
/// alike. `None` without sightings.
pub fn whitened(sightings: &[Sighting], shared_px2: f64) -> Option<(Buffer<Observation>, f64)> {
    let covariance = |seen: &Sighting| seen.covariance_px2 + shared_px2 * Matrix2::identity();
    let mut variances: Buffer<f64> = sightings.iter().map(|seen| 0.5 * covariance(seen).trace()).collect();
    if variances.is_empty() {
        return None;
    }
    let middle = variances.len() / 2;
    let usual_px2 = *variances.select_nth_unstable_by(middle, f64::total_cmp).1;
    let observation = |seen: &Sighting| {
        let information = covariance(seen).try_inverse().map(|inverse| usual_px2 * inverse);
        let root = information.and_then(|information| information.cholesky());
        let whitening = root.map_or(Matrix2::identity(), |root| root.l().transpose());
        Observation {
            ground: seen.ground,
            elevation: seen.elevation,
            pixel: seen.pixel,
            whitening,
            row_fraction: seen.row_fraction,
            keyframe_row_fraction: seen.keyframe_row_fraction,
        }
    };
    Some((sightings.iter().map(observation).collect(), usual_px2.sqrt()))
}

/// A measured pose.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionEstimate {
    /// Where the camera is.
    pub pose: GroundPose,
    /// Covariance of (x, y, heading, height, roll, pitch) given the ground points; zero rows for what the model holds fixed.
    pub covariance: Matrix6<f64>,
    /// How the pose changes with (x, y, heading, height, roll, pitch) of the pose from which the ground points were laid: their uncertainty is carried
    /// over by it.
    pub by_keyframe: Matrix6<f64>,
    /// How the pose changes with the roll and the pitch about which the prior scatters.
    pub by_prior_tilt: Matrix6x2<f64>,
    /// What the tracks say of the keyframe's height and tilt; `None` where these were known before.
    pub keyframe_error: Option<KeyframeError>,
    /// For each observation, whether it agrees.
    pub inliers: Buffer<bool>,
    /// Root mean square distance of the inliers from their re-projections, pixels.
    pub residual_px: f64,
    /// How alike the errors of neighbouring tracks are.
    pub neighbours: Neighbours,
    /// What the tracks alone say of height and tilt; only where all three were unknown.
    pub rig_evidence: Option<RigEvidence>,
    /// Elevation of each observation given the pose; empty where these are no single points.
    pub elevations: Buffer<MeasuredElevation>,
    /// Whether the tracks agree only on ground that is not flat.
    pub needs_relief: bool,
    /// What the tracks say of the shutter, where it may roll.
    pub shutter: Option<ShutterEstimate>,
}

/// How far height (metres), roll and pitch (radians) of a keyframe are from what they were taken
/// for, as a frame measured against it has them: a plane seen from two places tells how both stand
/// over it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframeError {
    /// How far.
    pub mean: Vector3<f64>,
    /// The covariance that is left.
    pub covariance: Matrix3<f64>,
}

/// What the tracks of a frame alone, without a prior, say of height (metres), roll and pitch (radians).
#[derive(Debug, Clone, PartialEq)]
pub struct RigEvidence {
    /// What they say.
    pub value: [f64; 3],
    /// The variance of each.
    pub variance: [f64; 3],
    /// How the three change with those of the pose from which the ground points were laid.
    pub by_keyframe: Matrix3<f64>,
}

impl MotionEstimate {
    /// How many observations agree.
    pub fn inlier_count(&self) -> usize {
        self.inliers.iter().filter(|&&agrees| agrees).count()
    }
}

/// The pose of the camera from `observations`, near `prediction`, whose height and tilt are the truth in what the model holds fixed; of the
/// rest, `prior` says what is known. `None` where too few observations agree on any movement.
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
    let (start, agreeing) = ransac::consensus(camera, observations, prediction, prior, config, random)?;
    let enough = |inliers: usize| {
        inliers >= config.minimum_inliers
            && inliers as f64 >= config.minimum_inlier_fraction * observations.seen.len() as f64
    };
    if !enough(agreeing.iter().filter(|&&agrees| agrees).count()) {
        return None;
    }
    let estimate = planar_pose::refine(camera, observations, &start, &agreeing, prediction, prior, config)?;
    enough(estimate.inlier_count()).then_some(estimate)
}

#[cfg(test)]
mod tests;
