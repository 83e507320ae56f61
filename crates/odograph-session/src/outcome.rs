//! The result of a run.

use crate::place::PoseInMap;
use crate::resemblance::Resemblance;
use crate::statistics::RunStatistics;
use odograph::trajectory::FrameSummary;
use std::path::PathBuf;

/// Why a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunEnd {
    /// The source ended.
    Completed,
    /// The observer asked for it. Results so far are written.
    Interrupted,
    /// The source ended, but less than half of the frames have a pose: the path is not that of the
    /// recording. Results are written.
    TrackingFailed,
}

impl RunEnd {
    pub(crate) fn of(statistics: &RunStatistics) -> Self {
        if statistics.interruption().is_some() {
            return Self::Interrupted;
        }
        // With less than half of the frames posed the path is not that of the recording.
        if 2 * statistics.frames_with_pose < statistics.frames {
            Self::TrackingFailed
        } else {
            Self::Completed
        }
    }
}

/// The result of a run, in addition to its files.
#[derive(Debug)]
pub struct RunOutcome {
    /// Why it ended.
    pub end: RunEnd,
    /// All frames in order, with loops closed and other sensors used, as `trajectory.csv` has them.
    pub trajectory: Vec<FrameSummary>,
    /// The statistics of `stats.json`.
    pub statistics: RunStatistics,
    /// Warnings about the result, one sentence each.
    pub warnings: Vec<String>,
    /// The output folder.
    pub folder: PathBuf,
    /// The files in the order of writing, the map file last. With a temporary folder they no longer
    /// exist, except a continued map.
    pub written: Vec<PathBuf>,
    /// The last pose of the camera in the continued map; `None` without such a map, or if none of
    /// it was recognised.
    pub place: Option<PoseInMap>,
    /// Similar places of the map, where localization found no certain one.
    pub resemblance: Option<Resemblance>,
}
