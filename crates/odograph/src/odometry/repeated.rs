//! Images that are copies of the one before: a camera that delivers fewer images than it says, or a
//! codec that skips.
//!
//! A copy shows where the camera was, not where it is. Its pose is extrapolated, as uncertain as
//! the last extrapolations were wrong. After a few copies in a row either the camera stands,
//! without image noise, or the video is frozen. A camera that stands has slowed down before. Over a
//! frozen video its speed may have changed by 100 % (two standard deviations).

use super::last_pose::{LastPose, seen_apart};
use super::{FrameReference, Odometry};
use crate::fixed_pattern::stale_blocks;
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::image::GrayImage;
use crate::motion::MotionModel;
use crate::trajectory::{FrameEstimate, PlaneMeasurement, PoseEstimate, TrackStatus};
use nalgebra::Matrix6;
use std::sync::Arc;

/// More repeated images than this in a row are not left out by a camera or a codec.
const MOST_COPIES: usize = 4;

/// Motion per frame before the copies, pixels: less is that of a camera that comes to rest.
const AT_REST_PX: f64 = 0.5;

/// Over a longer freeze, frames, no motion goes on.
const LONGEST_FREEZE: usize = 60;

/// Motion since the last frame, pixels, from which a part of an image that has not changed at all
/// is a copy: of a camera that stands, codecs copy whole regions.
const MOVES_PX: f64 = 2.0;

impl Odometry {
    /// The last image.
    fn last_image(&self) -> Option<&GrayImage> {
        match &self.spare {
            Some(spare) => Some(spare.base()),
            None => self.keyframe.as_ref().map(|keyframe| keyframe.pyramid.base()),
        }
    }

    /// Leaves out what of an image is a copy of the last one, although the camera moves.
    pub(super) fn leave_out_stale_blocks(&mut self, image: &GrayImage, time_s: f64) {
        let focal_px = self.camera.focal_px().0;
        let moves =
            |last: &LastPose| focal_px * seen_apart(&last.pose, &last.extrapolated(time_s)) > MOVES_PX;
        let before = self.last_image().filter(|_| self.last.as_ref().is_some_and(moves));
        self.stale = before.and_then(|before| stale_blocks(image, before)).map(Arc::new);
        if let Some(keyframe) = &mut self.keyframe {
            keyframe.stale = self.stale.clone();
        }
    }

    /// Whether an image is a copy of the last one.
    pub(super) fn is_repeated(&self, image: &GrayImage) -> bool {
        let last = self.last_image();
        self.repeated < if self.is_at_rest() { MOST_COPIES } else { LONGEST_FREEZE }
            && self.lost_frames == 0
            && self.config.motion.model != MotionModel::Mean
            && last.is_some_and(|last| last.samples() == image.samples())
    }

    /// Whether the camera hardly moved up to the last measured frame.
    fn is_at_rest(&self) -> bool {
        let focal_px = self.camera.focal_px().0;
        self.last.as_ref().is_none_or(|last| {
            let next = last.extrapolated(last.time_s + last.step_s);
            focal_px * seen_apart(&last.pose, &next) < AT_REST_PX
        })
    }

    /// The extrapolated frame of a repeated image; `None` while the motion is not known.
    pub(super) fn repeat(&mut self, time_s: f64) -> Option<FrameEstimate> {
        let last = self.last.as_ref()?;
        let (off_by, step_s) = (last.off_by(), last.step_s);
        if !off_by.is_finite() || step_s <= 0.0 || time_s <= last.time_s {
            return None;
        }
        let LastPose { pose, covariance, .. } = last.extrapolated_over_gap(time_s);
        let own = if self.repeated < MOST_COPIES {
            // The error of an extrapolation grows with the square of the time.
            let turn = off_by * ((time_s - last.time_s) / step_s).powi(2);
            let mut own = Matrix6::zeros();
            (own[(X, X)], own[(Y, Y)]) = ((turn * pose.height_m).powi(2), (turn * pose.height_m).powi(2));
            own[(HEADING, HEADING)] = turn * turn;
            own
        } else {
            covariance - last.covariance
        };
        let velocity = self.filter.as_ref().map(|filter| filter.filtered().velocity).unwrap_or_default();
        self.repeated += 1;
        self.tracks.clear();
        let model_covariance = self.keyframe.as_ref().map(|keyframe| keyframe.model_covariance);
        let keyframe = self.keyframe.as_ref().and_then(|keyframe| keyframe.id);
        self.reference = keyframe.map(|keyframe| FrameReference { keyframe, next: None });
        Some(FrameEstimate {
            frame: self.frames,
            time_s,
            status: TrackStatus::Tracked,
            estimate: Some(PoseEstimate {
                pose,
                velocity,
                covariance: last.covariance + model_covariance.unwrap_or_default() + own,
                measured: PlaneMeasurement::new(&pose, &own),
            }),
            tracks: 0,
            inliers: 0,
            residual_px: 0.0,
            keyframe: false,
            segment: self.segment,
        })
    }
}

#[cfg(test)]
mod tests {
    use crate::camera::{Camera, Distortion, Rig};
    use crate::geometry::pose_index::X;
    use crate::image::GrayImage;
    use crate::odometry::{Odometry, OdometryConfig};
    use crate::simulation::{Path, PathKind, RenderedFrame, Simulation, SimulationConfig, Texture};
    use crate::trajectory::FrameEstimate;

    /// Runs over a drive in which the images with these numbers are copies of the one before, and
    /// returns each frame with its error, metres.
    fn errors_with_copies(is_copy: impl Fn(usize) -> bool) -> Vec<(FrameEstimate, f64)> {
        let camera = Camera::new((320, 240), (250.0, 250.0), (160.0, 120.0), Distortion::None).unwrap();
        let simulation = Simulation::new(SimulationConfig {
            camera: camera.clone(),
            rig: Rig::level(0.75),
            texture: Texture::named("asphalt").unwrap(),
            path: Path::new(PathKind::Straight { length_m: 1.5 }, 0.6, 1.0, true).unwrap(),
            effects: Default::default(),
            fps: 30.0,
            duration_s: None,
            colored: false,
            seed: 3,
        })
        .unwrap();
        let mut odometry = Odometry::new(camera, Rig::level(0.75), OdometryConfig::default()).unwrap();
        let mut last: Option<GrayImage> = None;
        let mut process = |(number, frame): (usize, RenderedFrame)| {
            let image = last.take().filter(|_| is_copy(number)).unwrap_or(frame.image);
            last = Some(image.clone());
            let estimate = odometry.process(image, frame.time_s).unwrap();
            let pose = estimate.estimate.as_ref().unwrap().pose;
            let off_m = (pose.x_m - frame.truth.x_m).hypot(pose.y_m - frame.truth.y_m);
            (estimate, off_m)
        };
        simulation.frames().enumerate().map(&mut process).collect()
    }

    #[test]
    fn a_repeated_image_gets_the_pose_of_its_time() {
        let frames = errors_with_copies(|number| number % 4 == 3);
        assert!(frames.iter().filter(|(frame, _)| frame.tracks == 0).count() >= 10);
        for (number, (_, off_m)) in frames.iter().enumerate() {
            // A copy shows where the camera was 20 mm ago.
            assert!(*off_m < 2e-3, "frame {number}: {off_m}");
        }
    }

    #[test]
    fn over_a_frozen_video_the_motion_goes_on_with_growing_uncertainty() {
        let frozen = 30..50;
        let frames = errors_with_copies(|number| frozen.contains(&number));
        let mut before = 0.0;
        for number in frozen {
            let (frame, off_m) = &frames[number];
            let sigma_m = frame.estimate.as_ref().unwrap().covariance[(X, X)].sqrt();
            // It went on by 0.4 m meanwhile.
            assert!(*off_m < 3.0 * sigma_m + 2e-3, "frame {number}: {off_m} m off at {sigma_m}");
            assert!(sigma_m >= before, "frame {number}");
            before = sigma_m;
        }
        let (_, off_m) = frames.last().unwrap();
        assert!(*off_m < 2e-3, "{off_m}");
    }
}
