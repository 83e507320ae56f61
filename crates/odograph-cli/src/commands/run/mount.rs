//! How the camera sits on its carrier, where that is not what was told.

use super::{OutputArguments, RunPlan};
use crate::interrupt;
use odograph::camera::Rig;
use odograph::error::Result;
use odograph::motion::MotionModel;
use odograph::mounting::{TiltMeasurement, UntoldTilt};
use odograph::odometry::Odometry;
use serde::Serialize;

/// How the camera was found to sit, as `stats.json` has it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FoundMount {
    /// Roll and pitch against straight down as they were told, degrees.
    pub told_roll_deg: f64,
    pub told_pitch_deg: f64,
    /// As the recording has them, and one standard deviation of each.
    pub roll_deg: f64,
    pub pitch_deg: f64,
    pub roll_deviation_deg: f64,
    pub pitch_deviation_deg: f64,
}

impl FoundMount {
    fn new(told: &Rig, found: &TiltMeasurement) -> Self {
        Self {
            told_roll_deg: told.roll_rad.to_degrees(),
            told_pitch_deg: told.pitch_rad.to_degrees(),
            roll_deg: found.roll_rad.to_degrees(),
            pitch_deg: found.pitch_rad.to_degrees(),
            roll_deviation_deg: found.covariance[(0, 0)].sqrt().to_degrees(),
            pitch_deviation_deg: found.covariance[(1, 1)].sqrt().to_degrees(),
        }
    }

    /// For people.
    pub fn sentence(&self) -> String {
        format!(
            "the camera sits at a roll of {:+.2}° and a pitch of {:+.2}°, not at {:+.2}° and {:+.2}° as was told: the path was followed with the \
             former, which is in run.toml; --rig tells it, odograph ground measures it, --motion rigid insists on what was told",
            self.roll_deg, self.pitch_deg, self.told_roll_deg, self.told_pitch_deg
        )
    }
}

/// Looks after how the camera sits while a recording is followed, which is begun again when that is known better.
pub struct Mount {
    told: Rig,
    /// Whether it may be begun again.
    again: bool,
    measured: Option<TiltMeasurement>,
}

/// Where a map is continued the recording is looked at beforehand, for so many pairs of views.
const LOOKED_AT: usize = 32;

impl Mount {
    /// Of a recording that is followed by a plan. Where the plan says what may move, or the recording can be read only once, nothing is looked for.
    pub fn new(plan: &RunPlan) -> Self {
        let chosen = plan.odometry.motion.model == MotionModel::Auto;
        let readable_again =
            std::fs::metadata(&plan.source.path).is_ok_and(|there| there.is_file() || there.is_dir());
        Self { told: plan.rig, again: chosen && readable_again, measured: None }
    }

    /// What watches the run that now begins.
    pub fn watch(&self, plan: &RunPlan) -> Option<UntoldTilt> {
        self.again.then(|| match &self.measured {
            Some(measured) => UntoldTilt::measured(&plan.camera, &plan.rig, measured),
            None => UntoldTilt::new(&plan.camera, &plan.rig),
        })
    }

    /// How the camera was found to sit, where not as told.
    pub fn found(&self) -> Option<FoundMount> {
        self.measured.as_ref().map(|measured| FoundMount::new(&self.told, measured))
    }

    /// Takes what was found into the plan.
    pub fn take(&mut self, found: TiltMeasurement, plan: &mut RunPlan) {
        plan.rig = Rig { roll_rad: found.roll_rad, pitch_rad: found.pitch_rad, ..plan.rig };
        self.measured = Some(found);
    }

    /// A map that is continued holds what a run has put into it: there the beginning of the recording is looked at before the run.
    pub fn look_first(&mut self, plan: &mut RunPlan, arguments: &OutputArguments) -> Result<()> {
        if !arguments.map.as_ref().is_some_and(|map| map.exists()) {
            return Ok(());
        }
        while let Some(untold) = self.watch(plan) {
            match look(plan, untold)? {
                Some(found) => self.take(found, plan),
                None => self.again = false,
            }
        }
        Ok(())
    }
}

/// The tilt that the beginning of a recording shows, where it is not the plan's.
fn look(plan: &RunPlan, mut untold: UntoldTilt) -> Result<Option<TiltMeasurement>> {
    let mut source = plan.source.open()?;
    let mut odometry = Odometry::new(plan.camera.clone(), plan.rig, plan.odometry)?;
    while let Some(frame) = source.next_frame()? {
        let estimate = odometry.process(frame.gray, frame.time_s)?;
        let found = untold.watch(&estimate, odometry.tracks());
        if found.is_some() || untold.pairs() >= LOOKED_AT || interrupt::asked() {
            return Ok(found);
        }
    }
    Ok(None)
}
