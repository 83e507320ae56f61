//! The camera of an image topic, from the recording's camera_info.

use super::messages::camera_info::CameraInfo;
use super::messages::{Role, frame_id};
use super::recording::{MessageReader, Topic};
use super::topics;
use crate::recorded_camera::RecordedCamera;
use odograph::error::Result;
use std::path::Path;

/// The camera of the images that a run follows in a robot recording: those of `topic`, or of the
/// only topic with images. `None` if the recording does not describe it.
///
/// Its `camera_info` is that in the namespace of the images, or the only one with the same frame of
/// reference. Topics with `rect` in the last part of their name are rectified.
///
/// # Errors
/// If the path is not a robot recording or cannot be read, the topic is not one with images, or the
/// camera is not calibrated or of an unknown lens model.
pub fn recorded_camera(path: impl AsRef<Path>, topic: Option<&str>) -> Result<Option<RecordedCamera>> {
    let path = path.as_ref();
    topics::open_with_frames(path, topic)
        .and_then(|(mut recording, images)| camera_of(recording.as_mut(), &images))
        .map_err(|error| error.at(path.display()))
}

/// The camera of a topic with images, and rewinds the recording.
pub(super) fn camera_of(recording: &mut dyn MessageReader, images: &Topic) -> Result<Option<RecordedCamera>> {
    let all: Vec<Topic> =
        recording.topics().iter().filter(|topic| Role::of(topic) == Role::CameraInfo).cloned().collect();
    if all.is_empty() {
        return Ok(None);
    }
    let rectified = is_rectified(&images.name);
    let (infos, frame) = first_infos(recording, images, &all)?;
    let beside = names_beside(&images.name);
    let named = beside.iter().find_map(|name| all.iter().position(|topic| topic.name == *name));
    let index = named.filter(|&index| infos[index].is_some()).or_else(|| {
        let same_frame = |index: &usize| {
            infos[*index].as_ref().is_some_and(|(_, other)| *other == frame && !frame.is_empty())
        };
        let mut same = (0..all.len()).filter(same_frame);
        same.next().filter(|_| same.next().is_none())
    });
    let Some(index) = index else { return Ok(None) };
    let Some((info, _)) = &infos[index] else { return Ok(None) };
    let camera = info.camera(rectified).map_err(|error| error.at(&all[index].name))?;
    Ok(Some(RecordedCamera { camera, topic: all[index].name.clone(), rectified }))
}

/// A camera with its frame of reference.
type Described = (CameraInfo, String);

/// The first calibrated camera_info of each topic with its frame of reference, and the frame of
/// reference of the first image.
fn first_infos(
    recording: &mut dyn MessageReader,
    images: &Topic,
    all: &[Topic],
) -> Result<(Vec<Option<Described>>, String)> {
    /// A camera that is calibrated while recording would be seen after more messages than this.
    const MAX_MESSAGES: usize = 1000;
    let mut infos = vec![None; all.len()];
    let mut frame = None;
    recording.rewind()?;
    recording.select(&|topic| topic.is(images) || all.iter().any(|other| topic.is(other)));
    for _ in 0..MAX_MESSAGES {
        if (frame.is_some() && infos.iter().all(Option::is_some)) || !recording.advance()? {
            break;
        }
        let message = recording.message();
        let topic = &recording.topics()[message.topic];
        if topic.is(images) {
            frame.get_or_insert_with(|| frame_id(topic, message.data));
        } else if let Some(index) = all.iter().position(|other| topic.is(other))
            && infos[index].as_ref().is_none_or(|(info, _): &Described| !info.is_calibrated())
            && let Some(info) = CameraInfo::read(topic, message.data)
        {
            infos[index] = Some((info, frame_id(topic, message.data)));
        }
    }
    recording.rewind()?;
    Ok((infos, frame.unwrap_or_default()))
}

/// Names of the transports that are appended to the name of an image topic.
const TRANSPORTS: [&str; 4] = ["compressed", "ffmpeg", "theora", "h264"];

/// The name of an image topic without its transport.
fn base(name: &str) -> &str {
    match name.rsplit_once('/') {
        Some((base, transport)) if TRANSPORTS.contains(&transport) => base,
        _ => name,
    }
}

/// Whether the images of a topic are rectified, as image_proc names them: `image_rect`,
/// `image_rect_color`.
pub(super) fn is_rectified(name: &str) -> bool {
    base(name)
        .rsplit('/')
        .next()
        .is_some_and(|last| last.split('_').any(|word| word == "rect" || word == "rectified"))
}

/// Names of the camera_info topics that belong to an image topic, the most likely first.
pub(super) fn names_beside(name: &str) -> [String; 3] {
    let base = base(name);
    let (namespace, _) = base.rsplit_once('/').unwrap_or(("", base));
    [format!("{namespace}/camera_info"), format!("{base}/camera_info"), format!("{base}_info")]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_camera_info_of_an_image_topic_by_name() {
        assert_eq!(names_beside("/front/image_raw/compressed")[0], "/front/camera_info");
        assert_eq!(names_beside("/image")[0], "/camera_info");
        assert!(is_rectified("/front/image_rect_color/compressed") && is_rectified("/image_rect"));
        assert!(!is_rectified("/rect/image_raw") && !is_rectified("/camera/direct"));
    }
}
