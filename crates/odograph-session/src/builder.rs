//! Configuration of a run.

use crate::output::{MapUse, RunOutput};
use crate::plan::{FrameChoice, MarkerPlan, RunPlan, SourcePlan};
use crate::report::RunReporter;
use crate::sensors::SensorFiles;
use odograph::camera::{Camera, Rig};
use odograph::motion::MotionModel;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Source of the camera calibration.
#[derive(Debug, Clone)]
pub(crate) enum CameraChoice {
    File(PathBuf),
    Known(Box<Camera>),
    /// Width and height of the ground in the image, metres.
    FieldOfView(f64, f64),
    /// The camera of the map, which must exist.
    OfMap,
}

/// Source of the mount.
#[derive(Debug, Clone)]
pub(crate) enum MountChoice {
    File(PathBuf),
    Known(Rig),
    /// Height above the ground, metres; the rest is what a robot recording says, or level.
    Height(f64),
}

/// Configuration of a run: source, camera, mount, sensors, map and outputs.
///
/// Camera and height above the ground are required, unless a continued map has them; all else has a
/// default. Nothing is read or opened before [`RunBuilder::open`] or [`RunBuilder::run`].
#[derive(Clone)]
pub struct RunBuilder {
    pub(crate) source: SourcePlan,
    /// Whether the source is the `run.toml` of an earlier run.
    pub(crate) repeats: bool,
    /// The plan of the killed run that begins again.
    pub(crate) resumed: Option<Arc<RunPlan>>,
    pub(crate) camera: Option<CameraChoice>,
    pub(crate) mount: Option<MountChoice>,
    pub(crate) frame: Option<FrameChoice>,
    pub(crate) readout_s: Option<f64>,
    pub(crate) mask: Option<PathBuf>,
    pub(crate) markers: Option<MarkerPlan>,
    pub(crate) motion: MotionModel,
    pub(crate) sensors: SensorFiles,
    pub(crate) budget_ms: Option<f64>,
    pub(crate) loops: bool,
    pub(crate) reference: Option<PathBuf>,
    pub(crate) reference_topic: Option<String>,
    pub(crate) output: RunOutput,
    pub(crate) reporter: Option<Arc<dyn RunReporter>>,
}

impl fmt::Debug for RunBuilder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RunBuilder")
            .field("source", &self.source)
            .field("camera", &self.camera)
            .field("mount", &self.mount)
            .field("output", &self.output)
            .finish_non_exhaustive()
    }
}

impl RunBuilder {
    /// A run over a video, a folder of images, the address of a stream, or `-` for Y4M on standard
    /// input.
    pub fn new(source: impl Into<String>) -> Self {
        Self::over(SourcePlan::new(source))
    }

    /// A run over a part of a source.
    pub fn over(source: SourcePlan) -> Self {
        Self {
            source,
            repeats: false,
            resumed: None,
            camera: None,
            mount: None,
            frame: None,
            readout_s: None,
            mask: None,
            markers: None,
            motion: MotionModel::Auto,
            sensors: SensorFiles::default(),
            budget_ms: None,
            loops: true,
            reference: None,
            reference_topic: None,
            output: RunOutput::default(),
            reporter: None,
        }
    }

    /// A run that repeats an earlier one by its `run.toml`, which has all settings but the output
    /// folder.
    pub fn repeating(run_toml: impl Into<String>) -> Self {
        Self { repeats: true, ..Self::new(run_toml) }
    }

    /// A run that localizes an image or a recording in a map. Camera and mount are those of the
    /// newest session of the map with frames of that size; the map is not changed.
    pub fn localizing(source: SourcePlan, map: impl Into<PathBuf>) -> Self {
        let output = RunOutput { map: MapUse::LookInto(map.into()), least_frames: 1, ..RunOutput::default() };
        Self { camera: Some(CameraChoice::OfMap), output, ..Self::over(source) }
    }

    /// Camera from a file: OpenCV YAML, ROS `camera_info`, Kalibr, EuRoC or COLMAP.
    #[must_use]
    pub fn camera_file(mut self, path: impl Into<PathBuf>) -> Self {
        self.camera = Some(CameraChoice::File(path.into()));
        self
    }

    /// Camera from a value.
    #[must_use]
    pub fn camera(mut self, camera: Camera) -> Self {
        self.camera = Some(CameraChoice::Known(Box::new(camera)));
        self
    }

    /// Instead of a camera: width and height of the ground in the image, metres. Height and tilt
    /// are then taken as constant; without a mount the camera is as high as the field is wide.
    #[must_use]
    pub fn field_of_view_m(mut self, width_m: f64, height_m: f64) -> Self {
        self.camera = Some(CameraChoice::FieldOfView(width_m, height_m));
        self
    }

    /// Height of the camera above the ground, metres. The rest of its mount is taken from the
    /// static transforms of a robot recording, or from the map that is continued; otherwise it
    /// looks straight down, and a tilt is estimated from the recording.
    #[must_use]
    pub fn height_m(mut self, height_m: f64) -> Self {
        self.mount = Some(MountChoice::Height(height_m));
        self
    }

    /// Mount from a value.
    #[must_use]
    pub fn rig(mut self, rig: Rig) -> Self {
        self.mount = Some(MountChoice::Known(rig));
        self
    }

    /// Mount from a rig file (TOML: `height_m`, `roll_deg`, `pitch_deg`, `yaw_deg`, and the lever
    /// arm `x_m`, `y_m`, `z_m`).
    #[must_use]
    pub fn rig_file(mut self, path: impl Into<PathBuf>) -> Self {
        self.mount = Some(MountChoice::File(path.into()));
        self
    }

    /// Whose poses are written. By default the robot's where the rig has a lever arm, else the
    /// camera's.
    #[must_use]
    pub fn frame(mut self, frame: FrameChoice) -> Self {
        self.frame = Some(frame);
        self
    }

    /// Readout time of the image, first row to last, seconds; 0 is a global shutter. The default is
    /// the camera file's; where that has none it is learned.
    #[must_use]
    pub fn readout_s(mut self, readout_s: f64) -> Self {
        self.readout_s = Some(readout_s);
        self
    }

    /// Mask of what is not ground (black), of the size of the frames.
    #[must_use]
    pub fn mask(mut self, path: impl Into<PathBuf>) -> Self {
        self.mask = Some(path.into());
        self
    }

    /// Markers on the ground: family and side, such as `apriltag:36h11:80mm`. A marker that is seen
    /// again closes a loop.
    #[must_use]
    pub fn markers(mut self, family: impl Into<String>) -> Self {
        let control = self.markers.and_then(|markers| markers.control);
        self.markers = Some(MarkerPlan { family: family.into(), control });
        self
    }

    /// Control points (CSV: marker, x_m, y_m): the map is placed in their frame. To be called after
    /// [`RunBuilder::markers`].
    #[must_use]
    pub fn control(mut self, path: impl Into<PathBuf>) -> Self {
        if let Some(markers) = &mut self.markers {
            markers.control = Some(path.into());
        }
        self
    }

    /// Degrees of freedom between frames; [`MotionModel::Auto`] by default.
    #[must_use]
    pub fn motion(mut self, model: MotionModel) -> Self {
        self.motion = model;
        self
    }

    /// Sensors other than the camera.
    #[must_use]
    pub fn sensors(mut self, files: SensorFiles) -> Self {
        self.sensors = files;
        self
    }

    /// Time that a frame may take, milliseconds: fewer corners are tracked if needed. Measures the
    /// machine once, when the run is opened.
    #[must_use]
    pub fn budget_ms(mut self, frame_ms: f64) -> Self {
        self.budget_ms = Some(frame_ms);
        self
    }

    /// Disables loop closure: the path is the odometry's.
    #[must_use]
    pub fn without_loops(mut self) -> Self {
        self.loops = false;
        self
    }

    /// Reference trajectory (TUM), which the report shows beside that of the run.
    #[must_use]
    pub fn reference(mut self, path: impl Into<PathBuf>) -> Self {
        self.reference = Some(path.into());
        self
    }

    /// Reference trajectory from a topic of the robot recording, in place of a file.
    #[must_use]
    pub fn reference_topic(mut self, topic: impl Into<String>) -> Self {
        self.reference_topic = Some(topic.into());
        self
    }

    /// Output folder. The default is a temporary one, which is removed at the end.
    #[must_use]
    pub fn folder(mut self, path: impl Into<PathBuf>) -> Self {
        self.output.folder = Some(path.into());
        self
    }

    /// Overwrites existing results in the folder.
    #[must_use]
    pub fn overwriting(mut self, overwrites: bool) -> Self {
        self.output.force = overwrites;
        self
    }

    /// Use of a map; by default a new one in the output folder.
    #[must_use]
    pub fn map(mut self, map: MapUse) -> Self {
        self.output.map = map;
        self
    }

    /// The map that is continued or looked into; `None` for a new one in the folder.
    pub fn map_file(&self) -> Option<&Path> {
        self.output.map.path()
    }

    /// The camera file, if the camera is from one.
    pub(crate) fn camera_path(&self) -> Option<&Path> {
        match &self.camera {
            Some(CameraChoice::File(path)) => Some(path),
            _ => None,
        }
    }

    /// Name of the robot, where it has one.
    pub fn robot_name(&self) -> Option<&str> {
        self.output.robot.as_deref()
    }

    /// Name of the robot: the session has an origin in the map then, and can be sent to a site.
    #[must_use]
    pub fn robot(mut self, name: impl Into<String>) -> Self {
        self.output.robot = Some(name.into());
        self
    }

    /// A bag of ROS 2 (an MCAP file) to write: poses with covariance, transforms and diagnostics.
    #[must_use]
    pub fn bag(mut self, path: impl Into<PathBuf>) -> Self {
        self.output.bag = Some(path.into());
        self
    }

    /// An overlay video to write (`.avi`, Motion JPEG): each frame with its tracked corners,
    /// status, figures and the path so far, as it was tracked. Needs a reporter that can draw it.
    #[must_use]
    pub fn video(mut self, path: impl Into<PathBuf>) -> Self {
        self.output.video = Some(path.into());
        self
    }

    /// Number of threads; results do not depend on it. By default as many as are useful.
    #[must_use]
    pub fn threads(mut self, threads: usize) -> Self {
        self.output.threads = Some(threads.max(1));
        self
    }

    /// Renders `map.png` and `report.html`; without a reporter they are not written.
    #[must_use]
    pub fn reporter(mut self, reporter: impl RunReporter + 'static) -> Self {
        self.reporter = Some(Arc::new(reporter));
        self
    }
}
