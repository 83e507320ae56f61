//! Robot recordings: MCAP files, ROS 1 bags, and rosbag2 folders and databases.
//!
//! A recording is read sequentially ([`recording::MessageReader`]); its image topic becomes a
//! source of frames, its other topics the camera and the sensors beside it. Formats are detected by
//! the first bytes: a bag of JPEG images looks like a Motion JPEG stream, with the images of all
//! its cameras interleaved and without times.

mod camera;
mod chunks;
mod compression;
mod contents;
mod cursor;
mod database;
mod files;
mod folder;
mod frames;
mod live_topic;
mod mcap;
mod messages;
mod mount;
mod path;
mod recording;
mod rosbag1;
mod sensors;
mod topics;

pub use camera::recorded_camera;
pub(crate) use contents::contents;
pub use cursor::MessageCursor;
use files::{BagFormat, Files};
pub(crate) use frames::open_frames;
pub use live_topic::{LiveMessage, LiveTopic, LiveTransforms};
pub use mount::{RecordedMount, RecordedTransforms, recorded_antenna, recorded_mount};
use odograph::error::Result;
pub use path::recorded_path;
use recording::MessageReader;
pub use sensors::{recorded_fixes, recorded_sensor};
use std::path::Path;

/// Opens a recording; `None` if the file or folder is not one.
///
/// Fails if it is one and cannot be read. An SQLite database that is not a recording fails as well:
/// nothing else reads one.
pub(crate) fn open(path: &Path) -> Result<Option<Box<dyn MessageReader>>> {
    let (files, warnings) = if path.is_dir() {
        match folder::files(path)? {
            Some(found) => found,
            None => return Ok(None),
        }
    } else if is_recording_file(path)? {
        (vec![path.to_owned()], Vec::new())
    } else {
        return Ok(None);
    };
    Ok(Some(Box::new(Files::open(files, warnings)?)))
}

fn is_recording_file(path: &Path) -> Result<bool> {
    if !path.is_file() {
        return Ok(false);
    }
    Ok(match BagFormat::of_file(path)? {
        Some(BagFormat::Zstd) => files::is_packed_recording(path),
        format => format.is_some(),
    })
}

/// Whether a folder is one robot recording, and not a folder of several.
pub fn is_recording_folder(folder: impl AsRef<Path>) -> bool {
    matches!(folder::files(folder.as_ref()), Ok(Some(_)))
}

/// Whether a file or folder is a robot recording.
pub fn is_robot_recording(path: impl AsRef<Path>) -> bool {
    let path = path.as_ref();
    if path.is_dir() {
        return !matches!(folder::files(path), Ok(None));
    }
    is_recording_file(path).unwrap_or(false)
}
