//! Drawings and report of a run.

use crate::files;
use crate::folder::OutputFolder;
use crate::mapping::Mapping;
use crate::observer::Observer;
use crate::plan::RunPlan;
use crate::reference::ComparedReference;
use crate::report::{ReportInput, ReportLocalization, ReportMark, ReportMosaic, RunReporter};
use odograph::drawing::{Backdrop, DrawnLandmark, MapDrawing, ReckonedStretch};
use odograph::error::{Error, Result};
use odograph::filter::fusion::SensorReport;
use odograph::geometry::GroundPoint;
use odograph::geometry::Placement;
use odograph::mosaic::{Mosaic, MosaicPicture};
use odograph::trajectory::FrameSummary;
use std::panic::resume_unwind;
use std::thread;

/// Inputs of the drawings.
pub struct DrawingInputs<'a> {
    /// Description of the recording.
    pub description: &'a str,
    pub frames: &'a [FrameSummary],
    /// The path by other sensors where the camera was lost.
    pub reckoned: &'a [ReckonedStretch],
    /// Poses of the camera at recognised places, and the earlier poses.
    pub loops: &'a [[GroundPoint; 2]],
    /// Markers on the ground.
    pub landmarks: &'a [DrawnLandmark],
    /// Poses of the camera at the keyframes of the run.
    pub keyframes: &'a [GroundPoint],
    /// Marks set during a live run.
    pub marks: &'a [ReportMark],
    pub mosaic: &'a Mosaic,
    pub sensors: &'a [SensorReport],
    /// Reference trajectory for comparison.
    pub reference: Option<&'a ComparedReference>,
}

/// Drawings for the report.
#[derive(Default)]
pub struct ReportDrawing {
    /// Downscaled mosaic, and the georeference of the full one.
    small: Option<(MosaicPicture, Placement)>,
    /// The path without the mosaic, which the report shows separately.
    path_svg: String,
}

/// Outcome of writing the pictures.
pub struct Drawn {
    pub drawing: ReportDrawing,
    /// A warning where the map file lacks the mosaic of some ground.
    pub ground: Result<Option<String>>,
    /// What is missing, and why.
    pub failures: Vec<(&'static str, Error)>,
}

/// Writes mosaic and drawing, and the mosaic into the map file, concurrently where `threads` allow.
/// What cannot be written is missing, and keeps nothing else from being written.
pub fn write(
    plan: &RunPlan,
    shown: &DrawingInputs<'_>,
    mapping: &mut Mapping,
    folder: &mut OutputFolder,
    reporter: Option<&dyn RunReporter>,
    threads: usize,
    observer: &dyn Observer,
) -> Drawn {
    let mosaic = shown.mosaic;
    let bands = mosaic.bands(usize::MAX);
    let placement = bands.as_ref().map(|bands| bands.placement);
    let keep = || {
        let png = bands.map(|bands| files::png_from_rgba_bands(bands.width, bands.height, bands)).transpose();
        (png, mapping.render_ground(mosaic, observer))
    };
    let mut failures = Vec::new();
    let mut or_without =
        |what, written: Result<()>| failures.extend(written.err().map(|error| (what, error)));
    let mut drawing = ReportDrawing::default();
    let mut draw = || {
        let mut written = |written| or_without("there is no drawing of the path", written);
        drawing = draw(plan, shown, placement, folder, reporter, &mut written);
    };
    let (png, ground) = if threads > 1 {
        thread::scope(|scope| {
            let kept = scope.spawn(keep);
            draw();
            kept.join().unwrap_or_else(|panic| resume_unwind(panic))
        })
    } else {
        draw();
        keep()
    };
    let world_file = placement.map(|placement| Ok(placement.world_file().into_bytes()));
    for (name, bytes) in [("mosaic.png", png.transpose()), ("mosaic.pgw", world_file)] {
        or_without("there is no picture of the ground", folder.replace(name, bytes));
    }
    Drawn { drawing, ground, failures }
}

/// Writes the drawing with a downscaled mosaic of this georeference, and tells `written` of each
/// file. Returns both, and the drawing without the mosaic.
fn draw(
    plan: &RunPlan,
    shown: &DrawingInputs<'_>,
    placement: Option<Placement>,
    folder: &mut OutputFolder,
    reporter: Option<&dyn RunReporter>,
    written: &mut dyn FnMut(Result<()>),
) -> ReportDrawing {
    let small = shown.mosaic.picture_within(LONGEST_SIDE_PX).zip(placement);
    let png = small
        .as_ref()
        .map(|(mosaic, _)| files::png_from_rgba(mosaic.width, mosaic.height, &mosaic.rgba))
        .transpose()
        .unwrap_or_else(|error| {
            written(Err(error));
            None
        });
    let backdrop = small.as_ref().zip(png.as_ref()).map(|((mosaic, _), png)| Backdrop {
        png,
        width_px: mosaic.width,
        height_px: mosaic.height,
        placement: mosaic.placement,
        opacity: BACKDROP_OPACITY,
    });
    let (loops, landmarks, reckoned) = (shown.loops, shown.landmarks, shown.reckoned);
    let drawing = MapDrawing { title: title(plan), loops, landmarks, reckoned, ..Default::default() };
    let svg = MapDrawing { backdrop, ..drawing }.svg(shown.frames);
    written(folder.write("map.svg", svg.as_bytes()));
    written(folder.replace("map.png", reporter.map(|reporter| reporter.map_png(&svg))));
    ReportDrawing { small, path_svg: drawing.svg(shown.frames) }
}

/// What the report tells beside the drawings.
pub struct PageTexts<'a> {
    pub warnings: &'a [String],
    /// How far a run got that was ended early.
    pub interruption: Option<&'a str>,
    /// Names of the files in its folder.
    pub files: &'a [&'a str],
    pub localization: Option<ReportLocalization<'a>>,
}

/// Writes the report, if there is a reporter.
pub fn write_page(
    plan: &RunPlan,
    shown: &DrawingInputs<'_>,
    drawn: &ReportDrawing,
    told: &PageTexts<'_>,
    folder: &mut OutputFolder,
    reporter: Option<&dyn RunReporter>,
) -> Result<()> {
    let Some(reporter) = reporter else { return folder.remove("report.html") };
    let page = reporter.page(&ReportInput {
        title: title(plan),
        source: shown.description,
        frames: shown.frames,
        reckoned: shown.reckoned,
        interruption: told.interruption,
        camera: &plan.camera,
        rig: &plan.rig,
        map_svg: &drawn.path_svg,
        keyframes: shown.keyframes,
        loops: shown.loops,
        landmarks: shown.landmarks,
        marks: shown.marks,
        // The report names the full-size file, though it shows a smaller image.
        mosaic: drawn.small.as_ref().map(|(picture, placement)| ReportMosaic {
            picture,
            placement: *placement,
            file_name: "mosaic.png",
        }),
        run_toml: &plan.text()?,
        files: told.files,
        warnings: told.warnings,
        sensors: shown.sensors,
        reference: shown.reference,
        localization: told.localization,
    });
    folder.write("report.html", page.as_bytes())
}

/// File name of the recording without its folders.
fn title(plan: &RunPlan) -> &str {
    let name = plan.source.path.trim_end_matches(['/', '\\']);
    name.rsplit(['/', '\\']).next().unwrap_or(name)
}

/// Largest size of the mosaic in drawing and report: sharp on any screen, a few megabytes at most.
const LONGEST_SIDE_PX: usize = 1600;

/// Opacity of the mosaic, so that the path stays the most prominent element.
const BACKDROP_OPACITY: f64 = 0.55;
