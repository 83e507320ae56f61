//! Recording to disk during a run; on a full disk tracking continues.

use crate::folder::OutputFolder;
use crate::plan::RunPlan;
use crate::report::ReportMark;
use odograph::error::Result;
use odograph::trajectory::FrameEstimate;
use odograph_live::{Hub, Mark};
use std::fmt::Write;
use std::path::Path;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Longest time of results lost if the program is killed.
const FLUSHED_EVERY: Duration = Duration::from_millis(500);
/// Interval of checks of free disk space: seldom enough to cost nothing.
const SPACE_EVERY: Duration = Duration::from_secs(10);
/// Free disk space below which a warning is given, bytes: the drawings at the end take tens of
/// megabytes.
const LITTLE_SPACE: u64 = 200 << 20;

/// The output folder of a live run.
pub struct Recorder {
    folder: OutputFolder,
    /// `run.toml`, until it is written with the first frame: a run without frames leaves no files.
    plan: Option<String>,
    flushed: Instant,
    space_looked: Option<Instant>,
    little_space: Option<String>,
    stopped: Option<String>,
    marks: Vec<Mark>,
    /// Changes of the marks that are recorded.
    marks_changed: u64,
}

impl Recorder {
    /// Records into a folder. The plan is in it from the first frame on.
    pub fn new(folder: OutputFolder, plan: &RunPlan) -> Result<Self> {
        Ok(Self {
            plan: Some(plan.text_in(folder.path())?),
            folder,
            flushed: Instant::now(),
            space_looked: None,
            little_space: None,
            stopped: None,
            marks: Vec::new(),
            marks_changed: 0,
        })
    }

    /// Adds a frame.
    pub fn record(&mut self, frame: &FrameEstimate) {
        if self.stopped.is_some() {
            return;
        }
        let mut written = match self.plan.take() {
            Some(plan) => self.folder.write("run.toml", plan.as_bytes()),
            None => Ok(()),
        };
        written = written.and_then(|()| self.folder.record(frame));
        if written.is_ok() && self.flushed.elapsed() >= FLUSHED_EVERY {
            self.flushed = Instant::now();
            written = self.folder.flush();
        }
        if let Err(error) = written {
            self.stopped = Some(format!("{error}; tracking goes on, but it is not recorded any more"));
        }
    }

    /// Records the marks, if any was set or renamed since the last call.
    pub fn record_marks(&mut self, hub: &Hub) {
        let changed = hub.marks_changed();
        if changed == self.marks_changed {
            return;
        }
        (self.marks, self.marks_changed) = (hub.marks_from(0), changed);
        if let Err(error) = self.folder.write("marks.csv", marks_csv(&self.marks).as_bytes()) {
            self.stopped.get_or_insert(error.to_string());
        }
    }

    /// The marks for the report.
    pub fn report_marks(&self) -> Vec<ReportMark> {
        let of = |mark: &Mark| ReportMark { name: mark.name.clone(), time_s: f64::from(mark.time_s) };
        self.marks.iter().map(of).collect()
    }

    /// Warning about the disk.
    pub fn message(&mut self) -> Option<String> {
        if self.space_looked.is_none_or(|looked| looked.elapsed() >= SPACE_EVERY) {
            self.space_looked = Some(Instant::now());
            self.little_space = self.space_left().filter(|left| *left < LITTLE_SPACE).map(|left| {
                format!(
                    "the disk is nearly full: {} MB are left for {}",
                    left >> 20,
                    self.folder.path().display()
                )
            });
        }
        self.stopped.clone().or_else(|| self.little_space.clone())
    }

    /// Whether frames are recorded.
    pub fn is_recording(&self) -> bool {
        self.stopped.is_none()
    }

    /// Path of the folder.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// The folder, for the results.
    pub fn into_folder(self) -> OutputFolder {
        self.folder
    }

    #[cfg(unix)]
    fn space_left(&self) -> Option<u64> {
        let space = rustix::fs::statvfs(self.folder.path()).ok()?;
        Some(space.f_bavail.saturating_mul(space.f_frsize))
    }

    #[cfg(not(unix))]
    fn space_left(&self) -> Option<u64> {
        None
    }
}

/// Marks as a table.
fn marks_csv(marks: &[Mark]) -> String {
    let mut text = String::from("time_s,x_m,y_m,name\n");
    for mark in marks {
        let number = |value: Option<f32>| value.map_or(String::new(), |value| format!("{value:.4}"));
        let name = mark.name.replace('"', "\"\"");
        let _ = writeln!(text, "{:.3},{},{},\"{name}\"", mark.time_s, number(mark.x_m), number(mark.y_m));
    }
    text
}

/// A name for the folder of a run that begins now, in universal time: `live-2026-11-21-164501`.
pub fn folder_name_now() -> String {
    let seconds = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
    folder_name(seconds)
}

/// Days to a date by Howard Hinnant's `civil_from_days` (chrono-compatible low-level date
/// algorithms).
fn folder_name(seconds: u64) -> String {
    let (day, second) = (seconds / 86_400 + 719_468, seconds % 86_400);
    let (era, day_of_era) = (day / 146_097, day % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_from_march = (5 * day_of_year + 2) / 153;
    let date = day_of_year - (153 * month_from_march + 2) / 5 + 1;
    let month = if month_from_march < 10 { month_from_march + 3 } else { month_from_march - 9 };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
    format!("live-{year:04}-{month:02}-{date:02}-{hour:02}{minute:02}{second:02}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_of_folders() {
        assert_eq!(folder_name(0), "live-1970-01-01-000000");
        assert_eq!(folder_name(951_782_400 + 3661), "live-2000-02-29-010101");
        assert_eq!(folder_name(1_767_225_599), "live-2025-12-31-235959");
    }

    #[test]
    fn marks_with_quotes_and_without_a_place() {
        let mark =
            |x_m: Option<f32>, name: &str| Mark { record: 0, time_s: 1.5, x_m, y_m: x_m, name: name.into() };
        let text = marks_csv(&[mark(Some(-0.5), "door \"A\""), mark(None, "lost")]);
        assert_eq!(text, "time_s,x_m,y_m,name\n1.500,-0.5000,-0.5000,\"door \"\"A\"\"\"\n1.500,,,\"lost\"\n");
    }
}
