//! A path from elsewhere, such as that of a satellite receiver, to be seen beside that of the run.

use super::RunPlan;
use crate::commands::evaluate::{plot, trajectory_in};
use crate::report::ReportReference;
use odograph::error::Result;
use odograph::evaluation::{Alignment, EvaluationOptions, evaluate};
use odograph::formats::trajectory_file::Trajectory;
use std::path::Path;

/// The path that the plan names, where it names one. Fails where it cannot be read.
pub fn read(plan: &RunPlan) -> Result<Option<Trajectory>> {
    plan.reference.as_deref().map(trajectory_in).transpose()
}

/// The path of the run in `folder` and that one, laid onto each other by a turn, a shift and a
/// scale. Fails where they have no times in common.
pub fn compared(path: &Path, reference: &Trajectory, folder: &Path) -> Result<ReportReference> {
    let estimate = trajectory_in(&folder.join("trajectory.tum"))?;
    let options = EvaluationOptions {
        max_time_difference_s: TOLERANCE_S,
        alignment: Alignment::Sim3,
        ..EvaluationOptions::default()
    };
    let evaluation = evaluate(&estimate, reference, &options).map_err(|error| error.at(path.display()))?;
    let errors = &evaluation.absolute.translation;
    Ok(ReportReference {
        svg: plot::from_above(&evaluation, reference),
        name: path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned(),
        compared: evaluation.pairs.len(),
        length_m: evaluation.truth_length_m,
        scale: evaluation.scale,
        rms_m: errors.rmse,
        median_m: errors.median,
        most_m: errors.max,
    })
}

/// A receiver's second and a camera's frame belong together where they are no further apart than
/// this, seconds: half of the time between the fixes of a receiver that gives ten a second.
const TOLERANCE_S: f64 = 0.05;
