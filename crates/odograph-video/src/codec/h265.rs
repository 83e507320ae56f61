//! H.265 (HEVC) with `rust_h265`: 8 to 12 bits, 4:2:0 and 4:4:4.

use super::h265_parameters::HevcSequenceParameters;
use super::{DecodeResult, Decoded, Decoder, MakeDecoder, Refusal, Stamp, StreamFacts};
use crate::container::bytes::Bytes;
use crate::container::{Times, VideoTrack};
use crate::frame::{Chroma, ColorEncoding, Picture};
use crate::guard::guarded;
use crate::limits;
use crate::nal::NalFraming;
use odograph::error::{Error, Result};
use rust_h265::{DecodeError, PixelData};

/// Maximum reorder depth, pictures (H.265 A.4.2).
const MAX_REORDER: usize = 16;

/// The decoder for a track.
pub(crate) fn decoders(track: &VideoTrack, color: bool) -> Result<Vec<MakeDecoder>> {
    let track = track.clone();
    Ok(vec![Box::new(move || Ok(Box::new(Hevc::new(&track, color)?)))])
}

/// `rust_h265` in decoding order: decodes an access unit to a picture.
struct Hevc {
    decoder: rust_h265::Decoder,
    framing: NalFraming,
    parameters: Option<HevcSequenceParameters>,
    encoding: Option<ColorEncoding>,
    order_by_time: bool,
    color: bool,
    /// Whether the stream starts here, or restarts after an end-of-sequence unit.
    at_beginning: bool,
    /// Whether leading pictures that refer to pictures before the start are skipped (RASL; H.265
    /// 8.3.1).
    skips_leading: bool,
}

impl Hevc {
    fn new(track: &VideoTrack, color: bool) -> Result<Self> {
        let mut decoder = Self {
            decoder: rust_h265::Decoder::new(),
            framing: NalFraming::StartCodes,
            parameters: None,
            encoding: track.encoding,
            order_by_time: track.times == Times::Presentation,
            color,
            at_beginning: true,
            skips_leading: true,
        };
        // An hvcC box (ISO/IEC 14496-15, 8.3.3.1), or parameter sets in Annex B format, which begin
        // with a start code.
        let mut sets = Vec::new();
        match track.configuration.as_slice() {
            [] => {}
            [0, 0, ..] => NalFraming::StartCodes.split(&track.configuration, &mut sets),
            configuration => {
                let lengths = configuration
                    .get(21)
                    .ok_or_else(|| Error::input("the set-up of the H.265 stream (hvcC) is cut off"))?;
                decoder.framing = NalFraming::Lengths(usize::from(lengths & 3) + 1);
                let _ = parameter_sets(&configuration[22..], &mut sets);
            }
        }
        for unit in sets {
            decoder.look_for_parameters(unit)?;
            if let Some(unit) = rust_h265::parse_nal(unit) {
                // An unsupported parameter set is reported when a slice refers to it.
                let _ = guarded("H.265", || decoder.decoder.decode_nal(&unit))?;
            }
        }
        Ok(decoder)
    }

    fn look_for_parameters(&mut self, unit: &[u8]) -> Result<()> {
        if let Some(read) = HevcSequenceParameters::read(unit) {
            limits::check_video_size(read.width, read.height)?;
            self.parameters = Some(read);
        }
        Ok(())
    }

    fn push(&self, frame: rust_h265::Frame, stamp: Stamp, starts_group: bool, out: &mut Vec<Decoded>) {
        let (width, height) = (frame.width as usize, frame.height as usize);
        let shift = frame.bit_depth.saturating_sub(8);
        let (across, down) = match frame.chroma_format_idc {
            1 => (2, 2),
            2 => (2, 1),
            _ => (1, 1),
        };
        let stream = self.parameters.as_ref().map(|p| p.encoding);
        let chroma = (self.color && frame.chroma_format_idc != 0).then(|| Chroma {
            width: width.div_ceil(across),
            height: height.div_ceil(down),
            blue: plane(frame.u, shift),
            red: plane(frame.v, shift),
            encoding: self.encoding.or(stream).unwrap_or_default(),
        });
        let luminance = plane(frame.y, shift);
        let Some(picture) = Picture::from_planes((width, height), luminance, chroma) else { return };
        let order =
            if self.order_by_time { (stamp.time_s * 1e6) as i64 } else { i64::from(frame.pic_order_cnt) };
        out.push(Decoded { picture, stamp, order, starts_group });
    }
}

impl Decoder for Hevc {
    fn decode(&mut self, data: &[u8], stamp: Stamp, out: &mut Vec<Decoded>) -> DecodeResult {
        let mut units = Vec::new();
        self.framing.split(data, &mut units);
        let mut refusal = None;
        let mut starts_group = false;
        for unit in units {
            self.look_for_parameters(unit)?;
            match unit[0] >> 1 & 63 {
                8 | 9 if self.skips_leading => continue,
                16..=20 => {
                    starts_group = true;
                    (self.at_beginning, self.skips_leading) = (false, true);
                }
                21 => {
                    starts_group |= self.at_beginning;
                    (self.at_beginning, self.skips_leading) = (false, starts_group);
                }
                36 => self.at_beginning = true,
                _ => {}
            }
            let Some(unit) = rust_h265::parse_nal(unit) else { continue };
            match guarded("H.265", || self.decoder.decode_nal(&unit))? {
                Ok(Some(frame)) => self.push(frame, stamp, starts_group, out),
                Ok(None) => {}
                Err(DecodeError::Unsupported(what) | DecodeError::ResourceLimit(what)) => {
                    refusal = Some(Refusal::Unsupported(what.to_string()));
                }
                Err(error) => refusal = Some(Refusal::Damaged(error.to_string())),
            }
        }
        // A sample is a complete picture.
        while let Some(frame) = guarded("H.265", || self.decoder.flush())? {
            self.push(frame, stamp, starts_group, out);
        }
        refusal.map_or(Ok(()), Err)
    }

    fn stream(&self) -> StreamFacts {
        let Some(p) = &self.parameters else {
            return StreamFacts { reorder_depth: MAX_REORDER, ..StreamFacts::named("H.265") };
        };
        let description = format!("H.265 ({})", p.profile_name());
        let HevcSequenceParameters { reorder_depth, frames_per_second, .. } = *p;
        StreamFacts { description, reorder_depth, frames_per_second }
    }
}

/// The NAL units in the arrays of an `hvcC` box, starting at the number of arrays.
fn parameter_sets<'a>(arrays: &'a [u8], units: &mut Vec<&'a [u8]>) -> Option<()> {
    let mut bytes = Bytes::new(arrays);
    for _ in 0..bytes.u8()? {
        bytes.skip(1)?;
        for _ in 0..bytes.u16()? {
            let length = bytes.u16()?;
            units.push(bytes.take(usize::from(length)).filter(|u| !u.is_empty())?);
        }
    }
    Some(())
}

fn plane(samples: PixelData, shift: u8) -> Vec<u8> {
    match samples {
        PixelData::U8(samples) => samples,
        PixelData::U16(samples) => samples.into_iter().map(|s| super::narrow(s, shift)).collect(),
    }
}
