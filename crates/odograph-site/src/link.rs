//! A robot's link to its site: a thread that sends what is in the robot's map, as far as the
//! network allows, and receives the pose of the robot in the site's map.

use crate::client::{NoAnswer, SiteClient};
use crate::protocol::{MAX_BODY, SessionDescription, SiteStatus};
use crate::record::Record;
use odograph::error::{Error, Result};
use odograph::ground_map::MountedCamera;
use odograph_map::{MapFile, Outbox, SessionOrigin};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

/// Interval at which the map is polled for new records: how much later the site has them.
const LOOKS_EVERY: Duration = Duration::from_millis(500);
/// Shortest and longest pause after a failure; each is twice the one before.
const FIRST_PAUSE: Duration = Duration::from_millis(500);
const LONGEST_PAUSE: Duration = Duration::from_secs(15);
/// Time that a link that has sent everything waits for the site to recognise the session, which
/// takes one or two seconds where it does, and the pause between two questions.
const RECOGNISED_WITHIN: Duration = Duration::from_secs(5);
const ASKS_EVERY: Duration = Duration::from_millis(200);
/// Time for the first sign of life of a site that cannot be reached: three attempts.
const SILENT_FOR: Duration = Duration::from_secs(2);
/// Maximum number of records read at once: bounds memory, and what is sent again after a failure.
const AT_ONCE: usize = 16;

/// State of the transmission.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LinkReport {
    /// Number of records that the site has acknowledged since the link began.
    pub acknowledged: u64,
    /// Whether everything in the map has been acknowledged, its ends included.
    pub complete: bool,
    /// Why nothing is sent at the moment.
    pub problem: Option<String>,
    /// Last answer of the site about the newest session.
    pub status: Option<SiteStatus>,
}

impl LinkReport {
    /// How long to wait for a sign of life; `usual` where there was one, or none was due yet.
    fn patience(&self, usual: Duration) -> Duration {
        let is_silent = self.acknowledged == 0 && self.status.is_none() && self.problem.is_some();
        if is_silent { usual.min(SILENT_FOR) } else { usual }
    }
}

/// A running link. Dropped it ends at once; what has not been sent stays in the map.
pub struct SiteLink {
    client: SiteClient,
    shared: Arc<LinkState>,
    thread: Option<JoinHandle<()>>,
}

impl std::fmt::Debug for SiteLink {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SiteLink").field("report", &self.report()).finish_non_exhaustive()
    }
}

#[derive(Debug, Default)]
struct LinkState {
    report: Mutex<LinkReport>,
    /// Whether the map is complete: its sessions end when they are sent.
    finishing: Mutex<bool>,
    changed: Condvar,
    ended: AtomicBool,
    lost: AtomicBool,
}

/// Called with every new report, from the link's thread.
pub type Listening = Box<dyn FnMut(&LinkReport) + Send>;

impl SiteLink {
    /// Begins to send the sessions of a robot in a map to a site. The map need not be there yet.
    ///
    /// # Errors
    /// If the name of the robot is invalid, or the thread cannot be started.
    pub fn start(map: &Path, robot: &str, client: SiteClient, listening: Listening) -> Result<Self> {
        odograph_map::check_name(robot)?;
        let shared = Arc::new(LinkState::default());
        let mut sending = Sending {
            map: map.to_owned(),
            robot: robot.to_owned(),
            client: client.clone(),
            current: None,
            newest: None,
            done: BTreeSet::new(),
            shared: Arc::clone(&shared),
            listening,
        };
        let thread = thread::Builder::new()
            .name("site".into())
            .spawn(move || sending.run())
            .map_err(|error| Error::output(format!("the thread to the site cannot be started: {error}")))?;
        Ok(Self { client, shared, thread: Some(thread) })
    }

    /// Tells whether the robot is lost at the moment; never waits.
    pub fn set_lost(&self, lost: bool) {
        self.shared.lost.store(lost, Ordering::Relaxed);
    }

    /// State of the transmission so far.
    pub fn report(&self) -> LinkReport {
        self.shared.report.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Sends the rest of the map, which no program writes any more, as long as the site takes it,
    /// and at most `patience` after its last sign of life, or some seconds if it has given none and
    /// cannot be reached. Then waits some seconds for the site to
    /// recognise the newest session. `keep_going` is asked in between.
    pub fn finish(mut self, patience: Duration, keep_going: &dyn Fn() -> bool) -> LinkReport {
        *self.shared.finishing.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.shared.changed.notify_all();
        let (mut heard, mut known) = (Instant::now(), 0);
        while self.thread.as_ref().is_some_and(|thread| !thread.is_finished())
            && heard.elapsed() < self.report().patience(patience)
            && keep_going()
        {
            thread::sleep(Duration::from_millis(20));
            let acknowledged = self.report().acknowledged;
            if acknowledged != known {
                (known, heard) = (acknowledged, Instant::now());
            }
        }
        self.end();
        self.report()
    }

    fn end(&mut self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        self.shared.changed.notify_all();
        if let Some(thread) = self.thread.take() {
            while !thread.is_finished() {
                // A request that begins just now may be missed once.
                self.client.abort();
                thread::sleep(Duration::from_millis(1));
            }
            let _ = thread.join();
        }
    }
}

impl Drop for SiteLink {
    fn drop(&mut self) {
        self.end();
    }
}

/// What ends a round of sending.
enum Stopped {
    /// May be repeated.
    ForNow(String),
    /// The site or the map does not allow it.
    ForGood(String),
}

impl From<Error> for Stopped {
    /// The map cannot be read now.
    fn from(error: Error) -> Self {
        Self::ForNow(error.to_string())
    }
}

struct Sending {
    map: PathBuf,
    robot: String,
    client: SiteClient,
    current: Option<Current>,
    /// The newest session of the robot in the map.
    newest: Option<SessionOrigin>,
    /// Sessions that have ended, here and there.
    done: BTreeSet<SessionOrigin>,
    shared: Arc<LinkState>,
    listening: Listening,
}

/// The session that is being sent.
struct Current {
    origin: SessionOrigin,
    outbox: Outbox,
    /// Number of the last acknowledged record.
    last: Option<u64>,
    ended: bool,
    /// Records that the site has not acknowledged.
    waiting: Vec<Record>,
    /// Whether the site has other records than assumed.
    is_misplaced: bool,
}

impl Sending {
    fn run(&mut self) {
        let mut pause = FIRST_PAUSE;
        while !self.is_ended() {
            let finishing = self.is_finishing();
            match self.round(finishing) {
                // What was cut short is not complete, and says nothing about the site.
                _ if self.is_ended() => return,
                Ok(()) => {
                    pause = FIRST_PAUSE;
                    self.report(|report| {
                        report.problem = None;
                        report.complete = finishing;
                    });
                    if finishing {
                        self.wait_for_place();
                        return;
                    }
                    self.wait(LOOKS_EVERY, finishing);
                }
                Err(Stopped::ForNow(problem)) => {
                    self.report(|report| report.problem = Some(problem));
                    self.wait(pause, finishing);
                    pause = LONGEST_PAUSE.min(2 * pause);
                }
                Err(Stopped::ForGood(problem)) => {
                    self.report(|report| report.problem = Some(problem));
                    return;
                }
            }
        }
    }

    /// Asks where the newest session lies in the map of the site until the site has recognised it,
    /// or has taken the robot out of its map.
    fn wait_for_place(&mut self) {
        let Some(origin) = self.newest.clone() else { return };
        let began = Instant::now();
        loop {
            let status = self.shared.report.lock().unwrap_or_else(PoisonError::into_inner).status.clone();
            let is_answered =
                status.is_none_or(|status| status.map_from_odom.is_some() || !status.state.is_merged());
            if is_answered || self.is_ended() || began.elapsed() >= RECOGNISED_WITHIN {
                return;
            }
            self.wait(ASKS_EVERY, true);
            // Everything has been sent: a site that does not answer now is no failure.
            let Ok(status) = self.client.send(&origin, &[], false) else { return };
            self.heard(status, 0);
        }
    }

    /// Sends everything that is in the map now.
    fn round(&mut self, finishing: bool) -> std::result::Result<(), Stopped> {
        if !MapFile::is_there(&self.map) {
            return Ok(());
        }
        // The file is open only while it is read, so that its writer can close it. It may be about
        // to be replaced.
        let sessions = MapFile::open_read_only(&self.map).and_then(|file| file.sessions())?;
        let own: Vec<_> = sessions
            .into_iter()
            .filter_map(|session| Some((session.origin?, session.id, session.source)))
            .filter(|(origin, ..)| origin.robot == self.robot)
            .collect();
        let newest = own.last().map(|(origin, ..)| origin.clone());
        self.newest.clone_from(&newest);
        for (origin, session, source) in own {
            // An earlier session has ended with the program that wrote it.
            let is_over = finishing || Some(&origin) != newest.as_ref();
            if self.done.contains(&origin) {
                continue;
            }
            if self.current.as_ref().is_none_or(|current| current.origin != origin) {
                self.begin(&origin, session, source)?;
            }
            while self.send_some(is_over)? {
                if self.is_ended() {
                    return Ok(());
                }
            }
            if is_over {
                self.done.insert(origin);
                self.current = None;
            }
        }
        Ok(())
    }

    /// Describes a session to the site and makes it the current one.
    fn begin(
        &mut self,
        origin: &SessionOrigin,
        session: u32,
        source: String,
    ) -> std::result::Result<(), Stopped> {
        let file = MapFile::open_read_only(&self.map)?;
        let mounted = match file.other_cameras().get(&session) {
            Some(mounted) => mounted.clone(),
            None => MountedCamera { camera: file.camera().clone(), rig: *file.rig() },
        };
        let description = SessionDescription {
            robot: origin.robot.clone(),
            key: origin.key.clone(),
            source,
            camera: mounted.camera,
            rig: mounted.rig,
        };
        let outbox = Outbox::new(&file, origin)?;
        let last_here = outbox.last_number(&file)?;
        drop(file);
        let status = self.client.describe(&description).map_err(|why| self.stopped(&why))?;
        let (mut last, mut ended) = (status.acknowledged, status.ended);
        if ended && last <= last_here {
            // The run was killed, sent, and run again: the end that the site has was none.
            (last, ended) = (last.and_then(|end| end.checked_sub(1)), false);
        }
        self.heard(status, 0);
        let (waiting, is_misplaced) = (Vec::new(), false);
        self.current = Some(Current { origin: origin.clone(), outbox, last, ended, waiting, is_misplaced });
        Ok(())
    }

    /// Sends some records of the current session. Returns whether there may be more.
    fn send_some(&mut self, is_over: bool) -> std::result::Result<bool, Stopped> {
        let Some(mut current) = self.current.take() else { return Ok(false) };
        let more = self.send_some_of(&mut current, is_over);
        // The map is read again from the last record that the site has.
        self.current = (!current.is_misplaced).then_some(current);
        more
    }

    fn send_some_of(&mut self, current: &mut Current, is_over: bool) -> std::result::Result<bool, Stopped> {
        if current.ended {
            return Ok(false);
        }
        let mut read_all = false;
        if current.waiting.is_empty() {
            let file = MapFile::open_read_only(&self.map)?;
            let records = current.outbox.next(&file, AT_ONCE)?;
            read_all = records.is_empty();
            let mut after = current.last;
            for record in records {
                if current.last.is_some_and(|last| record.number <= last) {
                    continue;
                }
                let number = record.number;
                current.waiting.push(Record::new(record, after));
                after = Some(number);
            }
            if read_all && is_over {
                let rest = current.outbox.rest(&file)?;
                current.waiting.push(Record::end(current.last, &rest));
            }
        }
        if current.waiting.is_empty() && !read_all {
            return Ok(true);
        }
        let mut body = Vec::new();
        let mut sent = 0;
        for record in &current.waiting {
            let bytes = record.to_bytes().map_err(|error| Stopped::ForGood(error.to_string()))?;
            if sent > 0 && body.len() + bytes.len() > MAX_BODY {
                break;
            }
            body.extend(bytes);
            sent += 1;
        }
        let lost = self.shared.lost.load(Ordering::Relaxed);
        // Without records this is a sign of life, and asks where the robot is.
        match self.client.send(&current.origin, &body, lost) {
            Ok(status) => {
                (current.last, current.ended) = (status.acknowledged, status.ended);
                current.waiting.drain(..sent);
                self.heard(status, sent as u64);
                Ok(!current.waiting.is_empty() || !read_all)
            }
            Err(why) => {
                if matches!(why, NoAnswer::OutOfOrder) {
                    current.is_misplaced = true;
                }
                Err(self.stopped(&why))
            }
        }
    }

    fn stopped(&self, why: &NoAnswer) -> Stopped {
        let problem = self.client.error(why).to_string();
        match why {
            NoAnswer::Unreachable(_) | NoAnswer::NotNow(_) | NoAnswer::OutOfOrder => Stopped::ForNow(problem),
            NoAnswer::Refused(_) => Stopped::ForGood(problem),
        }
    }

    fn heard(&mut self, status: SiteStatus, records: u64) {
        self.report(|report| {
            report.acknowledged += records;
            report.status = Some(status);
        });
    }

    /// Changes the report, and passes it on if that made a difference.
    fn report(&mut self, change: impl FnOnce(&mut LinkReport)) {
        let changed = {
            let mut report = self.shared.report.lock().unwrap_or_else(PoisonError::into_inner);
            let before = report.clone();
            change(&mut report);
            (*report != before).then(|| report.clone())
        };
        if let Some(report) = changed {
            (self.listening)(&report);
        }
    }

    fn is_ended(&self) -> bool {
        self.shared.ended.load(Ordering::Relaxed)
    }

    fn is_finishing(&self) -> bool {
        *self.shared.finishing.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits, but not longer than until the link is to finish or to end.
    fn wait(&self, pause: Duration, finishing: bool) {
        let known = self.shared.finishing.lock().unwrap_or_else(PoisonError::into_inner);
        let unchanged = |now: &mut bool| *now == finishing && !self.is_ended();
        drop(self.shared.changed.wait_timeout_while(known, pause, unchanged));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_site_that_cannot_be_reached_is_not_waited_for_as_one_that_answers() {
        let usual = Duration::from_secs(20);
        let silent = LinkReport { problem: Some("connection refused".into()), ..Default::default() };
        assert_eq!(silent.patience(usual), SILENT_FOR);
        assert_eq!(LinkReport { acknowledged: 1, ..silent }.patience(usual), usual);
        assert_eq!(LinkReport::default().patience(usual), usual);
    }
}
