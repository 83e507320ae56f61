//! The error of a trajectory.

use crate::arrays::{Matrix, isometry, numbers, transform};
use crate::error::{Failure, Result};
use crate::simulation::PySimulation;
use crate::trajectory::PyTrajectory;
use numpy::IntoPyArray;
use numpy::ndarray::Array2;
use odograph_core::evaluation::{
    Alignment, Delta, Evaluation, EvaluationOptions, Statistics, evaluate as measure,
};
use odograph_core::trajectory::{StampedPose, Trajectory};
use odograph_session::{LoadedTrajectory, read_trajectory};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;

/// A trajectory in one of the ways to have one.
#[derive(FromPyObject)]
pub enum TrajectoryArgument<'py> {
    Run(Bound<'py, PyTrajectory>),
    Truth(Bound<'py, PySimulation>),
    File(PathBuf),
    /// N times and N×4×4 poses.
    Arrays(Bound<'py, PyAny>, Bound<'py, PyAny>),
}

impl TrajectoryArgument<'_> {
    fn read(&self, name: &str) -> Result<LoadedTrajectory> {
        let trajectory = match self {
            Self::Run(run) => run.get().stamped(),
            Self::Truth(simulation) => simulation.get().truth(),
            Self::File(path) => return Ok(read_trajectory(path, None, None)?),
            Self::Arrays(times, poses) => {
                let (shape, times_s) = numbers(&format!("the times of the {name}"), times)?;
                let (pose_shape, rows) = numbers(&format!("the poses of the {name}"), poses)?;
                if shape.len() != 1 || pose_shape != [shape[0], 4, 4] {
                    return Err(Failure::usage(format!(
                        "the {name} is (timestamps, poses) of N and N×4×4 numbers; these have {shape:?} and {pose_shape:?}"
                    )));
                }
                let stamped = |(at, (time_s, rows)): (usize, (f64, &[f64]))| {
                    let rigid = isometry(rows).ok_or_else(|| {
                        Failure::usage(format!(
                            "pose {at} of the {name} is no rigid transform: a rotation and a shift, with 0 0 0 1 below"
                        ))
                    });
                    Ok(StampedPose { time_s, world_from_camera: rigid? })
                };
                let poses = times_s.into_iter().zip(rows.chunks_exact(16)).enumerate();
                Trajectory { poses: poses.map(stamped).collect::<Result<_>>()? }
            }
        };
        Ok(LoadedTrajectory { trajectory, timed: true })
    }
}

/// Compares a trajectory with the truth, by the definitions of evo (docs/evaluation.md).
///
/// Each of both is the Trajectory of a run, a Simulation, the path of a file (TUM or KITTI), or a
/// pair of N timestamps in seconds and N×4×4 poses. align is how the estimate is aligned before:
/// "none", "origin" (the first poses onto each other), "se2" (turn about z and shift in x and y),
/// "se3" or "sim3" (with scale). Poses further apart in time than max_time_difference seconds are
/// not compared. The relative errors are over one frame and over each of the lengths of deltas,
/// metres; the drift is over segments, metres, by default 1, 10, 100, … up to the length.
#[pyfunction]
#[pyo3(signature = (
    estimate, truth, *, align = "se3", max_time_difference = 0.01, deltas = vec![1.0], segments = vec![]
))]
pub fn evaluate(
    py: Python<'_>,
    estimate: TrajectoryArgument<'_>,
    truth: TrajectoryArgument<'_>,
    align: &str,
    max_time_difference: f64,
    deltas: Vec<f64>,
    segments: Vec<f64>,
) -> Result<PyEvaluation> {
    let alignment = match align {
        "none" => Alignment::None,
        "origin" => Alignment::Origin,
        "se2" => Alignment::Se2,
        "se3" => Alignment::Se3,
        "sim3" => Alignment::Sim3,
        _ => {
            return Err(Failure::usage(format!(
                "there is no alignment {align:?}; there are \"none\", \"origin\", \"se2\", \"se3\" and \"sim3\""
            )));
        }
    };
    let (mut estimate, mut truth) = (estimate.read("estimate")?, truth.read("truth")?);
    let counts = [&estimate, &truth].map(|loaded| loaded.trajectory.poses.len());
    if !(estimate.timed && truth.timed) && counts[0] != counts[1] {
        return Err(Failure::usage(format!(
            "the estimate has {} poses and the truth {}; without times only trajectories of the same length can be \
             compared",
            counts[0], counts[1]
        )));
    }
    LoadedTrajectory::number_unless_timed(&mut estimate, &mut truth);
    let lengths = deltas.into_iter().map(Delta::Metres);
    let options = EvaluationOptions {
        max_time_difference_s: max_time_difference,
        alignment,
        deltas: std::iter::once(Delta::Frames(1)).chain(lengths).collect(),
        all_pairs: false,
        segment_lengths_m: segments,
    };
    Ok(PyEvaluation(py.detach(|| measure(&estimate.trajectory, &truth.trajectory, &options))?))
}

/// The error of a trajectory. Errors of position are metres, of rotation radians.
#[pyclass(name = "Evaluation", frozen, module = "odograph")]
pub struct PyEvaluation(Evaluation);

#[pymethods]
impl PyEvaluation {
    /// Absolute position error, metres: rmse, mean, median, std, min, max, sse and count.
    #[getter]
    fn translation<'py>(&self, py: Python<'py>) -> Result<Bound<'py, PyDict>> {
        figures(py, &self.0.absolute.translation)
    }

    /// Absolute rotation error, radians: rmse, mean, median, std, min, max, sse and count.
    #[getter]
    fn rotation<'py>(&self, py: Python<'py>) -> Result<Bound<'py, PyDict>> {
        figures(py, &self.0.absolute.rotation)
    }

    /// N×3: time of each compared pose, seconds, its position error, metres, and its rotation
    /// error, radians.
    #[getter]
    fn errors<'py>(&self, py: Python<'py>) -> Matrix<'py> {
        let (pairs, absolute) = (&self.0.pairs, &self.0.absolute);
        Array2::from_shape_fn((pairs.len(), 3), |(row, column)| match column {
            0 => pairs[row].time_s,
            1 => absolute.translation_m[row],
            _ => absolute.rotation_rad[row],
        })
        .into_pyarray(py)
    }

    /// Relative errors, one entry for each segment length that fits: delta ("1 frame", "1 m"),
    /// translation (metres) and rotation (radians), each as the absolute errors.
    #[getter]
    fn relative<'py>(&self, py: Python<'py>) -> Result<Vec<Bound<'py, PyDict>>> {
        let entry = |relative: &odograph_core::evaluation::RelativeErrors| {
            let entry = PyDict::new(py);
            entry.set_item("delta", relative.delta.to_string())?;
            entry.set_item("translation", figures(py, &relative.translation)?)?;
            entry.set_item("rotation", figures(py, &relative.rotation)?)?;
            Ok(entry)
        };
        self.0.relative.iter().map(entry).collect()
    }

    /// Drift, one entry for each segment length that fits: length_m, segments,
    /// translation_percent, rotation_deg_per_m, heading_deg_per_m, heading_bias_deg_per_m.
    #[getter]
    fn drift<'py>(&self, py: Python<'py>) -> Result<Vec<Bound<'py, PyDict>>> {
        let entry = |drift: &odograph_core::evaluation::SegmentDrift| {
            let entry = PyDict::new(py);
            entry.set_item("length_m", drift.length_m)?;
            entry.set_item("segments", drift.segments)?;
            entry.set_item("translation_percent", drift.translation_percent)?;
            entry.set_item("rotation_deg_per_m", drift.rotation_deg_per_m)?;
            entry.set_item("heading_deg_per_m", drift.heading_deg_per_m)?;
            entry.set_item("heading_bias_deg_per_m", drift.heading_bias_deg_per_m)?;
            Ok(entry)
        };
        self.0.drift.iter().map(entry).collect()
    }

    /// Number of compared poses.
    #[getter]
    fn compared(&self) -> usize {
        self.0.pairs.len()
    }

    /// Part of the truth's time that is compared, 0 to 1; None for a single pose.
    #[getter]
    fn time_covered(&self) -> Option<f64> {
        self.0.time_covered
    }

    /// Length of the estimate through the compared poses, metres, before it is scaled.
    #[getter]
    fn estimate_length(&self) -> f64 {
        self.0.estimate_length_m
    }

    /// Length of the truth through the compared poses, metres.
    #[getter]
    fn truth_length(&self) -> f64 {
        self.0.truth_length_m
    }

    /// Least-squares scale of the estimate's lengths, whatever the alignment; None if not
    /// determined.
    #[getter]
    fn scale(&self) -> Option<f64> {
        self.0.scale
    }

    /// Position error at the last pose with the first poses aligned, metres.
    #[getter]
    fn final_position_error(&self) -> f64 {
        self.0.final_position_error_m
    }

    /// Heading error at the last pose with the first poses aligned, radians, counter-clockwise.
    #[getter]
    fn final_heading_error(&self) -> f64 {
        self.0.final_heading_error_rad
    }

    /// The 4×4 transform that aligned the estimate, without the scale.
    #[getter]
    fn truth_from_estimate<'py>(&self, py: Python<'py>) -> Matrix<'py> {
        transform(py, &self.0.alignment.truth_from_estimate)
    }

    fn __repr__(&self) -> String {
        format!(
            "Evaluation({} poses, rmse = {:.5} m over {:.2} m)",
            self.0.pairs.len(),
            self.0.absolute.translation.rmse,
            self.0.truth_length_m
        )
    }
}

fn figures<'py>(py: Python<'py>, of: &Statistics) -> Result<Bound<'py, PyDict>> {
    let figures = PyDict::new(py);
    figures.set_item("rmse", of.rmse)?;
    figures.set_item("mean", of.mean)?;
    figures.set_item("median", of.median)?;
    figures.set_item("std", of.std)?;
    figures.set_item("min", of.min)?;
    figures.set_item("max", of.max)?;
    figures.set_item("sse", of.sse)?;
    figures.set_item("count", of.count)?;
    Ok(figures)
}
