//! `odograph run`: a recording goes in, a folder with a trajectory and a map comes out.

mod budget;
mod camera_watch;
mod finish;
pub(super) mod kept_frames;
pub(super) mod folder;
pub(super) mod found;
mod many;
mod map;
mod mask;
pub(super) mod mapping;
pub(super) mod pipeline;
mod place;
mod plan;
mod plan_paths;
mod reference;
mod resemblance;
mod sensors;
pub(super) mod statistics;
mod tilt;
pub(super) mod timings;
pub(super) mod views;

use crate::lengths::{self, Height};
use crate::{Outcome, console, files};
use camera_watch::CameraWatch;
pub(super) use finish::finish;
pub use folder::OutputFolder;
use odograph::error::Result;
use odograph::motion::MotionModel;
use pipeline::{Ended, Tracked};
pub use place::PlaceInMap;
pub use plan::{RunPlan, SourcePlan};
pub use resemblance::{AlikePlace, Resemblance, Verdict};
pub use sensors::SensorPlan;
pub use statistics::Statistics;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Follow a recording: trajectory, map, mosaic of the ground, report.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct RunArguments {
    /// A video, a folder of pictures, a robot recording, `-` for Y4M, or an earlier run.toml.
    ///
    /// Robot recordings are MCAP files, ROS 1 bags, and rosbag2 folders and databases; `-` is
    /// standard input.
    #[arg(value_name = "SOURCE")]
    pub source: String,
    /// More recordings of the same camera, or one folder of videos as SOURCE.
    ///
    /// Each gets a folder of its own in -o; as many run at a time as there are cores.
    #[arg(value_name = "MORE")]
    pub more: Vec<String>,
    /// Camera file (OpenCV YAML, ROS camera_info, Kalibr, EuRoC or COLMAP).
    ///
    /// Not needed to continue a map, which has the camera and how it sits, nor for a robot recording
    /// with a camera_info of its images.
    #[arg(help_heading = "Camera", long, value_name = "FILE")]
    pub camera: Option<PathBuf>,
    /// Height of the camera above the ground, as 0.9 (metres), 90cm or 3ft.
    ///
    /// The camera is taken to look straight down; a tilt is found in the recording.
    #[arg(help_heading = "Camera", long, value_name = "LENGTH", value_parser = lengths::height, allow_negative_numbers = true, conflicts_with = "rig")]
    pub height: Option<Height>,
    /// Rig file (TOML): height_m, roll_deg, pitch_deg, yaw_deg.
    #[arg(help_heading = "Camera", long, value_name = "FILE")]
    pub rig: Option<PathBuf>,
    /// Width and height of the ground in the image, as 1.20x0.90 (metres) or 120cmx90cm.
    ///
    /// Stands in for a camera file; height and tilt are then taken as steady.
    #[arg(help_heading = "Camera", long, value_name = "WxH", value_parser = field_of_view, conflicts_with = "camera")]
    pub field_of_view: Option<FieldOfView>,
    /// Readout time of the image in milliseconds, first row to last; 0 is a global shutter.
    ///
    /// [default: the camera file's readout_time_s; otherwise it is learned]
    #[arg(help_heading = "Camera", long, value_name = "MS", value_parser = readout_ms, allow_negative_numbers = true)]
    pub readout_ms: Option<f64>,
    /// Picture of what is not ground (black), of the size of the frames.
    ///
    /// Bumper, wheel, own shadow. What is found while running is ignored as well.
    #[arg(help_heading = "Camera", long, value_name = "PICTURE")]
    pub mask: Option<PathBuf>,
    /// What may change between frames.
    #[arg(help_heading = "Estimation", long, value_name = "MODEL", default_value = "auto")]
    pub motion: Motion,
    /// Topic with the images, where a robot recording (MCAP, ROS bag) has several.
    #[arg(help_heading = "Recording", long, value_name = "NAME")]
    pub topic: Option<String>,
    /// Times of the frames: lines of `seconds name`, or EuRoC's CSV in nanoseconds.
    #[arg(help_heading = "Recording", long, value_name = "FILE")]
    pub timestamps: Option<PathBuf>,
    /// Frames a second, where the source does not say.
    #[arg(help_heading = "Recording", long, value_name = "RATE", allow_negative_numbers = true)]
    pub fps: Option<f64>,
    /// Begin so many seconds after the first frame.
    #[arg(help_heading = "Recording", long, value_name = "SECONDS", allow_negative_numbers = true)]
    pub start: Option<f64>,
    /// End so many seconds after the first frame.
    #[arg(help_heading = "Recording", long, value_name = "SECONDS", allow_negative_numbers = true)]
    pub end: Option<f64>,
    /// Take every n-th frame.
    #[arg(help_heading = "Recording", long, value_name = "N", default_value_t = 1)]
    pub every: u64,
    /// Take at most so many frames.
    #[arg(help_heading = "Recording", long, value_name = "N")]
    pub max_frames: Option<u64>,
    /// Time that a frame may take, milliseconds; fewer corners are followed if needed.
    ///
    /// Measures the machine once. run.toml and stats.json say what was given up.
    #[arg(help_heading = "Estimation", long, value_name = "MS", allow_negative_numbers = true)]
    pub budget_ms: Option<f64>,
    #[command(flatten)]
    pub sensors: SensorPlan,
    /// Do not look for ground that was seen before: the path is what odometry alone has.
    #[arg(help_heading = "Estimation", long)]
    pub no_loops: bool,
    /// A path from elsewhere (TUM) to show beside that of the run in the report.
    ///
    /// Such as a satellite receiver's, or the truth: lines of time x y z qx qy qz qw, times as
    /// the frames'. It is aligned by rotation, shift and scale; nothing else is made of it.
    #[arg(help_heading = "Estimation", long, value_name = "FILE")]
    pub reference: Option<PathBuf>,
    /// Folder for the results.
    ///
    /// [default: beside the recording, with its name: drive/ for drive.mp4, frames-run/ for the
    /// folder frames/; with a number where that is there already]
    #[arg(help_heading = "Results", short = 'o', long = "output", value_name = "FOLDER")]
    pub folder: Option<PathBuf>,
    #[command(flatten)]
    pub output: OutputArguments,
}

/// Where results go and how much is said, alike for every command that tracks.
#[derive(Debug, Clone, clap::Args)]
pub struct OutputArguments {
    /// Folder for the results.
    #[arg(skip)]
    pub output: PathBuf,
    /// Overwrite results that are already there.
    #[arg(help_heading = "Results", long)]
    pub force: bool,
    /// Map file: continued where it exists, otherwise begun.
    ///
    /// [default: a new map.gpkg in the folder]
    #[arg(help_heading = "Results", long, value_name = "FILE")]
    pub map: Option<PathBuf>,
    /// The map is looked into, not written: a command that only asks where the camera is.
    #[arg(skip)]
    pub map_is_read_only: bool,
    /// Fewer frames than this are no recording.
    #[arg(skip = 2_usize)]
    pub least_frames: usize,
    /// Threads to use; the results are the same for any number. [default: as many as help]
    #[arg(help_heading = "Results", long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
    /// Say nothing but errors.
    #[arg(help_heading = "Results", short, long)]
    pub quiet: bool,
    /// Print stats.json to standard output instead of a summary.
    #[arg(help_heading = "Results", long)]
    pub json: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph run drive.mp4 --camera camera.yaml --height 1.20 -o drive/
  odograph run frames/ --timestamps frames.txt --camera camera.yaml --rig rig.toml -o drive/
  odograph run drive.mp4 --field-of-view 1.20x0.90 -o drive/
  odograph run drive.mp4 --camera camera.yaml --height 90cm --gyro gyro.csv --wheel wheel.csv
  odograph run drive.mcap --topic /camera/image_raw --height 90cm --gyro-topic /imu -o drive/
  odograph run drive/run.toml -o again/
  odograph run monday.mp4 --camera camera.yaml --height 1.20 --map hall.gpkg -o monday/
  odograph run monday.mp4 tuesday.mp4 --camera camera.yaml --height 1.20 -o week/

Ends with 0 when done, 2 on wrong usage, 3 on bad input, 4 when the movement could not be measured in most of the \
recording, 130 when interrupted by Ctrl-C (what there is has been written in both cases).";

/// A field of view on the ground: width and height in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FieldOfView(pub f64, pub f64);

pub(super) fn field_of_view(text: &str) -> std::result::Result<FieldOfView, String> {
    let sides = text
        .split_once(['x', 'X', '×'])
        .and_then(|(w, h)| Some((lengths::metres(w).ok()?, lengths::metres(h).ok()?)));
    match sides {
        Some((w, h)) if [w, h].iter().all(|v: &f64| v.is_finite() && *v > 0.0) => Ok(FieldOfView(w, h)),
        _ => Err("give width and height, as 1.20x0.90 (metres) or 120cmx90cm".to_owned()),
    }
}

/// The motion models by their names on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Motion {
    /// x, y and heading; height and tilt as far as the recording shows that they change.
    Auto,
    /// The paper's mean vector: x and y only, for comparison.
    Mean,
    /// Fixed height and tilt.
    Rigid,
    /// The height changes too.
    Similarity,
    /// Height and tilt change too: held by hand, or flying.
    Free,
}

impl From<Motion> for MotionModel {
    fn from(motion: Motion) -> Self {
        match motion {
            Motion::Auto => Self::Auto,
            Motion::Mean => Self::Mean,
            Motion::Rigid => Self::Rigid,
            Motion::Similarity => Self::Similarity,
            Motion::Free => Self::Free,
        }
    }
}

/// A readout time as it is typed, milliseconds.
pub fn readout_ms(text: &str) -> std::result::Result<f64, String> {
    let most_ms = 1e3 * odograph::camera::Camera::LONGEST_READOUT_S;
    match text.parse::<f64>() {
        Ok(milliseconds) if (0.0..=most_ms).contains(&milliseconds) => Ok(milliseconds),
        Ok(_) => Err(format!("a readout time lies between 0 (a global shutter) and {most_ms} ms")),
        Err(_) => Err("a readout time is a number of milliseconds, such as 20".to_owned()),
    }
}

impl RunArguments {
    /// A run of nothing in particular that writes to `output`; fields are set from there.
    pub fn over(output: OutputArguments) -> Self {
        Self {
            source: String::new(),
            more: Vec::new(),
            camera: None,
            height: None,
            rig: None,
            field_of_view: None,
            readout_ms: None,
            mask: None,
            motion: Motion::Auto,
            topic: None,
            timestamps: None,
            fps: None,
            start: None,
            end: None,
            every: 1,
            max_frames: None,
            budget_ms: None,
            sensors: SensorPlan::default(),
            no_loops: false,
            reference: None,
            folder: Some(output.output.clone()),
            output,
        }
    }
}

impl OutputArguments {
    /// Number of threads: three by default, for decoding, tracking and mapping.
    pub fn threads(&self) -> usize {
        self.threads.map_or(3, usize::from)
    }
}

/// Runs the command.
pub fn run(mut arguments: RunArguments) -> Result<Outcome> {
    let recordings = many::recordings(&arguments)?;
    let chosen = arguments.folder.take();
    let is_told = chosen.is_none() && !arguments.output.quiet;
    arguments.output.output =
        chosen.unwrap_or_else(|| default_folder(&arguments.source, recordings.is_some()));
    let tell_folder = || {
        if is_told {
            let folder = arguments.output.output.display();
            console::note(&format!("the results go to {folder} (-o chooses)"));
        }
    };
    if let Some(recordings) = recordings {
        tell_folder();
        return many::run(&recordings, &arguments);
    }
    let folder = OutputFolder::new(&arguments.output)?;
    let (plan, source) = RunPlan::new(&arguments)?;
    tell_folder();
    let report = follow(&plan, source, folder, &arguments.output)?;
    report.tell(&arguments.output)?;
    Ok(report.outcome())
}

/// The folder of a run over a source for which none is named: one that is not there yet.
fn default_folder(source: &str, many: bool) -> PathBuf {
    let path = Path::new(source);
    match path.parent() {
        // A repeated run goes beside the folder of the first.
        Some(first) if source.ends_with(".toml") && first.file_name().is_some() => {
            files::free_beside(&first.to_string_lossy(), "-again")
        }
        _ if many && !path.is_dir() => files::free_beside(&path.with_file_name("runs").to_string_lossy(), ""),
        _ if path.is_dir() || source.ends_with(".toml") => files::free_beside(source, "-run"),
        _ => files::free_beside(source, ""),
    }
}

/// What a run gave.
pub struct RunReport {
    pub statistics: Statistics,
    pub warnings: Vec<String>,
    pub folder: PathBuf,
    /// Where the camera was last in the map that was continued; `None` where none was, or nothing
    /// of it was recognised.
    pub place: Option<PlaceInMap>,
    /// What it looks like there, where the map was only looked into and nothing of it recognised.
    pub resemblance: Option<Resemblance>,
}

/// Follows a source by a plan and writes everything into the folder. What ends the recording early
/// is an error only after all that was computed has been written.
pub fn follow(
    plan: &RunPlan,
    source: odograph_video::Source,
    mut folder: OutputFolder,
    arguments: &OutputArguments,
) -> Result<RunReport> {
    let started = Instant::now();
    let sensors = plan.sensors.read(&plan.source.path)?;
    // What cannot be read is told before all the work.
    reference::read(plan)?;
    let description = source.info().description.clone();
    let mut plan = plan.clone();
    let tracked = track(&mut plan, source, &mut folder, arguments)?;
    finish(&plan, &description, tracked, &sensors, &mut folder, arguments, started)
}

/// Tracks the whole source. Starts again with a corrected plan if mount or lens are found to differ
/// from it.
fn track(
    plan: &mut RunPlan,
    mut source: odograph_video::Source,
    folder: &mut OutputFolder,
    arguments: &OutputArguments,
) -> Result<Tracked> {
    plan.take_lens_of(arguments.map.as_deref())?;
    let mut watch = CameraWatch::new(plan);
    watch.look_first(plan, arguments)?;
    loop {
        match pipeline::track(plan, source, folder, arguments, watch.watch(plan))? {
            Ended::Tracked(tracked) => {
                return Ok(Tracked { mount: watch.mount(), lens: watch.lens(), ..*tracked });
            }
            Ended::IsAnother(found) => {
                watch.take(*found, plan);
                folder.begin_again()?;
                source = plan.source.open()?;
            }
        }
    }
}

impl RunReport {
    /// How the run ended.
    pub fn outcome(&self) -> Outcome {
        if self.statistics.interruption().is_some() {
            return Outcome::Interrupted;
        }
        // With less than half of the frames posed the path is not the recording's path.
        if 2 * self.statistics.frames_with_pose < self.statistics.frames {
            Outcome::TrackingFailed
        } else {
            Outcome::Done
        }
    }

    /// Tells the result and where to look.
    pub fn tell(&self, arguments: &OutputArguments) -> Result<()> {
        if arguments.json {
            console::print(&format!("{}\n", self.statistics.json()?))?;
        } else if !arguments.quiet {
            let page = self.folder.join("report.html");
            console::print(&format!("{}Look at {}\n", self.statistics.summary(), page.display()))?;
        }
        if !arguments.quiet {
            for warning in &self.warnings {
                console::warn(warning);
            }
        }
        if let Some(interruption) = self.statistics.interruption().filter(|_| !arguments.quiet) {
            console::warn(&format!("{interruption}; what there is up to there has been written"));
        }
        if self.outcome() == Outcome::TrackingFailed && !arguments.quiet {
            console::error(&format!(
                "the movement could not be measured in {} of {} frames; the report says where and why",
                self.statistics.frames - self.statistics.frames_with_pose,
                self.statistics.frames
            ));
        }
        Ok(())
    }
}
