//! A run as a bag of ROS 2: an MCAP file with poses, transforms and diagnostics in CDR.
//!
//! The frames are those of ROS REP-105: `odom`, in which poses never jump, and `map`, in which
//! loops and other sensors have corrected them. Of each frame there are the pose as odometry had it
//! (`/odometry`, and `odom` → `base_link` or `camera` in `/tf`), the correction (`map` → `odom`)
//! and whether it was tracked (`/diagnostics`).

mod cdr;
mod definitions;

use crate::files::cannot_be_written;
use cdr::Cdr;
use definitions::{DIAGNOSTICS, Definition, ODOMETRY, TRANSFORMS};
use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{WriteOptions, Writer};
use nalgebra::{Isometry3, Matrix6};
use odograph::error::{Error, Result};
use odograph::geometry::GroundPose;
use odograph::geometry::pose_index::{HEADING, HEIGHT, PITCH, ROLL, X, Y};
use odograph::pose_frame::{PoseFrame, PoseFrames};
use odograph::trajectory::{FrameEstimate, PoseEstimate, TrackStatus, Velocity};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;

const MAP: &str = "map";
const ODOM: &str = "odom";
const CAMERA: &str = "camera";

/// Transforms that are published once must be kept for those who come later: the quality of service
/// that `ros2 bag play` offers for them.
const LATCHED: &str = "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:\n    sec: 9223372036\n    \
                       nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n  \
                       liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n  \
                       avoid_ros_namespace_conventions: false\n";

/// A bag while it is written.
pub struct RosBagWriter<'a, W: Write> {
    path: &'a Path,
    writer: Writer<NoSeek<W>>,
    of: PoseFrames,
    odometry: u16,
    transforms: u16,
    static_transforms: u16,
    diagnostics: u16,
    sequence: u32,
}

impl<'a, W: Write> RosBagWriter<'a, W> {
    /// A bag of the path of a frame; `path` is named in errors.
    pub fn new(path: &'a Path, output: W, of: PoseFrames) -> Result<Self> {
        let options = WriteOptions::new()
            .disable_seeking(true)
            .compression(None)
            .profile("ros2")
            .library(concat!("odograph ", env!("CARGO_PKG_VERSION")));
        let begun = || -> mcap::McapResult<_> {
            let mut writer = Writer::with_options(NoSeek::new(output), options)?;
            let mut channel = |topic: &str, of: &Definition, quality: &str| {
                let schema = writer.add_schema(of.name, "ros2msg", of.text().as_bytes())?;
                let offered = BTreeMap::from([("offered_qos_profiles".to_owned(), quality.to_owned())]);
                writer.add_channel(schema, topic, "cdr", &offered)
            };
            let odometry = channel("/odometry", &ODOMETRY, "")?;
            let transforms = channel("/tf", &TRANSFORMS, "")?;
            let static_transforms = channel("/tf_static", &TRANSFORMS, LATCHED)?;
            let diagnostics = channel("/diagnostics", &DIAGNOSTICS, "")?;
            Ok((writer, [odometry, transforms, static_transforms, diagnostics]))
        };
        let (writer, channels) = begun().map_err(|error| unwritten(path, error))?;
        let [odometry, transforms, static_transforms, diagnostics] = channels;
        Ok(Self { path, writer, of, odometry, transforms, static_transforms, diagnostics, sequence: 0 })
    }

    /// Appends a frame of the camera's path in the odometry frame, with the pose that the camera
    /// finally has in the map frame. ROS has no times before 0.
    pub fn add(&mut self, camera: &FrameEstimate, in_map: Option<&GroundPose>) -> Result<()> {
        let time_ns = (camera.time_s * 1e9).round() as u64;
        let of = *self.of.at(camera.frame);
        if self.sequence == 0
            && let PoseFrame::BaseLink(base) = self.of.last()
        {
            let on_robot = transforms(time_ns, &[(of.name(), CAMERA, *base.base_from_camera())]);
            self.put(self.static_transforms, time_ns, &on_robot)?;
        }
        self.sequence = self.sequence.saturating_add(1);
        let placed_frame = of.frame(camera);
        if let Some((known, seen)) = placed_frame.estimate.as_ref().zip(camera.estimate.as_ref()) {
            let placed = of.world_from_frame(&known.pose);
            let odom_from_camera = seen.pose.world_from_camera();
            let map_from_odom = in_map.map_or_else(Isometry3::identity, |in_map| {
                in_map.world_from_camera() * odom_from_camera.inverse()
            });
            let moved = [(MAP, ODOM, map_from_odom), (ODOM, of.name(), placed)];
            self.put(self.odometry, time_ns, &odometry(time_ns, of.name(), &placed, known))?;
            self.put(self.transforms, time_ns, &transforms(time_ns, &moved))?;
        }
        self.put(self.diagnostics, time_ns, &diagnostics(time_ns, camera))
    }

    fn put(&mut self, channel_id: u16, time_ns: u64, message: &[u8]) -> Result<()> {
        let sequence = self.sequence;
        let header = MessageHeader { channel_id, sequence, log_time: time_ns, publish_time: time_ns };
        self.writer.write_to_known_channel(&header, message).map_err(|error| unwritten(self.path, error))
    }

    /// Completes the bag with its index.
    pub fn finish(mut self) -> Result<()> {
        self.writer.finish().map(drop).map_err(|error| unwritten(self.path, error))
    }
}

fn unwritten(path: &Path, error: mcap::McapError) -> Error {
    match error {
        mcap::McapError::Io(error) => cannot_be_written(path, error),
        other => cannot_be_written(path, io::Error::other(other)),
    }
}

/// `nav_msgs/msg/Odometry`
fn odometry(time_ns: u64, child: &str, placed: &Isometry3<f64>, known: &PoseEstimate) -> Vec<u8> {
    let mut message = Cdr::new();
    message.header(time_ns, ODOM);
    message.text(child);
    message.pose(placed);
    message.covariance(&about_fixed_axes(&known.pose, &known.covariance));
    // In the axes of the child.
    let Velocity { x_m_s, y_m_s, heading_rad_s } = known.velocity;
    let in_child = |x: f64, y: f64, z: f64| placed.rotation.inverse() * nalgebra::Vector3::new(x, y, z);
    message.doubles(in_child(x_m_s, y_m_s, 0.0).iter().copied());
    message.doubles(in_child(0.0, 0.0, heading_rad_s).iter().copied());
    // Not known, as the first element says.
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
fn transforms(time_ns: u64, all: &[(&str, &str, Isometry3<f64>)]) -> Vec<u8> {
    let mut message = Cdr::new();
    message.u32(all.len() as u32);
    for (parent, child, pose) in all {
        message.header(time_ns, parent);
        message.text(child);
        message.pose(pose);
    }
    message.finished()
}

/// `diagnostic_msgs/msg/DiagnosticArray` with one status: whether the frame was tracked.
fn diagnostics(time_ns: u64, frame: &FrameEstimate) -> Vec<u8> {
    let mut message = Cdr::new();
    message.header(time_ns, "");
    message.u32(1);
    message.u8(u8::from(frame.status != TrackStatus::Tracked)); // OK or WARN
    message.text("odograph: tracking");
    message.text(&frame.status.to_string());
    message.text(CAMERA);
    let values = [
        ("frame", frame.frame.to_string()),
        ("tracks", frame.tracks.to_string()),
        ("inliers", frame.inliers.to_string()),
        ("residual_px", format!("{:.4}", frame.residual_px)),
        ("segment", frame.segment.to_string()),
    ];
    message.u32(values.len() as u32);
    for (key, value) in &values {
        message.text(key);
        message.text(value);
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
    fn definitions_name_every_part() {
        for definition in [ODOMETRY, TRANSFORMS, DIAGNOSTICS] {
            let text = definition.text();
            for word in text.split_whitespace().filter(|word| word.contains('/')) {
                let part = format!("MSG: {}\n", word.trim_end_matches("[]"));
                assert!(text.contains(&part), "{word} of {}", definition.name);
            }
        }
    }
}
