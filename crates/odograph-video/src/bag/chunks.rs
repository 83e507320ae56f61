//! Reading of formats whose messages lie in chunks of records, in the order of the file.

use super::cursor::MessageCursor;
use super::recording::{Message, MessageReader, Topic, Topics};
use crate::record_file::RecordFile;
use odograph::error::{Error, Result};
use std::fs::File;
use std::ops::Range;

/// Largest chunk or message, bytes.
pub(super) const MAX_BYTES: u64 = crate::limits::MAX_INDEX_BYTES;

/// A file of chunks, and what of it is in memory.
pub(super) struct ChunkFile {
    pub file: RecordFile,
    pub topics: Topics,
    /// The records of the current chunk. A record outside of any chunk is a chunk of one.
    pub records: Vec<u8>,
    /// The chunk as it is in the file.
    pub packed: Vec<u8>,
    pub is_cut_off: bool,
    /// Number of damaged chunks.
    pub damaged: u64,
}

/// A message of a known topic in a record.
pub(super) struct FoundMessage {
    pub topic: usize,
    pub log_ns: u64,
    /// Length of its data at the end of the record, bytes.
    pub length: usize,
}

/// A format whose messages lie in chunks of records. Its default value knows no topics.
pub(super) trait ChunkedFormat: Default + Send {
    /// Name for people, with its article.
    const NAME: &'static str;
    /// The first bytes of a file.
    const MAGIC: &'static [u8];
    /// Message about a file with other first bytes.
    const WRONG_MAGIC: &'static str;

    /// Reads topics and their numbers of messages; `None` if the file has no valid list of them.
    fn read_summary(&mut self, chunks: &mut ChunkFile) -> Result<Option<()>>;

    /// Reads chunks up to one that is not damaged; false at the end of the data.
    fn read_chunk(&mut self, chunks: &mut ChunkFile) -> Result<bool>;

    /// Reads the next record of a chunk; `None` at its end.
    fn read_record(
        &mut self,
        topics: &mut Topics,
        cursor: &mut MessageCursor<'_>,
    ) -> Option<Option<FoundMessage>>;

    /// What was wrong with the file, known at its end.
    fn warnings(&self, chunks: &ChunkFile) -> Vec<String>;
}

/// Reads a file of a format with chunks.
pub(super) struct ChunkReader<F> {
    format: F,
    chunks: ChunkFile,
    /// Position of the next record in the chunk.
    next: usize,
    /// Topic, log time and position in the chunk of the current message.
    current: (usize, u64, Range<usize>),
    ended: bool,
    warned: bool,
}

impl<F: ChunkedFormat> ChunkReader<F> {
    pub fn open(file: File) -> Result<Self> {
        let chunks = ChunkFile {
            file: RecordFile::new(file)?,
            topics: Topics::default(),
            records: Vec::new(),
            packed: Vec::new(),
            is_cut_off: false,
            damaged: 0,
        };
        let (next, current) = (0, (0, 0, 0..0));
        let mut reader = Self { format: F::default(), chunks, next, current, ended: false, warned: false };
        reader.rewind()?;
        if reader.format.read_summary(&mut reader.chunks)?.is_none() {
            // What a damaged summary listed is forgotten.
            (reader.format, reader.chunks.topics) = (F::default(), Topics::default());
            reader.rewind()?;
            while reader.advance()? {
                let Message { topic, log_ns, .. } = reader.message();
                reader.chunks.topics.all[topic].add(1, (log_ns, log_ns));
            }
        }
        reader.rewind()?;
        Ok(reader)
    }

    /// Advances to the next wanted message of the chunk.
    fn advance_in_chunk(&mut self) -> bool {
        loop {
            let rest = self.chunks.records.get(self.next..).unwrap_or_default();
            let mut cursor = MessageCursor::packed(rest);
            let topics = &mut self.chunks.topics;
            let Some(message) = self.format.read_record(topics, &mut cursor) else { return false };
            self.next += cursor.position();
            if let Some(FoundMessage { topic, log_ns, length }) = message
                && topics.is_wanted(topic)
            {
                self.current = (topic, log_ns, self.next - length..self.next);
                return true;
            }
        }
    }

    fn clear(&mut self) {
        self.chunks.records.clear();
        (self.next, self.current) = (0, (0, 0, 0..0));
    }
}

impl<F: ChunkedFormat> MessageReader for ChunkReader<F> {
    fn format(&self) -> String {
        F::NAME.to_owned()
    }

    fn topics(&self) -> &[Topic] {
        &self.chunks.topics.all
    }

    fn select(&mut self, wanted: &dyn Fn(&Topic) -> bool) {
        self.chunks.topics.select(wanted);
    }

    fn advance(&mut self) -> Result<bool> {
        while !self.ended {
            if self.advance_in_chunk() {
                return Ok(true);
            }
            self.clear();
            self.ended = !self.format.read_chunk(&mut self.chunks)?;
        }
        self.clear();
        Ok(false)
    }

    fn message(&self) -> Message<'_> {
        let (topic, log_ns, range) = &self.current;
        let data = self.chunks.records.get(range.clone()).unwrap_or_default();
        Message { topic: *topic, log_ns: *log_ns, data }
    }

    fn rewind(&mut self) -> Result<()> {
        let mut magic = Vec::new();
        self.chunks.file.seek(0)?;
        self.chunks.file.fill(F::MAGIC.len() as u64, &mut magic)?;
        if magic != F::MAGIC {
            return Err(Error::input(F::WRONG_MAGIC));
        }
        self.clear();
        (self.ended, self.chunks.damaged) = (false, 0);
        Ok(())
    }

    fn take_warnings(&mut self) -> Vec<String> {
        if !self.ended || self.warned {
            return Vec::new();
        }
        self.warned = true;
        self.format.warnings(&self.chunks)
    }
}
