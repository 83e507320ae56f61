//! AVI (Microsoft RIFF, with the OpenDML extension for large files), including truncated files and
//! files without an index.
//!
//! The chunks are read sequentially and no index is needed, so a truncated recording plays up to
//! the truncation.

use super::bytes::{Bytes, read_up_to};
use super::{Packet, PacketReader, Times, VideoCodec, VideoTrack};
use crate::file_error::unreadable;
use crate::limits;
use crate::record_file::RecordFile;
use odograph::error::{Error, Result};
use std::fs::File;
use std::io::Read;

/// Reads the samples of the first video stream of an AVI file.
pub(crate) struct AviReader {
    file: RecordFile,
    first_sample: u64,
    track: VideoTrack,
    /// Stream number: the two digits that its chunk names start with.
    stream: [u8; 2],
    /// The frame duration is `scale / rate` seconds; the first frame starts after `start` frames.
    scale: u32,
    rate: u32,
    start: u32,
    number: u64,
    warnings: Vec<String>,
}

/// Progress in reading the header of the video stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Head {
    Searching,
    HeaderSeen,
    Complete,
}

impl AviReader {
    pub fn open(file: File) -> Result<Self> {
        let mut reader = Self {
            file: RecordFile::new(file)?,
            first_sample: 0,
            track: VideoTrack::new("AVI", VideoCodec::Other(String::new()), Times::Decoding),
            stream: *b"  ",
            scale: 1,
            rate: 1,
            start: 0,
            number: 0,
            warnings: Vec::new(),
        };
        reader.read_head()?;
        Ok(reader)
    }

    /// Reads up to the first sample. The lists of the header are entered regardless of their
    /// lengths, which some writers get wrong.
    fn read_head(&mut self) -> Result<()> {
        let mut streams = 0u8;
        let mut state = Head::Searching;
        let mut payload = Vec::new();
        while let Some((kind, size)) = self.chunk()? {
            let size = u64::from(size);
            match &kind {
                b"RIFF" => {
                    self.list_kind()?;
                }
                b"LIST" => match &self.list_kind()? {
                    b"movi" => {
                        self.first_sample = self.file.at();
                        break;
                    }
                    b"hdrl" | b"strl" => {}
                    _ => self.skip(size.saturating_sub(4))?,
                },
                b"strh" | b"strf" => {
                    read_up_to(&mut self.file, size, &mut payload)?;
                    self.align(size)?;
                    if &kind == b"strh" {
                        streams = streams.saturating_add(1);
                        if state == Head::Searching
                            && self.read_stream_header(&payload).is_some()
                            && streams <= 100
                        {
                            self.stream = [b'0' + (streams - 1) / 10, b'0' + (streams - 1) % 10];
                            state = Head::HeaderSeen;
                        }
                    } else if state == Head::HeaderSeen && self.read_stream_format(&payload).is_some() {
                        state = Head::Complete;
                    }
                }
                _ => self.skip(size)?,
            }
        }
        if state != Head::Complete {
            return Err(Error::input(
                "there is no video in this AVI file, or its head is damaged; copy or record it again",
            ));
        }
        if self.first_sample == 0 {
            return Err(Error::input(
                "the AVI file is cut off before its first frame; copy or record it again",
            ));
        }
        Ok(())
    }

    /// Parses a `strh` chunk; `None` if it is not that of a video stream.
    fn read_stream_header(&mut self, header: &[u8]) -> Option<()> {
        let mut header = Bytes::new(header);
        header.take(4).filter(|kind| kind == b"vids")?;
        header.skip(16)?;
        let (scale, rate) = (header.u32_le()?, header.u32_le()?);
        let (start, count) = (header.u32_le()?, header.u32_le()?);
        self.track.frame_count = (count > 0).then_some(u64::from(count));
        if scale > 0 && rate > 0 {
            (self.scale, self.rate, self.start) = (scale, rate, start);
        } else {
            self.track.times = Times::Unknown;
        }
        Some(())
    }

    /// Parses a `strf` chunk: a `BITMAPINFOHEADER`.
    fn read_stream_format(&mut self, format: &[u8]) -> Option<()> {
        let mut format = Bytes::new(format);
        format.skip(4)?;
        self.track.width = format.u32_le()? as usize;
        self.track.height = (format.u32_le()? as i32).unsigned_abs() as usize;
        format.skip(4)?;
        self.track.codec = codec(format.take(4)?);
        Some(())
    }

    /// Reads the header of the next chunk; `None` at the end. Zeros before it, caused by wrong
    /// lengths, are skipped.
    fn chunk(&mut self) -> Result<Option<([u8; 4], u32)>> {
        while self.file.remaining() >= 8 {
            let kind = self.four_bytes()?;
            if kind != [0; 4] {
                return Ok(Some((kind, u32::from_le_bytes(self.four_bytes()?))));
            }
        }
        Ok(None)
    }

    fn list_kind(&mut self) -> Result<[u8; 4]> {
        if self.file.remaining() >= 4 { self.four_bytes() } else { Ok([0; 4]) }
    }

    fn four_bytes(&mut self) -> Result<[u8; 4]> {
        let mut bytes = [0; 4];
        self.file.read_exact(&mut bytes).map_err(unreadable)?;
        Ok(bytes)
    }

    /// Skips the padding byte after a chunk of odd size.
    fn align(&mut self, size: u64) -> Result<()> {
        self.file.skip(size % 2)
    }

    fn skip(&mut self, size: u64) -> Result<()> {
        self.file.skip(size)?;
        self.align(size)
    }
}

impl PacketReader for AviReader {
    fn track(&self) -> &VideoTrack {
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
                    if size > self.file.remaining() {
                        self.warnings.push(format!("the file is cut off inside frame {number}"));
                        return Ok(false);
                    }
                    read_up_to(&mut self.file, size, &mut packet.data)?;
                    self.align(size)?;
                    packet.time_s = (u64::from(self.start) + number) as f64 * f64::from(self.scale)
                        / f64::from(self.rate);
                    packet.shown = true;
                    // An empty chunk repeats the previous frame: no image was taken at that time.
                    if size > 0 {
                        return Ok(true);
                    }
                }
                _ if kind.iter().all(|c| c.is_ascii_graphic() || *c == b' ') => {
                    if size > self.file.remaining() {
                        self.warnings.push("the file is cut off".to_string());
                    }
                    self.skip(size)?;
                }
                _ => {
                    self.warnings
                        .push(format!("what follows byte {} is not AVI and was ignored", self.file.at()));
                    return Ok(false);
                }
            }
        }
        Ok(false)
    }

    fn rewind(&mut self) -> Result<()> {
        self.number = 0;
        self.file.seek(self.first_sample)
    }

    fn take_warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }
}

/// The codec of a stream from its FourCC.
pub(super) fn codec(letters: &[u8]) -> VideoCodec {
    match letters.to_ascii_uppercase().as_slice() {
        b"H264" | b"X264" | b"AVC1" | b"DAVC" | b"VSSH" => VideoCodec::H264,
        b"HEVC" | b"H265" | b"HVC1" | b"X265" => VideoCodec::H265,
        b"MJPG" | b"JPEG" | b"AVRN" | b"DMB1" => VideoCodec::MotionJpeg,
        b"VP90" => VideoCodec::Vp9,
        b"VP80" => VideoCodec::Other("VP8".into()),
        b"AV01" => VideoCodec::Other("AV1".into()),
        b"XVID" | b"DIVX" | b"DX50" | b"FMP4" | b"MP4V" | b"MP4S" | b"M4S2" | b"3IV2" => {
            VideoCodec::Other("MPEG-4 part 2 video".into())
        }
        b"DIV3" | b"MP43" | b"DIV4" | b"COL1" | b"AP41" => VideoCodec::Other("MSMPEG4 version 3".into()),
        b"MP42" | b"DIV2" => VideoCodec::Other("MSMPEG4 version 2".into()),
        b"CVID" => VideoCodec::Other("Cinepak".into()),
        b"FFV1" => VideoCodec::Other("FFV1".into()),
        b"\0\0\0\0" | b"DIB " | b"YUY2" | b"UYVY" | b"I420" | b"YV12" | b"Y800" | b"GREY" => {
            VideoCodec::Other("uncompressed video".into())
        }
        other => VideoCodec::Other(format!("'{}' video", String::from_utf8_lossy(other).trim())),
    }
}
