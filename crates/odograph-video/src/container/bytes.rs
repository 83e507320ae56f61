//! Bounds-checked parsing of integers.

use crate::file_error::unreadable;
use crate::limits;
use odograph::error::{Error, Result};
use std::io::Read;

/// Cursor over a slice; every read returns `None` past the end.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bytes<'a> {
    rest: &'a [u8],
}

impl<'a> Bytes<'a> {
    pub fn new(rest: &'a [u8]) -> Self {
        Self { rest }
    }

    pub fn rest(&self) -> &'a [u8] {
        self.rest
    }

    pub fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.rest.split_at_checked(count)?;
        self.rest = rest;
        Some(taken)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        self.take(N)?.try_into().ok()
    }

    pub fn skip(&mut self, count: usize) -> Option<()> {
        self.take(count).map(|_| ())
    }

    pub fn u8(&mut self) -> Option<u8> {
        self.array::<1>().map(|[byte]| byte)
    }

    pub fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_be_bytes)
    }

    pub fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_be_bytes)
    }

    pub fn i32(&mut self) -> Option<i32> {
        self.array().map(i32::from_be_bytes)
    }

    pub fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_be_bytes)
    }

    pub fn u32_le(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }
}

/// Reads up to `count` bytes, fewer at the end of the file. Memory is allocated only for bytes that
/// exist.
pub(crate) fn read_up_to(reader: &mut impl Read, count: u64, into: &mut Vec<u8>) -> Result<()> {
    into.clear();
    if count > limits::MAX_INDEX_BYTES {
        return Err(Error::input(format!(
            "a part of {count} bytes is larger than anything this program takes"
        )));
    }
    reader.take(count).read_to_end(into).map_err(unreadable)?;
    Ok(())
}
