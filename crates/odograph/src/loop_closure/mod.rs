//! Loop closure: whether a new keyframe shows ground that an older one shows, and from where.
//!
//! Candidates come from the pose graph ([`candidates`]) and from place recognition
//! ([`recognition`]). The tracker of odometry finds the corners of one keyframe in the image of the
//! other ([`matching`]), [`likeness`] and [`smooth_difference`] say how registered images differ,
//! and [`verification`] decides which matches are accepted; [`lookalikes`] decides for a single
//! picture over ground that repeats itself.

mod overlap;
mod likeness;
mod smooth_difference;
pub(crate) mod matching;
pub(crate) mod candidates;
mod gate;
pub(crate) mod recognition;
pub(crate) mod verification;
pub(crate) mod lookalikes;

pub use verification::LoopClosure;

use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// When a loop closure is accepted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LoopClosureConfig {
    /// Whether to search for loop closures.
    pub loops: bool,
    /// Maximum number of older keyframes that a new one is compared with.
    pub comparisons: usize,
    /// Minimum number of edges between two keyframes for a loop closure: with fewer, odometry has
    /// them well enough.
    pub least_edges: usize,
    /// Minimum overlap of two keyframes, as a share of the new one's view.
    pub least_overlap: f64,
    /// Minimum share of the corners in the overlap that must be matched.
    #[serde(alias = "least_presence")]
    pub least_inlier_ratio: f64,
    /// Number of agreeing matches on different ground, 1 or 2, that joins parts of a map whose
    /// relative pose is unknown or ambiguous. 1 is enough to localize a camera; a map that is kept
    /// needs 2.
    pub sightings: usize,
}

impl Default for LoopClosureConfig {
    fn default() -> Self {
        Self {
            loops: true,
            comparisons: 2,
            least_edges: 4,
            least_overlap: 0.35,
            least_inlier_ratio: 0.5,
            sightings: 2,
        }
    }
}

impl LoopClosureConfig {
    /// The same parameters if all are in range. Fails with the name and the value of one that is
    /// not.
    pub fn validated(self) -> Result<Self> {
        Error::check_range("slam.least_overlap", self.least_overlap, 0.1..=1.0)?;
        Error::check_range("slam.least_inlier_ratio", self.least_inlier_ratio, 0.1..=1.0)?;
        Error::check_range("slam.comparisons", self.comparisons, 1..=1000)?;
        Error::check_range("slam.least_edges", self.least_edges, 2..=1000)?;
        Error::check_range("slam.sightings", self.sightings, 1..=2)?;
        Ok(self)
    }
}
