//! A site: the records of its robots, and a thread that makes the map of them.

use crate::fleet_map::FleetMap;
use crate::protocol::{RobotState, SessionDescription, SiteStatus};
use crate::published::Published;
use crate::record::Record;
use crate::records::{NotStored, RecordStore, StoredSession};
use odograph::error::{Error, ErrorKind, Result};
use odograph::slam::SessionScale;
use odograph_map::{MapClaim, MapFile, SessionOrigin};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

/// Maximum number of records merged before their effect is published: more merge faster, fewer are
/// seen sooner.
const AT_ONCE: usize = 16;
/// Interval between two publications while records are merged.
const PUBLISHED_EVERY: Duration = Duration::from_millis(500);
/// Pause without records after which the map is optimised and written.
const SETTLED_AFTER: Duration = Duration::from_secs(1);
/// Interval of checks whether the mosaic is due, while no records arrive.
const IDLE: Duration = Duration::from_secs(5);
/// Shortest interval between two renderings of the mosaic, and the pause after one in multiples of
/// its duration: at most a tenth of a core is spent on the mosaic.
const RENDERED_EVERY: Duration = Duration::from_secs(20);
const RENDERING_REST: u32 = 9;
/// Relative difference of a robot's scale from the map's that is tolerated: about what a height
/// measured with a tape is exact to.
const TOLERATED_SCALE: f64 = 0.01;
/// A difference of scale is reported if it exceeds this many of its standard deviations: by chance
/// one in sixteen thousand does.
const CERTAIN: f64 = 4.0;

/// One map and its robots. The map is merged in a thread of its own, which ends when the site is
/// dropped.
#[derive(Debug)]
pub struct Site {
    folder: PathBuf,
    records: Mutex<RecordStore>,
    shared: Arc<SiteState>,
    merger: Mutex<Option<JoinHandle<()>>>,
}

#[derive(Debug, Default)]
struct SiteState {
    published: Mutex<Published>,
    work: Mutex<Work>,
    changed: Condvar,
    ended: AtomicBool,
}

/// What the merging thread is to do.
#[derive(Debug, Default)]
struct Work {
    records: bool,
    robots: bool,
    /// Whether everything that came before is in the map and the map is on disk.
    settled: bool,
    failed: bool,
}

/// Why a request of a robot is refused.
#[derive(Debug)]
pub enum RequestRefusal {
    /// What it sent is not acceptable.
    Malformed(Error),
    /// Its records do not follow the last one, or contradict what is stored.
    NotStored(NotStored),
}

impl Site {
    /// Opens the site in a folder, or makes it.
    ///
    /// # Errors
    /// If the folder cannot be written, if another program serves it, or if its files are damaged.
    pub fn open(folder: &Path) -> Result<Self> {
        fs::create_dir_all(folder)
            .map_err(|error| Error::output(format!("{} cannot be made: {error}", folder.display())))?;
        let claim = MapClaim::on(&folder.join("map.gpkg"))?;
        let path = folder.join("records.sqlite");
        let records = RecordStore::open(&path)?;
        let mut merger = Merger {
            records: RecordStore::open(&path)?,
            map: FleetMap::open(&claim)?,
            claim,
            sessions: BTreeMap::new(),
            sequence: 0,
            published: None,
        };
        let shared = Arc::new(SiteState::default());
        // What was acknowledged and not merged when the site ended.
        shared.lock_work().records = true;
        shared.lock_published().update(&merger.records, merger.map.as_ref())?;
        let thread = thread::Builder::new()
            .name("merging".into())
            .spawn({
                let shared = Arc::clone(&shared);
                move || {
                    if let Err(error) = merger.run(&shared) {
                        shared.lock_published().failure = Some(error.to_string());
                        shared.tell(|work| work.failed = true);
                    }
                }
            })
            .map_err(|error| Error::output(format!("the merging thread cannot be started: {error}")))?;
        let folder = folder.to_owned();
        Ok(Self { folder, records: Mutex::new(records), shared, merger: Mutex::new(Some(thread)) })
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Takes the description of a session. Returns the state of the session.
    pub(crate) fn describe(
        &self,
        description: SessionDescription,
    ) -> std::result::Result<SiteStatus, RequestRefusal> {
        let description = description.validated().map_err(RequestRefusal::Malformed)?;
        let failed = |error| RequestRefusal::NotStored(NotStored::Failed(error));
        let origin = description.origin().map_err(RequestRefusal::Malformed)?;
        let stored = {
            let mut records = self.lock_records();
            let stored = records.describe(&description).map_err(failed)?;
            (records.last(stored.id).map_err(failed)?, stored)
        };
        self.shared.tell(|work| work.records = true);
        Ok(self.status(&origin, stored.0, &stored.1))
    }

    /// Takes records of a session. When this returns they are on disk.
    pub(crate) fn take(
        &self,
        origin: &SessionOrigin,
        body: &[u8],
        lost: bool,
    ) -> std::result::Result<SiteStatus, RequestRefusal> {
        let failed = |error| RequestRefusal::NotStored(NotStored::Failed(error));
        let Some(stored) = self.lock_records().session(origin).map_err(failed)? else {
            return Err(RequestRefusal::NotStored(NotStored::Unknown));
        };
        let parts = Record::split(body).map_err(RequestRefusal::Malformed)?;
        let mut records = Vec::with_capacity(parts.len());
        let camera = &stored.description.camera;
        for bytes in parts {
            let record = Record::from_bytes(bytes).map_err(RequestRefusal::Malformed)?;
            if let Some(image) = &record.image {
                // An image that cannot be decoded would otherwise be found out after it was
                // acknowledged.
                image.decode((camera.width(), camera.height())).map_err(|why| {
                    RequestRefusal::Malformed(Error::input(format!(
                        "the image of keyframe {} {why}",
                        record.head.number
                    )))
                })?;
            }
            records.push((record, bytes));
        }
        let (last, stored) = {
            let mut store = self.lock_records();
            store.append(stored.id, &records).map_err(RequestRefusal::NotStored)?;
            let stored = store.session(origin).map_err(failed)?.unwrap_or(stored);
            (store.last(stored.id).map_err(failed)?, stored)
        };
        self.shared.lock_published().heard(origin, lost);
        if !records.is_empty() {
            self.shared.tell(|work| work.records = true);
        }
        Ok(self.status(origin, last, &stored))
    }

    fn status(&self, origin: &SessionOrigin, last: Option<u64>, stored: &StoredSession) -> SiteStatus {
        let status = self.shared.lock_published().status(origin);
        SiteStatus { acknowledged: last, ended: stored.ended, ..status }
    }

    /// Removes the records of a robot from the map, or adds them again. Returns whether there is
    /// such a robot.
    ///
    /// # Errors
    /// If the decision cannot be stored.
    pub fn set_robot(&self, name: &str, state: RobotState) -> Result<bool> {
        let reason = match state {
            RobotState::Active | RobotState::Trusted => None,
            RobotState::Quarantined => Some("by hand"),
            RobotState::Withdrawn => Some("withdrawn by hand"),
        };
        let known = self.lock_records().set_robot(name, state, reason)?;
        if known {
            self.shared.tell(|work| work.robots = true);
        }
        Ok(known)
    }

    /// Everything for the page.
    pub fn page(&self) -> Value {
        self.shared.lock_published().page()
    }

    /// The mosaic with its placement; `None` if there is none.
    ///
    /// # Errors
    /// If the map cannot be read.
    pub fn mosaic(&self, most_pixels: usize) -> Result<Option<odograph::mosaic::MosaicPicture>> {
        let path = self.folder.join("map.gpkg");
        if !MapFile::is_there(&path) {
            return Ok(None);
        }
        MapFile::open_read_only(&path)?.mosaic_picture(most_pixels)
    }

    /// Ends merging and closes the map, so that another program may serve the site. What is
    /// acknowledged after that is merged by that one.
    pub fn close(&self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        self.shared.tell(|_| {});
        let merger = self.merger.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(merger) = merger {
            let _ = merger.join();
        }
    }

    /// Waits until everything that was acknowledged or decided is in the map, and the map is on
    /// disk, or until merging has failed.
    pub fn wait_until_settled(&self) {
        let work = self.shared.lock_work();
        let unsettled = |work: &mut Work| !work.failed && (!work.settled || work.records || work.robots);
        drop(self.shared.changed.wait_while(work, unsettled));
    }

    fn lock_records(&self) -> MutexGuard<'_, RecordStore> {
        self.records.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Site {
    fn drop(&mut self) {
        self.close();
    }
}

impl SiteState {
    fn lock_published(&self) -> MutexGuard<'_, Published> {
        self.published.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn lock_work(&self) -> MutexGuard<'_, Work> {
        self.work.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn tell(&self, change: impl FnOnce(&mut Work)) {
        {
            let mut work = self.lock_work();
            change(&mut work);
            work.settled &= !work.records && !work.robots;
        }
        self.changed.notify_all();
    }

    fn is_ended(&self) -> bool {
        self.ended.load(Ordering::Relaxed)
    }

    /// Waits for work, or for `patience`.
    fn work(&self, patience: Duration) -> Work {
        let work = self.lock_work();
        let idle = |work: &mut Work| !work.records && !work.robots && !self.is_ended();
        let (mut work, _) =
            self.changed.wait_timeout_while(work, patience, idle).unwrap_or_else(PoisonError::into_inner);
        let taken = Work { records: work.records, robots: work.robots, ..Work::default() };
        (work.records, work.robots) = (false, false);
        taken
    }

    /// Marks all work as done, except what was requested meanwhile.
    fn set_settled(&self) {
        self.tell(|work| work.settled = true);
    }
}

/// Merges records into the map.
struct Merger {
    records: RecordStore,
    map: Option<FleetMap>,
    claim: MapClaim,
    sessions: BTreeMap<i64, StoredSession>,
    /// Sequence number up to which all records of active robots are in the map.
    sequence: i64,
    /// When the state was published last.
    published: Option<Instant>,
}

impl Merger {
    fn run(&mut self, shared: &SiteState) -> Result<()> {
        let (mut unsettled, mut unrendered) = (false, false);
        let (mut rendered, mut rest) = (None::<Instant>, RENDERED_EVERY);
        // Robots that were withdrawn when the site ended before it could take them out.
        self.take_out_inactive()?;
        while !shared.is_ended() {
            if !unsettled {
                shared.set_settled();
            }
            let work = shared.work(if unsettled { SETTLED_AFTER } else { IDLE });
            if work.robots {
                (unsettled, unrendered) = (true, true);
                // Records of a robot that is active again are among the old ones.
                self.sequence = 0;
                self.take_out_inactive()?;
                self.publish(shared)?;
            }
            let mut merged = true;
            while (work.records || work.robots) && merged && !shared.is_ended() {
                merged = self.merge_some(shared)?;
                (unsettled, unrendered) = (unsettled | merged, unrendered | merged);
            }
            if work.records || work.robots {
                self.publish(shared)?;
                continue;
            }
            let Some(map) = &mut self.map else { continue };
            if unsettled {
                map.settle()?;
                unsettled = false;
                self.publish(shared)?;
            } else if unrendered && rendered.is_none_or(|at| at.elapsed() >= rest) {
                let begun = Instant::now();
                if map.render(&mut || !shared.is_ended())? {
                    unrendered = false;
                    shared.lock_published().mosaic += 1;
                }
                rest = RENDERED_EVERY.max(RENDERING_REST * begun.elapsed());
                rendered = Some(Instant::now());
            }
        }
        match self.map.take() {
            Some(mut map) => {
                if unsettled {
                    map.settle()?;
                }
                map.close()
            }
            None => Ok(()),
        }
    }

    /// Merges the next records. Returns whether there were any.
    fn merge_some(&mut self, shared: &SiteState) -> Result<bool> {
        let next = self.records.after(self.sequence, 64 * AT_ONCE)?;
        let active: BTreeMap<String, RobotState> =
            self.records.robots()?.into_iter().map(|(name, state, _)| (name, state)).collect();
        let mut merged = 0;
        for &(sequence, session, number) in &next {
            if merged == AT_ONCE || shared.is_ended() {
                break;
            }
            self.sequence = sequence;
            let Some(stored) = self.session(session)? else { continue };
            let description = stored.description.clone();
            let origin = description.origin()?;
            let is_active = active.get(&origin.robot).is_none_or(|state| state.is_merged());
            let known = self.map.as_ref().and_then(|map| map.session(&origin)?.last());
            // The end of a session has no keyframe: its edges are compared with those of the map.
            let is_known = known.is_some_and(|known| number <= known);
            if !is_active || is_known {
                continue;
            }
            let record = self.records.record(sequence)?;
            let map = match &mut self.map {
                Some(map) => map,
                none => none.insert(FleetMap::create(&self.claim, &description)?),
            };
            merged += 1;
            match map.add(&description, record) {
                // The disk may have room again when the site is started again.
                Err(error) if error.kind() == ErrorKind::Output => return Err(error),
                Err(error) => {
                    let reason = format!("record {number} of session {} cannot be used: {error}", origin.key);
                    self.records.set_robot(&origin.robot, RobotState::Quarantined, Some(&reason))?;
                    self.take_out_inactive()?;
                    break;
                }
                Ok(()) => {}
            }
            if self.quarantine_doubtful()? {
                break;
            }
        }
        if merged > 0 {
            let version = self.records.version()?;
            self.records.set_version(version + merged as u64)?;
            if self.published.is_none_or(|at| at.elapsed() >= PUBLISHED_EVERY) {
                self.publish(shared)?;
            }
        }
        Ok(!next.is_empty())
    }

    fn session(&mut self, id: i64) -> Result<Option<&StoredSession>> {
        if !self.sessions.contains_key(&id) {
            self.sessions = self.records.sessions()?.into_iter().map(|stored| (stored.id, stored)).collect();
        }
        Ok(self.sessions.get(&id))
    }

    /// Removes a robot from the map whose scale differs from the map's. Returns whether there
    /// was one.
    fn quarantine_doubtful(&mut self) -> Result<bool> {
        let Some(map) = &self.map else { return Ok(false) };
        let robots = self.records.robots()?;
        let doubtful = self.sessions.values().find_map(|stored| {
            let origin = stored.description.origin().ok()?;
            let scale = map.scale(map.session(&origin)?).filter(is_doubtful)?;
            let trusted = |(name, state, _): &(String, RobotState, _)| {
                *name == origin.robot && *state == RobotState::Trusted
            };
            if robots.iter().any(trusted) {
                return None;
            }
            Some((origin.robot, reason(&stored.description, &scale)))
        });
        let Some((robot, reason)) = doubtful else { return Ok(false) };
        self.records.set_robot(&robot, RobotState::Quarantined, Some(&reason))?;
        self.take_out_inactive()
    }

    /// Removes the robots that are not active from the map. Returns whether there was anything of
    /// them.
    fn take_out_inactive(&mut self) -> Result<bool> {
        let Some(map) = self.map.take() else { return Ok(false) };
        let robots = self.records.robots()?;
        let inactive = |origin: &SessionOrigin| {
            robots.iter().any(|(name, state, _)| *name == origin.robot && !state.is_merged())
        };
        let (map, any) = map.remove(inactive)?;
        self.map = Some(map);
        if any {
            let version = self.records.version()?;
            self.records.set_version(version + 1)?;
        }
        Ok(any)
    }

    fn publish(&mut self, shared: &SiteState) -> Result<()> {
        self.published = Some(Instant::now());
        shared.lock_published().update(&self.records, self.map.as_ref())
    }
}

/// Whether the metres of a session certainly differ from those of the map.
fn is_doubtful(scale: &SessionScale) -> bool {
    let off = (scale.ratio - 1.0).abs();
    off > TOLERATED_SCALE && off - TOLERATED_SCALE > CERTAIN * scale.deviation
}

fn reason(description: &SessionDescription, scale: &SessionScale) -> String {
    let told_m = description.rig.height_m;
    format!(
        "its metres are {:.3} ± {:.3} of the map's, as seen at {} places: with a height of {:.3} m in place of {:.3} m, \
         or a focal length in the same ratio, they would agree",
        1.0 / scale.ratio,
        scale.deviation,
        scale.places,
        scale.ratio * told_m,
        told_m
    )
}
