//! `odograph localize`: where a camera is in a map that was made before.

use super::run::{self, OutputArguments, OutputFolder, RunPlan, SensorPlan, SourcePlan};
use crate::{Outcome, console, files};
use odograph::error::{Error, Result};
use odograph::formats::rig_file;
use odograph::motion::MotionModel;
use odograph::odometry::OdometryConfig;
use odograph::slam::SlamConfig;
use odograph_map::MapFile;
use std::path::PathBuf;

/// Find a recording, or a single picture, in a map that was made before, and follow it there.
///
/// The camera may look anywhere over the mapped ground, at any heading; nothing needs to be known of where it is. The path comes out in the
/// frame of the map, with all the files of a run.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct LocalizeArguments {
    /// A video, a folder of pictures, or `-` for Y4M on standard input; of the camera that the map was made with.
    #[arg(value_name = "SOURCE")]
    pub source: String,
    /// The map.
    #[arg(long, value_name = "FILE")]
    pub map: PathBuf,
    /// Leave the map as it is. Without this it grows by what the recording shows.
    #[arg(long)]
    pub read_only: bool,
    /// Rig file (TOML), where the camera is not mounted as it was when the map was begun.
    #[arg(long, value_name = "FILE")]
    pub rig: Option<PathBuf>,
    /// What may change between frames.
    #[arg(long, value_name = "MODEL", default_value = "auto")]
    pub motion: run::Motion,
    /// Times of the frames: lines of `seconds name`, or EuRoC's CSV in nanoseconds.
    #[arg(long, value_name = "FILE")]
    pub timestamps: Option<PathBuf>,
    /// Frames a second, where the source does not say.
    #[arg(long, value_name = "RATE", allow_negative_numbers = true)]
    pub fps: Option<f64>,
    /// Take at most so many frames.
    #[arg(long, value_name = "N")]
    pub max_frames: Option<u64>,
    /// Folder for the results.
    #[arg(short, long, value_name = "FOLDER")]
    pub output: PathBuf,
    /// Overwrite results that are already there.
    #[arg(long)]
    pub force: bool,
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

const EXAMPLES: &str = "\
Examples:
  odograph localize tuesday.mp4 --map hall.gpkg --read-only -o tuesday/
  odograph localize picture/ --map hall.gpkg --read-only -o here/

Ends with 0 when the place was found, 2 on wrong usage, 3 on bad input, 4 when nothing of the map was recognised.";

/// Runs the command.
pub fn localize(arguments: LocalizeArguments) -> Result<Outcome> {
    let map = MapFile::open_read_only(&arguments.map)?;
    let (camera, mounted) = (map.camera().clone(), *map.rig());
    drop(map);
    let rig = match &arguments.rig {
        Some(path) => rig_file::parse(&files::read_text(path)?).map_err(|error| error.at(path.display()))?,
        None => mounted,
    };
    let folder = OutputFolder::new(&arguments.output, arguments.force)?;
    let source_plan = SourcePlan {
        path: arguments.source.clone(),
        timestamps: arguments.timestamps.clone(),
        fps: arguments.fps,
        start_s: None,
        end_s: None,
        every: 1,
        max_frames: arguments.max_frames,
    };
    let source = source_plan.open()?;
    let (width, height) = (source.info().width, source.info().height);
    if (camera.width(), camera.height()) != (width, height) {
        return Err(Error::input(format!(
            "the frames of {} are {width}x{height} but the map was made with a camera of {}x{}; only pictures of that camera can \
             be found in it",
            arguments.source,
            camera.width(),
            camera.height(),
        )));
    }
    let mut odometry = OdometryConfig::default();
    odometry.motion.model = MotionModel::from(arguments.motion);
    let plan = RunPlan {
        mask: None,
        odograph: env!("CARGO_PKG_VERSION").to_owned(),
        reference: None,
        source: source_plan,
        camera,
        rig,
        sensors: SensorPlan::default(),
        odometry,
        budget: None,
        // Where nothing is written that a mistake could bend, the first sure sighting is the answer.
        slam: SlamConfig { sightings: if arguments.read_only { 1 } else { 2 }, ..SlamConfig::default() },
    };
    let output = OutputArguments {
        output: arguments.output,
        force: arguments.force,
        map: Some(arguments.map.clone()),
        map_is_read_only: arguments.read_only,
        least_frames: 1,
        threads: arguments.threads,
        quiet: arguments.quiet,
        json: arguments.json,
    };
    let report = run::follow(&plan, source, folder, &output)?;
    report.tell(&output)?;
    if report.recognised {
        return Ok(report.outcome());
    }
    if output.quiet {
        console::complain(&format!("nothing of {} was recognised", arguments.map.display()));
    }
    Ok(Outcome::TrackingFailed)
}
