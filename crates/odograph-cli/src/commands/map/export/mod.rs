//! `odograph map export`: writes a map for other programs, in the format given by the output's
//! name.

mod anchor;
mod colmap;
mod geographic;
mod grid;
mod picture;
mod ply;
mod trajectory;

use super::info::{over_ground_m, stale};
use crate::{Outcome, console, files, interrupt, lengths};
use anchor::{AnchorArgument, anchor_of};
use geographic::GeographicForm;
use odograph::error::{Error, Result};
use odograph::georeference::Anchor;
use odograph_map::{GeoTiff, MapFile, MosaicLayer, PathFrame, connected_stretches};
use std::path::{Path, PathBuf};
use trajectory::TrajectoryForm;

/// Write a map for other programs; the name of the output gives the format.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct ExportArguments {
    /// The map.
    #[arg(value_name = "MAP")]
    map: PathBuf,
    /// File or folder to write; its extension is the format.
    ///
    /// .tif, .png or .ply: the mosaic; .yaml: an occupancy grid for Nav2, with its .pgm; .tum,
    /// .kitti or .csv: the path; .geojson, .kml or .gpx: the path on Earth; a folder: COLMAP's text
    /// model with its images.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Where the map is on Earth: "LAT,LON,HEADING", or twice "X,Y=LAT,LON".
    ///
    /// LAT,LON,HEADING are those of the map's origin; HEADING is the compass direction of the map's
    /// x, degrees.
    #[arg(long, value_name = "ANCHOR", allow_hyphen_values = true, value_parser = clap::value_parser!(AnchorArgument))]
    anchor: Vec<AnchorArgument>,
    /// The session whose path is written as .tum, .kitti or .csv. [default: the only one]
    #[arg(long, value_name = "N")]
    session: Option<u32>,
    /// Largest number of points in a .ply; the mosaic is coarsened to fit.
    #[arg(long, value_name = "N", default_value_t = 2_000_000,
          value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..))]
    max_points: usize,
    /// Side of a cell of a .yaml, as 0.05 (metres) or 5cm. [default: 5 cm, more where the mosaic
    /// is coarse]
    #[arg(long, value_name = "LENGTH", value_parser = lengths::metres, allow_negative_numbers = true)]
    resolution: Option<f64>,
    /// Overwrite existing results.
    #[arg(long)]
    force: bool,
    /// Say nothing but errors.
    #[arg(short, long)]
    quiet: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph map export map.gpkg -o floor.tif                               # mosaic, in metres
  odograph map export map.gpkg --anchor 48.2082,16.3738,93.5 -o floor.tif # mosaic, UTM
  odograph map export map.gpkg --anchor 0,0=48.2,16.37 --anchor 9,9=48.20008,16.37012 -o path.kml
  odograph map export map.gpkg -o grid.yaml                               # Nav2, with grid.pgm
  odograph map export map.gpkg -o colmap/                                 # cameras, points";

/// The formats of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PictureForm {
    GeoTiff,
    Png,
}

impl PictureForm {
    /// The format given by a file's name.
    pub fn of(path: &Path) -> Result<Self> {
        match Form::of(path)? {
            Form::Picture(form) => Ok(form),
            _ => Err(Error::usage(format!(
                "{} is not the name of a picture; give a .tif or a .png",
                path.display()
            ))),
        }
    }
}

/// What can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Form {
    Picture(PictureForm),
    Ply,
    Grid,
    Trajectory(TrajectoryForm),
    Geographic(GeographicForm),
    Colmap,
}

impl Form {
    fn of(path: &Path) -> Result<Self> {
        let extension = path.extension().map(|extension| extension.to_string_lossy().to_ascii_lowercase());
        match extension.as_deref() {
            Some("tif" | "tiff") => Ok(Self::Picture(PictureForm::GeoTiff)),
            Some("png") => Ok(Self::Picture(PictureForm::Png)),
            Some("ply") => Ok(Self::Ply),
            Some("yaml" | "yml") => Ok(Self::Grid),
            Some("tum") => Ok(Self::Trajectory(TrajectoryForm::Tum)),
            Some("kitti") => Ok(Self::Trajectory(TrajectoryForm::Kitti)),
            Some("csv") => Ok(Self::Trajectory(TrajectoryForm::Csv)),
            Some("geojson" | "json") => Ok(Self::Geographic(GeographicForm::GeoJson)),
            Some("kml") => Ok(Self::Geographic(GeographicForm::Kml)),
            Some("gpx") => Ok(Self::Geographic(GeographicForm::Gpx)),
            None => Ok(Self::Colmap),
            Some(other) => Err(Error::usage(format!(
                "{}: a map cannot be written as .{other}; there are .tif, .png, .ply, .yaml (Nav2), .tum, .kitti, .csv, .geojson, \
                 .kml, .gpx and a folder for COLMAP",
                path.display()
            ))),
        }
    }

    /// Whether the format can hold the position on Earth.
    fn takes_anchor(self) -> bool {
        matches!(self, Self::Picture(PictureForm::GeoTiff) | Self::Geographic(_))
    }
}

/// Runs the command.
pub fn export(arguments: &ExportArguments) -> Result<Outcome> {
    let form = Form::of(&arguments.output)?;
    if !arguments.anchor.is_empty() && !form.takes_anchor() {
        return Err(Error::usage(
            "--anchor is for .tif, .geojson, .kml and .gpx; the other forms have no place on Earth",
        ));
    }
    if arguments.session.is_some() && !matches!(form, Form::Trajectory(_)) {
        return Err(Error::usage(
            "--session is for .tum, .kitti and .csv; the other forms have all sessions of the map",
        ));
    }
    check_cell(arguments.resolution, form)?;
    let anchor = anchor_of(&arguments.anchor)?;
    match form {
        Form::Colmap => check_colmap_folder(&arguments.output)?,
        Form::Grid => {
            files::check_output_file(&arguments.output, arguments.force)?;
            files::check_output_file(&grid::picture_of(&arguments.output), arguments.force)?;
        }
        _ => files::check_output_file(&arguments.output, arguments.force)?,
    }
    let output = arguments.output.as_path();
    if matches!(form, Form::Geographic(_)) && anchor.is_none() {
        return Err(without_anchor(output));
    }
    let mut file = MapFile::open_read_only(&arguments.map)?;
    let _made = files::MadeFolders::of_file(output)?;
    let shows_mosaic = matches!(form, Form::Picture(_) | Form::Ply | Form::Grid);
    if let Some(shift_m) = file.mosaic_shift_m()?.filter(|_| shows_mosaic && !arguments.quiet) {
        console::warn(&format!("the mosaic is {}", stale(shift_m, &arguments.map)));
    }
    let summary = match form {
        Form::Picture(form) => write_picture(&file, output, form, anchor.as_ref())?,
        Form::Ply => ply::write(&file, output, arguments.max_points)?,
        Form::Grid => grid::write(&file, &mosaic_of(&file)?, output, arguments.resolution)?,
        Form::Trajectory(form) => {
            let (frames, length_m) = path_asked(&file, arguments.session)?;
            trajectory::write((&frames, length_m), output, form)?
        }
        Form::Geographic(form) => {
            let anchor = anchor.ok_or_else(|| without_anchor(output))?;
            geographic::write(&file, output, form, &anchor)?
        }
        Form::Colmap => colmap::write(&mut file, output, arguments.force)?,
    };
    if !arguments.quiet {
        console::print(&format!("{summary}\nLook at {}\n", console::name(output)))?;
    }
    Ok(Outcome::Done)
}

/// Refuses a side of a cell that no grid can have.
fn check_cell(cell_m: Option<f64>, form: Form) -> Result<()> {
    const SIDES_M: std::ops::RangeInclusive<f64> = 1e-3..=100.0;
    match cell_m {
        Some(_) if form != Form::Grid => {
            Err(Error::usage("--resolution is for .yaml; odograph map mosaic --resolution is for pictures"))
        }
        Some(cell_m) if !SIDES_M.contains(&cell_m) => Err(Error::usage(format!(
            "--resolution is {cell_m:?} m; a cell of a grid is between 1 mm and 100 m wide"
        ))),
        _ => Ok(()),
    }
}

/// Refuses a file without an ending, which would say that a folder is meant.
fn check_colmap_folder(output: &Path) -> Result<()> {
    files::check_output_folder(output).map_err(|error| {
        Error::usage(format!(
            "{error} for COLMAP; or end the name in .tif, .png, .ply, .yaml, .tum, .csv or .kml"
        ))
    })
}

fn without_anchor(output: &Path) -> Error {
    Error::usage(format!(
        "{} needs to know where on Earth the map is; give --anchor LAT,LON,HEADING, or two of --anchor X,Y=LAT,LON",
        output.display()
    ))
}

/// Writes the mosaic of a map.
pub fn write_picture(
    file: &MapFile,
    path: &Path,
    form: PictureForm,
    anchor: Option<&Anchor>,
) -> Result<String> {
    let layer = mosaic_of(file)?;
    match form {
        PictureForm::GeoTiff => write_geotiff(file, &layer, path, anchor),
        PictureForm::Png => picture::write(file, &layer, path),
    }
}

/// The mosaic of a map.
fn mosaic_of(file: &MapFile) -> Result<MosaicLayer> {
    file.mosaic()?.ok_or_else(|| {
        Error::input(format!(
            "{} has no mosaic yet; odograph map mosaic {} renders it",
            file.path().display(),
            file.path().display()
        ))
    })
}

/// Writes the mosaic as a GeoTIFF and reports what was written.
fn write_geotiff(
    file: &MapFile,
    layer: &MosaicLayer,
    path: &Path,
    anchor: Option<&Anchor>,
) -> Result<String> {
    let mut written = None;
    files::write_with(path, |output| {
        let picture = file.write_geotiff(layer, output, anchor, &mut interrupt::check);
        written = Some(picture.map_err(|error| error.at(path.display()))?);
        Ok(())
    })?;
    let system =
        anchor.map_or("metres of the map".to_owned(), |anchor| format!("EPSG:{}", anchor.utm_code()));
    Ok(written.map_or_else(String::new, |GeoTiff { width, height, pixel_m, level }| {
        format!("{width}x{height} px of {:.2} mm, {system}{}", 1000.0 * pixel_m, coarser(layer, level))
    }))
}

/// The note if a picture is coarser than the mosaic; otherwise empty.
fn coarser(layer: &MosaicLayer, level: u32) -> String {
    if level >= layer.finest {
        return String::new();
    }
    format!(
        " (the mosaic has pixels of {:.2} mm: its ground is too far apart for a picture that fine)",
        1000.0 * layer.resolution_m
    )
}

/// The path of the given session, or of the only one, and its length, metres; that of the keyframes
/// if the map has no path yet.
fn path_asked(file: &MapFile, session: Option<u32>) -> Result<(Vec<PathFrame>, f64)> {
    let sessions = file.sessions()?;
    let session = match (session, sessions.as_slice()) {
        (Some(session), known) if known.iter().any(|known| known.id == session) => session,
        (None, [only]) => only.id,
        (asked, known) => {
            let numbers: Vec<String> = known.iter().map(|session| session.id.to_string()).collect();
            let asked = asked
                .map_or("it has several sessions".to_owned(), |asked| format!("there is no session {asked}"));
            return Err(Error::usage(format!(
                "{}: {asked}; choose one with --session: {}",
                file.path().display(),
                numbers.join(", ")
            )));
        }
    };
    let path = file.path_of(session)?;
    if !path.is_empty() {
        let length_m = over_ground_m(connected_stretches(&path));
        return Ok((path, length_m));
    }
    let keyframes = file.map()?.keyframes;
    let path: Vec<PathFrame> = keyframes
        .iter()
        .filter(|keyframe| keyframe.session == session)
        .map(|keyframe| PathFrame {
            frame: keyframe.frame,
            segment: keyframe.segment,
            time_s: keyframe.time_s,
            pose: keyframe.pose,
        })
        .collect();
    let length_m = over_ground_m(path.chunk_by(|a, b| a.segment == b.segment));
    Ok((path, length_m))
}
