//! Names of topics and types, in ROS 2 and in DDS.
//!
//! `/camera/image_raw` is the DDS topic `rt/camera/image_raw`, `sensor_msgs/msg/Image` the DDS type
//! `sensor_msgs::msg::dds_::Image_`
//! (<https://design.ros2.org/articles/topic_and_service_names.html>).

use odograph::error::{Error, Result};
use std::fmt;
use std::str::FromStr;

/// The name of a topic, with its leading slash.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicName(String);

/// Longest name: DDS has no longer ones.
const LONGEST: usize = 250;

impl FromStr for TopicName {
    type Err = Error;

    /// Parses a name with or without its leading slash.
    fn from_str(text: &str) -> Result<Self> {
        let name = text.strip_prefix('/').unwrap_or(text);
        let is_word = |word: &str| {
            word.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
                && word.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
        };
        if name.len() <= LONGEST && name.split('/').all(is_word) {
            return Ok(Self(format!("/{name}")));
        }
        Err(Error::usage(format!(
            "{text:?} is not the name of a ROS 2 topic; one is words of letters, digits and underscores, such as \
             /camera/image_raw"
        )))
    }
}

impl fmt::Display for TopicName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl TopicName {
    /// As a text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// The name in DDS.
    pub(crate) fn in_dds(&self) -> String {
        format!("rt{}", self.0)
    }

    /// The names in DDS of the requests and the replies of a service with this name.
    pub(crate) fn service_in_dds(&self) -> [String; 2] {
        [format!("rq{}Request", self.0), format!("rr{}Reply", self.0)]
    }

    /// From the name in DDS; `None` if it is not a topic of ROS 2.
    pub(crate) fn from_dds(name: &str) -> Option<Self> {
        name.strip_prefix("rt").filter(|name| name.starts_with('/')).map(|name| Self(name.to_owned()))
    }
}

/// The name of a type in DDS.
pub(crate) fn type_in_dds(name: &str) -> String {
    match name.rsplit_once('/') {
        Some((package, name)) => format!("{}::dds_::{name}_", package.replace('/', "::")),
        None => name.to_owned(),
    }
}

/// From the name of a type in DDS.
pub(crate) fn type_from_dds(name: &str) -> String {
    name.replace("::dds_::", "::").replace("::", "/").trim_end_matches('_').to_owned()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    #[test]
    fn topics_and_types_have_other_names_in_dds() {
        let name: TopicName = "camera/image_raw".parse().unwrap();
        assert_eq!((name.as_str(), name.in_dds().as_str()), ("/camera/image_raw", "rt/camera/image_raw"));
        assert_eq!(name.service_in_dds(), ["rq/camera/image_rawRequest", "rr/camera/image_rawReply"]);
        assert_eq!(TopicName::from_dds("rt/camera/image_raw"), Some(name));
        assert_eq!(TopicName::from_dds("rr/service"), None);
        assert_eq!(type_in_dds("sensor_msgs/msg/Image"), "sensor_msgs::msg::dds_::Image_");
        assert_eq!(type_from_dds("sensor_msgs::msg::dds_::Image_"), "sensor_msgs/msg/Image");
    }

    #[test]
    fn names_that_ros_refuses_are_refused() {
        for text in ["", "/", "/a//b", "/a/", "a b", "/1a", "/a-b", "/ä", "~/a"] {
            assert!(text.parse::<TopicName>().is_err(), "{text}");
        }
    }
}
