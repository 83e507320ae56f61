//! Per-frame results of the pipeline: poses with covariances, tracking status and statistics. Maps,
//! reports and files are made of these values.

use crate::geometry::GroundPose;
use crate::geometry::pose_index::{HEADING, X, Y};
use nalgebra::{Isometry3, Matrix3, Matrix6};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::fmt;

/// Whether the motion of a frame was measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", tag = "status")]
pub enum TrackStatus {
    /// The pose was measured.
    Tracked,
    /// Tracking failed; the frame has no pose.
    Lost {
        /// Cause of the failure.
        reason: LossReason,
    },
}

/// Why the motion of a frame could not be measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum LossReason {
    /// Too little texture to track (blank floor, a hand over the lens).
    Bare,
    /// The image is too dark.
    Dark,
    /// The image has texture, but hardly any of the keyframe's corners were tracked (a cut, a
    /// jump).
    Jump,
    /// Hardly any of the keyframe's corners were tracked because the image is much less sharp than
    /// the keyframe.
    Blur,
    /// The tracked corners are static in the image although the camera should have moved: the
    /// carrier's shadow or a part of the carrier.
    Shadow,
    /// Corners were tracked, but their motion is not that of one plane (moving objects, no flat
    /// ground).
    NotPlanar,
}

impl LossReason {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Bare, Self::Dark, Self::Jump, Self::Blur, Self::Shadow, Self::NotPlanar];

    /// Its name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Bare => "bare",
            Self::Dark => "dark",
            Self::Jump => "jump",
            Self::Blur => "blur",
            Self::Shadow => "shadow",
            Self::NotPlanar => "not-planar",
        }
    }

    /// The reason of this name; `None` if there is none.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|reason| reason.name() == name)
    }
}

impl fmt::Display for LossReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// An interval of consecutive frames without a pose.
#[derive(Debug, Clone, PartialEq)]
pub struct LostStretch {
    /// Time of the first lost frame, seconds.
    pub from_s: f64,
    /// Time of the next frame with a pose (the last frame if there is none), seconds.
    pub to_s: f64,
    /// Number of frames without a pose.
    pub frames: u64,
    /// The distinct reasons, in order of occurrence.
    pub reasons: Vec<LossReason>,
}

/// Gathers the intervals without a pose.
#[derive(Debug, Default)]
pub struct LostStretches {
    stretches: Vec<LostStretch>,
    is_lost: bool,
}

impl LostStretches {
    /// Adds the next frame.
    pub fn push(&mut self, time_s: f64, status: TrackStatus) {
        let was_lost = std::mem::replace(&mut self.is_lost, status != TrackStatus::Tracked);
        if self.is_lost && !was_lost {
            let (from_s, to_s) = (time_s, time_s);
            self.stretches.push(LostStretch { from_s, to_s, frames: 0, reasons: Vec::new() });
        }
        let Some(stretch) = self.stretches.last_mut().filter(|_| self.is_lost || was_lost) else { return };
        stretch.to_s = time_s;
        if let TrackStatus::Lost { reason } = status {
            stretch.frames += 1;
            if !stretch.reasons.contains(&reason) {
                stretch.reasons.push(reason);
            }
        }
    }

    /// The intervals in order.
    pub fn finish(self) -> Vec<LostStretch> {
        self.stretches
    }
}

impl fmt::Display for TrackStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tracked => f.write_str("tracked"),
            Self::Lost { reason } => write!(f, "lost:{reason}"),
        }
    }
}

/// Velocity of the camera over the ground.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Velocity {
    /// Along world x, metres per second.
    pub x_m_s: f64,
    /// Along world y, metres per second.
    pub y_m_s: f64,
    /// Counter-clockwise, radians per second.
    pub heading_rad_s: f64,
}

impl Velocity {
    /// Speed over ground, metres per second.
    pub fn speed_m_s(&self) -> f64 {
        self.x_m_s.hypot(self.y_m_s)
    }
}

/// Position and heading measured in the pixels of one frame, before any filter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneMeasurement {
    /// World x, metres.
    pub x_m: f64,
    /// World y, metres.
    pub y_m: f64,
    /// Heading, radians.
    pub heading_rad: f64,
    /// Covariance of (x, y, heading) relative to the reference keyframe: the measurement noise of
    /// this frame alone; metres and radians.
    pub covariance: Matrix3<f64>,
}

impl PlaneMeasurement {
    /// The planar part of a pose measurement; `covariance` is that of (x, y, heading, height, roll,
    /// pitch) relative to the keyframe.
    pub fn new(pose: &GroundPose, covariance: &Matrix6<f64>) -> Self {
        let covariance = covariance.fixed_view::<3, 3>(0, 0).into_owned();
        Self { x_m: pose.x_m, y_m: pose.y_m, heading_rad: pose.heading_rad, covariance }
    }
}

/// Estimated pose of a frame with its uncertainty.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseEstimate {
    /// Pose of the camera, filtered.
    pub pose: GroundPose,
    /// Velocity of the camera.
    pub velocity: Velocity,
    /// Covariance of (x, y, heading, height, roll, pitch) relative to the start of the run, metres
    /// and radians. Rows and columns of quantities that the rig holds fixed are zero.
    pub covariance: Matrix6<f64>,
    /// The measurement from which the filter estimated [`PoseEstimate::pose`].
    pub measured: PlaneMeasurement,
}

impl PoseEstimate {
    /// The pose as measured by the frame's own pixels.
    pub fn measured_pose(&self) -> GroundPose {
        let PlaneMeasurement { x_m, y_m, heading_rad, .. } = self.measured;
        GroundPose { x_m, y_m, heading_rad, ..self.pose }
    }
}

/// Result of the pipeline for one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameEstimate {
    /// Index of the frame in its source, from 0.
    pub frame: u64,
    /// Timestamp from the source, seconds.
    pub time_s: f64,
    /// Whether the motion was measured.
    pub status: TrackStatus,
    /// The pose; present exactly if [`FrameEstimate::status`] is [`TrackStatus::Tracked`], except
    /// that a live run dead-reckons lost frames from other sensors while it lasts.
    pub estimate: Option<PoseEstimate>,
    /// Number of corners tracked into this frame.
    pub tracks: usize,
    /// Number of inliers among the tracks.
    pub inliers: usize,
    /// Root mean square reprojection error of the inliers, pixels; 0 without inliers.
    pub residual_px: f64,
    /// Whether this frame became a keyframe.
    pub keyframe: bool,
    /// Number of tracking gaps before this frame. Poses of one segment are connected by
    /// measurements, poses of different segments are not.
    pub segment: usize,
}

impl FrameEstimate {
    /// Whether the pose is dead-reckoned from other sensors: the camera has lost the ground.
    pub fn is_reckoned(&self) -> bool {
        self.estimate.is_some() && self.status != TrackStatus::Tracked
    }

    /// The frame with the camera's pose only: without one that is dead-reckoned.
    pub fn measured(&self) -> Cow<'_, Self> {
        match self.is_reckoned() {
            true => Cow::Owned(Self { estimate: None, ..self.clone() }),
            false => Cow::Borrowed(self),
        }
    }

    /// The pose from which the image shows the ground; `None` if it is not known, and for a
    /// repeated image, whose pose is extrapolated and has no tracks.
    pub fn ground_pose(&self) -> Option<GroundPose> {
        self.estimate.as_ref().filter(|_| self.tracks > 0).map(|known| known.pose)
    }
}

/// The part of a [`FrameEstimate`] that drawings and figures need, at a fifth of its memory: an
/// hour of video has a hundred thousand frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameSummary {
    /// Index of the frame in its source, from 0.
    pub frame: u64,
    /// Timestamp from the source, seconds.
    pub time_s: f64,
    /// The pose; present exactly if [`FrameSummary::status`] is [`TrackStatus::Tracked`].
    pub place: Option<PlaceSummary>,
    /// Root mean square reprojection error of the inliers, pixels; 0 without inliers.
    pub residual_px: f64,
    /// Number of corners tracked into this frame.
    pub tracks: u32,
    /// Number of inliers among the tracks.
    pub inliers: u32,
    /// Number of tracking gaps before this frame.
    pub segment: u32,
    /// Whether the motion was measured.
    pub status: TrackStatus,
}

/// Summary of a pose for drawings and figures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaceSummary {
    /// World x, metres.
    pub x_m: f64,
    /// World y, metres.
    pub y_m: f64,
    /// Heading, radians.
    pub heading_rad: f64,
    /// Height above the ground, metres.
    pub height_m: f64,
    /// Speed over ground, metres per second.
    pub speed_m_s: f64,
    /// Variance of x, covariance of x and y, variance of y, relative to the start of the run;
    /// square metres.
    pub position_covariance: [f64; 3],
    /// Variance of the heading relative to the start of the run, square radians.
    pub heading_variance: f64,
}

impl From<&FrameEstimate> for FrameSummary {
    fn from(frame: &FrameEstimate) -> Self {
        let count = |number: usize| u32::try_from(number).unwrap_or(u32::MAX);
        Self {
            frame: frame.frame,
            time_s: frame.time_s,
            place: frame.estimate.as_ref().map(PlaceSummary::from),
            residual_px: frame.residual_px,
            tracks: count(frame.tracks),
            inliers: count(frame.inliers),
            segment: count(frame.segment),
            status: frame.status,
        }
    }
}

impl From<&PoseEstimate> for PlaceSummary {
    fn from(known: &PoseEstimate) -> Self {
        let (pose, covariance) = (&known.pose, &known.covariance);
        Self {
            x_m: pose.x_m,
            y_m: pose.y_m,
            heading_rad: pose.heading_rad,
            height_m: pose.height_m,
            speed_m_s: known.velocity.speed_m_s(),
            position_covariance: [covariance[(X, X)], covariance[(X, Y)], covariance[(Y, Y)]],
            heading_variance: covariance[(HEADING, HEADING)],
        }
    }
}

/// Path length over ground through all measured poses, metres; lost stretches are not counted, even
/// where the ground after them was recognised.
pub fn distance_m(frames: &[FrameSummary]) -> f64 {
    let step_m = |two: &[FrameSummary]| match (two[0].place, two[1].place) {
        (Some(from), Some(to)) if two[0].segment == two[1].segment => {
            Some((to.x_m - from.x_m).hypot(to.y_m - from.y_m))
        }
        _ => None,
    };
    // A fold: the sum of no numbers is −0.
    frames.windows(2).filter_map(step_m).fold(0.0, |way_m, step_m| way_m + step_m)
}

/// Pose of a camera with its timestamp: an entry of a trajectory file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StampedPose {
    /// Timestamp, seconds; the epoch is arbitrary but common to all poses of a trajectory.
    pub time_s: f64,
    /// Transform from camera to world coordinates, metres; from those of `base_link` in a
    /// trajectory of the robot.
    pub world_from_camera: Isometry3<f64>,
}

/// Timestamped poses with strictly increasing times.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Trajectory {
    /// The poses in order of time.
    pub poses: Vec<StampedPose>,
}

impl StampedPose {
    /// The stamped pose of a frame; `None` if the frame has no pose.
    pub fn of_frame(frame: &FrameEstimate) -> Option<Self> {
        let world_from_camera = frame.estimate.as_ref()?.pose.world_from_camera();
        Some(Self { time_s: frame.time_s, world_from_camera })
    }
}

impl Trajectory {
    /// The poses of all frames that have one.
    pub fn from_frames(frames: &[FrameEstimate]) -> Self {
        Self { poses: frames.iter().filter_map(StampedPose::of_frame).collect() }
    }

    /// Path length through all camera centres, metres; a gap counts as a straight line.
    pub fn length_m(&self) -> f64 {
        let step = |pair: &[StampedPose]| {
            let [a, b] = [0, 1].map(|i: usize| pair[i].world_from_camera.translation.vector);
            (b - a).norm()
        };
        self.poses.windows(2).map(step).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lost_stretches_have_no_length() {
        let frame = |number: u64, x_m: Option<f64>, segment: u32| FrameSummary {
            frame: number,
            time_s: number as f64,
            place: x_m.map(|x_m| PlaceSummary {
                x_m,
                y_m: 0.0,
                heading_rad: 0.0,
                height_m: 1.0,
                speed_m_s: 0.0,
                position_covariance: [0.0; 3],
                heading_variance: 0.0,
            }),
            residual_px: 0.0,
            tracks: 0,
            inliers: 0,
            segment,
            status: TrackStatus::Tracked,
        };
        // A metre; a loss over ten metres, after which the ground was recognised; half a metre; a
        // loss after which it was not.
        let frames = [
            frame(0, Some(0.0), 0),
            frame(1, Some(1.0), 0),
            frame(2, None, 0),
            frame(3, Some(11.0), 0),
            frame(4, Some(11.5), 0),
            frame(5, Some(20.0), 1),
        ];
        assert_eq!(distance_m(&frames), 1.5);
        assert_eq!(distance_m(&frames[..1]).to_string(), "0");
    }
}
