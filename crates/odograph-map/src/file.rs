//! The file: made, opened, checked, closed.

use crate::claim::{self, MapClaim};
use crate::complaint::{Complaint, Told};
use crate::schema;
use crate::thinning::{Thinning, thinning};
use odograph::camera::{Camera, Distortion, Rig};
use odograph::error::Result;
use odograph::mapping::{GroundMap, KeyframeImages};
use rusqlite::config::DbConfig;
use rusqlite::limits::Limit;
use rusqlite::{Connection, ErrorCode, OpenFlags, Row, params};
use std::path::{Path, PathBuf};

/// Nothing that is read back is larger than this, bytes.
const LARGEST_VALUE: i32 = 256 << 20;
/// A map's camera has at most so many pixels: an image is decoded to as many bytes.
const MOST_PIXELS: usize = 256 << 20;
/// No camera over ground is higher, metres.
const GREATEST_HEIGHT_M: f64 = 1e6;
/// The log beside the file is written into it whenever it has grown to so many pages of 4 KiB.
const PAGES_IN_LOG: i64 = 2000;

/// One of the runs that made a map.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Session {
    /// Its number, from 0.
    pub id: u32,
    /// What was run: a file, a folder, a stream.
    pub source: String,
}

/// A map on disk.
///
/// While it is open for writing, a log (`-wal`), an index of it (`-shm`) and a lock (`.lock`) lie
/// beside it; [`MapFile::close`] folds them in. What is in the log survives the program's death:
/// the next one that opens the file finds it.
#[derive(Debug)]
pub struct MapFile {
    pub(crate) connection: Connection,
    pub(crate) complaint: Complaint,
    path: PathBuf,
    camera: Camera,
    rig: Rig,
    /// Held while the map is open for writing. After the connection: that ends first.
    claim: Option<MapClaim>,
}

impl MapFile {
    /// A new map of the ground as this camera, mounted like this, sees it.
    ///
    /// Fails where there is a map already ([`MapFile::remove`] takes one away), where another
    /// program makes one, and where none can be written.
    pub fn create(path: &Path, camera: &Camera, rig: &Rig) -> Result<Self> {
        check_free(path)?;
        Self::create_claimed(MapClaim::on(path)?, camera, rig)
    }

    /// The same by who claimed its place before. What a program left that was killed while it began
    /// a map is no map, and is replaced.
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
            // All tables or none: a program killed here leaves an empty database, not half a map.
            let transaction = connection.transaction()?;
            schema::make(&transaction)?;
            write_camera(&transaction, camera)?;
            transaction.execute(
                "INSERT INTO odograph_rig VALUES (1, ?1, ?2, ?3, ?4)",
                params![rig.height_m, rig.roll_rad, rig.pitch_rad, rig.yaw_rad],
            )?;
            transaction.commit()
        })();
        if let Err(failure) = made {
            drop(connection);
            let _ = claim.remove_map();
            return Err(complaint.writing(&failure));
        }
        let camera = camera.clone();
        Ok(Self { connection, complaint, path, camera, rig: *rig, claim: Some(claim) })
    }

    /// Opens a map to continue it. Fails, with one sentence, on everything that is not a whole map
    /// of this version, and where another program writes it.
    pub fn open(path: &Path) -> Result<Self> {
        schema::check_bytes(path)?;
        Self::open_claimed(MapClaim::on(path)?)
    }

    /// The same by who claimed it before.
    pub fn open_claimed(claim: MapClaim) -> Result<Self> {
        let path = claim.path().to_owned();
        Self::opened(&path, Some(claim))
    }

    /// Opens a map to look at it; the file is not changed. Others may write it meanwhile.
    pub fn open_read_only(path: &Path) -> Result<Self> {
        Self::opened(path, None)
    }

    /// Whether there is a map to continue, or anything else that is not to be written over. What a
    /// program left that was killed while it began a map is neither: an empty file, or a database
    /// without a table.
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
        let camera = read_camera(&connection, &complaint)?;
        let rig = connection
            .query_row(
                "SELECT height_m, roll_rad, pitch_rad, yaw_rad FROM odograph_rig WHERE id = 1",
                [],
                |row| {
                    Ok(Rig {
                        height_m: row.get(0)?,
                        roll_rad: row.get(1)?,
                        pitch_rad: row.get(2)?,
                        yaw_rad: row.get(3)?,
                    })
                },
            )
            .while_reading(&complaint)?
            .validated()
            .map_err(|error| complaint.input(error))?;
        if rig.height_m > GREATEST_HEIGHT_M {
            return Err(complaint.input(format!(
                "the camera is {:e} m above the ground; no camera over ground is that high",
                rig.height_m
            )));
        }
        Ok(Self { connection, complaint, path: path.to_owned(), camera, rig, claim })
    }

    /// Takes a map away, with the log that may lie beside it. Nothing to take away is no failure; a
    /// map that another program writes is one.
    pub fn remove(path: &Path) -> Result<()> {
        if claim::leaves_anything(path) { MapClaim::on(path)?.remove_map() } else { Ok(()) }
    }

    /// Writes the whole map into a new file, as small as it can be. Fails where there is a file already, and where none can be written.
    pub fn copy_to(&self, path: &Path) -> Result<()> {
        let complaint = Complaint::about(path);
        let Some(name) = path.to_str() else {
            return Err(complaint.usage("the name is no text; choose another"));
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

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The camera that every keyframe was taken with.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// How it sat when the first session began.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// Everything but the images. Fails where anything in it is not what a map holds: a number that is not finite, an edge to a keyframe that
    /// is not there.
    pub fn map(&self) -> Result<GroundMap> {
        // Keyframes and edges of one moment: another program may be writing.
        let _moment = self.connection.unchecked_transaction().while_reading(&self.complaint)?;
        Ok(GroundMap {
            camera: self.camera.clone(),
            rig: self.rig,
            keyframes: self.keyframes()?,
            edges: self.edges()?,
        })
    }

    /// Begins a session over this source and gives its number.
    pub fn begin_session(&mut self, source: &str) -> Result<u32> {
        let transaction = self.connection.transaction().while_writing(&self.complaint)?;
        let id: u32 = transaction
            .query_row("SELECT ifnull(max(id) + 1, 0) FROM odograph_session", [], |row| row.get(0))
            .while_reading(&self.complaint)?;
        transaction
            .execute("INSERT INTO odograph_session VALUES (?1, ?2)", params![id, source])
            .and_then(|_| transaction.commit())
            .while_writing(&self.complaint)?;
        Ok(id)
    }

    /// The sessions, in their order.
    pub fn sessions(&self) -> Result<Vec<Session>> {
        let mut statement = self
            .connection
            .prepare("SELECT id, source FROM odograph_session ORDER BY id")
            .while_reading(&self.complaint)?;
        let session = |row: &Row<'_>| Ok(Session { id: row.get(0)?, source: row.get(1)? });
        let rows = statement.query_map([], session).while_reading(&self.complaint)?;
        rows.collect::<rusqlite::Result<_>>().while_reading(&self.complaint)
    }

    /// Looks through the whole file for damage (`PRAGMA integrity_check`); slow on a large map. Then reads all that a map holds, and every image.
    pub fn check(&mut self) -> Result<()> {
        let found: String = self
            .connection
            .query_row("PRAGMA integrity_check(1)", [], |row| row.get(0))
            .while_reading(&self.complaint)?;
        if found != "ok" {
            return Err(self.complaint.input(format!("the file is damaged: {}", found.replace('\n', " "))));
        }
        for keyframe in self.map()?.keyframes {
            self.load(keyframe.id)?;
        }
        Ok(())
    }

    /// Takes out the keyframes that the map can best do without, until there are at most so many, and composes what tied it together through them.
    pub fn thin(&mut self, most_keyframes: usize) -> Result<Thinning> {
        let thinning = thinning(&self.map()?, most_keyframes);
        self.remove_keyframes(&thinning.gone, &thinning.edges)?;
        Ok(thinning)
    }

    /// Gives back the room of what was taken out: the file is written anew, as small as it can be.
    pub fn compact(&mut self) -> Result<()> {
        self.connection
            .execute_batch("VACUUM; PRAGMA wal_checkpoint(TRUNCATE);")
            .while_writing(&self.complaint)
    }

    /// Folds the log into the file, so that the map is one file again. Dropping a map does the same where it can, without a word where it
    /// cannot: then the log stays beside the file and nothing is lost.
    pub fn close(mut self) -> Result<()> {
        self.fold().while_writing(&self.complaint)
    }

    fn fold(&mut self) -> rusqlite::Result<()> {
        if self.claim.is_none() {
            return Ok(());
        }
        self.connection.flush_prepared_statement_cache();
        // Leaving the log for good folds it in and removes it.
        match self.connection.query_row("PRAGMA journal_mode = DELETE", [], |_| Ok(())) {
            // Somebody is looking at the map: the log stays beside it, and the next one that opens
            // the map reads it.
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

/// What holds for every connection: nothing in the file acts by itself, nothing in it is larger than a map's largest.
fn prepare(connection: &Connection) -> rusqlite::Result<()> {
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_DEFENSIVE, true)?;
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_TRUSTED_SCHEMA, false)?;
    connection.set_limit(Limit::SQLITE_LIMIT_LENGTH, LARGEST_VALUE)?;
    connection.pragma_update(None, "cell_size_check", true)
}

/// A log that is appended to before the file is changed. It survives the death of the program at any moment without a word to the disk; with
/// `synchronous = NORMAL` the disk is waited for whenever the log is folded in, so that a power cut leaves a whole map too, though it may cost the
/// keyframes since.
fn write_ahead(connection: &Connection) -> rusqlite::Result<()> {
    connection.query_row("PRAGMA journal_mode = WAL", [], |_| Ok(()))?;
    connection.pragma_update(None, "synchronous", "NORMAL")?;
    connection.pragma_update(None, "wal_autocheckpoint", PAGES_IN_LOG)
}

/// The names of the lens models in the file.
fn name_of(distortion: &Distortion) -> &'static str {
    match distortion {
        Distortion::None => "none",
        Distortion::BrownConrady { .. } => "brown-conrady",
        Distortion::KannalaBrandt { .. } => "kannala-brandt",
        Distortion::DoubleSphere { .. } => "double-sphere",
    }
}

fn distortion_named(name: &str, coefficients: &[f64]) -> Option<Distortion> {
    match (name, coefficients) {
        ("none", []) => Some(Distortion::None),
        ("brown-conrady", &[k1, k2, p1, p2, k3, k4, k5, k6]) => {
            Some(Distortion::BrownConrady { k1, k2, p1, p2, k3, k4, k5, k6 })
        }
        ("kannala-brandt", &[k1, k2, k3, k4]) => Some(Distortion::KannalaBrandt { k1, k2, k3, k4 }),
        ("double-sphere", &[xi, alpha]) => Some(Distortion::DoubleSphere { xi, alpha }),
        _ => None,
    }
}

fn write_camera(connection: &Connection, camera: &Camera) -> rusqlite::Result<()> {
    let coefficients: Vec<u8> =
        camera.distortion().coefficients().iter().flat_map(|c| c.to_le_bytes()).collect();
    let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.principal_px());
    connection.execute(
        "INSERT INTO odograph_camera VALUES (1, ?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)",
        params![camera.width(), camera.height(), fx, fy, cx, cy, name_of(camera.distortion()), coefficients],
    )?;
    Ok(())
}

fn read_camera(connection: &Connection, complaint: &Complaint) -> Result<Camera> {
    let (size, focal_px, principal_px, name, bytes): ((usize, usize), _, _, String, Vec<u8>) = connection
        .query_row(
            "SELECT width, height, fx_px, fy_px, cx_px, cy_px, distortion, coefficients FROM odograph_camera WHERE id = 1",
            [],
            |row| {
                let size = (row.get(0)?, row.get(1)?);
                Ok((size, (row.get(2)?, row.get(3)?), (row.get(4)?, row.get(5)?), row.get(6)?, row.get(7)?))
            },
        )
        .while_reading(complaint)?;
    let coefficients: Vec<f64> =
        bytes.chunks(8).map(|eight| eight.try_into().map_or(f64::NAN, f64::from_le_bytes)).collect();
    let distortion = distortion_named(&name, &coefficients).ok_or_else(|| {
        complaint.input(format!("the camera has a lens model \"{name}\" that this program does not know"))
    })?;
    if size.0.saturating_mul(size.1) > MOST_PIXELS {
        return Err(
            complaint.input(format!("the camera's image of {}x{} pixels is too large", size.0, size.1))
        );
    }
    Camera::new(size, focal_px, principal_px, distortion).map_err(|error| complaint.input(error))
}
