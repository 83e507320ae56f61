//! What there is to see, in values.

use serde::Serialize;

/// What does not change while a run is looked at.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Introduction {
    /// The name of the run, e.g. that of its source.
    pub title: String,
    /// The source in words.
    pub source: String,
    /// Size of the camera's picture, pixels.
    pub width: usize,
    /// Size of the camera's picture, pixels.
    pub height: usize,
    /// Height of the camera above the ground, metres.
    pub height_m: f64,
    /// Whether frames are still coming; otherwise a finished run is shown.
    pub live: bool,
    /// Whether it is a calibration: boards in the picture instead of a path.
    pub calibration: bool,
}

/// Where a run stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Phase {
    /// Frames come and are tracked.
    #[default]
    Running,
    /// The source does not give frames at the moment.
    Waiting,
    /// No frame comes any more; the results are being written.
    Saving,
    /// All is in the folder.
    Saved,
    /// The run has ended, and not all could be written.
    Failed,
}

/// How the run goes.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Status {
    /// Where it stands.
    pub phase: Phase,
    /// What a person should know now, e.g. that the camera is gone, or that the disk is full.
    pub message: Option<String>,
    /// Frames that came from the source.
    pub captured: u64,
    /// Frames that gave way to newer ones.
    pub dropped: u64,
    /// Frames a second that are tracked, over the last seconds.
    pub fps: f64,
    /// Milliseconds from capture to pose, median of the last seconds.
    pub latency_median_ms: f64,
    /// Milliseconds from capture to pose that 99 of 100 frames of the last seconds stay below.
    pub latency_p99_ms: f64,
    /// Keyframes made.
    pub keyframes: u64,
    /// Length of the path, metres.
    pub distance_m: f64,
    /// Whether what is seen is being recorded.
    pub recording: bool,
}

/// A picture of the camera with its tracks.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Which record it belongs to.
    pub record: usize,
    /// The picture.
    pub jpeg: Vec<u8>,
    /// Where the tracks are and where their corners were in the keyframe, quarters of a pixel of the camera, and whether they agree.
    pub tracks: Vec<[i16; 5]>,
}

/// A place that a person marked.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Mark {
    /// Which record it belongs to.
    pub record: usize,
    /// Seconds since the first frame.
    pub time_s: f32,
    /// Where, metres; `null` where the pose was not known.
    pub x_m: Option<f32>,
    /// Where, metres; `null` where the pose was not known.
    pub y_m: Option<f32>,
    /// How it was called.
    pub name: String,
}
