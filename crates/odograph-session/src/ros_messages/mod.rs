//! Frames as ROS 2 messages, serialised as CDR with its four bytes of representation: for bags, and
//! for whoever publishes a live run.
//!
//! The frames of reference are those of ROS REP-105: `odom`, in which poses never jump, and `map`,
//! in which loops have corrected them.

mod cdr;
mod ground;
mod parameters;
mod services;

pub use ground::{GroundRaster, compressed_image, map_meta_data, occupancy_grid};
pub use parameters::{
    Parameter, ParameterValue, parameter_descriptions, parameter_event, parameter_list, parameter_result,
    parameter_results, parameter_types, parameter_values, requested_changes, requested_names,
    requested_prefixes,
};
pub use services::trigger_response;

use cdr::Cdr;
use nalgebra::{Isometry3, Matrix6};
use odograph::geometry::GroundPose;
use odograph::geometry::pose_index::{HEADING, HEIGHT, PITCH, ROLL, X, Y};
use odograph::trajectory::{FrameEstimate, PoseEstimate, TrackStatus, Velocity};

/// The frame in which poses are consistent, and jump when a loop is closed.
pub const MAP: &str = "map";
/// The frame in which poses never jump.
pub const ODOM: &str = "odom";
/// The camera's optical frame, where it has no name of its own.
pub const CAMERA: &str = "camera";

/// `nav_msgs/msg/Odometry`: the pose of `child` in `odom` with its covariance, and its velocity in
/// its own axes. The covariance of the velocity is not known, as its first element, −1, says.
pub fn odometry(time_ns: u64, child: &str, placed: &Isometry3<f64>, known: &PoseEstimate) -> Vec<u8> {
    let mut message = Cdr::new();
    message.header(time_ns, ODOM);
    message.text(child);
    message.pose(placed);
    message.covariance(&about_fixed_axes(&known.pose, &known.covariance));
    let Velocity { x_m_s, y_m_s, heading_rad_s } = known.velocity;
    let in_child = |x: f64, y: f64, z: f64| placed.rotation.inverse() * nalgebra::Vector3::new(x, y, z);
    message.doubles(in_child(x_m_s, y_m_s, 0.0).iter().copied());
    message.doubles(in_child(0.0, 0.0, heading_rad_s).iter().copied());
    let mut unknown = Matrix6::zeros();
    unknown[(0, 0)] = -1.0;
    message.covariance(&unknown);
    message.finished()
}

/// The covariance of position and rotation about the fixed axes x, y, z, as
/// `geometry_msgs/PoseWithCovariance` has it, from that of (x, y, heading, height, roll, pitch).
fn about_fixed_axes(pose: &GroundPose, covariance: &Matrix6<f64>) -> Matrix6<f64> {
    let axes = pose.rotation_axes();
    let mut jacobian = Matrix6::zeros();
    for (row, index) in [X, Y, HEIGHT].into_iter().enumerate() {
        jacobian[(row, index)] = 1.0;
    }
    for (column, index) in [HEADING, ROLL, PITCH].into_iter().enumerate() {
        (0..3).for_each(|row| jacobian[(3 + row, index)] = axes[(row, column)]);
    }
    odograph::geometry::propagated(&jacobian, covariance)
}

/// `tf2_msgs/msg/TFMessage`: parent, child, and the child's pose in the parent.
pub fn transforms(time_ns: u64, all: &[(&str, &str, Isometry3<f64>)]) -> Vec<u8> {
    let mut message = Cdr::new();
    message.u32(all.len() as u32);
    for (parent, child, pose) in all {
        message.header(time_ns, parent);
        message.text(child);
        message.pose(pose);
    }
    message.finished()
}

/// `nav_msgs/msg/Path` in `odom`: times and poses.
pub fn path(time_ns: u64, poses: &[(u64, Isometry3<f64>)]) -> Vec<u8> {
    let mut message = Cdr::new();
    message.header(time_ns, ODOM);
    message.u32(poses.len() as u32);
    for (time_ns, pose) in poses {
        message.header(*time_ns, ODOM);
        message.pose(pose);
    }
    message.finished()
}

/// How serious a [`Diagnostic`] is, as `diagnostic_msgs/DiagnosticStatus` has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Severity {
    /// Tracked.
    Ok,
    /// Lost.
    Warning,
    /// Ended.
    Error,
    /// No images come.
    Stale,
}

/// The state of the tracking.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diagnostic {
    /// How serious it is.
    pub severity: Severity,
    /// What there is to say, in a word or a sentence.
    pub message: String,
    /// Numbers by their names.
    pub values: Vec<(&'static str, String)>,
}

impl Diagnostic {
    /// Whether a frame was tracked, and why not.
    pub fn of(frame: &FrameEstimate) -> Self {
        let is_tracked = frame.status == TrackStatus::Tracked;
        Self {
            severity: if is_tracked { Severity::Ok } else { Severity::Warning },
            message: frame.status.to_string(),
            values: vec![
                ("frame", frame.frame.to_string()),
                ("tracks", frame.tracks.to_string()),
                ("inliers", frame.inliers.to_string()),
                ("residual_px", format!("{:.4}", frame.residual_px)),
                ("segment", frame.segment.to_string()),
            ],
        }
    }

    /// `diagnostic_msgs/msg/DiagnosticArray` with this status alone.
    pub fn message(&self, time_ns: u64) -> Vec<u8> {
        let mut message = Cdr::new();
        message.header(time_ns, "");
        message.u32(1);
        message.u8(self.severity as u8);
        message.text("odograph: tracking");
        message.text(&self.message);
        message.text(CAMERA);
        message.u32(self.values.len() as u32);
        for (key, value) in &self.values {
            message.text(key);
            message.text(value);
        }
        message.finished()
    }
}

/// `rmw_dds_common/msg/ParticipantEntitiesInfo`: the endpoints of a DDS participant that are those
/// of one node, by their 16 bytes. Distributions before Iron have 24 bytes for each.
pub fn participant(
    participant: [u8; 16],
    node: &str,
    readers: &[[u8; 16]],
    writers: &[[u8; 16]],
    distribution: &str,
) -> Vec<u8> {
    let more = if ["foxy", "galactic", "humble"].contains(&distribution) { 8 } else { 0 };
    let mut message = Cdr::new();
    let identifier = |message: &mut Cdr, bytes: &[u8; 16]| {
        bytes.iter().for_each(|byte| message.u8(*byte));
        (0..more).for_each(|_| message.u8(0));
    };
    identifier(&mut message, &participant);
    message.u32(1);
    message.text("/");
    message.text(node);
    for endpoints in [readers, writers] {
        message.u32(endpoints.len() as u32);
        endpoints.iter().for_each(|endpoint| identifier(&mut message, endpoint));
    }
    message.finished()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_covariance_of_a_level_pose_has_its_angles_about_the_fixed_axes() {
        let pose = GroundPose { heading_rad: std::f64::consts::FRAC_PI_2, ..GroundPose::level(1.0) };
        let variances = nalgebra::Vector6::new(1.0, 2.0, 3.0, 4.0, 5.0, 6.0);
        let fixed = about_fixed_axes(&pose, &Matrix6::from_diagonal(&variances));
        // x, y, z; the robot faces y: its roll turns about y, its pitch about −x.
        for (index, expected) in [1.0, 2.0, 4.0, 6.0, 5.0, 3.0].into_iter().enumerate() {
            assert!((fixed[(index, index)] - expected).abs() < 1e-12, "{index}: {fixed}");
        }
    }

    #[test]
    fn a_path_is_as_long_as_its_poses() {
        // Header: 8 bytes of time, 4 of length, "odom" and its zero; 3 before the next number.
        let pose = Isometry3::translation(1.0, 2.0, 3.0);
        assert_eq!(path(0, &[]).len(), 4 + 8 + 4 + 5 + 3 + 4);
        // The doubles of a pose are aligned to 8 bytes behind the representation.
        assert_eq!(path(0, &[(5, pose)]).len(), 4 + 48 + 56);
    }
}
