//! Raw H.264 and H.265 streams: NAL units between start codes, without timestamps (Annex B of both
//! standards).

use super::{Packet, PacketReader, Times, VideoCodec, VideoTrack};
use crate::file_error::unreadable;
use crate::limits;
use crate::nal::find_start_code;
use odograph::error::{Error, Result};
use std::fs::File;
use std::io::{Read, Seek};

const READ_BYTES: u64 = 1 << 18;

/// Identifies the codec of a raw stream from its first bytes; `None` if it is not a raw stream.
pub(crate) fn codec(bytes: &[u8]) -> Option<VideoCodec> {
    let after = match bytes {
        [0, 0, 1, rest @ ..] | [0, 0, 0, 1, rest @ ..] => rest,
        _ => return None,
    };
    match after {
        // VPS, SPS, PPS, access unit delimiter or SEI of the base layer, temporal layer 0.
        [0x40 | 0x42 | 0x44 | 0x46 | 0x4e, 1, ..] => Some(VideoCodec::H265),
        [head, ..]
            if head & 0x80 == 0
                && matches!((head & 31, head >> 5), (7 | 8 | 5, 1..) | (6 | 9, 0) | (1, _)) =>
        {
            Some(VideoCodec::H264)
        }
        _ => None,
    }
}

/// Reads a raw stream access unit by access unit.
pub(crate) struct AnnexBReader {
    file: File,
    track: VideoTrack,
    buffer: Vec<u8>,
    /// Position up to which the buffer has been searched for start codes.
    searched: usize,
    /// Start of the current unit, and whether a slice precedes it in this access unit.
    unit: Option<usize>,
    slice_seen: bool,
    at_end: bool,
    number: u64,
}

impl AnnexBReader {
    pub fn open(file: File, codec: VideoCodec) -> Self {
        let track = VideoTrack::new("a raw stream", codec, Times::Unknown);
        Self {
            file,
            track,
            buffer: Vec::new(),
            searched: 0,
            unit: None,
            slice_seen: false,
            at_end: false,
            number: 0,
        }
    }

    /// Whether a unit after a slice starts a new access unit, and whether it is a slice (H.264
    /// 7.4.1.2.3, H.265 7.4.2.4.4).
    fn role(&self, unit: &[u8]) -> (bool, bool) {
        let [first, second, rest @ ..] = unit else { return (false, false) };
        if self.track.codec == VideoCodec::H265 {
            let starts_picture = rest.first().is_some_and(|b| b & 0x80 != 0);
            match first >> 1 & 63 {
                0..=31 => (starts_picture, true),
                32..=35 | 39 | 41..=44 | 48..=55 => (true, false),
                _ => (false, false),
            }
        } else {
            match first & 31 {
                // The first bit of a slice is set if its first macroblock is the first of the
                // picture.
                1..=5 => (second & 0x80 != 0, true),
                6..=9 | 14..=18 => (true, false),
                _ => (false, false),
            }
        }
    }

    /// End of the access unit at the front of the buffer; `None` if more data is needed.
    fn end_of_access_unit(&mut self) -> Option<usize> {
        loop {
            if let Some(start) = self.unit {
                // The role of a unit follows from its first three bytes.
                if self.buffer.len() < start + 3 && !self.at_end {
                    return None;
                }
                let (starts, is_slice) = self.role(&self.buffer[start..]);
                if starts && self.slice_seen {
                    self.slice_seen = false;
                    return Some(start - 3);
                }
                self.slice_seen |= is_slice;
                self.unit = None;
            }
            match find_start_code(&self.buffer, self.searched) {
                Some(code) => {
                    self.searched = code + 3;
                    self.unit = Some(code + 3);
                }
                None => {
                    self.searched = self.searched.max(self.buffer.len().saturating_sub(2));
                    return None;
                }
            }
        }
    }
}

impl PacketReader for AnnexBReader {
    fn track(&self) -> &VideoTrack {
        &self.track
    }

    fn next_packet(&mut self, packet: &mut Packet) -> Result<bool> {
        let end = loop {
            if let Some(end) = self.end_of_access_unit() {
                break end;
            }
            if self.at_end {
                break self.buffer.len();
            }
            if self.buffer.len() as u64 > limits::MAX_SAMPLE_BYTES {
                return Err(Error::input("a frame takes more than 256 MB"));
            }
            let read = (&mut self.file).take(READ_BYTES).read_to_end(&mut self.buffer).map_err(unreadable)?;
            self.at_end = read == 0;
        };
        if end == 0 {
            return Ok(false);
        }
        packet.data.clear();
        packet.data.extend(self.buffer.drain(..end));
        self.searched = self.searched.saturating_sub(end);
        self.unit = self.unit.and_then(|unit| unit.checked_sub(end));
        packet.time_s = self.number as f64;
        packet.shown = true;
        self.number += 1;
        Ok(true)
    }

    fn rewind(&mut self) -> Result<()> {
        self.file.rewind().map_err(unreadable)?;
        self.buffer.clear();
        (self.searched, self.unit, self.slice_seen, self.at_end, self.number) = (0, None, false, false, 0);
        Ok(())
    }

    fn take_warnings(&mut self) -> Vec<String> {
        Vec::new()
    }
}
