//! `odograph live`: a camera, a stream, or a recording at its own pace, followed as it comes, with
//! a page in the browser.

mod address;
mod ground;
mod latency;
mod laying;
mod mcap;
pub(super) mod open;
mod outputs;
pub(super) mod pipeline;
mod recorder;
mod serving;
mod straight;

use super::run::{self, FieldOfView, Motion, OutputArguments, RunArguments, RunPlan};
use crate::lengths::{self, Height};
use crate::{Outcome, files, interrupt};
use mcap::McapLog;
use odograph::error::Result;
use odograph::formats::camera_file;
use odograph_live::capture::{Watch, without_credentials};
use odograph_live::{Introduction, Phase};
pub use open::CaptureArguments;
use outputs::Outputs;
use recorder::Recorder;
pub use serving::{Offer, ServeArguments, Serving};
use std::path::{Path, PathBuf};

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
    /// Camera file (OpenCV YAML, ROS camera_info, Kalibr, EuRoC or COLMAP).
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
    #[arg(help_heading = "Camera", long, value_name = "WxH", value_parser = run::field_of_view, conflicts_with = "camera")]
    pub field_of_view: Option<FieldOfView>,
    /// Readout time of the image in milliseconds, first row to last; 0 is a global shutter.
    ///
    /// [default: the camera file's readout_time_s; otherwise it is learned]
    #[arg(help_heading = "Camera", long, value_name = "MS", value_parser = run::readout_ms, allow_negative_numbers = true)]
    pub readout_ms: Option<f64>,
    /// Picture of what is not ground (black), of the size of the frames.
    ///
    /// Bumper, wheel, own shadow. What is found while running is ignored as well.
    #[arg(help_heading = "Camera", long, value_name = "PICTURE")]
    pub mask: Option<PathBuf>,
    /// What may change between frames.
    #[arg(help_heading = "Estimation", long, value_name = "MODEL", default_value = "auto")]
    pub motion: Motion,
    #[command(flatten)]
    pub capture: CaptureArguments,
    #[command(flatten)]
    pub serve: ServeArguments,
    /// Print a line of JSON for each frame to standard output.
    #[arg(help_heading = "Results", long, value_name = "WHAT")]
    pub print: Option<Print>,
    /// Send a line of JSON for each frame as a datagram.
    #[arg(help_heading = "Results", long, value_name = "HOST:PORT")]
    pub udp: Option<String>,
    /// Write poses, pictures and path into an MCAP file, for Foxglove and others.
    #[arg(help_heading = "Results", long, value_name = "FILE")]
    pub mcap: Option<PathBuf>,
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
}

const EXAMPLES: &str = "\
Examples:
  odograph cameras
  odograph live /dev/video0 --camera camera.yaml --height 1.20 --serve
  odograph live http://192.168.1.20:8080/video --camera phone.yaml --height 1.20 --serve -o walk/
  odograph live drive.mp4 --realtime --camera camera.yaml --height 1.20 --serve 8080
  odograph live /dev/video0 --camera camera.yaml --rig rig.toml --print poses | robot
  odograph live drive.mp4 --camera camera.yaml --height 1.20 --mcap drive.mcap -o drive/";

/// What can be printed for each frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Print {
    /// Pose, covariance and status.
    Poses,
}

impl LiveArguments {
    /// The arguments of a run over the same source into the same folder.
    fn as_run(&self) -> RunArguments {
        let output = self.output.clone().unwrap_or_else(|| PathBuf::from(recorder::folder_name_now()));
        RunArguments {
            source: self.source.clone(),
            camera: self.camera.clone(),
            height: self.height,
            rig: self.rig.clone(),
            field_of_view: self.field_of_view,
            readout_ms: self.readout_ms,
            mask: self.mask.clone(),
            motion: self.motion,
            fps: self.capture.fps,
            ..RunArguments::over(OutputArguments {
                output,
                force: self.force,
                threads: None,
                map: None,
                map_is_read_only: false,
                least_frames: 2,
                quiet: self.quiet,
                json: self.json,
            })
        }
    }
}

/// The size of the pictures for which a camera was calibrated, pixels.
fn calibrated_size(camera: &Path) -> Option<(u32, u32)> {
    let camera = camera_file::parse(&files::read_text(camera).ok()?, None).ok()?;
    Some((camera.width() as u32, camera.height() as u32))
}

/// Runs the command.
pub fn live(arguments: LiveArguments) -> Result<Outcome> {
    let run_arguments = arguments.as_run();
    let outputs = Outputs::new(&arguments)?;
    arguments.mcap.as_deref().map_or(Ok(()), |path| McapLog::check(path, arguments.force))?;
    let folder = run::folder::OutputFolder::new(&run_arguments.output)?;
    let watch = Watch::default();
    let (mut plan, source) = RunPlan::over(&run_arguments, |plan| {
        // A calibration holds for one size only: that is the one to ask a camera for.
        let calibrated = || calibrated_size(arguments.camera.as_deref()?);
        let source = open::open(plan, &arguments.capture, calibrated, &watch)?;
        let size = (source.source.info().width, source.source.info().height);
        Ok((source, size))
    })?;
    plan.take_lens_of(run_arguments.output.map.as_deref())?;
    // What is written and shown is for others to read.
    plan.source.path = without_credentials(&plan.source.path);
    let info = source.source.info().clone();
    let name = arguments.source.trim_end_matches(['/', '\\']);
    let introduction = Introduction {
        title: match name.rsplit(['/', '\\']).next() {
            Some("-") => "standard input".to_owned(),
            last => last.unwrap_or(name).to_owned(),
        },
        source: info.description.clone(),
        width: info.width,
        height: info.height,
        height_m: plan.rig.height_m,
        live: true,
        calibration: false,
    };
    let laying = ground::LiveGround::new(plan.camera.clone(), folder.path(), arguments.serve.serve.is_some());
    let serving =
        Serving::start(&arguments.serve, introduction, laying.clone(), Offer::of_run(folder.path()))?;
    if !arguments.quiet {
        serving.tell_where("");
    }
    let mapping = run::mapping::Mapping::new(&plan, &folder, &run_arguments.output)?;
    let recorder = Recorder::new(folder, &plan)?;
    let log = McapLog::new(&arguments, &info.description, source.policy)?;
    let result = pipeline::follow(
        &plan,
        source,
        &watch,
        &laying,
        serving.hub(),
        &run_arguments.output,
        mapping,
        recorder,
        outputs,
        log.as_ref(),
    );
    serving.set_phase(if result.is_ok() { Phase::Saved } else { Phase::Failed }, result.as_ref().err());
    let report = match result {
        Ok(report) => report,
        Err(error) => {
            // The page still shows what there was, and why it ended.
            if !interrupt::asked() {
                serving.linger(arguments.quiet);
            }
            return Err(error);
        }
    };
    if arguments.print.is_none() {
        report.tell(&run_arguments.output)?;
    }
    if !interrupt::asked() {
        serving.linger(arguments.quiet);
    }
    Ok(report.outcome())
}
