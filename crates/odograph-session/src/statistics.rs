//! The figures of a run: `stats.json` and the summary.

use crate::budget::Budget;
use crate::found::{FixedInImage, FoundLens, FoundMount, FoundReadout};
use crate::timings::Timings;
use odograph::error::{Error, Result};
use odograph::filter::fusion::{SensorKind, SensorParameter, SensorReport};
use serde::Serialize;
use std::collections::BTreeMap;
use std::time::Duration;

/// The figures of a run, as `stats.json` has them. Documented in `docs/output.md`.
#[derive(Debug, Clone, Serialize)]
pub struct Statistics {
    /// Frames taken from the source.
    pub frames: u64,
    /// Frames whose pose was measured.
    pub frames_with_pose: u64,
    /// From the first to the last frame, seconds of the recording.
    pub duration_s: f64,
    /// Length of the measured path, metres; gaps do not count.
    pub distance_m: f64,
    /// Frames a second of the whole run, writing included.
    pub fps: f64,
    /// Frames a second had decoding cost nothing.
    pub fps_without_decoding: f64,
    /// Time a frame by stage.
    pub stages: BTreeMap<&'static str, StageTime>,
    /// Keyframes made.
    pub keyframes: u64,
    /// Stretches without a pose.
    pub losses: u64,
    /// Ground that was seen again, and what it did to the path.
    pub loops: LoopStatistics,
    /// The most memory the program had, bytes; `null` where the system does not tell.
    pub peak_memory_bytes: Option<u64>,
    /// What was reduced for a time budget, and whether it was kept; left out without a budget.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub budget: Option<BudgetStatistics>,
    /// The mount, if it was found to differ from what was given; left out otherwise.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mount: Option<FoundMount>,
    /// The lens distortion, if it was found to differ from the camera file; left out otherwise.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lens: Option<FoundLens>,
    /// The readout time of the image, and whether it was given or learned; left out where neither.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub readout: Option<FoundReadout>,
    /// What of the image does not move with the ground.
    pub fixed_in_image: FixedInImage,
    /// Whether the run was ended early by a signal.
    pub interrupted: bool,
    /// How many frames an interrupted run would have had; left out where the source does not say,
    /// and of whole runs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frames_announced: Option<u64>,
    /// How the run kept up with its source; left out of runs over recordings.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub live: Option<LiveStatistics>,
    /// Results of the other sensors; left out if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub sensors: Vec<SensorStatistics>,
}

/// What was seen again, and what that did.
#[derive(Debug, Clone, Serialize)]
pub struct LoopStatistics {
    /// Places that the map recognised.
    pub closed: u64,
    /// Keyframes that odometry itself came back to.
    pub revisited: u64,
    /// How far poses were moved by it, root mean square over the frames, metres.
    pub correction_rms_m: f64,
    /// The same, the most.
    pub correction_most_m: f64,
    /// Heading drift for each metre ahead and to the left as the loops show it, radians.
    pub turn_per_m: [f64; 2],
    /// Time a keyframe.
    pub keyframe: StageTime,
}

/// How a live run kept up with its source.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LiveStatistics {
    /// Frames that came from the source.
    pub frames_captured: u64,
    /// Frames that gave way to newer ones because tracking was too slow.
    pub frames_dropped: u64,
    /// Posed frames that were not looked at for the mosaic because laying was too slow.
    pub frames_not_laid: u64,
    /// Keyframes that were not compared with older ones because the map was behind.
    pub keyframes_not_compared: u64,
    /// How often the source went away and came back.
    pub reconnects: u64,
    /// From capture to pose, milliseconds, median.
    pub latency_median_ms: f64,
    /// From capture to pose, milliseconds; 99 of 100 frames are quicker.
    pub latency_p99_ms: f64,
    /// From capture to pose, milliseconds, the slowest frame.
    pub latency_most_ms: f64,
}

impl LoopStatistics {
    /// For people, a line; empty without loops.
    pub fn summary(&self) -> String {
        match self.closed + self.revisited {
            0 => String::new(),
            loops => format!(
                "ground recognised {loops} times; the path moved by up to {:.1} mm\n",
                1e3 * self.correction_most_m
            ),
        }
    }
}

/// A budget for the time of a frame, and what became of it.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct BudgetStatistics {
    /// The budget, and what was given up for it.
    #[serde(flatten)]
    pub given_up: Budget,
    /// Frames that took longer to track than that by more than a hundredth.
    pub frames_over: u64,
}

impl BudgetStatistics {
    pub(crate) fn new(budget: Budget, track: &Timings) -> Self {
        let frames_over = track.longer_than(Duration::from_secs_f64(1e-3 * budget.frame_ms));
        Self { given_up: budget, frames_over }
    }
}

/// The result of a sensor beside the camera.
#[derive(Debug, Clone, Serialize)]
pub struct SensorStatistics {
    /// Which one.
    pub sensor: SensorKind,
    /// Whether it was believed.
    pub used: bool,
    /// Why not.
    pub reason: Option<String>,
    /// Its clock less the recording's, seconds; 0 where the movement does not tell.
    pub time_offset_s: Option<f64>,
    /// One standard deviation of it; `null` where the movement does not tell.
    pub time_offset_sigma_s: Option<f64>,
    /// Scale, bias and mounting as found.
    pub parameters: Vec<SensorParameter>,
    /// Standard deviation of its integral over a second (gyro, wheel) or of a second's reading
    /// (heading, range), radians or metres.
    pub noise: Option<f64>,
    /// Seconds in which it was compared with the camera.
    pub seconds: usize,
    /// In how many of them it contradicts the camera.
    pub contradictions: usize,
    /// Mean normalised innovation squared.
    pub nis: Option<f64>,
}

impl SensorStatistics {
    pub(crate) fn new(report: &SensorReport) -> Self {
        let offset = report.offset;
        Self {
            sensor: report.sensor,
            used: report.rejected.is_none(),
            reason: report.rejected.map(|reason| reason.to_string()),
            time_offset_s: offset.map(|offset| offset.offset_s),
            time_offset_sigma_s: offset.map(|offset| offset.sigma_s).filter(|sigma_s| sigma_s.is_finite()),
            parameters: report.parameters.clone(),
            noise: report.noise,
            seconds: report.seconds,
            contradictions: report.contradictions,
            nis: report.nis,
        }
    }
}

/// How long a stage takes.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct StageTime {
    /// Mean over all frames, milliseconds.
    pub mean_ms: f64,
    /// 99 of 100 frames take at most this long, milliseconds.
    pub p99_ms: f64,
}

impl StageTime {
    pub(crate) fn of(timings: &Timings) -> Self {
        Self { mean_ms: timings.mean_ms(), p99_ms: timings.quantile_ms(0.99) }
    }
}

impl Statistics {
    /// As JSON text.
    ///
    /// # Errors
    /// If JSON cannot express a value.
    pub fn json(&self) -> Result<String> {
        serde_json::to_string_pretty(self).map_err(|error| {
            Error::output(format!("the statistics cannot be written as JSON: {error}")).caused_by(error)
        })
    }

    /// Where an interrupted run ended, for people; `None` where it was not interrupted, or ended as
    /// live runs do.
    pub fn interruption(&self) -> Option<String> {
        let interrupted = self.interrupted && self.live.is_none();
        interrupted.then(|| interruption(self.frames, self.frames_announced))
    }

    /// For people, a few lines.
    pub fn summary(&self) -> String {
        let lost = match self.losses {
            0 => "never lost".to_owned(),
            1 => "lost once".to_owned(),
            n => format!("lost {n} times"),
        };
        let used = self.sensors.iter().filter(|sensor| sensor.used).map(|sensor| sensor.sensor.to_string());
        let used: Vec<String> = used.collect();
        let loops = self.loops.summary();
        let fixed = self.fixed_in_image.sentence();
        let sensors = match used.is_empty() {
            true => String::new(),
            false => format!("beside the camera: {}\n", used.join(", ")),
        };
        format!(
            "{:.2} m in {:.1} s; {} of {} frames with a pose, {lost}; {} keyframes\n{:.0} frames/s ({:.0} without decoding)\n{loops}{sensors}{fixed}",
            self.distance_m,
            self.duration_s,
            self.frames_with_pose,
            self.frames,
            self.keyframes,
            self.fps,
            self.fps_without_decoding,
        )
    }
}

/// Where a run of so many frames was interrupted.
pub(crate) fn interruption(frames: u64, announced: Option<u64>) -> String {
    match announced {
        Some(announced) => format!("interrupted after {frames} of {announced} frames"),
        None => format!("interrupted after {frames} frames"),
    }
}

/// The high-water mark of resident memory, from Linux's `/proc`.
pub(crate) fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kilobytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(1024 * kilobytes)
}
