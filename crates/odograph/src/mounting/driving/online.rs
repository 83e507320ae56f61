//! Self-calibration of a camera that is followed live, where nothing can be read again.

use super::{CalibrationMonitor, CalibrationUpdate};
use crate::camera::{Camera, Rig};
use crate::error::Result;
use crate::motion::RigPriorEstimator;
use crate::odometry::Odometry;
use crate::trajectory::FrameEstimate;
use std::thread::{self, JoinHandle};

/// Monitors a live recording as [`CalibrationMonitor`] does, and recalibrates the odometry from the
/// next keyframe on, so that the pose is continuous. A recording that can be read again is tracked
/// again instead.
///
/// The bundle is solved on a thread of its own. Its result is used a fixed number of frames later,
/// so that the trajectory does not depend on the speed of the machine.
#[derive(Debug)]
pub struct OnlineCalibration {
    given: (Camera, Rig),
    watch: CalibrationMonitor,
    solving: Option<Solving>,
    found: Option<CalibrationUpdate>,
}

/// A bundle that is being solved.
#[derive(Debug)]
struct Solving {
    /// Frames until its result is due.
    frames: usize,
    result: JoinHandle<Option<CalibrationUpdate>>,
}

/// Pairs of views that are solved within the time of one frame: a pair takes 2 to 4 ms.
const PAIRS_PER_FRAME: usize = 4;

impl OnlineCalibration {
    /// Starts with the given calibration; the lens is kept if `lens_is_known`.
    pub fn new(camera: &Camera, rig: &Rig, lens_is_known: bool) -> Self {
        let watch = CalibrationMonitor::new(camera, rig);
        let watch = if lens_is_known { watch.with_lens_known() } else { watch };
        Self { given: (camera.clone(), *rig), watch, solving: None, found: None }
    }

    /// Takes the next frame, the result of [`Odometry::process`]. Returns whether the odometry was
    /// recalibrated.
    ///
    /// # Errors
    ///
    /// Where the odometry does not take the calibration; see [`Odometry::recalibrate`].
    pub fn watch(&mut self, frame: &FrameEstimate, odometry: &mut Odometry) -> Result<bool> {
        self.watch.collect(frame, odometry);
        match &mut self.solving {
            Some(solving) => solving.frames = solving.frames.saturating_sub(1),
            None if self.watch.is_due() => self.solving = self.begin(),
            None => {}
        }
        let Some(solving) = self.solving.take_if(|solving| solving.frames == 0 && frame.keyframe) else {
            return Ok(false);
        };
        // A solver that panicked has found nothing.
        let Some(found) = solving.result.join().ok().flatten() else { return Ok(false) };
        let (camera, rig) = &self.given;
        let rig = found.rig(rig);
        let had_tilt = self.found().is_some_and(|found| found.tilt.is_some());
        let covariance = match &found.tilt {
            Some(tilt) => Some(tilt.covariance),
            None => had_tilt.then(RigPriorEstimator::unknown_mount_tilt),
        };
        odometry.recalibrate(found.camera(camera), covariance.map(|covariance| (&rig, covariance)))?;
        self.watch = self.watch.after(&found);
        self.found = Some(found);
        Ok(true)
    }

    /// `None` if the system has no thread to spare; the next look is tried again.
    fn begin(&mut self) -> Option<Solving> {
        self.watch.schedule_next();
        let watch = self.watch.clone();
        let frames = watch.pairs().div_ceil(PAIRS_PER_FRAME);
        let result = thread::Builder::new().spawn(move || watch.check()).ok()?;
        Some(Solving { frames, result })
    }

    /// The rig that is in use.
    pub fn rig(&self) -> Rig {
        let given = &self.given.1;
        self.found.as_ref().map_or(*given, |found| found.rig(given))
    }

    /// The estimated calibration that is in use; `None` while the given one is.
    pub fn found(&self) -> Option<&CalibrationUpdate> {
        self.found.as_ref().filter(|found| !found.is_nothing())
    }
}
