//! Reference trajectory, such as a satellite receiver's, shown beside that of the run.

use crate::plan::RunPlan;
use crate::trajectory_input::read_trajectory;
use odograph::error::{Error, Result};
use odograph::evaluation::{Alignment, Evaluation, EvaluationOptions, evaluate};
use odograph::formats::trajectory_file::Trajectory;
use std::path::Path;

/// The reference trajectory of the plan, if any. Fails where it cannot be read or has no times.
pub fn read(plan: &RunPlan) -> Result<Option<Trajectory>> {
    let Some(path) = plan.reference.as_deref() else { return Ok(None) };
    let read = read_trajectory(path, None, None)?;
    if !read.timed {
        // Its pose numbers would be compared with the times of the frames.
        return Err(Error::input(format!(
            "{} has no times (KITTI), by which a reference is compared with the frames; give it in TUM's format, a line \
             `time x y z qx qy qz qw` per pose, with times of the recording",
            path.display()
        )));
    }
    Ok(Some(read.trajectory))
}

/// Comparison of a run with a reference trajectory.
#[derive(Debug)]
pub struct ComparedReference {
    /// File name of the reference.
    pub name: String,
    /// The reference.
    pub reference: Trajectory,
    /// Errors of the run, after alignment by rotation, shift and scale.
    pub evaluation: Evaluation,
}

/// The trajectory of the run in `folder` and the reference, aligned by a similarity transform.
/// Fails where they have no times in common.
pub fn compared(path: &Path, reference: Trajectory, folder: &Path) -> Result<ComparedReference> {
    let estimate = read_trajectory(&folder.join("trajectory.tum"), None, None)?.trajectory;
    let options = EvaluationOptions {
        max_time_difference_s: TOLERANCE_S,
        alignment: Alignment::Sim3,
        ..EvaluationOptions::default()
    };
    let evaluation = evaluate(&estimate, &reference, &options).map_err(|error| error.at(path.display()))?;
    let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
    Ok(ComparedReference { name, reference, evaluation })
}

/// Largest time difference of associated poses, seconds: half of the interval of a receiver with
/// ten fixes a second.
const TOLERANCE_S: f64 = 0.05;
