//! Tracking: a keyframe's corners are found again in a frame, and the motion on which they agree
//! is its pose.

mod mean_motion;
mod observations;
mod pose_fit;
mod search;
mod visibility;

use super::OdometryConfig;
use super::found_corner::FoundCorner;
use super::keyframe::Keyframe;
use super::learned::Learned;
use super::texture::TextureClass;
use crate::buffer::Buffer;
use crate::camera::Camera;
use crate::flow::forward_backward_px;
use crate::geometry::GroundPose;
use crate::image::Pyramid;
use crate::motion::dense::{self, DenseEstimate, DenseImage, TileTrack};
use crate::motion::{MotionEstimate, MotionModel, Random};
use crate::trajectory::LossReason;
pub use observations::track_whitenings;
use pose_fit::fit_pose;
use search::{FoundCorners, search, search_where_last_seen};
pub use visibility::{reason_of_loss, still_seen};

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

/// Measures the pose of a frame against a keyframe, somewhere about `prediction`.
pub fn measure(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    prediction: &GroundPose,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> Result<Measurement, LossReason> {
    let first = measure_near(keyframe, pyramid, camera, prediction, f64::INFINITY, config, learned, random)?;
    if config.motion.model == MotionModel::Mean || first.refined {
        return Ok(first);
    }
    // Once more from where it was found: corners that were out of reach are now within.
    let found = first.estimate.pose;
    Ok(match measure_near(keyframe, pyramid, camera, &found, FOUND_WITHIN_PX, config, learned, random) {
        Ok(again) if again.support >= first.support => Measurement { prediction: first.prediction, ..again },
        _ => first,
    })
}

/// A pose that was found from few corners is still right to about this much in the image, pixels.
const FOUND_WITHIN_PX: f64 = 2.0;

/// Measures the pose of a frame against a keyframe if the prediction is off by at most `off_px` in
/// the image.
pub fn measure_near(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    prediction: &GroundPose,
    off_px: f64,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> Result<Measurement, LossReason> {
    if config.motion.model != MotionModel::Mean && keyframe.texture() == TextureClass::Faint {
        // A partly dark or blurred image looks faint, too, but has corners. Only corners determine
        // the skew of a rolling shutter.
        let whole = || measure_whole(keyframe, pyramid, camera, prediction, config, learned);
        let by_corners = |random: &mut Random| {
            measure_corners(keyframe, pyramid, camera, prediction, off_px, config, learned, random)
                .filter(|found| found.inlier_ratio(keyframe, camera) >= LEAST_ON_FAINT)
                .ok_or(LossReason::Jump)
        };
        return if learned.shutter_rolls() {
            by_corners(random).or_else(|_| whole())
        } else {
            whole().or_else(|lost| by_corners(random).map_err(|_| lost))
        };
    }
    let found = if config.motion.model == MotionModel::Mean {
        FoundCorners { found: search_where_last_seen(keyframe, pyramid, off_px, config), probe_pose: None }
    } else {
        search(keyframe, pyramid, camera, prediction, off_px, config, learned, random)
    };
    fit_pose(keyframe, found, camera, prediction, config, learned, random)
}

/// Measures a frame by the corners of a keyframe, whatever its texture; `None` where it has too few
/// or too few agree.
pub fn measure_corners(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    prediction: &GroundPose,
    off_px: f64,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> Option<Measurement> {
    if keyframe.corners.len() < 2 * config.motion.minimum_inliers {
        return None;
    }
    let corners = search(keyframe, pyramid, camera, prediction, off_px, config, learned, random);
    fit_pose(keyframe, corners, camera, prediction, config, learned, random).ok()
}

/// On an image that looks faint this part of the corners in view must agree with a pose.
const LEAST_ON_FAINT: f64 = 0.5;

/// Registers a frame to a whole keyframe: on faint ground no single corner is reliable.
fn measure_whole(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    prediction: &GroundPose,
    config: &OdometryConfig,
    learned: &Learned,
) -> Result<Measurement, LossReason> {
    let image = DenseImage::new(pyramid.base()).without(keyframe.mask.clone());
    let prior = learned.rig_prior.prior(prediction, &config.motion);
    let found = dense::refine(camera, keyframe.dense(camera), &image, prediction, &prior, &config.motion);
    let found = found.filter(|found| found.score >= DenseEstimate::LEAST_SCORE).ok_or(LossReason::Jump)?;
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

/// Registers a frame to a whole keyframe whose corners do not exceed the noise, near one of two
/// predictions. `None` if they do exceed it, or if the ground is not found.
pub fn measure_drowned(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    predictions: [&GroundPose; 2],
    config: &OdometryConfig,
    learned: &Learned,
) -> Option<Measurement> {
    let by_corners = keyframe.texture() != TextureClass::Drowned || learned.shutter_rolls();
    if config.motion.model == MotionModel::Mean || by_corners {
        return None;
    }
    predictions
        .iter()
        .find_map(|prediction| measure_whole(keyframe, pyramid, camera, prediction, config, learned).ok())
}

/// Drops tracks that fail the forward-backward check and measures again: used where later frames
/// depend on this one.
pub fn confirm(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    measurement: Measurement,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> Measurement {
    if measurement.agreement.is_some() {
        return measurement;
    }
    let comes_back = |found: &&FoundCorner| {
        let template = &keyframe.corners[found.corner].template;
        forward_backward_px(template, &keyframe.pyramid, pyramid, &found.warp, &config.flow)
            .is_some_and(|distance| distance <= config.flow.forward_backward_px)
    };
    let found: Buffer<FoundCorner> = measurement.found.iter().filter(comes_back).copied().collect();
    if (found.len() as f64) < MIN_CONFIRMED * measurement.found.len() as f64 {
        return measurement;
    }
    let found = FoundCorners { found, probe_pose: measurement.refined.then_some(measurement.estimate.pose) };
    match fit_pose(keyframe, found, camera, &measurement.prediction, config, learned, random) {
        Ok(again) if again.fixed.is_empty() => again.beside(measurement.fixed, keyframe),
        Ok(again) => again,
        Err(_) => measurement,
    }
}

/// Where fewer tracks than this fraction come back, blur keeps them from it, and the few that do
/// would give a worse pose. Not derived; chosen.
const MIN_CONFIRMED: f64 = 0.25;
