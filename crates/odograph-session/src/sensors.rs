//! Sensors other than the camera: their files and reports.

use crate::files;
use odograph::error::Result;
use odograph::filter::fusion::{SensorKind, SensorRecord, SensorReport, Sensors};
use odograph::formats::sensor_file;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// The files of the sensors, CSV as `docs/sensors.md` describes them, or their topics in a robot
/// recording.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SensorFiles {
    /// Gyroscope: time_s and rate_rad_s, or x_rad_s, y_rad_s and z_rad_s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gyro: Option<PathBuf>,
    /// Compass: time_s and heading_rad (counter-clockwise) or bearing_deg (clockwise).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heading: Option<PathBuf>,
    /// Wheel: time_s and speed_m_s or distance_m.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub wheel: Option<PathBuf>,
    /// Range finder: time_s and height_m, or distance_m along the optical axis.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub range: Option<PathBuf>,
    /// Satellite receiver: CSV, NMEA 0183, GPX, the subtitles of a drone, or a folder of pictures
    /// with positions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gnss: Option<PathBuf>,
    /// Topic of the gyroscope: sensor_msgs/Imu.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gyro_topic: Option<String>,
    /// Topic of the wheel: nav_msgs/Odometry, its forward speed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub wheel_topic: Option<String>,
    /// Topic of the range finder: sensor_msgs/Range.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub range_topic: Option<String>,
    /// Topic of the satellite receiver: sensor_msgs/NavSatFix.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gnss_topic: Option<String>,
    /// When the recording's time was 0, UTC as `2026-05-04T10:12:33.5Z`, where the receiver's times
    /// are UTC and the recording's are not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gnss_start: Option<String>,
}

/// Largest size of a sensor file, bytes: days of a gyroscope at 100 Hz.
const MAX_BYTES: u64 = 256 << 20;

impl SensorFiles {
    /// Whether there is no sensor.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// The topic of a sensor.
    fn topic(&self, sensor: SensorKind) -> Option<&str> {
        match sensor {
            SensorKind::Gyro => self.gyro_topic.as_deref(),
            SensorKind::Heading => None,
            SensorKind::Wheel => self.wheel_topic.as_deref(),
            SensorKind::Range => self.range_topic.as_deref(),
        }
    }

    /// Reads the files, and the topics of the recording; what is wrong with these is added to the
    /// warnings.
    pub(crate) fn read(&self, recording: &str, warnings: &mut Vec<String>) -> Result<Sensors> {
        let mut read = |path: &Option<PathBuf>, sensor: SensorKind| -> Result<Option<SensorRecord>> {
            if let Some(topic) = self.topic(sensor) {
                let (record, found) = odograph_video::recorded_sensor(recording, topic, sensor)?;
                warnings.extend(found);
                return Ok(record);
            }
            let Some(path) = path else { return Ok(None) };
            let text = files::read_text_within(path, MAX_BYTES)?;
            let record = sensor_file::parse(&text, sensor).map_err(|error| error.at(path.display()))?;
            Ok(Some(record))
        };
        Ok(Sensors {
            gyro: read(&self.gyro, SensorKind::Gyro)?,
            heading: read(&self.heading, SensorKind::Heading)?,
            wheel: read(&self.wheel, SensorKind::Wheel)?,
            range: read(&self.range, SensorKind::Range)?,
        })
    }

    /// A sentence for each sensor that is not used.
    pub(crate) fn warnings(&self, reports: &[SensorReport]) -> Vec<String> {
        let file = |sensor| match sensor {
            SensorKind::Gyro => &self.gyro,
            SensorKind::Heading => &self.heading,
            SensorKind::Wheel => &self.wheel,
            SensorKind::Range => &self.range,
        };
        let sentence = |report: &SensorReport| {
            let path = file(report.sensor).as_ref().map(|path| path.display().to_string());
            let place = path.or_else(|| self.topic(report.sensor).map(str::to_owned));
            let place = place.map_or(String::new(), |place| format!(" {place}"));
            let reason = report.rejected?;
            Some(format!("the {}{place} is not used: {reason}", report.sensor))
        };
        reports.iter().filter_map(sentence).collect()
    }
}
