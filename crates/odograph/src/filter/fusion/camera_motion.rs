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
    pub keyframe_covariance: Matrix3<f64>,
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
            keyframe_covariance: known.covariance.fixed_view::<3, 3>(0, 0) - plane.covariance,
            height_variance: known.covariance[(HEIGHT, HEIGHT)].max(0.0),
        });
    }
    leave_out_passing_errors(&mut nodes);
    nodes
}

/// An error that is gone after this time has not accumulated, seconds: while the readout time of
/// the image is being learned, for a second or so, the heading alone is uncertain by a degree.
const PASSING_S: f64 = 2.0;

/// Reduces the covariances to what is still there after [`PASSING_S`].
fn leave_out_passing_errors(nodes: &mut [MeasuredFrame]) {
    for k in 0..nodes.len() {
        let (here, after) = nodes[k..].split_at_mut(1);
        let node = &mut here[0];
        let is_near =
            |later: &&MeasuredFrame| later.segment == node.segment && later.time_s <= node.time_s + PASSING_S;
        let mut least = node.keyframe_covariance.diagonal();
        for later in after.iter().take_while(is_near) {
            least = least.inf(&later.keyframe_covariance.diagonal());
        }
        for (i, least) in least.iter().enumerate() {
            let share = least.max(0.0) / node.keyframe_covariance[(i, i)];
            if share < 1.0 {
                node.keyframe_covariance.row_mut(i).scale_mut(share.sqrt());
                node.keyframe_covariance.column_mut(i).scale_mut(share.sqrt());
            }
        }
    }
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use crate::geometry::GroundPose;
    use crate::geometry::pose_index::HEADING;
    use crate::trajectory::{PlaneMeasurement, PoseEstimate, TrackStatus};
    use nalgebra::Matrix6;

    fn frame(number: u64, heading_variance: f64) -> FrameEstimate {
        let mut covariance = Matrix6::identity() * 1e-6;
        covariance[(HEADING, HEADING)] = heading_variance;
        FrameEstimate {
            frame: number,
            time_s: number as f64 / 30.0,
            status: TrackStatus::Tracked,
            estimate: Some(PoseEstimate {
                pose: GroundPose::level(0.75),
                velocity: Default::default(),
                covariance,
                measured: PlaneMeasurement::new(&GroundPose::level(0.75), &Matrix6::zeros()),
            }),
            tracks: 100,
            inliers: 100,
            residual_px: 0.1,
            keyframe: false,
            segment: 0,
        }
    }

    #[test]
    fn an_uncertainty_that_passes_is_no_drift() {
        // One degree in the first second, and drift by a tenth of that from then on, until the
        // camera is back where it began.
        let variance = |k: u64| match k {
            0..30 => 3e-4 * k as f64 / 30.0,
            30..290 => 3e-6 * k as f64 / 290.0,
            _ => 1e-9,
        };
        let frames: Vec<_> = (0..300).map(|k| frame(k, variance(k))).collect();
        let nodes = nodes(&frames);
        let heading = |k: usize| nodes[k].keyframe_covariance[(HEADING, HEADING)];
        assert!((0..30).all(|k| heading(k) < 4e-7), "{:?}", (heading(15), heading(29)));
        assert!((heading(200) - variance(200)).abs() < 1e-12);
    }
}
