//! Runs over cameras, streams, and recordings at their own pace: frames are tracked as they come.
//!
//! Only tracking is waited for: map, mosaic, page and files get what they can carry. What there is
//! to see is in a [`Hub`], which a [`Server`](odograph_live::Server) shows in browsers; poses go to
//! a [`PoseSink`] as soon as they are known. At its end a live run writes the same folder as a run
//! over a recording.
//!
//! ```no_run
//! use odograph::error::Result;
//! use odograph_session::RunBuilder;
//! use odograph_session::live::{LiveFrame, LiveOptions, PoseSink};
//!
//! struct Robot;
//!
//! impl PoseSink for Robot {
//!     fn take(&mut self, frame: &LiveFrame<'_>) -> Result<()> {
//!         if let Some(known) = &frame.estimate.estimate {
//!             println!("{:.3} {:.3}", known.pose.x_m, known.pose.y_m);
//!         }
//!         Ok(())
//!     }
//! }
//!
//! let run = RunBuilder::new("/dev/video0").camera_file("camera.yaml").height_m(1.20);
//! run.open_live(&LiveOptions::default(), &())?.follow(Some(&mut Robot), &())?;
//! # Ok::<(), odograph::error::Error>(())
//! ```

mod capturing;
mod gnss;
mod ground;
mod latency;
mod line_source;
mod mosaic_rendering;
mod map_graph;
mod mcap;
mod page_layers;
mod pipeline;
mod recorder;
mod saved_map;
mod sensors;
mod sinks;
mod source;
mod map_frame;

pub use capturing::{FAREWELL, FRAMES_WAITING, Farewell, PATIENCE, STATUS_EVERY, capture};
pub use gnss::POSITIONS;
pub use line_source::LineSource;
pub use map_graph::{map_graph, map_markers};
pub use page_layers::show_map_of_run;
pub use recorder::folder_name_now;
pub use saved_map::save_map;
pub use sensors::SensorSources;
pub use sinks::{LiveFrame, PoseSink};
pub use source::{CaptureOptions, LiveInput, open_live_input};

use crate::builder::CameraChoice;
use crate::builder::RunBuilder;
use crate::earth::GnssRecord;
use crate::files;
use crate::finish::Ending;
use crate::folder::OutputFolder;
use crate::mapping::Mapping;
use crate::observer::Observer;
use crate::outcome::RunOutcome;
use crate::output::{RunOutput, explained};
use crate::plan::{RunPlan, SourcePlan};
use crate::recalibrated_odometry::RecalibratedOdometry;
use crate::report::RunReporter;
use gnss::{GnssReceiver, LiveGnss};
use ground::LiveGround;
use mcap::McapLog;
use odograph::error::{Error, Result};
use odograph::filter::fusion::Sensors;
use odograph::formats::camera_file;
use odograph_live::capture::{Policy, Watch, without_credentials};
use odograph_live::{Hub, Introduction};
use odograph_map::MapFile;
use odograph_video::{SourceInfo, TemporaryFolder};
use pipeline::PipelineInput;
use recorder::Recorder;
use sensors::{LiveFusion, LiveSensors};
use sinks::LiveSinks;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// What a live run needs beside what every run does.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LiveOptions {
    /// How frames are had.
    pub capture: CaptureOptions,
    /// Whether somebody can look at the [`Hub`], or set marks: the path is then kept up to date in
    /// it.
    pub shown: bool,
    /// Whether the mosaic is kept up to date in the hub as well.
    pub mosaic: bool,
    /// An MCAP file to write poses, pictures and path into.
    pub mcap: Option<PathBuf>,
    /// A satellite receiver that sends its positions during the run.
    pub gnss: Option<LineSource>,
    /// Sensors that send their readings during the run. Those of files are in the plan; such files
    /// may grow.
    pub sensors: SensorSources,
}

impl RunBuilder {
    /// Makes everything ready for a run that follows its source as frames come.
    ///
    /// # Errors
    /// As [`RunBuilder::open`]; besides, if the MCAP file is there already and may not be
    /// overwritten.
    pub fn open_live(&self, options: &LiveOptions, observer: &dyn Observer) -> Result<LiveRun> {
        // A calibration holds for one size only: that is the one to ask a camera for.
        let calibrated = || calibrated_size(self);
        let opened = self.open_live_over(options, observer, |plan, watch| {
            open_live_input(plan, &options.capture, calibrated, watch)
        });
        // The topics of a recording with several are the only list.
        opened.map_err(|error| match error.sentence_and_list().1 {
            [] => error,
            _ => error.at("a topic can be chosen for odograph run, not for live"),
        })
    }

    /// As [`RunBuilder::open_live`], over a source of the caller, which the name in the plan only
    /// describes. It ends when the watch says so.
    ///
    /// # Errors
    /// As [`RunBuilder::open_live`], or what `open` fails with.
    pub fn open_live_over(
        &self,
        options: &LiveOptions,
        observer: &dyn Observer,
        open: impl FnOnce(&SourcePlan, &Watch) -> Result<LiveInput>,
    ) -> Result<LiveRun> {
        if let Some(path) = &options.mcap {
            McapLog::check(path, self.output.folder.as_deref(), self.output.force)?;
        }
        self.check_separate(options.mcap.as_deref())?;
        let (path, temporary) = self.output.place()?;
        let folder =
            OutputFolder::new(&path, &self.output).map_err(|error| explained(error, temporary.as_ref()))?;
        let watch = Watch::default();
        let (mut plan, input) = self.plan_over(observer, |plan| {
            let input = open(plan, &watch)?;
            let size = (input.source.info().width, input.source.info().height);
            self.question_pixels(size, observer);
            Ok((input, size))
        })?;
        plan.take_lens_of(self.output.map.path())?;
        let name = plan.source.path.trim_end_matches(['/', '\\']);
        let title = match name.rsplit(['/', '\\']).next() {
            Some("-") => "standard input".to_owned(),
            last => last.unwrap_or(name).to_owned(),
        };
        // What is written and shown is for others to read.
        plan.source.path = without_credentials(&plan.source.path);
        let gnss = match &options.gnss {
            Some(_) if input.policy == Policy::Wait => {
                return Err(Error::usage(format!(
                    "positions as they come need frames as they come: give --realtime, or a file of the positions of {}",
                    plan.source.path
                )));
            }
            Some(source) => LiveGnss::Received(GnssReceiver::open(source)?),
            None => {
                let mut warnings = Vec::new();
                let record = GnssRecord::read(&plan.sensors, &plan.source.path, &mut warnings)?;
                warnings.iter().for_each(|warning| observer.warn(warning));
                LiveGnss::Recorded(record)
            }
        };
        let sensors = LiveSensors::open(&options.sensors, &plan.sensors, &plan.source.path, input.policy)?;
        let info = input.source.info().clone();
        let introduction = Introduction {
            title,
            source: info.description.clone(),
            width: info.width,
            height: info.height,
            height_m: plan.rig.height_m,
            live: true,
            recovered: false,
            calibration: false,
        };
        let ground = LiveGround::new(plan.camera.clone(), folder.path(), options.mosaic);
        let hub = Arc::new(Hub::new(introduction, Arc::new(ground.clone())));
        Ok(LiveRun {
            plan,
            info,
            input,
            watch,
            folder,
            ground,
            hub,
            shown: options.shown,
            mcap: options.mcap.clone(),
            gnss,
            sensors,
            output: self.output.clone(),
            reporter: self.reporter.clone(),
            temporary,
        })
    }
}

/// The size of the pictures for which the camera was calibrated, pixels.
fn calibrated_size(builder: &RunBuilder) -> Option<(u32, u32)> {
    let (width, height) = match builder.camera.as_ref()? {
        CameraChoice::File(path) => {
            let camera = camera_file::parse(&files::read_text(path).ok()?, None).ok()?;
            (camera.width(), camera.height())
        }
        CameraChoice::Known(camera) => (camera.width(), camera.height()),
        CameraChoice::FieldOfView(..) | CameraChoice::OfMap => return None,
    };
    Some((width as u32, height as u32))
}

/// A live run that is ready to begin. Dropped before that it leaves nothing behind.
pub struct LiveRun {
    plan: RunPlan,
    info: SourceInfo,
    input: LiveInput,
    watch: Watch,
    folder: OutputFolder,
    ground: LiveGround,
    hub: Arc<Hub>,
    shown: bool,
    mcap: Option<PathBuf>,
    gnss: LiveGnss,
    sensors: LiveSensors,
    output: RunOutput,
    reporter: Option<Arc<dyn RunReporter>>,
    /// Last, so that the folder is removed after all else is closed.
    temporary: Option<TemporaryFolder>,
}

impl fmt::Debug for LiveRun {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("LiveRun")
            .field("plan", &self.plan)
            .field("folder", &self.folder)
            .finish_non_exhaustive()
    }
}

impl LiveRun {
    /// Everything that decides what is computed.
    pub fn plan(&self) -> &RunPlan {
        &self.plan
    }

    /// What the source is.
    pub fn source(&self) -> &SourceInfo {
        &self.info
    }

    /// What there is to see, for a [`Server`](odograph_live::Server); it can also ask the run to
    /// end.
    pub fn hub(&self) -> &Arc<Hub> {
        &self.hub
    }

    /// Where the results will be.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// The map file that the run makes or continues.
    pub fn map(&self) -> PathBuf {
        self.output.map.path().map_or_else(|| self.folder().join("map.gpkg"), Path::to_owned)
    }

    /// Follows the source until it ends, or until the observer or the hub asks to stop; then writes
    /// everything into the folder.
    ///
    /// # Errors
    /// As [`Run::follow`](crate::Run::follow).
    pub fn follow(mut self, poses: Option<&mut dyn PoseSink>, observer: &dyn Observer) -> Result<RunOutcome> {
        // Removed after all else is closed.
        let temporary = self.temporary.take();
        self.followed(poses, observer).map_err(|error| explained(error, temporary.as_ref()))
    }

    fn followed(self, poses: Option<&mut dyn PoseSink>, observer: &dyn Observer) -> Result<RunOutcome> {
        let Self {
            plan,
            info,
            input,
            watch,
            folder,
            ground,
            hub,
            shown,
            mcap,
            gnss,
            sensors,
            output,
            reporter,
            ..
        } = self;
        // Of a map that is continued the lens is the map's.
        let lens_is_known = output.map.path().is_some_and(MapFile::is_there);
        let odometry = RecalibratedOdometry::online(&plan, lens_is_known)?;
        let mapping = Mapping::new(&plan, &folder, &output)?;
        let odometry = odometry.expecting(mapping.expected_mask());
        let recorder = Recorder::new(folder, &plan)?;
        let log = mcap.map(|path| McapLog::new(&path, &info.description, input.policy)).transpose()?;
        let ending = Ending {
            description: &info.description,
            sensors: &Sensors::default(),
            gnss: None,
            reference: None,
            output: &output,
            reporter: reporter.as_deref(),
            observer,
            started: Instant::now(),
        };
        let sinks = LiveSinks { poses, log: log.as_ref(), shown };
        let input = PipelineInput { frames: input, gnss, fusion: LiveFusion::new(sensors) };
        pipeline::follow(&plan, odometry, input, &watch, &ground, &hub, mapping, recorder, sinks, &ending)
    }
}
