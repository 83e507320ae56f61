//! Command-line options of the sensors beside a live source.

use odograph::error::{Error, Result};
use odograph::filter::fusion::SensorKind;
use odograph_session::SensorFiles;
use odograph_session::live::{LineSource, POSITIONS, SensorSources};
use std::path::PathBuf;

/// Where readings of other sensors, and positions on Earth, come from.
#[derive(Debug, Clone, Default, clap::Args)]
#[command(next_help_heading = "Other sensors (docs/sensors.md)")]
pub struct LiveSensorArguments {
    /// Gyroscope: time_s and rate_rad_s, or x_rad_s, y_rad_s and z_rad_s.
    ///
    /// Readings as they come, CSV or a JSON object a line: from a pipe, a serial device, a file
    /// that grows, udp:PORT, udp:HOST:PORT, or - for standard input. Sensors may share a source.
    #[arg(long, value_name = "SOURCE")]
    gyro: Option<String>,
    /// Compass, as --gyro: time_s and heading_rad (counter-clockwise) or bearing_deg (clockwise).
    #[arg(long, value_name = "SOURCE")]
    heading: Option<String>,
    /// Wheel, as --gyro: time_s and speed_m_s or distance_m.
    #[arg(long, value_name = "SOURCE")]
    wheel: Option<String>,
    /// Range finder, as --gyro: time_s and height_m, or distance_m along the optical axis.
    #[arg(long, value_name = "SOURCE")]
    range: Option<String>,
    /// Satellite receiver: a pipe, a serial device, udp:PORT or -; or a file as of `run`.
    ///
    /// Lines of NMEA 0183 or CSV (time_s, latitude_deg, longitude_deg, sigma_m). Places the path on
    /// Earth at the end, as `run` does. `-` is standard input, udp:HOST:PORT listens at HOST.
    #[arg(long, value_name = "SOURCE")]
    gnss: Option<String>,
    /// When the recording's time was 0, as 2026-05-04T10:12:33.5Z, for a file of NMEA or GPX.
    #[arg(long, value_name = "UTC", requires = "gnss")]
    gnss_start: Option<String>,
}

/// What the options name.
pub struct NamedSensors {
    /// Files, some of which may grow.
    pub files: SensorFiles,
    /// Where readings come from during the run.
    pub received: SensorSources,
    /// Where positions come from during the run.
    pub gnss: Option<LineSource>,
}

impl LiveSensorArguments {
    /// The sensors beside this source of frames.
    pub fn named(&self, frames: &str) -> Result<NamedSensors> {
        let mut files = SensorFiles::default();
        let mut received = SensorSources::new();
        let places = [
            (SensorKind::Gyro, &self.gyro, &mut files.gyro),
            (SensorKind::Heading, &self.heading, &mut files.heading),
            (SensorKind::Wheel, &self.wheel, &mut files.wheel),
            (SensorKind::Range, &self.range, &mut files.range),
        ];
        for (sensor, name, file) in places {
            let Some(name) = name else { continue };
            match LineSource::named(name, &format!("readings of the {sensor}"))? {
                Some(source) => received.push((sensor, source)),
                None => *file = Some(PathBuf::from(name)),
            }
        }
        let gnss = self.gnss.as_deref().map(|name| LineSource::named(name, POSITIONS)).transpose()?.flatten();
        if gnss.is_some() && self.gnss_start.is_some() {
            return Err(Error::usage(
                "--gnss-start is for a file of positions: those received have the times at which they arrive",
            ));
        }
        let mut sources: Vec<&LineSource> = received.iter().map(|(_, source)| source).collect();
        if sources.contains(&&LineSource::Input) && frames == "-" {
            return Err(Error::usage(
                "frames and readings cannot both be on standard input; give one of them as a pipe",
            ));
        }
        if gnss == Some(LineSource::Input) && frames == "-" {
            return Err(Error::usage(
                "frames and positions cannot both be on standard input; give one of them as a pipe",
            ));
        }
        sources.retain(|source| Some(*source) == gnss.as_ref());
        if let Some(shared) = sources.first() {
            return Err(Error::usage(format!(
                "positions and readings cannot both come from {}; give the satellite receiver a source of its own",
                shared.name()
            )));
        }
        if gnss.is_none() {
            files.gnss = self.gnss.as_ref().map(PathBuf::from);
            files.gnss_start.clone_from(&self.gnss_start);
        }
        Ok(NamedSensors { files, received, gnss })
    }
}
