//! The thread that takes messages from DDS: it keeps what is newest, and never waits for who reads.

use crate::names::TopicName;
use crate::node::{Delivery, Node};
use crate::payload::{Payload, PayloadReader};
use crate::sensors::GrowingRecord;
use odograph::error::{Error, Result};
use odograph_live::capture::{Newest, Policy};
use odograph_video::{LiveMessage, LiveTopic, LiveTransforms};
use rustdds::mio1::{Events, Interest, Poll, Token};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

/// Messages that wait for decoding: the next one, and one that arrives while it is taken.
const IMAGES_WAITING: usize = 2;
/// Messages that DDS keeps for this thread: of images a few, each up to some megabytes; of a
/// gyroscope what comes in half a second.
const IMAGES_KEPT: i32 = 4;
const SAMPLES_KEPT: i32 = 200;
/// Pause without images of the publisher that is followed after which another one is.
const TAKEN_OVER_AFTER: Duration = Duration::from_secs(2);
/// Interval of looks at who publishes.
const LOOKED_EVERY: Duration = Duration::from_millis(100);

/// An image message and when it arrived.
pub struct ArrivedImage {
    pub message: Vec<u8>,
    pub at: Instant,
}

/// A sensor beside the camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sensor {
    Gyro,
    Wheel,
    Range,
}

/// What a topic is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Use {
    Images,
    CameraInfo,
    Transforms,
    Sensor(Sensor),
}

/// A topic that is listened to from the beginning; that of the images is found by its name.
#[derive(Debug, Clone)]
pub enum Wanted {
    CameraInfo(TopicName),
    Transforms,
    Sensor(Sensor, TopicName),
}

/// What has come so far, besides the images.
#[derive(Debug, Default)]
pub struct Heard {
    /// The topic of the images, once somebody publishes it.
    pub images: Option<LiveTopic>,
    /// The newest message of each camera_info topic.
    pub camera_infos: Vec<(LiveTopic, Vec<u8>)>,
    pub transforms: LiveTransforms,
    pub records: Vec<(Sensor, GrowingRecord)>,
    /// Number of publishers of the images, at the last look.
    pub publishers: usize,
    /// Number of images of publishers that are not followed.
    pub of_others: u64,
    /// Other topics with images, at the last look.
    pub others: Vec<TopicName>,
    /// Why there will be no images.
    pub failure: Option<Error>,
}

/// The thread and what it shares.
pub struct Listening {
    heard: Arc<Mutex<Heard>>,
    images: Arc<Newest<ArrivedImage>>,
    ended: Arc<AtomicBool>,
}

impl Drop for Listening {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Relaxed);
    }
}

impl Listening {
    /// Begins to listen.
    pub fn begin(node: &Node, images: TopicName, wanted: &[Wanted]) -> Result<Self> {
        let heard: Arc<Mutex<Heard>> = Arc::default();
        let queue = Arc::new(Newest::new(Policy::NewestWins, IMAGES_WAITING));
        let ended: Arc<AtomicBool> = Arc::default();
        let poll = Poll::new().map_err(|error| {
            Error::input(format!("messages of ROS 2 cannot be waited for: {error}")).caused_by(error)
        })?;
        let mut listener = Listener {
            node: node.clone(),
            name: images,
            poll,
            readers: Vec::new(),
            heard: Arc::clone(&heard),
            queue: Arc::clone(&queue),
            ended: Arc::clone(&ended),
            looked: None,
            followed: None,
            writers: Vec::new(),
        };
        for wanted in wanted {
            listener.listen_to(wanted)?;
        }
        thread::spawn(move || listener.run());
        Ok(Self { heard, images: queue, ended })
    }

    /// What has come so far.
    pub fn heard(&self) -> MutexGuard<'_, Heard> {
        self.heard.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The image messages, the newest two of them.
    pub fn images(&self) -> &Newest<ArrivedImage> {
        &self.images
    }
}

struct Reader {
    of: Use,
    topic: LiveTopic,
    reader: PayloadReader,
}

struct Listener {
    node: Node,
    name: TopicName,
    poll: Poll,
    readers: Vec<Reader>,
    heard: Arc<Mutex<Heard>>,
    queue: Arc<Newest<ArrivedImage>>,
    ended: Arc<AtomicBool>,
    looked: Option<Instant>,
    /// The writer whose images are taken, and when the newest one came.
    followed: Option<([u8; 16], Instant)>,
    /// The writers of the images, at the last look.
    writers: Vec<[u8; 16]>,
}

impl Listener {
    fn heard(&self) -> MutexGuard<'_, Heard> {
        self.heard.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn listen_to(&mut self, wanted: &Wanted) -> Result<()> {
        let sensor = |sensor| match sensor {
            Sensor::Gyro => LiveMessage::Imu,
            Sensor::Wheel => LiveMessage::Odometry,
            Sensor::Range => LiveMessage::Range,
        };
        let (of, name, message, delivery) = match wanted {
            Wanted::CameraInfo(name) => {
                (Use::CameraInfo, name.clone(), LiveMessage::CameraInfo, Delivery::BestEffort)
            }
            Wanted::Transforms => {
                (Use::Transforms, "/tf_static".parse()?, LiveMessage::Transforms, Delivery::Latched)
            }
            Wanted::Sensor(kind, name) => {
                (Use::Sensor(*kind), name.clone(), sensor(*kind), Delivery::BestEffort)
            }
        };
        self.add(of, &name, message, delivery)
    }

    fn add(&mut self, of: Use, name: &TopicName, message: LiveMessage, delivery: Delivery) -> Result<()> {
        let depth = if of == Use::Images { IMAGES_KEPT } else { SAMPLES_KEPT };
        let mut reader = self.node.reader(name, message.type_name(), delivery, depth)?;
        let token = Token(self.readers.len());
        self.poll.registry().register(&mut reader, token, Interest::READABLE).map_err(|error| {
            Error::input(format!("messages of {name} cannot be waited for: {error}")).caused_by(error)
        })?;
        let topic = LiveTopic::new(name.as_str(), message);
        if let Use::Sensor(sensor) = of {
            self.heard().records.push((sensor, GrowingRecord::new(topic.clone())));
        }
        self.readers.push(Reader { of, topic, reader });
        Ok(())
    }

    fn run(mut self) {
        let mut events = Events::with_capacity(64);
        while !self.ended.load(Ordering::Relaxed) {
            // All readers are emptied, whichever has woken the thread.
            if self.poll.poll(&mut events, Some(LOOKED_EVERY)).is_err() {
                thread::sleep(LOOKED_EVERY);
            }
            self.take_all();
            if let Err(error) = self.look() {
                self.heard().failure = Some(error);
                break;
            }
        }
        self.queue.close();
    }

    fn take_all(&mut self) {
        let at = Instant::now();
        let mut readers = std::mem::take(&mut self.readers);
        for Reader { of, topic, reader } in &mut readers {
            // A damaged message is left out; it is not delivered again.
            while let Ok(Some(sample)) = reader.take_next_sample() {
                let writer = sample.sample_info().writer_guid().to_bytes();
                let Payload(message) = sample.into_value();
                match of {
                    Use::Images if self.follows(writer, at) => {
                        self.queue.give(ArrivedImage { message, at });
                    }
                    Use::Images => self.heard().of_others += 1,
                    Use::CameraInfo => {
                        let infos = &mut self.heard().camera_infos;
                        infos.retain(|(other, _)| other.name() != topic.name());
                        infos.push((topic.clone(), message));
                    }
                    Use::Transforms => self.heard().transforms.add(&message),
                    Use::Sensor(sensor) => {
                        let records = &mut self.heard().records;
                        if let Some((_, record)) = records.iter_mut().find(|(other, _)| other == sensor) {
                            record.take(&message);
                        }
                    }
                }
            }
        }
        self.readers = readers;
    }

    /// Whether the images of a writer are taken: those of one writer alone, so that the pictures of
    /// two cameras are not mixed. Another one takes over when it is gone, or silent.
    fn follows(&mut self, writer: [u8; 16], at: Instant) -> bool {
        let is_other = |(followed, newest): ([u8; 16], Instant)| {
            followed != writer
                && self.writers.contains(&followed)
                && at.saturating_duration_since(newest) < TAKEN_OVER_AFTER
        };
        if self.followed.is_some_and(is_other) {
            return false;
        }
        self.followed = Some((writer, at));
        true
    }

    /// Looks who publishes; fails if the topic has other messages than images.
    fn look(&mut self) -> Result<()> {
        if self.looked.is_some_and(|looked| looked.elapsed() < LOOKED_EVERY) {
            return Ok(());
        }
        self.looked = Some(Instant::now());
        let published = self.node.published();
        let message = |type_name: &str| {
            let images = [LiveMessage::Image, LiveMessage::CompressedImage];
            LiveMessage::named(type_name).filter(|message| images.contains(message))
        };
        let (own, others): (Vec<_>, Vec<_>) =
            published.into_iter().partition(|published| published.name == self.name);
        let mut others: Vec<TopicName> = others
            .into_iter()
            .filter(|other| message(&other.type_name).is_some())
            .map(|other| other.name)
            .collect();
        others.sort_by(|a, b| a.as_str().cmp(b.as_str()));
        others.dedup();
        self.writers = own.iter().map(|published| published.writer).collect();
        let is_followed = {
            let mut heard = self.heard();
            heard.publishers = own.len();
            heard.others = others;
            heard.images.is_some()
        };
        if is_followed || own.is_empty() {
            return Ok(());
        }
        let Some(found) = own.iter().find_map(|published| message(&published.type_name)) else {
            let name = &self.name;
            return Err(Error::input(format!(
                "the messages on {name} are {}, not images (sensor_msgs/msg/Image or CompressedImage){}",
                own[0].type_name,
                named_topics(&self.heard().others)
            )));
        };
        let name = self.name.clone();
        self.add(Use::Images, &name, found, Delivery::BestEffort)?;
        self.heard().images = Some(LiveTopic::new(name.as_str(), found));
        Ok(())
    }
}

/// The topics with images, as the end of a sentence.
pub fn named_topics(topics: &[TopicName]) -> String {
    const MOST: usize = 8;
    if topics.is_empty() {
        return "; no other topic has any".to_owned();
    }
    let names: Vec<&str> = topics.iter().take(MOST).map(TopicName::as_str).collect();
    let more = if topics.len() > MOST { ", …" } else { "" };
    format!("; topics with images are: {}{more}", names.join(", "))
}
