//! What a robot recording holds.

use super::camera::camera_of;
use super::messages::{Role, seconds, stamp_ns};
use super::recording::{MessageReader, Topic};
use super::topics::{FirstImage, first_images};
use crate::contents::{Contents, Stream, StreamUse};
use crate::limits;
use odograph::error::Result;

/// Lists the topics of a recording. Reads it once from begin to end, for the times of all messages.
pub(crate) fn contents(mut recording: Box<dyn MessageReader>) -> Result<Contents> {
    let recording = recording.as_mut();
    let topics: Vec<Topic> = recording.topics().to_vec();
    let roles: Vec<Role> = topics.iter().map(Role::of).collect();
    recording.select(&|_| true);
    recording.rewind()?;
    let mut times: Vec<Vec<f64>> = vec![Vec::new(); topics.len()];
    let mut counts = vec![0u64; topics.len()];
    while recording.advance()? {
        let message = recording.message();
        let (Some(topic), Some(times)) = (topics.get(message.topic), times.get_mut(message.topic)) else {
            continue;
        };
        counts[message.topic] += 1;
        let time_ns = stamp_ns(topic, message.data).or_else(|| i64::try_from(message.log_ns).ok());
        if let Some(time_ns) = time_ns.filter(|_| times.len() < limits::MAX_SAMPLES) {
            times.push(seconds(time_ns));
        }
    }
    let mut warnings = recording.take_warnings();
    let images: Vec<Topic> = topics
        .iter()
        .zip(&roles)
        .filter(|(_, role)| role.has_frames())
        .map(|(topic, _)| topic.clone())
        .collect();
    let firsts = first_images(recording, &images)?;
    let mut streams = Vec::new();
    for (index, (topic, role)) in topics.iter().zip(&roles).enumerate() {
        let first = images.iter().position(|image| image == topic).and_then(|at| firsts[at].clone());
        let FirstImage { size, encoding, is_picture } =
            first.unwrap_or(FirstImage { size: None, encoding: String::new(), is_picture: true });
        let usable_as = match role {
            _ if role.has_frames() && !is_picture => StreamUse::OtherImages,
            _ if role.has_frames() => {
                StreamUse::Frames(camera_of(recording, topic).unwrap_or_else(|error| {
                    warnings.push(format!("{} has no camera that can be used: {error}", topic.name));
                    None
                }))
            }
            Role::CameraInfo => StreamUse::CameraInfo,
            Role::Gyro => StreamUse::Gyro,
            Role::Wheel => StreamUse::Wheel,
            Role::Range => StreamUse::Range,
            Role::Gnss => StreamUse::Gnss,
            Role::Pose => StreamUse::Path,
            _ => StreamUse::Nothing,
        };
        let stream = Stream {
            topic: Some(topic.name.clone()),
            kind: topic.type_name.clone(),
            encoding,
            size,
            count: counts[index],
            span_s: None,
            rate_hz: None,
            gaps: Vec::new(),
            usable_as,
        };
        streams.push(stream.timed(std::mem::take(&mut times[index])));
    }
    streams.sort_by(|a, b| a.topic.cmp(&b.topic));
    Ok(Contents { format: recording.format(), streams, warnings })
}
