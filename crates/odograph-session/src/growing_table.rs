//! The table of frames that grows while a recording is tracked, so that a killed run keeps them.
//!
//! Where a recording is tracked again, the frames of the pass before stay on disk until the new
//! pass has as many.

use crate::files;
use odograph::error::Result;
use odograph::formats::trajectory_file;
use odograph::trajectory::FrameEstimate;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Frames per write to disk: a second of video.
const GROUP: usize = 30;

/// `trajectory.csv.part` in the folder of a run.
#[derive(Debug)]
pub(crate) struct GrowingTable {
    path: PathBuf,
    file: File,
    pending: Vec<FrameEstimate>,
    /// Number of frames of this pass in the file.
    frames: u64,
    /// Number of frames of an earlier pass at `path`, which this pass does not have yet.
    earlier: Option<u64>,
}

impl GrowingTable {
    /// Where the table of a run in this folder is.
    pub fn path_in(folder: &Path) -> PathBuf {
        files::beside(&folder.join("trajectory.csv"))
    }

    /// Where a pass begins that does not have as many frames yet as the one before.
    fn path_again(&self) -> PathBuf {
        self.path.with_extension("again")
    }

    /// An empty table, in place of one that is there.
    pub fn create(folder: &Path) -> Result<Self> {
        let path = Self::path_in(folder);
        let file = File::create(&path).map_err(|error| files::cannot_be_written(&path, error))?;
        let table = Self { path, file, pending: Vec::new(), frames: 0, earlier: None };
        let _ = fs::remove_file(table.path_again());
        Ok(table)
    }

    /// Whether frames are on disk, of this pass or an earlier one.
    pub fn has_frames(&self) -> bool {
        self.frames > 0 || self.earlier.is_some()
    }

    /// Begins a new pass.
    pub fn begin_again(&mut self) -> Result<()> {
        let earlier = self.earlier.unwrap_or(self.frames);
        let path = self.path_again();
        self.file = File::create(&path).map_err(|error| files::cannot_be_written(&path, error))?;
        self.pending.clear();
        (self.frames, self.earlier) = (0, Some(earlier));
        Ok(())
    }

    /// Adds a frame, which is on disk within a second of video.
    pub fn record(&mut self, frame: &FrameEstimate) -> Result<()> {
        self.pending.push(frame.clone());
        if self.pending.len() >= GROUP { self.flush() } else { Ok(()) }
    }

    /// Writes recorded frames to disk.
    pub fn flush(&mut self) -> Result<()> {
        if self.pending.is_empty() {
            return Ok(());
        }
        let text = trajectory_file::csv_from_frames(&self.pending);
        // The header is written once.
        let body = if self.frames > 0 { text.split_once('\n').map_or("", |(_, body)| body) } else { &text };
        let added = self.pending.len() as u64;
        self.pending.clear();
        let cannot = |error| files::cannot_be_written(&self.path, error);
        self.file.write_all(body.as_bytes()).map_err(cannot)?;
        self.frames += added;
        if self.earlier.is_some_and(|earlier| self.frames >= earlier) {
            fs::rename(self.path_again(), &self.path).map_err(cannot)?;
            self.earlier = None;
        }
        Ok(())
    }

    /// Removes the table, once its frames are elsewhere.
    pub fn remove(&self) {
        let _ = fs::remove_file(self.path_again());
        let _ = fs::remove_file(&self.path);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use odograph::trajectory::{LossReason, TrackStatus};

    fn frame(number: u64) -> FrameEstimate {
        FrameEstimate {
            frame: number,
            time_s: number as f64,
            status: TrackStatus::Lost { reason: LossReason::Bare },
            estimate: None,
            tracks: 0,
            inliers: 0,
            residual_px: 0.0,
            keyframe: false,
            segment: 0,
        }
    }

    #[test]
    fn a_new_pass_replaces_the_one_before_when_it_has_as_many_frames() {
        let folder = tempfile::tempdir().unwrap();
        let first_of = |passed: u64| move |number| frame(1000 * passed + number);
        let table = || fs::read_to_string(GrowingTable::path_in(folder.path())).unwrap();
        let numbers = || -> Vec<u64> {
            let text = table();
            let number = |line: &str| line.split(',').next()?.parse().ok();
            text.lines().skip(1).map(|line| number(line).unwrap()).collect()
        };
        let mut growing = GrowingTable::create(folder.path()).unwrap();
        assert!(!growing.has_frames());
        (0..70).map(first_of(0)).for_each(|frame| growing.record(&frame).unwrap());
        assert_eq!(numbers(), (0..60).collect::<Vec<_>>());
        growing.begin_again().unwrap();
        assert!(growing.has_frames());
        (0..50).map(first_of(1)).for_each(|frame| growing.record(&frame).unwrap());
        assert_eq!(numbers(), (0..60).collect::<Vec<_>>(), "thirty frames are fewer than sixty");
        // A third pass before the second has as many.
        growing.begin_again().unwrap();
        (0..65).map(first_of(2)).for_each(|frame| growing.record(&frame).unwrap());
        assert_eq!(numbers(), (2000..2060).collect::<Vec<_>>());
        growing.flush().unwrap();
        assert_eq!(numbers(), (2000..2065).collect::<Vec<_>>(), "it goes on in the same file");
        growing.remove();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
