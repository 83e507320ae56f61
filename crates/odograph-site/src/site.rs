//! A site: the records of its robots, and a thread that makes the map of them.

use crate::merging::{self, Merger, SiteState, Work};
use crate::protocol::{RobotState, SessionDescription, SiteStatus};
use crate::record::Record;
use crate::records::{NotStored, RecordStore, StoredSession};
use odograph::error::{Error, Result};
use odograph_map::{MapClaim, MapFile, SessionOrigin};
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};

/// One map and its robots. The map is merged in a thread of its own, which ends when the site is
/// dropped.
#[derive(Debug)]
pub struct Site {
    folder: PathBuf,
    records: Mutex<RecordStore>,
    shared: Arc<SiteState>,
    merger: Mutex<Option<JoinHandle<()>>>,
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
        // The map of a site is made of its records.
        if MapFile::is_there(claim.path()) && !path.exists() {
            return Err(Error::input(format!(
                "{} has the map of a run, and no records of a site; give an empty folder, and send the map to the \
                 site with odograph site send",
                folder.display()
            )));
        }
        let records = RecordStore::open(&path)?;
        let merger = Merger::open(&path, claim)?;
        let shared = Arc::new(SiteState::default());
        // What was acknowledged and not merged when the site ended.
        shared.lock_work().records = true;
        merger.show(&shared)?;
        let thread = thread::Builder::new()
            .name("merging".into())
            .spawn({
                let shared = Arc::clone(&shared);
                move || merging::merge(merger, &path, &shared)
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
        let (last, stored) = {
            let mut records = self.lock_records();
            let stored = records.describe(&description).map_err(failed)?;
            (records.last(stored.id).map_err(failed)?, stored)
        };
        self.shared.tell(|work| work.records = true);
        Ok(self.status(&origin, last, &stored))
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
            record.check_motions(camera, &stored.description.rig).map_err(RequestRefusal::Malformed)?;
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

    /// Why nothing is merged; `None` while all is well. What robots send is still stored, and
    /// merged when that is put right.
    pub fn failure(&self) -> Option<String> {
        self.shared.lock_published().failure.clone()
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
