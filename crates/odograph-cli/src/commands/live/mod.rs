//! `odograph live`: a camera, a stream, or a recording at its own pace, followed as it comes, with
//! a page in the browser.

mod capture_arguments;
mod outputs;
mod ros2;
mod sensor_arguments;
mod serving;

use super::run::{
    ConsoleObserver, LogArguments, MarkerArguments, MountedCameraArguments, print_summary, tell_warnings,
};
use super::site::SiteLinkArguments;
use crate::Outcome;
pub use capture_arguments::CaptureArguments;
use odograph::error::Result;
use odograph_live::Phase;
use odograph_report::HtmlReporter;
use odograph_session::live::{LiveOptions, folder_name_now};
use odograph_session::{MapUse, RunBuilder, SourcePlan};
use outputs::Outputs;
use ros2::{Ros2Arguments, Ros2Run};
use sensor_arguments::{LiveSensorArguments, NamedSensors};
pub use serving::{Offer, ServeArguments, Serving};
use std::path::PathBuf;
use std::sync::Arc;

/// Follow a camera as it moves, with a page in the browser.
///
/// Takes a camera (/dev/video0), a phone or network camera (http://… Motion JPEG, rtsp://…), frames
/// on standard input (-), and every recording that `run` takes. Writes the same folder as `run`
/// when it ends: at Ctrl-C, at the page's button, or with the source.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct LiveArguments {
    /// A camera (/dev/video0), an address (http://…, rtsp://…), `-`, or a recording.
    ///
    /// `-` is Y4M on standard input.
    #[arg(value_name = "SOURCE")]
    pub source: String,
    #[command(flatten)]
    pub mounted: MountedCameraArguments,
    #[command(flatten)]
    pub capture: CaptureArguments,
    #[command(flatten)]
    pub markers: MarkerArguments,
    #[command(flatten)]
    pub sensors: LiveSensorArguments,
    #[command(flatten)]
    pub ros2: Ros2Arguments,
    #[command(flatten)]
    pub serve: ServeArguments,
    /// Print a line of JSON for each frame to standard output.
    #[arg(help_heading = "Results", long, value_name = "WHAT", conflicts_with = "json")]
    pub print: Option<Print>,
    /// Send a line of JSON for each frame as a datagram.
    #[arg(help_heading = "Results", long, value_name = "HOST:PORT")]
    pub udp: Option<String>,
    /// Write poses, pictures and path into an MCAP file, for Foxglove and others.
    #[arg(help_heading = "Results", long, value_name = "FILE")]
    pub mcap: Option<PathBuf>,
    #[command(flatten)]
    pub site: SiteLinkArguments,
    /// Map file: continued where it exists, otherwise begun.
    ///
    /// Poses are in its frame as soon as its ground is recognised. [default: a new map.gpkg in the
    /// folder]
    #[arg(help_heading = "Results", long, value_name = "FILE")]
    pub map: Option<PathBuf>,
    /// Folder for the results. [default: live- and the date and time]
    #[arg(help_heading = "Results", short, long, value_name = "FOLDER")]
    pub output: Option<PathBuf>,
    /// Overwrite results that are already there.
    #[arg(help_heading = "Results", long)]
    pub force: bool,
    /// Say nothing but errors.
    #[arg(help_heading = "Results", short, long)]
    pub quiet: bool,
    /// Print stats.json to standard output instead of a summary.
    #[arg(help_heading = "Results", long)]
    pub json: bool,
    #[command(flatten)]
    pub log: LogArguments,
}

const EXAMPLES: &str = "\
Examples:
  odograph cameras
  odograph live /dev/video0 --camera camera.yaml --height 1.20 --serve
  odograph live http://192.168.1.20:8080/video --camera phone.yaml --height 1.20 --serve -o walk/
  odograph live drive.mp4 --realtime --camera camera.yaml --height 1.20 --serve 8080
  odograph live /dev/video0 --camera camera.yaml --rig rig.toml --print poses | robot
  odograph live drive.mp4 --camera camera.yaml --height 1.20 --mcap drive.mcap -o drive/
  odograph live /dev/video0 --camera camera.yaml --height 1.20 --map hall.gpkg --print poses | robot
  odograph live /dev/video0 --camera camera.yaml --height 1.20 --gnss /dev/ttyACM0 -o field/
  odograph live /dev/video0 --camera camera.yaml --rig rig.toml --gyro udp:9001 --wheel udp:9001
  odograph live /dev/video0 --camera camera.yaml --height 1.20 --site http://hall:8137/ --robot cart";

/// Formats of the line printed for each frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Print {
    /// Pose, covariance and status.
    Poses,
}

impl LiveArguments {
    /// The run with these options, but for the sensors.
    fn builder(&self) -> RunBuilder {
        let folder = self.output.clone().unwrap_or_else(|| PathBuf::from(folder_name_now()));
        let source = SourcePlan { fps: self.capture.fps, ..SourcePlan::new(&self.source) };
        let run = RunBuilder::over(source).folder(folder).overwriting(self.force).reporter(HtmlReporter);
        let run = self.site.robot.iter().fold(run, RunBuilder::robot);
        let run = self.map.iter().fold(run, |run, map| run.map(MapUse::Continue(map.clone())));
        self.markers.of_run(self.mounted.of_run(run))
    }
}

/// Runs the command.
pub fn live(arguments: LiveArguments) -> Result<Outcome> {
    let arguments = LiveArguments { mounted: arguments.mounted.with_profile()?, ..arguments };
    arguments.site.check()?;
    arguments.serve.check()?;
    let mut outputs = Outputs::new(&arguments)?;
    arguments.mounted.setup.question(arguments.quiet);
    let observer = ConsoleObserver::without_progress(arguments.quiet).with_log(arguments.log);
    let NamedSensors { files, received, gnss } = arguments.sensors.named(&arguments.source)?;
    let options = LiveOptions {
        capture: arguments.capture.options(),
        shown: arguments.serve.serve.is_some() || arguments.ros2.publishes(),
        mosaic: arguments.serve.serve.is_some() || arguments.ros2.publishes_ground(),
        mcap: arguments.mcap.clone(),
        gnss,
        sensors: received,
    };
    let run = match Ros2Run::of(&arguments, &files)? {
        Some(ros2) => ros2.open(arguments.builder(), &options, &observer, &mut outputs)?,
        None => arguments.builder().sensors(files).open_live(&options, &observer)?,
    };
    let link = arguments.site.start(&run.map(), run.folder(), arguments.quiet)?;
    outputs.tell_losses_to(link.clone());
    let serving = Serving::start(&arguments.serve, Arc::clone(run.hub()), Offer::of_run(run.folder()))?;
    serving.show_address("", arguments.quiet);
    observer.log_plan(run.plan(), run.source());
    let result = run.follow(Some(&mut outputs), &observer);
    serving.set_phase(if result.is_ok() { Phase::Saved } else { Phase::Failed }, result.as_ref().err());
    // The page still shows the last state, and the error.
    let outcome = result.inspect_err(|_| serving.linger(arguments.quiet))?;
    observer.log_times(&outcome.statistics);
    drop(outputs);
    if arguments.print.is_none() {
        print_summary(&outcome, arguments.quiet, arguments.json)?;
    } else if !arguments.quiet {
        tell_warnings(&outcome, "");
    }
    // The results are on disk: what the site does changes nothing of them.
    if let Some(link) = link {
        link.finish(arguments.quiet);
    }
    serving.linger(arguments.quiet);
    Ok(outcome.end.into())
}
