//! Matroska and WebM (RFC 9559, EBML of RFC 8794), including files of unknown length (live
//! recordings) and truncated files.
//!
//! The file is read sequentially. Segments, clusters and block groups are entered regardless of
//! their lengths, so unknown or wrong lengths do no harm.

use super::bytes::{Bytes, read_up_to};
use super::{Packet, PacketReader, Times, VideoCodec, VideoTrack};
use crate::file_error::unreadable;
use crate::frame::{ColorEncoding, Matrix};
use crate::limits;
use crate::record_file::RecordFile;
use crate::rotation::Orientation;
use odograph::error::{Error, Result};
use std::fs::File;
use std::io::Read;

/// EBML magic number at the start of every file.
pub(crate) const MAGIC: [u8; 4] = [0x1a, 0x45, 0xdf, 0xa3];

const SEGMENT: u32 = 0x1853_8067;
const INFO: u32 = 0x1549_a966;
const TRACKS: u32 = 0x1654_ae6b;
const CLUSTER: u32 = 0x1f43_b675;
const TIMESTAMP: u32 = 0xe7;
const SIMPLE_BLOCK: u32 = 0xa3;
const BLOCK_GROUP: u32 = 0xa0;
const BLOCK: u32 = 0xa1;

/// Reads the samples of the first video track.
pub(crate) struct MatroskaReader {
    file: RecordFile,
    first_cluster: u64,
    track: VideoTrack,
    number: u64,
    /// Bytes to prepend to every sample (header stripping compression).
    stripped: Vec<u8>,
    tick_ns: u64,
    cluster_ticks: i64,
    warnings: Vec<String>,
}

impl MatroskaReader {
    pub fn open(file: File) -> Result<Self> {
        let mut reader = Self {
            file: RecordFile::new(file)?,
            first_cluster: 0,
            track: VideoTrack::new("Matroska", VideoCodec::Other(String::new()), Times::Presentation),
            number: 0,
            stripped: Vec::new(),
            tick_ns: 1_000_000,
            cluster_ticks: 0,
            warnings: Vec::new(),
        };
        reader.read_head()?;
        Ok(reader)
    }

    /// Reads up to the first cluster.
    fn read_head(&mut self) -> Result<()> {
        let (mut duration_ticks, mut frame_s, mut tracks_seen) = (None, None, false);
        let mut payload = Vec::new();
        loop {
            let start = self.file.at();
            let Some((id, size)) = self.element()? else { break };
            match id {
                SEGMENT => {}
                CLUSTER => {
                    self.first_cluster = start;
                    break;
                }
                INFO | TRACKS => {
                    let size = size.unwrap_or(u64::MAX).min(self.file.remaining());
                    read_up_to(&mut self.file, size, &mut payload)?;
                    if id == INFO {
                        for (id, value) in Elements(&payload) {
                            match id {
                                0x2a_d7b1 => self.tick_ns = unsigned(value).max(1),
                                0x4489 => duration_ticks = float(value),
                                _ => {}
                            }
                        }
                    } else {
                        tracks_seen = true;
                        frame_s = self.read_tracks(&payload)?;
                    }
                }
                _ => self.skip(size)?,
            }
        }
        if !tracks_seen {
            return Err(Error::input(
                "there is no track in this Matroska file, or the file is cut off before them; copy or record it again",
            ));
        }
        if let (Some(duration), Some(frame_s)) = (duration_ticks, frame_s) {
            let frames = (duration * self.tick_ns as f64 * 1e-9 / frame_s).round();
            self.track.frame_count = (frames.is_finite() && frames > 0.0).then_some(frames as u64);
        }
        self.file.seek(self.first_cluster)
    }

    /// Selects the first video track; returns its frame duration in seconds, if the file has it.
    fn read_tracks(&mut self, tracks: &[u8]) -> Result<Option<f64>> {
        for (id, entry) in Elements(tracks) {
            let value = |wanted| Elements(entry).find(|(id, _)| *id == wanted).map(|(_, value)| value);
            if id != 0xae || value(0x83).map(unsigned) != Some(1) {
                continue;
            }
            self.number = value(0xd7).map_or(0, unsigned);
            let private = value(0x63a2).unwrap_or_default();
            let codec_id = String::from_utf8_lossy(value(0x86).unwrap_or_default()).into_owned();
            self.track.codec = codec(codec_id.trim_end_matches('\0'), private);
            if codec_id.starts_with("V_MS/VFW") {
                self.track.times = Times::Decoding;
            } else {
                self.track.configuration = private.to_vec();
            }
            if let Some(video) = value(0xe0) {
                self.read_video(video);
            }
            if let Some(encodings) = value(0x6d80) {
                self.read_encodings(encodings);
            }
            return Ok(value(0x23_e383).map(unsigned).filter(|&ns| ns > 0).map(|ns| ns as f64 * 1e-9));
        }
        Err(Error::input("there is no video in this file (only sound or other data)"))
    }

    fn read_video(&mut self, video: &[u8]) {
        for (id, value) in Elements(video) {
            match id {
                0xb0 => self.track.width = unsigned(value) as usize,
                0xba => self.track.height = unsigned(value) as usize,
                0x55b0 => {
                    let mut encoding = ColorEncoding::default();
                    for (id, value) in Elements(value) {
                        match id {
                            0x55b1 => encoding.matrix = Matrix::from_h273(unsigned(value)),
                            0x55b9 => encoding.full_range = unsigned(value) == 2,
                            _ => {}
                        }
                    }
                    self.track.encoding = Some(encoding);
                }
                // Roll of the projection in degrees, counter-clockwise for the viewer.
                0x7670 => {
                    let roll = Elements(value).find(|(id, _)| *id == 0x7675).and_then(|(_, v)| float(v));
                    if let Some(roll) = roll.filter(|r| r.is_finite()) {
                        let quarter_turns = (-roll / 90.0).round().rem_euclid(4.0) as u8;
                        self.track.orientation = Orientation::turned(quarter_turns);
                    }
                }
                _ => {}
            }
        }
    }

    fn read_encodings(&mut self, encodings: &[u8]) {
        for (_, encoding) in Elements(encodings).filter(|(id, _)| *id == 0x6240) {
            for (id, value) in Elements(encoding) {
                let field = |wanted| Elements(value).find(|(id, _)| *id == wanted).map(|(_, v)| v);
                match id {
                    0x5034 if field(0x4254).map(unsigned) == Some(3) => {
                        self.stripped = field(0x4255).unwrap_or_default().to_vec();
                    }
                    0x5034 => self.track.codec = VideoCodec::Other("compressed Matroska".into()),
                    0x5035 => self.track.codec = VideoCodec::Other("encrypted video".into()),
                    _ => {}
                }
            }
        }
    }

    fn skip(&mut self, size: Option<u64>) -> Result<()> {
        let size = size.unwrap_or(0);
        if size > self.file.remaining() {
            self.warnings.push("the file is cut off".to_string());
        }
        self.file.skip(size)
    }

    /// Reads the id and the size of the next element; the size is `None` if unknown. Returns `None`
    /// at the end.
    fn element(&mut self) -> Result<Option<(u32, Option<u64>)>> {
        let Some(id) = self.number(4)? else { return Ok(None) };
        let Some(size) = self.number(8)? else { return Ok(None) };
        let id = id.iter().fold(0, |id, &b| id << 8 | u32::from(b));
        Ok(Some((id, size_of(&size))))
    }

    /// Reads a number of variable length (VINT) with its marker bit; `None` at the end of the file.
    /// What follows one of more bytes than `longest` is ignored.
    fn number(&mut self, longest: usize) -> Result<Option<Vec<u8>>> {
        let mut bytes = Vec::with_capacity(longest);
        (&mut self.file).take(1).read_to_end(&mut bytes).map_err(unreadable)?;
        let Some(first) = bytes.first() else { return Ok(None) };
        let length = first.leading_zeros() as usize + 1;
        if length > longest {
            let at = self.file.at();
            self.warnings.push(format!("what follows byte {at} is not Matroska and was ignored"));
            self.file.seek(self.file.length())?;
            return Ok(None);
        }
        (&mut self.file).take(length as u64 - 1).read_to_end(&mut bytes).map_err(unreadable)?;
        Ok((bytes.len() == length).then_some(bytes))
    }

    /// Reads a block into `packet`; false if it belongs to another track or is truncated.
    fn block(&mut self, size: u64, packet: &mut Packet) -> Result<bool> {
        if size > limits::MAX_SAMPLE_BYTES {
            return Err(Error::input("a frame claims to take more than 256 MB"));
        }
        read_up_to(&mut self.file, size, &mut packet.data)?;
        if (packet.data.len() as u64) < size {
            self.warnings.push("the file is cut off inside a frame".to_string());
            return Ok(false);
        }
        let mut bytes = Bytes::new(&packet.data);
        let head = || -> Option<(u64, i16, u8)> {
            let length = bytes.rest().first()?.leading_zeros() as usize + 1;
            let track = size_of(bytes.take(length)?)?;
            Some((track, bytes.u16()? as i16, bytes.u8()?))
        };
        let mut head = head;
        let Some((track, ticks, flags)) = head() else { return Ok(false) };
        if track != self.number {
            return Ok(false);
        }
        if flags & 6 != 0 {
            return Err(Error::input("several frames share a block (lacing), which video does not do"));
        }
        let header = packet.data.len() - bytes.rest().len();
        packet.data.splice(..header, self.stripped.iter().copied());
        packet.time_s = block_time_s(self.cluster_ticks, ticks, self.tick_ns);
        packet.shown = true;
        Ok(true)
    }
}

impl PacketReader for MatroskaReader {
    fn track(&self) -> &VideoTrack {
        &self.track
    }

    fn next_packet(&mut self, packet: &mut Packet) -> Result<bool> {
        while let Some((id, size)) = self.element()? {
            match id {
                SEGMENT | CLUSTER | BLOCK_GROUP => {}
                TIMESTAMP => {
                    let size = size.unwrap_or(0).min(8);
                    read_up_to(&mut self.file, size, &mut packet.data)?;
                    self.cluster_ticks = i64::try_from(unsigned(&packet.data)).unwrap_or(i64::MAX);
                }
                SIMPLE_BLOCK | BLOCK => {
                    if self.block(size.unwrap_or(u64::MAX), packet)? {
                        return Ok(true);
                    }
                }
                _ => self.skip(size)?,
            }
        }
        Ok(false)
    }

    fn rewind(&mut self) -> Result<()> {
        self.cluster_ticks = 0;
        self.file.seek(self.first_cluster)
    }

    fn take_warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }
}

/// Time of a block from that of its cluster, seconds.
fn block_time_s(cluster_ticks: i64, ticks: i16, tick_ns: u64) -> f64 {
    (i128::from(cluster_ticks) + i128::from(ticks)).saturating_mul(tick_ns.into()) as f64 / 1e9
}

/// Decodes a variable-length size (VINT); `None` if all bits are one, which means unknown.
fn size_of(bytes: &[u8]) -> Option<u64> {
    let (&first, rest) = bytes.split_first()?;
    let value =
        rest.iter().fold(u64::from(first) & (0x7f >> first.leading_zeros()), |v, &b| v << 8 | u64::from(b));
    let unknown = (1u64 << (7 * bytes.len())) - 1;
    (value != unknown).then_some(value)
}

/// Iterates over the elements of a payload; the last one may be truncated.
struct Elements<'a>(&'a [u8]);

impl<'a> Iterator for Elements<'a> {
    type Item = (u32, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let mut bytes = Bytes::new(self.0);
        let id_length = bytes.rest().first()?.leading_zeros() as usize + 1;
        let id =
            bytes.take(id_length).filter(|_| id_length <= 4)?.iter().fold(0, |id, &b| id << 8 | u32::from(b));
        let size_length = bytes.rest().first()?.leading_zeros() as usize + 1;
        let size = size_of(bytes.take(size_length).filter(|_| size_length <= 8)?).unwrap_or(u64::MAX);
        let size = usize::try_from(size).unwrap_or(usize::MAX).min(bytes.rest().len());
        let payload = bytes.take(size)?;
        self.0 = bytes.rest();
        Some((id, payload))
    }
}

fn unsigned(value: &[u8]) -> u64 {
    value.iter().take(8).fold(0, |v, &b| v << 8 | u64::from(b))
}

fn float(value: &[u8]) -> Option<f64> {
    match value.len() {
        4 => Some(f64::from(f32::from_be_bytes(value.try_into().ok()?))),
        8 => Some(f64::from_be_bytes(value.try_into().ok()?)),
        _ => None,
    }
}

/// The codec of a track from its `CodecID` (RFC 9559 and the Matroska codec registry).
fn codec(id: &str, private: &[u8]) -> VideoCodec {
    match id {
        "V_MPEG4/ISO/AVC" => VideoCodec::H264,
        "V_MPEGH/ISO/HEVC" => VideoCodec::H265,
        "V_VP9" => VideoCodec::Vp9,
        "V_MJPEG" => VideoCodec::MotionJpeg,
        "V_VP8" => VideoCodec::Other("VP8".into()),
        "V_AV1" => VideoCodec::Other("AV1".into()),
        "V_MS/VFW/FOURCC" => super::avi::codec(private.get(16..20).unwrap_or_default()),
        _ if id.starts_with("V_MPEG4") => VideoCodec::Other("MPEG-4 part 2 video".into()),
        "V_MPEG1" => VideoCodec::Other("MPEG-1 video".into()),
        "V_MPEG2" => VideoCodec::Other("MPEG-2 video".into()),
        "V_PRORES" => VideoCodec::Other("ProRes".into()),
        "V_FFV1" => VideoCodec::Other("FFV1".into()),
        "V_THEORA" => VideoCodec::Other("Theora".into()),
        "V_UNCOMPRESSED" => VideoCodec::Other("uncompressed video".into()),
        other => VideoCodec::Other(format!("'{other}' video")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_of_elements() {
        assert_eq!(size_of(&[0x81]), Some(1));
        assert_eq!(size_of(&[0x40, 0x02]), Some(2));
        assert_eq!(size_of(&[0xff]), None);
        assert_eq!(size_of(&[0x01, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff]), None);
        assert_eq!(size_of(&[0x01, 0, 0, 0, 0, 0, 1, 0]), Some(256));
    }

    #[test]
    fn times_of_blocks() {
        assert_eq!(block_time_s(40, -1, 1_000_000), 0.039);
        assert!(block_time_s(i64::MAX, i16::MAX, u64::MAX).is_finite());
    }

    #[test]
    fn truncated_elements_keep_their_available_bytes() {
        let all: Vec<_> = Elements(&[0xd7, 0x81, 5, 0x42, 0x86, 0x84, 1, 2]).collect();
        assert_eq!(all, [(0xd7, &[5][..]), (0x4286, &[1, 2])]);
    }
}
