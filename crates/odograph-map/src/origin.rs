//! Origins: which robot made a session and its keyframes, and the numbers that it gave to these.
//!
//! Numbers of sessions and keyframes are this file's own. A robot, the key of one of its sessions
//! and the number of a keyframe in it name the same keyframe in every map. Two tables have them,
//! which only maps with a named robot have.

use crate::complaint::{Complaint, WithContext};
use crate::row_order::in_order;
use crate::schema;
use odograph::error::{Error, Result};
use odograph::keyframe::KeyframeId;
use rusqlite::{Connection, OptionalExtension, Row, params};
use std::collections::BTreeMap;

const SESSIONS: &str = "CREATE TABLE odograph_session_origin (session INTEGER PRIMARY KEY NOT NULL, robot TEXT NOT NULL, key TEXT NOT NULL)";
const KEYFRAMES: &str =
    "CREATE TABLE odograph_keyframe_origin (keyframe INTEGER PRIMARY KEY NOT NULL, number INTEGER NOT NULL)";

/// Longest name of a robot, bytes: it is shown on pages and is part of addresses.
const LONGEST_NAME: usize = 64;

/// The robot of a session, and its key there: the same in every map with that session.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SessionOrigin {
    /// Name of the robot.
    pub robot: String,
    /// Key of the session, 32 hexadecimal digits, drawn at random when it began.
    pub key: String,
}

impl SessionOrigin {
    /// The origin of a new session, with a key drawn at random.
    ///
    /// # Errors
    /// If the robot cannot be called so.
    pub fn new(robot: &str) -> Result<Self> {
        check_name(robot)?;
        let drawn = Connection::open_in_memory().and_then(|connection| {
            connection.query_row("SELECT lower(hex(randomblob(16)))", [], |row| row.get(0))
        });
        let key = drawn.map_err(|error| {
            Error::output(format!("no key for the session can be drawn: {error}")).caused_by(error)
        })?;
        Ok(Self { robot: robot.to_owned(), key })
    }

    /// The origin of the session that replaces this one, where the same run begins again with
    /// another calibration: the same whenever it is asked for.
    #[must_use]
    pub fn following(&self) -> Self {
        let number = u128::from_str_radix(&self.key, 16).unwrap_or_default();
        Self { robot: self.robot.clone(), key: format!("{:032x}", number.wrapping_add(1)) }
    }

    /// Checks both. Fails if the name is no name of a robot, or the key is none.
    pub fn validated(self) -> Result<Self> {
        check_name(&self.robot)?;
        let is_key = self.key.len() == 32
            && self.key.bytes().all(|byte| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte));
        if !is_key {
            return Err(Error::input("the key of a session has 32 hexadecimal digits"));
        }
        Ok(self)
    }
}

/// Checks the name of a robot: 1 to 64 letters, digits, hyphens, underscores and dots of ASCII,
/// with a letter or digit first.
pub fn check_name(robot: &str) -> Result<()> {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    let begins = robot.bytes().next().is_some_and(|byte| byte.is_ascii_alphanumeric());
    if begins && robot.len() <= LONGEST_NAME && robot.bytes().all(plain) {
        return Ok(());
    }
    Err(Error::usage(format!(
        "a robot cannot be called \"{}\"; its name has 1 to {LONGEST_NAME} letters, digits, hyphens, \
         underscores and dots, and begins with a letter or digit",
        robot.chars().take(2 * LONGEST_NAME).filter(|letter| !letter.is_control()).collect::<String>()
    )))
}

/// Writes the origin of a session.
pub(crate) fn write(connection: &Connection, session: u32, origin: &SessionOrigin) -> rusqlite::Result<()> {
    schema::make_further(connection, "odograph_session_origin", SESSIONS)?;
    schema::make_further(connection, "odograph_keyframe_origin", KEYFRAMES)?;
    connection.execute(
        "INSERT INTO odograph_session_origin VALUES (?1, ?2, ?3)",
        params![session, origin.robot, origin.key],
    )?;
    Ok(())
}

/// Writes the number that a keyframe's robot gave it.
pub(crate) fn write_number(
    connection: &Connection,
    keyframe: KeyframeId,
    number: u64,
) -> rusqlite::Result<()> {
    connection
        .prepare_cached("INSERT INTO odograph_keyframe_origin VALUES (?1, ?2)")?
        .execute(params![keyframe.0, number])?;
    Ok(())
}

/// The origins of the sessions that have one.
pub(crate) fn read(connection: &Connection, complaint: &Complaint) -> Result<BTreeMap<u32, SessionOrigin>> {
    if !is_there(connection).while_reading(complaint)? {
        return Ok(BTreeMap::new());
    }
    let mut statement = connection
        .prepare("SELECT session, robot, key FROM odograph_session_origin ORDER BY session")
        .while_reading(complaint)?;
    let origin = |row: &Row<'_>| Ok((row.get(0)?, SessionOrigin { robot: row.get(1)?, key: row.get(2)? }));
    let rows = statement.query_map([], in_order(origin)).while_reading(complaint)?;
    rows.map(|row| {
        let (session, origin): (u32, SessionOrigin) = row.while_reading(complaint)?;
        Ok((session, origin.validated().map_err(|error| complaint.input(error))?))
    })
    .collect()
}

/// The number that a keyframe's robot gave it; `None` where it has none.
pub(crate) fn number_of(connection: &Connection, keyframe: KeyframeId) -> rusqlite::Result<Option<u64>> {
    if !is_there(connection)? {
        return Ok(None);
    }
    connection
        .prepare_cached("SELECT number FROM odograph_keyframe_origin WHERE keyframe = ?1")?
        .query_row([keyframe.0], |row| row.get(0))
        .optional()
}

/// Removes the recorded origins of keyframes.
pub(crate) fn remove(connection: &Connection, gone: &[KeyframeId]) -> rusqlite::Result<()> {
    if !is_there(connection)? {
        return Ok(());
    }
    let mut statement = connection.prepare("DELETE FROM odograph_keyframe_origin WHERE keyframe = ?1")?;
    gone.iter().try_for_each(|keyframe| statement.execute([keyframe.0]).map(drop))
}

/// Removes what is known of the origin of a session.
pub(crate) fn remove_session(connection: &Connection, session: u32) -> rusqlite::Result<()> {
    if is_there(connection)? {
        connection.execute("DELETE FROM odograph_session_origin WHERE session = ?1", [session])?;
    }
    Ok(())
}

fn is_there(connection: &Connection) -> rusqlite::Result<bool> {
    Ok(schema::has_further(connection, "odograph_session_origin", SESSIONS)?
        && schema::has_further(connection, "odograph_keyframe_origin", KEYFRAMES)?)
}
