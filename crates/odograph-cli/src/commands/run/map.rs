//! The pictures and the page of a run.

use super::RunPlan;
use super::folder::OutputFolder;
use super::pipeline::Tracked;
use crate::files;
use odograph::error::Result;
use odograph::mapping::{Backdrop, MapDrawing};

/// Writes mosaic, map and report.
pub fn write(plan: &RunPlan, description: &str, tracked: &Tracked, folder: &mut OutputFolder) -> Result<()> {
    let name = plan.source.path.trim_end_matches(['/', '\\']);
    let title = name.rsplit(['/', '\\']).next().unwrap_or(name);
    if let Some(mosaic) = tracked.mosaic.picture() {
        let png = files::png_from_rgba(mosaic.width, mosaic.height, &mosaic.rgba)?;
        folder.write("mosaic.png", &png)?;
        folder.write("mosaic.pgw", mosaic.placement.world_file().as_bytes())?;
    }
    let small = tracked.mosaic.picture_within(1600);
    let small_png = small.as_ref().map(|m| files::png_from_rgba(m.width, m.height, &m.rgba)).transpose()?;
    let backdrop = small.as_ref().zip(small_png.as_deref()).map(|(mosaic, png)| Backdrop {
        png,
        width_px: mosaic.width,
        height_px: mosaic.height,
        placement: mosaic.placement,
        opacity: 0.55,
    });
    let svg = MapDrawing { title, backdrop }.svg(&tracked.frames);
    folder.write("map.svg", svg.as_bytes())?;
    let _ = description;
    Ok(())
}
