//! The services of a run, and its parameters.

use crate::node::{Delivery, Node};
use crate::parameters::{ParameterCall, Parameters};
use crate::service::{Caller, Service};
use crate::topic::{KEPT, Topic, now_ns};
use odograph::error::{Error, Result};
use odograph::trajectory::TrackStatus;
use odograph_live::Hub;
use odograph_session::Observer;
use odograph_session::live::{LiveFrame, LiveRun, save_map};
use odograph_session::ros_messages::{self, MAP, ODOM, Parameter, ParameterValue};
use rustdds::mio1::{Events, Poll, Token};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

/// The full name of the node, below which its services are.
const NODE: &str = "/odograph";
/// Interval of looks at what has come, and at clients that have become known.
const STEP: Duration = Duration::from_millis(50);
/// Longest wait for the last replies.
const LAST: Duration = Duration::from_millis(300);
/// Time after which a wait is reported.
const REPORTED_AFTER: Duration = Duration::from_secs(2);

/// Whether `odom` → `base_link` is published.
pub const PUBLISH_ODOM: &str = "publish_odom_tf";
/// Whether `map` → `odom` is published.
pub const PUBLISH_MAP: &str = "publish_map_tf";
const MARK_NAME: &str = "mark_name";

/// What can be asked of a run: each is a service of the type `std_srvs/srv/Trigger`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Command {
    Start,
    Stop,
    Mark,
    Localize,
    Save,
}

impl Command {
    const ALL: [Self; 5] = [Self::Start, Self::Stop, Self::Mark, Self::Localize, Self::Save];

    fn name(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Stop => "stop",
            Self::Mark => "mark",
            Self::Localize => "localize",
            Self::Save => "save",
        }
    }
}

#[derive(Debug, Clone, Copy)]
enum Offered {
    Command(Command),
    Parameters(ParameterCall),
}

/// The services of a node, answered on a thread of their own.
#[derive(Debug)]
pub struct Services {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug)]
struct Shared {
    state: Mutex<State>,
    publishes_odom: AtomicBool,
    publishes_map: AtomicBool,
    ended: AtomicBool,
}

#[derive(Debug)]
struct State {
    /// Whether the run waits for its start.
    waits: bool,
    run: Option<Running>,
    parameters: Parameters,
    newest: Option<Newest>,
}

/// A run that goes on.
#[derive(Clone)]
struct Running {
    hub: Arc<Hub>,
    map: PathBuf,
    folder: PathBuf,
    odometry: odograph::odometry::OdometryConfig,
}

impl std::fmt::Debug for Running {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Running").field("folder", &self.folder).finish_non_exhaustive()
    }
}

/// What is known of the newest frame.
#[derive(Debug, Clone, Copy)]
struct Newest {
    status: TrackStatus,
    is_recognised: bool,
    /// x and y in metres and heading in radians, in the map.
    place: Option<[f64; 3]>,
    of: &'static str,
}

/// An answer in words, and whether what was asked is done.
type Answer = std::result::Result<String, String>;

impl Services {
    /// Offers the services. The run waits for its start if `waits` is true.
    ///
    /// # Errors
    /// If a service cannot be announced.
    pub fn announce(node: &Node, source: &str, waits: bool) -> Result<Self> {
        let poll = Poll::new().map_err(|error| {
            Error::input(format!("calls of services cannot be waited for: {error}")).caused_by(error)
        })?;
        let mut services = Vec::new();
        let mut offer = |offered: Offered, name: &str, type_name: &str| {
            let (name, token) = (format!("{NODE}/{name}").parse()?, Token(services.len()));
            services.push((offered, Service::new(node, &name, type_name, poll.registry(), token)?));
            Ok::<(), Error>(())
        };
        for command in Command::ALL {
            offer(Offered::Command(command), command.name(), "std_srvs/srv/Trigger")?;
        }
        for call in ParameterCall::ALL {
            let (name, type_name) = call.service();
            offer(Offered::Parameters(call), name, type_name)?;
        }
        let kind = "rcl_interfaces/msg/ParameterEvent";
        let events = Topic::new(node, "/parameter_events", kind, Delivery::Reliable, KEPT)?;
        let mut parameters = Parameters::default();
        let text = |text: &str| ParameterValue::Text(text.to_owned());
        parameters.put(MARK_NAME, text(""), false, "name of the marks to come; empty for their number");
        parameters.put("source", text(source), true, "it is given when the program begins");
        for (name, frame) in [("map_frame", MAP), ("odom_frame", ODOM)] {
            parameters.put(name, text(frame), true, "the names of frames are those of REP-105");
        }
        let about_time = "stamps are those of the images, so simulated time needs nothing";
        parameters.put("use_sim_time", ParameterValue::Bool(false), true, about_time);
        let shared = Arc::new(Shared {
            state: Mutex::new(State { waits, run: None, parameters, newest: None }),
            publishes_odom: AtomicBool::new(false),
            publishes_map: AtomicBool::new(false),
            ended: AtomicBool::new(false),
        });
        let (saved, saves) = channel();
        let answering =
            Answering { shared: Arc::clone(&shared), services, events, poll, saved, saves, saving: None };
        Ok(Self { shared, thread: Some(thread::spawn(move || answering.run())) })
    }

    /// Waits for the service that starts the run. The observer hears of it, and may end it.
    ///
    /// # Errors
    /// If the observer asks to stop.
    pub fn wait_for_start(&self, observer: &dyn Observer) -> Result<()> {
        let began = std::time::Instant::now();
        let mut reported = false;
        while self.shared.state().waits {
            if observer.is_stop_asked() {
                return Err(Error::output("interrupted; nothing was written"));
            }
            if !reported && began.elapsed() >= REPORTED_AFTER {
                reported = true;
                observer.note(&format!("waiting for the service {NODE}/{}", Command::Start.name()));
            }
            thread::sleep(STEP);
        }
        Ok(())
    }

    /// Serves a run from now on; `camera` is the frame of its images.
    pub(crate) fn serve(&self, run: &LiveRun, camera: &str, has_odom: bool, has_map: bool) {
        let mut state = self.shared.state();
        let (map, folder) = (run.map(), run.folder().to_owned());
        let parameters = &mut state.parameters;
        let text = |text: String| ParameterValue::Text(text);
        parameters.put("camera_frame", text(camera.to_owned()), true, "it is that of the images");
        let height = ParameterValue::Double(run.plan().rig.height_m);
        parameters.put("height", height, true, "height of the camera in metres, given when the run begins");
        parameters.put("map", text(map.display().to_string()), true, "it is given when the run begins");
        parameters.put("output", text(folder.display().to_string()), true, "it is given when the run begins");
        for (name, has, what) in [
            (PUBLISH_ODOM, has_odom, "whether odom to base_link, or to the camera, is published on /tf"),
            (PUBLISH_MAP, has_map, "whether map to odom is published on /tf"),
        ] {
            parameters.put(name, ParameterValue::Bool(has), false, what);
        }
        self.shared.apply(parameters);
        let odometry = run.plan().odometry;
        state.run = Some(Running { hub: Arc::clone(run.hub()), map, folder, odometry });
    }

    /// Takes the newest frame.
    pub(crate) fn take(&self, frame: &LiveFrame<'_>) {
        let place = frame.estimate.estimate.as_ref().map(|known| {
            let pose = frame.map_from_odometry.apply_to_pose(&known.pose);
            [pose.x_m, pose.y_m, pose.heading_rad]
        });
        let (status, of) = (frame.estimate.status, frame.of.name());
        self.shared.state().newest = Some(Newest { status, is_recognised: frame.is_recognised, place, of });
    }

    /// Whether `odom` → `base_link` is to be published.
    pub(crate) fn publishes_odom(&self) -> bool {
        self.shared.publishes_odom.load(Ordering::Relaxed)
    }

    /// Whether `map` → `odom` is to be published.
    pub(crate) fn publishes_map(&self) -> bool {
        self.shared.publishes_map.load(Ordering::Relaxed)
    }
}

impl Drop for Services {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Does what the parameters say.
    fn apply(&self, parameters: &Parameters) {
        let is_on = |name| parameters.value(name) == ParameterValue::Bool(true);
        self.publishes_odom.store(is_on(PUBLISH_ODOM), Ordering::Relaxed);
        self.publishes_map.store(is_on(PUBLISH_MAP), Ordering::Relaxed);
    }
}

impl State {
    fn running(&self) -> std::result::Result<&Running, String> {
        let why = || match self.waits {
            true => format!("the run waits for its start: call {NODE}/{}", Command::Start.name()),
            false => "the run has not begun yet: it waits for its images".to_owned(),
        };
        self.run.as_ref().ok_or_else(why)
    }

    fn start(&mut self) -> Answer {
        match std::mem::replace(&mut self.waits, false) {
            true => Ok("the run begins".to_owned()),
            false => Err("the run has begun already; with --ros2-wait it waits for this service".to_owned()),
        }
    }

    fn stop(&self) -> Answer {
        let running = self.running()?;
        running.hub.ask_to_stop();
        Ok(format!("the run ends; its results will be in {}", running.folder.display()))
    }

    fn mark(&self) -> Answer {
        let running = self.running()?;
        let name = match self.parameters.value(MARK_NAME) {
            ParameterValue::Text(name) => name,
            _ => String::new(),
        };
        let set = running.hub.mark(&name);
        let (_, mark) =
            set.ok_or("no mark can be set: there is no frame yet, or there are too many marks")?;
        Ok(match mark.x_m.zip(mark.y_m) {
            Some((x_m, y_m)) => format!("mark {:?} at x {x_m:.3} m, y {y_m:.3} m", mark.name),
            None => format!("mark {:?} at an unknown place: the camera is lost", mark.name),
        })
    }

    fn localize(&self) -> Answer {
        let running = self.running()?;
        let Some(Newest { status, is_recognised, place, of }) = self.newest else {
            return Err("there is no frame yet".to_owned());
        };
        let Some([x_m, y_m, heading_rad]) = place else { return Err(format!("the camera is {status}")) };
        if !is_recognised {
            return Err(format!("the ground is not recognised yet in {}", running.map.display()));
        }
        let heading_deg = heading_rad.sin().atan2(heading_rad.cos()).to_degrees();
        Ok(format!("{of} in {MAP}: x {x_m:.3} m, y {y_m:.3} m, heading {heading_deg:.2}°"))
    }
}

/// The thread that answers.
struct Answering {
    shared: Arc<Shared>,
    services: Vec<(Offered, Service)>,
    events: Topic,
    poll: Poll,
    saved: Sender<(Caller, Answer)>,
    saves: Receiver<(Caller, Answer)>,
    /// The thread that saves the map, if one does.
    saving: Option<JoinHandle<()>>,
}

fn response(answer: &Answer) -> Vec<u8> {
    match answer {
        Ok(what) => ros_messages::trigger_response(true, what),
        Err(why) => ros_messages::trigger_response(false, why),
    }
}

impl Answering {
    fn run(mut self) {
        let mut events = Events::with_capacity(64);
        while !self.shared.ended.load(Ordering::Relaxed) {
            if self.poll.poll(&mut events, Some(STEP)).is_err() {
                thread::sleep(STEP);
            }
            self.answer_all();
        }
        // A map that is being saved is complete.
        if let Some(saving) = self.saving.take() {
            let _ = saving.join();
        }
        self.answer_all();
        self.services.iter().for_each(|(_, service)| service.wait(LAST));
    }

    fn answer_all(&mut self) {
        let mut services = std::mem::take(&mut self.services);
        for (offered, service) in &mut services {
            for (caller, request) in service.take() {
                match offered {
                    Offered::Command(Command::Save) => {
                        if let Some(busy) = self.save(&caller) {
                            service.reply(caller, response(&Err(busy)));
                        }
                    }
                    Offered::Command(command) => service.reply(caller, response(&self.obey(*command))),
                    Offered::Parameters(call) => {
                        if let Some(message) = self.parameters(*call, &request) {
                            service.reply(caller, message);
                        }
                    }
                }
            }
            if matches!(offered, Offered::Command(Command::Save)) {
                while let Ok((caller, answer)) = self.saves.try_recv() {
                    service.reply(caller, response(&answer));
                }
            }
            service.deliver();
        }
        self.services = services;
    }

    fn obey(&self, command: Command) -> Answer {
        let mut state = self.shared.state();
        match command {
            Command::Start => state.start(),
            Command::Stop => state.stop(),
            Command::Mark => state.mark(),
            Command::Localize => state.localize(),
            // Answered when it is done.
            Command::Save => Err(String::new()),
        }
    }

    /// Saves the map beside the run, and answers later; if that cannot be, why not.
    fn save(&mut self, caller: &Caller) -> Option<String> {
        if self.saving.as_ref().is_some_and(|saving| !saving.is_finished()) {
            return Some("the map is being saved already".to_owned());
        }
        let running = match self.shared.state().running() {
            Ok(running) => running.clone(),
            Err(why) => return Some(why),
        };
        let (saved, caller) = (self.saved.clone(), caller.clone());
        self.saving = Some(thread::spawn(move || {
            let Running { map, folder, odometry, .. } = running;
            let answer = match save_map(&map, &folder, &odometry) {
                Ok(path) => Ok(format!("the map so far is saved in {}", path.display())),
                Err(error) => Err(error.to_string()),
            };
            let _ = saved.send((caller, answer));
        }));
        None
    }

    fn parameters(&self, call: ParameterCall, request: &[u8]) -> Option<Vec<u8>> {
        let (message, changed): (Vec<u8>, Vec<Parameter>) = {
            let mut state = self.shared.state();
            let answer = state.parameters.answer(call, request)?;
            self.shared.apply(&state.parameters);
            answer
        };
        if !changed.is_empty() {
            self.events.send(ros_messages::parameter_event(now_ns(), NODE, &changed));
        }
        Some(message)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use crate::payload::{Payload, PayloadReader, PayloadWriter};
    use rustdds::{GUID, RTPSEntity, SampleIdentity, SequenceNumber, WriteOptionsBuilder};
    use std::time::Instant;

    /// A client as rmw_fastrtps makes one: which request it is stands beside the message.
    struct Client {
        requests: PayloadWriter,
        replies: PayloadReader,
    }

    impl Client {
        fn of(node: &Node, name: &str) -> Self {
            let (replies, requests) =
                node.client(&format!("{NODE}/{name}").parse().unwrap(), "std_srvs/srv/Trigger").unwrap();
            Self { requests, replies }
        }

        /// Calls the service until it answers; the message of the answer.
        fn call(&mut self) -> Vec<u8> {
            let reader: GUID = RTPSEntity::guid(&self.replies);
            let beside = SampleIdentity { writer_guid: reader, sequence_number: SequenceNumber::from(0) };
            let began = Instant::now();
            loop {
                let options = WriteOptionsBuilder::new().related_sample_identity(beside).build();
                let sent = self.requests.write_with_options(Payload(vec![0, 1, 0, 0, 0]), options).unwrap();
                for _ in 0..20 {
                    thread::sleep(STEP);
                    while let Ok(Some(sample)) = self.replies.take_next_sample() {
                        let related = sample.sample_info().related_sample_identity();
                        let expected = SampleIdentity { writer_guid: reader, ..sent };
                        if related == Some(expected) {
                            let Payload(message) = sample.into_value();
                            return message;
                        }
                    }
                }
                assert!(began.elapsed() < Duration::from_secs(30), "no answer");
            }
        }
    }

    #[test]
    fn a_client_over_fast_dds_is_answered() {
        const DOMAIN: u16 = 231;
        let node = Node::joined(DOMAIN, true).unwrap();
        let services = Services::announce(&node, "test", true).unwrap();
        let other = Node::joined(DOMAIN, true).unwrap();
        let waits = "the run waits for its start: call /odograph/start";
        // DDS fills a message up to a multiple of four bytes.
        let reply = Client::of(&other, "mark").call();
        assert!(reply.starts_with(&ros_messages::trigger_response(false, waits)), "{reply:?}");
        let mut start = Client::of(&other, "start");
        // The first answer may have been lost with its call.
        start.call();
        assert!(services.wait_for_start(&()).is_ok());
        assert!(start.call().starts_with(&response(&services.shared.state().start())));
    }
}
