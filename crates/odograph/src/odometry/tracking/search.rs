//! The search for a keyframe's corners in a frame.

use super::super::found_corner::{FoundCorner, FoundCorners};
use super::super::keyframe::KeyCorner;
use super::Tracker;
use super::pose_fit::PoseFit;
use super::visibility::in_view;
use crate::buffer::Buffer;
use crate::flow::{SEARCH_RADIUS_PX, Track, Warp, dissimilarity, track};
use crate::geometry::{GroundPose, Pixel};
use crate::motion::{PatchWarp, Random, ViewingPose};

/// Probe corners: a subset, evenly chosen, of about this many is searched for first. The pose on
/// which they agree predicts the others.
const PROBES: usize = 64;

/// Share of the probe corners in view that must agree on a pose.
const MIN_AGREEING: f64 = 0.6;

/// Typical error of the prediction, pixels, within the reach of the full-resolution image.
const LIKELY_NEAR_PX: f64 = 4.0;

/// Largest error of a prediction from the probe corners' pose, pixels.
const REFINED_PX: f64 = 0.75;

/// Fewest probe corners that must agree on a pose.
const MIN_PROBES: usize = 20;

impl Tracker<'_> {
    /// Searches for each corner at its predicted position and shape: a subset first, and the rest
    /// from the pose that the subset gives, which is exact enough for the full-resolution image
    /// alone.
    pub(super) fn search(&self, prediction: &GroundPose, off_px: f64, random: &mut Random) -> FoundCorners {
        let corners = self.keyframe.corners.len();
        let every = (corners as f64 * self.learned.findable()) as usize / PROBES;
        let mut found = Buffer::new();
        let from = self.learned.viewing(self.camera, prediction);
        if every < 2 || off_px <= REFINED_PX {
            found.extend((0..corners).filter_map(|index| self.find(index, &from, off_px)));
            return FoundCorners { found, probe_pose: None };
        }
        let probes = (0..corners).step_by(every);
        let mut probe_pose = None;
        // Usually the prediction is good and the full-resolution image is enough: the coarser
        // levels are not even computed.
        let likely_near = off_px > SEARCH_RADIUS_PX && off_px <= LIKELY_NEAR_PX;
        let reaches: &[f64] = if likely_near { &[SEARCH_RADIUS_PX, off_px] } else { &[off_px] };
        for &off_px in reaches {
            found.clear();
            found.extend(probes.clone().filter_map(|index| self.find(index, &from, off_px)));
            probe_pose = self.pose_of_probes(probes.clone(), &found, prediction, random);
            if probe_pose.is_some() {
                break;
            }
        }
        match probe_pose.map(|pose| self.learned.viewing(self.camera, &pose)) {
            Some(from) => {
                // Probe corners that were out of reach are searched for again.
                let probes = found.len();
                let mut next = 0;
                for index in 0..corners {
                    if found[..probes].get(next).is_some_and(|probe| probe.corner == index) {
                        next += 1;
                    } else {
                        found.extend(self.find(index, &from, REFINED_PX));
                    }
                }
            }
            None => {
                let others = (0..corners).filter(|index| index % every != 0);
                found.extend(others.filter_map(|index| self.find(index, &from, off_px)));
            }
        }
        FoundCorners { found, probe_pose }
    }

    /// The pose on which most of the probe corners that should be in view from there agree.
    fn pose_of_probes(
        &self,
        probes: impl Iterator<Item = usize>,
        found: &[FoundCorner],
        prediction: &GroundPose,
        random: &mut Random,
    ) -> Option<GroundPose> {
        let estimate = PoseFit::new(self, found, prediction, random).on_known_ground()?;
        let probes = probes.map(|index| &self.keyframe.corners[index]);
        let expected = in_view(self.keyframe, probes, self.camera, &estimate.pose);
        let agree = estimate.inlier_count();
        (agree >= MIN_PROBES && agree as f64 >= MIN_AGREEING * self.learned.findable() * expected as f64)
            .then_some(estimate.pose)
    }

    /// Searches a corner where and in which shape a pose expects it.
    fn find(&self, index: usize, pose: &ViewingPose, off_px: f64) -> Option<FoundCorner> {
        let Self { keyframe, pyramid, camera, config, .. } = *self;
        let corner = &keyframe.corners[index];
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
        let dissimilarity = found.dissimilarity as f32;
        Some(FoundCorner { corner: index, warp: Warp { position, ..warp }, covariance_px2, dissimilarity })
    }

    /// Searches for each corner where it was last seen; its shape is that of the affine comparison
    /// with its first appearance. This is the paper's method, without a model of the camera's
    /// rotation.
    pub(super) fn search_where_last_seen(&self, off_px: f64) -> FoundCorners {
        let Self { keyframe, pyramid, config, .. } = *self;
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
                dissimilarity: dissimilarity as f32,
            })
        };
        let found = keyframe.corners.iter().enumerate().filter_map(search).collect();
        FoundCorners { found, probe_pose: None }
    }
}
