//! What a run gives.

use crate::place::PlaceInMap;
use crate::resemblance::Resemblance;
use crate::statistics::Statistics;
use odograph::trajectory::FrameSummary;
use std::path::PathBuf;

/// Why a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunEnd {
    /// With its source.
    Completed,
    /// Early, because its observer asked for it. What there is has been written.
    Interrupted,
    /// With its source, but less than half of the frames have a pose: the path is not the
    /// recording's path. What there is has been written.
    TrackingFailed,
}

impl RunEnd {
    pub(crate) fn of(statistics: &Statistics) -> Self {
        if statistics.interruption().is_some() {
            return Self::Interrupted;
        }
        // With less than half of the frames posed the path is not the recording's path.
        if 2 * statistics.frames_with_pose < statistics.frames {
            Self::TrackingFailed
        } else {
            Self::Completed
        }
    }
}

/// What a run gives, beside what it has written.
#[derive(Debug)]
pub struct RunOutcome {
    /// Why it ended.
    pub end: RunEnd,
    /// All frames in order, with loops closed and other sensors used, as `trajectory.csv` has them.
    pub trajectory: Vec<FrameSummary>,
    /// The figures that are in `stats.json`.
    pub statistics: Statistics,
    /// What may be wrong with the result, a sentence each.
    pub warnings: Vec<String>,
    /// The folder that was written into.
    pub folder: PathBuf,
    /// The files that were written, in order; the map file last. With a temporary folder they are
    /// gone already, but for a map that was continued.
    pub written: Vec<PathBuf>,
    /// Where the camera was last in the map that was continued; `None` where none was, or nothing
    /// of it was recognised.
    pub place: Option<PlaceInMap>,
    /// What it looks like there, where the map was only looked into and nothing of it recognised.
    pub resemblance: Option<Resemblance>,
}
