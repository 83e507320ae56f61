//! The camera's motion in the form that sensors are calibrated against.

use crate::geometry::pose_index::HEIGHT;
use crate::geometry::{PlaneTransform, Se2};
use crate::trajectory::FrameEstimate;
use nalgebra::Matrix3;

/// A measured frame.
#[derive(Debug, Clone, Copy)]
pub struct MeasuredFrame {
    /// Index of the frame.
    pub index: usize,
    pub time_s: f64,
    pub segment: usize,
    pub x_m: f64,
    pub y_m: f64,
    pub heading_rad: f64,
    pub height_m: f64,
    /// Cosine of the angle between the optical axis and the vertical.
    pub tilt_cosine: f64,
    /// Covariance of (x, y, heading) of the reference keyframe, without the frame's own measurement
    /// noise.
    pub carried: Matrix3<f64>,
    /// Variance of the height relative to the start of the run, square metres.
    pub height_variance: f64,
}

/// Motion from one measured frame to the next of the same segment.
#[derive(Debug, Clone, Copy)]
pub struct MotionStep {
    /// Index of the first node.
    pub from: usize,
    pub from_s: f64,
    pub to_s: f64,
    /// Translation towards the top of the image and to its left, metres.
    pub ahead_m: f64,
    pub left_m: f64,
    /// Change of heading, counter-clockwise, radians.
    pub turn_rad: f64,
    pub segment: usize,
}

impl MotionStep {
    pub fn duration_s(&self) -> f64 {
        self.to_s - self.from_s
    }
}

/// The measured frames, in order of time; of frames with the same timestamp only the first.
pub fn nodes(frames: &[FrameEstimate]) -> Vec<MeasuredFrame> {
    let mut nodes: Vec<MeasuredFrame> = Vec::new();
    for (index, frame) in frames.iter().enumerate() {
        let Some(known) = &frame.estimate else { continue };
        if nodes.last().is_some_and(|before| before.time_s >= frame.time_s) {
            continue;
        }
        let (plane, pose) = (&known.measured, &known.pose);
        nodes.push(MeasuredFrame {
            index,
            time_s: frame.time_s,
            segment: frame.segment,
            x_m: plane.x_m,
            y_m: plane.y_m,
            heading_rad: plane.heading_rad,
            height_m: pose.height_m,
            tilt_cosine: pose.roll_rad.cos() * pose.pitch_rad.cos(),
            carried: known.covariance.fixed_view::<3, 3>(0, 0) - plane.covariance,
            height_variance: known.covariance[(HEIGHT, HEIGHT)].max(0.0),
        });
    }
    nodes
}

/// Motions between consecutive nodes of one segment, except across intervals of more than a second.
pub fn steps(nodes: &[MeasuredFrame]) -> Vec<MotionStep> {
    let pairs = nodes.windows(2).enumerate();
    let connected = pairs
        .filter(|(_, pair)| pair[0].segment == pair[1].segment && pair[1].time_s - pair[0].time_s <= 1.0);
    connected
        .map(|(from, pair)| {
            let (a, b) = (&pair[0], &pair[1]);
            let turn_rad = b.heading_rad - a.heading_rad;
            // Midpoint rule: the chord of a short arc has the mean of the two headings.
            let half_way = Se2::new(a.x_m, a.y_m, a.heading_rad + 0.5 * turn_rad);
            let chord = half_way.between(&Se2::new(b.x_m, b.y_m, b.heading_rad));
            MotionStep {
                from,
                from_s: a.time_s,
                to_s: b.time_s,
                ahead_m: chord.x_m,
                left_m: chord.y_m,
                turn_rad,
                segment: a.segment,
            }
        })
        .collect()
}
