//! Maps, and places in them.

use crate::camera::{PyCamera, PyRig};
use crate::error::{Failure, Result};
use crate::pixels::Pixels;
use crate::run::followed;
use numpy::ndarray::Array3;
use numpy::{IntoPyArray, PyArray3};
use odograph_core::Error;
use odograph_map::MapFile;
use odograph_session::{AlikePlace, PoseInMap, ResemblanceVerdict, RunBuilder, SourcePlan, files};
use pyo3::prelude::*;
use std::path::{Path, PathBuf};

/// A map file, opened for reading only.
#[pyclass(name = "Map", frozen, module = "odograph")]
pub struct PyMap {
    path: PathBuf,
    camera: PyCamera,
    rig: PyRig,
    sessions: Vec<String>,
}

/// A picture, or the path of a picture or recording.
#[derive(FromPyObject)]
pub enum SourceArgument<'py> {
    Path(PathBuf),
    Image(Bound<'py, PyAny>),
}

/// What the sentences call an image that has no name.
const NAMELESS: &str = "the image";

/// GDAL's geotransform: x of the outer left border, width of a pixel, 0, y of the outer upper
/// border, 0, minus the height of a pixel; metres.
type Geotransform = (f64, f64, f64, f64, f64, f64);

#[pymethods]
impl PyMap {
    #[new]
    fn new(path: PathBuf) -> Result<Self> {
        let file = MapFile::open_read_only(&path)?;
        let sessions = file.sessions()?.into_iter().map(|session| session.source).collect();
        Ok(Self { camera: PyCamera(file.camera().clone()), rig: PyRig(*file.rig()), sessions, path })
    }

    /// Where a picture was taken in the map: a uint8 array H×W or H×W×3, or the path of a picture,
    /// a video or a folder (then its last known place). It must be of the map's camera, which may
    /// look anywhere over the mapped ground. motion is as of Odometry.
    #[pyo3(signature = (image, *, motion = "auto"))]
    fn localize(&self, py: Python<'_>, image: SourceArgument<'_>, motion: &str) -> Result<PyPlace> {
        let motion = crate::odometry::motion(motion)?;
        let image = match image {
            SourceArgument::Path(path) => {
                let name = path.display().to_string();
                return self.place(py, &name, &name, motion);
            }
            SourceArgument::Image(image) => Pixels::read(&image)?,
        };
        let folder = tempfile::tempdir()
            .map_err(|error| Error::output(format!("there is no folder for temporary files: {error}")))?;
        let picture = folder.path().join("image.png");
        py.detach(|| files::write(&picture, &image.png()?))?;
        let source = picture.display().to_string();
        self.place(py, &source, NAMELESS, motion).map_err(|failure| match failure {
            Failure::Library(error) => {
                Error::new(error.kind(), error.to_string().replace(&source, NAMELESS)).into()
            }
            other => other,
        })
    }

    /// The picture of the ground, world x to the right and y up: an H×W×4 uint8 array (RGBA; white
    /// with opacity 0 where no ground was seen) and GDAL's geotransform, metres. It is as fine as
    /// the map has it with at most max_pixels pixels.
    #[pyo3(signature = (max_pixels = 100_000_000))]
    fn mosaic<'py>(
        &self,
        py: Python<'py>,
        max_pixels: usize,
    ) -> Result<(Bound<'py, PyArray3<u8>>, Geotransform)> {
        let picture = py.detach(|| MapFile::open_read_only(&self.path)?.mosaic_picture(max_pixels))?;
        let none = || {
            let path = self.path.display();
            Error::input(format!("{path} has no mosaic yet; odograph map mosaic {path} renders it"))
        };
        let picture = picture.ok_or_else(none)?;
        let side_m = picture.placement.metres_per_pixel;
        let (left_m, top_m) = (picture.placement.x_m - 0.5 * side_m, picture.placement.y_m + 0.5 * side_m);
        let array =
            Array3::from_shape_vec((picture.height, picture.width, 4), picture.rgba).map_err(|error| {
                Error::input(format!("{}: the mosaic is incomplete: {error}", self.path.display()))
            })?;
        Ok((array.into_pyarray(py), (left_m, side_m, 0.0, top_m, 0.0, -side_m)))
    }

    /// The camera of the map.
    #[getter]
    fn camera(&self) -> PyCamera {
        self.camera.clone()
    }

    /// How it was mounted at the start of the first session.
    #[getter]
    fn rig(&self) -> PyRig {
        self.rig.clone()
    }

    /// The recordings that made the map, in order.
    #[getter]
    fn sessions(&self) -> Vec<String> {
        self.sessions.clone()
    }

    /// The file.
    #[getter]
    fn path(&self) -> PathBuf {
        self.path.clone()
    }

    fn __repr__(&self) -> String {
        format!("Map({:?}, {} sessions)", self.path.display().to_string(), self.sessions.len())
    }
}

impl PyMap {
    /// Where a source was taken; `name` is what the sentences call it.
    fn place(
        &self,
        py: Python<'_>,
        source: &str,
        name: &str,
        motion: odograph_core::MotionModel,
    ) -> Result<PyPlace> {
        let run = RunBuilder::localizing(SourcePlan::new(source), &self.path).motion(motion);
        let (outcome, _) = followed(py, &run)?;
        let candidates = outcome.resemblance.as_ref().map_or(Vec::new(), |alike| alike.places.clone());
        let verdict =
            outcome.resemblance.as_ref().map_or(ResemblanceVerdict::TooFewFeatures, |alike| alike.verdict);
        Ok(PyPlace {
            message: outcome
                .place
                .is_none()
                .then(|| verdict.sentence(name, Path::new(&self.path), candidates.len())),
            verdict: outcome.place.map_or(verdict.name(), |_| "found"),
            place: outcome.place,
            candidates,
        })
    }
}

/// Where a camera is in a map, or why that is not known.
#[pyclass(name = "Place", frozen, module = "odograph")]
pub struct PyPlace {
    place: Option<PoseInMap>,
    verdict: &'static str,
    message: Option<String>,
    candidates: Vec<AlikePlace>,
}

#[pymethods]
impl PyPlace {
    /// Whether the place is known.
    #[getter]
    fn found(&self) -> bool {
        self.place.is_some()
    }

    /// "found", or why not: "never-seen", "too-few-features", "repeats" or "ambiguous".
    #[getter]
    fn verdict(&self) -> &'static str {
        self.verdict
    }

    /// Why nothing was found, in a sentence; None if it was.
    #[getter]
    fn message(&self) -> Option<String> {
        self.message.clone()
    }

    /// Position along x of the map, metres; None if not found.
    #[getter]
    fn x(&self) -> Option<f64> {
        self.place.map(|place| place.x_m)
    }

    /// Position along y of the map, metres; None if not found.
    #[getter]
    fn y(&self) -> Option<f64> {
        self.place.map(|place| place.y_m)
    }

    /// Heading from x of the map, radians in (-π, π], counter-clockwise; None if not found.
    #[getter]
    fn heading(&self) -> Option<f64> {
        self.place.map(|place| place.heading_deg.to_radians())
    }

    /// Standard deviations of x and y, metres, and of the heading, radians; None if not found.
    #[getter]
    fn sd(&self) -> Option<(f64, f64, f64)> {
        self.place.map(|place| (place.sd_x_m, place.sd_y_m, place.sd_heading_deg.to_radians()))
    }

    /// Number of the frame in its recording, 0 of a picture; None if not found.
    #[getter]
    fn frame(&self) -> Option<u64> {
        self.place.map(|place| place.frame)
    }

    /// The nearest keyframe of the map, how far it is in metres, and its session; None if not
    /// found.
    #[getter]
    fn nearest(&self) -> Option<(u64, f64, u32)> {
        self.place.map(|place| (place.keyframe, place.keyframe_distance_m, place.session))
    }

    /// The places that look alike if none is certain, the most probable first: probability, x and y
    /// (metres), heading (radians).
    #[getter]
    fn candidates(&self) -> Vec<(f64, f64, f64, f64)> {
        let numbers =
            |place: &AlikePlace| (place.probability, place.x_m, place.y_m, place.heading_deg.to_radians());
        self.candidates.iter().map(numbers).collect()
    }

    fn __repr__(&self) -> String {
        match &self.place {
            Some(place) => format!(
                "Place(x = {:.4} m, y = {:.4} m, heading = {:.4} rad)",
                place.x_m,
                place.y_m,
                place.heading_deg.to_radians()
            ),
            None => format!("Place({})", self.verdict),
        }
    }
}
