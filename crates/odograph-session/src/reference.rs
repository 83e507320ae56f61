//! A path from elsewhere, such as that of a satellite receiver, to be seen beside that of the run.

use crate::plan::RunPlan;
use crate::trajectory_input::read_trajectory;
use odograph::error::Result;
use odograph::evaluation::{Alignment, Evaluation, EvaluationOptions, evaluate};
use odograph::formats::trajectory_file::Trajectory;
use std::path::Path;

/// The path that the plan names, where it names one. Fails where it cannot be read.
pub fn read(plan: &RunPlan) -> Result<Option<Trajectory>> {
    plan.reference.as_deref().map(trajectory_in).transpose()
}

fn trajectory_in(path: &Path) -> Result<Trajectory> {
    read_trajectory(path, None, None).map(|read| read.trajectory)
}

/// The path of a run compared with a path from elsewhere.
#[derive(Debug)]
pub struct ComparedReference {
    /// Name of the file with the other path.
    pub name: String,
    /// The other path.
    pub reference: Trajectory,
    /// Where the run's path lies from it, after alignment by rotation, shift and scale.
    pub evaluation: Evaluation,
}

/// The path of the run in `folder` and that one, laid onto each other by a turn, a shift and a
/// scale. Fails where they have no times in common.
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

/// A receiver's second and a camera's frame belong together where they are no further apart than
/// this, seconds: half of the time between the fixes of a receiver that gives ten a second.
const TOLERANCE_S: f64 = 0.05;
