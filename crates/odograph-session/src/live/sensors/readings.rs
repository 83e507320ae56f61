//! Readings of one sensor as they come: understood, put in order, and by the clock of the frames.

use odograph::filter::fusion::{LONGEST_DELAY_S, Quantity, SensorKind, SensorRecord};
use odograph::formats::sensor_file;
use serde_json::Value;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// Readings by whose arrival the clock of a sensor is compared with that of the frames, and the
/// time over which they arrive, seconds: a pipe may have some that are seconds old.
const CLOCK_READINGS: usize = 10;
const CLOCK_S: f64 = 1.0;
/// A reading that is this far from its arrival is by another clock than those before, seconds.
const CLOCK_JUMP_S: f64 = 5.0;
/// How much later than the newest reading an earlier one may come, seconds.
const LATE_S: f64 = 1.0;
/// Readings in a row that disagree with those before until they are believed.
const SUSPECTS: usize = 3;
/// A sender that has been silent for this time is replaced by another one.
const SENDER_SILENT: Duration = Duration::from_secs(2);
/// Longest time between a frame and a reading for which its arrival is known by the frame's time.
const LONGEST_GAP: Duration = Duration::from_secs(2);
/// Most readings that are kept: a day of a gyroscope at 100 Hz.
const MOST: usize = 10_000_000;

const SENSORS: [SensorKind; 4] =
    [SensorKind::Gyro, SensorKind::Heading, SensorKind::Wheel, SensorKind::Range];

/// A reading: time, seconds, and up to three channels.
type Sample = (f64, [f64; 3]);

/// The readings of one sensor.
#[derive(Debug)]
pub struct Readings {
    pub sensor: SensorKind,
    /// Where they come from.
    pub name: String,
    /// Names of the columns of CSV, once they are known.
    columns: Vec<String>,
    quantity: Option<Quantity>,
    /// What is added to the times of the readings; `None` until it is known.
    offset_s: Option<f64>,
    /// Arrival, and arrival minus time, of readings in a row from which the offset is to be found.
    leads_s: Vec<(f64, f64)>,
    /// By the sensor's clock, until the offset is known.
    waiting: Vec<Sample>,
    /// In order, by the clock of the frames.
    samples: Vec<Sample>,
    /// Newest readings that disagree with those before.
    suspects: Vec<Sample>,
    /// What is added to a distance after its counter began again.
    counted_m: f64,
    left_out: usize,
    first_left_out: Option<String>,
    sender: Option<(SocketAddr, Instant)>,
    other_sender: bool,
    frame: Option<(Instant, f64)>,
    first_frame_s: Option<f64>,
    /// Time of the frames when the newest reading came, seconds.
    heard_s: Option<f64>,
    is_silent: bool,
    news: Vec<String>,
}

impl Readings {
    /// Of a sensor whose readings come from the source of this name.
    pub fn new(sensor: SensorKind, name: String) -> Self {
        Self {
            sensor,
            name,
            columns: Vec::new(),
            quantity: None,
            offset_s: None,
            leads_s: Vec::new(),
            waiting: Vec::new(),
            samples: Vec::new(),
            suspects: Vec::new(),
            counted_m: 0.0,
            left_out: 0,
            first_left_out: None,
            sender: None,
            other_sender: false,
            frame: None,
            first_frame_s: None,
            heard_s: None,
            is_silent: false,
            news: Vec::new(),
        }
    }

    /// A frame was captured: its time, seconds.
    pub fn frame(&mut self, at: Instant, time_s: f64) {
        self.frame = Some((at, time_s));
        let first_s = *self.first_frame_s.get_or_insert(time_s);
        if self.offset_s.is_none() && self.leads_s.is_empty() && time_s - first_s > CLOCK_S {
            self.set_offset(0.0);
        }
        let silent_s = time_s - self.heard_s.unwrap_or(first_s);
        let is_read_ahead = self.samples.last().is_some_and(|(last_s, _)| *last_s >= time_s);
        if silent_s > 2.0 * LONGEST_DELAY_S && !is_read_ahead && !self.is_silent {
            self.is_silent = true;
            self.news.push(match self.heard_s {
                Some(heard_s) => format!(
                    "the {} {} has sent no reading since {heard_s:.1} s; look at its cable and its program",
                    self.sensor, self.name
                ),
                None => format!(
                    "the {} {} has not sent any reading yet; look at its cable and its program",
                    self.sensor, self.name
                ),
            });
        }
    }

    /// Takes a line, CSV or JSON.
    pub fn take(&mut self, line: &str, arrived: Option<Instant>, sender: Option<SocketAddr>) {
        let line = line.trim().trim_start_matches('\u{feff}');
        if line.is_empty() || line.starts_with('#') {
            return;
        }
        match self.understood(line) {
            Ok(Some((quantity, sample))) => {
                if self.is_of_sender(sender) {
                    self.add(quantity, sample, arrived);
                }
            }
            Ok(None) => {}
            Err(why) => self.leave_out(why),
        }
    }

    /// The reading in a line; `None` for a line that has none of this sensor.
    fn understood(&mut self, line: &str) -> Result<Option<(Quantity, Sample)>, String> {
        let shown: String = line.chars().take(40).collect();
        if line.starts_with('{') {
            let object: Value =
                serde_json::from_str(line).map_err(|_| format!("{shown:?} is no JSON object on one line"))?;
            let value = |name: &str| object.get(name).and_then(Value::as_f64);
            // A line may be of another sensor of the same robot.
            let Some((quantity, values)) = sensor_file::reading(self.sensor, value) else { return Ok(None) };
            let time_s = value("time_s").ok_or_else(|| format!("{shown:?} has no number time_s"))?;
            return Ok(Some((quantity, sample(time_s, &values))));
        }
        let is_between = |c: char| c.is_whitespace() || c == ',' || c == ';' || c == '"';
        let words: Vec<&str> = line.split(is_between).filter(|word| !word.is_empty()).collect();
        if words.iter().any(|word| word.eq_ignore_ascii_case("time_s")) {
            let columns: Vec<String> = words.iter().map(|word| word.to_ascii_lowercase()).collect();
            if SENSORS.iter().all(|sensor| !names(&columns, *sensor)) {
                // Known columns stay: this line may be damaged.
                let wanted = sensor_file::columns(self.sensor);
                return Err(format!("{shown:?} must name the columns, time_s and {wanted}"));
            }
            self.columns = columns;
            return Ok(None);
        }
        if self.columns.is_empty() {
            let columns = sensor_file::columns(self.sensor);
            return Err(format!(
                "{shown:?} comes before a line with the names of the columns, time_s and {columns}"
            ));
        }
        // The lines of a source that sensors share may be of another one.
        if !names(&self.columns, self.sensor) {
            return Ok(None);
        }
        if words.len() != self.columns.len() {
            return Err(format!("{shown:?} has not as many values as the {} columns", self.columns.len()));
        }
        let value = |name: &str| {
            let at = self.columns.iter().position(|column| column == name)?;
            words[at].parse::<f64>().ok().filter(|value| value.is_finite())
        };
        let time_s = value("time_s").filter(|time_s| time_s.abs() < 1e15);
        match (time_s, sensor_file::reading(self.sensor, value)) {
            (Some(time_s), Some((quantity, values))) => Ok(Some((quantity, sample(time_s, &values)))),
            _ => Err(format!("{shown:?} has something else where a finite number belongs")),
        }
    }

    fn leave_out(&mut self, why: String) {
        self.left_out += 1;
        self.first_left_out.get_or_insert(why);
    }

    /// Whether a reading is of the sender whose readings are used: two at once would be mixed up.
    fn is_of_sender(&mut self, sender: Option<SocketAddr>) -> bool {
        let Some(sender) = sender else { return true };
        let now = Instant::now();
        match &mut self.sender {
            Some((known, heard)) if *known == sender => *heard = now,
            Some((known, heard)) if now.duration_since(*heard) < SENDER_SILENT => {
                if !self.other_sender {
                    self.other_sender = true;
                    self.news.push(format!(
                        "the {} {} has two senders, {known} and {sender}: only the first is used; end the other one, or give it another port",
                        self.sensor, self.name
                    ));
                }
                self.leave_out(format!("it came from {sender}, a second sender"));
                return false;
            }
            _ => self.sender = Some((sender, now)),
        }
        true
    }

    fn add(&mut self, quantity: Quantity, sample: Sample, arrived: Option<Instant>) {
        if *self.quantity.get_or_insert(quantity) != quantity {
            self.leave_out("it has other columns than the lines before".to_owned());
            return;
        }
        if self.samples.len() + self.waiting.len() >= MOST {
            self.leave_out(format!("there are {MOST} readings already"));
            return;
        }
        let arrival_s = arrived.zip(self.frame).and_then(|(arrived, (at, time_s))| {
            let since = arrived.saturating_duration_since(at);
            (since <= LONGEST_GAP).then_some(time_s + since.as_secs_f64())
        });
        if let Some(arrival_s) = arrival_s {
            self.heard_s = Some(arrival_s);
            if std::mem::take(&mut self.is_silent) {
                self.news.push(format!("the {} {} sends readings again", self.sensor, self.name));
            }
        }
        let lead = arrival_s.map(|arrival_s| (arrival_s, arrival_s - sample.0));
        let Some(offset_s) = self.offset_s else {
            self.waiting.push(sample);
            self.leads_s.extend(lead);
            if self.has_enough_leads() {
                self.compare_clocks();
            }
            return;
        };
        if lead.is_some_and(|(_, lead_s)| (lead_s - offset_s).abs() > CLOCK_JUMP_S) {
            self.leads_s.extend(lead);
            if self.has_enough_leads() {
                self.compare_clocks();
                self.news.push(format!(
                    "the clock of the {} {} has jumped; its readings count from there on",
                    self.sensor, self.name
                ));
            } else {
                self.leave_out(format!("its time {} s is by another clock than those before", sample.0));
            }
            return;
        }
        self.leads_s.clear();
        self.sort_in((sample.0 + offset_s, sample.1));
    }

    fn has_enough_leads(&self) -> bool {
        let (first, last) = (self.leads_s.first(), self.leads_s.last());
        let span_s = first.zip(last).map_or(0.0, |(first, last)| last.0 - first.0);
        self.leads_s.len() >= CLOCK_READINGS && span_s >= CLOCK_S
    }

    /// The sensor's clock is taken for that of the frames where its readings come when these say
    /// so; otherwise its offset is that of the reading that was delayed the least.
    fn compare_clocks(&mut self) {
        let least_s = self.leads_s.iter().map(|(_, lead_s)| *lead_s).min_by(f64::total_cmp).unwrap_or(0.0);
        self.set_offset(if least_s.abs() <= LONGEST_DELAY_S { 0.0 } else { least_s });
    }

    fn set_offset(&mut self, offset_s: f64) {
        self.leads_s.clear();
        self.offset_s = Some(offset_s);
        for (time_s, values) in std::mem::take(&mut self.waiting) {
            self.sort_in((time_s + offset_s, values));
        }
    }

    /// Puts a reading where it belongs by its time.
    fn sort_in(&mut self, mut sample: Sample) {
        if self.quantity == Some(Quantity::Way) {
            sample.1[0] += self.counted_m;
        }
        let Some(&last) = self.samples.last() else {
            self.samples.push(sample);
            return;
        };
        if sample.0 <= last.0 {
            let at = self.samples.partition_point(|(time_s, _)| *time_s < sample.0);
            if self.samples[at].0 == sample.0 {
                self.leave_out(format!("its time {} s has been before", sample.0));
            } else if last.0 - sample.0 > LATE_S {
                self.leave_out(format!("its time {} s is before {} s, which was there", sample.0, last.0));
            } else {
                self.samples.insert(at, sample);
            }
            return;
        }
        if self.follows(&last, &sample) {
            for (time_s, _) in std::mem::take(&mut self.suspects) {
                self.leave_out(format!("the reading at {time_s:.3} s jumps where no carrier can"));
            }
            self.samples.push(sample);
            return;
        }
        if self.suspects.last().is_some_and(|suspect| !self.follows(suspect, &sample)) {
            for (time_s, _) in std::mem::take(&mut self.suspects) {
                self.leave_out(format!("the reading at {time_s:.3} s jumps where no carrier can"));
            }
        }
        self.suspects.push(sample);
        if self.suspects.len() >= SUSPECTS {
            self.believe_suspects(&last);
        }
    }

    /// Readings in a row that agree with each other, but not with those before.
    fn believe_suspects(&mut self, last: &Sample) {
        let mut suspects = std::mem::take(&mut self.suspects);
        if self.quantity == Some(Quantity::Way) {
            let jump_m = suspects[0].1[0] - last.1[0];
            self.counted_m -= jump_m;
            suspects.iter_mut().for_each(|(_, values)| values[0] -= jump_m);
            self.news.push(format!(
                "the distance of the wheel {} jumps by {jump_m:.2} m at {:.1} s, which is taken for a counter that began again",
                self.name, suspects[0].0
            ));
        }
        self.samples.extend(suspects);
    }

    /// Whether a carrier can move so that one reading follows another.
    fn follows(&self, before: &Sample, next: &Sample) -> bool {
        let duration_s = next.0 - before.0;
        let (at_once, per_s) = match self.quantity {
            Some(Quantity::TurnRate | Quantity::TurnRates) => (5.0, 100.0),
            Some(Quantity::Speed) => (2.0, 20.0),
            Some(Quantity::Way) => (1.0, 20.0),
            _ => return true,
        };
        before.1.iter().zip(&next.1).all(|(a, b)| (b - a).abs() <= at_once + per_s * duration_s.max(0.0))
    }

    /// The readings from a time on; `None` if there are not two.
    pub fn since(&self, from_s: f64) -> Option<SensorRecord> {
        let first = self.samples.partition_point(|(time_s, _)| *time_s < from_s);
        let samples = &self.samples[first..];
        let quantity = self.quantity?;
        let channels = if quantity == Quantity::TurnRates { 3 } else { 1 };
        let values = (0..channels).map(|at| samples.iter().map(|(_, values)| values[at]).collect()).collect();
        SensorRecord::new(quantity, samples.iter().map(|(time_s, _)| *time_s).collect(), values).ok()
    }

    /// All readings, those included whose clock was never compared.
    pub fn finish(&mut self) -> Option<SensorRecord> {
        if self.offset_s.is_none() {
            self.compare_clocks();
        }
        self.since(f64::NEG_INFINITY)
    }

    /// Sentences since the last call.
    pub fn take_news(&mut self) -> Vec<String> {
        std::mem::take(&mut self.news)
    }

    /// What was left out.
    pub fn warning(&self) -> Option<String> {
        let first = self.first_left_out.as_ref()?;
        let lines = match self.left_out {
            1 => "1 line was".to_owned(),
            count => format!("{count} lines were"),
        };
        Some(format!("the {} {}: {lines} left out, the first because {first}", self.sensor, self.name))
    }
}

/// Whether columns are those of a sensor.
fn names(columns: &[String], sensor: SensorKind) -> bool {
    let named = |name: &str| columns.iter().any(|column| column == name).then_some(0.0);
    sensor_file::reading(sensor, named).is_some()
}

fn sample(time_s: f64, values: &[f64]) -> Sample {
    let mut channels = [0.0; 3];
    channels.iter_mut().zip(values).for_each(|(channel, value)| *channel = *value);
    (time_s, channels)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    fn wheel() -> Readings {
        let mut readings = Readings::new(SensorKind::Wheel, "udp:1".to_owned());
        readings.set_offset(0.0);
        readings
    }

    fn taken(readings: &mut Readings, lines: &[&str]) -> Vec<(f64, f64)> {
        lines.iter().for_each(|line| readings.take(line, None, None));
        readings.samples.iter().map(|(time_s, values)| (*time_s, values[0])).collect()
    }

    #[test]
    fn lines_of_csv_and_json_are_read_alike() {
        let csv = ["# robot", "time_s,speed_m_s", "0,0.5", "0.1,0.6"];
        assert_eq!(taken(&mut wheel(), &csv), [(0.0, 0.5), (0.1, 0.6)]);
        let json = [
            "{\"time_s\":0,\"speed_m_s\":0.5,\"battery\":\"full\"}",
            "{\"time_s\":0.1,\"rate_rad_s\":2.0}",
            "{\"time_s\":0.2,\"speed_m_s\":0.6}",
        ];
        let mut readings = wheel();
        assert_eq!(taken(&mut readings, &json), [(0.0, 0.5), (0.2, 0.6)]);
        // Two sensors that write into one pipe, each with its columns.
        let shared = ["time_s,rate_rad_s", "0.3,9", "time_s,speed_m_s", "0.4,0.6"];
        assert_eq!(taken(&mut readings, &shared), [(0.0, 0.5), (0.2, 0.6), (0.4, 0.6)]);
        assert_eq!(readings.warning(), None);
    }

    #[test]
    fn garbage_is_left_out_in_one_sentence() {
        let mut readings = wheel();
        let lines = ["1,2", "time_s,speed_m_s", "0,0.5", "0.1", "0.2,fast", "0.3,nan", "{}}", "time_s,x"];
        assert_eq!(taken(&mut readings, &lines), [(0.0, 0.5)]);
        assert_eq!(taken(&mut readings, &["0.4,0.5"]), [(0.0, 0.5), (0.4, 0.5)]);
        let warning = readings.warning().unwrap();
        assert!(
            warning.starts_with("the wheel udp:1: 6 lines were left out, the first because"),
            "{warning}"
        );
        assert!(warning.contains("names of the columns, time_s and speed_m_s"), "{warning}");
    }

    #[test]
    fn late_readings_are_sorted_in_and_repeated_ones_left_out() {
        let mut readings = wheel();
        let lines = ["time_s,speed_m_s", "1.0,0.1", "1.2,0.3", "1.1,0.2", "1.2,0.9", "0.1,0.0"];
        assert_eq!(taken(&mut readings, &lines), [(1.0, 0.1), (1.1, 0.2), (1.2, 0.3)]);
        assert_eq!(readings.left_out, 2);
    }

    #[test]
    fn a_spike_is_left_out_and_a_counter_that_begins_again_is_continued() {
        let lines = ["time_s,speed_m_s", "0,0.5", "0.1,90", "0.2,0.5"];
        assert_eq!(taken(&mut wheel(), &lines), [(0.0, 0.5), (0.2, 0.5)]);
        let mut readings = wheel();
        let lines = ["time_s,distance_m", "0,100.0", "0.1,100.1", "0.2,0.0", "0.3,0.1", "0.4,0.2", "0.5,0.3"];
        let samples = taken(&mut readings, &lines);
        let distances: Vec<f64> = samples.iter().map(|(_, distance)| *distance).collect();
        for (distance, expected) in distances.iter().zip([100.0, 100.1, 100.1, 100.2, 100.3, 100.4]) {
            assert!((distance - expected).abs() < 1e-9, "{distances:?}");
        }
        assert_eq!(distances.len(), 6);
        assert!(readings.take_news()[0].contains("counter that began again"));
    }

    #[test]
    fn a_foreign_clock_is_known_by_the_arrivals() {
        let began = Instant::now();
        let mut readings = Readings::new(SensorKind::Wheel, "pipe".to_owned());
        readings.take("time_s,speed_m_s", Some(began), None);
        for tenth in 0..20 {
            let since = Duration::from_millis(100 * tenth);
            readings.frame(began + since, 7.0 + since.as_secs_f64());
            let line = format!("{},0.5", 1.7e9 + since.as_secs_f64());
            readings.take(&line, Some(began + since + Duration::from_millis(20)), None);
        }
        let record = readings.since(0.0).unwrap();
        assert!((record.span_s().0 - 7.02).abs() < 1e-6, "{:?}", record.span_s());
        // Of the same clock, they are late only.
        let mut readings = Readings::new(SensorKind::Wheel, "pipe".to_owned());
        readings.take("time_s,speed_m_s", Some(began), None);
        for tenth in 0..20 {
            let since = Duration::from_millis(100 * tenth);
            readings.frame(began + since, since.as_secs_f64());
            readings.take(&format!("{},0.5", since.as_secs_f64() - 0.3), Some(began + since), None);
        }
        assert!((readings.since(-1.0).unwrap().span_s().0 + 0.3).abs() < 1e-9);
    }

    #[test]
    fn a_sensor_that_dies_and_a_second_sender_are_told_once() {
        let began = Instant::now();
        let mut readings = wheel();
        let senders: Vec<SocketAddr> =
            ["127.0.0.1:7", "127.0.0.1:8"].iter().map(|text| text.parse().unwrap()).collect();
        readings.frame(began, 0.0);
        for (time_s, sender) in [(0.0, 0), (0.1, 1), (0.2, 0), (0.3, 1)] {
            let line = format!("{{\"time_s\":{time_s},\"speed_m_s\":0.5}}");
            readings.take(&line, Some(began), Some(senders[sender]));
        }
        assert_eq!(readings.samples.len(), 2);
        let news = readings.take_news();
        assert!(news.len() == 1 && news[0].contains("two senders"), "{news:?}");
        (0..50).for_each(|tenth| readings.frame(began, 0.1 * f64::from(tenth)));
        let news = readings.take_news();
        assert!(news.len() == 1 && news[0].contains("no reading since 0.0 s"), "{news:?}");
    }
}
