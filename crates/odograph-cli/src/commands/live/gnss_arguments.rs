//! Command-line options of a satellite receiver beside a live source.

use odograph::error::{Error, Result};
use odograph_session::SensorFiles;
use odograph_session::live::GnssSource;
use std::path::PathBuf;

/// Where positions on Earth come from.
#[derive(Debug, Clone, Default, clap::Args)]
#[command(next_help_heading = "Satellite receiver")]
pub struct GnssArguments {
    /// Positions as they come: a pipe, a serial device, udp:PORT or -; or a file as of `run`.
    ///
    /// Lines of NMEA 0183 or CSV (time_s, latitude_deg, longitude_deg, sigma_m). Places the path on
    /// Earth at the end, as `run` does. `-` is standard input, udp:HOST:PORT listens at HOST.
    #[arg(long, value_name = "SOURCE")]
    gnss: Option<String>,
    /// When the recording's time was 0, as 2026-05-04T10:12:33.5Z, for a file of NMEA or GPX.
    #[arg(long, value_name = "UTC", requires = "gnss")]
    gnss_start: Option<String>,
}

impl GnssArguments {
    /// Where positions are received during the run from this source of frames; `None` for a file.
    pub fn source(&self, frames: &str) -> Result<Option<GnssSource>> {
        let Some(source) = self.gnss.as_deref().map(GnssSource::named).transpose()?.flatten() else {
            return Ok(None);
        };
        if source == GnssSource::Input && frames == "-" {
            return Err(Error::usage(
                "frames and positions cannot both be on standard input; give one of them as a pipe",
            ));
        }
        if self.gnss_start.is_some() {
            return Err(Error::usage(
                "--gnss-start is for a file of positions: those received have the times at which they arrive",
            ));
        }
        Ok(Some(source))
    }

    /// The file of positions, unless they are `received` during the run.
    pub fn files(&self, received: bool) -> SensorFiles {
        if received {
            return SensorFiles::default();
        }
        SensorFiles {
            gnss: self.gnss.as_ref().map(PathBuf::from),
            gnss_start: self.gnss_start.clone(),
            ..SensorFiles::default()
        }
    }
}
