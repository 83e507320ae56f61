//! Cameras and how they are mounted.

use crate::arrays::{Matrix, Vector, numbers, vector};
use crate::error::{Failure, Result};
use numpy::IntoPyArray;
use numpy::ndarray::Array2;
use odograph_core::camera::{Camera, Distortion, LeverArm, Rig};
use odograph_core::formats::{camera_file, rig_file};
use odograph_session::{Observer, RunBuilder, doubtful_unit, files, read_rig};
use pyo3::prelude::*;
use std::path::PathBuf;

/// A calibrated camera.
///
/// K is the 3×3 camera matrix in pixels (pixel centres at integers, no skew), dist the distortion
/// coefficients, size the image's (width, height). model says what dist is: "brown-conrady" has
/// OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]], or none; "kannala-brandt" OpenCV's fisheye k1 k2 k3 k4;
/// "double-sphere" xi alpha. readout is the rolling shutter's time from first to last row, seconds;
/// 0 is a global shutter, None lets it be learned.
#[pyclass(name = "Camera", frozen, eq, module = "odograph")]
#[derive(Debug, Clone, PartialEq)]
pub struct PyCamera(pub Camera);

#[pymethods]
#[allow(non_snake_case)] // K is what everybody calls it
impl PyCamera {
    #[new]
    #[pyo3(signature = (K, dist = None, *, size, model = "brown-conrady", readout = None))]
    fn new(
        K: &Bound<'_, PyAny>,
        dist: Option<&Bound<'_, PyAny>>,
        size: (usize, usize),
        model: &str,
        readout: Option<f64>,
    ) -> Result<Self> {
        let (shape, k) = numbers("K", K)?;
        let zeros = || [1, 3, 6, 7].iter().all(|&at| k[at] == 0.0) && k[8] == 1.0;
        if shape != [3, 3] || !zeros() {
            return Err(Failure::usage(
                "K is not a camera matrix; it is 3×3, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], in pixels",
            ));
        }
        let coefficients = dist.map_or(Ok(Vec::new()), |dist| numbers("dist", dist).map(|(_, c)| c))?;
        let distortion = distortion(model, &coefficients)?;
        let camera = Camera::new(size, (k[0], k[4]), (k[2], k[5]), distortion)?;
        Ok(Self(camera.with_readout_s(readout)?))
    }

    /// The camera of a file: OpenCV YAML, ROS camera_info, Kalibr, EuRoC or COLMAP. size, (width,
    /// height) in pixels, is needed only where the file has none.
    #[staticmethod]
    #[pyo3(signature = (path, size = None))]
    fn load(path: PathBuf, size: Option<(usize, usize)>) -> Result<Self> {
        let text = files::read_text(&path)?;
        Ok(Self(camera_file::parse(&text, size).map_err(|error| error.at(path.display()))?))
    }

    /// A camera without distortion whose image of size (width, height) pixels shows field_of_view,
    /// (width, height) metres, of level ground from height metres above it.
    #[staticmethod]
    fn from_field_of_view(size: (usize, usize), field_of_view: (f64, f64), height: f64) -> Result<Self> {
        Ok(Self(Camera::from_field_of_view(size, field_of_view, height)?))
    }

    /// Writes the camera as OpenCV YAML, which load reads to the bit.
    fn save(&self, path: PathBuf) -> Result<()> {
        Ok(files::write(&path, camera_file::write(&self.0).as_bytes())?)
    }

    /// The 3×3 camera matrix, pixels.
    #[getter]
    fn K<'py>(&self, py: Python<'py>) -> Matrix<'py> {
        let ((fx, fy), (cx, cy)) = (self.0.focal_px(), self.0.principal_px());
        let rows = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0];
        Array2::from_shape_fn((3, 3), |(row, column)| rows[3 * row + column]).into_pyarray(py)
    }

    /// The distortion coefficients in the order of the model.
    #[getter]
    fn dist<'py>(&self, py: Python<'py>) -> Vector<'py> {
        vector(py, self.0.distortion().coefficients())
    }

    /// The lens model of dist.
    #[getter]
    fn model(&self) -> &'static str {
        match self.0.distortion() {
            Distortion::None | Distortion::BrownConrady { .. } => "brown-conrady",
            Distortion::KannalaBrandt { .. } => "kannala-brandt",
            Distortion::DoubleSphere { .. } => "double-sphere",
        }
    }

    /// Width and height of the image, pixels.
    #[getter]
    fn size(&self) -> (usize, usize) {
        (self.0.width(), self.0.height())
    }

    /// Readout time of the shutter, seconds; None if unknown.
    #[getter]
    fn readout(&self) -> Option<f64> {
        self.0.readout_s()
    }

    fn __repr__(&self) -> String {
        let ((fx, fy), (width, height)) = (self.0.focal_px(), self.size());
        format!("Camera({width}x{height}, f = {fx:.1}, {fy:.1} px, {})", self.model())
    }
}

/// The lens of a model by its name.
fn distortion(model: &str, c: &[f64]) -> Result<Distortion> {
    let wrong = |needed: &str| {
        Failure::usage(format!("dist has {} coefficients; the lens model {model} has {needed}", c.len()))
    };
    match (model, c) {
        ("brown-conrady", _) => Distortion::from_opencv(c).ok_or_else(|| wrong("0, 4, 5 or 8")),
        ("kannala-brandt", &[k1, k2, k3, k4]) => Ok(Distortion::KannalaBrandt { k1, k2, k3, k4 }),
        ("kannala-brandt", _) => Err(wrong("4")),
        ("double-sphere", &[xi, alpha]) => Ok(Distortion::DoubleSphere { xi, alpha }),
        ("double-sphere", _) => Err(wrong("2")),
        _ => Err(Failure::usage(format!(
            "there is no lens model {model:?}; there are \"brown-conrady\", \"kannala-brandt\" and \"double-sphere\""
        ))),
    }
}

/// How a camera is mounted: height above the ground in metres; roll, pitch and yaw against straight
/// down with the top of the image forward, radians; where known, the camera's place in the robot's
/// frame (x forward, y left, z up), metres.
#[pyclass(name = "Rig", frozen, eq, module = "odograph")]
#[derive(Debug, Clone, PartialEq)]
pub struct PyRig(pub Rig);

#[pymethods]
impl PyRig {
    #[new]
    #[pyo3(signature = (height, *, roll = 0.0, pitch = 0.0, yaw = 0.0, lever_arm = None))]
    fn new(height: f64, roll: f64, pitch: f64, yaw: f64, lever_arm: Option<(f64, f64, f64)>) -> Result<Self> {
        let lever_arm = lever_arm.map(|(x_m, y_m, z_m)| LeverArm { x_m, y_m, z_m });
        let rig = Rig { height_m: height, roll_rad: roll, pitch_rad: pitch, yaw_rad: yaw, lever_arm };
        Ok(Self(rig.validated()?))
    }

    /// The rig of a file (TOML: height_m, roll_deg, pitch_deg, yaw_deg, and x_m, y_m, z_m).
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> Result<Self> {
        let doubts = Doubts::default();
        let rig = read_rig(&path, &doubts)?;
        doubts.0.into_inner().unwrap_or_default().iter().try_for_each(|doubt| warn(py, doubt))?;
        Ok(Self(rig))
    }

    /// Writes the rig as a rig file.
    fn save(&self, path: PathBuf) -> Result<()> {
        Ok(files::write(&path, rig_file::write(&self.0).as_bytes())?)
    }

    /// Metres above the ground.
    #[getter]
    fn height(&self) -> f64 {
        self.0.height_m
    }

    /// Radians.
    #[getter]
    fn roll(&self) -> f64 {
        self.0.roll_rad
    }

    /// Radians.
    #[getter]
    fn pitch(&self) -> f64 {
        self.0.pitch_rad
    }

    /// Radians, counter-clockwise.
    #[getter]
    fn yaw(&self) -> f64 {
        self.0.yaw_rad
    }

    /// Place of the camera in the robot's frame, metres; None where it is not known.
    #[getter]
    fn lever_arm(&self) -> Option<(f64, f64, f64)> {
        self.0.lever_arm.map(|LeverArm { x_m, y_m, z_m }| (x_m, y_m, z_m))
    }

    fn __repr__(&self) -> String {
        let Rig { height_m, roll_rad, pitch_rad, yaw_rad, lever_arm } = self.0;
        let arm = lever_arm
            .map_or_else(String::new, |arm| format!(", lever_arm=({}, {}, {})", arm.x_m, arm.y_m, arm.z_m));
        format!("Rig({height_m}, roll={roll_rad}, pitch={pitch_rad}, yaw={yaw_rad}{arm})")
    }
}

/// What a rig file leaves to be asked.
#[derive(Default)]
struct Doubts(std::sync::Mutex<Vec<String>>);

impl Observer for Doubts {
    fn warn(&self, sentence: &str) {
        if let Ok(mut doubts) = self.0.lock() {
            doubts.push(sentence.to_owned());
        }
    }
}

/// A camera, or the file of one.
#[derive(FromPyObject)]
pub enum CameraArgument<'py> {
    Camera(Bound<'py, PyCamera>),
    File(PathBuf),
}

impl CameraArgument<'_> {
    /// The camera.
    pub fn read(&self) -> Result<Camera> {
        match self {
            Self::Camera(camera) => Ok(camera.get().0.clone()),
            Self::File(path) => PyCamera::load(path.clone(), None).map(|camera| camera.0),
        }
    }

    /// Tells a run.
    pub fn of_run(&self, run: RunBuilder) -> RunBuilder {
        match self {
            Self::Camera(camera) => run.camera(camera.get().0.clone()),
            Self::File(path) => run.camera_file(path),
        }
    }
}

/// A rig, or the file of one.
#[derive(FromPyObject)]
pub enum RigArgument<'py> {
    Rig(Bound<'py, PyRig>),
    File(PathBuf),
}

/// The mount that `height` or `rig` give; `None` where neither is given.
pub fn mount(py: Python<'_>, height: Option<f64>, rig: Option<RigArgument<'_>>) -> Result<Option<Rig>> {
    match (height, rig) {
        (Some(_), Some(_)) => Err(Failure::usage("height and rig are both given; a rig has its height")),
        (None, None) => Ok(None),
        (Some(height_m), None) => {
            if let Some((_, name)) = doubtful_unit(height_m) {
                warn(py, &format!("height {height_m} is read as {height_m} metres; are {name} meant?"))?;
            }
            Ok(Some(Rig::level(height_m).validated()?))
        }
        (None, Some(RigArgument::Rig(rig))) => Ok(Some(rig.get().0)),
        (None, Some(RigArgument::File(path))) => Ok(Some(PyRig::load(py, path)?.0)),
    }
}

/// A Python warning.
pub fn warn(py: Python<'_>, sentence: &str) -> Result<()> {
    let category = py.get_type::<pyo3::exceptions::PyUserWarning>();
    let text = std::ffi::CString::new(sentence.replace('\0', " ")).unwrap_or_default();
    Ok(PyErr::warn(py, &category, &text, 1)?)
}
