//! Reference trajectory, such as a satellite receiver's, shown beside that of the run.

use crate::plan::RunPlan;
use crate::trajectory_input::read_trajectory;
use odograph::error::Result;
use odograph::evaluation::{Alignment, Evaluation, EvaluationOptions, evaluate};
use odograph::formats::trajectory_file::Trajectory;
use std::path::Path;

/// The reference trajectory of the plan, if any. Fails where it cannot be read.
pub fn read(plan: &RunPlan) -> Result<Option<Trajectory>> {
    plan.reference.as_deref().map(trajectory_in).transpose()
}

fn trajectory_in(path: &Path) -> Result<Trajectory> {
    read_trajectory(path, None, None).map(|read| read.trajectory)
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
    let estimate = trajectory_in(&folder.join("trajectory.tum"))?;
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
