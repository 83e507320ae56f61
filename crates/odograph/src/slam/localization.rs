//! Localization of a single image in a map, without changing the map.

use super::Mapper;
use crate::error::Result;
use crate::geometry::GroundPose;
use crate::ground_map::KeyframeImages;
use crate::image::GrayImage;
use crate::keyframe::KeyframeId;
use crate::keyframe::relative_pose::{compose, inverse};
use crate::loop_closure::matching::{CameraIndex, CameraPose};
use crate::loop_closure::recognition::recognise;
use crate::loop_closure::verification;
use nalgebra::Matrix4;

/// A localized image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Located {
    /// Pose of the camera in the map frame; roll and pitch as given.
    pub pose: GroundPose,
    /// The keyframe that it was matched with.
    pub keyframe: KeyframeId,
    /// Covariance of the keyframe's pose in the image's frame: (x, y, heading, logarithm of the
    /// ratio of heights).
    pub covariance: Matrix4<f64>,
    /// Number of matched corners.
    pub inliers: usize,
    /// Inlier ratio: the matched share of the corners in the overlap, 0 to 1.
    pub inlier_ratio: f64,
}

impl Mapper {
    /// Localizes an image of the map's camera, at any position and heading; only height, roll and
    /// pitch of `tilt` are used. `None` if no place is recognised unambiguously.
    ///
    /// Fails if the image size is not the camera's, or a keyframe's image cannot be loaded.
    pub fn locate(
        &self,
        image: GrayImage,
        tilt: &GroundPose,
        images: &mut dyn KeyframeImages,
    ) -> Result<Option<Located>> {
        let camera = &self.map.camera;
        if (image.width(), image.height()) != (camera.width(), camera.height()) {
            return Err(crate::error::Error::input(format!(
                "the picture has {}x{} pixels but the map's camera {}x{}",
                image.width(),
                image.height(),
                camera.width(),
                camera.height()
            )));
        }
        let at = CameraPose { camera: CameraIndex::default(), pose: *tilt, ground: None };
        let query = self.matcher.query(image, &at, self.map.newest_mask_of(camera));
        let signature = self.matcher.signature(&query, &self.places_config);
        // No keyframe has this number: nothing connects the image to the map.
        let new = KeyframeId(u64::MAX);
        let here = (new, &at);
        let found = recognise(
            &self.places,
            &signature,
            &self.graph,
            None,
            here,
            self.config.least_edges,
            &self.matcher,
            &|_| true,
        );
        for place in found.iter().take(self.config.comparisons) {
            let Some(known) = self.keyframe(place.id) else { continue };
            let Some(there) = self.seen_from(place.id) else { continue };
            let reference =
                self.matcher.reference(images.load(place.id)?.gray, &there, self.mask_of(place.id));
            let seen =
                verification::verify_recognised(&self.matcher, &query, &reference, place, new, &self.config);
            if let Some(seen) = seen {
                let scale = known.pose.height_m / known.odometry_pose.height_m;
                let measured_m = [tilt.height_m, known.odometry_pose.height_m];
                let placed = compose(&known.pose, &inverse(&seen.edge.motion, measured_m), scale);
                return Ok(Some(Located {
                    pose: GroundPose { roll_rad: tilt.roll_rad, pitch_rad: tilt.pitch_rad, ..placed },
                    keyframe: place.id,
                    covariance: seen.edge.covariance,
                    inliers: seen.inliers,
                    inlier_ratio: seen.inlier_ratio,
                }));
            }
        }
        Ok(None)
    }
}
