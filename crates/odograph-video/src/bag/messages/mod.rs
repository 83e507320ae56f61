//! The message types that are read: images, videos, cameras, and sensors.

pub(crate) mod camera_info;
mod protobuf;
pub(crate) mod image;
pub(crate) mod pose;
pub(crate) mod sensor;
pub(crate) mod transforms;

use super::cursor::{MessageCursor, Serialization};
use super::recording::Topic;
use std::borrow::Cow;

/// What the messages of a topic are to this program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Role {
    /// Uncompressed images.
    Image,
    /// One JPEG or PNG image each.
    CompressedImage,
    /// One packet of a video each.
    Video(VideoMessage),
    CameraInfo,
    Gyro,
    Wheel,
    Range,
    Gnss,
    /// Poses of anything.
    Pose,
    Other,
}

/// Message types that carry a video.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum VideoMessage {
    /// `foxglove.CompressedVideo`
    Foxglove,
    /// `ffmpeg_image_transport_msgs/FFMPEGPacket`
    FfmpegPacket,
}

/// An uncompressed image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RawImage<'a> {
    pub width: usize,
    pub height: usize,
    pub encoding: Cow<'a, str>,
    pub big_endian: bool,
    /// Bytes from one row to the next.
    pub step: usize,
    pub data: &'a [u8],
}

/// A packet of a video.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct VideoPacket<'a> {
    /// Name of the codec.
    pub format: Cow<'a, str>,
    pub data: &'a [u8],
}

impl Role {
    pub fn of(topic: &Topic) -> Self {
        let protobuf = topic.serialization == Serialization::Protobuf;
        if !protobuf && !matches!(topic.serialization, Serialization::Cdr | Serialization::Ros1) {
            return Self::Other;
        }
        match (topic.plain_type().as_str(), protobuf) {
            ("sensor_msgs/Image", false) | ("foxglove.RawImage", true) => Self::Image,
            // A depth image with a header of its own before the PNG.
            ("sensor_msgs/CompressedImage", false) if topic.name.ends_with("/compressedDepth") => Self::Other,
            ("sensor_msgs/CompressedImage", false) | ("foxglove.CompressedImage", true) => {
                Self::CompressedImage
            }
            ("foxglove_msgs/CompressedVideo", false) | ("foxglove.CompressedVideo", true) => {
                Self::Video(VideoMessage::Foxglove)
            }
            ("ffmpeg_image_transport_msgs/FFMPEGPacket", false) => Self::Video(VideoMessage::FfmpegPacket),
            ("sensor_msgs/CameraInfo", false) => Self::CameraInfo,
            ("sensor_msgs/Imu", false) => Self::Gyro,
            ("nav_msgs/Odometry", false) => Self::Wheel,
            ("sensor_msgs/Range", false) => Self::Range,
            ("sensor_msgs/NavSatFix", false) => Self::Gnss,
            (
                "geometry_msgs/PoseStamped"
                | "geometry_msgs/PoseWithCovarianceStamped"
                | "geometry_msgs/TransformStamped",
                false,
            ) => Self::Pose,
            _ => Self::Other,
        }
    }

    /// Whether frames can be read from the topic.
    pub fn has_frames(self) -> bool {
        matches!(self, Self::Image | Self::CompressedImage | Self::Video(_))
    }
}

/// The time in the message of a topic, nanoseconds; `None` if it has none that is read, or it is
/// zero, which means that nobody has set it.
pub(crate) fn stamp_ns(topic: &Topic, data: &[u8]) -> Option<i64> {
    let stamp_ns = match (Role::of(topic), &topic.serialization) {
        (Role::Other, _) => None,
        (_, Serialization::Protobuf) => protobuf::stamp_ns(data),
        (Role::Video(VideoMessage::Foxglove), serialization) => {
            MessageCursor::new(data, serialization)?.time_ns()
        }
        (_, serialization) => MessageCursor::new(data, serialization)?.header().map(|header| header.stamp_ns),
    };
    stamp_ns.filter(|&stamp_ns| stamp_ns != 0)
}

/// The frame of reference in the message of a topic; empty if it has none that is read.
pub(crate) fn frame_id(topic: &Topic, data: &[u8]) -> String {
    if topic.serialization == Serialization::Protobuf {
        return String::new();
    }
    let header = MessageCursor::new(data, &topic.serialization).and_then(|mut cursor| cursor.header());
    header.map(|header| header.frame.into_owned()).unwrap_or_default()
}

/// Nanoseconds as seconds, split before the conversion to keep precision.
pub(crate) fn seconds(time_ns: i64) -> f64 {
    const UNIT: i64 = 1_000_000_000;
    time_ns.div_euclid(UNIT) as f64 + time_ns.rem_euclid(UNIT) as f64 / UNIT as f64
}
