//! Writes a run as an MCAP file with JSON messages of Foxglove's types: poses with their
//! covariance, the camera image with its tracks, and the trajectory.
//!
//! Each second of the recording is flushed as one complete chunk, so that the file of a killed
//! process is readable up to its last second (MCAP specification, "Chunk"; `mcap recover` adds the
//! missing index).

mod messages;
mod schemas;
mod sketch;

use crate::stream::json_line;
use crate::view::encode;
use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{McapError, WriteOptions, Writer};
use messages::{CAMERA, WORLD};
use odograph::error::{Error, Result};
use odograph::image::GrayImage;
use odograph::odometry::TrackView;
use odograph::pose_frame::PoseFrame;
use odograph::trajectory::{FrameEstimate, TrackStatus};
use schemas::Schema;
use serde_json::Value;
use sketch::PathSketch;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

/// Duration of a chunk, and interval between two updates of the trajectory, nanoseconds.
const SECOND: u64 = 1_000_000_000;
/// Maximum size of a chunk, bytes: larger compresses better, but is what is lost if the process is
/// killed.
const LARGEST_CHUNK: u64 = 8 << 20;

/// The image of a frame with its tracks.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackedImage {
    /// The camera image.
    pub gray: GrayImage,
    /// The tracks in it.
    pub tracks: Vec<TrackView>,
}

/// An MCAP file while it is being written.
pub struct McapFile {
    path: PathBuf,
    writer: Writer<NoSeek<BufWriter<File>>>,
    channels: Channels,
    sketch: PathSketch,
    status: Option<TrackStatus>,
    chunk_began: Option<u64>,
    drawn: Option<u64>,
    newest: u64,
    frames: u32,
}

/// Channel ids of the topics in the file.
struct Channels {
    transform: u16,
    pose: u16,
    picture: u16,
    tracks: u16,
    path: u16,
    uncertainty: u16,
    frame: u16,
    log: u16,
}

impl McapFile {
    /// Creates a file, and writes the description of the source as metadata.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn create(path: &Path, source: &str) -> Result<Self> {
        let file = File::create(path).map_err(|error| cannot_be_written(path, error.into()))?;
        let options = WriteOptions::new()
            .disable_seeking(true)
            .chunk_size(Some(LARGEST_CHUNK))
            .library(concat!("odograph ", env!("CARGO_PKG_VERSION")));
        let began = || -> mcap::McapResult<_> {
            let mut writer = Writer::with_options(NoSeek::new(BufWriter::new(file)), options)?;
            let channels = Channels::new(&mut writer)?;
            let metadata = BTreeMap::from([("source".to_owned(), source.to_owned())]);
            writer.write_metadata(&mcap::records::Metadata { name: "odograph".to_owned(), metadata })?;
            Ok((writer, channels))
        };
        let (writer, channels) = began().map_err(|error| cannot_be_written(path, error))?;
        Ok(Self {
            path: path.to_owned(),
            writer,
            channels,
            sketch: PathSketch::default(),
            status: None,
            chunk_began: None,
            drawn: None,
            newest: 0,
            frames: 0,
        })
    }

    /// Appends a frame of the path of `of`, with its image if it is to be stored. Time stamps are
    /// those of the source; MCAP has no negative times, so they are clamped at 0.
    ///
    /// # Errors
    /// If the file cannot be written. It is unusable from then on.
    pub fn add(
        &mut self,
        frame: &FrameEstimate,
        of: &PoseFrame,
        latency_ms: f64,
        picture: Option<&TrackedImage>,
    ) -> Result<()> {
        let at = (frame.time_s * 1e9).round() as u64;
        if at.saturating_sub(*self.chunk_began.get_or_insert(at)) >= SECOND {
            self.chunk_began = Some(at);
            self.writer.flush().map_err(|error| cannot_be_written(&self.path, error))?;
        }
        let channels = &self.channels;
        let mut messages = vec![(channels.frame, json_line(frame, Some(latency_ms)))];
        let mut write = |channel: u16, message: Value| messages.push((channel, message.to_string()));
        if self.status.replace(frame.status) != Some(frame.status) {
            let lost = frame.status != TrackStatus::Tracked;
            write(channels.log, messages::log(at, lost, &frame.status.to_string()));
            if lost {
                write(channels.uncertainty, messages::cleared(at));
            }
        }
        if let Some(known) = &frame.estimate {
            let placed = of.world_from_frame(&known.pose);
            write(channels.transform, messages::frame_transform(at, WORLD, of.name(), &placed));
            if let PoseFrame::BaseLink(base) = of {
                let on_robot = base.base_from_camera();
                write(channels.transform, messages::frame_transform(at, of.name(), CAMERA, on_robot));
            }
            write(channels.pose, messages::pose_in_frame(at, &placed));
            write(channels.uncertainty, messages::ellipse(at, known));
            self.sketch.add(frame.segment, [known.pose.x_m, known.pose.y_m]);
        }
        if self.drawn.is_none_or(|drawn| at.saturating_sub(drawn) >= SECOND) {
            self.drawn = Some(at);
            write(channels.path, messages::path(at, &self.sketch.stretches()));
        }
        if let Some(TrackedImage { gray, tracks }) = picture
            && let Some((jpeg, scale)) = encode(gray)
        {
            write(channels.picture, messages::compressed_image(at, &jpeg));
            write(channels.tracks, messages::image_annotations(at, tracks, scale));
        }
        self.frames = self.frames.saturating_add(1);
        self.newest = self.newest.max(at);
        messages.into_iter().try_for_each(|(channel, text)| self.write(at, channel, &text))
    }

    fn write(&mut self, at: u64, channel_id: u16, text: &str) -> Result<()> {
        let header = MessageHeader { channel_id, sequence: self.frames, log_time: at, publish_time: at };
        self.writer
            .write_to_known_channel(&header, text.as_bytes())
            .map_err(|error| cannot_be_written(&self.path, error))
    }

    /// Number of frames written.
    pub fn frames(&self) -> u32 {
        self.frames
    }

    /// Completes the file with the whole trajectory and an index.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn finish(mut self) -> Result<()> {
        if self.frames > 0 {
            let path = messages::path(self.newest, &self.sketch.stretches());
            self.write(self.newest, self.channels.path, &path.to_string())?;
        }
        self.writer.finish().map_err(|error| cannot_be_written(&self.path, error))?;
        Ok(())
    }
}

fn cannot_be_written(path: &Path, error: McapError) -> Error {
    match error {
        // Its own message does not say what the system's is.
        McapError::Io(error) => Error::not_written(path.display(), error),
        error => Error::output(format!("{} cannot be written: {error}", path.display())).caused_by(error),
    }
}

impl Channels {
    fn new(writer: &mut Writer<NoSeek<BufWriter<File>>>) -> mcap::McapResult<Self> {
        let mut channel = |topic: &str, schema: Schema| {
            let schema = writer.add_schema(schema.name, "jsonschema", schema.json.to_string().as_bytes())?;
            writer.add_channel(schema, topic, "json", &BTreeMap::new())
        };
        Ok(Self {
            transform: channel("/tf", schemas::frame_transform())?,
            pose: channel("/pose", schemas::pose_in_frame())?,
            picture: channel("/camera", schemas::compressed_image())?,
            tracks: channel("/camera/tracks", schemas::image_annotations())?,
            path: channel("/path", schemas::scene_update())?,
            uncertainty: channel("/uncertainty", schemas::scene_update())?,
            frame: channel("/frame", schemas::frame())?,
            log: channel("/log", schemas::log())?,
        })
    }
}

#[cfg(test)]
mod tests;
