//! Command-line options of the other sensors.

use odograph_session::SensorFiles;
use std::path::PathBuf;

/// The files of the sensors, or their topics in a robot recording.
#[derive(Debug, Clone, Default, clap::Args)]
#[command(next_help_heading = "Other sensors (CSV, see docs/sensors.md)")]
pub struct SensorArguments {
    /// Gyroscope: time_s and rate_rad_s, or x_rad_s, y_rad_s and z_rad_s.
    #[arg(long, value_name = "FILE")]
    pub gyro: Option<PathBuf>,
    /// Compass: time_s and heading_rad (counter-clockwise) or bearing_deg (clockwise).
    #[arg(long, value_name = "FILE")]
    pub heading: Option<PathBuf>,
    /// Wheel: time_s and speed_m_s or distance_m.
    #[arg(long, value_name = "FILE")]
    pub wheel: Option<PathBuf>,
    /// Range finder: time_s and height_m, or distance_m along the optical axis.
    #[arg(long, value_name = "FILE")]
    pub range: Option<PathBuf>,
    /// Satellite receiver: CSV, NMEA 0183, GPX, subtitles of a drone (SRT), or a folder of JPEGs.
    ///
    /// A CSV file has time_s, latitude_deg, longitude_deg, sigma_m; JPEGs have positions in their
    /// EXIF data.
    /// Places the path on Earth: trajectory.geojson, trajectory-utm.csv, mosaic-utm.tif. The
    /// antenna is at gnss_lever_arm_m of the rig file.
    #[arg(long, value_name = "FILE")]
    pub gnss: Option<PathBuf>,
    /// When the recording's time was 0, as 2026-05-04T10:12:33.5Z, for NMEA and GPX.
    ///
    /// To a second; the rest is estimated. Not needed where the frames have times in UTC.
    #[arg(long, value_name = "UTC")]
    pub gnss_start: Option<String>,
    /// Gyroscope, from a topic of the robot recording: sensor_msgs/Imu.
    #[arg(long, value_name = "NAME", conflicts_with = "gyro")]
    pub gyro_topic: Option<String>,
    /// Wheel, from a topic of the robot recording: nav_msgs/Odometry, its forward speed.
    #[arg(long, value_name = "NAME", conflicts_with = "wheel")]
    pub wheel_topic: Option<String>,
    /// Range finder, from a topic of the robot recording: sensor_msgs/Range.
    #[arg(long, value_name = "NAME", conflicts_with = "range")]
    pub range_topic: Option<String>,
    /// Satellite receiver, from a topic of the robot recording: sensor_msgs/NavSatFix.
    #[arg(long, value_name = "NAME", conflicts_with = "gnss")]
    pub gnss_topic: Option<String>,
}

impl SensorArguments {
    /// The files for a run.
    pub fn files(&self) -> SensorFiles {
        let Self { gyro, heading, wheel, range, gnss, gnss_start, .. } = self.clone();
        let Self { gyro_topic, wheel_topic, range_topic, gnss_topic, .. } = self.clone();
        SensorFiles {
            gyro,
            heading,
            wheel,
            range,
            gnss,
            gyro_topic,
            wheel_topic,
            range_topic,
            gnss_topic,
            gnss_start,
        }
    }
}
