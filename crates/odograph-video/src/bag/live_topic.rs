//! The messages of a ROS 2 topic as they come, read as those of a recording are.

use super::camera::{is_rectified, names_beside};
use super::cursor::Serialization;
use super::messages::camera_info::CameraInfo;
use super::messages::{Role, frame_id, image, seconds, sensor, stamp_ns, transforms};
use super::mount::{RecordedMount, Tree};
use super::recording::Topic;
use crate::frame::Picture;
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::filter::fusion::Quantity;

/// Message types of ROS 2 that are read as they come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LiveMessage {
    /// `sensor_msgs/Image`
    Image,
    /// `sensor_msgs/CompressedImage`: JPEG or PNG.
    CompressedImage,
    /// `sensor_msgs/CameraInfo`
    CameraInfo,
    /// `sensor_msgs/Imu`
    Imu,
    /// `nav_msgs/Odometry`
    Odometry,
    /// `sensor_msgs/Range`
    Range,
    /// `tf2_msgs/TFMessage`
    Transforms,
}

impl LiveMessage {
    const ALL: [Self; 7] = [
        Self::Image,
        Self::CompressedImage,
        Self::CameraInfo,
        Self::Imu,
        Self::Odometry,
        Self::Range,
        Self::Transforms,
    ];

    /// The message type that has this name, such as `sensor_msgs/msg/Image`.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|message| message.type_name() == name)
    }

    /// Its name, such as `sensor_msgs/msg/Image`.
    pub fn type_name(self) -> &'static str {
        match self {
            Self::Image => "sensor_msgs/msg/Image",
            Self::CompressedImage => "sensor_msgs/msg/CompressedImage",
            Self::CameraInfo => "sensor_msgs/msg/CameraInfo",
            Self::Imu => "sensor_msgs/msg/Imu",
            Self::Odometry => "nav_msgs/msg/Odometry",
            Self::Range => "sensor_msgs/msg/Range",
            Self::Transforms => "tf2_msgs/msg/TFMessage",
        }
    }
}

/// A topic of a running ROS 2 system. Its messages are in CDR, behind four bytes that say how they
/// are represented.
#[derive(Debug, Clone)]
pub struct LiveTopic(Topic);

impl LiveTopic {
    /// A topic by its name, with its leading slash.
    pub fn new(name: impl Into<String>, message: LiveMessage) -> Self {
        let type_name = message.type_name().to_owned();
        let serialization = Serialization::Cdr;
        Self(Topic { name: name.into(), type_name, serialization, count: 0, span_ns: (0, 0) })
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.0.name
    }

    /// The time in a message, nanoseconds; `None` if nobody has set it, or the message is cut off.
    pub fn stamp_ns(&self, message: &[u8]) -> Option<i64> {
        stamp_ns(&self.0, message)
    }

    /// A time of a message as the seconds that a [`Frame`](crate::Frame) has.
    pub fn seconds(time_ns: i64) -> f64 {
        seconds(time_ns)
    }

    /// The frame of reference in a message; empty if it has none.
    pub fn frame_id(&self, message: &[u8]) -> String {
        frame_id(&self.0, message)
    }

    /// The picture of an image message, with its colour.
    ///
    /// # Errors
    /// If it is damaged, in an encoding that is not read, or no image message.
    pub fn picture(&self, message: &[u8]) -> Result<Picture> {
        match Role::of(&self.0) {
            Role::Image | Role::CompressedImage => image::picture(&self.0, message, 16, true),
            _ => Err(Error::input(format!("{} has no images", self.0.name))),
        }
    }

    /// Whether the images of the topic are rectified, by its name: `image_rect`.
    pub fn is_rectified(&self) -> bool {
        is_rectified(&self.0.name)
    }

    /// Names of the camera_info topics that belong to the images of this topic, the most likely
    /// first.
    pub fn camera_info_names(&self) -> [String; 3] {
        names_beside(&self.0.name)
    }

    /// The camera of a camera_info message, of the original images or the `rectified` ones.
    ///
    /// # Errors
    /// If the message is cut off, or its camera is not calibrated or of an unknown lens model.
    pub fn camera(&self, message: &[u8], rectified: bool) -> Result<Camera> {
        let cut_off = || Error::input("a camera_info message is cut off");
        CameraInfo::read(&self.0, message)
            .ok_or_else(cut_off)
            .and_then(|info| info.camera(rectified))
            .map_err(|error| error.at(&self.0.name))
    }

    /// The quantity that is taken from the messages; `None` if they are not of a sensor.
    pub fn quantity(&self) -> Option<Quantity> {
        sensor::quantity(Role::of(&self.0))
    }

    /// The values of a sensor's message, one for each channel of its quantity; `None` if it has
    /// none.
    pub fn values(&self, message: &[u8]) -> Option<Vec<f64>> {
        sensor::values(&self.0, message)
    }
}

/// The static transforms of a running robot, as far as they have come.
#[derive(Debug, Default)]
pub struct LiveTransforms(Tree);

impl LiveTransforms {
    /// Takes a message of `/tf_static`.
    pub fn add(&mut self, message: &[u8]) {
        let topic = LiveTopic::new("/tf_static", LiveMessage::Transforms);
        transforms::each(&topic.0, message, |transform| {
            self.0.insert(&transform.child, &transform.parent, transform.pose);
        });
    }

    /// The mount of the camera whose images have this frame of reference; `None` if the transforms
    /// do not connect it with `base_link`.
    pub fn mount(&self, camera_frame: &str) -> Option<RecordedMount> {
        let (base_from_camera, height_m) = self.0.base_from_camera(camera_frame)?;
        Some(RecordedMount { camera_frame: camera_frame.to_owned(), base_from_camera, height_m })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_message_is_read_as_it_comes() {
        let mut message = vec![0, 1, 0, 0, 7, 0, 0, 0, 9, 0, 0, 0, 4, 0, 0, 0];
        message.extend(b"cam\0");
        message.extend([1, 0, 0, 0, 2, 0, 0, 0, 6, 0, 0, 0]);
        message.extend(b"mono8\0\0\0\x02\0\0\0\x02\0\0\0ab");
        let topic = LiveTopic::new("/camera/image_raw", LiveMessage::Image);
        assert_eq!(topic.stamp_ns(&message), Some(7_000_000_009));
        assert_eq!(topic.frame_id(&message), "cam");
        assert_eq!(topic.picture(&message).unwrap().gray.samples(), b"ab");
        assert!(topic.picture(&message[..message.len() - 1]).is_err());
        assert_eq!(topic.camera_info_names()[0], "/camera/camera_info");
        let info = LiveTopic::new("/camera/camera_info", LiveMessage::CameraInfo);
        assert!(info.picture(&message).is_err() && info.camera(&message, false).is_err());
    }

    #[test]
    fn every_message_type_is_found_by_its_name() {
        for message in LiveMessage::ALL {
            assert_eq!(LiveMessage::named(message.type_name()), Some(message));
        }
        assert_eq!(LiveMessage::named("std_msgs/msg/String"), None);
    }
}
