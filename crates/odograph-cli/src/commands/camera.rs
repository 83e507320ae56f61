//! `odograph camera`: converts camera files between programs.

use crate::{Outcome, console, files};
use odograph::camera::{Camera, Distortion};
use odograph::error::{Error, Result};
use odograph::formats::camera_file::{self, CameraFormat};
use odograph::geometry::Pixel;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Convert or show camera files.
#[derive(Debug, clap::Args)]
pub struct CameraArguments {
    #[command(subcommand)]
    command: CameraCommand,
}

#[derive(Debug, clap::Subcommand)]
enum CameraCommand {
    Convert(ConvertArguments),
    Show(ShowArguments),
}

/// Write a camera file in the format of another program.
///
/// Refuses what that format cannot express.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
struct ConvertArguments {
    /// Camera file (OpenCV YAML, ROS camera_info, Kalibr, EuRoC or COLMAP).
    #[arg(value_name = "FILE")]
    input: PathBuf,
    /// File to write. [default: standard output]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// opencv, ros, kalibr or colmap. [default: by the name of the output]
    #[arg(long, value_name = "FORMAT", value_parser = clap::value_parser!(CameraFormat))]
    to: Option<CameraFormat>,
    /// Size of the calibrated images, pixels, if the file does not state it.
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = size)]
    size: Option<(usize, usize)>,
    /// Overwrite the output if it exists.
    #[arg(long)]
    force: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph camera convert camera.yaml -o cameras.txt           # COLMAP, its half pixel included
  odograph camera convert camera.yaml -o robot-camchain.yaml   # Kalibr
  odograph camera convert camera.yaml --to ros                 # to standard output";

/// Show size, focal lengths, lens and fields of view.
#[derive(Debug, clap::Args)]
struct ShowArguments {
    /// Camera file (OpenCV YAML, ROS camera_info, Kalibr, EuRoC or COLMAP).
    #[arg(value_name = "FILE")]
    input: PathBuf,
    /// Size of the calibrated images, pixels, if the file does not state it.
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = size)]
    size: Option<(usize, usize)>,
}

/// Runs the command.
pub fn camera(arguments: CameraArguments) -> Result<Outcome> {
    match arguments.command {
        CameraCommand::Convert(arguments) => convert(&arguments)?,
        CameraCommand::Show(arguments) => {
            let camera = read(&arguments.input, arguments.size)?;
            console::print(&description(&camera))?;
        }
    }
    Ok(Outcome::Done)
}

fn read(path: &Path, size: Option<(usize, usize)>) -> Result<Camera> {
    camera_file::parse(&files::read_text(path)?, size).map_err(|error| error.at(path.display()))
}

fn convert(arguments: &ConvertArguments) -> Result<()> {
    let named = |path: &PathBuf| CameraFormat::of_file_name(&path.file_name()?.to_string_lossy());
    let to_file = arguments.output.as_ref().filter(|path| *path != Path::new("-"));
    let format = match (arguments.to, to_file) {
        (Some(format), _) => format,
        (None, Some(path)) => named(path).ok_or_else(|| {
            Error::usage(format!(
                "the name {} does not say which format it is to be; give --to opencv, ros, kalibr or colmap",
                path.display()
            ))
        })?,
        (None, None) => {
            return Err(Error::usage(
                "no format is given; give --to opencv, ros, kalibr or colmap, or -o with a name that says it",
            ));
        }
    };
    let camera = read(&arguments.input, arguments.size)?;
    let text = camera_file::write_as(&camera, format).map_err(|error| error.at(arguments.input.display()))?;
    let Some(path) = to_file else { return console::print(&text) };
    files::check_output_file(path, arguments.force)?;
    let _made = files::MadeFolders::of_file(path)?;
    files::write(path, text.as_bytes())
}

fn size(text: &str) -> std::result::Result<(usize, usize), String> {
    let sides = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    sides
        .filter(|&(w, h)| w > 0 && h > 0)
        .ok_or_else(|| format!("`{text}` is not a size in pixels such as 1280x720"))
}

/// A few lines about a camera, for people.
fn description(camera: &Camera) -> String {
    let (width, height) = (camera.width(), camera.height());
    let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.principal_px());
    let mut text = format!(
        "{width}x{height} pixels\nfocal lengths    {fx:.3} and {fy:.3} px\nprincipal point  ({cx:.3}, {cy:.3}) px, pixel centres at \
         integers; the middle of the image is ({:.1}, {:.1})\n",
        (width as f64 - 1.0) / 2.0,
        (height as f64 - 1.0) / 2.0,
    );
    let names: &[&str] = match camera.distortion() {
        Distortion::None => &[],
        Distortion::BrownConrady { .. } => &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
        Distortion::KannalaBrandt { .. } => &["k1", "k2", "k3", "k4"],
        Distortion::DoubleSphere { .. } => &["xi", "alpha"],
    };
    let lens = match camera.distortion() {
        Distortion::None => "a pinhole",
        Distortion::BrownConrady { .. } => "Brown–Conrady",
        Distortion::KannalaBrandt { .. } => "Kannala–Brandt fisheye",
        Distortion::DoubleSphere { .. } => "double sphere",
    };
    let _ = write!(text, "lens             {lens}");
    for (name, value) in names.iter().zip(camera.distortion().coefficients()) {
        let _ = write!(text, " {name} {value:.6}");
    }
    let (right, bottom) = (width as f64 - 0.5, height as f64 - 0.5);
    let sight = |from: Pixel, to: Pixel| {
        let angle = camera
            .ray_from_pixel(from)
            .zip(camera.ray_from_pixel(to))
            .map(|(a, b)| a.vector().angle(&b.vector()).to_degrees());
        angle.map_or("beyond what the lens model describes".to_owned(), |degrees| format!("{degrees:.1}°"))
    };
    let _ = writeln!(
        text,
        "\nfield of view    {} wide, {} high, {} from corner to corner",
        sight(Pixel::new(-0.5, cy), Pixel::new(right, cy)),
        sight(Pixel::new(cx, -0.5), Pixel::new(cx, bottom)),
        sight(Pixel::new(-0.5, -0.5), Pixel::new(right, bottom)),
    );
    text
}
