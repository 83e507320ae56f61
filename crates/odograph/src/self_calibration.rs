//! Multi-pass self-calibration of a recording: tracked again from its first frame whenever mount,
//! lens or readout time prove to differ from what was assumed, or the camera proves to add a fixed
//! pattern to its images.
//!
//! A live camera cannot be tracked again; [`crate::mounting::OnlineCalibration`] is for it.

use crate::camera::{Camera, Rig};
use crate::continuous_time::{MotionMeasurement, MotionWithinImages, UNKNOWN_READOUT_S};
use crate::error::Result;
use crate::fixed_pattern::NonuniformityCorrection;
use crate::motion::{MeasuredMotion, Readout};
use crate::mounting::{CalibrationMonitor, CalibrationUpdate, ReadoutProfile, ReadoutTrial, UnknownReadout};
use crate::odometry::Odometry;
use crate::trajectory::FrameEstimate;
use std::sync::Arc;

/// How a camera differs from what a pass assumed.
#[derive(Debug)]
pub enum CameraDifference {
    /// Another mount, lens or readout time.
    Calibration(Box<CalibrationUpdate>),
    /// It adds a fixed pattern to its images.
    FixedPattern(NonuniformityCorrection),
    /// Its motion within the images, which the pass had to predict, is measured.
    Motion(MotionWithinImages),
    /// Its readout time is unknown and matters: several are to be tried.
    UnknownReadout(ReadoutProfile),
    /// A readout time was tried; the result.
    TriedReadout(ReadoutTrial),
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
    /// Whether the pass takes the ground to be uneven from its first frame on, as an earlier one
    /// has found it: readout times are compared under one model.
    pub uneven_ground: bool,
    /// The motion within the images of a rolling shutter, once a pass has measured it.
    pub motion: Option<Arc<MeasuredMotion>>,
    /// Whether another mount, lens or readout time ends a pass.
    pub calibrates: bool,
    /// Whether a fixed pattern that is not corrected yet ends a pass.
    pub corrects_pattern: bool,
    /// Whether the lens is known and not estimated.
    pub lens_is_known: bool,
    given: (Camera, Rig),
    found: Option<CalibrationUpdate>,
    /// Readout times that are tried, and whether all have been.
    profile: Option<ReadoutProfile>,
    is_profiled: bool,
}

impl MultiPassCalibration {
    /// Begins with the given camera and rig; nothing ends a pass.
    pub fn new(camera: Camera, rig: Rig) -> Self {
        Self {
            given: (camera.clone(), rig),
            camera,
            rig,
            correction: None,
            uneven_ground: false,
            motion: None,
            calibrates: false,
            corrects_pattern: false,
            lens_is_known: false,
            found: None,
            profile: None,
            is_profiled: false,
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
        if let Some(profile) = &self.profile {
            return CameraMonitor { trial: Some(ReadoutTrial::of(profile)), ..CameraMonitor::default() };
        }
        let calibration = self.calibrates.then(|| {
            let monitor = match &self.found {
                Some(found) => CalibrationMonitor::with_estimate(&self.given.0, &self.given.1, found),
                None => CalibrationMonitor::new(&self.camera, &self.rig),
            };
            if self.lens_is_known { monitor.with_lens_known() } else { monitor }
        });
        let is_profiled = !self.calibrates || self.is_profiled || self.given.0.readout_s().is_some();
        CameraMonitor {
            calibration,
            pattern: self.corrects_pattern && self.correction.is_none(),
            readout: (!is_profiled).then(UnknownReadout::default),
            trial: None,
            motion: (self.calibrates && self.motion.is_none())
                .then(|| MotionMeasurement::new(&self.camera, self.readout_deviation_s()))
                .flatten(),
        }
    }

    /// The readout time that the next pass tries on the beginning of the recording, seconds.
    pub fn tried_readout_s(&self) -> Option<f64> {
        self.profile.as_ref().and_then(ReadoutProfile::next_s)
    }

    /// Mount, lens and readout time that the passes have found, if they differ from the given ones.
    pub fn found(&self) -> Option<&CalibrationUpdate> {
        self.found.as_ref().filter(|found| !found.is_nothing())
    }

    /// Corrects the assumed camera.
    pub fn apply(&mut self, difference: CameraDifference) {
        match difference {
            CameraDifference::Calibration(found) => {
                self.assume(*found);
            }
            CameraDifference::FixedPattern(pattern) => self.correction = Some(pattern),
            CameraDifference::Motion(MotionWithinImages { motion, readout }) => {
                self.motion = Some(Arc::new(motion));
                if let Some(Readout { mean_s, variance_s2 }) = readout {
                    self.set_readout(mean_s, variance_s2.sqrt());
                }
            }
            CameraDifference::UnknownReadout(profile) => self.try_next(profile),
            CameraDifference::TriedReadout(trial) => {
                if let Some(mut profile) = self.profile.take() {
                    profile.take(trial);
                    self.try_next(profile);
                }
            }
        }
    }

    /// The camera with the next readout time of a profile, or with that which it has found.
    fn try_next(&mut self, profile: ReadoutProfile) {
        let next_s = profile.next_s();
        let (readout_s, deviation_s) = match next_s {
            // An interrupted trial states that its readout time is a guess.
            Some(readout_s) => (readout_s, profile.unknown_s()),
            None => profile.measured(),
        };
        self.set_readout(readout_s, deviation_s);
        self.is_profiled = next_s.is_none();
        self.uneven_ground = next_s.is_some();
        self.profile = next_s.map(|_| profile);
    }

    /// Standard deviation of the readout time before the tracks of a whole pass, seconds.
    fn readout_deviation_s(&self) -> f64 {
        let given = &self.given.0;
        given.readout_s().map_or(UNKNOWN_READOUT_S, |_| given.readout_deviation_s())
    }

    /// From here on this readout time is taken for given: pairs of views would not measure it
    /// better.
    fn set_readout(&mut self, readout_s: f64, deviation_s: f64) {
        let camera = self.given.0.clone();
        if let Ok(camera) = camera.with_readout_s(Some(readout_s)) {
            self.given.0 = camera.with_readout_deviation_s(deviation_s);
        }
        self.assume(CalibrationUpdate { readout: None, ..self.found.clone().unwrap_or_default() });
    }

    fn assume(&mut self, found: CalibrationUpdate) {
        let (camera, rig) = &self.given;
        (self.camera, self.rig) = (found.camera(camera), found.rig(rig));
        self.found = Some(found).filter(|found| found.pairs > 0);
    }
}

/// Compares the camera of one pass with what the pass assumes.
#[derive(Debug, Default)]
pub struct CameraMonitor {
    calibration: Option<CalibrationMonitor>,
    pattern: bool,
    readout: Option<UnknownReadout>,
    trial: Option<ReadoutTrial>,
    motion: Option<MotionMeasurement>,
}

impl CameraMonitor {
    /// Takes the next frame, the result of [`Odometry::process`]. Returns a difference as soon as
    /// it is certain.
    pub fn watch(&mut self, frame: &FrameEstimate, odometry: &Odometry) -> Option<CameraDifference> {
        if let Some(pattern) = odometry.correction().filter(|_| self.pattern) {
            return Some(CameraDifference::FixedPattern(pattern.clone()));
        }
        if let Some(trial) = &mut self.trial {
            return trial.watch(frame, odometry).then(|| CameraDifference::TriedReadout(trial.clone()));
        }
        self.motion.iter_mut().for_each(|motion| motion.watch(frame, odometry));
        let found = self.calibration.as_mut().and_then(|monitor| monitor.watch(frame, odometry));
        let unknown = self.readout.as_mut().and_then(|readout| readout.watch(frame, odometry));
        let found = found.map(|found| CameraDifference::Calibration(Box::new(found)));
        found.or(unknown.map(CameraDifference::UnknownReadout))
    }

    /// The check at the end of the recording ([`CalibrationMonitor::at_end`]).
    pub fn at_end(&self) -> Option<CameraDifference> {
        if let Some(trial) = &self.trial {
            return Some(CameraDifference::TriedReadout(trial.clone()));
        }
        let found = self.calibration.as_ref().and_then(CalibrationMonitor::at_end);
        let unknown = self.readout.as_ref().and_then(UnknownReadout::at_end);
        let found = found.map(|found| CameraDifference::Calibration(Box::new(found)));
        found.or(unknown.map(CameraDifference::UnknownReadout)).or_else(|| {
            let motion = self.motion.clone().and_then(MotionMeasurement::finish);
            motion.map(CameraDifference::Motion)
        })
    }

    /// Number of pairs of views that the estimate of mount and lens has so far.
    pub fn pairs(&self) -> usize {
        self.calibration.as_ref().map_or(0, CalibrationMonitor::pairs)
    }
}
