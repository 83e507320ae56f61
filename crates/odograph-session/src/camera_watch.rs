//! Detection of a mount or lens that differs from the plan.

use crate::found::{CameraDifference, FoundLens, FoundMount};
use crate::observer::Observer;
use crate::output::MapUse;
use crate::plan::RunPlan;
use odograph::camera::{Camera, Rig};
use odograph::error::Result;
use odograph::motion::MotionModel;
use odograph::mounting::{CalibrationMonitor, CalibrationUpdate};
use odograph_map::MapFile;

/// Watches for a different mount or lens during a recording, which is then tracked again with the
/// corrected plan.
pub struct CameraWatch {
    camera: Camera,
    rig: Rig,
    /// Whether the recording is tracked again where mount or lens differ, and where the camera adds
    /// a pattern to its images.
    again: bool,
    again_without_pattern: bool,
    /// Whether the lens is a map's.
    lens_is_known: bool,
    found: Option<CalibrationUpdate>,
}

/// Number of pairs of views from the beginning of the recording that are examined before a map is
/// continued. Not derived; chosen.
const LOOKED_AT: usize = 32;

impl CameraWatch {
    /// For a recording with this plan. Nothing is watched where the plan fixes the motion model, or
    /// where the recording can be read only once.
    pub fn new(plan: &RunPlan) -> Self {
        let chosen = plan.odometry.motion.model == MotionModel::Auto;
        let readable_again =
            std::fs::metadata(&plan.source.path).is_ok_and(|there| there.is_file() || there.is_dir());
        let (camera, rig) = (plan.camera.clone(), plan.rig);
        let again = chosen && readable_again;
        Self { camera, rig, again, again_without_pattern: readable_again, lens_is_known: false, found: None }
    }

    /// The self-calibration for the next pass.
    pub fn watch(&self, plan: &RunPlan) -> Option<CalibrationMonitor> {
        self.again.then(|| {
            let watch = match &self.found {
                Some(found) => CalibrationMonitor::found(&plan.camera, &plan.rig, found),
                None => CalibrationMonitor::new(&plan.camera, &plan.rig),
            };
            if self.lens_is_known { watch.with_lens_known() } else { watch }
        })
    }

    /// The mount, where found to differ from the plan.
    pub fn mount(&self) -> Option<FoundMount> {
        let tilt = self.found.as_ref()?.tilt.as_ref()?;
        Some(FoundMount::new(&self.rig, tilt))
    }

    /// The lens, where found to differ from the plan.
    pub fn lens(&self) -> Option<FoundLens> {
        let lens = self.found.as_ref()?.lens.as_ref()?;
        Some(FoundLens::new(&self.camera, lens))
    }

    /// Whether a pattern that the camera adds to its images ends the next pass.
    pub fn watches_pattern(&self, plan: &RunPlan) -> bool {
        self.again_without_pattern && plan.correction.is_none()
    }

    /// Applies what was found to the plan.
    pub fn take(&mut self, found: CameraDifference, plan: &mut RunPlan) {
        match found {
            CameraDifference::Calibration(found) => self.calibrate(*found, plan),
            CameraDifference::FixedPattern(pattern) => plan.correction = Some(pattern),
        }
    }

    fn calibrate(&mut self, found: CalibrationUpdate, plan: &mut RunPlan) {
        plan.rig = found.rig(&plan.rig);
        plan.camera = found.camera(&plan.camera);
        self.found = Some(found);
    }

    /// A continued map keeps what a run adds, so the beginning of the recording is examined before
    /// the run. The lens is the map's.
    pub fn look_first(&mut self, plan: &mut RunPlan, map: &MapUse, observer: &dyn Observer) -> Result<()> {
        if !map.path().is_some_and(MapFile::is_there) {
            return Ok(());
        }
        self.lens_is_known = true;
        self.again_without_pattern = false;
        while let Some(monitor) = self.watch(plan) {
            match look(plan, monitor, observer)? {
                Some(found) => self.take(found, plan),
                None => self.again = false,
            }
        }
        Ok(())
    }
}

/// Differences of the camera from the plan at the beginning of the recording.
fn look(
    plan: &RunPlan,
    mut monitor: CalibrationMonitor,
    observer: &dyn Observer,
) -> Result<Option<CameraDifference>> {
    let mut source = plan.source.open()?;
    let mut odometry = plan.odometry()?;
    while let Some(frame) = source.next_frame()? {
        let estimate = odometry.process(frame.gray, frame.time_s)?;
        let pattern = odometry.correction().filter(|_| plan.correction.is_none());
        if let Some(pattern) = pattern {
            return Ok(Some(CameraDifference::FixedPattern(pattern.clone())));
        }
        let found = monitor.watch(&estimate, &odometry);
        if found.is_some() || monitor.pairs() >= LOOKED_AT || observer.is_stop_asked() {
            return Ok(found.map(|found| CameraDifference::Calibration(Box::new(found))));
        }
    }
    Ok(None)
}
