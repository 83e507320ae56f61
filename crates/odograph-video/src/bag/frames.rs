//! The frames of a topic: images one by one, or the packets of a video for a decoder.

use super::messages::{Role, VideoMessage, image, seconds, stamp_ns};
use super::recording::{MessageReader, Topic};
use super::topics;
use crate::container::{Packet, PacketReader, Times, VideoTrack};
use crate::frame::Picture;
use crate::opened::{Frames, Opened};
use crate::source_options::SourceOptions;
use crate::video;
use odograph::error::{Error, Result};

/// Opens the topic with images that the options name, or the only one.
pub(crate) fn open_frames(mut recording: Box<dyn MessageReader>, options: &SourceOptions) -> Result<Opened> {
    let topic = topics::with_frames(recording.as_mut(), options.topic.as_deref())?;
    let place = format!("{}, {}", topic.name, recording.format());
    let frame_count = Some(topic.count);
    let messages = TopicMessages::new(recording, topic)?;
    match Role::of(&messages.topic) {
        Role::Video(kind) => {
            let reader = VideoTopic::new(messages, kind)?;
            let opened = video::open(None, Box::new(reader), options.color)?;
            Ok(Opened { description: format!("{} ({place})", opened.description), frame_count, ..opened })
        }
        _ => Ok(Opened {
            description: format!("images ({place})"),
            frame_count,
            frames_within: None,
            times_known: true,
            timestamps_used: false,
            frames_per_second: None,
            frames: Box::new(ImageTopic { messages, color: options.color, damaged: 0, first_damage: None }),
        }),
    }
}

/// The messages of one topic with their times.
pub(super) struct TopicMessages {
    recording: Box<dyn MessageReader>,
    pub topic: Topic,
    /// Times are those of recording, because the messages have none.
    by_log: Option<bool>,
    warnings: Vec<String>,
}

impl TopicMessages {
    pub fn new(mut recording: Box<dyn MessageReader>, topic: Topic) -> Result<Self> {
        recording.select(&|other| other.is(&topic));
        recording.rewind()?;
        Ok(Self { recording, topic, by_log: None, warnings: Vec::new() })
    }

    /// Advances to the next message and returns its time, seconds; not a number if it has none.
    pub fn advance(&mut self) -> Result<Option<f64>> {
        if !self.recording.advance()? {
            return Ok(None);
        }
        let message = self.recording.message();
        let stamp_ns = stamp_ns(&self.topic, message.data);
        // The first message decides for all of them: the two clocks may differ.
        let by_log = *self.by_log.get_or_insert_with(|| {
            if stamp_ns.is_none() {
                self.warnings.push(format!(
                    "the messages on {} have no time stamp; the times at which they were recorded are used",
                    self.topic.name
                ));
            }
            stamp_ns.is_none()
        });
        let time_ns = if by_log { i64::try_from(message.log_ns).ok() } else { stamp_ns };
        // A message without a time is left out by the source.
        Ok(Some(time_ns.map_or(f64::NAN, seconds)))
    }

    pub fn data(&self) -> &[u8] {
        self.recording.message().data
    }

    fn take_warnings(&mut self) -> Vec<String> {
        let mut warnings = std::mem::take(&mut self.warnings);
        warnings.append(&mut self.recording.take_warnings());
        warnings
    }
}

/// A topic of images.
struct ImageTopic {
    messages: TopicMessages,
    color: bool,
    damaged: u64,
    first_damage: Option<String>,
}

impl Frames for ImageTopic {
    fn advance(&mut self) -> Result<Option<f64>> {
        self.messages.advance()
    }

    fn picture(&mut self) -> Result<Option<Picture>> {
        match image::picture(&self.messages.topic, self.messages.data(), self.color) {
            Ok(picture) => Ok(Some(picture)),
            Err(error) => {
                self.damaged += 1;
                self.first_damage.get_or_insert(error.to_string());
                Ok(None)
            }
        }
    }

    fn take_warnings(&mut self) -> Vec<String> {
        let mut warnings = self.messages.take_warnings();
        if let Some(why) = self.first_damage.take() {
            let damaged = std::mem::take(&mut self.damaged);
            warnings.push(format!("{damaged} images were left out because they cannot be decoded ({why})"));
        }
        warnings
    }
}

/// A topic of the packets of a video, as a track for the decoders.
struct VideoTopic {
    messages: TopicMessages,
    kind: VideoMessage,
    track: VideoTrack,
    damaged: u64,
}

impl VideoTopic {
    fn new(mut messages: TopicMessages, kind: VideoMessage) -> Result<Self> {
        if messages.advance()?.is_none() {
            return Err(Error::input("there is no video packet in it"));
        }
        let format = image::video_packet(&messages.topic, kind, messages.data())?.format.into_owned();
        // Stamps are those of the images, or in decoding order; sorted, both are right.
        let track = VideoTrack::new("a robot recording", image::codec(&format), Times::Decoding);
        let track = VideoTrack { frame_count: Some(messages.topic.count), ..track };
        messages.recording.rewind()?;
        Ok(Self { messages, kind, track, damaged: 0 })
    }
}

impl PacketReader for VideoTopic {
    fn track(&self) -> &VideoTrack {
        &self.track
    }

    fn next_packet(&mut self, packet: &mut Packet) -> Result<bool> {
        while let Some(time_s) = self.messages.advance()? {
            match image::video_packet(&self.messages.topic, self.kind, self.messages.data()) {
                Ok(message) => {
                    packet.data.clear();
                    packet.data.extend_from_slice(message.data);
                    packet.time_s = time_s;
                    packet.shown = true;
                    return Ok(true);
                }
                Err(_) => self.damaged += 1,
            }
        }
        Ok(false)
    }

    fn rewind(&mut self) -> Result<()> {
        self.messages.recording.rewind()
    }

    fn take_warnings(&mut self) -> Vec<String> {
        let mut warnings = self.messages.take_warnings();
        if std::mem::take(&mut self.damaged) > 0 {
            warnings.push("some video packets are damaged and were left out".to_owned());
        }
        warnings
    }
}
