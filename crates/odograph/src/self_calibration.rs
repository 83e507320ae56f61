//! Multi-pass self-calibration of a recording: tracked again from its first frame whenever mount
//! or lens prove to differ from what was assumed, the readout time becomes known, or the camera
//! proves to add a fixed pattern to its images or to see something that moves along with it.
//!
//! A live camera cannot be tracked again; [`crate::mounting::OnlineCalibration`] is for it.

use crate::camera::{Camera, Rig};
use crate::continuous_time::{MotionMeasurement, MotionWithinImages, ReadoutEstimation};
use crate::error::Result;
use crate::fixed_pattern::ImageMask;
use crate::motion::Readout;
use crate::mounting::{CalibrationMonitor, CalibrationUpdate};
use crate::odometry::{EarlierPass, Odometry, OdometryConfig};
use crate::trajectory::FrameEstimate;
use std::sync::Arc;

/// How a camera differs from what a pass assumed.
#[derive(Debug)]
pub enum CameraDifference {
    /// Another mount or lens.
    Calibration(Box<CalibrationUpdate>),
    /// Its readout time, which was unknown; none of a global shutter.
    Readout(Readout),
    /// It adds a fixed pattern to its images.
    FixedPattern(EarlierPass),
    /// A large part of its view does not move with the ground.
    FixedInView(Arc<ImageMask>),
    /// Single pixels are mostly noise: its images are to be halved so often.
    Resolution(u32),
    /// Its motion within the images, which the pass had to predict, is measured.
    Motion(MotionWithinImages),
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
    /// What else the passes have found.
    pub images: EarlierPass,
    /// Whether another mount or lens ends a pass.
    pub calibrates: bool,
    /// Whether a readout time that becomes known, or the motion within the images, ends a pass.
    pub measures_shutter: bool,
    /// Whether a fixed pattern that is not corrected yet, a large part of the view that is static,
    /// or noise that calls for a coarser resolution ends a pass.
    pub corrects_images: bool,
    /// Whether the lens is known and not estimated.
    pub lens_is_known: bool,
    given: (Camera, Rig),
    found: Option<CalibrationUpdate>,
    /// Whether the readout time was found on the way, and not given.
    is_readout_found: bool,
}

impl MultiPassCalibration {
    /// Begins with the given camera and rig; nothing ends a pass.
    pub fn new(camera: Camera, rig: Rig) -> Self {
        Self {
            given: (camera.clone(), rig),
            camera,
            rig,
            images: EarlierPass::default(),
            calibrates: false,
            measures_shutter: false,
            corrects_images: false,
            lens_is_known: false,
            found: None,
            is_readout_found: false,
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
        CameraMonitor {
            calibration,
            pattern: self.corrects_images && self.images.correction.is_none(),
            view: self.corrects_images && self.images.correction.is_none() && self.images.fixed.is_none(),
            halvings: self.corrects_images.then_some(self.images.halvings),
            readout: self.measures_shutter.then(|| ReadoutEstimation::new(&self.camera)).flatten(),
            motion: (self.measures_shutter && self.images.motion.is_none())
                .then(|| MotionMeasurement::new(&self.camera, self.readout_deviation_s()))
                .flatten(),
        }
    }

    /// The odometry of the next pass. Fails as [`Odometry::new`] does.
    pub fn odometry(&self, config: OdometryConfig) -> Result<Odometry> {
        Ok(Odometry::new(self.camera.clone(), self.rig, config)?.with_earlier_pass(&self.images))
    }

    /// The readout time that the passes have found, if it was not given; zero is a global shutter.
    pub fn found_readout(&self) -> Option<Readout> {
        let variance_s2 = self.camera.readout_deviation_s().powi(2);
        let found = self.camera.readout_s().filter(|_| self.is_readout_found);
        found.map(|mean_s| Readout { mean_s, variance_s2 })
    }

    /// Mount and lens that the passes have found, if they differ from the given ones.
    pub fn found(&self) -> Option<&CalibrationUpdate> {
        self.found.as_ref().filter(|found| !found.is_nothing())
    }

    /// Corrects the assumed camera.
    pub fn apply(&mut self, difference: CameraDifference) {
        match difference {
            CameraDifference::Calibration(found) => {
                self.assume(*found);
            }
            CameraDifference::FixedPattern(found) => {
                let EarlierPass { motion, mount_tilt, .. } = std::mem::take(&mut self.images);
                self.images = EarlierPass { motion, mount_tilt, ..found };
            }
            CameraDifference::FixedInView(mask) => self.images.fixed = Some(mask),
            CameraDifference::Resolution(halvings) => {
                (self.images.correction, self.images.halvings) = (None, halvings);
            }
            CameraDifference::Motion(MotionWithinImages { motion, readout }) => {
                self.images.motion = Some(Arc::new(motion));
                if let Some(Readout { mean_s, variance_s2 }) = readout {
                    self.set_readout(mean_s, variance_s2.sqrt());
                }
            }
            CameraDifference::Readout(Readout { mean_s, variance_s2 }) => {
                self.is_readout_found = true;
                if mean_s != 0.0 {
                    // Mount and lens were estimated as if the shutter were global.
                    self.found = None;
                }
                self.set_readout(mean_s, variance_s2.sqrt());
            }
        }
    }

    /// Standard deviation of the readout time before the tracks of a whole pass, seconds.
    fn readout_deviation_s(&self) -> f64 {
        if self.is_readout_found { FOUND_READOUT_S } else { self.given.0.readout_deviation_s() }
    }

    /// From here on this readout time is taken for given.
    fn set_readout(&mut self, readout_s: f64, deviation_s: f64) {
        let camera = self.given.0.clone();
        if let Ok(camera) = camera.with_readout_s(Some(readout_s)) {
            self.given.0 = camera.with_readout_deviation_s(deviation_s);
        }
        self.assume(self.found.clone().unwrap_or_default());
    }

    fn assume(&mut self, found: CalibrationUpdate) {
        let (camera, rig) = &self.given;
        (self.camera, self.rig) = (found.camera(camera), found.rig(rig));
        self.images.mount_tilt = found.tilt.as_ref().map(|tilt| tilt.covariance);
        self.found = Some(found).filter(|found| found.pairs > 0);
    }
}

/// Standard deviation of a readout time that was found on the way, seconds: whatever a part of the
/// recording has shown, the tracks of the whole decide.
const FOUND_READOUT_S: f64 = 5e-3;

/// Frames at the beginning that are tracked again at the resolution that they call for; later ones
/// stay as they are.
const EARLY_FRAMES: u64 = 100;

/// Compares the camera of one pass with what the pass assumes.
#[derive(Debug, Default)]
pub struct CameraMonitor {
    calibration: Option<CalibrationMonitor>,
    pattern: bool,
    view: bool,
    /// How often the pass began to halve the images, if more would end it.
    halvings: Option<u32>,
    readout: Option<ReadoutEstimation>,
    motion: Option<MotionMeasurement>,
}

impl CameraMonitor {
    /// Takes the next frame, the result of [`Odometry::process`]. Returns a difference as soon as
    /// it is certain.
    pub fn watch(&mut self, frame: &FrameEstimate, odometry: &Odometry) -> Option<CameraDifference> {
        let halvings = odometry.halvings();
        if frame.frame < EARLY_FRAMES && self.halvings.is_some_and(|before| halvings > before) {
            return Some(CameraDifference::Resolution(halvings));
        }
        if let Some(pattern) = odometry.correction().filter(|_| self.pattern) {
            // What the other monitors would see comes from frames before the correction, too.
            let is_settled = pattern.is_settled();
            return odometry.found_pattern().filter(|_| is_settled).map(CameraDifference::FixedPattern);
        }
        if self.view
            && let Some(mask) = odometry.settled_mask()
        {
            return Some(CameraDifference::FixedInView(mask));
        }
        self.motion.iter_mut().for_each(|motion| motion.watch(frame, odometry));
        if let Some(found) = self.readout.as_mut().and_then(|readout| readout.watch(frame, odometry)) {
            return Some(CameraDifference::Readout(found));
        }
        let found = self.calibration.as_mut()?.watch(frame, odometry)?;
        // Lens and tilt absorb the skew of a rolling shutter, so the readout time is decided first.
        let readout = self.readout.as_ref().and_then(ReadoutEstimation::at_end);
        Some(
            readout.map_or_else(|| CameraDifference::Calibration(Box::new(found)), CameraDifference::Readout),
        )
    }

    /// The check at the end of the recording ([`CalibrationMonitor::at_end`]).
    pub fn at_end(&self, odometry: &Odometry) -> Option<CameraDifference> {
        if let Some(found) = odometry.found_pattern().filter(|_| self.pattern) {
            return Some(CameraDifference::FixedPattern(found));
        }
        let readout = || self.readout.as_ref()?.at_end().map(CameraDifference::Readout);
        let calibration = || {
            let found = self.calibration.as_ref()?.at_end()?;
            Some(CameraDifference::Calibration(Box::new(found)))
        };
        let motion = || self.motion.clone()?.finish().map(CameraDifference::Motion);
        readout().or_else(calibration).or_else(motion)
    }

    /// Number of pairs of views that the estimate of mount and lens has so far.
    pub fn pairs(&self) -> usize {
        self.calibration.as_ref().map_or(0, CalibrationMonitor::pairs)
    }
}
