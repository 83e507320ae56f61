//! Images that are copies of the one before: a camera that delivers fewer images than it says, or a
//! codec that skips.
//!
//! A copy shows where the camera was, not where it is. Its pose is extrapolated, as uncertain as
//! the last extrapolations were wrong.

use super::{FrameReference, Odometry};
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::image::GrayImage;
use crate::motion::MotionModel;
use crate::trajectory::{FrameEstimate, PlaneMeasurement, PoseEstimate, TrackStatus};
use nalgebra::Matrix6;

/// More repeated images than this in a row come from a camera that stands, without image noise.
const MOST_COPIES: usize = 4;

impl Odometry {
    /// Whether an image is a copy of the last one.
    pub(super) fn is_repeated(&self, image: &GrayImage) -> bool {
        let last = match &self.spare {
            Some(spare) => Some(spare.base()),
            None => self.keyframe.as_ref().map(|keyframe| keyframe.pyramid.base()),
        };
        self.repeated < MOST_COPIES
            && self.lost_frames == 0
            && self.config.motion.model != MotionModel::Mean
            && last.is_some_and(|last| last.samples() == image.samples())
    }

    /// The extrapolated frame of a repeated image; `None` while the motion is not known.
    pub(super) fn repeat(&mut self, time_s: f64) -> Option<FrameEstimate> {
        let last = self.last.as_ref()?;
        let (off_by, step_s) = (last.off_by(), last.step_s);
        if !off_by.is_finite() || step_s <= 0.0 || time_s <= last.time_s {
            return None;
        }
        let pose = last.extrapolated(time_s);
        // The error of an extrapolation grows with the square of the time.
        let turn = off_by * ((time_s - last.time_s) / step_s).powi(2);
        let mut own = Matrix6::zeros();
        (own[(X, X)], own[(Y, Y)]) = ((turn * pose.height_m).powi(2), (turn * pose.height_m).powi(2));
        own[(HEADING, HEADING)] = turn * turn;
        let velocity = self.filter.as_ref().map(|filter| filter.filtered().velocity).unwrap_or_default();
        self.repeated += 1;
        self.tracks.clear();
        let keyframe = self.keyframe.as_ref().and_then(|keyframe| keyframe.id);
        self.reference = keyframe.map(|keyframe| FrameReference { keyframe, next: None });
        Some(FrameEstimate {
            frame: self.frames,
            time_s,
            status: TrackStatus::Tracked,
            estimate: Some(PoseEstimate {
                pose,
                velocity,
                covariance: last.covariance + own,
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
    use crate::odometry::{Odometry, OdometryConfig};
    use crate::simulation::{Path, PathKind, Simulation, SimulationConfig, Texture};

    #[test]
    fn a_repeated_image_gets_the_pose_of_its_time() {
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
        let (mut last, mut copies) = (None, 0);
        for (number, frame) in simulation.frames().enumerate() {
            let image = if number % 4 == 3 { last.take() } else { None }.unwrap_or(frame.image);
            let estimate = odometry.process(image.clone(), frame.time_s).unwrap();
            last = Some(image);
            let known = estimate.estimate.unwrap();
            copies += usize::from(estimate.tracks == 0);
            let off_m = (known.pose.x_m - frame.truth.x_m).hypot(known.pose.y_m - frame.truth.y_m);
            // A copy shows where the camera was 20 mm ago.
            assert!(off_m < 2e-3, "frame {number}: {off_m}");
        }
        assert!(copies >= 10, "{copies}");
    }
}
