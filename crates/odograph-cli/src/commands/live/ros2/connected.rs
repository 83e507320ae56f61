//! The program with ROS 2.

use super::super::LiveArguments;
use super::super::outputs::Outputs;
use super::{Ros2Part, SOURCE};
use odograph::error::{Error, Result};
use odograph_live::capture::{Policy, without_credentials};
use odograph_ros2::{ImageOptions, Images, Node, Part, PublisherOptions, RunPublisher, Services, TopicName};
use odograph_session::live::{LiveInput, LiveOptions, LiveRun};
use odograph_session::{Observer, RunBuilder, SensorFiles, rig_of_mount};

/// A run that takes images from ROS 2, or publishes to it, or both.
pub struct Ros2Run {
    node: Node,
    images: Option<Images>,
    publishing: Option<(PublisherOptions, Services)>,
    sensors: SensorFiles,
    waits: bool,
    needs_camera: bool,
    needs_mount: bool,
    height_m: Option<f64>,
}

impl From<Ros2Part> for Part {
    fn from(part: Ros2Part) -> Self {
        match part {
            Ros2Part::OdomTf => Self::OdomTransform,
            Ros2Part::MapTf => Self::MapTransform,
            Ros2Part::CameraTf => Self::CameraTransform,
            Ros2Part::Path => Self::Path,
            Ros2Part::Diagnostics => Self::Diagnostics,
            Ros2Part::Grid => Self::Grid,
            Ros2Part::Mosaic => Self::Mosaic,
        }
    }
}

fn topic(name: &Option<String>) -> Result<Option<TopicName>> {
    name.as_deref().map(str::parse).transpose()
}

impl Ros2Run {
    /// Joins ROS 2 if it is asked for. `files` are those of sensors that are not of ROS 2.
    pub fn of(arguments: &LiveArguments, files: &SensorFiles) -> Result<Option<Self>> {
        let ros2 = &arguments.ros2;
        let images: Option<TopicName> = arguments.source.strip_prefix(SOURCE).map(str::parse).transpose()?;
        if let (None, Some(option)) = (&images, ros2.topic_beside_images()) {
            return Err(Error::usage(format!(
                "{option} goes with images of ROS 2; give their topic as the source, such as ros2:/camera/image_raw"
            )));
        }
        let publishing = match topic(&ros2.ros2)? {
            Some(odometry) => {
                let without = ros2.ros2_without.iter().copied().map(Part::from).collect();
                Some(PublisherOptions { odometry, without, camera_is_placed: false })
            }
            None if images.is_none() => return Ok(None),
            None => None,
        };
        let wheel = topic(&ros2.wheel_topic)?;
        if let Some(wheel) = wheel
            .as_ref()
            .filter(|wheel| publishing.iter().any(|out: &PublisherOptions| out.odometry == **wheel))
        {
            return Err(Error::usage(format!(
                "{wheel} is both read (--wheel-topic) and published (--ros2); give another name with --ros2=TOPIC"
            )));
        }
        let (gyro, range) = (topic(&ros2.gyro_topic)?, topic(&ros2.range_topic)?);
        let camera_info = topic(&ros2.camera_info_topic)?;
        let name = |topic: &Option<TopicName>| topic.as_ref().map(ToString::to_string);
        let sensors = SensorFiles {
            gyro_topic: name(&gyro),
            wheel_topic: name(&wheel),
            range_topic: name(&range),
            ..files.clone()
        };
        let node = Node::join()?;
        let offered = |options| {
            let services =
                Services::announce(&node, &without_credentials(&arguments.source), ros2.ros2_wait)?;
            Ok::<_, Error>((options, services))
        };
        let publishing = publishing.map(offered).transpose()?;
        let options = images.map(|images| {
            let options = ImageOptions { camera_info, gyro, wheel, range, ..ImageOptions::new(images) };
            let patience = arguments.capture.options().patience.unwrap_or(options.patience);
            ImageOptions { patience, ..options }
        });
        let images = options.map(|options| Images::of(&node, options)).transpose()?;
        let setup = &arguments.mounted.setup;
        Ok(Some(Self {
            node,
            images,
            publishing,
            sensors,
            waits: ros2.ros2_wait,
            needs_camera: setup.camera.is_none() && setup.field_of_view.is_none(),
            needs_mount: setup.rig.is_none() && setup.field_of_view.is_none(),
            height_m: setup.height.as_ref().map(|height| height.metres),
        }))
    }

    /// Opens the run, and lets its poses be published.
    pub fn open(
        self,
        mut run: RunBuilder,
        options: &LiveOptions,
        observer: &dyn Observer,
        outputs: &mut Outputs,
    ) -> Result<LiveRun> {
        let Self { node, images, mut publishing, sensors, waits, needs_camera, needs_mount, height_m } = self;
        if let Some((_, services)) = &publishing {
            services.wait_for_start(observer)?;
        }
        let Some(mut images) = images else {
            let run = run.sensors(sensors).open_live(options, observer)?;
            if let Some((publishing, services)) = publishing {
                outputs.publish_with(RunPublisher::new(&node, &publishing, None, services, &run)?);
            }
            return Ok(run);
        };
        if waits {
            images.begin_again();
        }
        if needs_camera {
            run = run.camera(images.camera(observer)?);
        }
        if needs_mount && let Some(mount) = images.mount(observer)? {
            if let Some((publishing, _)) = &mut publishing {
                publishing.camera_is_placed = true;
            }
            if let Some(rig) = rig_of_mount(&mount, "this robot", height_m, observer) {
                run = run.rig(rig);
            }
        }
        let mut link = None;
        let run = run.sensors(sensors).open_live_over(options, observer, |_, watch| {
            let source = images.source(watch.clone(), observer)?;
            link = Some(source.link());
            Ok(LiveInput { source: Box::new(source), policy: Policy::NewestWins })
        })?;
        if let Some((publishing, services)) = publishing {
            outputs.publish_with(RunPublisher::new(&node, &publishing, link, services, &run)?);
        }
        Ok(run)
    }
}
