//! The record of a sensor beside the camera, from a topic.

use super::frames::OrderedMessages;
use super::messages::{Role, sensor};
use super::recording::Topic;
use super::topics::is_named;
use odograph::error::{Error, Result};
use odograph::filter::fusion::{SensorKind, SensorRecord};
use odograph::georeference::GnssFix;
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
/// Times are those in the messages, as those of the frames, and in order as those. A message
/// without a measurement is left out. The record is `None` if it has fewer than two measurements;
/// the warnings, one sentence each, say so, and what is wrong with the times and the recording.
///
/// # Errors
/// If the path is not a robot recording or cannot be read, or the topic is missing or of another
/// type.
pub fn recorded_sensor(
    path: impl AsRef<Path>,
    topic: &str,
    kind: SensorKind,
) -> Result<(Option<SensorRecord>, Vec<String>)> {
    let path = path.as_ref();
    let read = read(path, topic, kind).map_err(|error| error.at(path.display()))?;
    Ok((read.0, at_path(path, read.1)))
}

pub(super) fn at_path(path: &Path, warnings: Vec<String>) -> Vec<String> {
    warnings.into_iter().map(|warning| format!("{}: {warning}", path.display())).collect()
}

/// Reads the positions of a satellite receiver from a topic of a robot recording:
/// `sensor_msgs/NavSatFix`. Times are taken as by [`recorded_sensor`]. A message without a position
/// is left out; one without a covariance has the usual one. Warnings as there.
///
/// # Errors
/// As [`recorded_sensor`].
pub fn recorded_fixes(path: impl AsRef<Path>, topic: &str) -> Result<(Vec<GnssFix>, Vec<String>)> {
    let path = path.as_ref();
    let mut fixes = Vec::new();
    let read = each(
        path,
        topic,
        "satellite receiver",
        (&|topic| Role::of(topic) == Role::Gnss, "sensor_msgs/NavSatFix"),
        |topic, time_s, data| {
            let Some((place, altitude_m, covariance_m2)) = sensor::position(topic, data) else {
                return;
            };
            fixes.push(GnssFix { time_s, place, altitude_m, covariance_m2 });
        },
    );
    let mut warnings = read.map_err(|error| error.at(path.display()))?;
    if fixes.is_empty() {
        warnings.push(format!("the topic {topic} has no position and is not used"));
    }
    Ok((fixes, at_path(path, warnings)))
}

fn read(path: &Path, name: &str, kind: SensorKind) -> Result<(Option<SensorRecord>, Vec<String>)> {
    let (role, type_name) = type_of(kind);
    let fits = |topic: &Topic| Role::of(topic) == role && role != Role::Other;
    let mut times_s: Vec<f64> = Vec::new();
    let mut channels: Vec<Vec<f64>> = Vec::new();
    let mut warnings = each(path, name, &kind.to_string(), (&fits, type_name), |topic, time_s, data| {
        let Some(values) = sensor::values(topic, data) else { return };
        times_s.push(time_s);
        channels.resize(values.len(), Vec::new());
        for (channel, value) in channels.iter_mut().zip(values) {
            channel.push(value);
        }
    })?;
    let quantity =
        sensor::quantity(role).ok_or_else(|| Error::usage(format!("a {kind} is not read from a topic")))?;
    if times_s.len() < 2 {
        let count = times_s.len();
        warnings
            .push(format!("the topic {name} has {count} measurements and is not used; two are the least"));
        return Ok((None, warnings));
    }
    let record = SensorRecord::new(quantity, times_s, channels).map_err(|error| error.at(name))?;
    Ok((Some(record), warnings))
}

/// Visits the messages of a sensor's topic in the order of their times, and returns the warnings.
pub(super) fn each(
    path: &Path,
    name: &str,
    sensor: &str,
    (fits, type_name): (&dyn Fn(&Topic) -> bool, &str),
    mut take: impl FnMut(&Topic, f64, &[u8]),
) -> Result<Vec<String>> {
    let not_one = || {
        Error::usage(format!(
            "only robot recordings (MCAP, ROS bags) have topics, and this is none; leave {name} away"
        ))
    };
    let recording = super::open(path)?.ok_or_else(not_one)?;
    let fits = |topic: &&Topic| fits(topic);
    let Some(topic) = recording.topics().iter().filter(fits).find(|topic| is_named(topic, name)).cloned()
    else {
        let others: Vec<&str> =
            recording.topics().iter().filter(fits).map(|topic| topic.name.as_str()).collect();
        let others = match others.as_slice() {
            [] => "the recording has no topic of this type".to_owned(),
            _ => format!("topics of this type are: {}", others.join(", ")),
        };
        return Err(Error::usage(format!(
            "there is no topic {name} of the type {type_name} for a {sensor}; {others}"
        )));
    };
    let mut messages = OrderedMessages::new(recording, topic)?;
    while let Some(time_s) = messages.advance()? {
        take(messages.topic(), time_s, messages.data());
    }
    Ok(messages.take_warnings("messages"))
}
