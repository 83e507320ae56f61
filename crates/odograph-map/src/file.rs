//! The map file: create, open, check, close.

use crate::claim::{self, MapClaim};
use crate::complaint::{Complaint, WithContext};
use crate::origin::{self, SessionOrigin};
use crate::row_order::in_order;
use crate::thinning::{Thinning, thinning};
use crate::{cameras, losses, masks, schema};
use odograph::camera::{Camera, Rig};
use odograph::error::{Error, Result};
use odograph::fixed_pattern::ImageMask;
use odograph::ground_map::{GroundMap, KeyframeImages, MountedCamera};
use odograph::keyframe::KeyframeId;
use odograph::trajectory::LostStretch;
use rusqlite::config::DbConfig;
use rusqlite::limits::Limit;
use rusqlite::{Connection, ErrorCode, OpenFlags, Transaction, params};
use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};

/// Largest value that is read from a map, bytes: bounds memory for damaged or hostile files.
const LARGEST_VALUE: i32 = 256 << 20;
/// Number of 4 KiB pages in the write-ahead log at which SQLite copies it into the file: more make
/// writes rarer and the log larger (8 MB).
const PAGES_IN_LOG: i64 = 2000;

/// One of the runs that made a map.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Session {
    /// Index of the session, from 0.
    pub id: u32,
    /// Source of the run: a file, folder or stream.
    pub source: String,
    /// The robot that recorded it, if it has a name.
    pub origin: Option<SessionOrigin>,
}

/// A map file.
///
/// While it is open for writing, a write-ahead log (`-wal`), its index (`-shm`) and a lock file
/// (`.lock`) are beside it; [`MapFile::close`] merges the log and removes them. The log survives a
/// crash of the program: the next program that opens the file recovers it.
#[derive(Debug)]
pub struct MapFile {
    pub(crate) connection: Connection,
    pub(crate) complaint: Complaint,
    path: PathBuf,
    camera: Camera,
    rig: Rig,
    other_cameras: BTreeMap<u32, MountedCamera>,
    /// Of each session of a named robot that was begun here: the id of its keyframe number 0.
    pub(crate) numbered_from: BTreeMap<u32, u64>,
    /// Held while the map is open for writing. Declared after the connection, so that the
    /// connection is dropped first.
    claim: Option<MapClaim>,
}

impl MapFile {
    /// Creates a map for the given camera and mounting.
    ///
    /// Fails if there is a map already ([`MapFile::remove`] deletes one), if another program is
    /// creating it, or if the file cannot be written.
    pub fn create(path: &Path, camera: &Camera, rig: &Rig) -> Result<Self> {
        check_free(path)?;
        Self::create_claimed(MapClaim::on(path)?, camera, rig)
    }

    /// As [`MapFile::create`], with a lock acquired before. An unfinished map of a program that was
    /// killed while creating it is replaced.
    pub fn create_claimed(claim: MapClaim, camera: &Camera, rig: &Rig) -> Result<Self> {
        let path = claim.path().to_owned();
        check_free(&path)?;
        claim.remove_map()?;
        let complaint = Complaint::about(&path);
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE
            | OpenFlags::SQLITE_OPEN_CREATE
            | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let mut connection = Connection::open_with_flags(&path, flags).while_writing(&complaint)?;
        let made = (|| {
            prepare(&connection)?;
            write_ahead(&connection)?;
            // One transaction: a program killed here leaves an empty database, not an incomplete
            // map.
            let transaction = connection.transaction()?;
            schema::make(&transaction)?;
            cameras::write_first(&transaction, camera, rig)?;
            transaction.commit()
        })();
        if let Err(failure) = made {
            drop(connection);
            let _ = claim.remove_map();
            return Err(complaint.writing(&failure));
        }
        let (camera, numbered_from) = (camera.clone(), BTreeMap::new());
        let other_cameras = BTreeMap::new();
        let claim = Some(claim);
        Ok(Self { connection, complaint, path, camera, rig: *rig, other_cameras, numbered_from, claim })
    }

    /// Opens a map to continue it. Fails, with one sentence, if the file is not a complete map of
    /// this version, or if another program is writing it.
    pub fn open(path: &Path) -> Result<Self> {
        schema::check_bytes(path)?;
        Self::open_claimed(MapClaim::on(path)?)
    }

    /// As [`MapFile::open`], with a lock acquired before.
    pub fn open_claimed(claim: MapClaim) -> Result<Self> {
        let path = claim.path().to_owned();
        Self::opened(&path, Some(claim))
    }

    /// Opens a map for reading only; the file is not changed. Another program may write it at the
    /// same time.
    pub fn open_read_only(path: &Path) -> Result<Self> {
        Self::opened(path, None)
    }

    /// Whether there is a map to continue, or any other file that must not be overwritten. False
    /// for what a program leaves that was killed while creating a map: an empty file, or a database
    /// without tables.
    pub fn is_there(path: &Path) -> bool {
        path.exists() && !schema::is_unfinished(path)
    }

    fn opened(path: &Path, claim: Option<MapClaim>) -> Result<Self> {
        schema::check_bytes(path)?;
        let complaint = Complaint::about(path);
        let writable = claim.is_some();
        let access =
            if writable { OpenFlags::SQLITE_OPEN_READ_WRITE } else { OpenFlags::SQLITE_OPEN_READ_ONLY };
        let connection = Connection::open_with_flags(path, access | OpenFlags::SQLITE_OPEN_NO_MUTEX)
            .while_reading(&complaint)?;
        prepare(&connection).while_reading(&complaint)?;
        schema::check(&connection, path)?;
        if writable {
            schema::check_writable(&connection, path)?;
            write_ahead(&connection).while_writing(&complaint)?;
        }
        Self::with_cameras(connection, complaint, path, claim)
    }

    /// The file behind a connection; reads its cameras.
    fn with_cameras(
        connection: Connection,
        complaint: Complaint,
        path: &Path,
        claim: Option<MapClaim>,
    ) -> Result<Self> {
        let (camera, rig) = cameras::read_first(&connection, &complaint)?;
        let other_cameras = cameras::read_of_sessions(&connection, &complaint)?;
        let (path, numbered_from) = (path.to_owned(), BTreeMap::new());
        Ok(Self { connection, complaint, path, camera, rig, other_cameras, numbered_from, claim })
    }

    /// Opens a damaged map to save what can be read of it: neither its length nor its tables are
    /// checked, and everything but camera and mounting may be unreadable.
    pub(crate) fn open_damaged(path: &Path) -> Result<Self> {
        let complaint = Complaint::about(path);
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let connection = Connection::open_with_flags(path, flags).while_reading(&complaint)?;
        prepare(&connection)
            // Without this SQLite reads nothing of a file that was cut off. Nothing is written: the
            // connection is read-only.
            .and_then(|()| connection.set_db_config(DbConfig::SQLITE_DBCONFIG_DEFENSIVE, false))
            .and_then(|_| connection.pragma_update(None, "writable_schema", true))
            .while_reading(&complaint)?;
        Self::with_cameras(connection, complaint, path, None)
    }

    /// Deletes a map with its write-ahead log. Succeeds if there is none; fails if another program
    /// is writing it.
    pub fn remove(path: &Path) -> Result<()> {
        if claim::leaves_anything(path) { MapClaim::on(path)?.remove_map() } else { Ok(()) }
    }

    /// Renames the finished map `new` over the one that `claim` is on, if there is one. A program
    /// that is killed meanwhile leaves the old map or the new one. If this fails, `new` is removed.
    pub fn replace(claim: &MapClaim, new: &Path) -> Result<()> {
        // The log of the old map would be taken for one of the new map, and without its log the old
        // map lacks its last keyframes: it is merged first. A file that is no map has none.
        if Self::is_there(claim.path()) {
            let _ = Self::open_claimed(claim.clone()).and_then(Self::close);
        }
        let replaced = claim.remove_beside().and_then(|()| {
            File::open(new)
                .and_then(|file| file.sync_all())
                .and_then(|()| std::fs::rename(new, claim.path()))
                .map_err(|error| Error::not_written(claim.path().display(), error))
        });
        replaced.inspect_err(|_| {
            let _ = Self::remove(new);
        })
    }

    /// Writes the whole map, compacted, to a new file. Fails if the file exists or cannot be
    /// written.
    pub fn copy_to(&self, path: &Path) -> Result<()> {
        let complaint = Complaint::about(path);
        let Some(name) = path.to_str() else {
            return Err(complaint.usage("the name is not UTF-8 text; choose another"));
        };
        let claim = MapClaim::on(path)?;
        if path.exists() {
            return Err(complaint.usage("there is a file already; choose another name"));
        }
        let written = self.connection.execute("VACUUM INTO ?1", [name]);
        if let Err(failure) = written {
            let _ = claim.remove_map();
            return Err(complaint.writing(&failure));
        }
        Ok(())
    }

    /// Path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Camera of the first session, and of every one that is not in [`MapFile::other_cameras`].
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// Mounting of the camera at the start of the first session.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// The sessions that were made with another camera or mount than the first, by session.
    pub fn other_cameras(&self) -> &BTreeMap<u32, MountedCamera> {
        &self.other_cameras
    }

    /// The camera of a session.
    pub fn camera_of(&self, session: u32) -> &Camera {
        self.other_cameras.get(&session).map_or(&self.camera, |other| &other.camera)
    }

    /// Reads the map without its images. Fails if anything in it is invalid, such as a number that
    /// is not finite or an edge to a missing keyframe.
    pub fn map(&self) -> Result<GroundMap> {
        // One read transaction: keyframes and edges of the same state, even if another program is
        // writing.
        let _moment = self.connection.unchecked_transaction().while_reading(&self.complaint)?;
        Ok(GroundMap {
            camera: self.camera.clone(),
            rig: self.rig,
            other_cameras: self.other_cameras.clone(),
            masks: masks::read(&self.connection, &self.complaint, |session| self.camera_of(session))?,
            keyframes: self.keyframes()?,
            edges: self.edges()?,
        })
    }

    /// Starts a session of the map's camera with this source; returns its index.
    pub fn begin_session(&mut self, source: &str) -> Result<u32> {
        self.new_session(source, None, &|_, _| Ok(()))
    }

    /// Starts a session of a camera that need not be that of the first session.
    pub fn begin_session_with(&mut self, source: &str, mounted: &MountedCamera) -> Result<u32> {
        self.new_session(source, Some(mounted), &|_, _| Ok(()))
    }

    /// The cameras of the sessions with their mounts, the newest session's first.
    pub fn mounted_cameras(&self) -> Result<Vec<MountedCamera>> {
        let first = || MountedCamera { camera: self.camera.clone(), rig: self.rig };
        let of = |session: Session| self.other_cameras.get(&session.id).cloned().unwrap_or_else(first);
        let cameras: Vec<_> = self.sessions()?.into_iter().rev().map(of).collect();
        Ok(if cameras.is_empty() { vec![first()] } else { cameras })
    }

    /// Starts a session of a robot. Its keyframes are numbered from 0 in the order in which they
    /// are added. Fails if the origin is invalid, or if the session cannot be written.
    pub fn begin_session_by(
        &mut self,
        origin: &SessionOrigin,
        source: &str,
        mounted: Option<&MountedCamera>,
    ) -> Result<u32> {
        let origin = origin.clone().validated()?;
        let first = self.next_keyframe()?.0;
        let id =
            self.new_session(source, mounted, &|transaction, id| origin::write(transaction, id, &origin))?;
        self.numbered_from.insert(id, first);
        Ok(id)
    }

    /// Starts a session that another map has too, with the camera that it was made with. Numbers
    /// of its keyframes are given with them ([`MapFile::add_numbered_keyframe`]).
    pub fn begin_session_of(
        &mut self,
        origin: &SessionOrigin,
        source: &str,
        mounted: &MountedCamera,
    ) -> Result<u32> {
        let origin = origin.clone().validated()?;
        self.new_session(source, Some(mounted), &|transaction, id| origin::write(transaction, id, &origin))
    }

    fn new_session(
        &mut self,
        source: &str,
        mounted: Option<&MountedCamera>,
        named: &dyn Fn(&Transaction<'_>, u32) -> rusqlite::Result<()>,
    ) -> Result<u32> {
        let other =
            mounted.filter(|mounted| mounted.camera != self.camera || mounted.rig != self.rig).cloned();
        let transaction = self.connection.transaction().while_writing(&self.complaint)?;
        let id: u32 = transaction
            .query_row("SELECT ifnull(max(id) + 1, 0) FROM odograph_session", [], |row| row.get(0))
            .while_reading(&self.complaint)?;
        (|| {
            transaction.execute("INSERT INTO odograph_session VALUES (?1, ?2)", params![id, source])?;
            if let Some(other) = &other {
                cameras::write_of_session(&transaction, id, other)?;
            }
            named(&transaction, id)?;
            transaction.commit()
        })()
        .while_writing(&self.complaint)?;
        if let Some(other) = other {
            self.other_cameras.insert(id, other);
        }
        Ok(id)
    }

    /// Sets what of a session's images is not ground; `None` where all of it is.
    pub fn set_mask(&mut self, session: u32, mask: Option<&ImageMask>) -> Result<()> {
        let transaction = self.connection.transaction().while_writing(&self.complaint)?;
        masks::write(&transaction, session, mask, &self.complaint)?;
        transaction.commit().while_writing(&self.complaint)
    }

    /// Replaces the losses of a session by these, in order; times are those of its frames.
    ///
    /// # Errors
    /// If they cannot be written.
    pub fn set_losses(&mut self, session: u32, stretches: &[LostStretch]) -> Result<()> {
        let transaction = self.connection.transaction().while_writing(&self.complaint)?;
        losses::write(&transaction, session, stretches).while_writing(&self.complaint)?;
        transaction.commit().while_writing(&self.complaint)
    }

    /// The losses of a session in order; empty if none are stored.
    ///
    /// # Errors
    /// If they cannot be read, or cannot be losses.
    pub fn losses_of(&self, session: u32) -> Result<Vec<LostStretch>> {
        losses::read(&self.connection, session, &self.complaint)
    }

    /// Removes a session with its keyframes, their edges and its path. The mosaic is not changed.
    pub fn remove_session(&mut self, session: u32) -> Result<()> {
        let own = self.keyframes()?.into_iter().filter(|keyframe| keyframe.session == session);
        let own: Vec<KeyframeId> = own.map(|keyframe| keyframe.id).collect();
        self.remove_keyframes(&own, &[])?;
        self.set_path(session, &[])?;
        let remove = |connection: &Connection| {
            cameras::remove_of_session(connection, session)?;
            masks::remove(connection, session)?;
            losses::write(connection, session, &[])?;
            origin::remove_session(connection, session)?;
            connection.execute("DELETE FROM odograph_session WHERE id = ?1", [session])
        };
        remove(&self.connection).while_writing(&self.complaint)?;
        self.other_cameras.remove(&session);
        self.numbered_from.remove(&session);
        Ok(())
    }

    /// The sessions in order.
    pub fn sessions(&self) -> Result<Vec<Session>> {
        let mut origins = origin::read(&self.connection, &self.complaint)?;
        let mut statement = self
            .connection
            .prepare("SELECT id, source FROM odograph_session ORDER BY id")
            .while_reading(&self.complaint)?;
        let rows = statement
            .query_map([], in_order(|row| Ok((row.get(0)?, row.get(1)?))))
            .while_reading(&self.complaint)?;
        rows.map(|row| {
            let (id, source): (u32, String) = row.while_reading(&self.complaint)?;
            Ok(Session { id, source, origin: origins.remove(&id) })
        })
        .collect()
    }

    /// Checks the whole file for damage (`PRAGMA integrity_check`; slow on a large map), then reads
    /// the map, every image and every tile of the mosaic.
    pub fn check(&mut self) -> Result<()> {
        let found: String = self
            .connection
            .query_row("PRAGMA integrity_check(1)", [], |row| row.get(0))
            .while_reading(&self.complaint)?;
        if found != "ok" {
            return Err(self.complaint.damage(format!("the file is damaged: {}", found.replace('\n', " "))));
        }
        for keyframe in self.map()?.keyframes {
            self.load(keyframe.id)?;
        }
        let levels = self.mosaic()?.map_or(0..0, |layer| 0..layer.finest + 1);
        for level in levels {
            for (column, row) in self.mosaic_tiles(level)? {
                self.mosaic_tile(level, column, row)?;
            }
        }
        for session in self.sessions()? {
            self.losses_of(session.id)?;
        }
        self.markers().map(drop)
    }

    /// Removes redundant keyframes until at most `most_keyframes` are left, and composes the edges
    /// through removed keyframes. Their markers are those of a neighbour then.
    pub fn thin(&mut self, most_keyframes: usize) -> Result<Thinning> {
        let thinning = thinning(&self.map()?, most_keyframes);
        let mut markers = self.markers()?;
        thinning.hand_over(&mut markers);
        let markers = (!markers.is_empty()).then_some(markers.as_slice());
        self.remove_and_keep(&thinning.gone, &thinning.edges, markers)?;
        Ok(thinning)
    }

    /// Rewrites the file without the free space of removed data.
    pub fn compact(&mut self) -> Result<()> {
        self.connection
            .execute_batch("VACUUM; PRAGMA wal_checkpoint(TRUNCATE);")
            .while_writing(&self.complaint)
    }

    /// Merges the write-ahead log into the file, so that the map is a single file again. Dropping a
    /// map does the same but ignores errors; then the log stays beside the file and nothing is
    /// lost.
    pub fn close(mut self) -> Result<()> {
        self.fold().while_writing(&self.complaint)
    }

    fn fold(&mut self) -> rusqlite::Result<()> {
        if self.claim.is_none() {
            return Ok(());
        }
        self.connection.flush_prepared_statement_cache();
        // Leaving WAL mode checkpoints the log and removes it.
        match self.connection.query_row("PRAGMA journal_mode = DELETE", [], |_| Ok(())) {
            // Another program is reading the map: the log stays beside it and is read by the next
            // program that opens the map.
            Err(failure) if failure.sqlite_error_code() == Some(ErrorCode::DatabaseBusy) => Ok(()),
            folded => folded,
        }
    }
}

impl Drop for MapFile {
    fn drop(&mut self) {
        let _ = self.fold();
    }
}

fn check_free(path: &Path) -> Result<()> {
    if MapFile::is_there(path) {
        return Err(Complaint::about(path)
            .usage("there is a file already; choose another name, or open the map to continue it"));
    }
    Ok(())
}

/// Settings of every connection against malicious files: the schema is not trusted, and the size of
/// values is limited.
fn prepare(connection: &Connection) -> rusqlite::Result<()> {
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_DEFENSIVE, true)?;
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_TRUSTED_SCHEMA, false)?;
    connection.set_limit(Limit::SQLITE_LIMIT_LENGTH, LARGEST_VALUE)?;
    connection.pragma_update(None, "cell_size_check", true)
}

/// Enables write-ahead logging. The log survives a crash of the program at any moment without
/// syncing to disk. With `synchronous = NORMAL` the disk is synced at checkpoints, so that a power
/// failure also leaves a consistent map, though it may lose the keyframes since the last
/// checkpoint.
fn write_ahead(connection: &Connection) -> rusqlite::Result<()> {
    connection.query_row("PRAGMA journal_mode = WAL", [], |_| Ok(()))?;
    connection.pragma_update(None, "synchronous", "NORMAL")?;
    connection.pragma_update(None, "wal_autocheckpoint", PAGES_IN_LOG)
}
