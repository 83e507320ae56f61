//! The thread that merges the records of a site into its map.

use crate::fleet_map::FleetMap;
use crate::protocol::{RobotState, SessionDescription};
use crate::published::Published;
use crate::records::{RecordStore, StoredSession};
use odograph::error::{Error, ErrorKind, Result};
use odograph::slam::SessionScale;
use odograph_map::{MapClaim, SessionOrigin};
use std::collections::BTreeMap;
use std::panic::{self, AssertUnwindSafe};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
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

/// Pause after a failure before merging is tried again, unless a person decides about a robot: a
/// disk gets room by hand, and opening a map of ten thousand keyframes takes a second or two.
const RETRIED_AFTER: Duration = Duration::from_secs(10);

/// What the merging thread shares with those that answer requests.
#[derive(Debug, Default)]
pub struct SiteState {
    pub published: Mutex<Published>,
    pub work: Mutex<Work>,
    pub changed: Condvar,
    pub ended: AtomicBool,
}

/// What the merging thread is to do.
#[derive(Debug, Default)]
pub struct Work {
    pub records: bool,
    pub robots: bool,
    /// Whether everything that came before is in the map and the map is on disk.
    pub settled: bool,
    pub failed: bool,
}

impl SiteState {
    pub fn lock_published(&self) -> MutexGuard<'_, Published> {
        self.published.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn lock_work(&self) -> MutexGuard<'_, Work> {
        self.work.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn tell(&self, change: impl FnOnce(&mut Work)) {
        {
            let mut work = self.lock_work();
            change(&mut work);
            work.settled &= !work.records && !work.robots;
        }
        self.changed.notify_all();
    }

    fn has_failed(&self) -> bool {
        self.lock_published().failure.is_some()
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

    /// Says that merging has failed.
    fn fail(&self, failure: String) {
        self.lock_published().failure = Some(failure);
        self.tell(|work| work.failed = true);
    }

    /// Says that merging goes on after a failure.
    fn recover(&self) {
        if self.lock_published().failure.take().is_some() {
            self.tell(|work| work.failed = false);
        }
    }

    /// Waits until merging is to be tried again, or the site ends. Returns whether it is.
    fn wait_to_retry(&self) -> bool {
        let work = self.lock_work();
        let idle = |work: &mut Work| !work.robots && !self.is_ended();
        let (mut work, _) = self
            .changed
            .wait_timeout_while(work, RETRIED_AFTER, idle)
            .unwrap_or_else(PoisonError::into_inner);
        // What is opened again heeds all decisions.
        work.robots = false;
        !self.is_ended()
    }
}

/// Merges until the site ends. What fails with an error, such as a full disk, is tried again, with
/// map and records opened anew; a defect of the program would come back.
pub fn merge(mut merger: Merger, records: &Path, shared: &SiteState) {
    let claim = merger.claim.clone();
    while let Some(failure) = failure_of(|| merger.run(shared)) {
        let retried_s = RETRIED_AFTER.as_secs();
        match failure {
            MergingFailure::Defect(text) => {
                return shared.fail(format!("a defect of the program: {text}; start the site again"));
            }
            MergingFailure::Error(error) => {
                shared.fail(format!("{error}; it is tried again every {retried_s} s"));
            }
        }
        drop(merger);
        merger = loop {
            if !shared.wait_to_retry() {
                return;
            }
            match Merger::open(records, claim.clone()) {
                Ok(opened) => break opened,
                Err(error) => shared.fail(format!("{error}; it is tried again every {retried_s} s")),
            }
        };
        shared.tell(|work| work.records = true);
    }
}

/// Why merging stopped.
#[derive(Debug)]
enum MergingFailure {
    /// A full disk, for example.
    Error(Error),
    /// A panic.
    Defect(String),
}

/// Why merging ended, if it did not because it was asked to. A panic is a reason, too: nobody may
/// wait for what is not merged any more.
fn failure_of(merging: impl FnOnce() -> Result<()>) -> Option<MergingFailure> {
    // Nothing that the closure was changing is used afterwards.
    match panic::catch_unwind(AssertUnwindSafe(merging)) {
        Ok(ended) => ended.err().map(MergingFailure::Error),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no reason given");
            Some(MergingFailure::Defect(text.to_owned()))
        }
    }
}

/// Merges records into the map.
pub struct Merger {
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
    /// Opens records and map. Fails if they cannot be read or written.
    pub fn open(records: &Path, claim: MapClaim) -> Result<Self> {
        Ok(Self {
            records: RecordStore::open(records)?,
            map: FleetMap::open(&claim)?,
            claim,
            sessions: BTreeMap::new(),
            sequence: 0,
            published: None,
        })
    }

    pub fn run(&mut self, shared: &SiteState) -> Result<()> {
        // A map that is there may be older than the records, and its mosaic older than the map.
        let (mut unsettled, mut unrendered) = (shared.has_failed(), self.map.is_some());
        let (mut rendered, mut rest) = (None::<Instant>, RENDERED_EVERY);
        // Robots that were withdrawn when the site ended before it could take them out.
        self.take_out_inactive()?;
        while !shared.is_ended() {
            if !unsettled {
                // Except for what was requested meanwhile.
                shared.tell(|work| work.settled = true);
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
            let Some(map) = &mut self.map else {
                unsettled = false;
                continue;
            };
            if unsettled {
                map.settle()?;
                unsettled = false;
                shared.recover();
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
            merged += 1;
            match self.merge(&description, sequence) {
                // The disk may have room again.
                Err(error) if error.kind() == ErrorKind::Output => return Err(error),
                // What the record itself is: the other robots are merged without it.
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
            shared.recover();
            self.records.advance_version(merged as u64)?;
            if self.published.is_none_or(|at| at.elapsed() >= PUBLISHED_EVERY) {
                self.publish(shared)?;
            }
        }
        Ok(!next.is_empty())
    }

    /// Merges a record. An error that is not of the kind `Output` is of the record.
    fn merge(&mut self, description: &SessionDescription, sequence: i64) -> Result<()> {
        let record = self.records.record(sequence)?;
        let map = match &mut self.map {
            Some(map) => map,
            none => none.insert(
                // Not the record: where no map can be made, that of no robot can.
                FleetMap::create(&self.claim, description)
                    .map_err(|error| Error::output(error.to_string()).caused_by(error))?,
            ),
        };
        map.add(description, record)
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
            let scale = map.scale(map.session(&origin)?).filter(SessionScale::is_doubtful)?;
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
            self.records.advance_version(1)?;
        }
        Ok(any)
    }

    fn publish(&mut self, shared: &SiteState) -> Result<()> {
        self.published = Some(Instant::now());
        self.show(shared)
    }

    /// Shows the state of store and map without counting as a publication.
    pub fn show(&self, shared: &SiteState) -> Result<()> {
        shared.lock_published().update(&self.records, self.map.as_ref())
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_of_the_merging_is_a_failure_of_the_site() {
        let said = |merging: fn() -> Result<()>| match failure_of(merging) {
            Some(MergingFailure::Error(error)) => error.to_string(),
            Some(MergingFailure::Defect(text)) => format!("a defect: {text}"),
            None => String::new(),
        };
        assert_eq!(said(|| Ok(())), "");
        assert_eq!(said(|| Err(Error::output("the disk is full"))), "the disk is full");
        assert_eq!(said(|| panic!("keyframe {}", 3)), "a defect: keyframe 3");
    }
}
