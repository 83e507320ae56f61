//! ROS 2 as a source of images and a receiver of poses, where the program is built with it (feature
//! `ros2`).

#[cfg(feature = "ros2")]
mod connected;
#[cfg(not(feature = "ros2"))]
mod without;

#[cfg(feature = "ros2")]
pub use connected::Ros2Run;
#[cfg(not(feature = "ros2"))]
pub use without::Ros2Run;

/// What a source of ROS 2 begins with.
const SOURCE: &str = "ros2:";

/// Topics of ROS 2.
#[derive(Debug, Clone, Default, clap::Args)]
#[command(next_help_heading = "ROS 2")]
pub struct Ros2Arguments {
    /// Publish odometry on a topic (with no name: /odom), transforms, path, grid and diagnostics.
    ///
    /// nav_msgs/Odometry with its covariance; /tf, /tf_static, /odograph/path, /odograph/grid,
    /// /odograph/mosaic/compressed, /diagnostics. The domain is that of ROS_DOMAIN_ID.
    #[arg(long, value_name = "TOPIC", num_args = 0..=1, require_equals = true, default_missing_value = "/odom", hide = !cfg!(feature = "ros2"))]
    pub ros2: Option<String>,
    /// Leave something out of what is published; several with commas.
    #[arg(long, value_name = "PART", value_delimiter = ',', requires = "ros2", hide = !cfg!(feature = "ros2"))]
    pub ros2_without: Vec<Ros2Part>,
    /// Wait for the service /odograph/start before the run begins.
    #[arg(long, requires = "ros2", hide = !cfg!(feature = "ros2"))]
    pub ros2_wait: bool,
    /// Camera of the images (sensor_msgs/CameraInfo), where it is not beside them.
    #[arg(long, value_name = "TOPIC", hide = !cfg!(feature = "ros2"))]
    pub camera_info_topic: Option<String>,
    /// Gyroscope (sensor_msgs/Imu), for the path at the end.
    #[arg(long, value_name = "TOPIC", hide = !cfg!(feature = "ros2"))]
    pub gyro_topic: Option<String>,
    /// Wheel odometry (nav_msgs/Odometry, its forward speed), for the path at the end.
    #[arg(long, value_name = "TOPIC", hide = !cfg!(feature = "ros2"))]
    pub wheel_topic: Option<String>,
    /// Range finder (sensor_msgs/Range), for the path at the end.
    #[arg(long, value_name = "TOPIC", hide = !cfg!(feature = "ros2"))]
    pub range_topic: Option<String>,
}

/// A part of what is published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Ros2Part {
    /// odom to base_link, or to the camera, on /tf.
    OdomTf,
    /// map to odom on /tf.
    MapTf,
    /// base_link to the camera on /tf_static.
    CameraTf,
    /// nav_msgs/Path.
    Path,
    /// diagnostic_msgs/DiagnosticArray.
    Diagnostics,
    /// nav_msgs/OccupancyGrid of the ground seen.
    Grid,
    /// The mosaic as sensor_msgs/CompressedImage, with its georeference.
    Mosaic,
}

impl Ros2Arguments {
    /// Whether anything is published.
    pub fn publishes(&self) -> bool {
        self.ros2.is_some()
    }

    /// Whether the ground is published.
    pub fn publishes_ground(&self) -> bool {
        let of_ground = [Ros2Part::Grid, Ros2Part::Mosaic];
        self.publishes() && !of_ground.iter().all(|part| self.ros2_without.contains(part))
    }

    /// The first topic that is taken from ROS 2 beside the images, by its option.
    fn topic_beside_images(&self) -> Option<&'static str> {
        let Self { camera_info_topic, gyro_topic, wheel_topic, range_topic, .. } = self;
        [
            (camera_info_topic, "--camera-info-topic"),
            (gyro_topic, "--gyro-topic"),
            (wheel_topic, "--wheel-topic"),
            (range_topic, "--range-topic"),
        ]
        .into_iter()
        .find_map(|(topic, option)| topic.as_ref().map(|_| option))
    }
}
