//! What a run gives.

use crate::arrays::{Matrices, Vector, covariances, transforms, vector};
use crate::error::{Failure, Result};
use nalgebra::Isometry3;
use numpy::IntoPyArray;
use numpy::ndarray::Array1;
use odograph_core::pose_frame::PoseFrame;
use odograph_core::trajectory::{FrameEstimate, PoseEstimate, StampedPose, Trajectory};
use odograph_session::{RunEnd, RunOutcome};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;

/// The path that a run found: with loops closed and other sensors used, as trajectory.csv has it.
///
/// The arrays have a row for each frame with a pose; of frames at the same time the first counts.
/// World x is forward at the start, y left, z up.
#[pyclass(name = "Trajectory", frozen, module = "odograph")]
pub struct PyTrajectory {
    /// Every frame in order.
    frames: Vec<FrameEstimate>,
    /// Whose pose each of them has.
    of: Vec<PoseFrame>,
    /// Indices of those with a pose, in strictly increasing time.
    posed: Vec<usize>,
    end: RunEnd,
    statistics: String,
    warnings: Vec<String>,
    folder: Option<PathBuf>,
}

impl PyTrajectory {
    /// The frames and the outcome of a run; `kept` says whether its folder stays.
    pub fn new(frames: Vec<(FrameEstimate, PoseFrame)>, outcome: RunOutcome, kept: bool) -> Result<Self> {
        let (frames, of): (Vec<FrameEstimate>, _) = frames.into_iter().unzip();
        let mut last_s = f64::NEG_INFINITY;
        let mut later = |frame: &FrameEstimate| {
            let later = frame.estimate.is_some() && frame.time_s > last_s;
            last_s = if later { frame.time_s } else { last_s };
            later
        };
        Ok(Self {
            posed: (0..frames.len()).filter(|&at| later(&frames[at])).collect(),
            frames,
            of,
            end: outcome.end,
            statistics: outcome.statistics.json()?,
            warnings: outcome.warnings,
            folder: kept.then_some(outcome.folder),
        })
    }

    fn posed(&self) -> impl Iterator<Item = (&FrameEstimate, &PoseEstimate)> {
        self.posed.iter().filter_map(|&at| Some((&self.frames[at], self.frames[at].estimate.as_ref()?)))
    }

    /// The stamped poses.
    pub fn stamped(&self) -> Trajectory {
        let times = self.posed().map(|(frame, _)| frame.time_s);
        let stamped = |(time_s, world_from_camera)| StampedPose { time_s, world_from_camera };
        Trajectory { poses: times.zip(self.transforms()).map(stamped).collect() }
    }

    /// The poses as transforms from camera or robot to world coordinates.
    fn transforms(&self) -> Vec<Isometry3<f64>> {
        let posed = self.posed.iter().zip(self.posed());
        posed.map(|(&at, (_, known))| self.of[at].world_from_frame(&known.pose)).collect()
    }

    /// A number of every frame, NaN without a pose.
    fn column<'py>(&self, py: Python<'py>, of: impl Fn(&PoseEstimate) -> f64) -> Vector<'py> {
        let value = |frame: &FrameEstimate| frame.estimate.as_ref().map_or(f64::NAN, &of);
        vector(py, self.frames.iter().map(value).collect())
    }
}

#[pymethods]
impl PyTrajectory {
    /// N times, seconds, strictly increasing.
    #[getter]
    fn timestamps<'py>(&self, py: Python<'py>) -> Vector<'py> {
        vector(py, self.posed().map(|(frame, _)| frame.time_s).collect())
    }

    /// N×4×4 transforms from camera to world coordinates, metres; from those of the robot where the
    /// rig says where the camera is on it.
    #[getter]
    fn poses<'py>(&self, py: Python<'py>) -> Matrices<'py> {
        transforms(py, &self.transforms())
    }

    /// N×6×6 covariances of (x, y, heading, height, roll, pitch) relative to the start, metres and
    /// radians.
    #[getter]
    fn covariances<'py>(&self, py: Python<'py>) -> Matrices<'py> {
        let matrices: Vec<_> = self.posed().map(|(_, known)| known.covariance).collect();
        covariances(py, &matrices)
    }

    /// N positions along world x, metres.
    #[getter]
    fn x<'py>(&self, py: Python<'py>) -> Vector<'py> {
        vector(py, self.posed().map(|(_, known)| known.pose.x_m).collect())
    }

    /// N positions along world y, metres.
    #[getter]
    fn y<'py>(&self, py: Python<'py>) -> Vector<'py> {
        vector(py, self.posed().map(|(_, known)| known.pose.y_m).collect())
    }

    /// N headings, radians, counter-clockwise, not wrapped.
    #[getter]
    fn heading<'py>(&self, py: Python<'py>) -> Vector<'py> {
        vector(py, self.posed().map(|(_, known)| known.pose.heading_rad).collect())
    }

    /// "completed"; "tracking-failed" where less than half of the frames have a pose.
    #[getter]
    fn end(&self) -> &'static str {
        match self.end {
            RunEnd::Completed => "completed",
            RunEnd::Interrupted => "interrupted",
            RunEnd::TrackingFailed => "tracking-failed",
        }
    }

    /// The figures of stats.json.
    #[getter]
    fn statistics<'py>(&self, py: Python<'py>) -> Result<Bound<'py, PyAny>> {
        Ok(py.import("json")?.call_method1("loads", (&self.statistics,))?)
    }

    /// What may be wrong with the result, a sentence each.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.warnings.clone()
    }

    /// The folder with the results; None where none was asked for.
    #[getter]
    fn folder(&self) -> Option<PathBuf> {
        self.folder.clone()
    }

    /// A pandas.DataFrame with a row for every frame, those without a pose too, by time_s: frame,
    /// status, segment, x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad, speed_m_s, their
    /// standard deviations sd_x_m, sd_y_m, sd_heading_rad, and tracks, inliers, residual_px,
    /// keyframe.
    fn to_pandas<'py>(&self, py: Python<'py>) -> Result<Bound<'py, PyAny>> {
        let pandas = needed(py, "pandas", "to_pandas")?;
        let counts = |of: fn(&FrameEstimate) -> u64| {
            self.frames.iter().map(of).collect::<Array1<u64>>().into_pyarray(py)
        };
        let deviation = |at: usize| self.column(py, move |known| known.covariance[(at, at)].max(0.0).sqrt());
        let columns = PyDict::new(py);
        columns.set_item("time_s", vector(py, self.frames.iter().map(|frame| frame.time_s).collect()))?;
        columns.set_item("frame", counts(|frame| frame.frame))?;
        let status: Vec<String> = self.frames.iter().map(|frame| frame.status.to_string()).collect();
        columns.set_item("status", status)?;
        columns.set_item("segment", counts(|frame| frame.segment as u64))?;
        columns.set_item("x_m", self.column(py, |known| known.pose.x_m))?;
        columns.set_item("y_m", self.column(py, |known| known.pose.y_m))?;
        columns.set_item("heading_rad", self.column(py, |known| known.pose.heading_rad))?;
        columns.set_item("height_m", self.column(py, |known| known.pose.height_m))?;
        columns.set_item("roll_rad", self.column(py, |known| known.pose.roll_rad))?;
        columns.set_item("pitch_rad", self.column(py, |known| known.pose.pitch_rad))?;
        columns.set_item("speed_m_s", self.column(py, |known| known.velocity.speed_m_s()))?;
        columns.set_item("sd_x_m", deviation(0))?;
        columns.set_item("sd_y_m", deviation(1))?;
        columns.set_item("sd_heading_rad", deviation(2))?;
        columns.set_item("tracks", counts(|frame| frame.tracks as u64))?;
        columns.set_item("inliers", counts(|frame| frame.inliers as u64))?;
        columns.set_item(
            "residual_px",
            vector(py, self.frames.iter().map(|frame| frame.residual_px).collect()),
        )?;
        let keyframes: Array1<bool> = self.frames.iter().map(|frame| frame.keyframe).collect();
        columns.set_item("keyframe", keyframes.into_pyarray(py))?;
        let table = pandas.call_method1("DataFrame", (columns,))?;
        Ok(table.call_method1("set_index", ("time_s",))?)
    }

    /// An evo PoseTrajectory3D of the poses.
    fn to_evo<'py>(&self, py: Python<'py>) -> Result<Bound<'py, PyAny>> {
        let evo = needed(py, "evo.core.trajectory", "to_evo")?;
        let arguments = PyDict::new(py);
        let poses: Vec<Bound<'py, PyAny>> = self.poses(py).try_iter()?.collect::<PyResult<_>>()?;
        arguments.set_item("poses_se3", poses)?;
        arguments.set_item("timestamps", self.timestamps(py))?;
        Ok(evo.getattr("PoseTrajectory3D")?.call((), Some(&arguments))?)
    }

    fn __len__(&self) -> usize {
        self.posed.len()
    }

    fn __repr__(&self) -> String {
        format!("Trajectory({} of {} frames with a pose)", self.posed.len(), self.frames.len())
    }
}

/// A module of another package, which a method needs.
fn needed<'py>(py: Python<'py>, module: &str, method: &str) -> Result<Bound<'py, PyModule>> {
    py.import(module).map_err(|error| {
        let package = module.split('.').next().unwrap_or(module);
        if error.is_instance_of::<pyo3::exceptions::PyModuleNotFoundError>(py) {
            Failure::usage(format!(
                "{method} needs the package {package}; install it with: pip install {package}"
            ))
        } else {
            Failure::Python(error)
        }
    })
}
