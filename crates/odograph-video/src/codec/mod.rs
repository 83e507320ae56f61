//! Codecs: decode compressed samples to pictures.

pub(crate) mod bits;
pub(crate) mod h264;
mod h264_parameters;
mod h265;
mod h265_parameters;
pub(crate) mod jpeg;
mod vp9;

pub(crate) use h264::{narrow, narrow_full_scale, narrow_little_endian};

use crate::container::{VideoCodec, VideoTrack};
use crate::frame::Picture;
use odograph::error::{Error, Result};

/// Reads sequence parameters of H.264 and HEVC, for the fuzz target.
#[cfg(any(fuzzing, test))]
pub fn read_parameter_sets(unit: &[u8]) {
    let _ = h264_parameters::SequenceParameters::read(unit);
    let _ = h265_parameters::HevcSequenceParameters::read(unit);
}

/// Metadata of a sample that is passed through the decoder to the picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Stamp {
    pub time_s: f64,
    pub shown: bool,
}

/// A picture in decoding order, with its sort key for the presentation order.
#[derive(Debug, Clone)]
pub(crate) struct Decoded {
    pub picture: Picture,
    pub stamp: Stamp,
    /// Sort key of the presentation order within the group.
    pub order: i64,
    /// The picture starts a new group: all earlier pictures are presented before it.
    pub starts_group: bool,
}

/// Why a sample was not decoded.
#[derive(Debug)]
pub(crate) enum Refusal {
    /// The decoder does not support a feature of the stream; another decoder may.
    Unsupported(String),
    /// The sample is damaged; decoding continues with the next one.
    Damaged(String),
    /// The decoder is unusable from now on.
    Broken(Error),
}

impl From<Error> for Refusal {
    fn from(error: Error) -> Self {
        Self::Broken(error)
    }
}

/// Whether a sample was decoded.
pub(crate) type DecodeResult = std::result::Result<(), Refusal>;

/// A decoder of one stream, sample by sample.
pub(crate) trait Decoder: Send {
    /// Decodes one sample and appends the completed pictures, in decoding order.
    fn decode(&mut self, data: &[u8], stamp: Stamp, out: &mut Vec<Decoded>) -> DecodeResult;

    /// Flushes the decoder: appends the remaining pictures, if it keeps any back.
    fn finish(&mut self, _out: &mut Vec<Decoded>) -> DecodeResult {
        Ok(())
    }

    /// What is known of the stream so far.
    fn stream(&self) -> StreamFacts;
}

/// What is known of a stream.
#[derive(Debug, Default)]
pub(crate) struct StreamFacts {
    /// Human-readable description, e.g. `H.264 (High)`.
    pub description: String,
    /// Maximum number of pictures that precede a picture in decoding order and follow it in
    /// presentation order.
    pub reorder_depth: usize,
    /// Frame rate, frames per second; `None` if the stream does not have it.
    pub frames_per_second: Option<f64>,
}

impl StreamFacts {
    /// Of a stream of pictures in presentation order that says nothing about itself.
    fn named(description: &str) -> Self {
        Self { description: description.to_owned(), ..Self::default() }
    }
}

/// Constructors of the decoders for a track, the fastest first, and a human-readable description of
/// the track.
pub(crate) fn decoders(track: &VideoTrack, color: bool) -> Result<(Vec<MakeDecoder>, String)> {
    Ok(match &track.codec {
        VideoCodec::H264 => h264::decoders(track, color)?,
        VideoCodec::H265 => (h265::decoders(track, color)?, "H.265".to_string()),
        VideoCodec::Vp9 => {
            let track = track.clone();
            (vec![Box::new(move || Ok(Box::new(vp9::Vp9::new(&track, color))))], "VP9".to_string())
        }
        VideoCodec::MotionJpeg => {
            let height = track.height;
            (
                vec![Box::new(move || Ok(Box::new(jpeg::MotionJpeg::new(height, color))))],
                "Motion JPEG".to_string(),
            )
        }
        VideoCodec::Other(name) => (Vec::new(), name.clone()),
    })
}

/// Constructs a decoder at the start of its stream.
pub(crate) type MakeDecoder = Box<dyn Fn() -> Result<Box<dyn Decoder>> + Send>;

#[cfg(test)]
mod tests {
    /// What once failed the fuzz target.
    #[test]
    fn damaged_parameters_are_read_or_refused() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fuzz/regressions/parameter_sets");
        let mut inputs = std::fs::read_dir(folder).unwrap().peekable();
        assert!(inputs.peek().is_some());
        inputs.for_each(|input| super::read_parameter_sets(&std::fs::read(input.unwrap().path()).unwrap()));
    }
}
