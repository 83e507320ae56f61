//! The pictures and the page of a run.

use super::RunPlan;
use super::folder::OutputFolder;
use super::pipeline::Tracked;
use crate::files;
use crate::report::{self, ReportInput, ReportMosaic, ReportReference};
use odograph::error::Result;
use odograph::filter::fusion::SensorReport;
use odograph::mapping::{Backdrop, MapDrawing, Mosaic, MosaicPicture, Placement};
use std::panic::resume_unwind;
use std::thread;

/// What is drawn.
pub struct Shown<'a> {
    /// What the recording is, in words.
    pub description: &'a str,
    pub tracked: &'a Tracked,
    pub mosaic: &'a Mosaic,
    pub sensors: &'a [SensorReport],
    /// A path from elsewhere, to be set beside.
    pub reference: Option<&'a ReportReference>,
}

/// Writes mosaic, map and report: the mosaic beside the others where there are `threads` for both.
pub fn write(plan: &RunPlan, shown: &Shown<'_>, folder: &mut OutputFolder, threads: usize) -> Result<()> {
    let mosaic = shown.mosaic;
    let bands = mosaic.bands(usize::MAX);
    let placement = bands.as_ref().map(|bands| bands.placement);
    let encode = || bands.map(|bands| files::png_from_rgba_bands(bands.width, bands.height, bands));
    let draw = |folder: &mut OutputFolder| {
        // The page tells of the picture in the folder, though it shows a smaller one.
        let small = mosaic.picture_within(LONGEST_SIDE_PX).zip(placement);
        draw(plan, shown, small, folder)
    };
    let png = if threads > 1 {
        thread::scope(|scope| {
            let encoded = scope.spawn(encode);
            draw(folder)?;
            encoded.join().unwrap_or_else(|panic| resume_unwind(panic)).transpose()
        })?
    } else {
        draw(folder)?;
        encode().transpose()?
    };
    if let Some((png, placement)) = png.zip(placement) {
        folder.write("mosaic.png", &png)?;
        folder.write("mosaic.pgw", placement.world_file().as_bytes())
    } else {
        // One of an earlier drive would show other ground.
        folder.remove("mosaic.png")?;
        folder.remove("mosaic.pgw")
    }
}

/// Writes map and report, with a small picture of the mosaic that lies at this placement.
fn draw(
    plan: &RunPlan,
    shown: &Shown<'_>,
    small: Option<(MosaicPicture, Placement)>,
    folder: &mut OutputFolder,
) -> Result<()> {
    let &Shown { description, tracked, sensors, reference, .. } = shown;
    let name = plan.source.path.trim_end_matches(['/', '\\']);
    let title = name.rsplit(['/', '\\']).next().unwrap_or(name);
    let small_png =
        small.as_ref().map(|(m, _)| files::png_from_rgba(m.width, m.height, &m.rgba)).transpose()?;
    let small = small.as_ref().zip(small_png.as_deref());
    let backdrop = small.map(|((mosaic, _), png)| Backdrop {
        png,
        width_px: mosaic.width,
        height_px: mosaic.height,
        placement: mosaic.placement,
        opacity: BACKDROP_OPACITY,
    });
    let loops = tracked.mapping.loops();
    let drawing = MapDrawing { title, loops: &loops, ..Default::default() };
    let svg = MapDrawing { backdrop, ..drawing }.svg(&tracked.frames);
    folder.write("map.svg", svg.as_bytes())?;
    folder.write("map.png", &report::drawing_png(&svg, report::MAP_WIDTH_PX)?)?;
    // The page shows the path on plain paper: the mosaic has its own place on it.
    let page = report::html(&ReportInput {
        title,
        source: description,
        frames: &tracked.frames,
        camera: &plan.camera,
        rig: &plan.rig,
        map_svg: &drawing.svg(&tracked.frames),
        mosaic: small.map(|((mosaic, placement), png)| ReportMosaic {
            png,
            width_px: mosaic.width,
            height_px: mosaic.height,
            placement: *placement,
            file_name: "mosaic.png",
        }),
        run_toml: &plan.text()?,
        warnings: &tracked.warnings,
        sensors,
        reference,
    });
    folder.write("report.html", page.as_bytes())
}

/// The mosaic in the map and on the page: sharp on any screen, a few megabytes at most.
const LONGEST_SIDE_PX: usize = 1600;

/// The path must stay the strongest thing on the map.
const BACKDROP_OPACITY: f64 = 0.55;
