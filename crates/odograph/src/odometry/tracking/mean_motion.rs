//! The mean displacement of the tracks as the motion, as in the original system.

use super::super::found_corner::FoundCorner;
use super::Tracker;
use crate::buffer::Buffer;
use crate::geometry::{GroundPoint, GroundPose, Pixel};
use crate::motion::{MotionEstimate, Random, mean_displacement};
use nalgebra::{Matrix6, Matrix6x2};

impl Tracker<'_> {
    /// The paper's mean vector from the last frame to this one.
    pub(super) fn mean_motion(
        &self,
        found: &[FoundCorner],
        last: &GroundPose,
        random: &mut Random,
    ) -> Option<MotionEstimate> {
        let Self { keyframe, camera, config, .. } = *self;
        let on_ground = |pixel: Pixel| -> Option<GroundPoint> {
            camera.ray_from_pixel(pixel).and_then(|ray| last.ground_from_ray(ray))
        };
        let pairs: Vec<(GroundPoint, GroundPoint)> = found
            .iter()
            .map(|f| {
                Some((on_ground(keyframe.corners[f.corner].seen.position)?, on_ground(f.warp.position)?))
            })
            .collect::<Option<_>>()?;
        let metres_per_pixel = last.height_m / camera.focal_px().0;
        let within_m = config.motion.inlier_px * metres_per_pixel;
        let ((x_m, y_m), variance, inliers) = mean_displacement(&pairs, within_m, &config.motion, random)?;
        let mut covariance = Matrix6::zeros();
        covariance[(0, 0)] = variance;
        covariance[(1, 1)] = variance;
        let count = inliers.iter().filter(|&&a| a).count() as f64;
        Some(MotionEstimate {
            pose: GroundPose { x_m: last.x_m + x_m, y_m: last.y_m + y_m, ..*last },
            covariance,
            model_covariance: Matrix6::zeros(),
            by_keyframe: Matrix6::identity(),
            by_prior_tilt: Matrix6x2::zeros(),
            keyframe_error: None,
            inliers,
            residual_px: (2.0 * variance * count).sqrt() / metres_per_pixel,
            noise_px: f64::INFINITY,
            residual_correlation: Default::default(),
            rig_evidence: None,
            elevations: Buffer::new(),
            shape: None,
            uneven: None,
            shutter: None,
        })
    }
}
