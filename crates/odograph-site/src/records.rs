//! The store of records: an SQLite database that is on disk before a record is acknowledged.

use crate::protocol::{RobotState, SessionDescription};
use crate::record::Record;
use odograph::error::{Error, Result};
use odograph_map::SessionOrigin;
use rusqlite::config::DbConfig;
use rusqlite::{Connection, OptionalExtension, Row, params};
use std::path::{Path, PathBuf};

const TABLES: &str = "\
    CREATE TABLE IF NOT EXISTS session (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, robot TEXT NOT NULL, \
    key TEXT NOT NULL, description TEXT NOT NULL, ended INTEGER NOT NULL DEFAULT 0, UNIQUE (robot, key));
    CREATE TABLE IF NOT EXISTS record (sequence INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, session INTEGER NOT NULL, \
    number INTEGER NOT NULL, bytes BLOB NOT NULL, UNIQUE (session, number));
    CREATE TABLE IF NOT EXISTS robot (name TEXT PRIMARY KEY NOT NULL, state TEXT NOT NULL, reason TEXT);
    CREATE TABLE IF NOT EXISTS site (id INTEGER PRIMARY KEY CHECK (id = 1), version INTEGER NOT NULL);
    INSERT OR IGNORE INTO site VALUES (1, 0);";

/// Sessions of a robot without a record that are kept. A run makes one; of more, as of a robot that
/// floods the site with descriptions, the oldest are forgotten.
const MAX_EMPTY_SESSIONS: u32 = 64;

/// Why records are not stored.
#[derive(Debug)]
pub enum NotStored {
    /// One does not follow the last one that is stored, whose number is this.
    OutOfOrder(Option<u64>),
    /// Another record with this number is stored already.
    Conflict(u64),
    /// The session has not been described.
    Unknown,
    /// The disk does not take them.
    Failed(Error),
}

/// A session of the store.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredSession {
    pub id: i64,
    pub description: SessionDescription,
    pub ended: bool,
}

/// The records of a site.
#[derive(Debug)]
pub struct RecordStore {
    connection: Connection,
    path: PathBuf,
}

impl RecordStore {
    /// Opens the store in a file, or makes it. Fails if it cannot be read or written. Only the
    /// holder of the site's claim may do so.
    pub fn open(path: &Path) -> Result<Self> {
        let failed = |error: rusqlite::Error| {
            Error::input(format!("{} cannot be used as the records of a site: {error}", path.display()))
        };
        let connection = Connection::open(path).map_err(failed)?;
        let prepare = || -> rusqlite::Result<()> {
            connection.set_db_config(DbConfig::SQLITE_DBCONFIG_DEFENSIVE, true)?;
            connection.set_db_config(DbConfig::SQLITE_DBCONFIG_TRUSTED_SCHEMA, false)?;
            connection.query_row("PRAGMA journal_mode = WAL", [], |_| Ok(()))?;
            // Every commit is on disk when it returns.
            connection.pragma_update(None, "synchronous", "FULL")?;
            connection.busy_timeout(std::time::Duration::from_secs(30))?;
            connection.execute_batch(TABLES)
        };
        prepare().map_err(failed)?;
        Ok(Self { connection, path: path.to_owned() })
    }

    /// Stores the description of a session, once; another description of the same session changes
    /// nothing. Returns the session.
    pub fn describe(&mut self, description: &SessionDescription) -> Result<StoredSession> {
        let text = serde_json::to_string(description)
            .map_err(|error| Error::input(format!("a session cannot be written: {error}")))?;
        let SessionDescription { robot, key, .. } = description;
        let forgotten = "DELETE FROM session WHERE id IN (SELECT id FROM session AS s WHERE robot = ?1 AND NOT EXISTS \
            (SELECT 1 FROM record WHERE session = s.id) ORDER BY id DESC LIMIT -1 OFFSET ?2)";
        self.connection
            .execute(forgotten, params![robot, MAX_EMPTY_SESSIONS])
            .and_then(|_| {
                self.connection.execute(
                    "INSERT OR IGNORE INTO session (robot, key, description) VALUES (?1, ?2, ?3)",
                    [robot, key, &text],
                )
            })
            .and_then(|_| {
                self.connection.execute("INSERT OR IGNORE INTO robot VALUES (?1, 'active', NULL)", [robot])
            })
            .map_err(|error| self.failed(&error))?;
        let origin = description.origin()?;
        self.session(&origin)?.ok_or_else(|| Error::output("a session was not stored"))
    }

    /// A session by its origin.
    pub fn session(&self, origin: &SessionOrigin) -> Result<Option<StoredSession>> {
        let row = self
            .connection
            .prepare_cached("SELECT id, description, ended FROM session WHERE robot = ?1 AND key = ?2")
            .and_then(|mut statement| {
                statement.query_row([&origin.robot, &origin.key], read_session).optional()
            })
            .map_err(|error| self.failed(&error))?;
        row.map(|row| self.parsed(row)).transpose()
    }

    /// All sessions in the order in which they were described.
    pub fn sessions(&self) -> Result<Vec<StoredSession>> {
        let rows = self
            .connection
            .prepare("SELECT id, description, ended FROM session ORDER BY id")
            .and_then(|mut statement| {
                statement.query_map([], read_session)?.collect::<rusqlite::Result<Vec<_>>>()
            })
            .map_err(|error| self.failed(&error))?;
        rows.into_iter().map(|row| self.parsed(row)).collect()
    }

    fn parsed(&self, (id, text, ended): (i64, String, bool)) -> Result<StoredSession> {
        let description = serde_json::from_str(&text).map_err(|error| {
            Error::input(format!("{}: session {id} is damaged: {error}", self.path.display()))
        })?;
        Ok(StoredSession { id, description, ended })
    }

    /// Number of the last record of a session.
    pub fn last(&self, session: i64) -> Result<Option<u64>> {
        last_number(&self.connection, session).map_err(|error| self.failed(&error))
    }

    /// Stores records of a session, each with its bytes. All that are new are on disk when this
    /// returns; what is there already is skipped if it is the same. A keyframe in the place of the
    /// session's end takes it: the run was killed, and goes on now that it was begun again. With
    /// an error nothing is stored.
    pub fn append(
        &mut self,
        session: i64,
        records: &[(Record, &[u8])],
    ) -> std::result::Result<(), NotStored> {
        let failed = |error: rusqlite::Error| {
            NotStored::Failed(Error::output(format!("the records of the site cannot be written: {error}")))
        };
        let mut last = self.last(session).map_err(NotStored::Failed)?;
        let transaction = self.connection.transaction().map_err(failed)?;
        for (Record { head, .. }, bytes) in records {
            if last.is_some_and(|last| head.number <= last) {
                let same: Option<bool> = transaction
                    .query_row(
                        "SELECT bytes = ?3 FROM record WHERE session = ?1 AND number = ?2",
                        params![session, head.number, bytes],
                        |row| row.get(0),
                    )
                    .optional()
                    .map_err(failed)?;
                if same == Some(true) {
                    continue;
                }
                // Only of the end there is no keyframe.
                let reopened = "DELETE FROM record WHERE session = ?1 AND number = ?2 AND (SELECT ended FROM session WHERE id = ?1)";
                let is_end = head.keyframe.is_some() && last == Some(head.number);
                if !is_end
                    || transaction.execute(reopened, params![session, head.number]).map_err(failed)? == 0
                {
                    return Err(NotStored::Conflict(head.number));
                }
                transaction
                    .execute("UPDATE session SET ended = 0 WHERE id = ?1", [session])
                    .map_err(failed)?;
                last = last_number(&transaction, session).map_err(failed)?;
            }
            if head.after != last {
                return Err(NotStored::OutOfOrder(last));
            }
            transaction
                .execute(
                    "INSERT INTO record (session, number, bytes) VALUES (?1, ?2, ?3)",
                    params![session, head.number, bytes],
                )
                .map_err(failed)?;
            if head.keyframe.is_none() {
                transaction
                    .execute("UPDATE session SET ended = 1 WHERE id = ?1", [session])
                    .map_err(failed)?;
            }
            last = Some(head.number);
        }
        transaction.commit().map_err(failed)
    }

    /// Sequence number, session and number of records after a sequence number, at most `most`, in
    /// the order in which they came.
    pub fn after(&self, sequence: i64, most: usize) -> Result<Vec<(i64, i64, u64)>> {
        self.connection
            .prepare_cached(
                "SELECT sequence, session, number FROM record WHERE sequence > ?1 ORDER BY sequence LIMIT ?2",
            )
            .and_then(|mut statement| {
                statement
                    .query_map(params![sequence, most as i64], |row| {
                        Ok((row.get(0)?, row.get(1)?, row.get(2)?))
                    })?
                    .collect()
            })
            .map_err(|error| self.failed(&error))
    }

    /// A record by its sequence number.
    pub fn record(&self, sequence: i64) -> Result<Record> {
        let bytes: Vec<u8> = self
            .connection
            .prepare_cached("SELECT bytes FROM record WHERE sequence = ?1")
            .and_then(|mut statement| statement.query_row([sequence], |row| row.get(0)))
            .map_err(|error| self.failed(&error))?;
        Record::from_bytes(&bytes)
            .map_err(|error| Error::input(format!("{}: record {sequence}: {error}", self.path.display())))
    }

    /// All robots, with their state and its reason.
    pub fn robots(&self) -> Result<Vec<(String, RobotState, Option<String>)>> {
        let robot = |row: &Row<'_>| {
            let state: String = row.get(1)?;
            Ok((row.get(0)?, RobotState::named(&state).unwrap_or_default(), row.get(2)?))
        };
        self.connection
            .prepare_cached("SELECT name, state, reason FROM robot ORDER BY name")
            .and_then(|mut statement| statement.query_map([], robot)?.collect())
            .map_err(|error| self.failed(&error))
    }

    /// Sets the state of a robot. Returns whether there is such a robot.
    pub fn set_robot(&mut self, name: &str, state: RobotState, reason: Option<&str>) -> Result<bool> {
        self.connection
            .execute(
                "UPDATE robot SET state = ?2, reason = ?3 WHERE name = ?1",
                params![name, state.name(), reason],
            )
            .map(|changed| changed > 0)
            .map_err(|error| self.failed(&error))
    }

    /// The version of the map.
    pub fn version(&self) -> Result<u64> {
        self.connection
            .query_row("SELECT version FROM site", [], |row| row.get(0))
            .map_err(|error| self.failed(&error))
    }

    /// Adds to the version of the map.
    pub fn advance_version(&mut self, by: u64) -> Result<()> {
        self.connection
            .execute("UPDATE site SET version = version + ?1", [by])
            .map(drop)
            .map_err(|error| self.failed(&error))
    }

    fn failed(&self, error: &rusqlite::Error) -> Error {
        Error::output(format!("{} cannot be used: {error}", self.path.display()))
    }
}

/// Number of the last record of a session.
fn last_number(connection: &Connection, session: i64) -> rusqlite::Result<Option<u64>> {
    connection
        .prepare_cached("SELECT max(number) FROM record WHERE session = ?1")?
        .query_row([session], |row| row.get(0))
}

fn read_session(row: &Row<'_>) -> rusqlite::Result<(i64, String, bool)> {
    Ok((row.get(0)?, row.get(1)?, row.get(2)?))
}
