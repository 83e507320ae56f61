//! A camera that is not as it was told: it sits otherwise, or its lens bends otherwise.

use crate::found::{FoundLens, FoundMount};
use crate::observer::Observer;
use crate::output::MapUse;
use crate::plan::RunPlan;
use odograph::camera::{Camera, Rig};
use odograph::error::Result;
use odograph::motion::MotionModel;
use odograph::mounting::{Found, Untold};
use odograph_map::MapFile;

/// Looks after the camera while a recording is followed, which is begun again when the camera is
/// known better.
pub struct CameraWatch {
    camera: Camera,
    rig: Rig,
    /// Whether it may be begun again.
    again: bool,
    /// Whether the lens is that of a map.
    lens_is_known: bool,
    found: Option<Found>,
}

/// Where a map is continued the recording is looked at beforehand, for so many pairs of views.
const LOOKED_AT: usize = 32;

impl CameraWatch {
    /// Of a recording that is followed by a plan. Where the plan says what may move, or the
    /// recording can be read only once, nothing is looked for.
    pub fn new(plan: &RunPlan) -> Self {
        let chosen = plan.odometry.motion.model == MotionModel::Auto;
        let readable_again =
            std::fs::metadata(&plan.source.path).is_ok_and(|there| there.is_file() || there.is_dir());
        let (camera, rig) = (plan.camera.clone(), plan.rig);
        Self { camera, rig, again: chosen && readable_again, lens_is_known: false, found: None }
    }

    /// What watches the run that now begins.
    pub fn watch(&self, plan: &RunPlan) -> Option<Untold> {
        self.again.then(|| {
            let watch = match &self.found {
                Some(found) => Untold::found(&plan.camera, &plan.rig, found),
                None => Untold::new(&plan.camera, &plan.rig),
            };
            if self.lens_is_known { watch.with_lens_known() } else { watch }
        })
    }

    /// How the camera was found to sit, where not as told.
    pub fn mount(&self) -> Option<FoundMount> {
        let tilt = self.found.as_ref()?.tilt.as_ref()?;
        Some(FoundMount::new(&self.rig, tilt))
    }

    /// How the lens was found to bend, where not as told.
    pub fn lens(&self) -> Option<FoundLens> {
        let lens = self.found.as_ref()?.lens.as_ref()?;
        Some(FoundLens::new(&self.camera, lens))
    }

    /// Takes what was found into the plan.
    pub fn take(&mut self, found: Found, plan: &mut RunPlan) {
        plan.rig = found.rig(&plan.rig);
        plan.camera = found.camera(&plan.camera);
        self.found = Some(found);
    }

    /// A map that is continued holds what a run has put into it: there the beginning of the
    /// recording is looked at before the run. The lens is that of the map.
    pub fn look_first(&mut self, plan: &mut RunPlan, map: &MapUse, observer: &dyn Observer) -> Result<()> {
        if !map.path().is_some_and(MapFile::is_there) {
            return Ok(());
        }
        self.lens_is_known = true;
        while let Some(untold) = self.watch(plan) {
            match look(plan, untold, observer)? {
                Some(found) => self.take(found, plan),
                None => self.again = false,
            }
        }
        Ok(())
    }
}

/// What the beginning of a recording shows of the camera that is not the plan's.
fn look(plan: &RunPlan, mut untold: Untold, observer: &dyn Observer) -> Result<Option<Found>> {
    let mut source = plan.source.open()?;
    let mut odometry = plan.odometry()?;
    while let Some(frame) = source.next_frame()? {
        let estimate = odometry.process(frame.gray, frame.time_s)?;
        let found = untold.watch(&estimate, &odometry);
        if found.is_some() || untold.pairs() >= LOOKED_AT || observer.is_stop_asked() {
            return Ok(found);
        }
    }
    Ok(None)
}
