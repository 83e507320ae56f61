//! # odograph-report
//!
//! What a person looks at after a run or a calibration: self-contained HTML pages, plots as SVG,
//! and drawings as PNG with embedded fonts, so that they are the same on every machine.
//!
//! [`HtmlReporter`] gives a run of `odograph-session` its `report.html`, `map.png` and overlay
//! video:
//!
//! ```no_run
//! use odograph_session::RunBuilder;
//!
//! let run = RunBuilder::new("drive.mp4").camera_file("camera.yaml").height_m(1.20).folder("drive");
//! run.reporter(odograph_report::HtmlReporter).run(&())?;
//! # Ok::<(), odograph::error::Error>(())
//! ```
//!
//! It is a crate of its own because drawing text takes longer to build than all of odometry and
//! mapping: who only wants poses does without.

pub mod calibration;
mod charts;
pub mod evaluation_plot;
mod examination;
mod figures;
mod ground_view;
mod other_sensors;
mod overlay;
mod page;
mod parts;
mod photograph;
mod plot;
mod raster;
mod recordings;

pub use examination::examination_html;
pub use figures::{because, lost_stretches};
pub use page::html;
pub use raster::{MAP_WIDTH_PX, drawing_png, gray_picture};
pub use recordings::recordings_html;

use odograph::camera::Camera;
use odograph::error::Result;
use odograph_session::{FramePainter, ReportInput, RunReporter};

/// The report of a run as a page for the browser, and its overlay video.
#[derive(Debug, Clone, Copy, Default)]
pub struct HtmlReporter;

impl RunReporter for HtmlReporter {
    fn map_png(&self, svg: &str) -> Result<Vec<u8>> {
        drawing_png(svg, MAP_WIDTH_PX)
    }

    fn page(&self, contents: &ReportInput<'_>) -> String {
        html(contents)
    }

    fn frame_painter(&self, camera: &Camera) -> Option<Box<dyn FramePainter>> {
        let painter = overlay::OverlayPainter::new(camera).ok()?;
        Some(Box::new(painter))
    }
}

#[cfg(test)]
mod tests;
