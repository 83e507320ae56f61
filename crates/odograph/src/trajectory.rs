//! What is known of each frame: the values that leave the pipeline and that maps, reports and files are made of.

use crate::geometry::GroundPose;
use crate::geometry::pose_index::{HEADING, X, Y};
use nalgebra::{Isometry3, Matrix3, Matrix6};
use serde::{Deserialize, Serialize};
use std::fmt;

/// Whether the movement of a frame was measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", tag = "status")]
pub enum TrackStatus {
    /// The pose was measured.
    Tracked,
    /// The pose was not measured; none is given.
    Lost {
        /// Why not.
        reason: LossReason,
    },
}

/// Why the movement of a frame could not be measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum LossReason {
    /// Too little texture to follow (blank floor, a hand over the lens).
    Bare,
    /// Nothing is seen for want of light.
    Dark,
    /// There is texture, but hardly any of the keyframe was found again (a cut, a jump).
    Jump,
    /// Hardly any of the keyframe was found again because the image is so much less sharp.
    Blur,
    /// What was found again stands still in the image while the camera should have moved: the shadow or a part of its carrier.
    Shadow,
    /// Corners were found again, but they do not move as one plane (moving objects, not a floor).
    NotPlanar,
}

impl fmt::Display for LossReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Bare => "bare",
            Self::Dark => "dark",
            Self::Jump => "jump",
            Self::Blur => "blur",
            Self::Shadow => "shadow",
            Self::NotPlanar => "not-planar",
        })
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

/// How fast the camera moves over the ground.
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

/// Position and heading as the pixels of one frame have them, before any filter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneMeasurement {
    /// World x, metres.
    pub x_m: f64,
    /// World y, metres.
    pub y_m: f64,
    /// Heading, radians.
    pub heading_rad: f64,
    /// Covariance of the three against the keyframe they were measured from: the noise of this frame alone.
    pub covariance: Matrix3<f64>,
}

impl PlaneMeasurement {
    /// A measurement of a pose, with the covariance of (x, y, heading, height, roll, pitch) against its keyframe.
    pub fn new(pose: &GroundPose, covariance: &Matrix6<f64>) -> Self {
        let covariance = covariance.fixed_view::<3, 3>(0, 0).into_owned();
        Self { x_m: pose.x_m, y_m: pose.y_m, heading_rad: pose.heading_rad, covariance }
    }
}

/// The pose of a frame with everything that says how well it is known.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseEstimate {
    /// Where the camera was.
    pub pose: GroundPose,
    /// How it moved.
    pub velocity: Velocity,
    /// Covariance of (x, y, heading, height, roll, pitch) in metres and radians, against the start of the run; rows of
    /// quantities that the rig holds fixed are zero.
    pub covariance: Matrix6<f64>,
    /// What was measured, before the filter that made [`PoseEstimate::pose`] of it.
    pub measured: PlaneMeasurement,
}

/// One frame as it left the pipeline.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameEstimate {
    /// Number of the frame in its source, from 0.
    pub frame: u64,
    /// Its time, seconds, from the source.
    pub time_s: f64,
    /// Whether its movement was measured.
    pub status: TrackStatus,
    /// Its pose; present exactly when [`FrameEstimate::status`] is [`TrackStatus::Tracked`].
    pub estimate: Option<PoseEstimate>,
    /// Number of corners found again in this frame.
    pub tracks: usize,
    /// How many of them agree with the movement.
    pub inliers: usize,
    /// Root mean square distance of the inliers from where the movement puts them, pixels; 0 without inliers.
    pub residual_px: f64,
    /// Whether this frame became a keyframe.
    pub keyframe: bool,
    /// Number of gaps before this frame: poses of one segment are connected by measurement, those of different ones are not.
    pub segment: usize,
}

/// What is shown of a frame, in drawings and figures: a fifth of the memory of the whole [`FrameEstimate`], of which an hour has a hundred thousand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameSummary {
    /// Number of the frame in its source, from 0.
    pub frame: u64,
    /// Its time, seconds, from the source.
    pub time_s: f64,
    /// Where the camera was; present exactly when [`FrameSummary::status`] is [`TrackStatus::Tracked`].
    pub place: Option<PlaceSummary>,
    /// Root mean square distance of the inliers from where the movement puts them, pixels; 0 without inliers.
    pub residual_px: f64,
    /// Number of corners found again in this frame.
    pub tracks: u32,
    /// How many of them agree with the movement.
    pub inliers: u32,
    /// Number of gaps before this frame.
    pub segment: u32,
    /// Whether its movement was measured.
    pub status: TrackStatus,
}

/// What is shown of a pose.
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
    /// Variance of x, covariance of x and y, variance of y, square metres, against the start of the run.
    pub position_covariance: [f64; 3],
    /// Variance of the heading, square radians.
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

/// Length of the path over ground through all measured poses, metres; gaps do not count.
pub fn distance_m(frames: &[FrameSummary]) -> f64 {
    let mut before: Option<(u32, PlaceSummary)> = None;
    let mut way_m = 0.0;
    for (segment, place) in frames.iter().filter_map(|frame| Some((frame.segment, frame.place?))) {
        if let Some((_, from)) = before.filter(|before| before.0 == segment) {
            way_m += (place.x_m - from.x_m).hypot(place.y_m - from.y_m);
        }
        before = Some((segment, place));
    }
    way_m
}

/// Where a camera was at a time: an entry of a trajectory file, from whatever program it comes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StampedPose {
    /// Seconds, from any beginning that the trajectory's poses share.
    pub time_s: f64,
    /// Takes points in the camera to the world, metres.
    pub world_from_camera: Isometry3<f64>,
}

/// Poses in the order of their times, which strictly increase.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Trajectory {
    /// The poses, earliest first.
    pub poses: Vec<StampedPose>,
}

impl StampedPose {
    /// Where the camera was at a frame; `None` where it is not known.
    pub fn of_frame(frame: &FrameEstimate) -> Option<Self> {
        let world_from_camera = frame.estimate.as_ref()?.pose.world_from_camera();
        Some(Self { time_s: frame.time_s, world_from_camera })
    }
}

impl Trajectory {
    /// The poses of the frames that have one.
    pub fn from_frames(frames: &[FrameEstimate]) -> Self {
        Self { poses: frames.iter().filter_map(StampedPose::of_frame).collect() }
    }

    /// Length of the path through all camera centres, metres; gaps count as straight lines.
    pub fn length_m(&self) -> f64 {
        let step = |pair: &[StampedPose]| {
            let [a, b] = [0, 1].map(|i: usize| pair[i].world_from_camera.translation.vector);
            (b - a).norm()
        };
        self.poses.windows(2).map(step).sum()
    }
}
