//! Runs that did not end: what they have left in their folder.

use crate::begun_run::{BegunRun, begun_file};
use crate::growing_table::GrowingTable;
use odograph_map::MapClaim;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::Path;

/// A run that did not end.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnfinishedRun {
    /// Number of frames on disk.
    pub frames: u64,
    /// Number of those with a pose.
    pub posed: u64,
    /// Whether `odograph run --resume` can run it again.
    pub can_resume: bool,
    /// Whether it goes on: a program writes the folder.
    pub goes_on: bool,
}

impl UnfinishedRun {
    /// The unfinished run in a folder; `None` if the run is complete, or the folder has no run.
    pub fn in_folder(folder: &Path) -> Option<Self> {
        let growing = GrowingTable::path_in(folder);
        let has_begun = begun_file(folder).is_file();
        let has_path = growing.is_file() || folder.join("run.toml").is_file();
        if !has_begun && (!has_path || folder.join("stats.json").exists()) {
            return None;
        }
        let table = if growing.is_file() { growing } else { folder.join("trajectory.csv") };
        let (frames, posed) = counted(&table);
        let can_resume = BegunRun::read(folder).is_ok();
        Some(Self { frames, posed, can_resume, goes_on: MapClaim::is_held(&folder.join("map.gpkg")) })
    }

    /// What it has, and how it can be finished, as the end of a sentence about its folder.
    pub fn description(&self, folder: &Path) -> String {
        let Self { frames, posed, .. } = self;
        let there = format!("{frames} frames are on disk, {posed} with a pose");
        match (self.goes_on, self.can_resume) {
            (true, _) => format!("has a run that goes on; {there}"),
            (false, true) => format!(
                "has a run that did not end; {there}; odograph run --resume {} runs it again, to its end",
                folder.display()
            ),
            (false, false) => format!("has a run that did not end; {there}"),
        }
    }
}

/// Numbers of frames, and of those with a pose, in a table of frames.
fn counted(table: &Path) -> (u64, u64) {
    let Ok(file) = File::open(table) else { return (0, 0) };
    let lines = BufReader::new(file).split(b'\n').skip(1).map_while(std::result::Result::ok);
    lines
        .filter(|line| !line.is_empty())
        .fold((0, 0), |(frames, posed), line| (frames + 1, posed + u64::from(line.ends_with(b",tracked"))))
}
