//! Makes the plan of a run from a builder; reads the named files.

use crate::builder::{CameraChoice, MountChoice, RunBuilder};
use crate::markers::MarkerWatch;
use crate::observer::Observer;
use crate::plan::{FrameChoice, RunPlan, SourcePlan};
use crate::rig::{StatedRig, doubtful_focal_length, other_size, parse_camera, recorded_rig};
use crate::{budget, files, pixel_shape};
use odograph::camera::{CalibrationDeviations, Camera, CameraUncertainty, LeverArm, Rig};
use odograph::error::{Error, Result};
use odograph::formats::camera_file;
use odograph::formats::decimal::Rounded;
use odograph::ground_map::MountedCamera;
use odograph::loop_closure::LoopClosureConfig;
use odograph::motion::MotionModel;
use odograph::odometry::{EarlierPass, OdometryConfig};
use odograph_map::MapFile;
use std::path::Path;

/// Least width and height of a frame. Corners are found by windows and margins of about as many
/// pixels.
const LEAST_SIDE_PX: usize = 16;

impl RunBuilder {
    /// The plan over a source that `open` opens; it also returns the size in pixels.
    pub(crate) fn plan_over<S>(
        &self,
        observer: &dyn Observer,
        open: impl FnOnce(&SourcePlan) -> Result<(S, (usize, usize))>,
    ) -> Result<(RunPlan, S)> {
        // An unreadable camera or map is reported before a source that may take long to open.
        let given = GivenCamera::by(self)?;
        // The camera of a map with several is known by the size of the frames.
        let waits =
            matches!((&given, &self.mount), (GivenCamera::Map(_), None | Some(MountChoice::Height(_))));
        let early = (!waits).then(|| given.rig(self, observer)).transpose()?;
        let (source, size) = open(&self.source)?;
        let given = given.of_size(size)?;
        let StatedRig { rig, deviations, antenna } = early.map_or_else(|| given.rig(self, observer), Ok)?;
        let by_field = matches!(given, GivenCamera::Field(_));
        let uncertainty = given.uncertainty()?;
        let camera = given.camera(size, rig.height_m)?;
        let deviations =
            CalibrationDeviations::new((&camera, uncertainty.as_ref()), (rig.height_m, &deviations));
        let camera = match self.readout_s {
            Some(seconds) => camera.with_readout_s(Some(seconds))?,
            None => camera,
        };
        self.check_size(&camera, size)?;
        if !by_field && let Some(doubt) = doubtful_focal_length(&camera) {
            observer.warn(&doubt);
        }
        let mut odometry = OdometryConfig::default();
        odometry.motion.model = match self.motion {
            // A tape measure does not give the lens distortion, and unmodelled distortion looks
            // like changing height and tilt.
            MotionModel::Auto if by_field => MotionModel::Rigid,
            model => model,
        };
        let budget = match self.budget_ms {
            Some(frame_ms) => Some(budget::fit(&mut odometry, size, frame_ms)?),
            None => None,
        };
        let mut slam = LoopClosureConfig { loops: self.loops, ..LoopClosureConfig::default() };
        if self.output.map.is_read_only() {
            // A read-only look-up cannot corrupt the map, so a single certain sighting is enough.
            slam.sightings = 1;
        }
        let plan = RunPlan {
            odograph: env!("CARGO_PKG_VERSION").to_owned(),
            reference: self.reference.clone(),
            reference_topic: self.reference_topic.clone(),
            source: self.source.clone(),
            camera,
            rig,
            deviations,
            frame: self.frame.or(rig.lever_arm.map(|_| FrameChoice::BaseLink)),
            antenna: antenna.map_or_else(|| self.recorded_antenna(&rig, observer), |arm| Ok(Some(arm)))?,
            images: EarlierPass::default(),
            mask: self.mask.clone(),
            markers: self.markers.clone(),
            sensors: self.sensors.clone(),
            budget,
            odometry,
            slam,
        };
        // A mask of the wrong size and an unknown frame are reported before tracking.
        plan.odometry()?;
        plan.pose_frame()?;
        // So are an unknown family of markers and unreadable control points.
        MarkerWatch::new(&plan, &plan.camera)?;
        Ok((plan, source))
    }

    /// Warns where the stated field of view does not make the pixels of frames of this size square.
    pub(crate) fn question_pixels(&self, size: (usize, usize), observer: &dyn Observer) {
        if let Some(CameraChoice::FieldOfView(width_m, height_m)) = self.camera
            && let Some(doubt) = pixel_shape::doubt(size, (width_m, height_m))
        {
            observer.warn(&doubt);
        }
    }

    /// Fails if the camera is not calibrated for frames of this size, pixels.
    fn check_size(&self, camera: &Camera, size: (usize, usize)) -> Result<()> {
        if size.0.min(size.1) < LEAST_SIDE_PX {
            return Err(Error::input(format!(
                "the frames of {} are {}x{} pixels, too small to track anything in: {LEAST_SIDE_PX} are needed in \
                 each direction, 320x240 is good",
                self.source.path, size.0, size.1
            )));
        }
        if (camera.width(), camera.height()) == size {
            return Ok(());
        }
        let path = &self.source.path;
        Err(if matches!(self.camera, Some(CameraChoice::OfMap)) {
            let (width, height) = (camera.width(), camera.height());
            let what_to_do = if (size.1, size.0) == (width, height) {
                "it is turned by 90°: hold the camera as it was held there"
            } else if size.0 * height == size.1 * width {
                "if it shows what that camera shows, scale it to that size"
            } else {
                "only pictures of that camera can be found in it"
            };
            Error::input(format!(
                "the frames of {path} are {}x{} but the map was made with a camera of {width}x{height}; {what_to_do}",
                size.0, size.1
            ))
        } else if matches!(GivenCamera::by(self), Ok(GivenCamera::Recording(_))) {
            Error::input(format!(
                "the frames of {path} are {}x{} but their camera_info is for {}x{}; give --camera FILE, calibrated at the \
                 recording's size",
                size.0,
                size.1,
                camera.width(),
                camera.height()
            ))
        } else {
            other_size(path, size, (camera.width(), camera.height()))
        })
    }

    /// The antenna of the satellite receiver by the static transforms of the recording, where it is
    /// known where the camera is on the robot.
    fn recorded_antenna(&self, rig: &Rig, observer: &dyn Observer) -> Result<Option<LeverArm>> {
        let Some(topic) = self.sensors.gnss_topic.as_deref().filter(|_| rig.lever_arm.is_some()) else {
            return Ok(None);
        };
        let Some((frame, arm)) = odograph_video::recorded_antenna(&self.source.path, topic)? else {
            return Ok(None);
        };
        let [x_m, y_m, z_m] = [arm.x_m, arm.y_m, arm.z_m].map(Rounded);
        observer.note(&format!(
            "{frame} in base_link, from /tf_static: x {x_m:.3} m, y {y_m:.3} m, z {z_m:.3} m (gnss_lever_arm_m in a \
             rig file overrides)"
        ));
        Ok(Some(arm))
    }
}

/// Source of the camera, with the files already read.
enum GivenCamera<'a> {
    /// The file and its content.
    File(&'a Path, String),
    Known(&'a Camera),
    /// Width and height of the ground in view, metres.
    Field((f64, f64)),
    /// The camera of the continued map: that of its first session, until the size of the frames is
    /// known.
    Map(Box<MapCamera>),
    /// The camera of a robot recording.
    Recording(&'a SourcePlan),
}

/// A camera of a map.
struct MapCamera {
    file: MapFile,
    mounted: MountedCamera,
}

impl MapCamera {
    fn of(map: &Path) -> Result<Self> {
        let file = MapFile::open_read_only(map)?;
        let mounted = MountedCamera { camera: file.camera().clone(), rig: *file.rig() };
        Ok(Self { file, mounted })
    }

    /// The camera of the newest session with frames of this size, pixels; the first session's if
    /// there is none.
    fn of_size(self, size: (usize, usize)) -> Result<Self> {
        let fits = |mounted: &MountedCamera| (mounted.camera.width(), mounted.camera.height()) == size;
        let mounted = self.file.mounted_cameras()?.into_iter().find(fits).unwrap_or(self.mounted);
        Ok(Self { mounted, ..self })
    }
}

/// Whether a source is a file or folder that does not exist, and neither a stream nor `-`.
fn is_missing(source: &str) -> bool {
    source != "-" && !source.contains("://") && !Path::new(source).exists()
}

fn no_camera() -> Error {
    Error::usage(
        "no camera is given; give --camera FILE, as odograph calibrate writes it, and --height LENGTH; or \
         --field-of-view WIDTHxHEIGHT in metres as measured on the ground",
    )
}

impl<'a> GivenCamera<'a> {
    fn by(builder: &'a RunBuilder) -> Result<Self> {
        let map = builder.output.map.path();
        let there = map.filter(|map| MapFile::is_there(map));
        match (&builder.camera, there) {
            (Some(CameraChoice::OfMap), _) => {
                let map = map.ok_or_else(|| Error::usage("there is no map to take the camera from"))?;
                Ok(Self::Map(Box::new(MapCamera::of(map)?)))
            }
            (Some(CameraChoice::File(file)), _) => Ok(Self::File(file, files::read_text(file)?)),
            (Some(CameraChoice::Known(camera)), _) => Ok(Self::Known(camera)),
            (Some(CameraChoice::FieldOfView(width_m, height_m)), _) => Ok(Self::Field((*width_m, *height_m))),
            (None, Some(map)) => Ok(Self::Map(Box::new(MapCamera::of(map)?))),
            (None, None) if odograph_video::is_robot_recording(&builder.source.path) => {
                Ok(Self::Recording(&builder.source))
            }
            // A misspelt name of a robot recording is not a missing camera.
            (None, None) if is_missing(&builder.source.path) => {
                Err(Error::input("there is no such file or folder").at(&builder.source.path))
            }
            // Nor is a file that is no recording.
            (None, None) if Path::new(&builder.source.path).is_file() => {
                builder.source.open()?;
                Err(no_camera())
            }
            (None, None) => Err(no_camera()),
        }
    }

    /// The same for frames of this size, pixels.
    fn of_size(self, size: (usize, usize)) -> Result<Self> {
        Ok(match self {
            Self::Map(map) => Self::Map(Box::new(map.of_size(size)?)),
            other => other,
        })
    }

    /// The mount in the continued map of the camera, if the map has a session of it; the newest.
    fn rig_in_map(&self, builder: &RunBuilder) -> Result<Option<Rig>> {
        let map = builder.output.map.path().filter(|map| MapFile::is_there(map));
        let is_same = |mounted: &MountedCamera| match self {
            Self::Map(map) => mounted.camera == map.mounted.camera,
            Self::Known(camera) => camera.differs_by_estimate(&mounted.camera),
            Self::File(path, text) => {
                let size = (mounted.camera.width(), mounted.camera.height());
                parse_camera(path, text, size).is_ok_and(|camera| camera.differs_by_estimate(&mounted.camera))
            }
            Self::Field(_) | Self::Recording(_) => false,
        };
        let Some(map) = map else { return Ok(None) };
        let cameras = MapFile::open_read_only(map)?.mounted_cameras()?;
        Ok(cameras.into_iter().find(is_same).map(|mounted| mounted.rig))
    }

    fn rig(&self, builder: &RunBuilder, observer: &dyn Observer) -> Result<StatedRig> {
        let rig = match (&builder.mount, self) {
            (Some(MountChoice::File(path)), _) => return StatedRig::read(path, observer),
            (Some(MountChoice::Known(rig)), _) => rig.validated(),
            (Some(MountChoice::Height(height_m)), Self::Field(_)) => Rig::level(*height_m).validated(),
            (Some(MountChoice::Height(height_m)), _) => {
                let level = Rig::level(*height_m).validated()?;
                let SourcePlan { path, topic, .. } = &builder.source;
                if let Some(recorded) = recorded_rig(path, topic.as_deref(), Some(*height_m), observer)? {
                    return Ok(recorded.into());
                }
                // The height alone does not say whose poses the map has. Without a lever arm they
                // are the camera's, and its tilt is estimated as without a map.
                let there = self.rig_in_map(builder)?;
                let Some((there, arm)) = there.and_then(|rig| Some((rig, rig.lever_arm?))) else {
                    return Ok(level.into());
                };
                note_kept_mount(&there, arm, observer);
                Rig { height_m: *height_m, ..there }.validated()
            }
            // The field of view already gives the scale. The height is that of a lens of 53°: from
            // a fixed height a field of 120 m would be seen by a lens that cannot be tracked.
            (None, Self::Field((width_m, _))) => Rig::level(*width_m).validated(),
            (None, Self::Map(map)) => Ok(map.mounted.rig),
            (None, Self::File(..) | Self::Known(_) | Self::Recording(_)) => {
                let SourcePlan { path, topic, .. } = &builder.source;
                let recorded = recorded_rig(path, topic.as_deref(), None, observer)?;
                let known = recorded.map_or_else(|| self.rig_in_map(builder), |rig| Ok(Some(rig)))?;
                known.ok_or_else(|| {
                    Error::usage(
                        "the height of the camera above the ground is missing; give --height LENGTH, such as 90cm, or --rig FILE",
                    )
                })
            }
        };
        rig.map(StatedRig::from)
    }

    /// How well its parameters are known, where its file says so.
    fn uncertainty(&self) -> Result<Option<CameraUncertainty>> {
        match self {
            Self::File(path, text) => {
                camera_file::parse_uncertainty(text).map_err(|error| error.at(path.display()))
            }
            Self::Known(_) | Self::Field(_) | Self::Map(_) | Self::Recording(_) => Ok(None),
        }
    }

    /// The camera for images of this size, pixels.
    fn camera(self, size: (usize, usize), height_m: f64) -> Result<Camera> {
        match self {
            Self::File(path, text) => parse_camera(path, &text, size),
            Self::Known(camera) => Ok(camera.clone()),
            Self::Field(field) => Camera::from_field_of_view(size, field, height_m),
            Self::Map(map) => Ok(map.mounted.camera),
            Self::Recording(SourcePlan { path, topic, .. }) => {
                match odograph_video::recorded_camera(path, topic.as_deref())? {
                    Some(recorded) => Ok(recorded.camera),
                    None => Err(Error::usage(format!(
                        "{path} has no camera_info of its images; give --camera FILE, or --field-of-view WIDTHxHEIGHT in \
                         metres as measured on the ground"
                    ))),
                }
            }
        }
    }
}

/// Tells that what a height alone does not say of a mount is as in the map.
fn note_kept_mount(rig: &Rig, LeverArm { x_m, y_m, z_m }: LeverArm, observer: &dyn Observer) {
    let [x_m, y_m, z_m] = [x_m, y_m, z_m].map(Rounded);
    let [roll, pitch, yaw] =
        [rig.roll_rad, rig.pitch_rad, rig.yaw_rad].map(|angle_rad| Rounded(angle_rad.to_degrees()));
    observer.note(&format!(
        "the height is the given one, the rest of the mount that of the map: x {x_m:.3} m, y {y_m:.3} m, z {z_m:.3} m, \
         roll {roll:.1}°, pitch {pitch:.1}°, yaw {yaw:.1}° (--rig overrides)"
    ));
}
