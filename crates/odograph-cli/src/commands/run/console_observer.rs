//! Progress of a run on the console.

use crate::{console, interrupt};
use indicatif::{ProgressBar, ProgressState};
use odograph::camera::Camera;
use odograph::formats::decimal::Rounded;
use odograph::trajectory::{FrameEstimate, TrackStatus};
use odograph_session::{Observer, RunPlan, RunStatistics};
use odograph_video::SourceInfo;
use serde_json::json;
use std::fmt;
use std::io::{Write, stderr};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// How much of a run is logged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
enum Level {
    /// Nothing.
    #[default]
    Nothing,
    /// What is used, when tracking is lost and found, and how long each stage takes.
    Events,
    /// Every frame.
    Frames,
}

/// Log of a run.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct LogArguments {
    /// Log on standard error: what is used, losses, times; -vv also logs every frame.
    #[arg(help_heading = "Results", short, long, action = clap::ArgAction::Count, conflicts_with = "quiet")]
    verbose: u8,
}

/// How progress is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Progress {
    /// A bar, if standard error is a terminal.
    Bar,
    /// Lines of JSON on standard error, for other programs.
    Json,
}

/// Frames from one line of progress to the next.
const FRAMES_PER_LINE: u64 = 30;

/// Shows progress, and ends the run at Ctrl-C.
pub struct ConsoleObserver {
    quiet: bool,
    /// How progress is shown; `None` if it is not.
    progress: Option<Progress>,
    bar: Mutex<ProgressBar>,
    /// Why the recording is tracked again.
    again: Mutex<String>,
    counted: Mutex<Counted>,
    level: Level,
    began: Instant,
}

/// What the lines of progress contain.
#[derive(Debug, Default)]
struct Counted {
    frames: u64,
    lost: u64,
    of: Option<u64>,
    /// The status of the last frame.
    status: Option<TrackStatus>,
}

impl ConsoleObserver {
    /// A `quiet` observer prints nothing.
    pub fn new(quiet: bool) -> Self {
        Self {
            quiet,
            progress: (!quiet).then_some(Progress::Bar),
            bar: Mutex::new(ProgressBar::hidden()),
            again: Mutex::default(),
            counted: Mutex::default(),
            level: Level::Nothing,
            began: Instant::now(),
        }
    }

    /// The same with this kind of progress. Lines of JSON are written by a quiet one, too.
    pub fn with_progress(self, progress: Progress) -> Self {
        match progress {
            Progress::Bar => self,
            Progress::Json => Self { progress: Some(progress), ..self },
        }
    }

    /// Without a progress bar, for runs that have a page instead.
    pub fn without_progress(quiet: bool) -> Self {
        Self { progress: None, ..Self::new(quiet) }
    }

    /// The same with a log.
    pub fn with_log(self, arguments: LogArguments) -> Self {
        let level = match arguments.verbose {
            0 => Level::Nothing,
            1 => Level::Events,
            _ => Level::Frames,
        };
        Self { level, ..self }
    }

    /// Logs what a run uses.
    pub fn log_plan(&self, plan: &RunPlan, source: &SourceInfo) {
        if self.level == Level::Nothing {
            return;
        }
        let frames = source.frame_count.map_or("an unknown number of".to_owned(), |count| count.to_string());
        self.log(&format!("source {}: {}, {frames} frames", plan.source.path, source.description));
        self.log(&format!("camera: {}", camera_line(&plan.camera)));
        let rig = &plan.rig;
        self.log(&format!(
            "mount: height {} m, roll {:.2}°, pitch {:.2}°, yaw {:.2}°{}",
            rig.height_m,
            Rounded(rig.roll_rad.to_degrees()),
            Rounded(rig.pitch_rad.to_degrees()),
            Rounded(rig.yaw_rad.to_degrees()),
            plan.mask.as_ref().map_or_else(String::new, |mask| format!("; mask {}", mask.display())),
        ));
    }

    /// Logs how long the stages of a run took.
    pub fn log_times(&self, statistics: &RunStatistics) {
        if self.level == Level::Nothing {
            return;
        }
        for (stage, time) in &statistics.stages {
            self.log(&format!(
                "{stage}: {:.3} ms per frame, 99 of 100 below {:.3} ms",
                time.mean_ms, time.p99_ms
            ));
        }
    }

    fn log(&self, sentence: &str) {
        let since_start_s = self.began.elapsed().as_secs_f64();
        self.bar().suspend(|| console::log(since_start_s, sentence));
    }

    /// Logs a frame, or that tracking was lost or found with it.
    fn log_frame(&self, frame: &FrameEstimate, before: Option<TrackStatus>) {
        let FrameEstimate { frame: number, time_s, status, tracks, inliers, residual_px, .. } = frame;
        if self.level >= Level::Frames {
            let keyframe = if frame.keyframe { ", keyframe" } else { "" };
            self.log(&format!(
                "frame {number} at {time_s:.3} s: {status}{keyframe}, {inliers} of {tracks} tracks agree, residual {residual_px:.3} px"
            ));
        } else if before.is_some_and(|before| before != *status) {
            self.log(&format!("frame {number} at {time_s:.3} s: {status}"));
        }
    }

    /// Changes what is counted, and writes a line of it if `change` returns true.
    fn count(&self, change: impl FnOnce(&mut Counted) -> bool) {
        let mut counted = self.counted.lock().unwrap_or_else(PoisonError::into_inner);
        if change(&mut counted) && self.progress == Some(Progress::Json) {
            let Counted { frames, lost, of, .. } = *counted;
            let _ = writeln!(stderr(), "{}", json!({ "frames": frames, "of": of, "lost": lost }));
        }
    }

    fn bar(&self) -> MutexGuard<'_, ProgressBar> {
        self.bar.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Observer for ConsoleObserver {
    fn tracking_again(&self, why: &str) {
        if self.level > Level::Nothing {
            self.log(why);
        }
        *self.again.lock().unwrap_or_else(PoisonError::into_inner) = format!(" ({why})");
    }

    fn tracking_begins(&self, frames: Option<u64>) {
        if self.progress == Some(Progress::Bar) {
            let mut bar = self.bar();
            // The bar of the pass before would stay on the screen.
            bar.finish_and_clear();
            let again = std::mem::take(&mut *self.again.lock().unwrap_or_else(PoisonError::into_inner));
            *bar = progress(frames, &again);
        }
        if self.level > Level::Nothing {
            self.log("tracking begins");
        }
        // Again where the recording starts again with another mount or lens.
        self.count(|counted| {
            *counted = Counted { of: frames, ..Counted::default() };
            true
        });
    }

    fn frame(&self, estimate: &FrameEstimate) {
        self.bar().inc(1);
        let mut before = None;
        self.count(|counted| {
            before = counted.status.replace(estimate.status);
            counted.frames += 1;
            counted.lost += u64::from(estimate.estimate.is_none());
            counted.frames.is_multiple_of(FRAMES_PER_LINE)
        });
        if self.level > Level::Nothing {
            self.log_frame(estimate, before);
        }
    }

    fn tracking_ends(&self) {
        self.bar().finish_and_clear();
        if self.level > Level::Nothing {
            self.log("tracking has ended; loops, sensors, mosaic and report follow");
        }
        self.count(|counted| !counted.frames.is_multiple_of(FRAMES_PER_LINE));
    }

    fn warn(&self, sentence: &str) {
        if !self.quiet {
            console::warn(sentence);
        }
    }

    fn note(&self, sentence: &str) {
        if !self.quiet {
            console::note(sentence);
        }
    }

    fn is_stop_asked(&self) -> bool {
        interrupt::asked()
    }
}

/// A camera in a line.
fn camera_line(camera: &Camera) -> String {
    let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.principal_px());
    let readout = match camera.readout_s() {
        Some(0.0) => "global shutter".to_owned(),
        Some(readout_s) => format!("readout {:.2} ms", 1e3 * readout_s),
        None => "readout to be learned".to_owned(),
    };
    let coefficients: Vec<String> =
        camera.distortion().coefficients().iter().map(|coefficient| coefficient.to_string()).collect();
    let lens = match coefficients.is_empty() {
        true => "no distortion".to_owned(),
        false => format!("distortion {}", coefficients.join(" ")),
    };
    format!(
        "{}x{}, focal length {fx:.2} and {fy:.2} px, principal point {cx:.2}, {cy:.2}, {lens}, {readout}",
        camera.width(),
        camera.height(),
    )
}

/// A bar if the number of frames is known, otherwise a count, and why the recording is tracked
/// again; nothing if standard error is not a terminal. A line of a terminal holds it.
fn progress(frames: Option<u64>, again: &str) -> ProgressBar {
    let templates = match again.is_empty() {
        true => ["{bar:40} {pos}/{len} frames, {rate}, {eta} left", "{spinner} {pos} frames, {rate}{msg}"],
        false => ["{bar:20} {pos}/{len}, {eta} left{msg}", "{spinner} {pos} frames, {rate}{msg}"],
    };
    let bar = console::progress_as(templates, frames, false);
    let rate = |state: &ProgressState, text: &mut dyn fmt::Write| {
        let _ = text.write_str(&rate_text(state.per_sec()));
    };
    bar.set_style(bar.style().with_key("rate", rate));
    bar.with_message(again.to_owned())
}

/// Frames per second, whole ones from ten on.
fn rate_text(frames_per_s: f64) -> String {
    let decimals = usize::from(frames_per_s < 9.95);
    format!("{frames_per_s:.decimals$}/s")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_have_the_digits_that_matter() {
        for (rate, text) in [(102.8558, "103/s"), (9.97, "10/s"), (2.345, "2.3/s"), (0.0, "0.0/s")] {
            assert_eq!(rate_text(rate), text);
        }
    }
}
