//! ROS 1 bags (<http://wiki.ros.org/Bags/Format/2.0>): records of messages, in chunks that may be
//! compressed.
//!
//! Read in the order of the file. The index at its end is used for the list of topics; a bag
//! without one (`.bag.active`, a truncated bag) is read once more to list them.

use super::compression::Compression;
use super::cursor::{MessageCursor, Serialization};
use super::reader::RecordFile;
use super::recording::{Message, MessageReader, Topic, Topics, count};
use odograph::error::{Error, Result};
use std::collections::HashMap;
use std::fs::File;
use std::ops::Range;

pub(super) const MAGIC: &[u8] = b"#ROSBAG V";
const VERSION: &[u8] = b"#ROSBAG V2.0\n";
/// Largest chunk or message, bytes.
const MAX_BYTES: u64 = crate::limits::MAX_INDEX_BYTES;
/// Largest header of a record, bytes.
const MAX_HEADER: u64 = 1 << 20;

mod op {
    pub const MESSAGE: u8 = 0x02;
    pub const BAG_HEADER: u8 = 0x03;
    pub const CHUNK: u8 = 0x05;
    pub const CHUNK_INFO: u8 = 0x06;
    pub const CONNECTION: u8 = 0x07;
}

/// Reads a ROS 1 bag.
pub(super) struct RosBag1 {
    file: RecordFile,
    topics: Topics,
    /// Topics by the number of their connection.
    connections: HashMap<u32, usize>,
    /// The records of the current chunk, and the position of the next one. A record outside of any
    /// chunk is a chunk of one.
    chunk: Vec<u8>,
    next: usize,
    packed: Vec<u8>,
    current: (usize, u64, Range<usize>),
    ended: bool,
    cut_off: bool,
    indexed: bool,
    damaged_chunks: u64,
    warned: bool,
}

/// The fields of a record's header: `name=value`, each with its length before it.
#[derive(Clone)]
struct Fields<'a>(MessageCursor<'a>);

impl<'a> Fields<'a> {
    fn get(&self, name: &str) -> Option<&'a [u8]> {
        let mut rest = self.0.clone();
        while let Some(field) = rest.bytes() {
            if let Some(value) = field.strip_prefix(name.as_bytes())
                && let Some(value) = value.strip_prefix(b"=")
            {
                return Some(value);
            }
        }
        None
    }

    fn op(&self) -> u8 {
        self.get("op").and_then(|value| value.first().copied()).unwrap_or(0)
    }

    fn u32(&self, name: &str) -> Option<u32> {
        MessageCursor::packed(self.get(name)?).u32()
    }

    fn u64(&self, name: &str) -> Option<u64> {
        MessageCursor::packed(self.get(name)?).u64()
    }

    fn time_ns(&self, name: &str) -> Option<u64> {
        u64::try_from(MessageCursor::packed(self.get(name)?).time_ns()?).ok()
    }

    fn text(&self, name: &str) -> Option<String> {
        Some(String::from_utf8_lossy(self.get(name)?).into_owned())
    }
}

impl RosBag1 {
    pub fn open(file: File) -> Result<Self> {
        let mut bag = Self {
            file: RecordFile::new(file)?,
            topics: Topics::default(),
            connections: HashMap::new(),
            chunk: Vec::new(),
            next: 0,
            packed: Vec::new(),
            current: (0, 0, 0..0),
            ended: false,
            cut_off: false,
            indexed: true,
            damaged_chunks: 0,
            warned: false,
        };
        bag.rewind()?;
        if bag.read_index()?.is_none() {
            bag.indexed = false;
            bag.topics = Topics::default();
            bag.connections.clear();
            bag.rewind()?;
            count(&mut bag, |bag, topic, log_ns| bag.topics.all[topic].add(1, (log_ns, log_ns)))?;
        }
        bag.rewind()?;
        Ok(bag)
    }

    /// Reads topics and their numbers of messages from the index; `None` if it is missing or not
    /// whole.
    fn read_index(&mut self) -> Result<Option<()>> {
        let mut header = Vec::new();
        let Some(length) = self.read_head(&mut header)? else { return Ok(None) };
        let fields = Fields(MessageCursor::packed(&header));
        let numbers =
            || Some((fields.u64("index_pos")?, fields.u32("conn_count")?, fields.u32("chunk_count")?));
        let Some((index, connections, chunks)) = numbers().filter(|_| fields.op() == op::BAG_HEADER) else {
            return Ok(None);
        };
        if index < self.file.at() + length || index >= self.file.length() {
            return Ok(None);
        }
        self.file.seek(index)?;
        for _ in 0..connections {
            let Some(op::CONNECTION) = self.read_record(&mut header)? else { return Ok(None) };
            let data = std::mem::take(&mut self.chunk);
            self.register(&Fields(MessageCursor::packed(&header)), &data);
        }
        for _ in 0..chunks {
            let Some(op::CHUNK_INFO) = self.read_record(&mut header)? else { return Ok(None) };
            let fields = Fields(MessageCursor::packed(&header));
            let (Some(begin), Some(end)) = (fields.time_ns("start_time"), fields.time_ns("end_time")) else {
                return Ok(None);
            };
            let mut counts = MessageCursor::packed(&self.chunk);
            while let (Some(connection), Some(count)) = (counts.u32(), counts.u32()) {
                if let Some(&topic) = self.connections.get(&connection) {
                    self.topics.all[topic].add(u64::from(count), (begin, end));
                }
            }
        }
        Ok(Some(()).filter(|()| !self.topics.all.is_empty()))
    }

    /// Reads the header of a record, and the length of its data; `None` at the end of the file.
    fn read_head(&mut self, header: &mut Vec<u8>) -> Result<Option<u64>> {
        let mut length = Vec::new();
        self.file.read(4, &mut length)?;
        let Some(bytes) = MessageCursor::packed(&length).u32().map(u64::from) else { return Ok(None) };
        if bytes > MAX_HEADER || bytes > self.file.remaining() {
            return Ok(None);
        }
        self.file.read(bytes, header)?;
        self.file.read(4, &mut length)?;
        Ok(MessageCursor::packed(&length).u32().map(u64::from))
    }

    /// Reads a record, its data into `chunk`; `None` if it is not whole.
    fn read_record(&mut self, header: &mut Vec<u8>) -> Result<Option<u8>> {
        let Some(length) = self.read_head(header)? else { return Ok(None) };
        if length > self.file.remaining() || length > MAX_BYTES {
            return Ok(None);
        }
        self.file.read(length, &mut self.chunk)?;
        Ok(Some(Fields(MessageCursor::packed(header)).op()))
    }

    /// Takes note of a connection.
    fn register(&mut self, fields: &Fields<'_>, data: &[u8]) {
        let _: Option<()> = (|| {
            let number = fields.u32("conn")?;
            let inner = Fields(MessageCursor::packed(data));
            let name = fields.text("topic").or_else(|| inner.text("topic"))?;
            let topic = self.topics.index(&name, &inner.text("type")?, Serialization::Ros1)?;
            self.connections.insert(number, topic);
            Some(())
        })();
    }

    /// Advances to the next wanted message of the chunk.
    fn advance_in_chunk(&mut self) -> bool {
        let chunk = std::mem::take(&mut self.chunk);
        let mut found = false;
        while !found {
            let mut cursor = MessageCursor::packed(chunk.get(self.next..).unwrap_or_default());
            let (Some(header), Some(data)) = (cursor.bytes(), cursor.bytes()) else { break };
            self.next += cursor.position();
            let fields = Fields(MessageCursor::packed(header));
            match fields.op() {
                op::CONNECTION => self.register(&fields, data),
                op::MESSAGE => {
                    let topic = fields.u32("conn").and_then(|number| self.connections.get(&number));
                    if let (Some(&topic), Some(log_ns)) = (topic, fields.time_ns("time"))
                        && self.topics.is_wanted(topic)
                    {
                        self.current = (topic, log_ns, self.next - data.len()..self.next);
                        found = true;
                    }
                }
                _ => {}
            }
        }
        self.chunk = chunk;
        found
    }

    /// Reads records up to the next one with messages; false at the end of the data.
    fn next_chunk(&mut self) -> Result<bool> {
        self.chunk.clear();
        self.next = 0;
        let mut header = Vec::new();
        loop {
            if self.file.remaining() == 0 {
                return Ok(false);
            }
            let Some(length) = self.read_head(&mut header)? else {
                self.cut_off = true;
                return Ok(false);
            };
            let there = length.min(self.file.remaining());
            let whole = there == length;
            let fields = Fields(MessageCursor::packed(&header));
            match fields.op() {
                op::MESSAGE | op::CONNECTION if whole && length <= MAX_BYTES => {
                    self.file.read(length, &mut self.packed)?;
                    for part in [&header, &self.packed] {
                        // Both lengths were read from 32 bits.
                        self.chunk.extend_from_slice(&(part.len() as u32).to_le_bytes());
                        self.chunk.extend_from_slice(part);
                    }
                    return Ok(true);
                }
                op::CHUNK if there <= MAX_BYTES => {
                    let compression = Compression::named(&fields.text("compression").unwrap_or_default())?;
                    let size = u64::from(fields.u32("size").unwrap_or(0));
                    // The recorder fills in both lengths of a chunk when it has written it. Without
                    // that, the rest of the file is the chunk; its records follow one by one if
                    // they are not compressed.
                    let unfinished = length == 0 && compression != Compression::None;
                    let bytes = if unfinished { self.file.remaining().min(MAX_BYTES) } else { length };
                    self.file.read(bytes, &mut self.packed)?;
                    let most = if unfinished { MAX_BYTES } else { size.min(MAX_BYTES) };
                    let decompressed = compression.decompress(&self.packed, most, &mut self.chunk);
                    let is_whole = whole && !unfinished;
                    self.cut_off |= !is_whole;
                    if is_whole && !(decompressed && self.chunk.len() as u64 == size) {
                        // There is no checksum: what could be decompressed is used.
                        self.damaged_chunks += 1;
                    }
                    if !self.chunk.is_empty() {
                        return Ok(true);
                    }
                }
                _ if whole => self.file.skip(length)?,
                _ => {}
            }
            if !whole {
                self.cut_off = true;
                return Ok(false);
            }
        }
    }
}

impl MessageReader for RosBag1 {
    fn format(&self) -> String {
        "a ROS 1 bag".to_owned()
    }

    fn topics(&self) -> &[Topic] {
        &self.topics.all
    }

    fn select(&mut self, wanted: &dyn Fn(&Topic) -> bool) {
        self.topics.select(wanted);
    }

    fn advance(&mut self) -> Result<bool> {
        while !self.ended {
            if self.advance_in_chunk() {
                return Ok(true);
            }
            self.ended = !self.next_chunk()?;
        }
        self.chunk.clear();
        self.current = (0, 0, 0..0);
        Ok(false)
    }

    fn message(&self) -> Message<'_> {
        let (topic, log_ns, range) = &self.current;
        Message { topic: *topic, log_ns: *log_ns, data: self.chunk.get(range.clone()).unwrap_or_default() }
    }

    fn rewind(&mut self) -> Result<()> {
        let mut magic = Vec::new();
        self.file.seek(0)?;
        self.file.read(VERSION.len() as u64, &mut magic)?;
        if magic != VERSION {
            return Err(Error::input(
                "this bag is of an older version than 2.0; convert it with `rosbag fix` or `rosbag record`'s successor",
            ));
        }
        self.chunk.clear();
        self.next = 0;
        self.current = (0, 0, 0..0);
        self.ended = false;
        self.damaged_chunks = 0;
        Ok(())
    }

    fn take_warnings(&mut self) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.ended && !self.warned {
            self.warned = true;
            if self.cut_off {
                warnings.push("the bag is cut off; it is read up to there".to_owned());
            } else if !self.indexed {
                warnings.push("the bag has no index; it is read from begin to end".to_owned());
            }
            if self.damaged_chunks > 0 {
                warnings.push(format!("{} chunks of the bag are damaged", self.damaged_chunks));
            }
        }
        warnings
    }
}
