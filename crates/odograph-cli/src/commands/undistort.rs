//! `odograph undistort`: removes the lens distortion from a recording.

mod output;
mod pipeline;

use super::frame_selection::FrameSelection;
use crate::{Outcome, console, files};
use odograph::correction::{FieldOfViewKept, ImageCorrection};
use odograph::error::{Error, Result};
use odograph_video::SourceOptions;
use output::UndistortedOutput;
use std::path::{Path, PathBuf};

/// Remove the lens distortion from a recording.
///
/// Writes the frames as a pinhole camera would have taken them, and that camera's file.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct UndistortArguments {
    /// A video, a folder of pictures, or `-` for Y4M on standard input.
    #[arg(value_name = "SOURCE")]
    source: String,
    /// Camera file (OpenCV YAML, ROS camera_info, Kalibr, EuRoC or COLMAP).
    #[arg(help_heading = "Camera", long, value_name = "FILE")]
    camera: PathBuf,
    /// Folder for the results.
    ///
    /// [default: beside the source, with its name: clip-undistorted/ for clip.mp4]
    #[arg(help_heading = "Results", short, long, value_name = "FOLDER")]
    output: Option<PathBuf>,
    /// How much of the lens's field of view is kept.
    #[arg(help_heading = "Camera", long, value_name = "WHICH", default_value = "same")]
    field_of_view_kept: KeptView,
    /// png: a folder of pictures; y4m: uncompressed video.
    #[arg(help_heading = "Results", long, value_name = "FORMAT", default_value = "png")]
    format: OutputFormat,
    /// Gray frames, even if the source has colour.
    #[arg(help_heading = "Results", long)]
    gray: bool,
    #[command(flatten)]
    frames: FrameSelection,
    /// Take at most this many frames.
    #[arg(help_heading = "Recording", long, value_name = "N")]
    max_frames: Option<u64>,
    /// Overwrite results that are already there.
    #[arg(help_heading = "Results", long)]
    force: bool,
    /// Threads to use; the results are the same for any number.
    ///
    /// [default: as many as the machine has]
    #[arg(help_heading = "Results", long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Say nothing but errors.
    #[arg(help_heading = "Results", short, long)]
    quiet: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph undistort clip.mp4 --camera camera.yaml -o clean/
  odograph run clean/frames --timestamps clean/frames.txt --camera clean/camera.yaml --height 1.20";

/// How much is kept, by the names on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum KeptView {
    /// Focal length and principal point stay as they are.
    Same,
    /// As much as fits without an empty pixel.
    Valid,
    /// Everything; unseen pixels are black.
    All,
}

impl From<KeptView> for FieldOfViewKept {
    fn from(kept: KeptView) -> Self {
        match kept {
            KeptView::Same => Self::SameFocalLength,
            KeptView::Valid => Self::ValidPixels,
            KeptView::All => Self::AllPixels,
        }
    }
}

/// Format of the frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum OutputFormat {
    Png,
    Y4m,
}

/// Runs the command.
pub fn undistort(arguments: UndistortArguments) -> Result<Outcome> {
    let camera_text = files::read_text(&arguments.camera)?;
    let options = SourceOptions {
        max_frames: arguments.max_frames,
        color: !arguments.gray,
        ..arguments.frames.source_options()
    };
    let source = odograph_session::open_recording(&arguments.source, &options)?;
    let (width, height) = (source.info().width, source.info().height);
    let in_file = |error: Error| error.at(arguments.camera.display());
    let camera = odograph_session::parse_camera(&arguments.camera, &camera_text, (width, height))?;
    let calibrated = (camera.width(), camera.height());
    if calibrated != (width, height) {
        return Err(odograph_session::other_size(&arguments.source, (width, height), calibrated));
    }
    let correction = ImageCorrection::new(&camera, arguments.field_of_view_kept.into()).map_err(in_file)?;
    let folder =
        arguments.output.clone().unwrap_or_else(|| files::free_beside(&arguments.source, "-undistorted"));
    let mut output = UndistortedOutput::new(&folder, arguments.format, arguments.force)?;
    let corrected = pipeline::correct(source, &correction, &arguments, &mut output)?;
    let Some(before_after) = &corrected.before_after else {
        return Err(corrected.failure.unwrap_or_else(|| {
            Error::input(format!("{} has no frame in the chosen range", arguments.source))
        }));
    };
    output.finish(correction.camera(), before_after)?;
    if !arguments.quiet {
        let rolling = camera.readout_s().is_some_and(|readout_s| readout_s != 0.0);
        print_result(&folder, &correction, &corrected, rolling)?;
    }
    // The error that ended the recording is reported after everything before it has been written.
    corrected.failure.map_or(Ok(Outcome::Done), Err)
}

fn print_result(
    folder: &Path,
    correction: &ImageCorrection,
    corrected: &pipeline::CorrectionSummary,
    rolling: bool,
) -> Result<()> {
    let camera = correction.camera();
    let empty = correction.pixels_without_source() as f64 / (camera.width() * camera.height()) as f64;
    console::print(&format!(
        "{} {} of {}x{}, focal lengths {:.1} and {:.1} px, {:.1} % of each without a source\nLook at {}\n",
        corrected.frames,
        if corrected.frames == 1 { "frame" } else { "frames" },
        camera.width(),
        camera.height(),
        camera.focal_px().0,
        camera.focal_px().1,
        100.0 * empty,
        console::name(folder.join("before-after.png")),
    ))?;
    corrected.warnings.iter().for_each(|warning| console::warn(warning));
    if rolling {
        console::warn(
            "the camera's readout time does not hold for the corrected frames, and is not in their camera file; \
             for a run use the frames as they were, with their own camera file",
        );
    }
    Ok(())
}
