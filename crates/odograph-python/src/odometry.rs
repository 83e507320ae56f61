//! Odometry frame by frame.

use crate::arrays::{Matrix, covariance, transform};
use crate::camera::{CameraArgument, RigArgument, mount};
use crate::error::{Failure, Result};
use crate::pixels::Pixels;
use numpy::ndarray::{Array1, Array2};
use numpy::{IntoPyArray, PyArray1};
use odograph_core::camera::Rig;
use odograph_core::mounting::OnlineCalibration;
use odograph_core::odometry::{Odometry, OdometryConfig, TrackView};
use odograph_core::pose_frame::{PoseFrame, PoseFrames};
use odograph_core::trajectory::{FrameEstimate, PoseEstimate};
use odograph_core::{GroundPose, MotionModel};
use pyo3::prelude::*;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// The motion model by its name.
pub fn motion(name: &str) -> Result<MotionModel> {
    Ok(match name {
        "auto" => MotionModel::Auto,
        "rigid" => MotionModel::Rigid,
        "similarity" => MotionModel::Similarity,
        "free" => MotionModel::Free,
        "mean" => MotionModel::Mean,
        _ => {
            return Err(Failure::usage(format!(
                "there is no motion model {name:?}; there are \"auto\", \"rigid\", \"similarity\", \"free\" and \
                 \"mean\""
            )));
        }
    })
}

/// Visual odometry, one image after the other.
///
/// camera is a Camera or the path of a camera file; its mount is height, metres above the ground
/// looking straight down, or rig, a Rig or the path of a rig file. motion is what may change
/// between frames: "auto", "rigid" (fixed height and tilt), "similarity" (the height changes),
/// "free" (height and tilt change) or "mean" (the mean vector, for comparison). mask is an image of
/// the camera's size, black where there is no ground.
///
/// Where the rig says where the camera is on the robot, what frames say is of the robot, as in a
/// run. Loops are not closed here: run does that. With "auto", the shutter's readout time, the tilt
/// and the lens are found on the way, as by a live run; the pose may change a little where the
/// readout time becomes known.
#[pyclass(name = "Odometry", frozen, module = "odograph")]
pub struct PyOdometry(Mutex<Tracker>);

/// An odometry and, where height and tilt are what the mount says, its calibration on the way.
struct Tracker {
    odometry: Odometry,
    /// As it was given.
    rig: Rig,
    calibration: Option<OnlineCalibration>,
}

impl PyOdometry {
    fn held(&self) -> MutexGuard<'_, Tracker> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[pymethods]
impl PyOdometry {
    #[new]
    #[pyo3(signature = (camera, height = None, *, rig = None, motion = "auto", mask = None))]
    fn new(
        py: Python<'_>,
        camera: CameraArgument<'_>,
        height: Option<f64>,
        rig: Option<RigArgument<'_>>,
        motion: &str,
        mask: Option<&Bound<'_, PyAny>>,
    ) -> Result<Self> {
        let rig = mount(py, height, rig)?.ok_or_else(|| {
            Failure::usage(
                "the height of the camera above the ground is missing; give height in metres, or rig",
            )
        })?;
        let mut config = OdometryConfig::default();
        config.motion.model = self::motion(motion)?;
        let camera = camera.read()?;
        let calibration =
            (config.motion.model == MotionModel::Auto).then(|| OnlineCalibration::new(&camera, &rig, false));
        let odometry = Odometry::new(camera, rig, config)?;
        let odometry = match mask {
            Some(picture) => odometry.with_mask(&Pixels::read(picture)?.gray()?)?,
            None => odometry,
        };
        Ok(Self(Mutex::new(Tracker { odometry, rig, calibration })))
    }

    /// The estimate of the next frame: an image of the camera's size, uint8, H×W (gray) or H×W×3
    /// (RGB), of any strides, and its time t in seconds, later than the last. Other Python threads
    /// run meanwhile. A frame that could not be measured is no error: its status says why.
    fn process(&self, py: Python<'_>, image: &Bound<'_, PyAny>, t: f64) -> Result<PyFrame> {
        let pixels = Pixels::read(image)?;
        Ok(py.detach(|| {
            let image = pixels.gray()?;
            let mut tracker = self.held();
            let Tracker { odometry, rig, calibration } = &mut *tracker;
            let rig = calibration.as_ref().map_or(*rig, OnlineCalibration::rig);
            let of = *PoseFrames::of_carrier(&rig).last();
            let estimate = odometry.process(image.clone(), t)?;
            let tracks = odometry.tracks().to_vec();
            if let Some(calibration) = calibration {
                calibration.watch(&image, &estimate, odometry)?;
            }
            odograph_core::Result::Ok(PyFrame { estimate: of.frame(&estimate).into_owned(), of, tracks })
        })?)
    }

    /// Number of keyframes so far.
    #[getter]
    fn keyframes(&self, py: Python<'_>) -> u64 {
        py.detach(|| self.held().odometry.keyframes())
    }

    fn __repr__(&self, py: Python<'_>) -> String {
        format!("Odometry({} keyframes)", self.keyframes(py))
    }
}

/// What odometry says of one frame. World x is forward at the start, y left, z up; the first frame
/// is the origin.
#[pyclass(name = "Frame", frozen, module = "odograph")]
pub struct PyFrame {
    estimate: FrameEstimate,
    /// Whose pose it has.
    of: PoseFrame,
    tracks: Vec<TrackView>,
}

impl PyFrame {
    fn known(&self) -> Option<&PoseEstimate> {
        self.estimate.estimate.as_ref()
    }

    fn ground(&self) -> Option<&GroundPose> {
        self.known().map(|known| &known.pose)
    }
}

#[pymethods]
impl PyFrame {
    /// Number of the frame, from 0.
    #[getter]
    fn frame(&self) -> u64 {
        self.estimate.frame
    }

    /// Its time, seconds.
    #[getter]
    fn time(&self) -> f64 {
        self.estimate.time_s
    }

    /// "tracked", or "lost:" and the reason: bare, dark, jump, blur, shadow, not-planar.
    #[getter]
    fn status(&self) -> String {
        self.estimate.status.to_string()
    }

    /// Whether there is a pose.
    #[getter]
    fn tracked(&self) -> bool {
        self.known().is_some()
    }

    /// The 4×4 transform from camera to world coordinates, metres; from those of the robot where
    /// the rig says where the camera is on it. None if lost.
    #[getter]
    fn pose<'py>(&self, py: Python<'py>) -> Option<Matrix<'py>> {
        self.ground().map(|pose| transform(py, &self.of.world_from_frame(pose)))
    }

    /// Position along world x, metres; None if lost.
    #[getter]
    fn x(&self) -> Option<f64> {
        self.ground().map(|pose| pose.x_m)
    }

    /// Position along world y, metres; None if lost.
    #[getter]
    fn y(&self) -> Option<f64> {
        self.ground().map(|pose| pose.y_m)
    }

    /// Heading, radians, counter-clockwise, not wrapped; None if lost.
    #[getter]
    fn heading(&self) -> Option<f64> {
        self.ground().map(|pose| pose.heading_rad)
    }

    /// Height above the ground, metres; None if lost.
    #[getter]
    fn height(&self) -> Option<f64> {
        self.ground().map(|pose| pose.height_m)
    }

    /// Roll, radians; None if lost.
    #[getter]
    fn roll(&self) -> Option<f64> {
        self.ground().map(|pose| pose.roll_rad)
    }

    /// Pitch, radians; None if lost.
    #[getter]
    fn pitch(&self) -> Option<f64> {
        self.ground().map(|pose| pose.pitch_rad)
    }

    /// Velocity along world x and y, metres per second, and of the heading, radians per second;
    /// None if lost.
    #[getter]
    fn velocity(&self) -> Option<(f64, f64, f64)> {
        self.known().map(|known| (known.velocity.x_m_s, known.velocity.y_m_s, known.velocity.heading_rad_s))
    }

    /// 6×6 covariance of (x, y, heading, height, roll, pitch) relative to the start, metres and
    /// radians; zero where the motion model holds a quantity fixed. None if lost.
    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> Option<Matrix<'py>> {
        self.known().map(|known| covariance(py, &known.covariance))
    }

    /// N×4: column and row of each track in this image, and of its corner in the keyframe, pixels.
    #[getter]
    fn tracks<'py>(&self, py: Python<'py>) -> Matrix<'py> {
        let numbers = |track: &TrackView| [track.pixel.x, track.pixel.y, track.corner.x, track.corner.y];
        let rows: Vec<[f64; 4]> = self.tracks.iter().map(numbers).collect();
        Array2::from_shape_fn((rows.len(), 4), |(row, column)| rows[row][column]).into_pyarray(py)
    }

    /// N booleans: whether each track agrees with the motion.
    #[getter]
    fn inliers<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<bool>> {
        self.tracks.iter().map(|track| track.inlier).collect::<Array1<bool>>().into_pyarray(py)
    }

    /// Root mean square reprojection error of the inliers, pixels; 0 without inliers.
    #[getter]
    fn residual(&self) -> f64 {
        self.estimate.residual_px
    }

    /// Whether the frame became a keyframe.
    #[getter]
    fn keyframe(&self) -> bool {
        self.estimate.keyframe
    }

    /// Number of tracking gaps before this frame; poses of one segment are connected.
    #[getter]
    fn segment(&self) -> usize {
        self.estimate.segment
    }

    fn __repr__(&self) -> String {
        let frame = self.estimate.frame;
        match self.ground() {
            Some(pose) => format!(
                "Frame({frame}, x = {:.4} m, y = {:.4} m, heading = {:.4} rad)",
                pose.x_m, pose.y_m, pose.heading_rad
            ),
            None => format!("Frame({frame}, {})", self.estimate.status),
        }
    }
}
