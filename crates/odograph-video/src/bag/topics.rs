//! Which topic a run follows, and which one a sensor is.

use super::cursor::Serialization;
use super::messages::{Role, image};
use super::recording::{MessageReader, Topic};
use odograph::error::{Error, Result};
use std::path::Path;

/// Whether a topic is meant by a name: as it is, or without its leading slash.
pub(super) fn is_named(topic: &Topic, name: &str) -> bool {
    topic.name == name || topic.name.strip_prefix('/') == Some(name)
}

/// The topic that frames are taken from: the named one, or the only one with images.
///
/// Fails with a list of the topics with images if there are several, or the named one is not among
/// them.
pub(super) fn with_frames(recording: &mut dyn MessageReader, name: Option<&str>) -> Result<Topic> {
    let has_frames = |topic: &Topic| Role::of(topic).has_frames() && topic.count > 0;
    let all: Vec<Topic> = recording.topics().iter().filter(|topic| has_frames(topic)).cloned().collect();
    if let Some(name) = name {
        if let Some(topic) = all.iter().find(|topic| is_named(topic, name)) {
            return Ok(topic.clone());
        }
        let others: Vec<String> = recording
            .topics()
            .iter()
            .filter(|topic| is_named(topic, name))
            .map(|topic| {
                format!(
                    "; {} has {} messages of the type {}{}",
                    topic.name,
                    topic.count,
                    topic.type_name,
                    if is_unread_foxglove(topic) { UNREAD_FOXGLOVE } else { "" }
                )
            })
            .collect();
        let refused = |rest: &str| {
            Error::usage(format!("there are no images on the topic {name}{}; {rest}", others.concat()))
        };
        return Err(match all.len() {
            0 => refused("no topic has images"),
            _ => refused("the topics with images are:").with_list(list(recording, &all)?),
        });
    }
    match all.as_slice() {
        [] if recording.topics().is_empty() => Err(Error::input(format!(
            "this is {} without messages: it is empty, or cut off before the first one",
            recording.format()
        ))),
        [] => {
            let is_unread = recording.topics().iter().any(is_unread_foxglove);
            let hint = if is_unread { UNREAD_FOXGLOVE } else { "" };
            let others = others(recording.topics());
            Err(Error::input(format!("there are no images that can be read in it, only {others}{hint}")))
        }
        [only] => Ok(only.clone()),
        _ => {
            let pictures = with_pictures(recording, &all)?;
            let listed = if pictures.is_empty() { &all } else { &pictures };
            match listed.as_slice() {
                [only] => Ok(only.clone()),
                _ => Err(Error::usage(format!(
                    "there are {} topics with images; choose one with --topic NAME:",
                    listed.len()
                ))
                .with_list(list(recording, listed)?)),
            }
        }
    }
}

/// Opens the robot recording at a path with the topic that [`with_frames`] gives.
pub(super) fn open_with_frames(path: &Path, name: Option<&str>) -> Result<(Box<dyn MessageReader>, Topic)> {
    let not_one = || Error::input("this is not a robot recording");
    let mut recording = super::open(path)?.ok_or_else(not_one)?;
    let topic = with_frames(recording.as_mut(), name)?;
    Ok((recording, topic))
}

/// What is said of the images of Foxglove that cannot be read.
const UNREAD_FOXGLOVE: &str = "; Foxglove's images are read in Protocol Buffers, and not in JSON, as odograph live --mcap writes \
                               them: give the recording that they were made of";

/// Whether a topic has images of Foxglove in JSON; only those in Protocol Buffers are read.
fn is_unread_foxglove(topic: &Topic) -> bool {
    let is_image = ["foxglove.CompressedImage", "foxglove.RawImage", "foxglove.CompressedVideo"]
        .contains(&topic.type_name.as_str());
    is_image && topic.serialization == Serialization::Other("json".to_owned())
}

/// Those of the topics whose images show light: a depth camera has others beside them.
fn with_pictures(recording: &mut dyn MessageReader, topics: &[Topic]) -> Result<Vec<Topic>> {
    let firsts = first_images(recording, topics)?;
    let is_picture = |first: &Option<FirstImage>| first.as_ref().is_none_or(|first| first.is_picture);
    let shown = topics.iter().zip(&firsts).filter(|(_, first)| is_picture(first));
    Ok(shown.map(|(topic, _)| topic.clone()).collect())
}

/// The topics without images, for people.
fn others(topics: &[Topic]) -> String {
    const MOST: usize = 8;
    let mut names: Vec<String> =
        topics.iter().map(|topic| format!("{} ({})", topic.name, topic.type_name)).collect();
    if names.len() > MOST {
        let more = names.len() - MOST;
        names.truncate(MOST);
        names.push(format!("and {more} more"));
    }
    names.join(", ")
}

/// Topics with images as a list for people, a line each: name, type, size, rate and number.
fn list(recording: &mut dyn MessageReader, topics: &[Topic]) -> Result<Vec<String>> {
    let firsts = first_images(recording, topics)?;
    let row = |(topic, first): (&Topic, &Option<FirstImage>)| {
        let image = match first {
            Some(FirstImage { size: Some((width, height)), encoding, .. }) => {
                format!("{width}x{height} {encoding}")
            }
            Some(FirstImage { encoding, .. }) => encoding.clone(),
            None => String::new(),
        };
        // A single image has no rate.
        let rate = if topic.count > 1 { format!("{:.1} Hz", topic.rate_hz()) } else { String::new() };
        let unit = if topic.count == 1 { "image" } else { "images" };
        [topic.name.clone(), image, rate, format!("{} {unit}", topic.count), topic.plain_type()]
    };
    let rows: Vec<[String; 5]> = topics.iter().zip(&firsts).map(row).collect();
    let mut widths = [0; 5];
    for row in &rows {
        for (width, cell) in widths.iter_mut().zip(row) {
            *width = cell.chars().count().max(*width);
        }
    }
    let line = |row: &[String; 5]| {
        let cells: Vec<String> =
            row.iter().zip(widths).map(|(cell, width)| format!("{cell:width$}")).collect();
        cells.join("  ").trim_end().to_owned()
    };
    Ok(rows.iter().map(line).collect())
}

/// The first image of a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct FirstImage {
    /// Width and height, pixels; `None` for a video, or an image that cannot be decoded.
    pub size: Option<(usize, usize)>,
    pub encoding: String,
    /// Whether images of this encoding show light: depth images and unknown encodings do not.
    pub is_picture: bool,
}

/// The first image of each of the topics, and rewinds the recording.
pub(super) fn first_images(
    recording: &mut dyn MessageReader,
    topics: &[Topic],
) -> Result<Vec<Option<FirstImage>>> {
    let mut firsts = vec![None; topics.len()];
    let place = |topic: &Topic| topics.iter().position(|other| other.is(topic));
    recording.rewind()?;
    recording.select(&|topic| place(topic).is_some());
    while firsts.iter().any(Option::is_none) && recording.advance()? {
        let message = recording.message();
        let topic = &recording.topics()[message.topic];
        if let Some(index) = place(topic)
            && firsts[index].is_none()
        {
            let size = match Role::of(topic) {
                Role::Image => image::raw_image(topic, message.data).ok().map(|raw| (raw.width, raw.height)),
                Role::CompressedImage => image::picture(topic, message.data, 16, false)
                    .ok()
                    .map(|picture| (picture.gray.width(), picture.gray.height())),
                _ => None,
            };
            let is_picture = image::is_picture(topic, message.data);
            let encoding = image::encoding(topic, message.data);
            firsts[index] = Some(FirstImage { size, encoding, is_picture });
        }
    }
    recording.rewind()?;
    Ok(firsts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn foxglove_images_in_json_are_not_read() {
        let topic = |type_name: &str, serialization: &str| Topic {
            name: "/camera".to_owned(),
            type_name: type_name.to_owned(),
            serialization: Serialization::named(serialization),
            count: 5,
            span_ns: (0, 1),
        };
        assert!(is_unread_foxglove(&topic("foxglove.CompressedImage", "json")));
        assert!(!is_unread_foxglove(&topic("foxglove.CompressedImage", "protobuf")));
        assert!(!is_unread_foxglove(&topic("foxglove.Log", "json")));
    }
}
