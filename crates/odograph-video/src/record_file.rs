//! Sequential reading of a file of records whose lengths may be damaged.

use crate::file_error::unreadable;
use odograph::error::Result;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};

/// A file of records.
pub(crate) struct RecordFile {
    file: BufReader<File>,
    length: u64,
    at: u64,
}

impl RecordFile {
    pub fn new(file: File) -> Result<Self> {
        let length = file.metadata().map_err(unreadable)?.len();
        let mut reader = Self { file: BufReader::with_capacity(1 << 16, file), length, at: 0 };
        reader.seek(0)?;
        Ok(reader)
    }

    pub fn length(&self) -> u64 {
        self.length
    }

    pub fn at(&self) -> u64 {
        self.at
    }

    pub fn remaining(&self) -> u64 {
        self.length.saturating_sub(self.at)
    }

    pub fn seek(&mut self, to: u64) -> Result<()> {
        self.file.seek(SeekFrom::Start(to)).map_err(unreadable)?;
        self.at = to;
        Ok(())
    }

    /// Skips bytes that exist.
    pub fn skip(&mut self, count: u64) -> Result<()> {
        let count = count.min(self.remaining());
        match i64::try_from(count) {
            Ok(step) => self.file.seek_relative(step).map_err(unreadable)?,
            Err(_) => return self.seek(self.at + count),
        }
        self.at += count;
        Ok(())
    }

    /// Reads `count` bytes, fewer at the end of the file; memory is allocated for those that exist.
    pub fn fill(&mut self, count: u64, into: &mut Vec<u8>) -> Result<()> {
        let there = count.min(self.remaining());
        into.clear();
        into.reserve(usize::try_from(there).unwrap_or(0));
        (&mut self.file).take(there).read_to_end(into).map_err(unreadable)?;
        self.at += into.len() as u64;
        Ok(())
    }
}

impl Read for RecordFile {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let read = self.file.read(bytes)?;
        self.at += read as u64;
        Ok(read)
    }
}
