//! The sensors beside the camera, as they are given on the command line.

use odograph_session::SensorFiles;
use std::path::PathBuf;

/// The files of the sensors.
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
}

impl SensorArguments {
    /// The files, as a run takes them.
    pub fn files(&self) -> SensorFiles {
        let Self { gyro, heading, wheel, range } = self.clone();
        SensorFiles { gyro, heading, wheel, range }
    }
}
