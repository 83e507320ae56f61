//! Everything that decides the bytes of a run, in one value that is also the file `run.toml`.

use super::budget::{self, Budget};
use super::mask;
use super::{FieldOfView, RunArguments, SensorPlan};
use crate::{files, lengths};
use odograph::camera::{Camera, Rig};
use odograph::error::{Error, Result};
use odograph::formats::camera_file;
use odograph::motion::MotionModel;
use odograph::odometry::{Odometry, OdometryConfig};
use odograph::slam::SlamConfig;
use odograph_map::MapFile;
use odograph_video::{Source, SourceOptions};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What is run: the source, the camera over it, and every parameter of the pipeline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunPlan {
    /// The version of the program that made the plan.
    pub odograph: String,
    /// A path to be seen beside that of the run; it changes nothing of the run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference: Option<PathBuf>,
    pub source: SourcePlan,
    pub camera: Camera,
    pub rig: Rig,
    /// A picture of what is not ground.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<PathBuf>,
    #[serde(default, skip_serializing_if = "SensorPlan::is_empty")]
    pub sensors: SensorPlan,
    /// The budget that the parameters were chosen for, where there was one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub budget: Option<Budget>,
    pub odometry: OdometryConfig,
    #[serde(default)]
    pub slam: SlamConfig,
}

/// Which frames are taken from where.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SourcePlan {
    pub path: String,
    /// The topic with the images, of a robot recording.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub topic: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timestamps: Option<PathBuf>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fps: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub end_s: Option<f64>,
    pub every: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_frames: Option<u64>,
}

impl SourcePlan {
    pub fn open(&self) -> Result<Source> {
        let options = SourceOptions {
            timestamps: self.timestamps.clone(),
            fps: self.fps,
            start_s: self.start_s,
            end_s: self.end_s,
            every: self.every,
            max_frames: self.max_frames,
            color: true,
            topic: self.topic.clone(),
        };
        odograph_video::open(&self.path, &options)
    }
}

const HEADER: &str =
    "# Every parameter of this run. Repeat it with:  odograph run run.toml -o another-folder\n\n";

impl RunPlan {
    /// The plan of the arguments, and its opened source. A `run.toml` as the source is repeated
    /// unchanged.
    pub fn new(arguments: &RunArguments) -> Result<(Self, Source)> {
        if arguments.source.ends_with(".toml") {
            let plan = Self::read(arguments)?;
            let source = plan.source.open()?;
            return Ok((plan, source));
        }
        Self::over(arguments, |plan| {
            let source = plan.open()?;
            let size = (source.info().width, source.info().height);
            Ok((source, size))
        })
    }

    /// The plan of the arguments over a source that `open` opens; it also returns the size in
    /// pixels.
    pub fn over<S>(
        arguments: &RunArguments,
        open: impl FnOnce(&SourcePlan) -> Result<(S, (usize, usize))>,
    ) -> Result<(Self, S)> {
        // A camera or map that cannot be read is told before a source that may take long to open.
        let told = ToldCamera::by(arguments)?;
        let rig = told.rig(arguments)?;
        let source_plan = SourcePlan {
            path: arguments.source.clone(),
            topic: arguments.topic.clone(),
            timestamps: arguments.timestamps.clone(),
            fps: arguments.fps,
            start_s: arguments.start,
            end_s: arguments.end,
            every: arguments.every,
            max_frames: arguments.max_frames,
        };
        let (source, size) = open(&source_plan)?;
        let by_field = matches!(told, ToldCamera::Field(_));
        let camera = told.camera(size, rig.height_m)?;
        let camera = match arguments.readout_ms {
            Some(milliseconds) => camera.with_readout_s(Some(1e-3 * milliseconds))?,
            None => camera,
        };
        if (camera.width(), camera.height()) != size {
            return Err(Error::input(format!(
                "the frames of {} are {}x{} but the camera is calibrated for {}x{}; calibrate at the recording's size",
                arguments.source,
                size.0,
                size.1,
                camera.width(),
                camera.height(),
            )));
        }
        let mut odometry = OdometryConfig::default();
        odometry.motion.model = match MotionModel::from(arguments.motion) {
            // A tape measure does not give the lens distortion, and unmodelled distortion looks
            // like changing height and tilt.
            MotionModel::Auto if by_field => MotionModel::Rigid,
            model => model,
        };
        let budget = match arguments.budget_ms {
            Some(frame_ms) => Some(budget::fit(&mut odometry, size, frame_ms)?),
            None => None,
        };
        let plan = Self {
            odograph: env!("CARGO_PKG_VERSION").to_owned(),
            reference: arguments.reference.clone(),
            source: source_plan,
            camera,
            rig,
            mask: arguments.mask.clone(),
            sensors: arguments.sensors.clone(),
            budget,
            odometry,
            slam: SlamConfig { loops: !arguments.no_loops, ..SlamConfig::default() },
        };
        // A mask that does not fit is told before all the work.
        plan.odometry()?;
        Ok((plan, source))
    }

    /// The pipeline that follows the recording.
    pub fn odometry(&self) -> Result<Odometry> {
        let odometry = Odometry::new(self.camera.clone(), self.rig, self.odometry)?;
        match &self.mask {
            Some(path) => odometry.with_mask(&mask::read(path)?).map_err(|error| error.at(path.display())),
            None => Ok(odometry),
        }
    }

    fn read(arguments: &RunArguments) -> Result<Self> {
        let path = PathBuf::from(&arguments.source);
        let unasked = RunArguments::over(arguments.output.clone());
        let given = [
            ("--camera", arguments.camera.is_some()),
            ("--field-of-view", arguments.field_of_view.is_some()),
            ("--rig", arguments.rig.is_some()),
            ("--height", arguments.height.is_some()),
            ("--mask", arguments.mask.is_some()),
            ("--motion", arguments.motion != unasked.motion),
            ("--topic", arguments.topic.is_some()),
            ("--timestamps", arguments.timestamps.is_some()),
            ("--fps", arguments.fps.is_some()),
            ("--start", arguments.start.is_some()),
            ("--end", arguments.end.is_some()),
            ("--every", arguments.every != unasked.every),
            ("--max-frames", arguments.max_frames.is_some()),
            ("--budget-ms", arguments.budget_ms.is_some()),
            ("--gyro", arguments.sensors.gyro.is_some()),
            ("--heading", arguments.sensors.heading.is_some()),
            ("--wheel", arguments.sensors.wheel.is_some()),
            ("--range", arguments.sensors.range.is_some()),
            ("--gyro-topic", arguments.sensors.gyro_topic.is_some()),
            ("--wheel-topic", arguments.sensors.wheel_topic.is_some()),
            ("--range-topic", arguments.sensors.range_topic.is_some()),
            ("--no-loops", arguments.no_loops),
            ("--reference", arguments.reference.is_some()),
        ];
        if let Some((option, _)) = given.iter().find(|(_, given)| *given) {
            return Err(Error::usage(format!(
                "{} already says everything about the run; leave {option} away, or change the file",
                path.display()
            )));
        }
        let text = files::read_text(&path)?;
        let plan: Self = toml::from_str(&text).map_err(|error| {
            let why = error.message().replace('\n', ", ");
            Error::input(format!("{} is not the run.toml of a run: {why}", path.display()))
        })?;
        // The file is at fault, not who gave it.
        let at_fault = |error| Error::input(format!("{}: {error}", path.display()));
        plan.rig.validated().map_err(at_fault)?;
        plan.odometry.validated().map_err(at_fault)?;
        plan.slam.validated().map_err(at_fault)?;
        Ok(plan.brought_from(path.parent().unwrap_or(Path::new(""))))
    }

    /// Takes the camera of a map that is continued where it is the plan's with a lens that an
    /// earlier run has found. A run that finds a lens leaves the focal length as it is, to the bit,
    /// and no two calibrations agree in that.
    pub fn take_lens_of(&mut self, map: Option<&Path>) -> Result<()> {
        let Some(map) = map.filter(|map| MapFile::is_there(map)) else { return Ok(()) };
        let found = MapFile::open_read_only(map)?.camera().clone();
        let key = |camera: &Camera| (camera.width(), camera.height(), camera.focal_px().0);
        if key(&found) == key(&self.camera) {
            self.camera = found.with_readout_s(self.camera.readout_s())?;
        }
        Ok(())
    }

    /// The plan as the text of a `run.toml` in this folder.
    pub fn text_in(&self, folder: &Path) -> Result<String> {
        self.seen_from(folder).text()
    }

    /// The same with paths as they were typed: for the report, which is the same wherever it lies.
    pub fn text(&self) -> Result<String> {
        let body = toml::to_string(self)
            .map_err(|error| Error::output(format!("the parameters cannot be written as TOML: {error}")))?;
        Ok(format!("{HEADER}{body}"))
    }
}

/// Where the camera is told.
enum ToldCamera<'a> {
    /// The file and what is in it.
    File(&'a Path, String),
    /// The ground that it sees.
    Field(FieldOfView),
    /// That of the map that is continued.
    Map(Box<MapFile>),
    /// That which a robot recording describes, and the topic of its images.
    Recording(&'a str, Option<&'a str>),
}

impl<'a> ToldCamera<'a> {
    fn by(arguments: &'a RunArguments) -> Result<Self> {
        let map = arguments.output.map.as_deref().filter(|map| MapFile::is_there(map));
        match (&arguments.camera, arguments.field_of_view, map) {
            (Some(file), _, _) => Ok(Self::File(file, files::read_text(file)?)),
            (None, Some(field), _) => Ok(Self::Field(field)),
            (None, None, Some(map)) => Ok(Self::Map(Box::new(MapFile::open_read_only(map)?))),
            (None, None, None) if odograph_video::is_robot_recording(&arguments.source) => {
                Ok(Self::Recording(&arguments.source, arguments.topic.as_deref()))
            }
            (None, None, None) => Err(Error::usage(
                "no camera is given; give --camera FILE (and --height LENGTH), or --field-of-view WIDTHxHEIGHT in metres \
                 as measured on the ground",
            )),
        }
    }

    fn rig(&self, arguments: &RunArguments) -> Result<Rig> {
        match (&arguments.rig, arguments.height, self) {
            (Some(path), _, _) => lengths::read_rig(path, arguments.output.quiet),
            (None, Some(height), _) => {
                if !arguments.output.quiet {
                    height.question();
                }
                Rig::level(height.metres).validated()
            }
            // The field of view already gives the scale; any height gives the same path.
            (None, None, Self::Field(_)) => Ok(Rig::level(1.0)),
            (None, None, Self::Map(map)) => Ok(*map.rig()),
            (None, None, Self::File(..) | Self::Recording(..)) => Err(Error::usage(
                "the height of the camera above the ground is missing; give --height LENGTH, such as 90cm, or --rig FILE",
            )),
        }
    }

    /// The camera of images of this size, pixels.
    fn camera(self, size: (usize, usize), height_m: f64) -> Result<Camera> {
        match self {
            Self::File(path, text) => {
                camera_file::parse(&text, Some(size)).map_err(|error| error.at(path.display()))
            }
            Self::Field(field) => Camera::from_field_of_view(size, (field.0, field.1), height_m),
            Self::Map(map) => Ok(map.camera().clone()),
            Self::Recording(path, topic) => match odograph_video::recorded_camera(path, topic)? {
                Some(recorded) => Ok(recorded.camera),
                None => Err(Error::usage(format!(
                    "{path} has no camera_info of its images; give --camera FILE, or --field-of-view WIDTHxHEIGHT in \
                     metres as measured on the ground"
                ))),
            },
        }
    }
}
