//! `odograph run`: a recording goes in, a folder with a trajectory and a map comes out.

mod console_observer;
mod many;
mod markers;
mod mounted_camera;
mod sensors;
mod summary;

use super::frame_selection::FrameTimes;
use super::site::SiteLinkArguments;
use crate::browser::OpeningBrowser;
use crate::{Outcome, console, files};
use console_observer::Progress;
pub use console_observer::{ConsoleObserver, LogArguments};
pub use markers::MarkerArguments;
pub use mounted_camera::{
    CameraSetup, FieldOfView, Motion, MountedCameraArguments, PoseFrameName, ProfileChoice,
};
use odograph::error::{Error, Result};
use odograph_report::HtmlReporter;
use odograph_session::batch::Shard;
use odograph_session::{MapUse, RunBuilder, RunEnd, SourcePlan};
pub use sensors::SensorArguments;
use std::path::{Path, PathBuf};
pub use summary::{losses, print_summary, tell_warnings};

/// Follow a recording: trajectory, map, mosaic of the ground, report.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct RunArguments {
    /// A video, a folder of pictures, a robot recording, `-` for Y4M, or an earlier run.toml.
    ///
    /// Robot recordings are MCAP files, ROS 1 bags, and rosbag2 folders and databases; `-` is
    /// standard input.
    #[arg(value_name = "SOURCE", required_unless_present = "resume")]
    pub source: Option<String>,
    /// More recordings of the same camera, or one folder of videos as SOURCE.
    ///
    /// Each gets a folder of its own in -o; as many run at a time as there are cores.
    #[arg(value_name = "MORE")]
    pub more: Vec<String>,
    #[command(flatten)]
    pub mounted: MountedCameraArguments,
    /// Topic with the images, where a robot recording (MCAP, ROS bag) has several.
    #[arg(help_heading = "Recording", long, value_name = "NAME")]
    pub topic: Option<String>,
    #[command(flatten)]
    pub times: FrameTimes,
    /// Begin this many seconds after the first frame.
    #[arg(help_heading = "Recording", long, value_name = "SECONDS", allow_negative_numbers = true)]
    pub start: Option<f64>,
    /// End this many seconds after the first frame.
    #[arg(help_heading = "Recording", long, value_name = "SECONDS", allow_negative_numbers = true)]
    pub end: Option<f64>,
    /// Take every n-th frame.
    #[arg(help_heading = "Recording", long, value_name = "N", default_value_t = 1)]
    pub every: u64,
    /// Take at most this many frames.
    #[arg(help_heading = "Recording", long, value_name = "N")]
    pub max_frames: Option<u64>,
    /// Time that a frame may take, milliseconds; fewer corners are followed if needed.
    ///
    /// Measures the machine once. run.toml and stats.json say what was given up.
    #[arg(help_heading = "Estimation", long, value_name = "MS", allow_negative_numbers = true)]
    pub budget_ms: Option<f64>,
    #[command(flatten)]
    pub sensors: SensorArguments,
    #[command(flatten)]
    pub markers: MarkerArguments,
    /// Do not look for ground that was seen before: the path is what odometry alone has.
    #[arg(help_heading = "Estimation", long, conflicts_with = "markers")]
    pub no_loops: bool,
    /// A path from elsewhere (TUM) to show beside that of the run in the report.
    ///
    /// Such as a satellite receiver's, or the truth: lines of time x y z qx qy qz qw, times as
    /// the frames'. It is aligned by rotation, shift and scale; nothing else is made of it.
    #[arg(help_heading = "Estimation", long, value_name = "FILE")]
    pub reference: Option<PathBuf>,
    /// The same from a topic of the robot recording: PoseStamped, Odometry, TransformStamped or tf.
    #[arg(help_heading = "Estimation", long, value_name = "NAME", conflicts_with = "reference")]
    pub reference_topic: Option<String>,
    /// Folder for the results.
    ///
    /// [default: beside the recording, with its name: drive/ for drive.mp4, frames-run/ for the
    /// folder frames/; with a number where that is there already]
    #[arg(help_heading = "Results", short = 'o', long = "output", value_name = "FOLDER")]
    pub folder: Option<PathBuf>,
    /// Run again what was killed in FOLDER; without FOLDER, the recordings that are not done.
    ///
    /// With FOLDER: that run from its first frame to its end, with the options that it was begun
    /// with. A run gives the same bytes each time, so nothing is lost but the time. What a killed
    /// run has added to a map of --map is replaced. Without: all recordings in SOURCE and its
    /// folders are run, each into a folder of its own in -o; those that were run with the same
    /// options are skipped.
    #[arg(help_heading = "Results", long, value_name = "FOLDER", num_args = 0..=1)]
    pub resume: Option<Option<PathBuf>>,
    /// Run only this part of the recordings: 0/64, 1/64, … or 63/64.
    ///
    /// All recordings in SOURCE and its folders are counted, and each has a folder of its own in
    /// -o, which all parts share.
    #[arg(help_heading = "Results", long, value_name = "I/N")]
    pub shard: Option<Shard>,
    /// Begin a recording again this often that failed, or whose worker was killed.
    ///
    /// [default: 1 with --resume or --shard, otherwise 0]
    #[arg(help_heading = "Results", long, value_name = "N")]
    pub retries: Option<u32>,
    /// How progress is shown on standard error.
    ///
    /// A line of JSON every 30 frames: {"frames":30,"lost":0,"of":1083}. `of` is null where the
    /// number of frames is not known, as while the beginning of a recording is examined before a
    /// map is continued; the count begins again where tracking does.
    #[arg(help_heading = "Results", long, value_name = "FORM", default_value = "bar")]
    pub progress: Progress,
    /// Write poses, transforms and diagnostics as ROS 2 messages into an MCAP file.
    ///
    /// /odometry (nav_msgs/Odometry with the covariance), /tf (map, odom, and base_link or camera),
    /// /tf_static and /diagnostics, for `ros2 bag play` and others.
    #[arg(help_heading = "Results", long, value_name = "FILE")]
    pub bag_out: Option<PathBuf>,
    /// Write a video of the drive: corners, status, speed, path so far (.avi).
    ///
    /// Motion JPEG in AVI. Every frame as it was tracked, before loop closures and other sensors,
    /// with the reason where it was lost. Results do not depend on it.
    #[arg(help_heading = "Results", long, value_name = "FILE")]
    pub video_out: Option<PathBuf>,
    /// Open the report in the browser of this machine at the end.
    #[arg(help_heading = "Results", long)]
    pub open: bool,
    #[command(flatten)]
    pub site: SiteLinkArguments,
    #[command(flatten)]
    pub output: OutputArguments,
    #[command(flatten)]
    pub log: LogArguments,
}

/// Options of output and verbosity, common to all commands that track.
#[derive(Debug, Clone, clap::Args)]
pub struct OutputArguments {
    /// Overwrite results that are already there.
    #[arg(help_heading = "Results", long)]
    pub force: bool,
    /// Map file: continued where it exists, otherwise begun.
    ///
    /// [default: a new map.gpkg in the folder]
    #[arg(help_heading = "Results", long, value_name = "FILE")]
    pub map: Option<PathBuf>,
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
  odograph run drive.mcap --height 90cm --bag-out poses.mcap -o drive/
  odograph run drive.mp4 --camera camera.yaml --height 1.20 --video-out drive.avi -o drive/
  odograph run drive.mp4 --profile cart --markers apriltag:36h11:80mm --control hall.csv -o drive/
  odograph run drive/run.toml -o again/
  odograph run --resume drive/
  odograph run monday.mp4 --camera camera.yaml --height 1.20 --map hall.gpkg -o monday/
  odograph run monday.mp4 tuesday.mp4 --camera camera.yaml --height 1.20 -o week/
  odograph run recordings/ --camera camera.yaml --height 1.20 -o results/ --shard 3/64 --resume
  odograph run drive.mp4 --camera camera.yaml --height 1.20 --site http://hall:8137/ --robot cart-2

Ends with 0 when done, 2 on wrong usage, 3 on bad input, 4 when the movement could not be measured in most of the \
recording, 130 when interrupted by Ctrl-C (what there is has been written in both cases).";

impl RunArguments {
    /// The source; empty where a killed run is run again.
    fn source(&self) -> &str {
        self.source.as_deref().unwrap_or_default()
    }

    /// Whether other calls may share the results folder.
    fn is_shared(&self) -> bool {
        self.shard.is_some() || self.resume == Some(None)
    }

    /// The killed run in a folder, from its first frame.
    fn resumed(&self, folder: &Path) -> Result<RunBuilder> {
        if let Some(source) = &self.source {
            return Err(Error::usage(format!(
                "--resume {} runs again what was begun there, without {source}; to finish several recordings, give \
                 --resume after them",
                folder.display()
            )));
        }
        let given = [
            ("-o", self.folder.is_some()),
            ("--shard", self.shard.is_some()),
            ("--retries", self.retries.is_some()),
            ("--map", self.output.map.is_some()),
            ("--bag-out", self.bag_out.is_some()),
            ("--video-out", self.video_out.is_some()),
            ("--force", self.output.force),
        ];
        let given = self.settings().into_iter().chain(given).find(|(_, given)| *given);
        if let Some((option, _)) = given {
            return Err(Error::usage(format!(
                "--resume runs what was begun in {} as it was begun; leave {option} away",
                folder.display()
            )));
        }
        let run = RunBuilder::resuming(folder)?.reporter(HtmlReporter);
        Ok(self.output.threads.iter().fold(run, |run, threads| run.threads(usize::from(*threads))))
    }

    /// The run with these options, over `source` into `folder`.
    fn builder(&self, source: &str, folder: &Path) -> Result<RunBuilder> {
        let run = if source.ends_with(".toml") {
            self.check_repeated(source)?;
            RunBuilder::repeating(source)
        } else {
            self.fresh(source)
        };
        let run = run.folder(folder).overwriting(self.output.force).reporter(HtmlReporter);
        let run = self.site.robot.iter().fold(run, RunBuilder::robot);
        let run = self.bag_out.iter().fold(run, RunBuilder::bag);
        let run = self.video_out.iter().fold(run, RunBuilder::video);
        let run = self.output.map.iter().fold(run, |run, map| run.map(MapUse::Continue(map.clone())));
        Ok(self.output.threads.iter().fold(run, |run, threads| run.threads(usize::from(*threads))))
    }

    /// The run over a recording.
    fn fresh(&self, source: &str) -> RunBuilder {
        let source = SourcePlan {
            topic: self.topic.clone(),
            timestamps: self.times.timestamps.clone(),
            fps: self.times.fps,
            start_s: self.start,
            end_s: self.end,
            every: self.every,
            max_frames: self.max_frames,
            ..SourcePlan::new(source)
        };
        let run = RunBuilder::over(source).sensors(self.sensors.files());
        let run = self.mounted.of_run(run);
        let run = self.budget_ms.iter().fold(run, |run, budget_ms| run.budget_ms(*budget_ms));
        let run = self.reference.iter().fold(run, RunBuilder::reference);
        let run = self.reference_topic.iter().fold(run, RunBuilder::reference_topic);
        let run = self.markers.of_run(run);
        if self.no_loops { run.without_loops() } else { run }
    }

    /// Fails where an option contradicts the `run.toml` of an earlier run.
    fn check_repeated(&self, run_toml: &str) -> Result<()> {
        match self.settings().iter().find(|(_, given)| *given) {
            Some((option, _)) => Err(Error::usage(format!(
                "{run_toml} already says everything about the run; leave {option} away, or change the file"
            ))),
            None => Ok(()),
        }
    }

    /// The options that determine the results, and whether they are given.
    fn settings(&self) -> [(&'static str, bool); 32] {
        let setup = &self.mounted.setup;
        [
            ("--profile", self.mounted.chosen.profile.is_some()),
            ("--camera", setup.camera.is_some()),
            ("--field-of-view", setup.field_of_view.is_some()),
            ("--rig", setup.rig.is_some()),
            ("--height", setup.height.is_some()),
            ("--frame", self.mounted.frame.is_some()),
            ("--readout-ms", setup.readout_ms.is_some()),
            ("--mask", setup.mask.is_some()),
            ("--motion", self.mounted.motion != Motion::Auto),
            ("--topic", self.topic.is_some()),
            ("--timestamps", self.times.timestamps.is_some()),
            ("--fps", self.times.fps.is_some()),
            ("--start", self.start.is_some()),
            ("--end", self.end.is_some()),
            ("--every", self.every != 1),
            ("--max-frames", self.max_frames.is_some()),
            ("--budget-ms", self.budget_ms.is_some()),
            ("--gyro", self.sensors.gyro.is_some()),
            ("--heading", self.sensors.heading.is_some()),
            ("--wheel", self.sensors.wheel.is_some()),
            ("--range", self.sensors.range.is_some()),
            ("--gyro-topic", self.sensors.gyro_topic.is_some()),
            ("--wheel-topic", self.sensors.wheel_topic.is_some()),
            ("--range-topic", self.sensors.range_topic.is_some()),
            ("--gnss", self.sensors.gnss.is_some()),
            ("--gnss-topic", self.sensors.gnss_topic.is_some()),
            ("--gnss-start", self.sensors.gnss_start.is_some()),
            ("--markers", self.markers.markers.is_some()),
            ("--control", self.markers.control.is_some()),
            ("--no-loops", self.no_loops),
            ("--reference", self.reference.is_some()),
            ("--reference-topic", self.reference_topic.is_some()),
        ]
    }
}

/// Runs the command.
pub fn run(arguments: RunArguments) -> Result<Outcome> {
    if let Some(Some(folder)) = &arguments.resume {
        let builder = arguments.resumed(folder)?;
        let print_begin = || {
            if !arguments.output.quiet {
                console::note(&format!("the run in {} begins again at its first frame", folder.display()));
            }
        };
        let site = arguments.site.of_resumed(builder.robot_name(), folder)?;
        return follow(&builder, &RunArguments { site, ..arguments.clone() }, folder, &print_begin);
    }
    if arguments.source.is_none() {
        return Err(Error::usage(
            "--resume needs the folder of a run that was killed, or recordings before it and -o FOLDER",
        ));
    }
    arguments.site.check()?;
    let arguments = match arguments.source().ends_with(".toml") {
        true => arguments,
        false => RunArguments { mounted: arguments.mounted.with_profile()?, ..arguments },
    };
    let recordings = many::recordings(&arguments)?;
    let folder = match &arguments.folder {
        Some(folder) => folder.clone(),
        None => default_folder(arguments.source(), recordings.is_some()),
    };
    let quiet = arguments.output.quiet;
    let print_folder = || {
        if arguments.folder.is_none() && !quiet {
            console::note(&format!("the results go to {} (-o chooses)", folder.display()));
        }
    };
    for (option, file, what) in
        [("--bag-out", &arguments.bag_out, "bag"), ("--video-out", &arguments.video_out, "video")]
    {
        if file.as_deref() == Some(folder.as_path()) {
            return Err(Error::usage(format!(
                "{} cannot be the {what} and the folder of the results; give {option} the name of a file",
                folder.display()
            )));
        }
    }
    if let Some(recordings) = recordings {
        print_folder();
        let outcome = many::run(&recordings, &arguments, &folder);
        if arguments.open && outcome.is_ok() {
            OpeningBrowser::at(folder.join("results.html")).wait();
        }
        return outcome;
    }
    let builder = arguments.builder(arguments.source(), &folder)?;
    arguments.mounted.setup.question(quiet);
    follow(&builder, &arguments, &folder, &print_folder)
}

/// Follows one recording; `opened` is called when nothing stands against that any more.
fn follow(
    builder: &RunBuilder,
    arguments: &RunArguments,
    folder: &Path,
    opened: &dyn Fn(),
) -> Result<Outcome> {
    let quiet = arguments.output.quiet;
    let observer = ConsoleObserver::new(quiet).with_progress(arguments.progress).with_log(arguments.log);
    let run = builder.open(&observer)?;
    opened();
    observer.log_plan(run.plan(), run.source());
    let outcome = run.follow(&observer)?;
    observer.log_times(&outcome.statistics);
    print_summary(&outcome, quiet, arguments.output.json)?;
    if outcome.end == RunEnd::TrackingFailed && arguments.mounted.setup.field_of_view.is_some() && !quiet {
        console::note(
            "--field-of-view takes the lens as free of distortion, which may be the reason; odograph calibrate \
             measures the lens",
        );
    }
    let browser = arguments.open.then(|| OpeningBrowser::at(folder.join("report.html")));
    let map = builder.map_file().map_or_else(|| folder.join("map.gpkg"), Path::to_owned);
    if let Some(link) = arguments.site.start(&map, folder, quiet)? {
        link.finish(quiet);
    }
    if let Some(browser) = browser {
        browser.wait();
    }
    Ok(outcome.end.into())
}

/// Default output folder of a run: one that does not exist yet.
fn default_folder(source: &str, many: bool) -> PathBuf {
    let path = Path::new(source);
    match path.parent() {
        // A repeated run has its folder next to that of the first.
        Some(first) if source.ends_with(".toml") && first.file_name().is_some() => {
            files::free_beside(&first.to_string_lossy(), "-again")
        }
        _ if many && !path.is_dir() => files::free_beside(&path.with_file_name("runs").to_string_lossy(), ""),
        _ if path.is_dir() || source.ends_with(".toml") => files::free_beside(source, "-run"),
        _ => files::free_beside(source, ""),
    }
}
