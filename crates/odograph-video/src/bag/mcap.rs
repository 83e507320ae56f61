//! MCAP files (<https://mcap.dev/spec>): records of messages, plain or in compressed chunks.
//!
//! Read in the order of the file; the summary at its end is used for the list of topics. A file
//! without one, such as a truncated one, is read once more to list them.

use super::chunks::{ChunkFile, ChunkedFormat, FoundMessage, MAX_BYTES};
use super::compression::Compression;
use super::cursor::{MessageCursor, Serialization};
use super::recording::Topics;
use odograph::error::Result;
use std::collections::HashMap;

pub(super) const MAGIC: &[u8] = b"\x89MCAP0\r\n";
/// Length of the footer with the magic number behind it.
const FOOTER_BYTES: u64 = 37;

mod op {
    pub const FOOTER: u8 = 0x02;
    pub const SCHEMA: u8 = 0x03;
    pub const CHANNEL: u8 = 0x04;
    pub const MESSAGE: u8 = 0x05;
    pub const CHUNK: u8 = 0x06;
    pub const STATISTICS: u8 = 0x0b;
    pub const DATA_END: u8 = 0x0f;
}

/// The format of MCAP files.
#[derive(Default)]
pub(super) struct Mcap {
    /// Names of the message types by the number of their schema.
    schemas: HashMap<u16, String>,
    /// Topics by the number of their channel.
    channels: HashMap<u16, usize>,
}

impl Mcap {
    fn take_statistics(&mut self, topics: &mut Topics, body: &[u8]) -> Option<()> {
        let mut body = MessageCursor::packed(body);
        body.take(8 + 2 + 4 + 4 + 4 + 4)?;
        let span_ns = (body.u64()?, body.u64()?);
        let mut counts = MessageCursor::packed(body.bytes()?);
        let mut found = false;
        while let (Some(channel), Some(count)) = (counts.u16(), counts.u64()) {
            let topic = *self.channels.get(&channel)?;
            topics.all.get_mut(topic)?.add(count, span_ns);
            found = true;
        }
        found.then_some(())
    }

    /// Takes note of a schema or a channel.
    fn register(&mut self, topics: &mut Topics, kind: u8, body: &[u8]) {
        let mut body = MessageCursor::packed(body);
        let _: Option<()> = (|| {
            if kind == op::SCHEMA {
                self.schemas.insert(body.u16()?, body.string()?.into_owned());
            } else {
                let (channel, schema) = (body.u16()?, body.u16()?);
                let (name, serialization) = (body.string()?, body.string()?);
                let type_name = self.schemas.get(&schema).map_or("", String::as_str);
                let topic = topics.index(&name, type_name, Serialization::named(&serialization))?;
                self.channels.insert(channel, topic);
            }
            Some(())
        })();
    }
}

/// The next record: its kind and its body.
fn record<'a>(cursor: &mut MessageCursor<'a>) -> Option<(u8, &'a [u8])> {
    let (kind, length) = (cursor.u8()?, cursor.u64()?);
    Some((kind, cursor.take(usize::try_from(length).ok()?)?))
}

impl ChunkedFormat for Mcap {
    const NAME: &'static str = "an MCAP file";
    const MAGIC: &'static [u8] = MAGIC;
    const WRONG_MAGIC: &'static str = "this is not an MCAP file";

    fn read_summary(&mut self, chunks: &mut ChunkFile) -> Result<Option<()>> {
        let Some(footer_at) = chunks.file.length().checked_sub(FOOTER_BYTES) else { return Ok(None) };
        chunks.file.seek(footer_at)?;
        chunks.file.fill(FOOTER_BYTES, &mut chunks.packed)?;
        let mut footer = MessageCursor::packed(&chunks.packed);
        let Some((op::FOOTER, 20, summary)) = (|| Some((footer.u8()?, footer.u64()?, footer.u64()?)))()
        else {
            return Ok(None);
        };
        if !chunks.packed.ends_with(MAGIC) || !(MAGIC.len() as u64..footer_at).contains(&summary) {
            return Ok(None);
        }
        chunks.file.seek(summary)?;
        chunks.file.fill((footer_at - summary).min(MAX_BYTES), &mut chunks.records)?;
        let records = std::mem::take(&mut chunks.records);
        let mut cursor = MessageCursor::packed(&records);
        let mut counted = None;
        while let Some((kind, body)) = record(&mut cursor) {
            match kind {
                op::SCHEMA | op::CHANNEL => self.register(&mut chunks.topics, kind, body),
                op::STATISTICS => counted = self.take_statistics(&mut chunks.topics, body),
                _ => {}
            }
        }
        Ok(counted.filter(|()| !chunks.topics.all.is_empty()))
    }

    fn read_record(
        &mut self,
        topics: &mut Topics,
        cursor: &mut MessageCursor<'_>,
    ) -> Option<Option<FoundMessage>> {
        let (kind, body) = record(cursor)?;
        Some(match kind {
            op::SCHEMA | op::CHANNEL => {
                self.register(topics, kind, body);
                None
            }
            op::MESSAGE => (|| {
                let mut fields = MessageCursor::packed(body);
                let (channel, _, log_ns, _) = (fields.u16()?, fields.u32()?, fields.u64()?, fields.u64()?);
                let topic = *self.channels.get(&channel)?;
                Some(FoundMessage { topic, log_ns, length: body.len() - fields.position() })
            })(),
            _ => None,
        })
    }

    fn read_chunk(&mut self, chunks: &mut ChunkFile) -> Result<bool> {
        loop {
            let mut head = Vec::new();
            chunks.file.fill(9, &mut head)?;
            let mut cursor = MessageCursor::packed(&head);
            let (Some(kind), Some(length)) = (cursor.u8(), cursor.u64()) else {
                chunks.is_cut_off = true;
                return Ok(false);
            };
            let whole = length <= chunks.file.remaining();
            match kind {
                op::FOOTER | op::DATA_END => return Ok(false),
                op::SCHEMA | op::CHANNEL | op::MESSAGE if whole && length <= MAX_BYTES => {
                    chunks.file.fill(length, &mut chunks.packed)?;
                    chunks.records.extend_from_slice(&head);
                    chunks.records.extend_from_slice(&chunks.packed);
                    return Ok(true);
                }
                op::CHUNK if length.min(chunks.file.remaining()) <= MAX_BYTES => {
                    chunks.file.fill(length, &mut chunks.packed)?;
                    if unpack(chunks)? {
                        chunks.is_cut_off |= !whole;
                        return Ok(true);
                    }
                    chunks.damaged += u64::from(whole);
                }
                // Zero is not an operation: the rest of the file was never written.
                0 => {
                    chunks.is_cut_off = true;
                    return Ok(false);
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
            warnings.push("the recording is cut off; it is read up to there".to_owned());
        }
        if chunks.damaged > 0 {
            let damaged = chunks.damaged;
            warnings.push(format!("{damaged} damaged chunks of the recording were left out"));
        }
        warnings
    }
}

/// Unpacks the chunk in `packed`; false if it is damaged. Of a chunk that is cut off, what
/// there is of it is unpacked.
fn unpack(chunks: &mut ChunkFile) -> Result<bool> {
    let mut body = MessageCursor::packed(&chunks.packed);
    let head = (|| {
        body.take(16)?;
        Some((body.u64()?, body.u32()?, body.string()?, body.u64()?))
    })();
    let Some((size, checksum, compression, packed_size)) = head else { return Ok(false) };
    let compression = Compression::named(&compression)?;
    let records = &chunks.packed[body.position()..];
    let there = records.len().min(usize::try_from(packed_size).unwrap_or(usize::MAX));
    let is_cut_off = (there as u64) < packed_size;
    if size > MAX_BYTES {
        return Ok(false);
    }
    let whole = compression.decompress(&records[..there], size, &mut chunks.records);
    if is_cut_off {
        return Ok(!chunks.records.is_empty());
    }
    let right = checksum == 0 || crc32fast::hash(&chunks.records) == checksum;
    if !whole || !right || chunks.records.len() as u64 != size {
        chunks.records.clear();
        return Ok(false);
    }
    Ok(true)
}
