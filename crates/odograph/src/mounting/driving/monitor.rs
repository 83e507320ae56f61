//! A mount and a lens that are not as they were told, noticed while a recording is followed.
//!
//! Ground that is laid out under a wrong tilt slopes: a camera that keeps its height over the floor seems to climb, by one part in sixty for
//! each degree, and the path is stretched with it. A lens that bends otherwise than its calibration says looks like a tilt towards wherever the camera goes. The
//! floor's own movement through the image tells both long before they matter much: a metre and a half of driving, to a few thousandths of a degree and to a
//! hundredth of a pixel on well-textured ground. So whoever reads a recording begins again with what was found, and the path is that of a camera
//! which had been told right.

use super::{DrivenTilt, DrivingConfig, LensMeasurement, Observability, ReadoutMeasurement, TiltMeasurement};
use crate::camera::{Camera, Rig};
use crate::geometry::GroundPose;
use crate::motion::Readout;
use crate::odometry::Odometry;
use crate::trajectory::FrameEstimate;
use nalgebra::Vector2;

/// Watches a recording while [`crate::odometry::Odometry`] follows it with the motion model that chooses by evidence.
#[derive(Debug, Clone)]
pub struct CalibrationMonitor {
    driven: DrivenTilt,
    given: Rig,
    /// Whether the lens is looked at, too.
    lens: bool,
    readout_is_given: bool,
    /// What the told tilt and lens were found by, where they were.
    before: Found,
    /// Whether the odometry has found that the camera is not as it was told.
    deviates: bool,
    /// At so many pairs of views it is looked at next.
    next_check: usize,
}

/// What a recording says of its camera that is not as it was told.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Found {
    /// How it sits.
    pub tilt: Option<TiltMeasurement>,
    /// How long its images take to be read out.
    pub readout: Option<ReadoutMeasurement>,
    /// How its lens bends.
    pub lens: Option<LensMeasurement>,
    /// Pairs of views from which it was found.
    pub pairs: usize,
}

impl Found {
    /// Nothing is another than it was told.
    fn is_nothing(&self) -> bool {
        self.tilt.is_none() && self.readout.is_none() && self.lens.is_none()
    }

    /// A rig with the tilt that was found.
    pub fn rig(&self, given: &Rig) -> Rig {
        match &self.tilt {
            Some(tilt) => Rig { roll_rad: tilt.roll_rad, pitch_rad: tilt.pitch_rad, ..*given },
            None => *given,
        }
    }

    /// The camera with the lens and the readout time that were found.
    pub fn camera(&self, given: &Camera) -> Camera {
        let camera = self.lens.as_ref().map_or_else(|| given.clone(), |lens| lens.camera.clone());
        let (readout_s, deviation_s) = match self.readout {
            Some(found) => (Some(found.readout_s), found.deviation_s),
            None => (given.readout_s(), given.readout_deviation_s()),
        };
        match camera.clone().with_readout_s(readout_s) {
            Ok(camera) => camera.with_readout_deviation_s(deviation_s),
            Err(_) => camera,
        }
    }
}

/// Pairs of views after which the tilt is looked at the first time, twice as many each time after that, and the last time. A pair is a movement by a tenth
/// of the image.
const FIRST_CHECK: usize = 8;
const LAST_CHECK: usize = 256;

/// A tilt that was measured is looked at again after so many times the pairs that it was measured from: it is known twice as well then, and to begin once more
/// costs a quarter of the way at most.
const RECHECK_FACTOR: usize = 4;

/// Tracks of a pair: of four hundred, these have most of what all say.
const MAX_TRACKS: usize = 80;

/// At the end of the recording twice the pairs are enough.
const END_FACTOR: usize = 2;

/// What the odometry itself leaves as it was told while it is within this: parts of the height, radians. (On a mount that is as told it is a
/// hundredth of this.)
const MIN_DEVIATION: f64 = 2e-4;

/// A smaller tilt than this does not bend a path by more than the pixels do, radians.
const MIN_TILT_RAD: f64 = 0.02 * std::f64::consts::PI / 180.0;

/// Who tells a tilt that is not straight down has measured it: what differs from it by less than this may as well be an error of the camera's calibration,
/// which looks like a tilt too, radians.
const MIN_FROM_MEASURED_RAD: f64 = 0.5 * std::f64::consts::PI / 180.0;

/// A tilt is told apart from none where it is so many of its standard deviations off (once in some hundred thousand looks by chance, in two dimensions).
const MIN_SIGMAS: f64 = 5.0;

/// A tilt is that of the mount, and not of a hand or of a spring, where it scatters from keyframe to keyframe by less than this part of itself.
const MAX_SCATTER: f64 = 1.0 / 3.0;

impl CalibrationMonitor {
    /// Nothing seen yet of a camera that was told to be `camera` and to sit like `told`.
    pub fn new(camera: &Camera, given: &Rig) -> Self {
        let config =
            DrivingConfig { max_tracks: MAX_TRACKS, max_pairs: LAST_CHECK, ..DrivingConfig::default() };
        let driven = DrivenTilt::new(camera, config);
        let (before, next_check) = (Found::default(), FIRST_CHECK);
        let readout_is_given = camera.readout_s().is_some();
        Self { driven, given: *given, lens: true, readout_is_given, before, deviates: false, next_check }
    }

    /// The same where `camera` and `told` are what was found in an earlier part of the recording.
    pub fn found(camera: &Camera, given: &Rig, before: &Found) -> Self {
        let next_check = RECHECK_FACTOR * before.pairs;
        let unknown = camera.clone().with_readout_s(None).ok().filter(|_| before.readout.is_some());
        let mut watch = Self::new(unknown.as_ref().unwrap_or(camera), given);
        watch.driven.set_assumed_readout_s(camera.readout_s().unwrap_or(0.0));
        Self { before: before.clone(), deviates: true, next_check, ..watch }
    }

    /// The same where the lens is known to be as it was told.
    pub fn with_lens_known(self) -> Self {
        Self { lens: false, ..self }
    }

    /// Takes the next frame: what [`Odometry::process`] gave, and its tracks. The camera as it is, where by now it is sure that it is not as it
    /// was told, or known better than what was found before.
    pub fn watch(&mut self, frame: &FrameEstimate, odometry: &Odometry) -> Option<Found> {
        self.collect(frame, odometry);
        if !self.is_due() {
            return None;
        }
        self.schedule_next();
        self.check()
    }

    /// Takes the next frame, as [`CalibrationMonitor::watch`] does, without solving.
    pub(super) fn collect(&mut self, frame: &FrameEstimate, odometry: &Odometry) {
        if self.next_check <= LAST_CHECK {
            self.driven.watch(frame, odometry);
            self.deviates |= odometry.readout().is_some_and(seems_rolling);
            self.deviates |= frame.estimate.as_ref().is_some_and(|known| self.differs(&known.pose));
        }
    }

    /// Whether there are enough pairs of views for the next look.
    pub(super) fn is_due(&self) -> bool {
        self.next_check <= LAST_CHECK && self.driven.pairs() >= self.next_check
    }

    /// Sets when the look after this one is due.
    pub(super) fn schedule_next(&mut self) {
        self.next_check *= if self.before.is_nothing() { 2 } else { RECHECK_FACTOR };
    }

    /// What watches the rest of a recording that goes on with what was found.
    pub(super) fn after(&self, camera: &Camera, rig: &Rig, found: &Found) -> Self {
        let watch = Self::found(camera, rig, found);
        Self { lens: self.lens, ..watch }
    }

    /// The same at the end of the recording, where that is not far enough for the next look: with all of it the short way is followed once more.
    pub fn at_end(&self) -> Option<Found> {
        let least = if self.before.is_nothing() { FIRST_CHECK } else { END_FACTOR * self.before.pairs };
        let worth = self.next_check <= LAST_CHECK && self.driven.pairs() >= least;
        worth.then(|| self.check()).flatten()
    }

    /// The camera as it is, where it is surely not as it was given.
    pub(super) fn check(&self) -> Option<Found> {
        if !self.deviates {
            return None;
        }
        let (tilt, lens) = self.measured()?;
        if !self.driven.explains(&tilt) {
            return None;
        }
        let replaces_tilt = self.replaces_tilt(&tilt);
        let replaces_lens = lens.as_ref().is_some_and(|lens| self.replaces_lens(lens));
        let readout = tilt.readout.filter(|found| self.driven.is_possible(found));
        let replaces_readout = readout.is_some_and(|readout| self.replaces_readout(&readout));
        (replaces_tilt || replaces_lens || replaces_readout).then(|| Found {
            // What was found before is replaced by what is found now, be it little else.
            tilt: (replaces_tilt || self.before.tilt.is_some()).then_some(tilt),
            readout: readout.filter(|_| replaces_readout || self.before.readout.is_some()),
            lens,
            pairs: self.driven.pairs(),
        })
    }

    /// The tilt, and the lens where that is another than it was calibrated to be; the tilt is with that lens.
    fn measured(&self) -> Option<(TiltMeasurement, Option<LensMeasurement>)> {
        if !self.lens {
            return Some((self.driven.solve(&self.given, None).ok()?, None));
        }
        let before = self.before.lens.as_ref().map_or(0, |lens| lens.coefficients.len());
        let found = self.driven.self_calibration(&self.given, before).ok()?;
        Some(match found.lens {
            Some((lens, tilt)) if self.before.lens.is_some() || lens.is_significant() => (tilt, Some(lens)),
            _ => (found.tilt, None),
        })
    }

    /// How many pairs of views there are so far.
    pub fn pairs(&self) -> usize {
        self.driven.pairs()
    }

    /// Whether the odometry has a pose at another height or tilt than was told.
    fn differs(&self, pose: &GroundPose) -> bool {
        (pose.height_m / self.given.height_m - 1.0).abs() > MIN_DEVIATION
            || (pose.roll_rad - self.given.roll_rad).abs() > MIN_DEVIATION
            || (pose.pitch_rad - self.given.pitch_rad).abs() > MIN_DEVIATION
    }

    fn replaces_tilt(&self, found: &TiltMeasurement) -> bool {
        match &self.before.tilt {
            Some(before) => self.is_better(found, before),
            None => self.differs_significantly(found),
        }
    }

    fn replaces_lens(&self, found: &LensMeasurement) -> bool {
        match &self.before.lens {
            Some(before) if found.deviation_px < MAX_SIGMA_RATIO * before.deviation_px => {
                found.off_px >= MIN_CHANGE_PX
            }
            _ => found.is_significant(),
        }
    }

    fn replaces_readout(&self, found: &ReadoutMeasurement) -> bool {
        match &self.before.readout {
            Some(before) => found.is_better_than(before),
            None => !self.readout_is_given && found.differs_from(0.0),
        }
    }

    /// Whether a tilt is surely, steadily and usefully another than the one told.
    fn differs_significantly(&self, found: &TiltMeasurement) -> bool {
        let off = Vector2::new(found.roll_rad - self.given.roll_rad, found.pitch_rad - self.given.pitch_rad);
        let [roll, pitch] = found.scatter_rad;
        let certainty =
            found.covariance.try_inverse().map_or(0.0, |information| off.dot(&(information * off)));
        let level = self.given.roll_rad == 0.0 && self.given.pitch_rad == 0.0;
        let least_rad = if level { MIN_TILT_RAD } else { MIN_FROM_MEASURED_RAD };
        found.observability == Observability::Full
            && off.norm() >= least_rad
            && certainty >= MIN_SIGMAS * MIN_SIGMAS
            && roll.hypot(pitch) < MAX_SCATTER * off.norm()
    }

    /// Whether a tilt is known clearly better than before, and not the same for that.
    fn is_better(&self, found: &TiltMeasurement, before: &TiltMeasurement) -> bool {
        let off = (found.roll_rad - self.given.roll_rad).hypot(found.pitch_rad - self.given.pitch_rad);
        let worst = |tilt: &TiltMeasurement| tilt.covariance.symmetric_eigenvalues().max();
        off >= MIN_CHANGE_RAD && worst(found) < MAX_SIGMA_RATIO * MAX_SIGMA_RATIO * worst(before)
    }
}

/// What is known better is begun again with where it is another by this much, radians and pixels at the edge of the image, and its deviation is so many times as
/// large.
const MIN_CHANGE_RAD: f64 = 5e-5;
const MIN_CHANGE_PX: f64 = 0.03;
const MAX_SIGMA_RATIO: f64 = 0.8;

/// A readout time this many standard deviations from zero is worth a look.
const ROLLING_SIGMAS: f64 = 1.5;

fn seems_rolling(readout: Readout) -> bool {
    readout.mean_s.powi(2) > ROLLING_SIGMAS * ROLLING_SIGMAS * readout.variance_s2
}
