//! Reference trajectory, such as a satellite receiver's, shown beside that of the run.

use crate::plan::RunPlan;
use crate::trajectory_input::read_trajectory;
use odograph::error::{Error, Result};
use odograph::evaluation::{Alignment, Evaluation, EvaluationOptions, evaluate};
use odograph::formats::trajectory_file::Trajectory;
use std::path::Path;

/// A reference trajectory.
#[derive(Debug)]
pub struct ReferencePath {
    /// Name of its file, or of its topic.
    name: String,
    trajectory: Trajectory,
}

impl ReferencePath {
    /// The reference trajectory of the plan, if any; what is wrong with its topic is added to the
    /// warnings. Fails where it cannot be read or has no times.
    pub fn read(plan: &RunPlan, warnings: &mut Vec<String>) -> Result<Option<Self>> {
        if let Some(path) = plan.reference.as_deref() {
            return Self::of_file(path).map(Some);
        }
        let Some(topic) = &plan.reference_topic else { return Ok(None) };
        let (trajectory, found) = odograph_video::recorded_path(&plan.source.path, topic)?;
        warnings.extend(found);
        Ok(Some(Self { name: topic.clone(), trajectory }))
    }

    fn of_file(path: &Path) -> Result<Self> {
        let read = read_trajectory(path, None, None)?;
        if !read.timed {
            // Its pose numbers would be compared with the times of the frames.
            return Err(Error::input(format!(
                "{} has no times (KITTI), by which a reference is compared with the frames; give it in TUM's format, a line \
                 `time x y z qx qy qz qw` per pose, with times of the recording",
                path.display()
            )));
        }
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        Ok(Self { name, trajectory: read.trajectory })
    }

    /// The trajectory of the run in `folder` and the reference, aligned by a similarity transform.
    /// Fails where they have no times in common.
    pub fn compared(&self, folder: &Path) -> Result<ComparedReference> {
        let estimate = read_trajectory(&folder.join("trajectory.tum"), None, None)?.trajectory;
        let options = EvaluationOptions {
            max_time_difference_s: TOLERANCE_S,
            alignment: Alignment::Sim3,
            ..EvaluationOptions::default()
        };
        let evaluation =
            evaluate(&estimate, &self.trajectory, &options).map_err(|error| error.at(&self.name))?;
        Ok(ComparedReference { name: self.name.clone(), reference: self.trajectory.clone(), evaluation })
    }
}

/// Comparison of a run with a reference trajectory.
#[derive(Debug)]
pub struct ComparedReference {
    /// Name of the file or the topic.
    pub name: String,
    /// The reference.
    pub reference: Trajectory,
    /// Errors of the run, after alignment by rotation, shift and scale.
    pub evaluation: Evaluation,
}

/// Largest time difference of associated poses, seconds: half of the interval of a receiver with
/// ten fixes a second.
const TOLERANCE_S: f64 = 0.05;
