//! ROS 1 bags (<http://wiki.ros.org/Bags/Format/2.0>): records of messages, in chunks that may be
//! compressed.
//!
//! Read in the order of the file. The index at its end is used for the list of topics; a bag
//! without one (`.bag.active`, a truncated bag) is read once more to list them.

use super::chunks::{ChunkFile, ChunkedFormat, FoundMessage, MAX_BYTES};
use super::compression::Compression;
use super::cursor::{MessageCursor, Serialization};
use super::recording::Topics;
use crate::record_file::RecordFile;
use odograph::error::Result;
use std::collections::HashMap;

/// The first bytes of a bag of any version.
pub(super) const MAGIC: &[u8] = b"#ROSBAG V";
/// Largest header of a record, bytes.
const MAX_HEADER: u64 = 1 << 20;

mod op {
    pub const MESSAGE: u8 = 0x02;
    pub const BAG_HEADER: u8 = 0x03;
    pub const CHUNK: u8 = 0x05;
    pub const CHUNK_INFO: u8 = 0x06;
    pub const CONNECTION: u8 = 0x07;
}

/// The format of ROS 1 bags.
#[derive(Default)]
pub(super) struct RosBag1 {
    /// Topics by the number of their connection.
    connections: HashMap<u32, usize>,
    indexed: bool,
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
    /// Takes note of a connection.
    fn register(&mut self, topics: &mut Topics, fields: &Fields<'_>, data: &[u8]) {
        let _: Option<()> = (|| {
            let number = fields.u32("conn")?;
            let inner = Fields(MessageCursor::packed(data));
            let name = fields.text("topic").or_else(|| inner.text("topic"))?;
            let topic = topics.index(&name, &inner.text("type")?, Serialization::Ros1)?;
            self.connections.insert(number, topic);
            Some(())
        })();
    }
}

/// Reads the header of a record, and the length of its data; `None` at the end of the file.
fn read_head(file: &mut RecordFile, header: &mut Vec<u8>) -> Result<Option<u64>> {
    let mut length = Vec::new();
    file.fill(4, &mut length)?;
    let Some(bytes) = MessageCursor::packed(&length).u32().map(u64::from) else { return Ok(None) };
    if bytes > MAX_HEADER || bytes > file.remaining() {
        return Ok(None);
    }
    file.fill(bytes, header)?;
    file.fill(4, &mut length)?;
    Ok(MessageCursor::packed(&length).u32().map(u64::from))
}

/// Reads a record, its data into `records`; `None` if it is not whole.
fn read_whole_record(chunks: &mut ChunkFile, header: &mut Vec<u8>) -> Result<Option<u8>> {
    let Some(length) = read_head(&mut chunks.file, header)? else { return Ok(None) };
    if length > chunks.file.remaining() || length > MAX_BYTES {
        return Ok(None);
    }
    chunks.file.fill(length, &mut chunks.records)?;
    Ok(Some(Fields(MessageCursor::packed(header)).op()))
}

impl ChunkedFormat for RosBag1 {
    const NAME: &'static str = "a ROS 1 bag";
    const MAGIC: &'static [u8] = b"#ROSBAG V2.0\n";
    const WRONG_MAGIC: &'static str = "this bag is of an older version than 2.0; convert it with `rosbag fix` or `rosbag record`'s successor";

    fn read_summary(&mut self, chunks: &mut ChunkFile) -> Result<Option<()>> {
        let mut header = Vec::new();
        let Some(length) = read_head(&mut chunks.file, &mut header)? else { return Ok(None) };
        let fields = Fields(MessageCursor::packed(&header));
        let numbers =
            || Some((fields.u64("index_pos")?, fields.u32("conn_count")?, fields.u32("chunk_count")?));
        let Some((index, connections, infos)) = numbers().filter(|_| fields.op() == op::BAG_HEADER) else {
            return Ok(None);
        };
        if index < chunks.file.at() + length || index >= chunks.file.length() {
            return Ok(None);
        }
        chunks.file.seek(index)?;
        for _ in 0..connections {
            let Some(op::CONNECTION) = read_whole_record(chunks, &mut header)? else { return Ok(None) };
            self.register(&mut chunks.topics, &Fields(MessageCursor::packed(&header)), &chunks.records);
        }
        for _ in 0..infos {
            let Some(op::CHUNK_INFO) = read_whole_record(chunks, &mut header)? else { return Ok(None) };
            let fields = Fields(MessageCursor::packed(&header));
            let (Some(begin), Some(end)) = (fields.time_ns("start_time"), fields.time_ns("end_time")) else {
                return Ok(None);
            };
            let mut counts = MessageCursor::packed(&chunks.records);
            while let (Some(connection), Some(count)) = (counts.u32(), counts.u32()) {
                if let Some(&topic) = self.connections.get(&connection) {
                    chunks.topics.all[topic].add(u64::from(count), (begin, end));
                }
            }
        }
        self.indexed = !chunks.topics.all.is_empty();
        Ok(self.indexed.then_some(()))
    }

    fn read_record(
        &mut self,
        topics: &mut Topics,
        cursor: &mut MessageCursor<'_>,
    ) -> Option<Option<FoundMessage>> {
        let (header, data) = (cursor.bytes()?, cursor.bytes()?);
        let fields = Fields(MessageCursor::packed(header));
        Some(match fields.op() {
            op::CONNECTION => {
                self.register(topics, &fields, data);
                None
            }
            op::MESSAGE => (|| {
                let topic = *self.connections.get(&fields.u32("conn")?)?;
                Some(FoundMessage { topic, log_ns: fields.time_ns("time")?, length: data.len() })
            })(),
            _ => None,
        })
    }

    fn read_chunk(&mut self, chunks: &mut ChunkFile) -> Result<bool> {
        let mut header = Vec::new();
        loop {
            if chunks.file.remaining() == 0 {
                return Ok(false);
            }
            let Some(length) = read_head(&mut chunks.file, &mut header)? else {
                chunks.is_cut_off = true;
                return Ok(false);
            };
            let there = length.min(chunks.file.remaining());
            let whole = there == length;
            let fields = Fields(MessageCursor::packed(&header));
            match fields.op() {
                op::MESSAGE | op::CONNECTION if whole && length <= MAX_BYTES => {
                    chunks.file.fill(length, &mut chunks.packed)?;
                    for part in [&header, &chunks.packed] {
                        // Both lengths were read from 32 bits.
                        chunks.records.extend_from_slice(&(part.len() as u32).to_le_bytes());
                        chunks.records.extend_from_slice(part);
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
                    let bytes = if unfinished { chunks.file.remaining().min(MAX_BYTES) } else { length };
                    chunks.file.fill(bytes, &mut chunks.packed)?;
                    let most = if unfinished { MAX_BYTES } else { size.min(MAX_BYTES) };
                    let decompressed = compression.decompress(&chunks.packed, most, &mut chunks.records);
                    let is_whole = whole && !unfinished;
                    chunks.is_cut_off |= !is_whole;
                    if is_whole && !(decompressed && chunks.records.len() as u64 == size) {
                        // There is no checksum: what could be decompressed is used.
                        chunks.damaged += 1;
                    }
                    if !chunks.records.is_empty() {
                        return Ok(true);
                    }
                }
                _ if whole => chunks.file.skip(length)?,
                _ => {}
            }
            if !whole {
                chunks.is_cut_off = true;
                return Ok(false);
            }
        }
    }

    fn warnings(&self, chunks: &ChunkFile) -> Vec<String> {
        let mut warnings = Vec::new();
        if chunks.is_cut_off {
            warnings.push("the bag is cut off; it is read up to there".to_owned());
        } else if !self.indexed {
            warnings.push("the bag has no index; it is read from begin to end".to_owned());
        }
        if chunks.damaged > 0 {
            warnings.push(format!("{} chunks of the bag are damaged", chunks.damaged));
        }
        warnings
    }
}
