//! Options of camera, mount and motion model, common to the commands that follow a camera.

use crate::lengths::{self, Height};
use crate::{console, profiles};
use odograph::camera::Rig;
use odograph::error::Result;
use odograph::motion::MotionModel;
use odograph_session::{FrameChoice, RunBuilder, doubtful_unit};
use std::path::PathBuf;

/// The camera and how it is mounted: what a profile keeps.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct CameraSetup {
    /// Camera file (OpenCV YAML, ROS camera_info, Kalibr, EuRoC or COLMAP).
    ///
    /// Not needed to continue a map, which has the camera and how it sits, nor for a robot
    /// recording with a camera_info of its images.
    #[arg(help_heading = "Camera", long, value_name = "FILE")]
    pub camera: Option<PathBuf>,
    /// Height of the camera above the ground, as 0.9 (metres), 90cm or 3ft.
    ///
    /// The camera is taken to look straight down; a tilt is found in the recording. Where a map
    /// with a lever arm is continued, the rest of the mount is that of the map.
    #[arg(help_heading = "Camera", long, value_name = "LENGTH", value_parser = lengths::height, allow_negative_numbers = true, conflicts_with = "rig")]
    pub height: Option<Height>,
    /// Rig file (TOML): height_m, roll_deg, pitch_deg, yaw_deg; x_m, y_m, z_m.
    ///
    /// x_m, y_m, z_m: the camera on the robot (base_link), forward, left and up.
    #[arg(help_heading = "Camera", long, value_name = "FILE")]
    pub rig: Option<PathBuf>,
    /// Width and height of the ground in the image, as 1.20x0.90 (metres) or 120x90cm.
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
}

impl CameraSetup {
    /// Applies the options to a run.
    pub fn of_run(&self, run: RunBuilder) -> RunBuilder {
        let run = self.camera.iter().fold(run, RunBuilder::camera_file);
        let run = match self.field_of_view {
            Some(FieldOfView { width_m, height_m, .. }) => run.field_of_view_m(width_m, height_m),
            None => run,
        };
        let run = self.height.iter().fold(run, |run, height| run.height_m(height.metres));
        let run = self.rig.iter().fold(run, RunBuilder::rig_file);
        let run = self.readout_ms.iter().fold(run, |run, readout_ms| run.readout_s(1e-3 * readout_ms));
        self.mask.iter().fold(run, RunBuilder::mask)
    }

    /// The setup with what is not given taken from a profile.
    pub fn or_of_profile(self, name: Option<&str>) -> Result<Self> {
        let Some(name) = name else { return Ok(self) };
        let kept = profiles::read(name)?;
        let (has_camera, has_mount) = (
            self.camera.is_some() || self.field_of_view.is_some(),
            self.rig.is_some() || self.height.is_some(),
        );
        let camera = kept.camera.filter(|_| !has_camera);
        let field_of_view = kept.field_of_view_m.filter(|_| !has_camera);
        Ok(Self {
            camera: self.camera.or(camera),
            height: self.height.or(kept.height_m.filter(|_| !has_mount).map(Height::in_metres)),
            rig: self.rig.or(kept.rig.filter(|_| !has_mount)),
            field_of_view: self.field_of_view.or(field_of_view.map(FieldOfView::in_metres)),
            readout_ms: self.readout_ms.or(kept.readout_ms),
            mask: self.mask.or(kept.mask),
        })
    }

    /// Warns about a height or field of view that was probably meant in another unit.
    pub fn question(&self, quiet: bool) {
        if let Some(height) = self.height.filter(|_| !quiet) {
            height.question();
        }
        if let Some(doubt) = self.field_of_view.filter(|_| !quiet).and_then(FieldOfView::doubt) {
            console::warn(&doubt);
        }
    }
}

/// A profile by its name.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct ProfileChoice {
    /// Camera and mount by the name of a saved profile; other options go before it.
    ///
    /// `odograph profile save NAME --camera FILE --rig FILE` keeps one.
    #[arg(help_heading = "Camera", long, value_name = "NAME")]
    pub profile: Option<String>,
}

/// Camera, mount and motion.
#[derive(Debug, Clone, clap::Args)]
pub struct MountedCameraArguments {
    #[command(flatten)]
    pub setup: CameraSetup,
    #[command(flatten)]
    pub chosen: ProfileChoice,
    /// Whose poses are written. [default: the robot's where the rig has x_m, y_m, z_m]
    #[arg(help_heading = "Results", long, value_name = "FRAME")]
    pub frame: Option<PoseFrameName>,
    /// What may change between frames.
    #[arg(help_heading = "Estimation", long, value_name = "MODEL", default_value = "auto")]
    pub motion: Motion,
}

impl MountedCameraArguments {
    /// The same with what its profile has.
    pub fn with_profile(self) -> Result<Self> {
        let setup = self.setup.or_of_profile(self.chosen.profile.as_deref())?;
        Ok(Self { setup, ..self })
    }

    /// Applies the options to a run.
    pub fn of_run(&self, run: RunBuilder) -> RunBuilder {
        let run = self.setup.of_run(run.motion(self.motion.into()));
        self.frame.into_iter().fold(run, |run, frame| run.frame(frame.into()))
    }
}

/// A field of view on the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FieldOfView {
    pub width_m: f64,
    pub height_m: f64,
    /// Whether the unit was written.
    has_unit: bool,
}

impl FieldOfView {
    /// Width and height that are certainly meant in metres.
    fn in_metres((width_m, height_m): (f64, f64)) -> Self {
        Self { width_m, height_m, has_unit: true }
    }

    /// A question about one that was probably meant in another unit.
    fn doubt(self) -> Option<String> {
        let Self { width_m, height_m, has_unit } = self;
        doubtful_unit(width_m.max(height_m)).filter(|_| !has_unit).map(|(unit, name)| {
            format!(
                "--field-of-view {width_m}x{height_m} is read as metres; if {name} are meant, write \
                 {width_m}x{height_m}{unit} ({width_m}x{height_m}m silences this)"
            )
        })
    }
}

fn field_of_view(text: &str) -> std::result::Result<FieldOfView, String> {
    let sides = text.split_once(['x', 'X', '×']).and_then(|(w, h)| lengths::pair(w, h));
    let has_unit = text.ends_with(|c: char| c.is_alphabetic());
    match sides {
        Some((width_m, height_m)) if [width_m, height_m].iter().all(|side| Rig::HEIGHTS_M.contains(side)) => {
            Ok(FieldOfView { width_m, height_m, has_unit })
        }
        Some(_) => Err("width and height are each between 1 µm and 10 km".to_owned()),
        _ if text.contains(',') => Err(format!("write it with decimal points, {}", text.replace(',', "."))),
        _ => Err("give width and height, as 1.20x0.90 (metres), 120x90cm or 120cmx90cm".to_owned()),
    }
}

/// Whose poses are written, by their names on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum PoseFrameName {
    /// The robot: x forward, y left, z up (ROS REP-105).
    #[value(name = "base_link")]
    BaseLink,
    /// The camera: x right, y down, z along the optical axis.
    Camera,
}

impl From<PoseFrameName> for FrameChoice {
    fn from(frame: PoseFrameName) -> Self {
        match frame {
            PoseFrameName::BaseLink => Self::BaseLink,
            PoseFrameName::Camera => Self::Camera,
        }
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
fn readout_ms(text: &str) -> std::result::Result<f64, String> {
    let most_ms = 1e3 * odograph::camera::Camera::LONGEST_READOUT_S;
    match text.parse::<f64>() {
        Ok(milliseconds) if (0.0..=most_ms).contains(&milliseconds) => Ok(milliseconds),
        Ok(_) => Err(format!("a readout time lies between 0 (a global shutter) and {most_ms} ms")),
        Err(_) => Err("a readout time is a number of milliseconds, such as 20".to_owned()),
    }
}
