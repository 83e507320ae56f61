//! Self-calibration of a camera that is followed live, where nothing can be read again.

use super::{CalibrationMonitor, CalibrationUpdate};
use crate::camera::{Camera, Rig};
use crate::continuous_time::ReadoutEstimation;
use crate::error::Result;
use crate::image::GrayImage;
use crate::motion::{Readout, RigPriorEstimator};
use crate::odometry::Odometry;
use crate::trajectory::FrameEstimate;
use std::thread::{self, JoinHandle};

/// Monitors a live recording as [`CalibrationMonitor`] and [`ReadoutEstimation`] do, and
/// recalibrates the odometry from the next keyframe on, so that the pose is continuous. A recording
/// that can be read again is tracked again instead.
///
/// Adjustments run on a thread of their own. Their results are used a fixed number of frames later,
/// so that the trajectory does not depend on the speed of the machine.
#[derive(Debug)]
pub struct OnlineCalibration {
    given: (Camera, Rig),
    watch: CalibrationMonitor,
    lens_is_known: bool,
    solving: Option<Solving<Option<CalibrationUpdate>>>,
    found: Option<CalibrationUpdate>,
    /// While the readout time is unknown.
    readout: Option<ReadoutEstimation>,
    adjusting: Option<Solving<(ReadoutEstimation, Option<Readout>)>>,
    /// The first frame and the last ones, while the readout time is unknown and few keyframes were
    /// made.
    beginning: Option<Vec<(GrayImage, f64)>>,
}

/// An adjustment that is being solved.
#[derive(Debug)]
struct Solving<T> {
    /// Frames until its result is due.
    frames: usize,
    result: JoinHandle<T>,
}

impl<T: Send + 'static> Solving<T> {
    /// `None` if the system has no thread to spare.
    fn begin(frames: usize, solve: impl FnOnce() -> T + Send + 'static) -> Option<Self> {
        Some(Self { frames, result: thread::Builder::new().spawn(solve).ok()? })
    }
}

/// One frame less until an adjustment is due; its result then. A solver that panicked has found
/// nothing.
fn next_frame<T>(solving: &mut Option<Solving<T>>, is_keyframe: bool) -> Option<T> {
    let all = solving.as_mut()?;
    all.frames = all.frames.saturating_sub(1);
    solving.take_if(|all| all.frames == 0 && is_keyframe)?.result.join().ok()
}

/// Pairs of views that are solved within the time of one frame: a pair takes 2 to 4 ms.
const PAIRS_PER_FRAME: usize = 4;

/// Frames of a window that are adjusted within the time of one frame: 40 take some 0.4 s.
const WINDOW_FRAMES_PER_FRAME: usize = 3;

/// Frames of the beginning that are kept, and their memory, bytes: twice as many as pass before a
/// first window of twelve is adjusted. Not derived; chosen.
const BEGINNING_FRAMES: usize = 32;
const BEGINNING_BYTES: usize = 64 << 20;

/// Keyframes in that time, at most: poor fits of skewed images make some too early.
const BEGINNING_KEYFRAMES: u64 = 4;

impl OnlineCalibration {
    /// Starts with the given calibration; the lens is kept if `lens_is_known`.
    pub fn new(camera: &Camera, rig: &Rig, lens_is_known: bool) -> Self {
        let watch = CalibrationMonitor::new(camera, rig);
        let watch = if lens_is_known { watch.with_lens_known() } else { watch };
        Self {
            given: (camera.clone(), *rig),
            watch,
            lens_is_known,
            solving: None,
            found: None,
            readout: ReadoutEstimation::new(camera).map(ReadoutEstimation::live),
            adjusting: None,
            beginning: camera.readout_s().is_none().then(Vec::new),
        }
    }

    /// Takes the next frame, the result of [`Odometry::process`] for this image. Returns whether
    /// the odometry was recalibrated.
    ///
    /// # Errors
    ///
    /// Where the odometry does not take the calibration; see [`Odometry::recalibrate`].
    pub fn watch(
        &mut self,
        image: &GrayImage,
        frame: &FrameEstimate,
        odometry: &mut Odometry,
    ) -> Result<bool> {
        self.keep_beginning(image, frame.time_s, odometry);
        self.watch.collect(frame, odometry);
        let is_due = self.readout.as_mut().is_some_and(|readout| readout.collect(frame, odometry));
        if is_due && self.adjusting.is_none() {
            let frames = self.readout.as_ref().map_or(0, ReadoutEstimation::frames_to_adjust);
            let copy = self.readout.as_mut().map(ReadoutEstimation::take_window);
            self.adjusting = copy.and_then(|mut copy| {
                Solving::begin(frames.div_ceil(WINDOW_FRAMES_PER_FRAME), move || {
                    let found = copy.adjust();
                    (copy, found)
                })
            });
        }
        let may_begin_again = self.beginning.is_some();
        if let Some((readout, found)) = next_frame(&mut self.adjusting, frame.keyframe || may_begin_again) {
            return self.take_readout(readout, found, odometry);
        }
        if self.solving.is_none() && self.watch.is_due() {
            self.watch.schedule_next();
            let watch = self.watch.clone();
            let frames = watch.pairs().div_ceil(PAIRS_PER_FRAME);
            self.solving = Solving::begin(frames, move || watch.check());
        } else if let Some(Some(found)) = next_frame(&mut self.solving, frame.keyframe) {
            return self.take(found, odometry);
        }
        Ok(false)
    }

    /// Keeps the first frame and the last ones, as long as few keyframes were made.
    fn keep_beginning(&mut self, image: &GrayImage, time_s: f64, odometry: &Odometry) {
        let may_be_again = self.readout.is_some() && odometry.keyframes() <= BEGINNING_KEYFRAMES;
        let Some(frames) = self.beginning.as_mut().filter(|_| may_be_again) else {
            self.beginning = None;
            return;
        };
        let most = BEGINNING_FRAMES.min(BEGINNING_BYTES / image.samples().len().max(1));
        if frames.len() >= most.max(2) {
            frames.remove(1);
        }
        frames.push((image.clone(), time_s));
    }

    fn take(&mut self, found: CalibrationUpdate, odometry: &mut Odometry) -> Result<bool> {
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

    /// Takes the adjusted windows, and the readout time if they determine it. What was found of
    /// mount and lens in images that were skewed is dropped.
    fn take_readout(
        &mut self,
        adjusted: ReadoutEstimation,
        found: Option<Readout>,
        odometry: &mut Odometry,
    ) -> Result<bool> {
        let Some(Readout { mean_s, variance_s2 }) = found else {
            if let Some(readout) = &mut self.readout {
                readout.take_adjusted(adjusted);
            }
            return Ok(false);
        };
        let (camera, rig) = self.given.clone();
        let camera = camera.with_readout_s(Some(mean_s))?.with_readout_deviation_s(variance_s2.sqrt());
        if mean_s == 0.0 {
            let present = self.found.as_ref().map_or_else(|| camera.clone(), |found| found.camera(&camera));
            odometry.recalibrate(present, None)?;
            (self.given, self.readout) = ((camera, rig), None);
        } else if let Some(frames) = self.beginning.take()
            && odometry.track_again(&camera, &frames)?
        {
            *self = Self::new(&camera, &rig, self.lens_is_known);
        } else {
            let had_tilt = self.found().is_some_and(|found| found.tilt.is_some());
            let mount = had_tilt.then(RigPriorEstimator::unknown_mount_tilt);
            odometry.recalibrate(camera.clone(), mount.map(|covariance| (&rig, covariance)))?;
            *self = Self::new(&camera, &rig, self.lens_is_known);
        }
        Ok(true)
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
