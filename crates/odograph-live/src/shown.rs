//! The values that the page displays.

use serde::Serialize;

/// The constant description of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Introduction {
    /// Name of the run, e.g. that of its source.
    pub title: String,
    /// Description of the source.
    pub source: String,
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// Height of the camera above the ground, metres.
    pub height_m: f64,
    /// `true` for a live run, `false` for a finished one.
    pub live: bool,
    /// Whether it is what a run has left that was killed.
    pub recovered: bool,
    /// Whether this is a calibration, which displays detected boards instead of a trajectory.
    pub calibration: bool,
}

/// Phase of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Phase {
    /// Frames arrive and are tracked.
    #[default]
    Running,
    /// The source delivers no frames at the moment.
    Waiting,
    /// The source has ended; the results are being written.
    Saving,
    /// All results have been written.
    Saved,
    /// The run has ended, and some results could not be written.
    Failed,
}

/// Status of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Status {
    /// Phase of the run.
    pub phase: Phase,
    /// A message for the user, e.g. that the camera is disconnected or the disk is full.
    pub message: Option<String>,
    /// Number of frames received from the source.
    pub captured: u64,
    /// Number of frames dropped in favour of newer ones.
    pub dropped: u64,
    /// Tracked frames per second, averaged over the last seconds.
    pub fps: f64,
    /// Median latency from capture to pose over the last seconds, milliseconds.
    pub latency_median_ms: f64,
    /// 99th percentile of the latency from capture to pose over the last seconds, milliseconds.
    pub latency_p99_ms: f64,
    /// Number of keyframes created.
    pub keyframes: u64,
    /// Length of the trajectory, metres.
    pub distance_m: f64,
    /// Whether the video is being recorded.
    pub recording: bool,
}

/// A camera image with its tracks.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Index of the frame's record.
    pub record: usize,
    /// The image, JPEG-encoded.
    pub jpeg: Vec<u8>,
    /// One entry a track: x and y in this image, x and y of its corner in the keyframe, both in
    /// quarters of a pixel of the full-size image, and 1 for an inlier or 0 for an outlier.
    pub tracks: Vec<[i16; 5]>,
}

/// A position marked by the user.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Mark {
    /// Index of the record that was newest when the mark was set.
    pub record: usize,
    /// Time since the first frame, seconds.
    pub time_s: f32,
    /// World x, metres; `None` (JSON `null`) where the pose was unknown.
    pub x_m: Option<f32>,
    /// World y, metres; `None` (JSON `null`) where the pose was unknown.
    pub y_m: Option<f32>,
    /// Name given by the user, or the mark's number.
    pub name: String,
}
