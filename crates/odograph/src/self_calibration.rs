//! Multi-pass self-calibration of a recording: tracked again from its first frame whenever mount,
//! lens or readout time prove to differ from what was assumed, or the camera proves to add a fixed
//! pattern to its images.
//!
//! A live camera cannot be tracked again; [`crate::mounting::OnlineCalibration`] is for it.

use crate::camera::{Camera, Rig};
use crate::error::Result;
use crate::fixed_pattern::NonuniformityCorrection;
use crate::mounting::{CalibrationMonitor, CalibrationUpdate};
use crate::odometry::Odometry;
use crate::trajectory::FrameEstimate;

/// How a camera differs from what a pass assumed.
#[derive(Debug)]
pub enum CameraDifference {
    /// Another mount, lens or readout time.
    Calibration(Box<CalibrationUpdate>),
    /// It adds a fixed pattern to its images.
    FixedPattern(NonuniformityCorrection),
}

/// How a pass over a recording ended.
#[derive(Debug)]
pub enum PassEnd<T> {
    /// At the end of the recording, with its result.
    Finished(T),
    /// At a frame where it is certain that the camera differs from what was assumed.
    Differs(CameraDifference),
}

/// The camera as the next pass over a recording assumes it.
#[derive(Debug, Clone)]
pub struct MultiPassCalibration {
    /// The camera.
    pub camera: Camera,
    /// Its mount above the ground.
    pub rig: Rig,
    /// Correction of its fixed-pattern noise, if an earlier pass found some.
    pub correction: Option<NonuniformityCorrection>,
    /// Whether another mount, lens or readout time ends a pass.
    pub calibrates: bool,
    /// Whether a fixed pattern that is not corrected yet ends a pass.
    pub corrects_pattern: bool,
    /// Whether the lens is known and not estimated.
    pub lens_is_known: bool,
    given: (Camera, Rig),
    found: Option<CalibrationUpdate>,
}

impl MultiPassCalibration {
    /// Begins with the given camera and rig; nothing ends a pass.
    pub fn new(camera: Camera, rig: Rig) -> Self {
        Self {
            given: (camera.clone(), rig),
            camera,
            rig,
            correction: None,
            calibrates: false,
            corrects_pattern: false,
            lens_is_known: false,
            found: None,
        }
    }

    /// Calls `pass` until it reaches the end of the recording, each time with the camera as the
    /// passes before have found it. Fails as `pass` does.
    pub fn track<T>(&mut self, mut pass: impl FnMut(&Self) -> Result<PassEnd<T>>) -> Result<T> {
        loop {
            match pass(self)? {
                PassEnd::Finished(result) => return Ok(result),
                PassEnd::Differs(difference) => self.apply(difference),
            }
        }
    }

    /// The monitor of the next pass.
    pub fn monitor(&self) -> CameraMonitor {
        let calibration = self.calibrates.then(|| {
            let monitor = match &self.found {
                Some(found) => CalibrationMonitor::with_estimate(&self.given.0, &self.given.1, found),
                None => CalibrationMonitor::new(&self.camera, &self.rig),
            };
            if self.lens_is_known { monitor.with_lens_known() } else { monitor }
        });
        CameraMonitor { calibration, pattern: self.corrects_pattern && self.correction.is_none() }
    }

    /// Mount, lens and readout time that the passes have found, if they differ from the given ones.
    pub fn found(&self) -> Option<&CalibrationUpdate> {
        self.found.as_ref().filter(|found| !found.is_nothing())
    }

    /// Corrects the assumed camera.
    pub fn apply(&mut self, difference: CameraDifference) {
        match difference {
            CameraDifference::Calibration(found) => {
                let (camera, rig) = &self.given;
                (self.camera, self.rig) = (found.camera(camera), found.rig(rig));
                self.found = Some(*found);
            }
            CameraDifference::FixedPattern(pattern) => self.correction = Some(pattern),
        }
    }
}

/// Compares the camera of one pass with what the pass assumes.
#[derive(Debug)]
pub struct CameraMonitor {
    calibration: Option<CalibrationMonitor>,
    pattern: bool,
}

impl CameraMonitor {
    /// Takes the next frame, the result of [`Odometry::process`]. Returns a difference as soon as
    /// it is certain.
    pub fn watch(&mut self, frame: &FrameEstimate, odometry: &Odometry) -> Option<CameraDifference> {
        if let Some(pattern) = odometry.correction().filter(|_| self.pattern) {
            return Some(CameraDifference::FixedPattern(pattern.clone()));
        }
        let found = self.calibration.as_mut()?.watch(frame, odometry)?;
        Some(CameraDifference::Calibration(Box::new(found)))
    }

    /// The check at the end of the recording ([`CalibrationMonitor::at_end`]).
    pub fn at_end(&self) -> Option<CameraDifference> {
        let found = self.calibration.as_ref()?.at_end()?;
        Some(CameraDifference::Calibration(Box::new(found)))
    }

    /// Number of pairs of views that the estimate of mount and lens has so far.
    pub fn pairs(&self) -> usize {
        self.calibration.as_ref().map_or(0, CalibrationMonitor::pairs)
    }
}
