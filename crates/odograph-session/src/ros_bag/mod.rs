//! A run as a bag of ROS 2: an MCAP file with poses, transforms and diagnostics in CDR.
//!
//! The frames are those of ROS REP-105: `odom`, in which poses never jump, and `map`, in which
//! loops and other sensors have corrected them. Of each frame there are the pose as odometry had it
//! (`/odometry`, and `odom` → `base_link` or `camera` in `/tf`), the correction (`map` → `odom`)
//! and whether it was tracked (`/diagnostics`).

mod definitions;

use crate::files::cannot_be_written;
use crate::ros_messages::{CAMERA, Diagnostic, MAP, ODOM, odometry, transforms};
use definitions::{DIAGNOSTICS, Definition, ODOMETRY, TRANSFORMS};
use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{WriteOptions, Writer};
use nalgebra::Isometry3;
use odograph::error::{Error, Result};
use odograph::geometry::GroundPose;
use odograph::pose_frame::{PoseFrame, PoseFrames};
use odograph::trajectory::FrameEstimate;
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;

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
        self.put(self.diagnostics, time_ns, &Diagnostic::of(camera).message(time_ns))
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

#[cfg(test)]
mod tests {
    use super::*;

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
