//! `odograph map mosaic`: renders the mosaic of a map again.

use super::export;
use crate::{Outcome, console, files, interrupt, lengths};
use odograph::error::{Error, Result};
use odograph_map::{MapFile, MosaicLayer};
use std::path::PathBuf;

/// Render the mosaic of a map again, at a chosen resolution.
///
/// It is stored in the map.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct MosaicArguments {
    /// The map.
    #[arg(value_name = "MAP")]
    map: PathBuf,
    /// Write the picture too: .tif (GeoTIFF) or .png (with a world file).
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Side of a ground pixel, as 0.002 (metres) or 2mm.
    ///
    /// [default: that of a pixel in the middle of an image]
    #[arg(long, value_name = "LENGTH", value_parser = lengths::metres, allow_negative_numbers = true)]
    resolution: Option<f64>,
    /// Overwrite the picture if it exists.
    #[arg(long)]
    force: bool,
    /// Say nothing but errors.
    #[arg(short, long)]
    quiet: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph map mosaic drive/map.gpkg -o floor.tif
  odograph map mosaic drive/map.gpkg --resolution 0.005 -o floor.png";

/// Runs the command.
pub fn mosaic(arguments: &MosaicArguments) -> Result<Outcome> {
    if let Some(resolution) = arguments.resolution.filter(|r| !(FINEST_M..=COARSEST_M).contains(r)) {
        return Err(Error::usage(format!(
            "--resolution is {resolution:?} m; a pixel of a mosaic is between 1 nm and {COARSEST_M} m wide"
        )));
    }
    let form = arguments.output.as_deref().map(export::PictureForm::of).transpose()?;
    if let Some(path) = &arguments.output {
        files::check_output_file(path, arguments.force)?;
    }
    let mut file = MapFile::open(&arguments.map)?;
    let layer = rendered(&mut file, arguments.resolution, arguments.quiet)?;
    if let Some((path, form)) = arguments.output.as_deref().zip(form) {
        let _made = files::MadeFolders::of_file(path)?;
        export::write_picture(&file, path, form, None)?;
    }
    file.close()?;
    if let Some(asked_m) = arguments.resolution.filter(|asked_m| layer.resolution_m > 1.001 * asked_m) {
        console::warn(&coarser(asked_m, layer.resolution_m));
    }
    if !arguments.quiet {
        let (width, height, _) = layer.picture_at(layer.finest);
        console::print(&format!("{width}x{height} px of {:.2} mm\n", 1000.0 * layer.resolution_m))?;
    }
    Ok(Outcome::Done)
}

/// The warning that the mosaic has larger pixels than requested, and why.
fn coarser(asked_m: f64, rendered_m: f64) -> String {
    format!(
        "--resolution {asked_m:?} is finer than this map allows: the mosaic has pixels of {:.2} mm, because \
         its images show nothing finer than a quarter of their pixels, and no mosaic is more than 2^30 \
         pixels wide",
        1e3 * rendered_m
    )
}

/// Finest resolution, metres per pixel.
const FINEST_M: f64 = 1e-9;

/// Coarsest resolution, metres per pixel: more than a keyframe shows.
const COARSEST_M: f64 = 1000.0;

/// Renders the mosaic of a map and stores it there, with a progress bar. Fails if it is
/// interrupted, or if no keyframe shows the ground.
pub fn rendered(file: &mut MapFile, resolution_m: Option<f64>, quiet: bool) -> Result<MosaicLayer> {
    let bar = console::bar("{bar:40} {pos}/{len} patches, {eta} left", quiet);
    let rendered = file.render_mosaic(resolution_m, &mut |left| {
        bar.inc(1);
        bar.set_length(bar.position() + left as u64);
        !interrupt::asked()
    })?;
    bar.finish_and_clear();
    file.mosaic()?.filter(|_| rendered).ok_or_else(|| {
        Error::input(if interrupt::asked() {
            "interrupted; the map has the mosaic that it had".to_owned()
        } else if let Some(metres) = resolution_m {
            format!(
                "{}: no keyframe shows enough ground for a pixel of {metres} m; give a finer --resolution",
                file.path().display()
            )
        } else {
            format!(
                "{} has no keyframe that shows the ground; there is no mosaic to render",
                file.path().display()
            )
        })
    })
}
