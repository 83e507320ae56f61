//! The images of a topic as a live source, and the camera that they are of.

use crate::link::Link;
use crate::listening::{ArrivedImage, Listening, Sensor, Wanted, named_topics};
use crate::names::TopicName;
use crate::node::Node;
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::filter::fusion::Sensors;
use odograph_live::capture::{Captured, LiveSource, Taken, Watch};
use odograph_session::Observer;
use odograph_video::{Frame, LiveTopic, Picture, RecordedMount, SourceInfo};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// What is wanted of the topics of a robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ImageOptions {
    /// The images.
    pub topic: TopicName,
    /// Their camera_info, if it is not beside them.
    pub camera_info: Option<TopicName>,
    /// Gyroscope: `sensor_msgs/Imu`.
    pub gyro: Option<TopicName>,
    /// Wheel odometry: `nav_msgs/Odometry`.
    pub wheel: Option<TopicName>,
    /// Range finder: `sensor_msgs/Range`.
    pub range: Option<TopicName>,
    /// Longest wait for images to come, at the beginning or again.
    pub patience: Duration,
}

/// Default longest wait, as for network cameras.
const PATIENCE: Duration = Duration::from_secs(60);
/// Longest wait for the static transforms of a robot after its first image.
const TRANSFORMS_PATIENCE: Duration = Duration::from_secs(2);
/// Pause without images after which they are missing.
const MISSING_AFTER: Duration = Duration::from_secs(2);
/// Interval of looks at what has come.
const STEP: Duration = Duration::from_millis(50);
/// Time after which a wait is reported.
const REPORTED_AFTER: Duration = Duration::from_secs(2);
/// Most images at the beginning that may be damaged.
const DAMAGED: u32 = 3;
/// A jump back in time by more than this is another beginning, not a message that was overtaken.
const OVERTAKEN_S: f64 = 1.0;

impl ImageOptions {
    /// The images of a topic, and the camera_info beside them.
    pub fn new(topic: TopicName) -> Self {
        Self { topic, camera_info: None, gyro: None, wheel: None, range: None, patience: PATIENCE }
    }
}

/// The images of a topic, before they are followed.
pub struct Images {
    listening: Listening,
    options: ImageOptions,
    domain: u16,
    began: Instant,
    first: Option<FirstImage>,
}

impl std::fmt::Debug for Images {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Images").field("options", &self.options).finish_non_exhaustive()
    }
}

/// The first image of a topic.
struct FirstImage {
    topic: LiveTopic,
    arrived: ArrivedImage,
    picture: Picture,
    frame: String,
}

impl Images {
    /// Begins to listen to the topics.
    ///
    /// # Errors
    /// If there is no network.
    pub fn of(node: &Node, options: ImageOptions) -> Result<Self> {
        let mut wanted = vec![Wanted::Transforms];
        let beside = || {
            let images = LiveTopic::new(options.topic.as_str(), odograph_video::LiveMessage::Image);
            images.camera_info_names().iter().filter_map(|name| name.parse().ok()).collect()
        };
        let infos: Vec<TopicName> = options.camera_info.clone().map_or_else(beside, |name| vec![name]);
        wanted.extend(infos.into_iter().map(Wanted::CameraInfo));
        for (sensor, name) in
            [(Sensor::Gyro, &options.gyro), (Sensor::Wheel, &options.wheel), (Sensor::Range, &options.range)]
        {
            wanted.extend(name.clone().map(|name| Wanted::Sensor(sensor, name)));
        }
        let listening = Listening::begin(node, options.topic.clone(), &wanted)?;
        let (domain, began) = (node.domain(), Instant::now());
        Ok(Self { listening, options, domain, began, first: None })
    }

    /// Forgets what has come so far, and how long it has been waited for.
    pub fn begin_again(&mut self) {
        while let Taken::Item(_) = self.listening.images().take(Duration::ZERO) {}
        (self.began, self.first) = (Instant::now(), None);
    }

    /// Waits until `look` finds something. The observer hears what is waited for, and may end it.
    fn wait<T>(
        &self,
        patience: Duration,
        observer: &dyn Observer,
        what: &str,
        mut look: impl FnMut() -> Result<Option<T>>,
    ) -> Result<Option<T>> {
        let (began, mut reported) = (Instant::now(), false);
        loop {
            if let Some(found) = look()? {
                return Ok(Some(found));
            }
            if observer.is_stop_asked() {
                return Err(Error::output("interrupted; nothing was written"));
            }
            if began.elapsed() >= patience {
                return Ok(None);
            }
            if !reported && began.elapsed() >= REPORTED_AFTER {
                reported = true;
                observer.note(&format!("waiting for {what} (ROS_DOMAIN_ID {})", self.domain));
            }
            std::thread::sleep(STEP);
        }
    }

    /// Waits for the first image.
    fn first(&mut self, observer: &dyn Observer) -> Result<&FirstImage> {
        let first = match self.first.take() {
            Some(first) => first,
            None => self.wait_for_first(observer)?,
        };
        Ok(self.first.insert(first))
    }

    fn wait_for_first(&self, observer: &dyn Observer) -> Result<FirstImage> {
        let name = &self.options.topic;
        let patience = self.options.patience.saturating_sub(self.began.elapsed());
        let what = format!("images on {name}");
        let mut damaged = 0;
        let found = self.wait(patience, observer, &what, || {
            if let Some(failure) = self.listening.heard().failure.take() {
                return Err(failure);
            }
            let Taken::Item(arrived) = self.listening.images().take(Duration::ZERO) else { return Ok(None) };
            let Some(topic) = self.listening.heard().images.clone() else { return Ok(None) };
            let picture = match topic.picture(&arrived.message) {
                Ok(picture) => picture,
                Err(_) if damaged < DAMAGED => {
                    damaged += 1;
                    return Ok(None);
                }
                Err(error) => return Err(error.at(name)),
            };
            let frame = topic.frame_id(&arrived.message);
            Ok(Some(FirstImage { topic, arrived, picture, frame }))
        })?;
        found.ok_or_else(|| self.no_images(None))
    }

    fn no_images(&self, since: Option<Duration>) -> Error {
        no_images(&self.listening, &self.options, self.domain, since)
    }

    /// The camera of the images, from their camera_info: waits for both.
    ///
    /// # Errors
    /// If no image comes, nobody publishes the camera_info, its camera is not calibrated, or the
    /// observer asks to stop.
    pub fn camera(&mut self, observer: &dyn Observer) -> Result<Camera> {
        let images = self.first(observer)?.topic.clone();
        let names = match &self.options.camera_info {
            Some(name) => vec![name.to_string()],
            None => images.camera_info_names().to_vec(),
        };
        let patience = self.options.patience;
        let found = self.wait(patience, observer, &format!("the camera on {}", names[0]), || {
            let heard = self.listening.heard();
            let infos = &heard.camera_infos;
            let named = names.iter().find_map(|name| infos.iter().find(|(topic, _)| topic.name() == name));
            named.map(|(topic, message)| topic.camera(message, images.is_rectified())).transpose()
        })?;
        found.ok_or_else(|| {
            Error::input(format!(
                "nobody publishes the camera of {} on {}; give --camera FILE, or its topic with --camera-info-topic",
                images.name(),
                names[0]
            ))
        })
    }

    /// Where the camera is on the robot, from the robot's static transforms. `None` if none that
    /// connect the frame of the images with `base_link` come within two seconds.
    ///
    /// # Errors
    /// If no image comes, or the observer asks to stop.
    pub fn mount(&mut self, observer: &dyn Observer) -> Result<Option<RecordedMount>> {
        let frame = self.first(observer)?.frame.clone();
        self.wait(TRANSFORMS_PATIENCE, observer, "/tf_static", || {
            Ok(self.listening.heard().transforms.mount(&frame))
        })
    }

    /// The images as a live source, which ends when the watch says so; waits for the first one.
    ///
    /// # Errors
    /// If no image comes, it cannot be decoded, or the observer asks to stop.
    pub fn source(mut self, watch: Watch, observer: &dyn Observer) -> Result<ImageSource> {
        self.first(observer)?;
        let Some(FirstImage { topic, arrived, picture, frame }) = self.first.take() else {
            return Err(self.no_images(None));
        };
        let (width, height) = (picture.gray.width(), picture.gray.height());
        let description = format!("images of ROS 2 ({}), {width}x{height}", self.options.topic);
        let info = SourceInfo { width, height, frame_count: None, description };
        let Self { listening, options, domain, .. } = self;
        Ok(ImageSource {
            listening,
            link: Link::new(watch.clone(), frame),
            options,
            domain,
            info,
            topic,
            first: Some((arrived, picture)),
            watch,
            number: 0,
            last_s: None,
            by_arrival: None,
            newest: Instant::now(),
            overtaken: 0,
            damaged: 0,
            first_damage: None,
            warnings: Vec::new(),
        })
    }
}

/// The error that no images come, or that none have come for some time.
fn no_images(listening: &Listening, options: &ImageOptions, domain: u16, since: Option<Duration>) -> Error {
    let heard = listening.heard();
    let name = &options.topic;
    let seconds = since.unwrap_or(options.patience).as_secs();
    let waited = if since.is_some() { "more" } else { "any" };
    Error::input(if heard.publishers > 0 {
        format!("no image came on {name} for {seconds} s, though it is published")
    } else if since.is_some() {
        format!("nobody publishes {name} any {waited}, for {seconds} s")
    } else {
        format!(
            "nobody publishes {name} (ROS_DOMAIN_ID {domain}), for {seconds} s{}",
            named_topics(&heard.others)
        )
    })
}

/// The images of a topic.
pub struct ImageSource {
    listening: Listening,
    link: Link,
    options: ImageOptions,
    domain: u16,
    info: SourceInfo,
    topic: LiveTopic,
    first: Option<(ArrivedImage, Picture)>,
    watch: Watch,
    number: u64,
    last_s: Option<f64>,
    /// Times are those of arrival, because the messages have none.
    by_arrival: Option<bool>,
    /// When the newest image arrived.
    newest: Instant,
    overtaken: u64,
    damaged: u64,
    first_damage: Option<String>,
    warnings: Vec<String>,
}

impl std::fmt::Debug for ImageSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ImageSource").field("info", &self.info).finish_non_exhaustive()
    }
}

/// The time of the clock at an arrival, nanoseconds.
fn clock_ns(at: Instant) -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.saturating_sub(at.elapsed()).as_nanos()).unwrap_or(i64::MAX)
}

impl ImageSource {
    /// What a publisher of the run's poses needs to know of the images.
    pub fn link(&self) -> Link {
        self.link.clone()
    }

    /// The frame of a message; `None` if it is not after the one before.
    fn frame(&mut self, arrived: &ArrivedImage, picture: Picture) -> Result<Option<Frame>> {
        let name = &self.options.topic;
        let size = (picture.gray.width(), picture.gray.height());
        if size != (self.info.width, self.info.height) {
            return Err(Error::input(format!(
                "{name} now has images of {}x{}, at first they were {}x{}; a camera must keep its size",
                size.0, size.1, self.info.width, self.info.height
            )));
        }
        let stamp_ns = self.topic.stamp_ns(&arrived.message);
        let by_arrival = *self.by_arrival.get_or_insert_with(|| {
            if stamp_ns.is_none() {
                self.warnings.push(format!(
                    "the images on {name} have no time stamp; the times at which they arrived are used"
                ));
            }
            stamp_ns.is_none()
        });
        let stamp_ns = if by_arrival { Some(clock_ns(arrived.at)) } else { stamp_ns };
        let Some(stamp_ns) = stamp_ns else {
            self.overtaken += 1;
            return Ok(None);
        };
        let time_s = LiveTopic::seconds(stamp_ns);
        if let Some(last_s) = self.last_s.filter(|last_s| time_s <= *last_s) {
            if last_s - time_s > OVERTAKEN_S {
                return Err(Error::input(format!(
                    "the time of the images on {name} went back by {:.1} s, as of a recording that is played again; \
                     begin another run",
                    last_s - time_s
                )));
            }
            self.overtaken += 1;
            return Ok(None);
        }
        self.last_s = Some(time_s);
        let number = self.number;
        self.number += 1;
        self.link.keep(number, stamp_ns);
        Ok(Some(Frame::new(number, time_s, picture)))
    }

    /// Reports when the images have several publishers.
    fn count_publishers(&self) {
        let publishers = self.listening.heard().publishers;
        if self.link.set_publishers(publishers) && publishers > 1 {
            self.watch.notice(format!(
                "{} has {publishers} publishers; the images of one are used, those of the others left out",
                self.options.topic
            ));
        }
    }

    /// Without images for a while: reports it, and fails when patience ends.
    fn miss(&mut self) -> Result<()> {
        let since = self.newest.elapsed();
        if since >= self.options.patience {
            return Err(no_images(&self.listening, &self.options, self.domain, Some(since)));
        }
        if since >= MISSING_AFTER {
            self.watch.lost(&no_images(&self.listening, &self.options, self.domain, Some(since)).to_string());
        }
        Ok(())
    }
}

impl LiveSource for ImageSource {
    fn info(&self) -> &SourceInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Captured>> {
        while !self.watch.ended() {
            self.count_publishers();
            let (arrived, picture) = match self.first.take() {
                Some((arrived, picture)) => (arrived, Ok(picture)),
                None => match self.listening.images().take(STEP) {
                    Taken::Item(arrived) => {
                        let picture = self.topic.picture(&arrived.message);
                        (arrived, picture)
                    }
                    Taken::Nothing => {
                        self.miss()?;
                        continue;
                    }
                    Taken::End => {
                        return match self.listening.heard().failure.take() {
                            Some(failure) => Err(failure),
                            None => Ok(None),
                        };
                    }
                },
            };
            self.newest = Instant::now();
            self.watch.back();
            match picture {
                Ok(picture) => {
                    if let Some(frame) = self.frame(&arrived, picture)? {
                        return Ok(Some(Captured { frame, at: arrived.at }));
                    }
                }
                Err(error) => {
                    self.damaged += 1;
                    self.first_damage.get_or_insert(error.to_string());
                }
            }
        }
        Ok(None)
    }

    fn take_warnings(&mut self) -> Vec<String> {
        let mut warnings = std::mem::take(&mut self.warnings);
        if let Some(why) = self.first_damage.take() {
            let damaged = std::mem::take(&mut self.damaged);
            warnings.push(format!("{damaged} images were left out because they cannot be decoded ({why})"));
        }
        if self.overtaken > 0 {
            let overtaken = std::mem::take(&mut self.overtaken);
            warnings
                .push(format!("images left out because their times are not after those before: {overtaken}"));
        }
        let of_others = std::mem::take(&mut self.listening.heard().of_others);
        if of_others > 0 {
            let name = &self.options.topic;
            warnings.push(format!("images of another publisher of {name} that were left out: {of_others}"));
        }
        warnings.extend(self.listening.heard().records.iter().filter_map(|(_, record)| record.defect()));
        warnings
    }

    fn take_sensors(&mut self) -> Sensors {
        let mut sensors = Sensors::default();
        for (sensor, record) in std::mem::take(&mut self.listening.heard().records) {
            let place = match sensor {
                Sensor::Gyro => &mut sensors.gyro,
                Sensor::Wheel => &mut sensors.wheel,
                Sensor::Range => &mut sensors.range,
            };
            *place = record.finish();
        }
        sensors
    }

    fn dropped(&self) -> u64 {
        self.listening.images().counts().1
    }
}
