//! The record of a sensor beside the camera, from a topic.

use super::messages::{Role, seconds, sensor, stamp_ns};
use super::topics::is_named;
use odograph::error::{Error, Result};
use odograph::filter::fusion::{SensorKind, SensorRecord};
use std::path::Path;

/// Message type of a kind of sensor.
fn type_of(kind: SensorKind) -> (Role, &'static str) {
    match kind {
        SensorKind::Gyro => (Role::Gyro, "sensor_msgs/Imu"),
        SensorKind::Wheel => (Role::Wheel, "nav_msgs/Odometry"),
        SensorKind::Range => (Role::Range, "sensor_msgs/Range"),
        SensorKind::Heading => (Role::Other, "none"),
    }
}

/// Reads the record of a sensor from a topic of a robot recording: turn rates from
/// `sensor_msgs/Imu`, speed from `nav_msgs/Odometry`, distance from `sensor_msgs/Range`.
///
/// Times are those in the messages, as those of the frames. A message whose time is not after the
/// one before, or without a measurement, is left out.
///
/// # Errors
/// If the path is not a robot recording or cannot be read, the topic is missing or of another type,
/// or it has fewer than two measurements.
pub fn recorded_sensor(path: impl AsRef<Path>, topic: &str, kind: SensorKind) -> Result<SensorRecord> {
    let path = path.as_ref();
    read(path, topic, kind).map_err(|error| error.at(path.display()))
}

fn read(path: &Path, name: &str, kind: SensorKind) -> Result<SensorRecord> {
    let not_one = || {
        Error::usage(format!(
            "only robot recordings (MCAP, ROS bags) have topics, and this is none; leave {name} away"
        ))
    };
    let mut recording = super::open(path)?.ok_or_else(not_one)?;
    let (role, type_name) = type_of(kind);
    let fits = |topic: &&super::recording::Topic| Role::of(topic) == role && role != Role::Other;
    let Some(topic) = recording.topics().iter().filter(fits).find(|topic| is_named(topic, name)).cloned()
    else {
        let others: Vec<&str> =
            recording.topics().iter().filter(fits).map(|topic| topic.name.as_str()).collect();
        let others = if others.is_empty() { "none".to_owned() } else { others.join(", ") };
        return Err(Error::usage(format!(
            "there is no topic {name} of the type {type_name} for a {kind}; of this type there are: {others}"
        )));
    };
    recording.select(&|other| other.name == topic.name && other.type_name == topic.type_name);
    let quantity =
        sensor::quantity(role).ok_or_else(|| Error::usage(format!("a {kind} is not read from a topic")))?;
    let mut times_s: Vec<f64> = Vec::new();
    let mut channels: Vec<Vec<f64>> = Vec::new();
    let mut by_log = None;
    while recording.advance()? {
        let message = recording.message();
        let stamp_ns = stamp_ns(&topic, message.data);
        let by_log = *by_log.get_or_insert(stamp_ns.is_none());
        let time_ns = if by_log { i64::try_from(message.log_ns).ok() } else { stamp_ns };
        let (Some(time_ns), Some(values)) = (time_ns, sensor::values(&topic, message.data)) else { continue };
        let time_s = seconds(time_ns);
        if times_s.last().is_some_and(|&last| time_s <= last) {
            continue;
        }
        times_s.push(time_s);
        channels.resize(values.len(), Vec::new());
        for (channel, value) in channels.iter_mut().zip(values) {
            channel.push(value);
        }
    }
    if times_s.len() < 2 {
        return Err(Error::input(format!(
            "the topic {name} has {} measurements; two are the least",
            times_s.len()
        )));
    }
    SensorRecord::new(quantity, times_s, channels).map_err(|error| error.at(name))
}
