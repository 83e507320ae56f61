//! Options that select the frames of a recording.

use odograph_video::SourceOptions;
use std::path::PathBuf;

/// When the frames of a recording were taken.
#[derive(Debug, Clone, clap::Args)]
pub struct FrameTimes {
    /// Times of the frames: lines of `seconds name`, or EuRoC's CSV in nanoseconds.
    #[arg(help_heading = "Recording", long, value_name = "FILE")]
    pub timestamps: Option<PathBuf>,
    /// Frame rate, if the source does not state it.
    #[arg(
        help_heading = "Recording",
        long,
        value_name = "RATE",
        allow_negative_numbers = true,
        conflicts_with = "timestamps"
    )]
    pub fps: Option<f64>,
}

/// Which frames of a recording are taken, and when they were.
#[derive(Debug, Clone, clap::Args)]
pub struct FrameSelection {
    #[command(flatten)]
    times: FrameTimes,
    /// Begin this many seconds after the first frame.
    #[arg(help_heading = "Recording", long, value_name = "SECONDS", allow_negative_numbers = true)]
    start: Option<f64>,
    /// End this many seconds after the first frame.
    #[arg(help_heading = "Recording", long, value_name = "SECONDS", allow_negative_numbers = true)]
    end: Option<f64>,
    /// Topic with the images, where a robot recording (MCAP, ROS bag) has several.
    #[arg(help_heading = "Recording", long, value_name = "NAME")]
    topic: Option<String>,
    /// Take every n-th frame.
    #[arg(help_heading = "Recording", long, value_name = "N", default_value_t = 1)]
    every: u64,
}

impl FrameSelection {
    /// The same for the source.
    pub fn source_options(&self) -> SourceOptions {
        SourceOptions {
            timestamps: self.times.timestamps.clone(),
            fps: self.times.fps,
            start_s: self.start,
            end_s: self.end,
            every: self.every,
            topic: self.topic.clone(),
            ..SourceOptions::default()
        }
    }
}
