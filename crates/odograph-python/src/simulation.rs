//! Simulation drives with exact truth.

use crate::arrays::{Matrices, Vector, transforms, vector};
use crate::camera::{CameraArgument, PyCamera, PyRig, RigArgument, mount};
use crate::error::{Failure, Result};
use numpy::ndarray::{Array2, Array3};
use numpy::{IntoPyArray, PyArrayDyn};
use odograph_core::Error;
use odograph_core::formats::trajectory_file::write_tum;
use odograph_core::formats::{camera_file, rig_file};
use odograph_core::trajectory::{StampedPose, Trajectory};
use odograph_session::files;
use odograph_simulation::{
    Effects, Path, PathKind, RenderedFrame, Simulation, SimulationConfig, Texture, ordinary_camera,
};
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::{fs, thread};

/// A rendered drive: a sequence of images with exact truth. Frame i is rendered when it is asked
/// for, as a uint8 array, H×W or, in colour, H×W×3; the same drive always has the same bytes.
#[pyclass(name = "Simulation", frozen, sequence, module = "odograph")]
pub struct PySimulation(Simulation);

/// Renders a drive over flat ground.
///
/// path is the shape of the way: "straight", "square" (without turning), "square-turns", "eight",
/// "walk" (random) or "still". length is that of the path, of a side of a square, or of the eight
/// from tip to tip, metres; by default 5, 2, 2, 4 and 10. speed is in metres per second, turn_rate
/// in radians per second, duration in seconds (by default that of the path). texture is one of
/// "asphalt", "carpet", "tiles", "bricks", "grass", "concrete" and "bare".
///
/// camera is a Camera or the path of a camera file; by default one of 65° with mild barrel
/// distortion and images of size (width, height) pixels. Its mount is height, metres above the
/// ground, or rig. noise is that of the sensor, standard deviation in gray levels; blur the
/// exposure time and readout the rolling shutter's, seconds.
#[pyfunction]
#[pyo3(signature = (
    path = "square", *, length = None, speed = 0.5, turn_rate = std::f64::consts::FRAC_PI_6, duration = None,
    texture = "asphalt", camera = None, size = None, height = None, rig = None, fps = 30.0, noise = 2.0,
    blur = 0.0, readout = 0.0, color = false, seed = 1
))]
pub fn simulate(
    py: Python<'_>,
    path: &str,
    length: Option<f64>,
    speed: f64,
    turn_rate: f64,
    duration: Option<f64>,
    texture: &str,
    camera: Option<CameraArgument<'_>>,
    size: Option<(usize, usize)>,
    height: Option<f64>,
    rig: Option<RigArgument<'_>>,
    fps: f64,
    noise: f64,
    blur: f64,
    readout: f64,
    color: bool,
    seed: u64,
) -> Result<PySimulation> {
    let camera = match (camera, size) {
        (Some(_), Some(_)) => {
            return Err(Failure::usage("camera and size are both given; a camera has its image size"));
        }
        (Some(camera), None) => camera.read()?,
        (None, size) => ordinary_camera(size.unwrap_or((640, 480)))?,
    };
    let texture = Texture::named(texture).ok_or_else(|| {
        let names: Vec<_> = Texture::names().collect();
        Failure::usage(format!("there is no texture {texture:?}; there are {}", names.join(", ")))
    })?;
    let config = SimulationConfig {
        camera,
        rig: match mount(py, height, rig)? {
            Some(rig) => rig,
            None => odograph_core::Rig::level(0.9),
        },
        texture,
        path: Path::new(shape(path, length, duration, seed)?, speed, turn_rate, true)?,
        effects: Effects { exposure_s: blur, readout_s: readout, noise_gray: noise, ..Effects::default() },
        fps,
        duration_s: duration,
        colored: color,
        seed,
    };
    Ok(PySimulation(py.detach(|| Simulation::new(config))?))
}

/// The shape of a path by its name.
fn shape(name: &str, length: Option<f64>, duration: Option<f64>, seed: u64) -> Result<PathKind> {
    let length_m = |default_m: f64| length.unwrap_or(default_m);
    Ok(match name {
        "still" => PathKind::Still { duration_s: duration.unwrap_or(5.0) },
        "straight" => PathKind::Straight { length_m: length_m(5.0) },
        "square" => PathKind::SquareByTranslation { side_m: length_m(2.0) },
        "square-turns" => PathKind::SquareWithTurns { side_m: length_m(2.0) },
        "eight" => PathKind::FigureEight { length_m: length_m(4.0), laps: 1.0 },
        "walk" => PathKind::RandomWalk { length_m: length_m(10.0), seed },
        _ => {
            return Err(Failure::usage(format!(
                "there is no path {name:?}; there are \"straight\", \"square\", \"square-turns\", \"eight\", \
                 \"walk\" and \"still\""
            )));
        }
    })
}

impl PySimulation {
    /// The true poses.
    pub fn truth(&self) -> Trajectory {
        let stamped = |&time_s: &f64| StampedPose {
            time_s,
            world_from_camera: self.0.truth(time_s).world_from_camera(),
        };
        Trajectory { poses: self.0.times_s().iter().map(stamped).collect() }
    }

    /// Renders all frames into the folder, on as many threads as the machine has.
    fn write_frames(&self, folder: &std::path::Path) -> odograph_core::Result<()> {
        let next = AtomicUsize::new(0);
        let write = || {
            while let Some(frame) = self.0.frame(next.fetch_add(1, Ordering::Relaxed)) {
                let bytes = match &frame.color {
                    Some(color) => files::png_from_rgb(color)?,
                    None => files::png_from_gray(&frame.image)?,
                };
                let path = folder.join(picture_name(frame.number));
                fs::write(&path, bytes).map_err(|error| {
                    Error::output(format!("{} cannot be written: {error}", path.display())).caused_by(error)
                })?;
            }
            Ok(())
        };
        let threads = thread::available_parallelism().map_or(1, usize::from);
        thread::scope(|scope| {
            let writing: Vec<_> = (0..threads).map(|_| scope.spawn(write)).collect();
            writing
                .into_iter()
                .try_for_each(|thread| thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
        })
    }
}

fn picture_name(number: u64) -> String {
    format!("{number:06}.png")
}

#[pymethods]
impl PySimulation {
    fn __len__(&self) -> usize {
        self.0.len()
    }

    fn __getitem__<'py>(&self, py: Python<'py>, index: isize) -> Result<Bound<'py, PyArrayDyn<u8>>> {
        let at = if index < 0 { index + self.0.len() as isize } else { index };
        let frame = usize::try_from(at).ok().and_then(|at| py.detach(|| self.0.frame(at)));
        let RenderedFrame { image, color, .. } =
            frame.ok_or_else(|| PyIndexError::new_err(format!("there is no frame {index}")))?;
        let (width, height) = (image.width(), image.height());
        let array = match color {
            Some(color) => Array3::from_shape_vec((height, width, 3), color.samples().to_vec())
                .map(|array| array.into_dyn()),
            None => {
                Array2::from_shape_vec((height, width), image.into_samples()).map(|array| array.into_dyn())
            }
        };
        let array = array.map_err(|error| Error::input(format!("frame {index} is incomplete: {error}")))?;
        Ok(array.into_pyarray(py))
    }

    /// Writes the drive into a folder, as odograph simulate does: frames/ (PNG), frames.txt (their
    /// times), truth.tum, camera.yaml and rig.toml. Nothing that is there is overwritten.
    fn save(&self, py: Python<'_>, folder: PathBuf) -> Result<()> {
        for name in ["frames", "frames.txt", "truth.tum", "camera.yaml", "rig.toml"] {
            let there = folder.join(name);
            if there.exists() {
                return Err(Failure::usage(format!(
                    "{} exists already; choose another folder",
                    there.display()
                )));
            }
        }
        py.detach(|| {
            let frames = folder.join("frames");
            let part = files::beside(&frames);
            let failed = |error: std::io::Error| {
                Error::output(format!("{} cannot be written: {error}", frames.display())).caused_by(error)
            };
            fs::create_dir_all(&part).map_err(failed)?;
            // Frames come to their place last, so that a folder with frames is complete.
            let written = self.write_frames(&part).and_then(|()| {
                let mut times = String::from("# time_s name\n");
                for (number, time_s) in (0..).zip(self.0.times_s()) {
                    let _ = writeln!(times, "{time_s:.9} frames/{}", picture_name(number));
                }
                let config = self.0.config();
                for (name, text) in [
                    ("frames.txt", times),
                    ("truth.tum", write_tum(&self.truth())),
                    ("camera.yaml", camera_file::write(&config.camera)),
                    ("rig.toml", rig_file::write(&config.rig)),
                ] {
                    files::write(&folder.join(name), text.as_bytes())?;
                }
                fs::rename(&part, &frames).map_err(failed)
            });
            if written.is_err() {
                let _ = fs::remove_dir_all(&part);
            }
            Ok(written?)
        })
    }

    /// N times of the frames, seconds.
    #[getter]
    fn timestamps<'py>(&self, py: Python<'py>) -> Vector<'py> {
        vector(py, self.0.times_s().to_vec())
    }

    /// N×4×4 true transforms from camera to world coordinates, metres.
    #[getter]
    fn poses<'py>(&self, py: Python<'py>) -> Matrices<'py> {
        let poses: Vec<_> = self.truth().poses.iter().map(|pose| pose.world_from_camera).collect();
        transforms(py, &poses)
    }

    /// The camera.
    #[getter]
    fn camera(&self) -> PyCamera {
        PyCamera(self.0.config().camera.clone())
    }

    /// How it is mounted.
    #[getter]
    fn rig(&self) -> PyRig {
        PyRig(self.0.config().rig)
    }

    fn __repr__(&self) -> String {
        let config = self.0.config();
        format!("Simulation({} frames, {:.2} m)", self.0.len(), config.path.length_m())
    }
}
