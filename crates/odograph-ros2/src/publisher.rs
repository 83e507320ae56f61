//! What is published of a run.

use crate::ground::GroundPublisher;
use crate::link::Link;
use crate::names::TopicName;
use crate::node::{Delivery, Node};
use crate::path::SparsePath;
use crate::services::Services;
use crate::topic::{KEPT, Topic, now_ns};
use nalgebra::Isometry3;
use odograph::error::Result;
use odograph::pose_frame::PoseFrame;
use odograph::trajectory::TrackStatus;
use odograph_session::live::{LiveFrame, LiveRun, PoseSink};
use odograph_session::ros_messages::{self, CAMERA, Diagnostic, MAP, ODOM, Severity};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

/// A part of what is published.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// `odom` → `base_link` on `/tf`.
    OdomTransform,
    /// `map` → `odom` on `/tf`.
    MapTransform,
    /// `base_link` → `camera` on `/tf_static`.
    CameraTransform,
    /// `nav_msgs/Path` on `/odograph/path`.
    Path,
    /// `diagnostic_msgs/DiagnosticArray` on `/diagnostics`.
    Diagnostics,
    /// `nav_msgs/OccupancyGrid` on `/odograph/grid`.
    Grid,
    /// `sensor_msgs/CompressedImage` on `/odograph/mosaic/compressed`, and its georeference.
    Mosaic,
}

/// What is published, and where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PublisherOptions {
    /// Topic of `nav_msgs/Odometry`.
    pub odometry: TopicName,
    /// What is left out.
    pub without: Vec<Part>,
    /// Whether the robot already has the transform from `base_link` to the camera.
    pub camera_is_placed: bool,
}

/// Topic of the odometry, as navigation expects it.
const ODOMETRY: &str = "/odom";
const PATH: &str = "/odograph/path";

impl Default for PublisherOptions {
    fn default() -> Self {
        let odometry = ODOMETRY.parse().unwrap_or_else(|_| unreachable!("{ODOMETRY} is a name"));
        Self { odometry, without: Vec::new(), camera_is_placed: false }
    }
}

/// Interval of the path, and of diagnostics that do not change.
const SECOND: Duration = Duration::from_secs(1);
/// Age of the newest frame from which the state is stale.
const STALE_AFTER: Duration = Duration::from_secs(2);
/// What there is to say after the last frame.
const ENDED: &str = "the run has ended";
/// Interval at which the watch for missing images wakes.
const STEP: Duration = Duration::from_millis(100);

/// Publishes the poses of a live run.
#[derive(Debug)]
pub struct RunPublisher {
    link: Option<Link>,
    camera: String,
    odometry: Topic,
    transforms: Topic,
    static_transforms: Option<Topic>,
    path: Option<(Topic, SparsePath, Option<Instant>)>,
    health: Option<Health>,
    ground: Option<GroundPublisher>,
    services: Services,
    /// That of the camera on the robot, as it was published last.
    placed: Option<Isometry3<f64>>,
    /// Last, so that what is sent at the end is sent.
    _node: Node,
}

impl RunPublisher {
    /// Announces the topics. Of images of ROS 2 the link has the times and the frame; those of
    /// other sources are stamped by the clock. The services are for the run from now on; its ground
    /// is published if the run keeps it up to date in its hub.
    ///
    /// # Errors
    /// If a topic cannot be announced.
    pub fn new(
        node: &Node,
        options: &PublisherOptions,
        link: Option<Link>,
        services: Services,
        run: &LiveRun,
    ) -> Result<Self> {
        let has = |part: Part| !options.without.contains(&part);
        let topic =
            |name: &str, type_name: &str, delivery, depth| Topic::new(node, name, type_name, delivery, depth);
        let transforms = "tf2_msgs/msg/TFMessage";
        let is_placed = options.camera_is_placed || !has(Part::CameraTransform);
        let path = || topic(PATH, "nav_msgs/msg/Path", Delivery::Latched, 1);
        let frame = link.as_ref().map(Link::frame).filter(|frame| !frame.is_empty());
        let camera = frame.unwrap_or(CAMERA).to_owned();
        services.serve(run, &camera, has(Part::OdomTransform), has(Part::MapTransform));
        Ok(Self {
            camera,
            odometry: topic(options.odometry.as_str(), "nav_msgs/msg/Odometry", Delivery::Reliable, KEPT)?,
            transforms: topic("/tf", transforms, Delivery::Reliable, KEPT)?,
            static_transforms: (!is_placed)
                .then(|| topic("/tf_static", transforms, Delivery::Latched, 1))
                .transpose()?,
            path: has(Part::Path).then(path).transpose()?.map(|topic| (topic, SparsePath::default(), None)),
            health: has(Part::Diagnostics).then(|| Health::new(node, link.clone())).transpose()?,
            ground: GroundPublisher::new(node, run.hub(), has(Part::Grid), has(Part::Mosaic))?,
            link,
            services,
            placed: None,
            _node: node.clone(),
        })
    }

    fn publish_pose(&mut self, time_ns: u64, frame: &LiveFrame<'_>) {
        let Some(known) = &frame.estimate.estimate else { return };
        let child = match frame.of {
            PoseFrame::Camera => self.camera.as_str(),
            base @ PoseFrame::BaseLink(_) => base.name(),
        };
        let placed = frame.of.world_from_frame(&known.pose);
        self.odometry.send(ros_messages::odometry(time_ns, child, &placed, known));
        let corrected = frame.map_from_odometry.apply_to_pose(&known.pose);
        let map_from_odom = frame.of.world_from_frame(&corrected) * placed.inverse();
        let mut moved = Vec::new();
        if self.services.publishes_map() {
            moved.push((MAP, ODOM, map_from_odom));
        }
        if self.services.publishes_odom() {
            moved.push((ODOM, child, placed));
        }
        if !moved.is_empty() {
            self.transforms.send(ros_messages::transforms(time_ns, &moved));
        }
        if let Some((topic, path, sent)) = &mut self.path {
            path.add(time_ns, placed);
            if sent.is_none_or(|sent| sent.elapsed() >= SECOND) {
                *sent = Some(Instant::now());
                topic.send(ros_messages::path(time_ns, path.poses()));
            }
        }
    }

    /// The camera on the robot: again whenever it has become known better.
    fn publish_mount(&mut self, time_ns: u64, of: &PoseFrame) {
        let (Some(topic), PoseFrame::BaseLink(base)) = (&self.static_transforms, of) else { return };
        let placed = *base.base_from_camera();
        if self.placed.replace(placed) != Some(placed) {
            topic.send(ros_messages::transforms(time_ns, &[(of.name(), &self.camera, placed)]));
        }
    }
}

impl PoseSink for RunPublisher {
    fn take(&mut self, frame: &LiveFrame<'_>) -> Result<()> {
        let stamp_ns = self.link.as_ref().and_then(|link| link.stamp_ns(frame.estimate.frame));
        // ROS has no times before 0.
        let stamp_ns = stamp_ns.map(|stamp_ns| u64::try_from(stamp_ns).unwrap_or(0));
        let time_ns = stamp_ns.unwrap_or_else(|| now_ns().saturating_sub((1e6 * frame.latency_ms) as u64));
        self.publish_mount(time_ns, frame.of);
        self.publish_pose(time_ns, frame);
        self.services.take(frame);
        if let Some(ground) = &self.ground {
            ground.set_time(time_ns);
        }
        if let Some(health) = &self.health {
            health.update(time_ns, frame);
        }
        Ok(())
    }
}

impl Drop for RunPublisher {
    fn drop(&mut self) {
        // The end of the path, for those who still listen.
        if let Some((topic, path, _)) = &self.path
            && let Some((time_ns, _)) = path.poses().last()
        {
            topic.wait();
            topic.send(ros_messages::path(*time_ns, path.poses()));
            topic.wait();
        }
    }
}

/// Says how the run is: at each change, and each second.
#[derive(Debug)]
struct Health {
    shared: Arc<SharedHealth>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug)]
struct SharedHealth {
    topic: Topic,
    link: Option<Link>,
    state: Mutex<HealthState>,
    ended: AtomicBool,
}

#[derive(Debug, Default)]
struct HealthState {
    /// That of the newest frame, with its stamp and when it came.
    newest: Option<(u64, Diagnostic, Instant)>,
    /// Status and number of publishers of the images, as they were said last.
    status: Option<(TrackStatus, usize)>,
    /// Why there are no frames, as it was said last.
    stale: Option<&'static str>,
    sent: Option<Instant>,
}

impl Health {
    fn new(node: &Node, link: Option<Link>) -> Result<Self> {
        let (name, type_name) = ("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray");
        let topic = Topic::new(node, name, type_name, Delivery::Reliable, KEPT)?;
        let shared =
            Arc::new(SharedHealth { topic, link, state: Mutex::default(), ended: AtomicBool::new(false) });
        let watched = Arc::clone(&shared);
        let thread = thread::spawn(move || {
            while !watched.ended.load(Ordering::Relaxed) {
                watched.look();
                thread::sleep(STEP);
            }
        });
        Ok(Self { shared, thread: Some(thread) })
    }

    fn update(&self, time_ns: u64, frame: &LiveFrame<'_>) {
        let mut state = self.shared.state();
        let mut diagnostic = Diagnostic::of(frame.estimate);
        diagnostic.values.push(("latency_ms", format!("{:.1}", frame.latency_ms)));
        let publishers = self.shared.link.as_ref().map_or(0, Link::publishers);
        if publishers > 1 {
            diagnostic.severity = Severity::Warning;
            diagnostic.message += &format!("; the images have {publishers} publishers, and one is used");
        }
        let said = (frame.estimate.status, publishers);
        let changed = state.status.replace(said) != Some(said);
        state.newest = Some((time_ns, diagnostic, Instant::now()));
        if changed {
            self.shared.send(&mut state);
        }
    }
}

impl SharedHealth {
    fn state(&self) -> MutexGuard<'_, HealthState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Why there are no frames, in a word.
    fn stale(&self, state: &HealthState) -> Option<&'static str> {
        let is_old = |newest: &(u64, Diagnostic, Instant)| newest.2.elapsed() >= STALE_AFTER;
        match &self.link {
            Some(link) if link.has_ended() => Some(ENDED),
            Some(link) if link.waiting().is_some() => Some("no images"),
            _ if self.ended.load(Ordering::Relaxed) => Some(ENDED),
            _ => state.newest.as_ref().filter(|newest| is_old(newest)).map(|_| "no frames"),
        }
    }

    /// Sends the newest state.
    fn send(&self, state: &mut HealthState) {
        state.sent = Some(Instant::now());
        if let Some(stale) = state.stale {
            let message = match self.link.as_ref().and_then(Link::waiting) {
                Some(why) if stale != ENDED => why,
                _ => stale.to_owned(),
            };
            let stale = Diagnostic { severity: Severity::Stale, message, values: Vec::new() };
            self.topic.send(stale.message(now_ns()));
        } else if let Some((time_ns, diagnostic, _)) = &state.newest {
            self.topic.send(diagnostic.message(*time_ns));
        }
    }

    fn look(&self) {
        let mut state = self.state();
        let stale = self.stale(&state);
        let changed = std::mem::replace(&mut state.stale, stale) != stale;
        if changed || state.sent.is_some_and(|sent| sent.elapsed() >= SECOND) {
            self.send(&mut state);
        }
    }
}

impl Drop for Health {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        self.shared.look();
        self.shared.topic.wait();
    }
}
