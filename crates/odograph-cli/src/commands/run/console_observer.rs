//! How a run goes on, on the console.

use crate::{console, interrupt};
use indicatif::{ProgressBar, ProgressStyle};
use odograph::trajectory::FrameEstimate;
use odograph_session::Observer;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Shows a progress bar, and ends the run at Ctrl-C.
pub struct ConsoleObserver {
    quiet: bool,
    /// Whether there is a bar.
    shows_progress: bool,
    bar: Mutex<ProgressBar>,
}

impl ConsoleObserver {
    /// A `quiet` one says nothing.
    pub fn new(quiet: bool) -> Self {
        Self { quiet, shows_progress: !quiet, bar: Mutex::new(ProgressBar::hidden()) }
    }

    /// The same without a bar: for runs that have a page instead.
    pub fn without_progress(quiet: bool) -> Self {
        Self { shows_progress: false, ..Self::new(quiet) }
    }

    fn bar(&self) -> MutexGuard<'_, ProgressBar> {
        self.bar.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Observer for ConsoleObserver {
    fn tracking_begins(&self, frames: Option<u64>) {
        if self.shows_progress {
            *self.bar() = progress(frames);
        }
    }

    fn frame(&self, _: &FrameEstimate) {
        self.bar().inc(1);
    }

    fn tracking_ends(&self) {
        self.bar().finish_and_clear();
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
