//! The camera file and the folder of its report.

use super::CalibrationResult;
use super::focal_length::focal_px;
use crate::files::{self, MadeFolders};
use crate::report::calibration::{BentBoard, CalibrationReport, ExpectedError, ReprojectionError, ShownView};
use odograph::error::{Error, Result};
use odograph_calibration::calibration_file;
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

const PAGE: &str = "report.html";
/// The camera file with the bend of the board estimated, in the folder of the report.
const BENT_BOARD: &str = "bent-board.yaml";

/// Where the results go.
pub struct CalibrationOutput {
    camera_file: PathBuf,
    report: PathBuf,
    /// Folders that were made for it, the inner one first.
    _made: [MadeFolders; 2],
}

impl CalibrationOutput {
    /// Fails if results exist and `force` does not allow replacing them, or if they cannot be
    /// written.
    pub fn new(camera_file: &Path, report: Option<&Path>, force: bool) -> Result<Self> {
        let Some(stem) = camera_file.file_stem().filter(|_| !camera_file.is_dir()) else {
            return Err(Error::usage(format!(
                "{} is a folder; the result is a file such as {}",
                camera_file.display(),
                camera_file.join("camera.yaml").display()
            )));
        };
        let mut beside: OsString = stem.to_owned();
        beside.push("-report");
        let report = report.map_or_else(|| camera_file.with_file_name(beside), Path::to_owned);
        if report.exists() && !report.is_dir() {
            return Err(Error::usage(format!("{} is a file; the report needs a folder", report.display())));
        }
        files::check_output_file(camera_file, force)?;
        let page = report.join(PAGE);
        files::check_output_file(&page, force)?;
        let of_camera_file = MadeFolders::of_result(camera_file)?;
        let made = [MadeFolders::of_result(&page)?, of_camera_file];
        Ok(Self { camera_file: camera_file.to_owned(), report, _made: made })
    }

    pub fn camera_file(&self) -> &Path {
        &self.camera_file
    }

    pub fn report_page(&self) -> PathBuf {
        self.report.join(PAGE)
    }

    /// The camera file with the bend of the board estimated.
    pub fn bent_board_file(&self) -> PathBuf {
        self.report.join(BENT_BOARD)
    }

    /// Writes the report and then the camera file, so that a camera file implies a complete report.
    pub fn write(&self, calibrated: &CalibrationResult) -> Result<()> {
        let calibration = &calibrated.calibration;
        let views = shown_views(calibrated);
        let size = (calibration.camera.width(), calibration.camera.height());
        let expected_error = ExpectedError::new(size, |pixel| calibration.expected_error_px(pixel));
        let name = self.camera_file.file_name().unwrap_or_default().to_string_lossy();
        let title = Path::new(&calibrated.description)
            .file_name()
            .map_or_else(|| calibrated.description.clone(), |name| name.to_string_lossy().into_owned());
        let report = CalibrationReport {
            title: &format!("Calibration with {title}"),
            source: &calibrated.search.kind,
            board: calibrated.board.to_string(),
            pictures: !calibrated.search.pictures.is_empty(),
            found: &calibrated.search.found,
            camera: &calibration.camera,
            model: calibration.model,
            focal_px: focal_px(calibration),
            parameters: &calibration.parameters,
            rms_px: calibration.rms_px,
            hold_out_rms_px: calibration.hold_out_rms_px,
            candidates: &calibration.candidates,
            verdict: calibration.verdict,
            reasons: &calibration.reasons,
            views: &views,
            expected_error_px: calibration.expected_error_over_image_px(),
            expected_error: &expected_error,
            bent_board: calibrated.bent.as_ref().map(|bent| BentBoard {
                file: BENT_BOARD,
                rms_px: bent.rms_px,
                expected_error_px: bent.expected_error_over_image_px(),
            }),
            guidance: &calibrated.guidance,
            warnings: &calibrated.search.warnings,
            camera_file: &name,
        };
        let files = report.files()?;
        for (name, bytes) in &files {
            files::write(&self.report.join(name), bytes)?;
        }
        let bent_board = self.bent_board_file();
        match &calibrated.bent {
            Some(bent) => {
                files::write(&bent_board, calibration_file::write(bent, &calibrated.board).as_bytes())?;
            }
            // One of an earlier calibration would be taken for one of this.
            None => drop(fs::remove_file(&bent_board)),
        }
        let text = calibration_file::write(calibration, &calibrated.board);
        files::write(&self.camera_file, text.as_bytes())
    }
}

fn shown_views(calibrated: &CalibrationResult) -> Vec<ShownView<'_>> {
    let views = calibrated.calibration.views.iter().zip(&calibrated.views).zip(&calibrated.names);
    views
        .map(|((view, seen), (number, name))| ShownView {
            name: name.clone(),
            thumbnail: calibrated.search.thumbnails.get(number),
            residuals: view
                .residuals
                .iter()
                .filter_map(|&(index, dx_px, dy_px)| {
                    let at = seen.points.binary_search_by_key(&index, |point| point.index).ok()?;
                    Some(ReprojectionError { seen: seen.points[at].pixel, dx_px, dy_px })
                })
                .collect(),
            rms_px: view.rms_px,
            why_not: (!view.used).then(|| view.why_not.clone().unwrap_or_else(|| "not used".to_owned())),
        })
        .collect()
}
