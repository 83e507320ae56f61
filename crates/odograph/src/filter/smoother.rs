//! A smoother for recordings: every frame's position and heading from what came before *and* after it.
//!
//! The estimates are those of H. Rauch, F. Tung and C. Striebel, "Maximum likelihood estimates of linear dynamic systems", 1965, computed
//! in the form of A. Bryson and M. Frazier (G. Bierman, "Fixed interval smoothing with discrete measurements", 1973), which inverts nothing
//! but the innovation's variance. The model is that of [`super::ConstantAcceleration`]; how much the acceleration changes is told by the
//! innovations of a filter that runs forward in time and of one that runs backward, the larger of the two, so that the first frame of a
//! jerk is not smoothed away. Where frames are missing the same equations bridge the gap.

use super::FilterConfig;
use super::constant_acceleration::{Axis, SMALLEST_VARIANCE, transition, unknown_motion, white_jerk};
use crate::geometry::GroundPose;
use crate::trajectory::StampedPose;
use crate::trajectory::{FrameEstimate, PoseEstimate, Trajectory, Velocity};
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
    let measured = |frame: &FrameEstimate| frame.estimate.is_some();
    let (Some(first), Some(last)) = (frames.iter().position(measured), frames.iter().rposition(measured))
    else {
        return Vec::new();
    };
    let frames = &frames[first..=last];
    let densities = [config.jerk_density, config.jerk_density, config.heading_jerk_density];
    let axes = [0, 1, 2].map(|axis| {
        let sample = |frame: &FrameEstimate| Sample {
            time_s: frame.time_s,
            measured: frame.estimate.as_ref().map(|known| {
                let plane = &known.measured;
                let value = [plane.x_m, plane.y_m, plane.heading_rad][axis];
                (value, plane.covariance[(axis, axis)].max(SMALLEST_VARIANCE))
            }),
        };
        let samples: Vec<Sample> = frames.iter().map(sample).collect();
        smooth_axis(&samples, &adapted(&samples, densities[axis]))
    });
    let ends = Ends::of(frames);
    (0..frames.len())
        .map(|i| smoothed_frame(frames, &ends, i, axes.each_ref().map(|axis| &axis[i])))
        .collect()
}

impl SmoothedFrame {
    /// The poses of smoothed frames as a trajectory. Of frames at the same moment the first counts.
    pub fn trajectory(path: &[Self]) -> Trajectory {
        let mut poses: Vec<StampedPose> = Vec::with_capacity(path.len());
        for frame in path {
            if poses.last().is_none_or(|before| before.time_s < frame.time_s) {
                let world_from_camera = frame.pose.world_from_camera();
                poses.push(StampedPose { time_s: frame.time_s, world_from_camera });
            }
        }
        Trajectory { poses }
    }
}

/// A coordinate at a moment: its measured value and the variance of that, where there is one.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    pub time_s: f64,
    pub measured: Option<(f64, f64)>,
}

/// A coordinate, its velocity and acceleration, and the variance of the coordinate.
#[derive(Debug, Clone, Copy)]
pub(super) struct Smoothed {
    pub state: Vector3<f64>,
    pub variance: f64,
}

/// The density of the jerk in each step (from the sample before to this one) as the innovations have it, in both directions of time.
fn adapted(samples: &[Sample], least_density: f64) -> Vec<f64> {
    let mut densities = vec![least_density; samples.len()];
    let known: Vec<(usize, f64, f64)> =
        samples.iter().enumerate().filter_map(|(i, s)| s.measured.map(|(z, r)| (i, z, r))).collect();
    let mut run = |order: &mut dyn Iterator<Item = &(usize, f64, f64)>| {
        let Some(&(mut before, z, r)) = order.next() else { return };
        let mut axis = Axis::new(z, r, least_density);
        for &(i, z, r) in order {
            let step_s = (samples[i].time_s - samples[before].time_s).abs();
            let density = axis.update(step_s, z, r);
            for step in &mut densities[before.min(i) + 1..=before.max(i)] {
                *step = step.max(density);
            }
            before = i;
        }
    };
    run(&mut known.iter());
    run(&mut known.iter().rev());
    densities
}

/// What the filter has at one sample, for the way back.
struct Step {
    state: Vector3<f64>,
    covariance: Matrix3<f64>,
    transition: Matrix3<f64>,
    /// Innovation, its variance and the gain, where there was a measurement.
    update: Option<(f64, f64, Vector3<f64>)>,
}

/// Every sample from all of them. The first one must be measured. `densities` is that of the jerk in the step before each sample.
pub(super) fn smooth_axis(samples: &[Sample], densities: &[f64]) -> Vec<Smoothed> {
    let Some(first) = samples.first() else { return Vec::new() };
    let (value, variance) = first.measured.unwrap_or((0.0, 1e6));
    let mut steps = vec![Step {
        state: Vector3::new(value, 0.0, 0.0),
        covariance: unknown_motion(variance),
        transition: Matrix3::identity(),
        update: None,
    }];
    for (pair, &density) in samples.windows(2).zip(&densities[1..]) {
        let before = &steps[steps.len() - 1];
        let t = (pair[1].time_s - pair[0].time_s).max(0.0);
        let transition = transition(t);
        let state = transition * before.state;
        let covariance = transition * before.covariance * transition.transpose() + density * white_jerk(t);
        steps.push(match pair[1].measured {
            None => Step { state, covariance, transition, update: None },
            Some((z, r)) => {
                let (innovation, spread) = (z - state[0], covariance[(0, 0)] + r);
                let gain = covariance.column(0) / spread;
                let keep = Matrix3::identity() - gain * Vector3::x().transpose();
                Step {
                    state: state + gain * innovation,
                    covariance: keep * covariance * keep.transpose() + gain * gain.transpose() * r,
                    transition,
                    update: Some((innovation, spread, gain)),
                }
            }
        });
    }
    let (mut adjoint, mut information) = (Vector3::zeros(), Matrix3::zeros());
    let mut smoothed: Vec<Smoothed> = steps
        .iter()
        .rev()
        .map(|step| {
            let covariance = step.covariance - step.covariance * information * step.covariance;
            let here = Smoothed {
                state: step.state - step.covariance * adjoint,
                variance: covariance[(0, 0)]
                    .clamp(SMALLEST_VARIANCE, step.covariance[(0, 0)].max(SMALLEST_VARIANCE)),
            };
            if let Some((innovation, spread, gain)) = step.update {
                let keep = Matrix3::identity() - gain * Vector3::x().transpose();
                adjoint = keep.transpose() * adjoint - Vector3::x() * (innovation / spread);
                information = keep.transpose() * information * keep;
                information[(0, 0)] += 1.0 / spread;
            }
            adjoint = step.transition.transpose() * adjoint;
            information = step.transition.transpose() * information * step.transition;
            here
        })
        .collect();
    smoothed.reverse();
    smoothed
}

/// For each frame the measured frames at or before and at or after it.
struct Ends {
    before: Vec<usize>,
    after: Vec<usize>,
}

impl Ends {
    /// The first and the last frame are measured.
    fn of(frames: &[FrameEstimate]) -> Self {
        let mut before = vec![0; frames.len()];
        let mut after = vec![frames.len().saturating_sub(1); frames.len()];
        for i in 1..frames.len() {
            before[i] = if frames[i].estimate.is_some() { i } else { before[i - 1] };
        }
        for i in (0..frames.len().saturating_sub(1)).rev() {
            after[i] = if frames[i].estimate.is_some() { i } else { after[i + 1] };
        }
        Self { before, after }
    }
}

fn smoothed_frame(frames: &[FrameEstimate], ends: &Ends, i: usize, axes: [&Smoothed; 3]) -> SmoothedFrame {
    let frame = &frames[i];
    let [x, y, heading] = axes.map(|axis| axis.state);
    let velocity = Velocity { x_m_s: x[1], y_m_s: y[1], heading_rad_s: heading[1] };
    let variances = axes.map(|axis| axis.variance);
    let level = GroundPose { x_m: x[0], y_m: y[0], heading_rad: heading[0], ..GroundPose::level(1.0) };
    let (height_m, roll_rad, pitch_rad, covariance) = match &frame.estimate {
        Some(known) => {
            // What smoothing leaves of the frame's own noise; its correlations stay.
            let own = known.measured.covariance;
            let left = Matrix3::from_diagonal(&Vector3::from_fn(|axis, _| {
                (variances[axis] / own[(axis, axis)].max(SMALLEST_VARIANCE)).min(1.0).sqrt()
            }));
            let pose = &known.pose;
            (pose.height_m, pose.roll_rad, pose.pitch_rad, carried(known) + left * own * left)
        }
        None => bridged(frames, (ends.before[i], ends.after[i]), frame.time_s, &velocity, variances),
    };
    SmoothedFrame {
        frame: frame.frame,
        time_s: frame.time_s,
        pose: GroundPose { height_m, roll_rad, pitch_rad, ..level },
        velocity,
        covariance,
        source: if frame.estimate.is_some() { PoseSource::Measured } else { PoseSource::Bridged },
        segment: frames[ends.before[i]].segment,
    }
}

/// The covariance of the ground that a frame was measured against.
fn carried(known: &PoseEstimate) -> Matrix3<f64> {
    known.covariance.fixed_view::<3, 3>(0, 0) - known.measured.covariance
}

/// Height, tilt and covariance between two measured frames.
fn bridged(
    frames: &[FrameEstimate],
    (before, after): (usize, usize),
    time_s: f64,
    velocity: &Velocity,
    variances: [f64; 3],
) -> (f64, f64, f64, Matrix3<f64>) {
    let (Some(a), Some(b)) = (&frames[before].estimate, &frames[after].estimate) else {
        return (1.0, 0.0, 0.0, Matrix3::from_diagonal(&Vector3::from(variances)));
    };
    let (since_s, left_s) = (time_s - frames[before].time_s, frames[after].time_s - time_s);
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
