//! The frames of a topic: images one by one, or the packets of a video for a decoder.

use super::messages::{Role, VideoMessage, image, seconds, stamp_ns};
use super::recording::{MessageReader, Topic};
use super::topics;
use crate::arrival_clock::are_bursts;
use crate::container::{Packet, PacketReader, Times, VideoTrack};
use crate::frame::Picture;
use crate::opened::{Frames, Opened};
use crate::source_options::SourceOptions;
use crate::time_order::{TimeOrder, Timed};
use crate::video;
use odograph::error::{Error, Result};

/// Opens the topic with images that the options name, or the only one.
pub(crate) fn open_frames(mut recording: Box<dyn MessageReader>, options: &SourceOptions) -> Result<Opened> {
    let topic = topics::with_frames(recording.as_mut(), options.topic.as_deref())?;
    let place = format!("{}, {}", topic.name, recording.format());
    let frame_count = Some(topic.count);
    let mut messages = TopicMessages::new(recording, topic)?;
    let (first_times_s, bits) = messages.beginning()?;
    // Other times are those of the frames as they were recorded.
    let by_time = options.timestamps.is_none() && options.fps.is_none();
    let in_bursts = are_bursts(&first_times_s);
    match Role::of(&messages.topic) {
        Role::Video(kind) => {
            let images = format!("images on {}", messages.topic.name);
            let reader = VideoTopic::new(messages, kind)?;
            let opened = video::open(None, Box::new(reader), options.color)?;
            let description = format!("{} ({place})", opened.description);
            let frames: Box<dyn Frames> = if by_time {
                let order = order(in_bursts);
                Box::new(Ordered { frames: opened.frames, order, images, current: None })
            } else {
                opened.frames
            };
            Ok(Opened { description, frame_count, frames, ..opened })
        }
        _ => Ok(Opened {
            description: format!("images ({place})"),
            frame_count,
            frames_within: None,
            times_known: true,
            timestamps_used: false,
            frames_per_second: None,
            frames: Box::new(ImageTopic {
                messages: OrderedMessages {
                    messages,
                    order: by_time.then(|| order(in_bursts)),
                    data: Vec::new(),
                },
                bits,
                color: options.color,
                damaged: 0,
                first_damage: None,
            }),
        }),
    }
}

/// Number of first messages that decide whether their stamps are used, and of first images that
/// decide whether their times come in bursts, and how many bits they have: seconds of a camera.
const FIRST: usize = 5;
const FIRST_IMAGES: usize = 100;

fn order<T>(in_bursts: bool) -> TimeOrder<T> {
    if in_bursts { TimeOrder::new().evened() } else { TimeOrder::new() }
}

/// The messages of one topic with their times, in the order in which they were recorded.
pub(super) struct TopicMessages {
    recording: Box<dyn MessageReader>,
    pub topic: Topic,
    /// Times are those of recording, because the messages have none.
    by_log: bool,
    warnings: Vec<String>,
}

impl TopicMessages {
    pub fn new(mut recording: Box<dyn MessageReader>, topic: Topic) -> Result<Self> {
        recording.select(&|other| other.is(&topic));
        recording.rewind()?;
        // One clock for all of them: the two may differ.
        let (mut count, mut stamped) = (0, 0);
        while count < FIRST && recording.advance()? {
            count += 1;
            stamped += usize::from(stamp_ns(&topic, recording.message().data).is_some());
        }
        recording.rewind()?;
        let by_log = 2 * stamped < count;
        let warning = || {
            format!(
                "the messages on {} have no time stamp; the times at which they were recorded are used",
                topic.name
            )
        };
        Ok(Self { warnings: by_log.then(warning).into_iter().collect(), recording, topic, by_log })
    }

    /// The times of the first images, seconds, and the bits that their samples of two bytes have in
    /// use, if they have such.
    fn beginning(&mut self) -> Result<(Vec<f64>, Option<u32>)> {
        let (mut times_s, mut bits) = (Vec::new(), None);
        while times_s.len() < FIRST_IMAGES
            && let Some(timed) = self.advance()?
        {
            times_s.push(timed.time_s);
            bits = bits.max(image::gray_bits(&self.topic, self.data()));
        }
        self.recording.rewind()?;
        Ok((times_s, bits))
    }

    /// Advances to the next message; its times, or `None` at the end.
    pub fn advance(&mut self) -> Result<Option<Timed<()>>> {
        if !self.recording.advance()? {
            return Ok(None);
        }
        let message = self.recording.message();
        let log_ns = i64::try_from(message.log_ns).ok();
        let time_ns = if self.by_log { log_ns } else { stamp_ns(&self.topic, message.data) };
        let time_s = time_ns.map_or(f64::NAN, seconds);
        Ok(Some(Timed { time_s, recorded_s: log_ns.map(seconds), item: () }))
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

/// The messages of one topic in the order of their times.
pub(super) struct OrderedMessages {
    messages: TopicMessages,
    /// `None` to leave them as they were recorded.
    order: Option<TimeOrder<Vec<u8>>>,
    /// The current message, if it was held back.
    data: Vec<u8>,
}

impl OrderedMessages {
    pub fn new(recording: Box<dyn MessageReader>, topic: Topic) -> Result<Self> {
        let messages = TopicMessages::new(recording, topic)?;
        Ok(Self { messages, order: Some(TimeOrder::new()), data: Vec::new() })
    }

    pub fn topic(&self) -> &Topic {
        &self.messages.topic
    }

    /// Advances to the next message and returns its time, seconds.
    pub fn advance(&mut self) -> Result<Option<f64>> {
        let Self { messages, order, data } = self;
        let Some(order) = order else { return Ok(messages.advance()?.map(|timed| timed.time_s)) };
        let next = order.next(|| -> Result<_> {
            let Some(Timed { time_s, recorded_s, .. }) = messages.advance()? else { return Ok(None) };
            Ok(Some(Timed { time_s, recorded_s, item: messages.data().to_vec() }))
        })?;
        Ok(next.map(|(time_s, message)| {
            *data = message;
            time_s
        }))
    }

    pub fn data(&self) -> &[u8] {
        if self.order.is_some() { &self.data } else { self.messages.data() }
    }

    pub fn take_warnings(&mut self, what: &str) -> Vec<String> {
        let mut warnings = self.messages.take_warnings();
        if let Some(order) = &mut self.order {
            warnings.append(&mut order.take_warnings(&format!("{what} on {}", self.messages.topic.name)));
        }
        warnings
    }
}

/// A topic of images.
struct ImageTopic {
    messages: OrderedMessages,
    /// Bits in use of samples of two bytes.
    bits: Option<u32>,
    color: bool,
    damaged: u64,
    first_damage: Option<String>,
}

impl Frames for ImageTopic {
    fn advance(&mut self) -> Result<Option<f64>> {
        self.messages.advance()
    }

    fn picture(&mut self) -> Result<Option<Picture>> {
        let (topic, data) = (self.messages.topic(), self.messages.data());
        // After a dark beginning there may be more.
        self.bits = self.bits.max(image::gray_bits(topic, data));
        match image::picture(topic, data, self.bits.unwrap_or(16), self.color) {
            Ok(picture) => Ok(Some(picture)),
            Err(error) => {
                self.damaged += 1;
                self.first_damage.get_or_insert(error.to_string());
                Ok(None)
            }
        }
    }

    fn take_warnings(&mut self) -> Vec<String> {
        let mut warnings = self.messages.take_warnings("images");
        if let Some(bits @ ..16) = self.bits {
            warnings.push(format!(
                "the images on {} have {bits} of 16 bits in use, which are taken as full scale",
                self.messages.topic().name
            ));
        }
        if let Some(why) = self.first_damage.take() {
            let damaged = std::mem::take(&mut self.damaged);
            warnings.push(format!("{damaged} images were left out because they cannot be decoded ({why})"));
        }
        warnings
    }
}

/// Frames of a video, whose packets cannot be put in another order, by their times.
struct Ordered {
    frames: Box<dyn Frames>,
    order: TimeOrder<Picture>,
    images: String,
    current: Option<Picture>,
}

impl Frames for Ordered {
    fn advance(&mut self) -> Result<Option<f64>> {
        let Self { frames, order, current, .. } = self;
        let next = order.next(|| -> Result<_> {
            while let Some(time_s) = frames.advance()? {
                if let Some(item) = frames.picture()? {
                    return Ok(Some(Timed { time_s, recorded_s: None, item }));
                }
            }
            Ok(None)
        })?;
        Ok(next.map(|(time_s, picture)| {
            *current = Some(picture);
            time_s
        }))
    }

    fn picture(&mut self) -> Result<Option<Picture>> {
        Ok(self.current.take())
    }

    fn take_warnings(&mut self) -> Vec<String> {
        let mut warnings = self.frames.take_warnings();
        warnings.append(&mut self.order.take_warnings(&self.images));
        warnings
    }

    fn times(&mut self) -> Result<Vec<f64>> {
        self.frames.times()
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
        while let Some(timed) = self.messages.advance()? {
            match image::video_packet(&self.messages.topic, self.kind, self.messages.data()) {
                Ok(message) => {
                    packet.data.clear();
                    packet.data.extend_from_slice(message.data);
                    packet.time_s = timed.time_s;
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
