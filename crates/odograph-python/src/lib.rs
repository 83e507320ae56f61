//! The Python module `odograph`: a thin layer over the libraries of this project. `odograph.pyi`
//! describes it for people and type checkers, `docs/python.md` shows it at work.
//!
//! Everything that takes long runs detached from the interpreter, so that other Python threads go
//! on. Lengths are metres, angles radians, times seconds, as in the libraries.

mod error;
mod arrays;
mod pixels;
mod camera;
mod odometry;
mod trajectory;
mod run;
mod map;
mod simulation;
mod evaluation;
mod calibration;

/// Trajectories and maps from one downward camera: metric poses with their covariance.
///
/// Lengths are metres, angles radians, times seconds; arrays are numpy's. Images are uint8, H×W
/// (gray) or H×W×3 (RGB). Whatever goes wrong raises odograph.Error with one sentence that says
/// what, where and why.
#[pyo3::pymodule(name = "odograph")]
mod module {
    #[pymodule_export]
    use crate::calibration::{PyCalibration, calibrate};
    #[pymodule_export]
    use crate::camera::{PyCamera, PyRig};
    #[pymodule_export]
    use crate::error::Error;
    #[pymodule_export]
    use crate::evaluation::{PyEvaluation, evaluate};
    #[pymodule_export]
    use crate::map::{PyMap, PyPlace};
    #[pymodule_export]
    use crate::odometry::{PyFrame, PyOdometry};
    #[pymodule_export]
    use crate::run::run;
    #[pymodule_export]
    use crate::simulation::{PySimulation, simulate};
    #[pymodule_export]
    use crate::trajectory::PyTrajectory;

    #[pymodule_export]
    #[allow(non_upper_case_globals)] // Python's name for it
    const __version__: &str = env!("CARGO_PKG_VERSION");
}
