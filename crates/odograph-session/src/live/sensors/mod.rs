//! Other sensors beside a live source: gyroscope, compass, wheel and range finder, whose readings
//! come while the carrier drives.

mod fusing;
mod readings;

pub use fusing::LiveFusion;

use super::line_source::{LineSink, LineSource};
use crate::sensors::SensorFiles;
use odograph::error::{Error, Result};
use odograph::filter::fusion::{SensorKind, SensorRecord, Sensors};
use odograph_live::capture::Policy;
use readings::Readings;
use std::borrow::Cow;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// The sensors of a live run, and where their readings come from.
pub type SensorSources = Vec<(SensorKind, LineSource)>;

/// The sensors of a live run.
pub struct LiveSensors {
    /// Those whose whole record was there at the beginning.
    recorded: Sensors,
    /// One for each source: sensors of the same source share its lines.
    heard: Vec<Arc<Heard>>,
}

/// What is shared with the thread that reads a source.
struct Heard {
    readings: Mutex<Vec<Readings>>,
    is_ended: AtomicBool,
}

impl Heard {
    fn readings(&self) -> MutexGuard<'_, Vec<Readings>> {
        self.readings.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl LineSink for Heard {
    fn take(&self, line: &str, arrived: Option<Instant>, sender: Option<SocketAddr>) {
        self.readings().iter_mut().for_each(|readings| readings.take(line, arrived, sender));
    }

    fn is_ended(&self) -> bool {
        self.is_ended.load(Ordering::Relaxed)
    }
}

impl LiveSensors {
    /// Begins to listen to `sources`, and to `files` as they grow; without haste (every frame of a
    /// recording is waited for) the files are read whole.
    ///
    /// # Errors
    /// If a source cannot be opened, or readings as they come do not fit the frames.
    pub fn open(
        sources: &[(SensorKind, LineSource)],
        files: &SensorFiles,
        frames: &str,
        policy: Policy,
    ) -> Result<Self> {
        let mut recorded = Sensors::default();
        let mut all = sources.to_vec();
        if policy == Policy::Wait {
            if let Some((sensor, source)) = sources.first() {
                return Err(Error::usage(format!(
                    "readings of a {sensor} as they come, from {}, need frames as they come: give --realtime, or a file of the readings for {frames}",
                    source.name()
                )));
            }
            recorded = files.read(frames, &mut Vec::new())?;
        } else {
            let named = [
                (SensorKind::Gyro, &files.gyro),
                (SensorKind::Heading, &files.heading),
                (SensorKind::Wheel, &files.wheel),
                (SensorKind::Range, &files.range),
            ];
            let file = |(sensor, path): (SensorKind, &Option<PathBuf>)| {
                path.as_ref().map(|path| (sensor, LineSource::File(path.clone())))
            };
            all.extend(named.into_iter().filter_map(file));
        }
        let mut grouped: Vec<(LineSource, Vec<SensorKind>)> = Vec::new();
        for (sensor, source) in all {
            match grouped.iter_mut().find(|(other, _)| *other == source) {
                Some((_, sensors)) => sensors.push(sensor),
                None => grouped.push((source, vec![sensor])),
            }
        }
        let mut heard = Vec::new();
        for (source, sensors) in grouped {
            let what = format!("readings of the {}", sensors[0]);
            let readings = sensors.iter().map(|sensor| Readings::new(*sensor, source.name())).collect();
            let shared = Arc::new(Heard { readings: Mutex::new(readings), is_ended: AtomicBool::new(false) });
            source.read(&what, Arc::clone(&shared) as Arc<dyn LineSink>)?;
            heard.push(shared);
        }
        Ok(Self { recorded, heard })
    }

    /// Whether there is no sensor.
    pub fn is_empty(&self) -> bool {
        self.heard.is_empty() && self.recorded == Sensors::default()
    }

    /// Whether the readings are there from the beginning, so that the result is the same each time.
    fn is_recorded(&self) -> bool {
        self.heard.is_empty()
    }

    /// Tells when a frame was captured, and its time, seconds.
    fn frame(&self, at: Instant, time_s: f64) {
        for heard in &self.heard {
            heard.readings().iter_mut().for_each(|readings| readings.frame(at, time_s));
        }
    }

    fn each(&self, record: impl Fn(&mut Readings) -> Option<SensorRecord>) -> Sensors {
        let mut sensors = self.recorded.clone();
        for heard in &self.heard {
            for readings in heard.readings().iter_mut() {
                let place = match readings.sensor {
                    SensorKind::Gyro => &mut sensors.gyro,
                    SensorKind::Heading => &mut sensors.heading,
                    SensorKind::Wheel => &mut sensors.wheel,
                    SensorKind::Range => &mut sensors.range,
                };
                *place = record(readings);
            }
        }
        sensors
    }

    /// The readings from a time on; recorded ones are all there from the beginning.
    fn since(&self, from_s: f64) -> Cow<'_, Sensors> {
        match self.is_recorded() {
            true => Cow::Borrowed(&self.recorded),
            false => Cow::Owned(self.each(|readings| readings.since(from_s))),
        }
    }

    /// All readings, and sentences about what was left out.
    fn finish(&self) -> (Sensors, Vec<String>) {
        let sensors = self.each(Readings::finish);
        let mut warnings = Vec::new();
        for heard in &self.heard {
            warnings.extend(heard.readings().iter().filter_map(Readings::warning));
        }
        (sensors, warnings)
    }

    /// Sentences since the last call.
    fn take_news(&self) -> Vec<String> {
        let mut news = Vec::new();
        for heard in &self.heard {
            heard.readings().iter_mut().for_each(|readings| news.extend(readings.take_news()));
        }
        news
    }
}

impl Drop for LiveSensors {
    fn drop(&mut self) {
        self.heard.iter().for_each(|heard| heard.is_ended.store(true, Ordering::Relaxed));
    }
}
