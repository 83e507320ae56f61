//! Containers: read the compressed, timestamped samples of one video track from a file.

pub(crate) mod annex_b;
pub(crate) mod avi;
pub(crate) mod bytes;
pub(crate) mod matroska;
pub(crate) mod mp4;
mod mp4_boxes;
mod mp4_description;
mod mp4_fragments;
mod mp4_tables;

use crate::frame::ColorEncoding;
use crate::rotation::Orientation;
use odograph::error::Result;

/// Compression format of a track.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum VideoCodec {
    H264,
    H265,
    Vp9,
    MotionJpeg,
    /// A codec that this crate does not decode, by its common name.
    Other(String),
}

/// Meaning of the timestamps of a track.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Times {
    /// Presentation timestamps (PTS).
    Presentation,
    /// Decoding timestamps (DTS): sorted, they are the presentation times of the frames in
    /// presentation order.
    Decoding,
    /// The container has no timestamps; samples are numbered 0, 1, 2, …
    Unknown,
}

/// The video track of a file.
#[derive(Debug, Clone)]
pub(crate) struct VideoTrack {
    /// Common name of the container.
    pub container: &'static str,
    pub codec: VideoCodec,
    /// Size in the container, pixels; 0 if unknown. The decoded frames may differ.
    pub width: usize,
    pub height: usize,
    /// Codec configuration (`avcC`, `hvcC`); empty if it is in the stream (Annex B).
    pub configuration: Vec<u8>,
    pub frame_count: Option<u64>,
    /// The least and the greatest number of frames; `None` if the container does not state it
    /// reliably or is cut off.
    pub frames_within: Option<(u64, u64)>,
    pub orientation: Orientation,
    /// Colour encoding in the container; `None` if only the stream may have it.
    pub encoding: Option<ColorEncoding>,
    pub times: Times,
}

impl VideoTrack {
    /// A track of which no more is known than its codec.
    pub fn new(container: &'static str, codec: VideoCodec, times: Times) -> Self {
        Self {
            container,
            codec,
            width: 0,
            height: 0,
            configuration: Vec::new(),
            frame_count: None,
            frames_within: None,
            orientation: Orientation::default(),
            encoding: None,
            times,
        }
    }
}

/// One compressed sample.
#[derive(Debug, Clone, Default)]
pub(crate) struct Packet {
    pub data: Vec<u8>,
    /// Timestamp, seconds; the index of the sample if the container has no timestamps.
    pub time_s: f64,
    /// False for samples that are decoded only as references (outside the edit list).
    pub shown: bool,
}

/// Reads the samples of a track sequentially, in decoding order.
pub(crate) trait PacketReader: Send {
    fn track(&self) -> &VideoTrack;
    /// Reads the next sample into `packet`; false at the end.
    fn next_packet(&mut self, packet: &mut Packet) -> Result<bool>;
    /// Restarts at the first sample.
    fn rewind(&mut self) -> Result<()>;
    /// Drains the warnings about defects of the file, one sentence each.
    fn take_warnings(&mut self) -> Vec<String>;
}
