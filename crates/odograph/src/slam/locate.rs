//! Where a single picture is in the map, without taking it in.

use super::Mapper;
use super::closure;
use super::recognition::recognise;
use crate::error::Result;
use crate::geometry::GroundPose;
use crate::image::GrayImage;
use crate::mapping::plane_motion::{inverse, laid_from};
use crate::mapping::{KeyframeId, KeyframeImages};
use nalgebra::Matrix4;

/// A picture found in the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Located {
    /// Where the camera is, in the map frame; roll and pitch as they were given.
    pub pose: GroundPose,
    /// The keyframe that shows the same ground.
    pub keyframe: KeyframeId,
    /// Covariance of how the picture sees that keyframe: (x, y, heading, logarithm of the ratio of heights).
    pub covariance: Matrix4<f64>,
    /// Corners that were found again.
    pub inliers: usize,
    /// How large a part they are of those that should be in view, 0 to 1.
    pub presence: f64,
}

impl Mapper {
    /// Finds a picture of the map's camera in the map, anywhere and at any heading; of `leaning` only height, roll and pitch count. The map stays as it
    /// is. `None` where no ground is recognised without doubt.
    ///
    /// Fails where the picture has not the camera's size, and where a keyframe's image cannot be read.
    pub fn locate(
        &self,
        image: GrayImage,
        leaning: &GroundPose,
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
        let sought = self.matcher.sought(image, leaning);
        let signature = sought.signature(camera, &self.places_config);
        // A number that no keyframe has, and no way to any: nothing is known of where it is.
        let new = KeyframeId(u64::MAX);
        let here = (new, leaning);
        let found = recognise(
            &self.places,
            &signature,
            &self.graph,
            None,
            here,
            self.config.least_edges,
            &self.matcher,
        );
        for place in found.iter().take(self.config.comparisons) {
            let Some(known) = self.keyframe(place.id) else { continue };
            let pictured = self.matcher.pictured(images.load(place.id)?.gray, &known.odometry_pose);
            let seen = closure::look_recognised(&self.matcher, &sought, &pictured, place, new, &self.config);
            if let Some(seen) = seen {
                let scale = known.pose.height_m / known.odometry_pose.height_m;
                let measured_m = [leaning.height_m, known.odometry_pose.height_m];
                let laid = laid_from(&known.pose, &inverse(&seen.edge.motion, measured_m), scale);
                return Ok(Some(Located {
                    pose: GroundPose { roll_rad: leaning.roll_rad, pitch_rad: leaning.pitch_rad, ..laid },
                    keyframe: place.id,
                    covariance: seen.edge.covariance,
                    inliers: seen.inliers,
                    presence: seen.presence,
                }));
            }
        }
        Ok(None)
    }
}
