//! Fragmented MP4 (ISO/IEC 14496-12, 8.8).

use super::bytes::Bytes;
use super::mp4_boxes::{Boxes, Sample, child, too_many};
use crate::limits::MAX_SAMPLES;
use odograph::error::Result;

/// The fragments (`moof` boxes) of a file, in file order, with their offsets.
#[derive(Debug, Default)]
pub(super) struct Fragments {
    fragments: Vec<(u64, Vec<u8>)>,
    bytes: u64,
}

impl Fragments {
    /// Adds the `moof` box at the given offset of the file.
    pub fn add(&mut self, at: u64, payload: &[u8]) -> Result<()> {
        self.bytes += payload.len() as u64;
        if self.bytes > crate::limits::MAX_INDEX_BYTES {
            return Err(too_many());
        }
        self.fragments.push((at, payload.to_vec()));
        Ok(())
    }

    /// Appends the samples of a track; true if there are fragments of it (14496-12, 8.8).
    pub fn samples(&self, track: u32, moov: &[u8], samples: &mut Vec<Sample>) -> Result<bool> {
        let defaults = child(moov, b"mvex").and_then(|mvex| {
            Boxes(mvex.rest()).filter(|(kind, _)| kind == b"trex").find_map(|(_, payload)| {
                let mut bytes = Bytes::new(payload);
                bytes.skip(4)?;
                let id = bytes.u32()?;
                bytes.skip(4)?;
                (id == track).then_some((bytes.u32()?, bytes.u32()?))
            })
        });
        let mut decode_time = 0i64;
        let mut any = false;
        for (at, moof) in &self.fragments {
            let mut end_of_previous = *at;
            for (kind, traf) in Boxes(moof) {
                if &kind != b"traf" {
                    continue;
                }
                let Some(head) = FragmentHead::read(traf, *at, end_of_previous, defaults) else { continue };
                if head.track != track {
                    continue;
                }
                any = true;
                if let Some(mut bytes) = child(traf, b"tfdt") {
                    let version = bytes.u32().unwrap_or(0) >> 24;
                    let start = if version == 1 { bytes.u64() } else { bytes.u32().map(u64::from) };
                    decode_time = start.map_or(decode_time, |t| t as i64);
                }
                let mut offset = head.base;
                for (kind, trun) in Boxes(traf) {
                    if &kind == b"trun" {
                        head.run(trun, &mut offset, &mut decode_time, samples);
                    }
                    if samples.len() > MAX_SAMPLES {
                        return Err(too_many());
                    }
                }
                end_of_previous = offset;
            }
        }
        Ok(any)
    }
}

/// The `tfhd` box: base data offset of a track fragment and defaults for its samples.
struct FragmentHead {
    track: u32,
    base: u64,
    duration: u32,
    size: u32,
}

impl FragmentHead {
    fn read(traf: &[u8], moof_at: u64, end_of_previous: u64, defaults: Option<(u32, u32)>) -> Option<Self> {
        let mut bytes = child(traf, b"tfhd")?;
        let flags = bytes.u32()? & 0xff_ffff;
        let track = bytes.u32()?;
        let base = match flags {
            f if f & 1 != 0 => bytes.u64()?,
            f if f & 0x2_0000 != 0 => moof_at,
            _ => end_of_previous,
        };
        if flags & 2 != 0 {
            bytes.u32()?;
        }
        let (duration, size) = defaults.unwrap_or((0, 0));
        let duration = if flags & 8 != 0 { bytes.u32()? } else { duration };
        let size = if flags & 16 != 0 { bytes.u32()? } else { size };
        Some(Self { track, base, duration, size })
    }

    /// Parses one `trun` box; missing fields take the defaults.
    fn run(&self, trun: &[u8], offset: &mut u64, decode_time: &mut i64, samples: &mut Vec<Sample>) {
        let mut bytes = Bytes::new(trun);
        let mut parse = || -> Option<()> {
            let flags = bytes.u32()? & 0xff_ffff;
            let count = bytes.u32()?;
            if flags & 1 != 0 {
                *offset = self.base.saturating_add_signed(i64::from(bytes.i32()?));
            }
            if flags & 4 != 0 {
                bytes.u32()?;
            }
            for _ in 0..count {
                let duration = if flags & 0x100 != 0 { bytes.u32()? } else { self.duration };
                let size = if flags & 0x200 != 0 { bytes.u32()? } else { self.size };
                if flags & 0x400 != 0 {
                    bytes.u32()?;
                }
                let shift = if flags & 0x800 != 0 { bytes.i32()? } else { 0 };
                if samples.len() > MAX_SAMPLES || (size == 0 && flags & 0xf00 == 0) {
                    return None;
                }
                let time = decode_time.saturating_add(i64::from(shift));
                samples.push(Sample { offset: *offset, size, time });
                *offset = offset.saturating_add(u64::from(size));
                *decode_time = decode_time.saturating_add(i64::from(duration));
            }
            Some(())
        };
        // A truncated run has the samples read so far.
        let _ = parse();
    }
}
