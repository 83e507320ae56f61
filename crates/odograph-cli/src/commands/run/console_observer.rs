//! Progress of a run on the console.

use crate::{console, interrupt};
use indicatif::{ProgressBar, ProgressStyle};
use odograph::trajectory::FrameEstimate;
use odograph_session::Observer;
use serde_json::json;
use std::io::{Write, stderr};
use std::sync::{Mutex, MutexGuard, PoisonError};

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
    counted: Mutex<Counted>,
}

/// What the lines of progress contain.
#[derive(Debug, Default)]
struct Counted {
    frames: u64,
    lost: u64,
    of: Option<u64>,
}

impl ConsoleObserver {
    /// A `quiet` observer prints nothing.
    pub fn new(quiet: bool) -> Self {
        Self {
            quiet,
            progress: (!quiet).then_some(Progress::Bar),
            bar: Mutex::new(ProgressBar::hidden()),
            counted: Mutex::default(),
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

    /// Changes what is counted, and writes a line of it if `change` returns true.
    fn count(&self, change: impl FnOnce(&mut Counted) -> bool) {
        let mut counted = self.counted.lock().unwrap_or_else(PoisonError::into_inner);
        if change(&mut counted) && self.progress == Some(Progress::Json) {
            let Counted { frames, lost, of } = *counted;
            let _ = writeln!(stderr(), "{}", json!({ "frames": frames, "of": of, "lost": lost }));
        }
    }

    fn bar(&self) -> MutexGuard<'_, ProgressBar> {
        self.bar.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Observer for ConsoleObserver {
    fn tracking_begins(&self, frames: Option<u64>) {
        if self.progress == Some(Progress::Bar) {
            *self.bar() = progress(frames);
        }
        // Again where the recording starts again with another mount or lens.
        self.count(|counted| {
            *counted = Counted { of: frames, ..Counted::default() };
            true
        });
    }

    fn frame(&self, estimate: &FrameEstimate) {
        self.bar().inc(1);
        self.count(|counted| {
            counted.frames += 1;
            counted.lost += u64::from(estimate.estimate.is_none());
            counted.frames.is_multiple_of(FRAMES_PER_LINE)
        });
    }

    fn tracking_ends(&self) {
        self.bar().finish_and_clear();
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

/// A bar if the number of frames is known, otherwise a count; nothing if standard error is not a
/// terminal.
fn progress(frames: Option<u64>) -> ProgressBar {
    let bar = frames.map_or_else(ProgressBar::new_spinner, ProgressBar::new);
    let template = match frames {
        Some(_) => "{bar:40} {pos}/{len} frames, {per_sec}, {eta} left",
        None => "{spinner} {pos} frames, {per_sec}",
    };
    if let Ok(style) = ProgressStyle::with_template(template) {
        bar.set_style(style);
    }
    bar
}
