//! `odograph ground`: how the camera is mounted over the floor.

mod board;
mod driving;
mod picture;

use super::frame_selection::FrameSelection;
use crate::lengths::{self, Height, Typed};
use crate::{Outcome, console, files};
use odograph::camera::Camera;
use odograph::camera::{CameraUncertainty, MeasuredRig};
use odograph::error::{Error, Result};
use odograph::formats::{camera_file, rig_file};
use odograph::geometry::Pixel;
use odograph::image::RgbImage;
use odograph_calibration::BoardDirection;
use odograph_video::SourceOptions;
use std::fs;
use std::path::{Path, PathBuf};

/// Measure height, roll, pitch and yaw of the mounted camera.
///
/// From pictures of a board that lies on the floor, or from driving.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct GroundArguments {
    /// Pictures, folders or clips of a board on the floor; or one recording of driving.
    #[arg(value_name = "SOURCE", required = true)]
    sources: Vec<String>,
    /// Camera file (OpenCV YAML, ROS camera_info, Kalibr, EuRoC or COLMAP).
    #[arg(help_heading = "Camera", long, value_name = "FILE")]
    camera: PathBuf,
    /// Rig file to write; a picture of the same name that ends in .png is put beside it.
    ///
    /// [default: beside the first source, with its name: drive-rig.toml for drive.mp4]
    #[arg(help_heading = "Results", short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// The board on the floor, such as charuco:8x11:20mm or chessboard:9x6:25mm.
    #[arg(help_heading = "With a board", long, value_name = "BOARD")]
    board: Option<String>,
    /// With --board: how far its printed side is above the floor, such as 5mm. [default: 0mm]
    #[arg(help_heading = "With a board", long, value_name = "LENGTH", value_parser = lengths::with_unit, requires = "board")]
    thickness: Option<f64>,
    /// With --board: the direction of the print that points forward on the carrier.
    ///
    /// x is to the right of the print, y down it. Without this the mount yaw is not measured.
    #[arg(help_heading = "With a board", long, value_name = "x|-x|y|-y", value_parser = direction, allow_hyphen_values = true, requires = "board")]
    forward: Option<BoardDirection>,
    /// Without --board: the height of the camera above the floor, as 0.9 (metres) or 90cm.
    #[arg(help_heading = "From driving", long, value_name = "LENGTH", value_parser = lengths::height, allow_negative_numbers = true, conflicts_with = "board")]
    height: Option<Height>,
    /// Without --board: how far the camera was driven, such as 6.20 (metres); gives the height.
    ///
    /// The last digit counts: 6.20 is more precise than 6.2.
    #[arg(help_heading = "From driving", long, value_name = "LENGTH", value_parser = lengths::typed, allow_negative_numbers = true, conflicts_with_all = ["board", "height"])]
    distance: Option<Typed>,
    /// Without --board: a rig file to start from, for tilts of more than ten degrees.
    #[arg(help_heading = "From driving", long, value_name = "FILE", conflicts_with = "board")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    frames: FrameSelection,
    /// Overwrite results that are already there.
    #[arg(help_heading = "Results", long)]
    force: bool,
    /// Say nothing but errors and warnings.
    #[arg(help_heading = "Results", short, long)]
    quiet: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph ground floor.jpg --board charuco:8x11:20mm --camera camera.yaml -o rig.toml
  odograph ground floor*.jpg --board chessboard:9x6:25mm --forward x --camera camera.yaml
  odograph ground drive.mp4 --camera camera.yaml --height 0.75 -o rig.toml     # from driving 5 m
  odograph ground drive.mp4 --camera camera.yaml --distance 6.20 -o rig.toml   # with the height";

/// The measured rig, and what illustrates it.
struct RigMeasurement {
    rig: MeasuredRig,
    /// Lines for people: what it was measured from.
    summary: String,
    warnings: Vec<String>,
    /// A frame, and the board's points in it.
    frame: RgbImage,
    points: Vec<Pixel>,
    /// Whether the carrier's forward is known.
    forward_known: bool,
}

/// Warning if the camera file has no covariance.
const CAMERA_UNKNOWN: &str = "the camera file has no uncertainty, so the deviations do not include errors \
     of the calibration";

/// Runs the command.
pub fn ground(arguments: GroundArguments) -> Result<Outcome> {
    let source = arguments.source();
    let output = arguments.output.clone().unwrap_or_else(|| files::free_beside(source, "-rig.toml"));
    let picture_path = picture_path(&output)?;
    for path in [&output, &picture_path] {
        files::check_output_file(path, arguments.force)?;
    }
    let _made = files::MadeFolders::of_result(&output)?;
    let measured = match &arguments.board {
        Some(board) => board::measure(&arguments, board.parse()?)?,
        None => driving::measure(&arguments)?,
    };
    let camera = read_camera(&arguments.camera, source, size_of(&measured.frame))?.0;
    let drawn = picture::drawn(&camera, &measured)?;
    files::write(&picture_path, &drawn)?;
    files::write(&output, rig_file::write_measured(&measured.rig).as_bytes()).inspect_err(|_| {
        let _ = fs::remove_file(&picture_path);
    })?;
    measured.warnings.iter().for_each(|warning| console::warn(warning));
    if !arguments.quiet {
        console::print(&format!(
            "{}{}\nWrote {}; look at {}\n",
            figures(&measured),
            measured.summary,
            console::name(&output),
            console::name(&picture_path)
        ))?;
    }
    Ok(Outcome::Done)
}

fn picture_path(output: &Path) -> Result<PathBuf> {
    let picture = output.with_extension("png");
    if output.file_name().is_none() || picture == output {
        return Err(Error::usage(format!(
            "{} is no name for a rig file; take one such as rig.toml",
            output.display()
        )));
    }
    Ok(picture)
}

fn size_of(image: &RgbImage) -> (usize, usize) {
    (image.width(), image.height())
}

/// The camera of the file for frames of a size of a source, with its uncertainty, if the file has
/// one.
fn read_camera(
    path: &Path,
    source: &str,
    size: (usize, usize),
) -> Result<(Camera, Option<CameraUncertainty>)> {
    let text = files::read_text(path)?;
    let in_file = |error: Error| error.at(path.display());
    let camera = odograph_session::parse_camera(path, &text, size)?;
    let calibrated = (camera.width(), camera.height());
    if calibrated != size {
        return Err(odograph_session::other_size(source, size, calibrated));
    }
    Ok((camera, camera_file::parse_uncertainty(&text).map_err(in_file)?))
}

impl GroundArguments {
    /// The first source.
    fn source(&self) -> &str {
        self.sources.first().map_or("-", String::as_str)
    }

    fn source_options(&self) -> SourceOptions {
        SourceOptions { color: true, ..self.frames.source_options() }
    }
}

/// The numbers of the rig with their deviations, a line each.
fn figures(measured: &RigMeasurement) -> String {
    let MeasuredRig { rig, deviations } = measured.rig;
    let within = |deviation: Option<f64>, unit: f64, name: &str, otherwise: &str| {
        deviation.map_or(otherwise.to_owned(), |value| match value * unit {
            little if little < 0.001 => format!("± less than 0.001{name}"),
            value => format!("± {value:.3}{name}"),
        })
    };
    let degrees = |angle: f64, deviation: Option<f64>| {
        format!(
            "{:.3}° {}",
            angle.to_degrees(),
            within(deviation, 180.0 / std::f64::consts::PI, "°", "(given)")
        )
    };
    let yaw = if measured.forward_known {
        format!(
            "{}, from forward to the top of the image, counter-clockwise",
            degrees(rig.yaw_rad, deviations.yaw_rad)
        )
    } else {
        "not measured: the top of the image is taken as forward".to_owned()
    };
    format!(
        "height  {:.4} m {}\nroll    {}, positive with the left side of the image raised\npitch   {}, positive when the camera looks \
         backwards\nyaw     {yaw}\n",
        rig.height_m,
        within(deviations.height_m, 1e3, " mm", "(given)"),
        degrees(rig.roll_rad, deviations.roll_rad),
        degrees(rig.pitch_rad, deviations.pitch_rad),
    )
}

fn direction(text: &str) -> std::result::Result<BoardDirection, String> {
    match text {
        "x" | "+x" => Ok(BoardDirection::X),
        "-x" => Ok(BoardDirection::MinusX),
        "y" | "+y" => Ok(BoardDirection::Y),
        "-y" => Ok(BoardDirection::MinusY),
        _ => Err(format!(
            "`{text}` is no direction of the board; there are x (to the right of the print), -x, y (down the print) and -y"
        )),
    }
}
