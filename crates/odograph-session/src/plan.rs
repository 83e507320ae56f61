//! Everything that determines the bytes of a run, in one value that is also the file `run.toml`.

use crate::budget::Budget;
use crate::sensors::SensorFiles;
use crate::{files, mask};
use odograph::camera::{CalibrationDeviations, Camera, LeverArm, Rig};
use odograph::error::{Error, Result};
use odograph::formats::rig_file;
use odograph::loop_closure::LoopClosureConfig;
use odograph::odometry::{EarlierPass, Odometry, OdometryConfig};
use odograph::pose_frame::{BaseLink, PoseFrame};
use odograph_map::MapFile;
use odograph_video::{Source, SourceOptions};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Source, camera and all parameters of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunPlan {
    /// The version of the program that made the plan.
    pub odograph: String,
    /// Reference trajectory for the report; it changes no result.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference: Option<PathBuf>,
    /// The topic of the recording that has it, where no file does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference_topic: Option<String>,
    /// Which frames are taken from where.
    pub source: SourcePlan,
    /// The camera.
    pub camera: Camera,
    /// The mount above the ground.
    pub rig: Rig,
    /// Standard deviations of camera and mount, where their files have them.
    #[serde(default, skip_serializing_if = "CalibrationDeviations::is_unknown")]
    pub deviations: CalibrationDeviations,
    /// The frame whose poses are written; by default the robot's if the rig has a lever arm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<FrameChoice>,
    /// The antenna of the satellite receiver, in `base_link`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub antenna: Option<LeverArm>,
    /// Mask of what is not ground.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<PathBuf>,
    /// Markers on the ground.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub markers: Option<MarkerPlan>,
    /// What an earlier pass over the same frames has found.
    #[serde(skip)]
    pub images: EarlierPass,
    #[serde(default, skip_serializing_if = "SensorFiles::is_empty")]
    /// The other sensors.
    pub sensors: SensorFiles,
    /// The budget that the parameters were chosen for, where there was one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub budget: Option<Budget>,
    /// The parameters of odometry.
    pub odometry: OdometryConfig,
    /// The parameters of the map.
    #[serde(default)]
    pub slam: LoopClosureConfig,
}

/// Markers on the ground that are looked for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MarkerPlan {
    /// Family and side, as [`odograph_calibration::MarkerFamily`] reads them.
    pub family: String,
    /// Control points: the surveyed places of markers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub control: Option<PathBuf>,
}

/// Whose poses a run writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameChoice {
    /// The robot's: `base_link` of ROS REP-105. The rig must have a lever arm.
    BaseLink,
    /// The camera's.
    Camera,
}

/// Which frames are taken from where.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SourcePlan {
    /// A file, a folder of pictures, an address, or `-` for Y4M on standard input.
    pub path: String,
    /// The topic with the images, of a robot recording.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub topic: Option<String>,
    /// A file with the times of the frames.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timestamps: Option<PathBuf>,
    /// Frames per second, where the source does not state it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fps: Option<f64>,
    /// Time of the first frame after the source's first, seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start_s: Option<f64>,
    /// Largest time of the last frame after the source's first, seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub end_s: Option<f64>,
    /// Every n-th frame is used.
    pub every: u64,
    /// Largest number of frames.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_frames: Option<u64>,
}

impl SourcePlan {
    /// All frames of a source.
    pub fn new(path: impl Into<String>) -> Self {
        Self {
            path: path.into(),
            topic: None,
            timestamps: None,
            fps: None,
            start_s: None,
            end_s: None,
            every: 1,
            max_frames: None,
        }
    }

    /// Whether every frame of the source is used.
    pub fn is_whole(&self) -> bool {
        let is_cut = self.start_s.is_some() || self.end_s.is_some() || self.max_frames.is_some();
        !is_cut && self.every <= 1
    }

    /// Whether the source can be read again: a file or folder, and no pipe.
    pub fn is_readable_again(&self) -> bool {
        // A folder of that name is `./-`.
        self.path != "-" && std::fs::metadata(&self.path).is_ok_and(|there| there.is_file() || there.is_dir())
    }

    /// Opens the source.
    ///
    /// # Errors
    /// If it cannot be read, or the plan does not fit it.
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
        open_recording(&self.path, &options)
    }
}

/// Opens a recording, unless it is the folder of a run.
///
/// # Errors
/// As [`odograph_video::open`] and [`check_recording`].
pub fn open_recording(source: impl AsRef<Path>, options: &SourceOptions) -> Result<Source> {
    check_recording(source.as_ref())?;
    odograph_video::open(source, options)
}

/// Refuses the folder of a run, whose drawings would be taken for frames.
///
/// # Errors
/// If the folder has the path of a run beside its parameters.
pub fn check_recording(source: &Path) -> Result<()> {
    let parameters = source.join("run.toml");
    // Of a killed run.
    if files::beside(&parameters).is_file() {
        return Err(Error::input(format!(
            "{0} is the folder of a run that did not end, not of a recording; give its recording, run it to its end with \
             odograph run --resume {0}, or look at it with odograph view {0}",
            source.display()
        )));
    }
    if !(parameters.is_file() && source.join("trajectory.csv").is_file()) {
        return Ok(());
    }
    let recording = RunPlan::read(&parameters).ok().map(|plan| plan.source.path);
    let give = match recording.filter(|recording| recording != "-") {
        Some(recording) => format!("give its recording, {recording}"),
        None => "give its recording".to_owned(),
    };
    Err(Error::input(format!(
        "{0} is the folder of a run, not of a recording; {give}, or look at it with odograph view {0}",
        source.display()
    )))
}

const HEADER: &str =
    "# Every parameter of this run. Repeat it with:  odograph run run.toml -o another-folder\n\n";

impl RunPlan {
    /// The frame whose poses are written.
    ///
    /// # Errors
    /// If it is the robot's and the rig has no lever arm.
    pub fn pose_frame(&self) -> Result<PoseFrame> {
        match (self.frame, BaseLink::of(&self.rig)) {
            (None | Some(FrameChoice::BaseLink), Some(base)) => Ok(PoseFrame::BaseLink(base)),
            (Some(FrameChoice::BaseLink), None) => Err(Error::usage(
                "where the camera is on the robot is not known: the poses of base_link need a rig file (--rig) with x_m, \
                 y_m and z_m of the camera",
            )),
            (None | Some(FrameChoice::Camera), _) => Ok(PoseFrame::Camera),
        }
    }

    /// The odometry that tracks the recording.
    ///
    /// # Errors
    /// If a parameter is out of range, or the mask cannot be read or does not fit.
    pub fn odometry(&self) -> Result<Odometry> {
        let odometry = Odometry::new(self.camera.clone(), self.rig, self.odometry)?;
        let mut odometry = odometry.with_deviations(&self.deviations);
        if let Some(path) = &self.mask {
            odometry = odometry.with_mask(&mask::read(path)?).map_err(|error| error.at(path.display()))?;
        }
        Ok(odometry.with_earlier_pass(&self.images))
    }

    /// Reads the `run.toml` of an earlier run; paths in it are brought into the working directory.
    ///
    /// # Errors
    /// If the file cannot be read, is not a `run.toml`, or has values out of range.
    pub fn read(path: &Path) -> Result<Self> {
        let text = files::read_text(path)?;
        let plan: Self = toml::from_str(&text).map_err(|error| {
            let shown = path.display();
            if rig_file::parse(&text).is_ok() {
                return Error::input(format!(
                    "{shown} is a rig file, not the run.toml of a run; give it with --rig, beside a recording"
                ));
            }
            let why = error.message().replace('\n', ", ");
            // The list of all names in a run.toml says nothing of another file.
            let why = why.split(", expected one of").next().unwrap_or_default();
            Error::input(format!("{shown} is not the run.toml of a run: {why}")).caused_by(error)
        })?;
        Ok(plan.validated(path)?.brought_from(path.parent().unwrap_or(Path::new(""))))
    }

    /// The plan, if its values are in range. The error names the file that it is from.
    pub(crate) fn validated(self, path: &Path) -> Result<Self> {
        let at_fault = |error: Error| Error::input(format!("{}: {error}", path.display())).caused_by(error);
        self.rig.validated().map_err(at_fault)?;
        self.odometry.validated().map_err(at_fault)?;
        self.slam.validated().map_err(at_fault)?;
        self.pose_frame().map_err(at_fault)?;
        self.antenna.map(LeverArm::validated).transpose().map_err(at_fault)?;
        Ok(self)
    }

    /// Uses the camera of a continued map where it is the plan's with a lens that an earlier run
    /// estimated.
    pub(crate) fn take_lens_of(&mut self, map: Option<&Path>) -> Result<()> {
        let Some(map) = map.filter(|map| MapFile::is_there(map)) else { return Ok(()) };
        let cameras = MapFile::open_read_only(map)?.mounted_cameras()?;
        let global = self.camera.clone().with_readout_s(None)?;
        if cameras.iter().any(|mounted| mounted.camera == global) {
            return Ok(());
        }
        let found = cameras.into_iter().find(|mounted| self.camera.differs_by_estimate(&mounted.camera));
        if let Some(found) = found.map(|mounted| mounted.camera) {
            let deviation_s = self.camera.readout_deviation_s();
            self.camera =
                found.with_readout_s(self.camera.readout_s())?.with_readout_deviation_s(deviation_s);
        }
        Ok(())
    }

    /// The plan as the text of a `run.toml` in this folder.
    pub(crate) fn text_in(&self, folder: &Path) -> Result<String> {
        self.seen_from(folder).text()
    }

    /// The plan as the text of a `run.toml`, with paths as they were typed: for the report, which
    /// is the same wherever it lies.
    ///
    /// # Errors
    /// If TOML cannot express a value.
    pub fn text(&self) -> Result<String> {
        self.check_names()?;
        let body = toml::to_string(self).map_err(|error| {
            Error::output(format!("the parameters cannot be written as TOML: {error}")).caused_by(error)
        })?;
        Ok(format!("{HEADER}{body}"))
    }
}
