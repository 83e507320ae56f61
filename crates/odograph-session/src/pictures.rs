//! The pictures and the page of a run.

use crate::files;
use crate::folder::OutputFolder;
use crate::mapping::Mapping;
use crate::observer::Observer;
use crate::plan::RunPlan;
use crate::reference::ComparedReference;
use crate::report::{ReportInput, ReportMosaic, RunReporter};
use odograph::drawing::{Backdrop, MapDrawing};
use odograph::error::Result;
use odograph::filter::fusion::SensorReport;
use odograph::geometry::GroundPoint;
use odograph::geometry::Placement;
use odograph::mosaic::{Mosaic, MosaicPicture};
use odograph::trajectory::FrameSummary;
use std::panic::resume_unwind;
use std::thread;

/// What is drawn.
pub struct Shown<'a> {
    /// What the recording is, in words.
    pub description: &'a str,
    pub frames: &'a [FrameSummary],
    /// Where the camera was when it recognised a place, and where it had been.
    pub loops: &'a [[GroundPoint; 2]],
    pub mosaic: &'a Mosaic,
    pub sensors: &'a [SensorReport],
    /// A path from elsewhere, to be set beside.
    pub reference: Option<&'a ComparedReference>,
}

/// What was drawn, as far as the page shows it.
pub struct Drawn {
    /// The mosaic made small, its PNG, and where the large one lies.
    small: Option<(MosaicPicture, Vec<u8>, Placement)>,
    /// The path on plain paper: the mosaic has its own place on the page.
    path_svg: String,
    /// What came of putting the ground into the map: a sentence where not all of it is there.
    pub ground: Result<Option<String>>,
}

/// Writes mosaic and map, and puts the ground into the map file: the ground beside the drawings
/// where there are `threads` for both.
pub fn write(
    plan: &RunPlan,
    shown: &Shown<'_>,
    mapping: &mut Mapping,
    folder: &mut OutputFolder,
    reporter: Option<&dyn RunReporter>,
    threads: usize,
    observer: &dyn Observer,
) -> Result<Drawn> {
    let mosaic = shown.mosaic;
    let bands = mosaic.bands(usize::MAX);
    let placement = bands.as_ref().map(|bands| bands.placement);
    let keep = || {
        let png = bands.map(|bands| files::png_from_rgba_bands(bands.width, bands.height, bands)).transpose();
        (png, mapping.lay_ground(mosaic, observer))
    };
    let (drawn, (png, ground)) = if threads > 1 {
        thread::scope(|scope| {
            let kept = scope.spawn(keep);
            let drawn = draw(plan, shown, placement, folder, reporter);
            (drawn, kept.join().unwrap_or_else(|panic| resume_unwind(panic)))
        })
    } else {
        (draw(plan, shown, placement, folder, reporter), keep())
    };
    let (small, path_svg) = drawn?;
    if let Some((png, placement)) = png?.zip(placement) {
        folder.write("mosaic.png", &png)?;
        folder.write("mosaic.pgw", placement.world_file().as_bytes())?;
    } else {
        // One of an earlier drive would show other ground.
        folder.remove("mosaic.png")?;
        folder.remove("mosaic.pgw")?;
    }
    Ok(Drawn { small, path_svg, ground })
}

/// Writes the map, with a small picture of the mosaic that lies at this placement. Gives that, and
/// the map without it.
#[expect(clippy::type_complexity, reason = "two parts of `Drawn`")]
fn draw(
    plan: &RunPlan,
    shown: &Shown<'_>,
    placement: Option<Placement>,
    folder: &mut OutputFolder,
    reporter: Option<&dyn RunReporter>,
) -> Result<(Option<(MosaicPicture, Vec<u8>, Placement)>, String)> {
    let small = shown.mosaic.picture_within(LONGEST_SIDE_PX).zip(placement);
    let encode = |(mosaic, placement): (MosaicPicture, Placement)| {
        let png = files::png_from_rgba(mosaic.width, mosaic.height, &mosaic.rgba)?;
        // The page tells of the picture in the folder, though it shows a smaller one.
        Ok((mosaic, png, placement))
    };
    let small = small.map(encode).transpose()?;
    let backdrop = small.as_ref().map(|(mosaic, png, _)| Backdrop {
        png,
        width_px: mosaic.width,
        height_px: mosaic.height,
        placement: mosaic.placement,
        opacity: BACKDROP_OPACITY,
    });
    let drawing = MapDrawing { title: title(plan), loops: shown.loops, ..Default::default() };
    let svg = MapDrawing { backdrop, ..drawing }.svg(shown.frames);
    folder.write("map.svg", svg.as_bytes())?;
    match reporter {
        Some(reporter) => folder.write("map.png", &reporter.map_png(&svg)?)?,
        None => folder.remove("map.png")?,
    }
    Ok((small, drawing.svg(shown.frames)))
}

/// Writes the page, where there is a reporter.
pub fn write_page(
    plan: &RunPlan,
    shown: &Shown<'_>,
    drawn: &Drawn,
    warnings: &[String],
    interruption: Option<&str>,
    folder: &mut OutputFolder,
    reporter: Option<&dyn RunReporter>,
) -> Result<()> {
    let Some(reporter) = reporter else { return folder.remove("report.html") };
    let page = reporter.page(&ReportInput {
        title: title(plan),
        source: shown.description,
        frames: shown.frames,
        interruption,
        camera: &plan.camera,
        rig: &plan.rig,
        map_svg: &drawn.path_svg,
        mosaic: drawn.small.as_ref().map(|(mosaic, png, placement)| ReportMosaic {
            png,
            width_px: mosaic.width,
            height_px: mosaic.height,
            png_placement: mosaic.placement,
            placement: *placement,
            file_name: "mosaic.png",
        }),
        run_toml: &plan.text()?,
        warnings,
        sensors: shown.sensors,
        reference: shown.reference,
    });
    folder.write("report.html", page.as_bytes())
}

/// The recording's name without its folders.
fn title(plan: &RunPlan) -> &str {
    let name = plan.source.path.trim_end_matches(['/', '\\']);
    name.rsplit(['/', '\\']).next().unwrap_or(name)
}

/// The mosaic in the map and on the page: sharp on any screen, a few megabytes at most.
const LONGEST_SIDE_PX: usize = 1600;

/// The path must stay the strongest thing on the map.
const BACKDROP_OPACITY: f64 = 0.55;
