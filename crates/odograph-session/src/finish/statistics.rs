//! The statistics of a finished run.

use crate::budget::Budget;
use crate::earth_statistics::GnssStatistics;
use crate::marker_statistics::MarkerStatistics;
use crate::pipeline::Tracked;
use crate::statistics::{
    BudgetStatistics, LoopStatistics, RunStatistics, SensorStatistics, peak_memory_bytes,
};
use crate::timings::StageTime;
use odograph::filter::fusion::SensorReport;
use odograph::trajectory::{FrameSummary, TrackStatus, distance_m};
use std::collections::BTreeMap;
use std::time::Duration;

/// What the loops, the markers and the satellite receiver said of the path.
pub struct Estimated {
    pub loops: LoopStatistics,
    pub markers: Option<MarkerStatistics>,
    pub gnss: Option<GnssStatistics>,
}

/// The statistics of a run that took `elapsed`, from its final frames and its sensors.
pub fn statistics_of(
    tracked: &Tracked,
    frames: &[FrameSummary],
    budget: Option<Budget>,
    sensors: &[SensorReport],
    estimated: Estimated,
    elapsed: Duration,
) -> RunStatistics {
    let posed = |i: usize| frames[i].place.is_some();
    let losses = (0..frames.len()).filter(|&i| !posed(i) && (i == 0 || posed(i - 1))).count();
    let duration_s = match (frames.first(), frames.last()) {
        (Some(first), Some(last)) => last.time_s - first.time_s,
        _ => 0.0,
    };
    let rate = |s: f64| if s > 0.0 { frames.len() as f64 / s } else { 0.0 };
    RunStatistics {
        frames: frames.len() as u64,
        frames_with_pose: frames.iter().filter(|f| f.status == TrackStatus::Tracked).count() as u64,
        duration_s,
        distance_m: distance_m(frames),
        fps: rate(elapsed.as_secs_f64()),
        stages: BTreeMap::from([
            ("decode", StageTime::of(&tracked.times.decode)),
            ("track", StageTime::of(&tracked.times.track)),
            ("self_calibration", StageTime::of(&tracked.times.self_calibration)),
            ("map", StageTime::of(&tracked.times.map)),
        ]),
        keyframes: tracked.keyframes,
        losses: losses as u64,
        loops: estimated.loops,
        peak_memory_bytes: peak_memory_bytes(),
        budget: budget.map(|budget| BudgetStatistics::new(budget, &tracked.times.track)),
        mount: tracked.mount,
        lens: tracked.lens.clone(),
        readout: tracked.readout,
        defects: tracked.defects,
        fixed_in_image: tracked.fixed.clone(),
        interrupted: tracked.interrupted,
        warnings: tracked.warnings.clone(),
        frames_announced: tracked.announced.filter(|_| tracked.interrupted),
        live: tracked.live,
        markers: estimated.markers,
        sensors: sensors.iter().map(SensorStatistics::new).collect(),
        gnss: estimated.gnss,
    }
}
