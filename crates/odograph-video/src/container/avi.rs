//! AVI (Microsoft RIFF, with the OpenDML extension for large files), also without an index, also cut off.
//!
//! The chunks are walked from front to back; no index is needed, so that a recording whose end is missing plays to the cut.

use super::bytes::{Bytes, read_up_to};
use super::{Codec, Packet, PacketReader, Times, Track};
use crate::limits;
use crate::rotation::Orientation;
use odograph::error::{Error, Result};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};

/// The samples of the first video stream of an AVI file.
pub(crate) struct AviReader {
    file: BufReader<File>,
    length: u64,
    at: u64,
    first_sample: u64,
    track: Track,
    /// The stream's number as the two digits its chunks start with.
    stream: [u8; 2],
    frame_s: f64,
    starts_at: f64,
    number: u64,
    warnings: Vec<String>,
}

impl AviReader {
    pub fn open(file: File) -> Result<Self> {
        let length = file.metadata().map(|m| m.len()).unwrap_or(0);
        let mut reader = Self {
            file: BufReader::with_capacity(1 << 16, file),
            length,
            at: 0,
            first_sample: 0,
            track: Track {
                container: "AVI",
                codec: Codec::Other(String::new()),
                width: 0,
                height: 0,
                configuration: Vec::new(),
                frame_count: None,
                orientation: Orientation::default(),
                encoding: None,
                times: Times::Decoding,
            },
            stream: *b"  ",
            frame_s: 0.0,
            starts_at: 0.0,
            number: 0,
            warnings: Vec::new(),
        };
        reader.read_head()?;
        Ok(reader)
    }

    fn read_head(&mut self) -> Result<()> {
        let mut found = false;
        while let Some((kind, size)) = self.chunk()? {
            match &kind {
                b"RIFF" => {
                    self.list_kind()?;
                }
                b"LIST" => {
                    let inside = self.list_kind()?;
                    if &inside == b"movi" {
                        self.first_sample = self.at;
                        break;
                    }
                    let mut payload = Vec::new();
                    read_up_to(&mut self.file, u64::from(size).saturating_sub(4), &mut payload)?;
                    self.at += payload.len() as u64;
                    self.align(u64::from(size))?;
                    if &inside == b"hdrl" && !found {
                        found = self.read_streams(&payload).is_some();
                    }
                }
                _ => self.skip(u64::from(size))?,
            }
        }
        if !found {
            return Err(Error::input("there is no video in this AVI file, or its head is damaged"));
        }
        if self.first_sample == 0 {
            return Err(Error::input("the AVI file is cut off before its first frame"));
        }
        Ok(())
    }

    /// Finds the first video stream among the lists of the head.
    fn read_streams(&mut self, head: &[u8]) -> Option<()> {
        let lists = Chunks { rest: head }.filter(|(k, p)| k == b"LIST" && p.starts_with(b"strl"));
        for (number, (_, list)) in lists.enumerate() {
            let chunk =
                |wanted: &[u8; 4]| Chunks { rest: &list[4..] }.find(|(k, _)| k == wanted).map(|(_, p)| p);
            let Some(mut header) = chunk(b"strh").map(Bytes::new) else { continue };
            if header.take(4)? != b"vids" {
                continue;
            }
            header.skip(16)?;
            let (scale, rate) = (header.u32_le()?, header.u32_le()?);
            let (start, count) = (header.u32_le()?, header.u32_le()?);
            if number > 99 {
                return None;
            }
            self.stream = [b'0' + (number / 10) as u8, b'0' + (number % 10) as u8];
            self.track.frame_count = (count > 0).then_some(u64::from(count));
            if scale > 0 && rate > 0 {
                self.frame_s = f64::from(scale) / f64::from(rate);
            } else {
                (self.frame_s, self.track.times) = (1.0, Times::Unknown);
            }
            self.starts_at = f64::from(start) * self.frame_s;
            let mut format = Bytes::new(chunk(b"strf")?);
            format.skip(4)?;
            self.track.width = format.u32_le()? as usize;
            self.track.height = (format.u32_le()? as i32).unsigned_abs() as usize;
            format.skip(4)?;
            self.track.codec = codec(format.take(4)?);
            return Some(());
        }
        None
    }

    /// The head of the next chunk; `None` at the end.
    fn chunk(&mut self) -> Result<Option<([u8; 4], u32)>> {
        let mut head = [0u8; 8];
        if self.length.saturating_sub(self.at) < 8 {
            return Ok(None);
        }
        self.file.read_exact(&mut head).map_err(unreadable)?;
        self.at += 8;
        let [a, b, c, d, size @ ..] = head;
        Ok(Some(([a, b, c, d], u32::from_le_bytes(size))))
    }

    fn list_kind(&mut self) -> Result<[u8; 4]> {
        let mut kind = [0u8; 4];
        if self.length.saturating_sub(self.at) >= 4 {
            self.file.read_exact(&mut kind).map_err(unreadable)?;
            self.at += 4;
        }
        Ok(kind)
    }

    /// Chunks of odd size are followed by a byte of padding.
    fn align(&mut self, size: u64) -> Result<()> {
        if size % 2 == 1 && self.at < self.length {
            self.file.seek_relative(1).map_err(unreadable)?;
            self.at += 1;
        }
        Ok(())
    }

    fn skip(&mut self, size: u64) -> Result<()> {
        let skipped = size.min(self.length - self.at);
        self.file.seek_relative(skipped as i64).map_err(unreadable)?;
        self.at += skipped;
        self.align(size)
    }
}

impl PacketReader for AviReader {
    fn track(&self) -> &Track {
        &self.track
    }

    fn next_packet(&mut self, packet: &mut Packet) -> Result<bool> {
        while let Some((kind, size)) = self.chunk()? {
            let size = u64::from(size);
            match &kind {
                b"RIFF" | b"LIST" => {
                    let inside = self.list_kind()?;
                    if !matches!(&inside, b"AVIX" | b"movi" | b"rec ") {
                        self.skip(size.saturating_sub(4))?;
                    }
                }
                [a, b, b'd', b'c' | b'b'] if [*a, *b] == self.stream => {
                    let number = self.number;
                    self.number += 1;
                    if size > limits::MAX_SAMPLE_BYTES {
                        return Err(Error::input(format!("frame {number} claims to take more than 256 MB")));
                    }
                    if size > self.length - self.at {
                        self.warnings.push(format!("the file is cut off inside frame {number}"));
                        return Ok(false);
                    }
                    read_up_to(&mut self.file, size, &mut packet.data)?;
                    self.at += size;
                    self.align(size)?;
                    packet.time_s = self.starts_at + number as f64 * self.frame_s;
                    packet.shown = true;
                    // An empty chunk repeats the frame before it: nothing was seen then.
                    if size > 0 {
                        return Ok(true);
                    }
                }
                _ if kind.iter().all(|c| c.is_ascii_graphic() || *c == b' ') => {
                    if size > self.length - self.at {
                        self.warnings.push("the file is cut off".to_string());
                    }
                    self.skip(size)?;
                }
                _ => {
                    self.warnings.push(format!("what follows byte {} is not AVI and was ignored", self.at));
                    return Ok(false);
                }
            }
        }
        Ok(false)
    }

    fn rewind(&mut self) -> Result<()> {
        self.file.seek(SeekFrom::Start(self.first_sample)).map_err(unreadable)?;
        (self.at, self.number) = (self.first_sample, 0);
        Ok(())
    }

    fn take_warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }
}

/// The chunks inside a list; the last one may be cut off.
struct Chunks<'a> {
    rest: &'a [u8],
}

impl<'a> Iterator for Chunks<'a> {
    type Item = ([u8; 4], &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let mut bytes = Bytes::new(self.rest);
        let kind: [u8; 4] = bytes.take(4)?.try_into().ok()?;
        let size = bytes.u32_le()? as usize;
        let payload = bytes.take(size.min(bytes.rest().len()))?;
        self.rest = bytes.rest().get(size % 2..).unwrap_or_default();
        Some((kind, payload))
    }
}

/// The codec of a stream from its four letters.
pub(super) fn codec(letters: &[u8]) -> Codec {
    match letters.to_ascii_uppercase().as_slice() {
        b"H264" | b"X264" | b"AVC1" | b"DAVC" | b"VSSH" => Codec::H264,
        b"HEVC" | b"H265" | b"HVC1" | b"X265" => Codec::H265,
        b"MJPG" | b"JPEG" | b"AVRN" | b"DMB1" => Codec::MotionJpeg,
        b"VP90" => Codec::Vp9,
        b"VP80" => Codec::Other("VP8".into()),
        b"AV01" => Codec::Other("AV1".into()),
        b"XVID" | b"DIVX" | b"DX50" | b"FMP4" | b"MP4V" | b"MP4S" | b"M4S2" | b"3IV2" => {
            Codec::Other("MPEG-4 part 2 video".into())
        }
        b"DIV3" | b"MP43" | b"DIV4" | b"COL1" | b"AP41" => Codec::Other("MSMPEG4 version 3".into()),
        b"MP42" | b"DIV2" => Codec::Other("MSMPEG4 version 2".into()),
        b"CVID" => Codec::Other("Cinepak".into()),
        b"FFV1" => Codec::Other("FFV1".into()),
        b"\0\0\0\0" | b"DIB " | b"YUY2" | b"UYVY" | b"I420" | b"YV12" | b"Y800" | b"GREY" => {
            Codec::Other("uncompressed video".into())
        }
        other => Codec::Other(format!("'{}' video", String::from_utf8_lossy(other).trim())),
    }
}

fn unreadable(error: std::io::Error) -> Error {
    Error::input(format!("cannot be read: {error}"))
}
