//! rosbag2's SQLite files: the tables `topics` and `messages`. The only file of this crate that
//! knows SQLite.
//!
//! The file is opened for reading only. Rows are read in the order of their numbers, so that
//! neither an index nor a sort is needed, and a damaged or truncated file is read up to the damage.

use super::cursor::Serialization;
use super::recording::{Message, MessageReader, Topic, Topics};
use crate::limits;
use odograph::error::{Error, Result};
use rusqlite::limits::Limit;
use rusqlite::{Connection, OpenFlags};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

pub(super) const MAGIC: &[u8] = b"SQLite format 3\0";
/// Number of rows that are read at a time, and the bytes after which no further one is begun.
const ROWS_AT_A_TIME: usize = 64;
const BYTES_AT_A_TIME: usize = 8 << 20;

/// Reads a rosbag2 database.
pub(super) struct Database {
    connection: Connection,
    topics: Topics,
    /// Topics by their number in the table.
    numbers: HashMap<i64, usize>,
    /// Rows that have been read ahead, the next one last.
    ahead: Vec<DatabaseRow>,
    current: Option<DatabaseRow>,
    last_number: i64,
    at_end: bool,
    damage: Option<String>,
}

struct DatabaseRow {
    topic: usize,
    log_ns: u64,
    data: Vec<u8>,
}

fn failed(error: &rusqlite::Error) -> Error {
    Error::input(format!(
        "the database cannot be read: {error}; copy the recording again, or save the rest of it: \
         sqlite3 DAMAGED.db3 .recover | sqlite3 SAVED.db3"
    ))
}

impl Database {
    pub fn open(path: &Path) -> Result<Self> {
        let connection = connect(path)?;
        let mut database = Self {
            connection,
            topics: Topics::default(),
            numbers: HashMap::new(),
            ahead: Vec::new(),
            current: None,
            last_number: i64::MIN,
            at_end: false,
            damage: None,
        };
        database.read_topics()?;
        database.count()?;
        Ok(database)
    }

    fn read_topics(&mut self) -> Result<()> {
        // A view could compute for ever; a recording has tables.
        let tables = "SELECT count(*) FROM sqlite_schema WHERE type = 'table' AND name IN ('topics', 'messages') \
                      AND upper(sql) NOT LIKE 'CREATE VIRTUAL%'";
        let found: i64 = self.connection.query_row(tables, [], |row| row.get(0)).map_err(|e| failed(&e))?;
        if found != 2 {
            return Err(Error::input(
                "this is an SQLite database and not a recording (a map is given with --map, and odograph map info shows it)",
            ));
        }
        let text = "SELECT id, name, type, serialization_format FROM topics ORDER BY rowid LIMIT 100000";
        let mut statement = self.connection.prepare(text).map_err(|e| failed(&e))?;
        let mut rows = statement.query([]).map_err(|e| failed(&e))?;
        while let Some(row) = rows.next().map_err(|e| failed(&e))? {
            let read = || -> rusqlite::Result<_> { Ok((row.get(0)?, row.get(1)?, row.get(2)?, row.get(3)?)) };
            let (number, name, type_name, format): (i64, String, String, String) =
                read().map_err(|e| failed(&e))?;
            if let Some(topic) = self.topics.index(&name, &type_name, Serialization::named(&format)) {
                self.numbers.insert(number, topic);
            }
        }
        Ok(())
    }

    /// Counts the messages without reading them.
    fn count(&mut self) -> Result<()> {
        let text = "SELECT rowid, topic_id, timestamp FROM messages ORDER BY rowid";
        let mut statement = self.connection.prepare(text).map_err(|e| failed(&e))?;
        let mut rows = statement.query([]).map_err(|e| failed(&e))?;
        let mut last = i64::MIN;
        // Damage ends the count here, and is reported when the messages are read.
        while let Ok(Some(row)) = rows.next() {
            let (Ok(number), Ok(topic), Ok(log_ns)) =
                (row.get::<_, i64>(0), row.get::<_, i64>(1), row.get::<_, i64>(2))
            else {
                continue;
            };
            // In a damaged file pages may refer to each other in a circle.
            if number <= last {
                break;
            }
            last = number;
            let log_ns = u64::try_from(log_ns).unwrap_or(0);
            if let Some(&topic) = self.numbers.get(&topic) {
                self.topics.all[topic].add(1, (log_ns, log_ns));
            }
        }
        Ok(())
    }

    /// Reads the next rows ahead.
    fn read_ahead(&mut self) -> Result<()> {
        let mut wanted: Vec<i64> = self.numbers.keys().copied().collect();
        wanted.retain(|number| self.topics.is_wanted(self.numbers[number]));
        wanted.sort_unstable();
        let wanted: Vec<String> = wanted.iter().map(ToString::to_string).collect();
        // Unwanted rows are seen as well, without their data: in a damaged file pages may refer to
        // each other in a circle, and only their numbers show it.
        let text = format!(
            "SELECT rowid, topic_id, timestamp, CASE WHEN topic_id IN ({}) THEN data END FROM messages \
             WHERE rowid > ?1 ORDER BY rowid",
            wanted.join(",")
        );
        let mut statement = self.connection.prepare_cached(&text).map_err(|e| failed(&e))?;
        let mut rows = statement.query([self.last_number]).map_err(|e| failed(&e))?;
        let mut bytes = 0;
        self.at_end = true;
        loop {
            let row = match rows.next() {
                Ok(Some(row)) => row,
                Ok(None) => break,
                Err(error) => {
                    self.damage = Some(error.to_string());
                    break;
                }
            };
            let Ok(number) = row.get::<_, i64>(0) else { break };
            if number <= self.last_number {
                self.damage = Some("its rows are not in order".to_owned());
                break;
            }
            self.last_number = number;
            let fields = (row.get::<_, i64>(1), row.get::<_, i64>(2), row.get_ref(3));
            if let (Ok(topic), Ok(log_ns), Ok(data)) = fields
                && let Some(&topic) = self.numbers.get(&topic)
                && let Ok(data) = data.as_blob()
            {
                bytes += data.len();
                let log_ns = u64::try_from(log_ns).unwrap_or(0);
                self.ahead.push(DatabaseRow { topic, log_ns, data: data.to_vec() });
            }
            if self.ahead.len() >= ROWS_AT_A_TIME || bytes >= BYTES_AT_A_TIME {
                self.at_end = false;
                break;
            }
        }
        self.ahead.reverse();
        Ok(())
    }
}

/// Opens a database for reading, without leaving anything beside it where that can be avoided.
fn connect(path: &Path) -> Result<Connection> {
    let beside = |ending: &str| {
        let mut name = path.as_os_str().to_owned();
        name.push(ending);
        std::fs::metadata(PathBuf::from(name)).is_ok_and(|file| file.len() > 0)
    };
    let open = |immutable: bool, cut_off: bool| -> rusqlite::Result<Connection> {
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let connection = if immutable {
            Connection::open_with_flags(address(path), flags | OpenFlags::SQLITE_OPEN_URI)?
        } else {
            Connection::open_with_flags(path, flags)?
        };
        connection.set_limit(Limit::SQLITE_LIMIT_LENGTH, limits::MAX_SAMPLE_BYTES as i32)?;
        connection.pragma_update(None, "trusted_schema", false)?;
        connection.pragma_update(None, "cell_size_check", true)?;
        if cut_off {
            // SQLite then reads a file that is shorter than it states.
            connection.pragma_update(None, "writable_schema", true)?;
        }
        connection.query_row("SELECT count(*) FROM sqlite_schema", [], |_| Ok(()))?;
        Ok(connection)
    };
    // What is in a log or a journal beside the file belongs to it.
    let logged = beside("-wal") || beside("-journal");
    let whole = open(!logged, false).or_else(|_| open(logged, false));
    whole.or_else(|error| open(true, true).map_err(|_| error)).map_err(|e| failed(&e))
}

/// The address of a file that nobody changes.
fn address(path: &Path) -> String {
    let whole = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let mut address = "file:".to_owned();
    for &byte in whole.as_os_str().as_encoded_bytes() {
        match byte {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'/' | b'.' | b'-' | b'_' => address.push(byte.into()),
            _ => address.push_str(&format!("%{byte:02x}")),
        }
    }
    address + "?immutable=1"
}

impl MessageReader for Database {
    fn format(&self) -> String {
        "a rosbag2 database".to_owned()
    }

    fn topics(&self) -> &[Topic] {
        &self.topics.all
    }

    fn select(&mut self, wanted: &dyn Fn(&Topic) -> bool) {
        self.topics.select(wanted);
    }

    fn advance(&mut self) -> Result<bool> {
        if self.ahead.is_empty() && !self.at_end {
            self.read_ahead()?;
        }
        self.current = self.ahead.pop();
        Ok(self.current.is_some())
    }

    fn message(&self) -> Message<'_> {
        match &self.current {
            Some(row) => Message { topic: row.topic, log_ns: row.log_ns, data: &row.data },
            None => Message { topic: 0, log_ns: 0, data: &[] },
        }
    }

    fn rewind(&mut self) -> Result<()> {
        self.ahead.clear();
        self.current = None;
        self.last_number = i64::MIN;
        self.at_end = false;
        self.damage = None;
        Ok(())
    }

    fn take_warnings(&mut self) -> Vec<String> {
        let damage = self.damage.take();
        let warning = |why| format!("the database is damaged or cut off ({why}); it is read up to there");
        damage.map(warning).into_iter().collect()
    }
}
