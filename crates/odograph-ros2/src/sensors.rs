//! Records of sensors beside the camera, as they come.

use odograph::filter::fusion::SensorRecord;
use odograph_video::LiveTopic;

/// Largest number of samples of a sensor: nearly three hours at 200 Hz, and 64 MB of a gyroscope.
const MOST: usize = 2_000_000;

/// The record of a sensor.
#[derive(Debug)]
pub struct GrowingRecord {
    topic: LiveTopic,
    times_s: Vec<f64>,
    channels: Vec<Vec<f64>>,
    left_out: u64,
}

impl GrowingRecord {
    pub fn new(topic: LiveTopic) -> Self {
        Self { topic, times_s: Vec::new(), channels: Vec::new(), left_out: 0 }
    }

    /// Takes a message; one whose time is not after the one before, or without a measurement, is
    /// left out.
    pub fn take(&mut self, message: &[u8]) {
        let measured = self.topic.stamp_ns(message).map(LiveTopic::seconds).zip(self.topic.values(message));
        let Some((time_s, values)) = measured else { return };
        if self.times_s.last().is_some_and(|last_s| time_s <= *last_s) {
            return;
        }
        if self.times_s.len() >= MOST {
            self.left_out += 1;
            return;
        }
        self.times_s.push(time_s);
        self.channels.resize(values.len(), Vec::new());
        self.channels.iter_mut().zip(values).for_each(|(channel, value)| channel.push(value));
    }

    /// What is missing, as a sentence.
    pub fn defect(&self) -> Option<String> {
        let name = self.topic.name();
        match self.times_s.len() {
            count @ 0..2 => {
                Some(format!("{name} is not used: it had {count} measurements, and two are the least"))
            }
            _ if self.left_out > 0 => Some(format!("{name}: only its first {MOST} measurements are used")),
            _ => None,
        }
    }

    /// The record; `None` if it is too short.
    pub fn finish(self) -> Option<SensorRecord> {
        SensorRecord::new(self.topic.quantity()?, self.times_s, self.channels).ok()
    }
}
