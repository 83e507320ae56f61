//! H.264 (AVC): a fast decoder for progressive 8-bit 4:2:0, and a complete one as fallback.
//!
//! `rusty_h264` is two to three times as fast but limited to progressive 8-bit 4:2:0. `rust_h264`
//! also decodes interlaced video, 10 bits, 4:2:2 and monochrome. Both were compared byte by byte
//! with the frames of ffmpeg. Neither supports 4:4:4 and lossless coding.

use super::h264_parameters::SequenceParameters;
use super::{DecodeResult, Decoded, Decoder, MakeDecoder, Refusal, Stamp, StreamFacts};
use crate::container::{Times, VideoTrack};
use crate::frame::{Chroma, ColorEncoding, Picture};
use crate::guard::guarded;
use crate::limits;
use crate::nal::NalFraming;
use odograph::error::{Error, Result};
use rust_h264::nal::{NalUnit, NalUnitType};

/// Maximum reorder depth, pictures (`MaxDpbFrames`, H.264 A.3.1).
const MAX_REORDER: usize = 16;

/// The decoders for a track, the fast one first unless the parameters exclude it, and a description
/// of the stream.
pub(crate) fn decoders(track: &VideoTrack, color: bool) -> Result<(Vec<MakeDecoder>, String)> {
    let set_up = SetUp::read(track, color)?;
    let name = set_up.stream().description;
    let fast_may_do = set_up.parameters.as_ref().is_none_or(|p| {
        p.chroma_format == 1
            && p.bit_depth == 8
            && !p.may_be_lossless
            && p.order_count_type != 1
            && !p.crops_left_or_top
    });
    let complete_may_do =
        set_up.parameters.as_ref().is_none_or(|p| p.chroma_format <= 2 && matches!(p.bit_depth, 8 | 10));
    let mut decoders: Vec<MakeDecoder> = Vec::new();
    if fast_may_do {
        let set_up = set_up.clone();
        decoders.push(Box::new(move || Ok(Box::new(Fast::new(set_up.clone())?))));
    }
    if complete_may_do {
        decoders.push(Box::new(move || Ok(Box::new(Complete::new(set_up.clone())?))));
    }
    Ok((decoders, name))
}

/// Stream configuration for both decoders.
#[derive(Debug, Clone)]
struct SetUp {
    framing: NalFraming,
    /// Parameter sets from the container, which precede the first sample.
    parameter_sets: Vec<Vec<u8>>,
    parameters: Option<SequenceParameters>,
    /// Colour encoding in the container; takes precedence over that of the stream.
    encoding: Option<ColorEncoding>,
    /// Whether pictures are reordered by the timestamps of the samples or by picture order count
    /// (POC).
    order_by_time: bool,
    color: bool,
}

impl SetUp {
    fn read(track: &VideoTrack, color: bool) -> Result<Self> {
        let mut set_up = Self {
            framing: NalFraming::StartCodes,
            parameter_sets: Vec::new(),
            parameters: None,
            encoding: track.encoding,
            order_by_time: track.times == Times::Presentation,
            color,
        };
        // An avcC box (ISO/IEC 14496-15, 5.3.3.1), or parameter sets in Annex B format, which begin
        // with a start code.
        match track.configuration.as_slice() {
            [] => {}
            [0, 0, ..] => {
                let mut units = Vec::new();
                NalFraming::StartCodes.split(&track.configuration, &mut units);
                for unit in units {
                    set_up.parameter_set(unit);
                }
            }
            [_, _, _, _, lengths, rest @ ..] => {
                set_up.framing = NalFraming::Lengths(usize::from(lengths & 3) + 1);
                set_up.read_sets(rest);
            }
            _ => return Err(Error::input("the set-up of the H.264 stream (avcC) is cut off")),
        }
        if let Some(p) = &set_up.parameters {
            limits::check_video_size(p.coded_width, p.coded_height)?;
        }
        Ok(set_up)
    }

    fn read_sets(&mut self, mut rest: &[u8]) -> Option<()> {
        for mask in [31u8, 255] {
            let (&count, after) = rest.split_first()?;
            rest = after;
            for _ in 0..count & mask {
                let (length, after) = rest.split_at_checked(2)?;
                let length = usize::from(length[0]) << 8 | usize::from(length[1]);
                let (unit, after) = after.split_at_checked(length)?;
                rest = after;
                self.parameter_set(unit);
            }
        }
        Some(())
    }

    fn parameter_set(&mut self, unit: &[u8]) {
        if unit.is_empty() {
            return;
        }
        if self.parameters.is_none() {
            self.parameters = SequenceParameters::read(unit);
        }
        self.parameter_sets.push(unit.to_vec());
    }

    /// Reads sequence parameter sets from the units of a sample. Fails if a picture would take too
    /// much memory.
    fn look_for_parameters(&mut self, units: &[&[u8]]) -> Result<()> {
        for unit in units.iter().filter(|u| u[0] & 31 == 7) {
            if let Some(read) = SequenceParameters::read(unit) {
                limits::check_video_size(read.coded_width, read.coded_height)?;
                self.parameters = Some(read);
            }
        }
        Ok(())
    }

    fn stream(&self) -> StreamFacts {
        let Some(p) = &self.parameters else {
            return StreamFacts { reorder_depth: MAX_REORDER, ..StreamFacts::named("H.264") };
        };
        StreamFacts {
            description: format!("H.264 ({})", p.profile_name()),
            reorder_depth: p.reorder_depth.unwrap_or(if p.profile == 66 { 0 } else { MAX_REORDER }),
            frames_per_second: p.frames_per_second,
        }
    }

    fn encoding(&self) -> ColorEncoding {
        let from_stream = self.parameters.as_ref().map(|p| p.encoding);
        self.encoding.or(from_stream).unwrap_or_default()
    }

    fn decoded(&self, picture: Picture, stamp: Stamp, order_count: i32, starts_group: bool) -> Decoded {
        // Microseconds resolve the timestamps of every container.
        let order = if self.order_by_time { (stamp.time_s * 1e6) as i64 } else { i64::from(order_count) };
        Decoded { picture, stamp, order, starts_group }
    }
}

fn starts_group(units: &[&[u8]]) -> bool {
    units.iter().any(|u| u[0] & 31 == 5)
}

/// `rusty_h264`: decodes an access unit to a picture.
struct Fast {
    set_up: SetUp,
    decoder: rusty_h264_decoder::Decoder,
    /// The access unit in Annex B format.
    annex_b: Vec<u8>,
    starts_group: bool,
}

impl Fast {
    fn new(set_up: SetUp) -> Result<Self> {
        let mut decoder = rusty_h264_decoder::Decoder::new();
        let mut annex_b = Vec::new();
        for unit in &set_up.parameter_sets {
            annex_b.extend_from_slice(&[0, 0, 1]);
            annex_b.extend_from_slice(unit);
        }
        // An unsupported parameter set is reported when a slice refers to it.
        let _ = guarded("H.264", || decoder.decode(&annex_b))?;
        Ok(Self { set_up, decoder, annex_b, starts_group: false })
    }
}

impl Decoder for Fast {
    fn decode(&mut self, data: &[u8], stamp: Stamp, out: &mut Vec<Decoded>) -> DecodeResult {
        let mut units = Vec::new();
        self.set_up.framing.split(data, &mut units);
        self.set_up.look_for_parameters(&units)?;
        self.starts_group |= starts_group(&units);
        self.annex_b.clear();
        for unit in &units {
            self.annex_b.extend_from_slice(&[0, 0, 1]);
            self.annex_b.extend_from_slice(unit);
        }
        match guarded("H.264", || self.decoder.decode(&self.annex_b))? {
            Ok(None) => Ok(()),
            Ok(Some(frame)) => {
                let chroma = self.set_up.color.then(|| Chroma {
                    width: frame.width / 2,
                    height: frame.height / 2,
                    blue: frame.u,
                    red: frame.v,
                    encoding: self.set_up.encoding(),
                });
                let picture = Picture::from_planes((frame.width, frame.height), frame.y, chroma);
                let Some(picture) = picture else {
                    return Err(Refusal::Damaged("a picture of the wrong size".into()));
                };
                let starts_group = std::mem::take(&mut self.starts_group);
                let order = self.decoder.last_poc();
                out.push(self.set_up.decoded(picture, stamp, order, starts_group));
                Ok(())
            }
            // After an error its state is inconsistent; damaged streams are decoded by the complete
            // decoder.
            Err(error) => Err(Refusal::Unsupported(error.to_string())),
        }
    }

    fn stream(&self) -> StreamFacts {
        self.set_up.stream()
    }
}

/// `rust_h264`: decodes unit by unit; outputs a picture when the next one starts or when it is
/// flushed.
struct Complete {
    set_up: SetUp,
    decoder: rust_h264::decoder::Decoder,
    /// Stamp of the picture under construction, and whether it starts a group.
    building: Option<(Stamp, bool)>,
}

impl Complete {
    fn new(set_up: SetUp) -> Result<Self> {
        let mut decoder = rust_h264::decoder::Decoder::new();
        guarded("H.264", || {
            for unit in &set_up.parameter_sets {
                let _ = decoder.decode_nal(&unit_of(unit));
            }
        })?;
        Ok(Self { set_up, decoder, building: None })
    }

    /// Whether a sample is a complete picture. It is in every container; in raw streams it need not
    /// be, and the two fields of an interlaced picture must not be separated.
    fn sample_is_picture(&self) -> bool {
        matches!(self.set_up.framing, NalFraming::Lengths(_))
            || self.set_up.parameters.as_ref().is_some_and(|p| p.only_frames)
    }

    fn push(&mut self, frame: rust_h264::decoder::Frame, out: &mut Vec<Decoded>) {
        let Some((stamp, starts_group)) = self.building.take() else { return };
        let (chroma_width, chroma_height) = (frame.chroma_width() as usize, frame.chroma_height() as usize);
        let shift = frame.bit_depth.saturating_sub(8);
        let plane =
            |samples: Vec<u8>| if shift == 0 { samples } else { narrow_little_endian(&samples, shift) };
        let gray_only = self.set_up.parameters.as_ref().is_some_and(|p| p.chroma_format == 0);
        let chroma = (self.set_up.color && !gray_only).then(|| Chroma {
            width: chroma_width,
            height: chroma_height,
            blue: plane(frame.u),
            red: plane(frame.v),
            encoding: self.set_up.encoding(),
        });
        let size = (frame.width as usize, frame.height as usize);
        let Some(picture) = Picture::from_planes(size, plane(frame.y), chroma) else { return };
        let order = frame.pic_order_cnt;
        out.push(self.set_up.decoded(picture, stamp, order, starts_group));
    }
}

impl Decoder for Complete {
    fn decode(&mut self, data: &[u8], stamp: Stamp, out: &mut Vec<Decoded>) -> DecodeResult {
        let mut units = Vec::new();
        self.set_up.framing.split(data, &mut units);
        self.set_up.look_for_parameters(&units)?;
        let mut refusal = None;
        for unit in units {
            let is_slice = matches!(unit[0] & 31, 1 | 5);
            match guarded("H.264", || self.decoder.decode_nal(&unit_of(unit)))? {
                Ok(Some(frame)) => self.push(frame, out),
                Ok(None) => {}
                Err(rust_h264::error::DecodeError::Unsupported(what)) => {
                    refusal = Some(Refusal::Unsupported(what.to_string()));
                }
                Err(error) => refusal = Some(Refusal::Damaged(error.to_string())),
            }
            if is_slice {
                let starts_group = unit[0] & 31 == 5;
                let building = self.building.get_or_insert((stamp, starts_group));
                building.1 |= starts_group;
            }
        }
        if self.sample_is_picture() {
            self.finish(out)?;
            self.building = None;
        }
        refusal.map_or(Ok(()), Err)
    }

    fn finish(&mut self, out: &mut Vec<Decoded>) -> DecodeResult {
        if let Some(frame) = guarded("H.264", || self.decoder.flush())? {
            self.push(frame, out);
        }
        Ok(())
    }

    fn stream(&self) -> StreamFacts {
        self.set_up.stream()
    }
}

fn unit_of(unit: &[u8]) -> NalUnit<'_> {
    NalUnit {
        nal_ref_idc: unit[0] >> 5 & 3,
        nal_unit_type: NalUnitType::from(unit[0] & 31),
        rbsp: crate::nal::unescape(&unit[1..]).into(),
    }
}

/// Narrows little-endian samples of `8 + shift` bits to 8 bits, rounded.
pub(crate) fn narrow_little_endian(samples: &[u8], shift: u8) -> Vec<u8> {
    samples.chunks_exact(2).map(|b| narrow(u16::from_le_bytes([b[0], b[1]]), shift)).collect()
}

/// Narrows a full-scale 16-bit sample (65 535) to 8 bits (255), rounded: for still images, not for
/// video.
pub(crate) fn narrow_full_scale(sample: u16) -> u8 {
    ((u32::from(sample) + 128) / 257) as u8
}

/// Narrows a sample of `8 + shift` bits to 8 bits, rounded.
pub(crate) fn narrow(sample: u16, shift: u8) -> u8 {
    let half = (1u32 << shift) >> 1;
    ((u32::from(sample) + half) >> shift).min(255) as u8
}
