//! Containers: files → compressed samples of one video track, with their times.

pub(crate) mod annex_b;
pub(crate) mod avi;
pub(crate) mod bytes;
pub(crate) mod matroska;
pub(crate) mod mp4;
mod mp4_description;
mod mp4_fragments;
mod mp4_tables;

use crate::frame::ColorEncoding;
use crate::rotation::Orientation;
use odograph::error::Result;

/// How a track is compressed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Codec {
    H264,
    H265,
    Vp9,
    MotionJpeg,
    /// Something this crate does not decode, by the name people know it by.
    Other(String),
}

/// What the times of a track's samples mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Times {
    /// When the sample's frame is shown.
    Presentation,
    /// When the sample is decoded: frames take these times in the order in which they are shown.
    Decoding,
    /// The container has no times; samples are numbered 0, 1, 2, …
    Unknown,
}

/// The video track of a file.
#[derive(Debug, Clone)]
pub(crate) struct Track {
    /// The container's name, as people know it.
    pub container: &'static str,
    pub codec: Codec,
    /// As the container says; the decoded frames may differ. Zero where it does not say.
    pub width: usize,
    pub height: usize,
    /// The codec's own set-up (`avcC`, `hvcC`); empty where the stream carries it itself (Annex B).
    pub configuration: Vec<u8>,
    pub frame_count: Option<u64>,
    pub orientation: Orientation,
    /// Where the container says it; the stream itself may say it too.
    pub encoding: Option<ColorEncoding>,
    pub times: Times,
}

/// One compressed sample.
#[derive(Debug, Clone, Default)]
pub(crate) struct Packet {
    pub data: Vec<u8>,
    /// In seconds; the sample's number where the container has no times.
    pub time_s: f64,
    /// False for samples that are only decoded because others need them (outside the edit list).
    pub shown: bool,
}

/// Reads a track's samples one after another, in decoding order.
pub(crate) trait PacketReader: Send {
    fn track(&self) -> &Track;
    /// The next sample into `packet`; false at the end.
    fn next_packet(&mut self, packet: &mut Packet) -> Result<bool>;
    /// Starts again with the first sample.
    fn rewind(&mut self) -> Result<()>;
    /// What was wrong with the file so far, one sentence each; empties the list.
    fn take_warnings(&mut self) -> Vec<String>;
}
