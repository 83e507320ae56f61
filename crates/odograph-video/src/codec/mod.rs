//! Codecs: compressed samples → pictures.

pub(crate) mod bits;
pub(crate) mod h264;
mod h264_parameters;
mod h265;
mod h265_parameters;
pub(crate) mod jpeg;
pub(crate) mod nal;
mod vp9;

pub(crate) use h264::{narrow, narrow_full_scale, narrow_little_endian};

use crate::container::{Codec, Track};
use crate::frame::Picture;
use odograph::error::{Error, Result};

/// What travels with a sample through its decoder to the picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Stamp {
    pub time_s: f64,
    pub shown: bool,
}

/// A picture in decoding order, with what puts it into the order of presentation.
#[derive(Debug, Clone)]
pub(crate) struct Decoded {
    pub picture: Picture,
    pub stamp: Stamp,
    /// Place in the order of presentation within the group.
    pub order: i64,
    /// The picture starts a new group: everything before it is shown before it.
    pub starts_group: bool,
}

/// Why a decoder did not decode a sample.
#[derive(Debug)]
pub(crate) enum Refusal {
    /// The stream uses something the decoder does not know; another decoder may.
    Unsupported(String),
    /// This sample is damaged; the decoder goes on with the next.
    Damaged(String),
    /// The decoder cannot be used any more.
    Broken(Error),
}

impl From<Error> for Refusal {
    fn from(error: Error) -> Self {
        Self::Broken(error)
    }
}

/// Decodes one stream, sample by sample.
pub(crate) trait Decoder: Send {
    /// Decodes one sample and appends the pictures that are finished, in decoding order.
    fn decode(
        &mut self,
        data: &[u8],
        stamp: Stamp,
        out: &mut Vec<Decoded>,
    ) -> std::result::Result<(), Refusal>;

    /// Appends the pictures that are still inside.
    fn finish(&mut self, out: &mut Vec<Decoded>) -> std::result::Result<(), Refusal>;

    /// How many pictures may have to wait until the one that is shown first is decoded; 0 where all come in order.
    fn reorder_depth(&self) -> usize;

    /// Frames a second, where the stream itself says it.
    fn frames_per_second(&self) -> Option<f64>;

    /// The stream's kind, as people know it, e.g. `H.264 (High)`.
    fn description(&self) -> String;
}

/// The decoders for a track, the fastest first, each made when its turn comes; and what the track is, as people know it.
pub(crate) fn decoders(track: &Track, color: bool) -> Result<(Vec<MakeDecoder>, String)> {
    Ok(match &track.codec {
        Codec::H264 => h264::decoders(track, color)?,
        Codec::H265 => (h265::decoders(track, color)?, "H.265".to_string()),
        Codec::Vp9 => {
            let track = track.clone();
            (vec![Box::new(move || Ok(Box::new(vp9::Vp9::new(&track, color))))], "VP9".to_string())
        }
        Codec::MotionJpeg => {
            let height = track.height;
            (
                vec![Box::new(move || Ok(Box::new(jpeg::MotionJpeg::new(height, color))))],
                "Motion JPEG".to_string(),
            )
        }
        Codec::Other(name) => (Vec::new(), name.clone()),
    })
}

/// Makes a decoder at the start of its stream.
pub(crate) type MakeDecoder = Box<dyn Fn() -> Result<Box<dyn Decoder>> + Send>;
