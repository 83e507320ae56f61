//! Options that select the frames of a recording.

use odograph_video::SourceOptions;
use std::path::PathBuf;

/// Which frames of a recording are taken, and when they were.
#[derive(Debug, Clone, clap::Args)]
pub struct FrameSelection {
    /// Times of the frames: lines of `seconds name`, or EuRoC's CSV in nanoseconds.
    #[arg(help_heading = "Recording", long, value_name = "FILE")]
    timestamps: Option<PathBuf>,
    /// Frame rate, if the source does not state it.
    #[arg(
        help_heading = "Recording",
        long,
        value_name = "RATE",
        allow_negative_numbers = true,
        conflicts_with = "timestamps"
    )]
    fps: Option<f64>,
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
            timestamps: self.timestamps.clone(),
            fps: self.fps,
            start_s: self.start,
            end_s: self.end,
            every: self.every,
            topic: self.topic.clone(),
            ..SourceOptions::default()
        }
    }
}
