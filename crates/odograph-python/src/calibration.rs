//! Calibration with pictures of a board.

use crate::arrays::{Matrix, Vector, transform, vector};
use crate::camera::PyCamera;
use crate::error::{Failure, Result};
use crate::pixels::Pixels;
use numpy::IntoPyArray;
use numpy::ndarray::Array2;
use odograph_calibration::selection::{SelectionConfig, Sighting, ViewSelector, blur_px};
use odograph_calibration::{
    Board, BoardFinder, BoardView, Calibration, CalibrationConfig, LensModel, NotFound, Verdict,
    calibrate as solve, calibration_file, nothing_found,
};
use odograph_core::Error;
use odograph_core::image::GrayImage;
use odograph_session::files;
use odograph_video::{SourceOptions, open};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::thread;

/// A picture, or the path of a picture, a folder or a recording.
#[derive(FromPyObject)]
pub enum LookArgument<'py> {
    Path(PathBuf),
    Image(Bound<'py, PyAny>),
}

/// Calibrates a camera with images of a board.
///
/// images is the path of a video or a folder of pictures, or a list of paths and of uint8 arrays,
/// H×W or H×W×3. board is such as "chessboard:9x6:25mm" (inner corners, side of a square),
/// "charuco:8x11:20mm", "aprilgrid:6x6:88mm", "circles:7x5:20mm" or "asymmetric-circles:4x11:20mm".
/// model is "auto" (the one that predicts unseen views best), "pinhole", "brown-conrady4",
/// "brown-conrady5", "brown-conrady8", "kannala-brandt4" or "double-sphere". square_pixels is one
/// focal length for both directions, centred a principal point in the middle; with bent_board the
/// board's bend and stretch are estimated too. At most max_views views are used, the most
/// informative ones.
#[pyfunction]
#[pyo3(signature = (
    images, board, *, model = "auto", square_pixels = false, centred = false, bent_board = false, max_views = 60
))]
pub fn calibrate(
    py: Python<'_>,
    images: &Bound<'_, PyAny>,
    board: &str,
    model: &str,
    square_pixels: bool,
    centred: bool,
    bent_board: bool,
    max_views: usize,
) -> Result<PyCalibration> {
    let board: Board = board.parse()?;
    let model = if model == "auto" { None } else { Some(model.parse::<LensModel>()?) };
    let config = CalibrationConfig { model, square_pixels, centred, flat_board: !bent_board };
    if !(3..=500).contains(&max_views) {
        return Err(Failure::usage(format!("max_views is {max_views}; it lies between 3 and 500")));
    }
    let mut search = Search::new(&board, max_views);
    match images.extract::<PathBuf>() {
        Ok(path) => py.detach(|| search.look_into(&path.display().to_string()))?,
        Err(_) => {
            for (at, image) in images.try_iter()?.enumerate() {
                match image?.extract().map_err(PyErr::from)? {
                    LookArgument::Path(path) => {
                        py.detach(|| search.look_into(&path.display().to_string()))?
                    }
                    LookArgument::Image(image) => {
                        let pixels = Pixels::read(&image)?;
                        py.detach(|| search.take(format!("image {at}"), None, true, pixels.gray()?))?;
                    }
                }
                py.check_signals()?;
            }
        }
    }
    Ok(py.detach(|| {
        search.look();
        let (names, views) = search.chosen()?;
        let calibration = solve(&board, &views, &config)?;
        odograph_core::Result::Ok(PyCalibration { calibration, board, names })
    })?)
}

/// An image that is looked at.
struct Look {
    name: String,
    time_s: Option<f64>,
    picture: bool,
    image: GrayImage,
}

/// Looks for the board in one image after the other.
struct Search {
    finder: BoardFinder,
    selector: ViewSelector,
    most_views: usize,
    waiting: VecDeque<Look>,
    size: Option<(usize, usize)>,
    looked_at: u64,
    only_pictures: bool,
    /// The sightings in pictures, while all can be used.
    pictures: Vec<Sighting>,
    names: BTreeMap<u64, String>,
    reasons: BTreeMap<String, u64>,
}

/// Images that wait, so that all cores have one to look at.
const WAITING: usize = 32;

impl Search {
    fn new(board: &Board, most_views: usize) -> Self {
        let selection = SelectionConfig { most_views, ..SelectionConfig::default() };
        Self {
            finder: BoardFinder::new(board),
            selector: ViewSelector::new(board, selection),
            most_views,
            waiting: VecDeque::new(),
            size: None,
            looked_at: 0,
            only_pictures: true,
            pictures: Vec::new(),
            names: BTreeMap::new(),
            reasons: BTreeMap::new(),
        }
    }

    /// Takes all frames of a recording, a folder or a picture.
    fn look_into(&mut self, path: &str) -> odograph_core::Result<()> {
        let mut source = open(path, &SourceOptions::default())?;
        // The times of pictures that were taken one by one say nothing of how the board moved.
        let photographs = source.info().frame_count.is_some_and(|count| count <= self.most_views as u64);
        while let Some(frame) = source.next_frame()? {
            let picture = frame.name.is_some();
            let name = frame
                .name
                .unwrap_or_else(|| format!("{path}, frame {} ({:.2} s)", frame.number, frame.time_s));
            self.take(name, Some(frame.time_s).filter(|_| !(photographs && picture)), picture, frame.gray)?;
        }
        Ok(())
    }

    /// Takes an image.
    fn take(
        &mut self,
        name: String,
        time_s: Option<f64>,
        picture: bool,
        image: GrayImage,
    ) -> odograph_core::Result<()> {
        let size = (image.width(), image.height());
        let first = *self.size.get_or_insert(size);
        if first != size {
            return Err(Error::input(format!(
                "{name} has {}x{} pixels, the first image {}x{}; one camera at one resolution is calibrated at a time",
                size.0, size.1, first.0, first.1
            )));
        }
        self.waiting.push_back(Look { name, time_s, picture, image });
        if self.waiting.len() >= WAITING {
            self.look();
        }
        Ok(())
    }

    /// Looks at the images that wait, side by side, and takes what they show in their order.
    fn look(&mut self) {
        let looks: Vec<Look> = self.waiting.drain(..).collect();
        let threads = thread::available_parallelism().map_or(1, usize::from);
        let finder = &self.finder;
        let find = |look: &Look| {
            finder.find(&look.image).map(|view| {
                let blur = blur_px(&look.image, &view);
                (view, blur)
            })
        };
        let found: Vec<std::result::Result<(BoardView, Option<f64>), NotFound>> = thread::scope(|scope| {
            let parts = looks.chunks(looks.len().div_ceil(threads).max(1));
            let finding: Vec<_> =
                parts.map(|part| scope.spawn(move || part.iter().map(find).collect::<Vec<_>>())).collect();
            finding
                .into_iter()
                .flat_map(|part| part.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
                .collect()
        });
        for (look, found) in looks.into_iter().zip(found) {
            self.add(look, found);
        }
    }

    fn add(&mut self, look: Look, found: std::result::Result<(BoardView, Option<f64>), NotFound>) {
        let number = self.looked_at;
        self.looked_at += 1;
        self.only_pictures &= look.picture;
        match found {
            Ok((view, blur_px)) => {
                let sighting = Sighting { number, time_s: look.time_s, view, blur_px };
                self.names.insert(number, look.name);
                if self.pictures.len() <= self.most_views {
                    self.pictures.push(sighting.clone());
                }
                self.selector.add(sighting);
            }
            Err(why) => *self.reasons.entry(why.to_string()).or_default() += 1,
        }
    }

    /// The views to calibrate with, and their names: all pictures if there are not too many,
    /// otherwise the most informative views.
    fn chosen(&self) -> odograph_core::Result<(Vec<String>, Vec<BoardView>)> {
        if self.selector.sightings() == 0 {
            let mostly = self.reasons.iter().max_by_key(|(_, count)| **count);
            let mostly = mostly.map(|(reason, count)| (reason as &dyn std::fmt::Display, *count));
            return Err(nothing_found(
                self.selector_board(),
                self.looked_at,
                self.only_pictures,
                mostly,
                None,
            ));
        }
        self.selector.enough()?;
        let all = self.only_pictures && self.pictures.len() <= self.most_views;
        let chosen: Vec<&Sighting> =
            if all { self.pictures.iter().collect() } else { self.selector.chosen() };
        Ok(chosen.into_iter().map(|one| (self.names[&one.number].clone(), one.view.clone())).unzip())
    }

    fn selector_board(&self) -> &Board {
        self.finder.board()
    }
}

/// A calibrated camera with its uncertainty and quality figures.
#[pyclass(name = "Calibration", frozen, module = "odograph")]
pub struct PyCalibration {
    calibration: Calibration,
    board: Board,
    /// Names of the views.
    names: Vec<String>,
}

#[pymethods]
impl PyCalibration {
    /// The camera.
    #[getter]
    fn camera(&self) -> PyCamera {
        PyCamera(self.calibration.camera.clone())
    }

    /// Name of the lens model.
    #[getter]
    fn model(&self) -> &'static str {
        self.calibration.model.name()
    }

    /// "good", "usable" or "do it again".
    #[getter]
    fn verdict(&self) -> String {
        self.calibration.verdict.to_string()
    }

    /// Whether the verdict is not "do it again".
    #[getter]
    fn usable(&self) -> bool {
        self.calibration.verdict != Verdict::DoItAgain
    }

    /// Reasons for the verdict, with advice, a sentence each.
    #[getter]
    fn reasons(&self) -> Vec<String> {
        self.calibration.reasons.clone()
    }

    /// Root mean square reprojection error of the views used, pixels.
    #[getter]
    fn rms(&self) -> f64 {
        self.calibration.rms_px
    }

    /// The same over views held out of the fit, pixels.
    #[getter]
    fn hold_out_rms(&self) -> f64 {
        self.calibration.hold_out_rms_px
    }

    /// Expected error of a ray by the uncertainty of the camera, over the image, pixels.
    #[getter]
    fn expected_error(&self) -> f64 {
        self.calibration.expected_error_over_image_px()
    }

    /// Names of the parameters in the order of values and covariance: fx, fy or f, cx, cy,
    /// distortion coefficients, and those of a bent board.
    #[getter]
    fn parameters(&self) -> Vec<&'static str> {
        self.calibration.parameters.iter().map(|parameter| parameter.name).collect()
    }

    /// N values of the parameters; pixels, metres, radians or without unit.
    #[getter]
    fn values<'py>(&self, py: Python<'py>) -> Vector<'py> {
        vector(py, self.calibration.parameters.iter().map(|parameter| parameter.value).collect())
    }

    /// N×N covariance of the parameters.
    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> Matrix<'py> {
        let matrix = &self.calibration.covariance;
        Array2::from_shape_fn(matrix.shape(), |(row, column)| matrix[(row, column)]).into_pyarray(py)
    }

    /// The views, a dict each: name, used, rms (pixels, NaN without a pose), camera_from_board
    /// (4×4, metres) and why_not, a remark or None.
    #[getter]
    fn views<'py>(&self, py: Python<'py>) -> Result<Bound<'py, PyList>> {
        let entry = |(view, name): (&odograph_calibration::CalibratedView, &String)| -> PyResult<_> {
            let entry = PyDict::new(py);
            entry.set_item("name", name)?;
            entry.set_item("used", view.used)?;
            entry.set_item("rms", view.rms_px)?;
            entry.set_item("camera_from_board", transform(py, &view.camera_from_board))?;
            entry.set_item("why_not", view.why_not.as_deref())?;
            Ok(entry)
        };
        let views: Vec<_> =
            self.calibration.views.iter().zip(&self.names).map(entry).collect::<PyResult<_>>()?;
        Ok(PyList::new(py, views)?)
    }

    /// Writes the camera file (OpenCV YAML) with the figures of the calibration.
    fn save(&self, path: PathBuf) -> Result<()> {
        Ok(files::write(&path, calibration_file::write(&self.calibration, &self.board).as_bytes())?)
    }

    fn __repr__(&self) -> String {
        let calibration = &self.calibration;
        format!(
            "Calibration({}, {}, rms = {:.3} px from {} views)",
            calibration.verdict,
            calibration.model,
            calibration.rms_px,
            calibration.views_used()
        )
    }
}
