//! Fixed-interval smoother for recordings: position and heading of each frame from the measurements
//! before *and* after it.
//!
//! Each coordinate is smoothed independently ([`super::coordinate`]). In gaps without measurements
//! the same equations interpolate.
//!
//! The recording is read twice, so that its frames need not fit in memory: once to collect the
//! measurements ([`Smoother`]), once to output the smoothed frames ([`SmoothedPath`]).

use super::FilterConfig;
use super::constant_acceleration::SMALLEST_VARIANCE;
use super::coordinate::{Measured, Smoothed, adapted, smooth_coordinate};
use crate::geometry::GroundPose;
use crate::pose_frame::PoseFrame;
use crate::trajectory::StampedPose;
use crate::trajectory::{FrameEstimate, PoseEstimate, Velocity};
use nalgebra::{Matrix3, Vector3};
use std::fmt;

/// Origin of the pose of a smoothed frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PoseSource {
    /// Measured in the frame's own pixels, and smoothed.
    Measured,
    /// Not measured: interpolated by the motion model between the measured frames before and after.
    Bridged,
    /// Not measured by the camera: dead reckoning with other sensors.
    Sensors,
}

impl fmt::Display for PoseSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Measured => "measured",
            Self::Bridged => "bridged",
            Self::Sensors => "sensors",
        })
    }
}

/// A frame after smoothing over the whole recording.
#[derive(Debug, Clone, PartialEq)]
pub struct SmoothedFrame {
    /// Index of the frame in its source, from 0.
    pub frame: u64,
    /// Timestamp from the source, seconds.
    pub time_s: f64,
    /// Pose of the camera.
    pub pose: GroundPose,
    /// Velocity of the camera.
    pub velocity: Velocity,
    /// Covariance of (x, y, heading) relative to the start of the run, metres and radians.
    pub covariance: Matrix3<f64>,
    /// Origin of the pose.
    pub source: PoseSource,
    /// Number of tracking gaps before this frame; an interpolated frame belongs to the segment
    /// before the gap.
    pub segment: usize,
}

/// Collects the measurements of a recording. The result has one entry for each frame from the first
/// measured frame to the last, interpolated where a frame was not measured.
#[derive(Debug)]
pub struct Smoother {
    /// Timestamps from the first measured frame on, seconds.
    times_s: Vec<f64>,
    measured: [Vec<Measured>; 3],
    /// Number of frames up to and including the last measured one.
    count: usize,
}

impl Smoother {
    /// An empty smoother with capacity for `frames` frames.
    pub fn for_frames(frames: usize) -> Self {
        Self {
            times_s: Vec::with_capacity(frames),
            measured: [(); 3].map(|()| Vec::with_capacity(frames)),
            count: 0,
        }
    }

    /// Appends the next frame; its time must not be before that of the previous frame.
    pub fn push(&mut self, frame: &FrameEstimate) {
        let plane = frame.estimate.as_ref().map(|known| &known.measured);
        if self.times_s.is_empty() && plane.is_none() {
            return;
        }
        self.times_s.push(frame.time_s);
        for (axis, measured) in self.measured.iter_mut().enumerate() {
            measured.push(plane.map(|plane| {
                let value = [plane.x_m, plane.y_m, plane.heading_rad][axis];
                (value, plane.covariance[(axis, axis)].max(SMALLEST_VARIANCE))
            }));
        }
        if plane.is_some() {
            self.count = self.times_s.len();
        }
    }

    /// Smooths all frames appended so far.
    pub fn smoothed(self, config: &FilterConfig) -> SmoothedPath {
        let times_s = &self.times_s[..self.count];
        let densities = [config.jerk_density, config.jerk_density, config.heading_jerk_density];
        let mut density = densities.into_iter();
        let axes = self.measured.map(|measured| {
            let measured = &measured[..self.count];
            let adapted = adapted(times_s, measured, density.next().unwrap_or(config.jerk_density));
            smooth_coordinate(times_s, measured, |step| adapted[step])
        });
        SmoothedPath { axes }
    }
}

/// Smoothed coordinates of a path. Everything else comes from the frames themselves, which are read
/// a second time ([`SmoothedPath::walk`]).
#[derive(Debug)]
pub struct SmoothedPath {
    axes: [Vec<Smoothed>; 3],
}

impl SmoothedPath {
    /// Starts the second pass over the frames.
    pub fn walk(&self) -> Walk<'_> {
        Walk { path: self, next: 0, before: None, gap: Vec::new() }
    }
}

/// The second pass: combines the frames, read again in the same order, with the smoothed path.
#[derive(Debug)]
pub struct Walk<'a> {
    path: &'a SmoothedPath,
    /// Index of the next frame, counted from the first measured one.
    next: usize,
    /// The last measured frame.
    before: Option<FrameEstimate>,
    /// Index and time of each unmeasured frame since then.
    gap: Vec<(u64, f64)>,
}

impl Walk<'_> {
    /// Takes the next frame and outputs the smoothed frames known so far; those of a gap follow
    /// with the measured frame after it.
    pub fn next(&mut self, frame: &FrameEstimate, take: &mut dyn FnMut(SmoothedFrame)) {
        let Some(known) = &frame.estimate else {
            if self.before.is_some() && self.next + self.gap.len() < self.path.axes[0].len() {
                self.gap.push((frame.frame, frame.time_s));
            }
            return;
        };
        for (number, time_s) in std::mem::take(&mut self.gap) {
            if let Some(before) = &self.before {
                take(self.path.bridged(self.next, (number, time_s), before, frame));
            }
            self.next += 1;
        }
        take(self.path.measured(self.next, frame, known));
        self.next += 1;
        self.before = Some(frame.clone());
    }
}

impl SmoothedFrame {
    /// The same frame of the path of `of`.
    pub fn seen_as(&self, of: &PoseFrame) -> Self {
        let PoseFrame::BaseLink(base) = of else { return self.clone() };
        let (pose, velocity, covariance) = base.in_plane(&self.pose, &self.velocity, &self.covariance);
        Self { pose, velocity, covariance, ..self.clone() }
    }

    /// The frame, which is one of the path of `of`, as an entry of a trajectory.
    pub fn stamped(&self, of: &PoseFrame) -> StampedPose {
        StampedPose { time_s: self.time_s, world_from_camera: of.world_from_frame(&self.pose) }
    }
}

impl SmoothedPath {
    /// Position and heading, velocity and variances of a frame.
    fn plane(&self, index: usize) -> (GroundPose, Velocity, [f64; 3]) {
        let axes = self.axes.each_ref().map(|axis| &axis[index]);
        let [x, y, heading] = axes.map(|axis| axis.state);
        let velocity = Velocity { x_m_s: x[1], y_m_s: y[1], heading_rad_s: heading[1] };
        let level = GroundPose { x_m: x[0], y_m: y[0], heading_rad: heading[0], ..GroundPose::level(1.0) };
        (level, velocity, axes.map(|axis| axis.variance))
    }

    fn measured(&self, index: usize, frame: &FrameEstimate, known: &PoseEstimate) -> SmoothedFrame {
        let (level, velocity, variances) = self.plane(index);
        // Scales the frame's own covariance to the smoothed variances and keeps its correlations.
        let own = known.measured.covariance;
        let left = Matrix3::from_diagonal(&Vector3::from_fn(|axis, _| {
            (variances[axis] / own[(axis, axis)].max(SMALLEST_VARIANCE)).min(1.0).sqrt()
        }));
        let GroundPose { height_m, roll_rad, pitch_rad, .. } = known.pose;
        SmoothedFrame {
            frame: frame.frame,
            time_s: frame.time_s,
            pose: GroundPose { height_m, roll_rad, pitch_rad, ..level },
            velocity,
            covariance: carried(known) + left * own * left,
            source: PoseSource::Measured,
            segment: frame.segment,
        }
    }

    /// An unmeasured frame, with its index and time, between two measured ones.
    fn bridged(
        &self,
        index: usize,
        (frame, time_s): (u64, f64),
        before: &FrameEstimate,
        after: &FrameEstimate,
    ) -> SmoothedFrame {
        let (level, velocity, variances) = self.plane(index);
        let (height_m, roll_rad, pitch_rad, covariance) =
            bridged((before, after), time_s, &velocity, variances);
        SmoothedFrame {
            frame,
            time_s,
            pose: GroundPose { height_m, roll_rad, pitch_rad, ..level },
            velocity,
            covariance,
            source: PoseSource::Bridged,
            segment: before.segment,
        }
    }
}

/// Covariance of the reference keyframe: the frame's covariance without its own measurement noise.
fn carried(known: &PoseEstimate) -> Matrix3<f64> {
    known.covariance.fixed_view::<3, 3>(0, 0) - known.measured.covariance
}

/// Height, roll, pitch and covariance of an unmeasured frame, interpolated between two measured
/// ones.
fn bridged(
    (before, after): (&FrameEstimate, &FrameEstimate),
    time_s: f64,
    velocity: &Velocity,
    variances: [f64; 3],
) -> (f64, f64, f64, Matrix3<f64>) {
    let (Some(a), Some(b)) = (&before.estimate, &after.estimate) else {
        return (1.0, 0.0, 0.0, Matrix3::from_diagonal(&Vector3::from(variances)));
    };
    let (since_s, left_s) = (time_s - before.time_s, after.time_s - time_s);
    let share = if since_s + left_s > 0.0 { since_s / (since_s + left_s) } else { 0.0 };
    let between = |from: f64, to: f64| from + share * (to - from);
    // The pose after a tracking gap is not measured relative to that before it: its covariance
    // includes that, and is blended in along the gap.
    let ends = carried(a) * (1.0 - share) + carried(b) * share;
    // Over a long gap, white jerk predicts more than any wheeled carrier or person does. The
    // standard deviation is bounded by an excursion at half the largest speed at the ends plus 0.1
    // m/s (0.1 rad/s) that returns in time: two standard deviations allow twice that speed, or 0.2
    // m/s and 0.2 rad/s from rest.
    let reach_s = since_s.min(left_s);
    let fastest = |of: fn(&Velocity) -> f64| of(&a.velocity).max(of(&b.velocity)).max(of(velocity));
    let limits = [
        fastest(Velocity::speed_m_s),
        fastest(Velocity::speed_m_s),
        fastest(|velocity| velocity.heading_rad_s.abs()),
    ]
    .map(|rate| ((0.5 * rate + 0.1) * reach_s).powi(2));
    let way = Vector3::from_fn(|axis, _| variances[axis].min(limits[axis]));
    (
        between(a.pose.height_m, b.pose.height_m),
        between(a.pose.roll_rad, b.pose.roll_rad),
        between(a.pose.pitch_rad, b.pose.pitch_rad),
        ends + Matrix3::from_diagonal(&way),
    )
}
