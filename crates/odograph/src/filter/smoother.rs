//! A smoother for recordings: every frame's position and heading from what came before *and* after it.
//!
//! Each coordinate is smoothed by itself ([`super::coordinate`]). Where frames are missing the same equations bridge the gap.
//!
//! A recording is gone through twice, so that its frames need not be in memory: once to gather what was measured ([`Smoother`]), once to tell where each
//! frame was ([`SmoothedPath`]).

use super::FilterConfig;
use super::constant_acceleration::SMALLEST_VARIANCE;
use super::coordinate::{Measured, Smoothed, adapted, smooth_coordinate};
use crate::geometry::GroundPose;
use crate::trajectory::StampedPose;
use crate::trajectory::{FrameEstimate, PoseEstimate, Velocity};
use nalgebra::{Matrix3, Vector3};
use std::fmt;

/// Where the pose of a smoothed frame comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PoseSource {
    /// Measured in its own pixels, and smoothed.
    Measured,
    /// Not measured: put between the measured frames before and after, as a camera would have gone.
    Bridged,
    /// Not measured in the pixels: what other sensors tell.
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

/// A frame as the whole recording has it.
#[derive(Debug, Clone, PartialEq)]
pub struct SmoothedFrame {
    /// Number of the frame in its source, from 0.
    pub frame: u64,
    /// Its time, seconds, from the source.
    pub time_s: f64,
    /// Where the camera was.
    pub pose: GroundPose,
    /// How it moved.
    pub velocity: Velocity,
    /// Covariance of (x, y, heading) in metres and radians, against the start of the run.
    pub covariance: Matrix3<f64>,
    /// Where it comes from.
    pub source: PoseSource,
    /// Number of gaps before this frame; a bridged frame counts to the stretch before it.
    pub segment: usize,
}

/// The path with what came after each frame taken into account: one entry for each frame from the first measured one to the last,
/// bridged where a frame could not be measured. Times must not fall.
pub fn smooth(frames: &[FrameEstimate], config: &FilterConfig) -> Vec<SmoothedFrame> {
    let mut smoother = Smoother::for_frames(frames.len());
    frames.iter().for_each(|frame| smoother.push(frame));
    let path = smoother.smoothed(config);
    let mut walk = path.walk();
    let mut smoothed = Vec::with_capacity(frames.len());
    frames.iter().for_each(|frame| walk.next(frame, &mut |frame| smoothed.push(frame)));
    smoothed
}

/// Gathers what was measured, for [`smooth`] over frames that are not in memory at once.
#[derive(Debug)]
pub struct Smoother {
    /// From the first measured frame on.
    times_s: Vec<f64>,
    measured: [Vec<Measured>; 3],
    /// How many of them there are up to the last measured one.
    count: usize,
}

impl Smoother {
    /// Of a recording of about so many frames.
    pub fn for_frames(frames: usize) -> Self {
        Self {
            times_s: Vec::with_capacity(frames),
            measured: [(); 3].map(|()| Vec::with_capacity(frames)),
            count: 0,
        }
    }

    /// Takes the next frame; its time must not be before that of the frame before.
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

    /// The path of all that was taken.
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

/// The coordinates of a smoothed path; what else its frames have comes from the frames themselves, which are gone through again.
#[derive(Debug)]
pub struct SmoothedPath {
    axes: [Vec<Smoothed>; 3],
}

impl SmoothedPath {
    /// A way through the path.
    pub fn walk(&self) -> Walk<'_> {
        Walk { path: self, next: 0, before: None, gap: Vec::new() }
    }
}

/// On the way through a smoothed path, along the frames that it was made of.
#[derive(Debug)]
pub struct Walk<'a> {
    path: &'a SmoothedPath,
    /// Counted from the first measured frame.
    next: usize,
    /// The last measured frame.
    before: Option<FrameEstimate>,
    /// Number and time of those since.
    gap: Vec<(u64, f64)>,
}

impl Walk<'_> {
    /// Takes the next of the frames, and gives the smoothed ones that are known with it: those of a gap come with the frame behind it.
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
    /// As an entry of a trajectory.
    pub fn stamped(&self) -> StampedPose {
        StampedPose { time_s: self.time_s, world_from_camera: self.pose.world_from_camera() }
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
        // What smoothing leaves of the frame's own noise; its correlations stay.
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

    /// A frame, of this number and time, between two measured ones.
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

/// The covariance of the ground that a frame was measured against.
fn carried(known: &PoseEstimate) -> Matrix3<f64> {
    known.covariance.fixed_view::<3, 3>(0, 0) - known.measured.covariance
}

/// Height, tilt and covariance between two measured frames.
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
    // Where the stretch behind a gap lies is not measured either: its covariance says so, and comes in with the way through the gap.
    let ends = carried(a) * (1.0 - share) + carried(b) * share;
    // A white jerk over a long gap leads beyond what anything that rolls or walks would do: nobody goes further than twice as fast as
    // at the ends, or sets off at more than 0.2 m/s and 0.2 rad/s (two standard deviations), and then comes back.
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
