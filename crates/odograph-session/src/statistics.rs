//! Statistics of a run: `stats.json` and the summary.

use crate::budget::Budget;
use crate::earth_statistics::GnssStatistics;
use crate::found::{FixedInImage, FoundLens, FoundMount, FoundReadout};
use crate::marker_statistics::MarkerStatistics;
use crate::timings::{StageTime, Timings};
use odograph::drawing::scale::length_text;
use odograph::error::{Error, Result};
use odograph::filter::fusion::{SensorKind, SensorParameter, SensorReport};
use odograph::image::ImageDefects;
use serde::Serialize;
use std::collections::BTreeMap;
use std::time::Duration;

/// Statistics of a run, as in `stats.json`. Documented in `docs/output.md`.
#[derive(Debug, Clone, Serialize)]
pub struct RunStatistics {
    /// Frames taken from the source.
    pub frames: u64,
    /// Frames whose pose was measured.
    pub frames_with_pose: u64,
    /// Duration from the first to the last frame, seconds of the recording.
    pub duration_s: f64,
    /// Length of the measured path, metres; gaps do not count.
    pub distance_m: f64,
    /// Frames per second of the whole run, including writing.
    pub fps: f64,
    /// Time per frame by stage.
    pub stages: BTreeMap<&'static str, StageTime>,
    /// Number of keyframes.
    pub keyframes: u64,
    /// Gaps without a pose.
    pub losses: u64,
    /// Loop closures and their effect on the path.
    pub loops: LoopStatistics,
    /// Peak memory of the program, bytes; `null` where the system does not report it.
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
    /// What was wrong with the images; each is left out where it was not there.
    #[serde(flatten)]
    pub defects: ImageDefects,
    /// Mask of what is static in the image.
    pub fixed_in_image: FixedInImage,
    /// Whether the run was ended early by a signal.
    pub interrupted: bool,
    /// Warnings about the run, one sentence each; empty if there are none.
    pub warnings: Vec<String>,
    /// Number of frames that a run that was ended early would have had; left out where the source
    /// does not state it, and of complete runs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frames_announced: Option<u64>,
    /// Drops and latencies of a live run; left out of runs over recordings.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub live: Option<LiveStatistics>,
    /// Markers on the ground; left out if none are looked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub markers: Option<MarkerStatistics>,
    /// Results of the other sensors; left out if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub sensors: Vec<SensorStatistics>,
    /// Result of the satellite receiver; left out if there is none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gnss: Option<GnssStatistics>,
}

/// Loop closures and their effect.
#[derive(Debug, Clone, Serialize)]
pub struct LoopStatistics {
    /// Loop closures of the map.
    pub closed: u64,
    /// Revisited keyframes of the odometry.
    pub revisited: u64,
    /// Displacement of the poses by loops, root mean square over the frames, metres.
    pub correction_rms_m: f64,
    /// Largest displacement, metres.
    pub correction_most_m: f64,
    /// Heading drift for each metre ahead and to the left as the loops show it, radians.
    pub turn_per_m: [f64; 2],
    /// Time per keyframe.
    pub keyframe: StageTime,
}

/// Drops and latencies of a live run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LiveStatistics {
    /// Frames from the source.
    pub frames_captured: u64,
    /// Frames dropped because tracking was too slow.
    pub frames_dropped: u64,
    /// Posed frames left out of the mosaic because rendering was too slow.
    pub frames_not_laid: u64,
    /// Keyframes without a search for loops and markers because the map was behind.
    pub keyframes_not_compared: u64,
    /// Number of reconnections of the source.
    pub reconnects: u64,
    /// From capture to pose, milliseconds, median.
    pub latency_median_ms: f64,
    /// From capture to pose, milliseconds; 99 of 100 frames are quicker.
    pub latency_p99_ms: f64,
    /// From capture to pose, milliseconds, the slowest frame.
    pub latency_most_ms: f64,
}

impl LiveStatistics {
    /// One line; empty if no frame was dropped.
    fn summary(&self) -> String {
        match self.frames_dropped {
            0 => String::new(),
            dropped => format!(
                "{dropped} of {} frames dropped, because they came faster than they could be tracked\n",
                self.frames_captured
            ),
        }
    }
}

impl LoopStatistics {
    /// One line; empty without loops. The pictures show the places that were recognised, and not
    /// those that odometry came back to.
    pub fn summary(&self) -> String {
        let (what, count) = match (self.closed, self.revisited) {
            (0, 0) => return String::new(),
            (0, revisited) => ("the camera came back to an earlier keyframe", revisited),
            (closed, _) => ("ground recognised", closed),
        };
        let times = if count == 1 { "once".to_owned() } else { format!("{count} times") };
        format!("{what} {times}; the path moved by up to {}\n", length_text(self.correction_most_m))
    }
}

/// The time budget of a frame, and whether it was met.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct BudgetStatistics {
    /// The budget and the parameters reduced for it.
    #[serde(flatten)]
    pub given_up: Budget,
    /// Frames that exceeded the budget by more than 1 %.
    pub frames_over: u64,
}

impl BudgetStatistics {
    pub(crate) fn new(budget: Budget, track: &Timings) -> Self {
        let frames_over = track.longer_than(Duration::from_secs_f64(1e-3 * budget.frame_ms));
        Self { given_up: budget, frames_over }
    }
}

/// Result of a sensor other than the camera.
#[derive(Debug, Clone, Serialize)]
pub struct SensorStatistics {
    /// Its name.
    pub sensor: SensorKind,
    /// Whether it passed its consistency test and was used.
    pub used: bool,
    /// The reason if it was not used.
    pub reason: Option<String>,
    /// Its clock minus the recording's, seconds; 0 where the motion does not determine it.
    pub time_offset_s: Option<f64>,
    /// Standard deviation of the clock difference; `null` where the motion does not determine it.
    pub time_offset_sigma_s: Option<f64>,
    /// Estimated scale, bias and mounting.
    pub parameters: Vec<SensorParameter>,
    /// Standard deviation of its integral over a second (gyro, wheel) or of a second's reading
    /// (heading, range), radians or metres.
    pub noise: Option<f64>,
    /// Duration of its comparison with the camera, seconds.
    pub seconds: usize,
    /// Number of these seconds in which it contradicts the camera.
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

impl RunStatistics {
    /// As JSON text.
    ///
    /// # Errors
    /// If JSON cannot express a value.
    pub fn json(&self) -> Result<String> {
        serde_json::to_string_pretty(self).map_err(|error| {
            Error::output(format!("the statistics cannot be written as JSON: {error}")).caused_by(error)
        })
    }

    /// State of an interrupted run; `None` if it was not interrupted, or ended as live runs do.
    pub fn interruption(&self) -> Option<String> {
        let interrupted = self.interrupted && self.live.is_none();
        interrupted.then(|| interruption(self.frames, self.frames_announced))
    }

    /// State of a run that ended before its recording did: interrupted, or a live run over a
    /// recording that was stopped. `None` for any other, and for a stopped camera, which has no
    /// end.
    pub fn stopped_early(&self) -> Option<String> {
        let announced = self.frames_announced;
        self.interrupted.then(|| stopped_early(self.frames, announced, self.live.as_ref())).flatten()
    }

    /// A summary of a few lines.
    pub fn summary(&self) -> String {
        // The path of a microscope is no 0.00 m.
        let distance = match self.distance_m {
            short if (1e-6..0.1).contains(&short) => length_text(short),
            distance_m => format!("{distance_m:.2} m"),
        };
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
        let markers = self.markers.as_ref().map_or_else(String::new, MarkerStatistics::summary);
        let dropped = self.live.as_ref().map_or_else(String::new, LiveStatistics::summary);
        let on_earth = self.gnss.as_ref().map_or_else(String::new, GnssStatistics::summary);
        format!(
            "{distance} in {:.1} s; {} of {} frames with a pose, {lost}; {} keyframe{}\n\
             {:.0} frames/s, decoding and writing included\n{dropped}{loops}{markers}{sensors}{on_earth}{fixed}",
            self.duration_s,
            self.frames_with_pose,
            self.frames,
            self.keyframes,
            if self.keyframes == 1 { "" } else { "s" },
            self.fps,
        )
    }
}

/// State of a run with this number of frames that was asked to stop; `None` for a live run that has
/// all frames of its recording, or whose source announced none, as a camera does.
pub(crate) fn stopped_early(
    frames: u64,
    announced: Option<u64>,
    live: Option<&LiveStatistics>,
) -> Option<String> {
    let is_whole =
        live.is_some_and(|live| announced.is_none_or(|announced| frames + live.frames_dropped >= announced));
    (!is_whole).then(|| interruption(frames, announced))
}

/// State of an interrupted run with this number of frames.
fn interruption(frames: u64, announced: Option<u64>) -> String {
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
