//! `odograph demo`: the bundled drive, end to end.

use super::run::{self, OutputArguments, RunArguments};
use crate::{Outcome, console, files};
use odograph::error::{Error, Result};
use odograph::evaluation::{self, Alignment, EvaluationOptions};
use odograph::formats::trajectory_file;
use std::path::{Path, PathBuf};

const CLIP: &[u8] = include_bytes!("../../demo/drive.mp4");
const CAMERA: &str = include_str!("../../demo/camera.yaml");
const RIG: &str = include_str!("../../demo/rig.toml");
const TRUTH: &str = include_str!("../../demo/truth.tum");

/// Follow the bundled drive and show what comes out.
///
/// The clip is rendered over photographed floors (a shaky, turning, lens-distorted camera), so its truth is known exactly and the result is
/// compared with it.
#[derive(Debug, clap::Args)]
pub struct DemoArguments {
    /// Folder for the clip and the results.
    #[arg(short, long, value_name = "FOLDER", default_value = "odograph-demo")]
    pub output: PathBuf,
    /// Threads to use; the results are the same for any number. [default: as many as help]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
    /// Say nothing but errors.
    #[arg(short, long)]
    pub quiet: bool,
    /// Print stats.json to standard output instead of a summary.
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
pub fn demo(arguments: DemoArguments) -> Result<Outcome> {
    let folder = &arguments.output;
    let unpacked = folder.join("input");
    std::fs::create_dir_all(&unpacked)
        .map_err(|error| Error::output(format!("{} cannot be made: {error}", unpacked.display())))?;
    let unpack = |name: &str, bytes: &[u8]| -> Result<PathBuf> {
        let path = unpacked.join(name);
        files::write(&path, bytes)?;
        Ok(path)
    };
    let clip = unpack("drive.mp4", CLIP)?;
    let camera = unpack("camera.yaml", CAMERA.as_bytes())?;
    let rig = unpack("rig.toml", RIG.as_bytes())?;
    let truth = unpack("truth.tum", TRUTH.as_bytes())?;
    let told = !arguments.quiet && !arguments.json;
    if told {
        console::print(&format!(
            "A drive of half a minute over photographed floors; this is what you would type for a recording of your own:\n\n  \
             odograph run {} --camera {} --rig {} -o {}\n\n",
            clip.display(),
            camera.display(),
            rig.display(),
            folder.display()
        ))?;
    }
    let outcome = run::run(RunArguments {
        source: clip.display().to_string(),
        camera: Some(camera),
        rig: Some(rig),
        ..RunArguments::over(OutputArguments {
            output: folder.clone(),
            force: true, // the demo's own folder
            map: None,
            threads: arguments.threads,
            quiet: arguments.quiet,
            json: arguments.json,
        })
    })?;
    if told {
        compare(folder, &truth)?;
    }
    Ok(outcome)
}

/// Tells how far the path is from the truth.
fn compare(folder: &Path, truth: &Path) -> Result<()> {
    let estimate = trajectory_file::parse_tum(&files::read_text(&folder.join("trajectory.tum"))?)?;
    let options = EvaluationOptions { alignment: Alignment::Origin, ..Default::default() };
    let found = evaluation::evaluate(&estimate, &trajectory_file::parse_tum(TRUTH)?, &options)?;
    console::print(&format!(
        "Against the truth: {:.1} mm off on average, {:.1} mm at the end of {:.1} m.\n  odograph evaluate {} {}\n",
        1e3 * found.absolute.translation.mean,
        1e3 * found.final_position_error_m,
        found.truth_length_m,
        folder.join("trajectory.tum").display(),
        truth.display()
    ))
}
