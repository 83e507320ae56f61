//! MCAP files (<https://mcap.dev/spec>): records of messages, plain or in compressed chunks.
//!
//! Read in the order of the file; the summary at its end is used for the list of topics. A file
//! without one, such as a truncated one, is read once more to list them.

use super::compression::Compression;
use super::cursor::{MessageCursor, Serialization};
use super::reader::RecordFile;
use super::recording::{Message, MessageReader, Topic, Topics, count};
use odograph::error::{Error, Result};
use std::collections::HashMap;
use std::fs::File;
use std::ops::Range;

pub(super) const MAGIC: &[u8] = b"\x89MCAP0\r\n";
/// Length of the footer with the magic number behind it.
const FOOTER_BYTES: u64 = 37;
/// Largest chunk or message, bytes.
const MAX_BYTES: u64 = crate::limits::MAX_INDEX_BYTES;

mod op {
    pub const FOOTER: u8 = 0x02;
    pub const SCHEMA: u8 = 0x03;
    pub const CHANNEL: u8 = 0x04;
    pub const MESSAGE: u8 = 0x05;
    pub const CHUNK: u8 = 0x06;
    pub const STATISTICS: u8 = 0x0b;
    pub const DATA_END: u8 = 0x0f;
}

/// Reads an MCAP file.
pub(super) struct Mcap {
    file: RecordFile,
    topics: Topics,
    /// Names of the message types by the number of their schema.
    schemas: HashMap<u16, String>,
    /// Topics by the number of their channel.
    channels: HashMap<u16, usize>,
    /// The records of the current chunk, and the position of the next one. A record outside of any
    /// chunk is a chunk of one.
    chunk: Vec<u8>,
    next: usize,
    packed: Vec<u8>,
    current: (usize, u64, Range<usize>),
    ended: bool,
    cut_off: bool,
    damaged_chunks: u64,
    warned: bool,
}

impl Mcap {
    pub fn open(file: File) -> Result<Self> {
        let mut mcap = Self {
            file: RecordFile::new(file)?,
            topics: Topics::default(),
            schemas: HashMap::new(),
            channels: HashMap::new(),
            chunk: Vec::new(),
            next: 0,
            packed: Vec::new(),
            current: (0, 0, 0..0),
            ended: false,
            cut_off: false,
            damaged_chunks: 0,
            warned: false,
        };
        if mcap.read_summary()?.is_none() {
            // What a damaged summary listed is forgotten, numbers of channels included.
            mcap.topics = Topics::default();
            mcap.schemas.clear();
            mcap.channels.clear();
            mcap.rewind()?;
            count(&mut mcap, |mcap, topic, log_ns| mcap.topics.all[topic].add(1, (log_ns, log_ns)))?;
        }
        mcap.rewind()?;
        Ok(mcap)
    }

    /// Reads topics and their numbers of messages from the summary; `None` if there is none, or
    /// not with these.
    fn read_summary(&mut self) -> Result<Option<()>> {
        let Some(footer_at) = self.file.length().checked_sub(FOOTER_BYTES) else { return Ok(None) };
        self.file.seek(footer_at)?;
        self.file.read(FOOTER_BYTES, &mut self.packed)?;
        let mut footer = MessageCursor::packed(&self.packed);
        let Some((op::FOOTER, 20, summary)) = (|| Some((footer.u8()?, footer.u64()?, footer.u64()?)))()
        else {
            return Ok(None);
        };
        if !self.packed.ends_with(MAGIC) || !(MAGIC.len() as u64..footer_at).contains(&summary) {
            return Ok(None);
        }
        self.file.seek(summary)?;
        self.file.read((footer_at - summary).min(MAX_BYTES), &mut self.chunk)?;
        let records = std::mem::take(&mut self.chunk);
        let mut cursor = MessageCursor::packed(&records);
        let mut counted = None;
        while let Some((kind, body)) = record(&mut cursor) {
            match kind {
                op::SCHEMA | op::CHANNEL => self.register(kind, body),
                op::STATISTICS => counted = self.take_statistics(body),
                _ => {}
            }
        }
        Ok(counted.filter(|()| !self.topics.all.is_empty()))
    }

    fn take_statistics(&mut self, body: &[u8]) -> Option<()> {
        let mut body = MessageCursor::packed(body);
        body.take(8 + 2 + 4 + 4 + 4 + 4)?;
        let span_ns = (body.u64()?, body.u64()?);
        let mut counts = MessageCursor::packed(body.bytes()?);
        let mut found = false;
        while let (Some(channel), Some(count)) = (counts.u16(), counts.u64()) {
            let topic = *self.channels.get(&channel)?;
            self.topics.all.get_mut(topic)?.add(count, span_ns);
            found = true;
        }
        found.then_some(())
    }

    /// Takes note of a schema or a channel.
    fn register(&mut self, kind: u8, body: &[u8]) {
        let mut body = MessageCursor::packed(body);
        let _: Option<()> = (|| {
            if kind == op::SCHEMA {
                self.schemas.insert(body.u16()?, body.string()?.into_owned());
            } else {
                let (channel, schema) = (body.u16()?, body.u16()?);
                let (name, serialization) = (body.string()?, body.string()?);
                let type_name = self.schemas.get(&schema).map_or("", String::as_str);
                let topic = self.topics.index(&name, type_name, Serialization::named(&serialization))?;
                self.channels.insert(channel, topic);
            }
            Some(())
        })();
    }

    /// Advances to the next wanted message of the chunk.
    fn advance_in_chunk(&mut self) -> bool {
        let chunk = std::mem::take(&mut self.chunk);
        let mut found = false;
        while !found {
            let mut cursor = MessageCursor::packed(chunk.get(self.next..).unwrap_or_default());
            let Some((kind, body)) = record(&mut cursor) else { break };
            self.next += cursor.position();
            match kind {
                op::SCHEMA | op::CHANNEL => self.register(kind, body),
                op::MESSAGE => {
                    let mut fields = MessageCursor::packed(body);
                    let head = (|| Some((fields.u16()?, fields.u32()?, fields.u64()?, fields.u64()?)))();
                    let topic = head.and_then(|(channel, ..)| self.channels.get(&channel));
                    if let (Some((_, _, log_ns, _)), Some(&topic)) = (head, topic)
                        && self.topics.is_wanted(topic)
                    {
                        let begin = self.next - body.len() + fields.position();
                        self.current = (topic, log_ns, begin..self.next);
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
        loop {
            let mut head = Vec::new();
            self.file.read(9, &mut head)?;
            let mut cursor = MessageCursor::packed(&head);
            let (Some(kind), Some(length)) = (cursor.u8(), cursor.u64()) else {
                self.cut_off = true;
                return Ok(false);
            };
            let whole = length <= self.file.remaining();
            match kind {
                op::FOOTER | op::DATA_END => return Ok(false),
                op::SCHEMA | op::CHANNEL | op::MESSAGE if whole && length <= MAX_BYTES => {
                    self.file.read(length, &mut self.packed)?;
                    self.chunk.extend_from_slice(&head);
                    self.chunk.extend_from_slice(&self.packed);
                    return Ok(true);
                }
                op::CHUNK if length.min(self.file.remaining()) <= MAX_BYTES => {
                    self.file.read(length, &mut self.packed)?;
                    if self.unpack()? {
                        self.cut_off |= !whole;
                        return Ok(true);
                    }
                    self.damaged_chunks += u64::from(whole);
                }
                // Zero is not an operation: the rest of the file was never written.
                0 => {
                    self.cut_off = true;
                    return Ok(false);
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

    /// Unpacks the chunk in `packed`; false if it is damaged. Of a chunk that is cut off, what
    /// there is of it is unpacked.
    fn unpack(&mut self) -> Result<bool> {
        let mut body = MessageCursor::packed(&self.packed);
        let head = (|| {
            body.take(16)?;
            Some((body.u64()?, body.u32()?, body.string()?, body.u64()?))
        })();
        let Some((size, checksum, compression, packed_size)) = head else { return Ok(false) };
        let compression = Compression::named(&compression)?;
        let records = &self.packed[body.position()..];
        let there = records.len().min(usize::try_from(packed_size).unwrap_or(usize::MAX));
        let is_cut_off = (there as u64) < packed_size;
        if size > MAX_BYTES {
            return Ok(false);
        }
        let whole = compression.decompress(&records[..there], size, &mut self.chunk);
        if is_cut_off {
            return Ok(!self.chunk.is_empty());
        }
        let right = checksum == 0 || crc32fast::hash(&self.chunk) == checksum;
        if !whole || !right || self.chunk.len() as u64 != size {
            self.chunk.clear();
            return Ok(false);
        }
        Ok(true)
    }
}

/// The next record: its kind and its body.
fn record<'a>(cursor: &mut MessageCursor<'a>) -> Option<(u8, &'a [u8])> {
    let (kind, length) = (cursor.u8()?, cursor.u64()?);
    Some((kind, cursor.take(usize::try_from(length).ok()?)?))
}

impl MessageReader for Mcap {
    fn format(&self) -> String {
        "an MCAP file".to_owned()
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
        self.file.read(MAGIC.len() as u64, &mut magic)?;
        if magic != MAGIC {
            return Err(Error::input("this is not an MCAP file"));
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
                warnings.push("the recording is cut off; it is read up to there".to_owned());
            }
            if self.damaged_chunks > 0 {
                let damaged = self.damaged_chunks;
                warnings.push(format!("{damaged} damaged chunks of the recording were left out"));
            }
        }
        warnings
    }
}
