//! The search for a keyframe's corners in a frame.

use super::super::OdometryConfig;
use super::super::found_corner::FoundCorner;
use super::super::keyframe::{KeyCorner, Keyframe};
use super::super::learned::Learned;
use super::observations::observations;
use super::visibility::in_view;
use crate::buffer::Buffer;
use crate::camera::Camera;
use crate::flow::{SEARCH_RADIUS_PX, Track, Warp, dissimilarity, track};
use crate::geometry::{GroundPose, Pixel};
use crate::image::Pyramid;
use crate::motion::{Observations, PatchWarp, Random, ViewingPose, estimate};

/// The corners found again, and the pose that the probe corners agreed on.
pub(super) struct FoundCorners {
    pub(super) found: Buffer<FoundCorner>,
    pub(super) probe_pose: Option<GroundPose>,
}

/// Probe corners: a subset, evenly chosen, of about this many is searched for first. The pose on
/// which they agree predicts the others.
const PROBES: usize = 64;

/// Share of the probe corners in view that must agree on a pose.
const MIN_AGREEING: f64 = 0.6;

/// Typical error of the prediction, pixels, within the reach of the full-resolution image.
const LIKELY_NEAR_PX: f64 = 4.0;

/// Largest error of a prediction from the probe corners' pose, pixels.
const REFINED_PX: f64 = 0.75;

/// Searches for each corner at its predicted position and shape: a subset first, and the rest from
/// the pose that the subset gives, which is exact enough for the full-resolution image alone.
pub(super) fn search(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    prediction: &GroundPose,
    off_px: f64,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> FoundCorners {
    let corners = keyframe.corners.len();
    let every = (corners as f64 * learned.findable()) as usize / PROBES;
    let mut found = Buffer::new();
    let from = learned.viewing(camera, prediction);
    let find = |index: usize, from: &ViewingPose, off_px: f64| {
        find(index, &keyframe.corners[index], keyframe, pyramid, camera, from, off_px, config)
    };
    if every < 2 || off_px <= REFINED_PX {
        found.extend((0..corners).filter_map(|index| find(index, &from, off_px)));
        return FoundCorners { found, probe_pose: None };
    }
    let probes = (0..corners).step_by(every);
    let mut probe_pose = None;
    // Usually the prediction is good and the full-resolution image is enough: the coarser levels
    // are not even computed.
    let likely_near = off_px > SEARCH_RADIUS_PX && off_px <= LIKELY_NEAR_PX;
    let reaches: &[f64] = if likely_near { &[SEARCH_RADIUS_PX, off_px] } else { &[off_px] };
    for &off_px in reaches {
        found.clear();
        found.extend(probes.clone().filter_map(|index| find(index, &from, off_px)));
        probe_pose =
            pose_of_probes(keyframe, probes.clone(), &found, camera, prediction, config, learned, random);
        if probe_pose.is_some() {
            break;
        }
    }
    match probe_pose.map(|pose| learned.viewing(camera, &pose)) {
        Some(from) => {
            // Probe corners that were out of reach are searched for again.
            let probes = found.len();
            let mut next = 0;
            for index in 0..corners {
                if found[..probes].get(next).is_some_and(|probe| probe.corner == index) {
                    next += 1;
                } else {
                    found.extend(find(index, &from, REFINED_PX));
                }
            }
        }
        None => {
            let others = (0..corners).filter(|index| index % every != 0);
            found.extend(others.filter_map(|index| find(index, &from, off_px)));
        }
    }
    FoundCorners { found, probe_pose }
}

/// The pose on which most of the probe corners that should be in view from there agree.
fn pose_of_probes(
    keyframe: &Keyframe,
    probes: impl Iterator<Item = usize>,
    found: &[FoundCorner],
    camera: &Camera,
    prediction: &GroundPose,
    config: &OdometryConfig,
    learned: &Learned,
    random: &mut Random,
) -> Option<GroundPose> {
    let shutter = learned.shutter_at(camera, prediction);
    let shutter = learned.frame_shutter.as_ref().zip(shutter.as_ref());
    let (observations, noise_px) =
        observations(keyframe, found, camera, prediction, shutter, (learned.relief_m2(), 0.0));
    let prior = learned.rig_prior.prior(prediction, &config.motion);
    let shutter = shutter.map(|(prior, shutter)| (prior, shutter.rates));
    let keyframe_covariance = &keyframe.rig_covariance();
    let observations = Observations {
        seen: &observations,
        noise_px,
        keyframe_pose: &keyframe.pose,
        keyframe_covariance,
        shutter,
        shape: None,
    };
    let estimate = estimate(camera, observations, prediction, &prior, &config.motion, random)?;
    let probes = probes.map(|index| &keyframe.corners[index]);
    let expected = in_view(keyframe, probes, camera, &estimate.pose);
    let agree = estimate.inlier_count();
    (agree >= MIN_PROBES && agree as f64 >= MIN_AGREEING * learned.findable() * expected as f64)
        .then_some(estimate.pose)
}

/// Fewest probe corners that must agree on a pose.
const MIN_PROBES: usize = 20;

/// Searches a corner where and in which shape a pose expects it.
fn find(
    index: usize,
    corner: &KeyCorner,
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    camera: &Camera,
    pose: &ViewingPose,
    off_px: f64,
    config: &OdometryConfig,
) -> Option<FoundCorner> {
    let PatchWarp { warp, curvature, .. } = corner.patch.warp(camera, pose)?;
    let parallax = corner.parallax_px(camera, pose);
    let warp =
        Warp { position: Pixel::new(warp.position.x + parallax.x, warp.position.y + parallax.y), ..warp };
    if keyframe.is_masked(warp.position) {
        return None;
    }
    if off_px > SEARCH_RADIUS_PX {
        corner.template.add_coarser_levels(&keyframe.pyramid);
    }
    let (warp, found) = match track(&corner.template, pyramid, &warp, off_px, &config.flow) {
        Ok(found) if found.dissimilarity <= config.flow.dissimilarity => {
            (Warp { position: found.position, ..warp }, found)
        }
        // The predicted shape alone may have been wrong. From a pose with inliers it is not.
        Ok(Track { position, .. }) if off_px > REFINED_PX => {
            dissimilarity(&corner.template, pyramid, &Warp { position, ..warp })
                .filter(|(_, found)| found.dissimilarity <= config.flow.dissimilarity)?
        }
        Ok(_) | Err(_) => return None,
    };
    let bend = corner.template.curvature_bias(&found.noise, &warp.linear, &curvature);
    let position = Pixel::new(warp.position.x - bend.x, warp.position.y - bend.y);
    let covariance_px2 = found.covariance_px2;
    Some(FoundCorner { corner: index, warp: Warp { position, ..warp }, covariance_px2 })
}

/// Searches for each corner where it was last seen; its shape is that of the affine comparison with
/// its first appearance. This is the paper's method, without a model of the camera's rotation.
pub(super) fn search_where_last_seen(
    keyframe: &Keyframe,
    pyramid: &Pyramid,
    off_px: f64,
    config: &OdometryConfig,
) -> Buffer<FoundCorner> {
    let search = |(index, corner): (usize, &KeyCorner)| {
        corner.template.add_coarser_levels(&keyframe.pyramid);
        let Track { position, .. } =
            track(&corner.template, pyramid, &corner.seen, off_px, &config.flow).ok()?;
        let (warp, judged) = dissimilarity(&corner.template, pyramid, &Warp { position, ..corner.seen })?;
        let Track { dissimilarity, covariance_px2, .. } = judged;
        (dissimilarity <= config.flow.dissimilarity).then_some(FoundCorner {
            corner: index,
            warp,
            covariance_px2,
        })
    };
    keyframe.corners.iter().enumerate().filter_map(search).collect()
}
