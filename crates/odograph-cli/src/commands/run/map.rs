//! The pictures and the page of a run.

use super::RunPlan;
use super::folder::OutputFolder;
use super::pipeline::Tracked;
use crate::files;
use crate::report::{self, ReportInput, ReportMosaic, ReportReference};
use odograph::error::Result;
use odograph::filter::fusion::SensorReport;
use odograph::mapping::{Backdrop, MapDrawing};

/// Writes mosaic, map and report.
pub fn write(
    plan: &RunPlan,
    description: &str,
    tracked: &Tracked,
    sensors: &[SensorReport],
    reference: Option<&ReportReference>,
    folder: &mut OutputFolder,
) -> Result<()> {
    let name = plan.source.path.trim_end_matches(['/', '\\']);
    let title = name.rsplit(['/', '\\']).next().unwrap_or(name);
    let mosaic = tracked.mosaic.picture();
    // The page tells of the picture in the folder, though it shows a smaller one.
    let placement = mosaic.as_ref().map(|mosaic| mosaic.placement);
    if let Some(mosaic) = mosaic {
        let png = files::png_from_rgba(mosaic.width, mosaic.height, &mosaic.rgba)?;
        folder.write("mosaic.png", &png)?;
        folder.write("mosaic.pgw", mosaic.placement.world_file().as_bytes())?;
    } else {
        // One of an earlier drive would show other ground.
        folder.remove("mosaic.png")?;
        folder.remove("mosaic.pgw")?;
    }
    let small = tracked.mosaic.picture_within(LONGEST_SIDE_PX);
    let small_png = small.as_ref().map(|m| files::png_from_rgba(m.width, m.height, &m.rgba)).transpose()?;
    let small = small.as_ref().zip(small_png.as_deref());
    let backdrop = small.map(|(mosaic, png)| Backdrop {
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
        mosaic: small.map(|(mosaic, png)| ReportMosaic {
            png,
            width_px: mosaic.width,
            height_px: mosaic.height,
            placement: placement.unwrap_or(mosaic.placement),
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
