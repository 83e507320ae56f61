//! The boxes of an MP4 file, and the samples that they list.

use super::bytes::Bytes;
use crate::limits::MAX_SAMPLES;
use odograph::error::Error;

/// Offset and size of a sample in the file, and its timestamp in the track's ticks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Sample {
    pub offset: u64,
    pub size: u32,
    pub time: i64,
}

/// Type, header length and total size of a box; `None` if it is not a box. A size of 0 extends the
/// box to the end, `available` bytes away.
pub(super) fn box_header(bytes: &[u8], available: u64) -> Option<([u8; 4], u64, u64)> {
    let mut bytes = Bytes::new(bytes);
    let short = bytes.u32()?;
    let kind: [u8; 4] = bytes.take(4)?.try_into().ok()?;
    if !kind.iter().all(|c| c.is_ascii_graphic() || *c == b' ' || *c == 0xa9) {
        return None;
    }
    match short {
        0 => Some((kind, 8, available.max(8))),
        1 => bytes.u64().filter(|&size| size >= 16).map(|size| (kind, 16, size)),
        2..=7 => None,
        size => Some((kind, 8, u64::from(size))),
    }
}

/// Iterates over the boxes inside a box; the last one may be truncated.
pub(super) struct Boxes<'a>(pub &'a [u8]);

impl<'a> Iterator for Boxes<'a> {
    type Item = ([u8; 4], &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let (kind, header, size) = box_header(self.0, self.0.len() as u64)?;
        let end = usize::try_from(size).unwrap_or(usize::MAX).min(self.0.len());
        let payload = self.0.get(header as usize..end)?;
        self.0 = &self.0[end..];
        Some((kind, payload))
    }
}

/// The first box of a given type inside another.
pub(super) fn child<'a>(parent: &'a [u8], kind: &[u8; 4]) -> Option<Bytes<'a>> {
    Boxes(parent).find(|(k, _)| k == kind).map(|(_, payload)| Bytes::new(payload))
}

pub(super) fn too_many() -> Error {
    Error::input(format!("the index claims more than {MAX_SAMPLES} frames"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heads_of_boxes() {
        assert_eq!(box_header(b"\0\0\0\x10moov", 99), Some((*b"moov", 8, 16)));
        assert_eq!(box_header(b"\0\0\0\x00mdat", 99), Some((*b"mdat", 8, 99)));
        assert_eq!(box_header(b"\0\0\0\x01mdat\0\0\0\x01\0\0\0\0", 99), Some((*b"mdat", 16, 1 << 32)));
        assert_eq!(box_header(b"\0\0\0\x04moov", 99), None);
        assert_eq!(box_header(b"\0\0\0\x10\x01oov", 99), None);
    }
}
