//! Detects while tracking that mount or lens differ from the given calibration.
//!
//! Ground reconstructed with a wrong tilt slopes: a camera at constant height seems to climb by one
//! part in sixty per degree, and the path is stretched. A wrong distortion looks like a tilt
//! towards the direction of travel. The motion of the ground through the image determines both
//! before they matter much: a metre and a half of driving, to a few thousandths of a degree and a
//! hundredth of a pixel on well-textured ground. A recording is then tracked again with what was
//! found.

use super::{DrivenTilt, DrivingConfig, LensMeasurement, MAX_SIGMA_RATIO, Observability, TiltMeasurement};
use crate::camera::{Camera, Rig};
use crate::geometry::GroundPose;
use crate::odometry::Odometry;
use crate::trajectory::FrameEstimate;
use nalgebra::Vector2;

/// Monitors a recording that [`crate::odometry::Odometry`] tracks with the automatic motion model.
#[derive(Debug, Clone)]
pub struct CalibrationMonitor {
    driven: DrivenTilt,
    given: Rig,
    /// Whether the lens is estimated, too.
    lens: bool,
    /// The estimate in use, by an earlier check: nothing while the given calibration is.
    in_use: CalibrationUpdate,
    /// Whether the odometry itself deviates from the given height or tilt.
    deviates: bool,
    /// Number of pairs at which the next check is due.
    next_check: usize,
}

/// What differs from the given calibration.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CalibrationUpdate {
    /// The tilt.
    pub tilt: Option<TiltMeasurement>,
    /// The lens.
    pub lens: Option<LensMeasurement>,
    /// Number of pairs of views behind it.
    pub pairs: usize,
    /// Whether these pairs were followed with an estimate of the lens.
    pub is_second: bool,
}

impl CalibrationUpdate {
    /// Whether nothing differs: what an earlier check found is withdrawn.
    pub fn is_nothing(&self) -> bool {
        self.tilt.is_none() && self.lens.is_none()
    }

    /// A rig with the estimated tilt.
    pub fn rig(&self, given: &Rig) -> Rig {
        match &self.tilt {
            Some(tilt) => Rig { roll_rad: tilt.roll_rad, pitch_rad: tilt.pitch_rad, ..*given },
            None => *given,
        }
    }

    /// The camera with the estimated lens.
    pub fn camera(&self, given: &Camera) -> Camera {
        let camera = self.lens.as_ref().map_or_else(|| given.clone(), |lens| lens.camera.clone());
        match camera.clone().with_readout_s(given.readout_s()) {
            Ok(camera) => camera.with_readout_deviation_s(given.readout_deviation_s()),
            Err(_) => camera,
        }
    }
}

/// Number of pairs at the first check, which doubles from check to check, and at the last one. A
/// pair is a motion by a tenth of the image.
const FIRST_CHECK: usize = 8;
const LAST_CHECK: usize = 256;

/// An estimate is checked again after this many times the pairs behind it: its standard deviation
/// has then halved, and tracking once more repeats at most a quarter of the recording.
const RECHECK_FACTOR: usize = 4;

/// Tracks kept of a pair: 80 of 400 carry most of their information.
const MAX_TRACKS: usize = 80;

/// At the end of the recording, twice the pairs are enough for another check.
const END_FACTOR: usize = 2;

/// A lens that differs by more than this at the edge of the image, pixels, bends the patches that
/// are followed, and with it the tracks. Not derived; chosen.
const ROUGH_PX: f64 = 3.0;

/// Deviation of the odometry below which the calibration seems to be right: fraction of the height,
/// radians. With a right calibration it is a hundredth of this. A decentering across the direction
/// of travel and a wrong roll do not show in it.
const MIN_DEVIATION: f64 = 2e-4;

/// Number of pairs at the last check of a calibration that seems to be right: a check costs 3 ms of
/// processor time a pair.
const LAST_QUIET_CHECK: usize = 32;

/// A smaller tilt, radians, bends a path by less than the pixel noise does.
const MIN_TILT_RAD: f64 = 0.02 * std::f64::consts::PI / 180.0;

/// A given tilt that is not straight down was measured; a difference below this, radians, may be an
/// error of the camera's calibration, which looks like a tilt.
const MIN_FROM_MEASURED_RAD: f64 = 0.5 * std::f64::consts::PI / 180.0;

/// Standard deviations by which a tilt must differ to be significant; by chance, one check in some
/// hundred thousand (two dimensions).
const MIN_SIGMAS: f64 = 5.0;

/// Largest scatter between keyframes as a fraction of the difference: above it, the camera is not
/// rigidly mounted.
const MAX_SCATTER: f64 = 1.0 / 3.0;

impl CalibrationMonitor {
    /// Starts with the given camera and rig.
    pub fn new(camera: &Camera, given: &Rig) -> Self {
        let config =
            DrivingConfig { max_tracks: MAX_TRACKS, max_pairs: LAST_CHECK, ..DrivingConfig::default() };
        let driven = DrivenTilt::new(camera, config);
        let (in_use, next_check) = (CalibrationUpdate::default(), FIRST_CHECK);
        Self { driven, given: *given, lens: true, in_use, deviates: false, next_check }
    }

    /// Starts with the given camera and rig where the odometry uses an earlier estimate.
    pub fn with_estimate(camera: &Camera, given: &Rig, in_use: &CalibrationUpdate) -> Self {
        let next_check = RECHECK_FACTOR * in_use.pairs;
        Self { in_use: in_use.clone(), deviates: true, next_check, ..Self::new(camera, given) }
    }

    /// The lens is known and not estimated.
    pub fn with_lens_known(self) -> Self {
        Self { lens: false, ..self }
    }

    /// Takes the next frame, the result of [`Odometry::process`], and its tracks. Returns the
    /// estimated calibration as soon as it differs significantly from the given one, or is clearly
    /// more precise than the earlier estimate; one of nothing where more of the recording
    /// contradicts the earlier estimate.
    pub fn watch(&mut self, frame: &FrameEstimate, odometry: &Odometry) -> Option<CalibrationUpdate> {
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
            self.deviates |= frame.estimate.as_ref().is_some_and(|known| self.differs(&known.pose));
        }
    }

    /// Whether there are enough pairs for the next check.
    pub(super) fn is_due(&self) -> bool {
        self.next_check <= LAST_CHECK && self.driven.pairs() >= self.next_check
    }

    /// Schedules the check after this one.
    pub(super) fn schedule_next(&mut self) {
        self.next_check *= if self.in_use.pairs == 0 { 2 } else { RECHECK_FACTOR };
    }

    /// A monitor for the rest of a recording that goes on with what was found.
    pub(super) fn after(&self, found: &CalibrationUpdate) -> Self {
        let watch = Self::with_estimate(&self.driven.camera, &self.given, found);
        Self { lens: self.lens, ..watch }
    }

    /// The check at the end of a recording that is too short for the next scheduled one: a short
    /// recording is cheap to track again.
    pub fn at_end(&self) -> Option<CalibrationUpdate> {
        // Tracks that were followed with a very wrong lens are off themselves.
        let is_off = self.in_use.lens.as_ref().is_some_and(|lens| lens.off_px > ROUGH_PX);
        let is_rough = is_off && !self.in_use.is_second;
        let least = match self.in_use.pairs {
            0 => FIRST_CHECK,
            pairs if is_rough => pairs,
            pairs => END_FACTOR * pairs,
        };
        let worth = self.next_check <= LAST_CHECK && self.driven.pairs() >= least;
        worth.then(|| self.check()).flatten()
    }

    /// The estimated calibration if it is to replace the one in use.
    pub(super) fn check(&self) -> Option<CalibrationUpdate> {
        if !self.deviates && self.driven.pairs() >= 2 * LAST_QUIET_CHECK {
            return None;
        }
        let (tilt, lens) = self.measured()?;
        let (used, explains) = (&self.in_use, self.driven.explains(&tilt));
        let lens = lens.filter(|_| explains);
        let tilt = Some(tilt).filter(|tilt| match lens {
            // What the motion leaves open between tilt and lens is in both estimates.
            Some(_) => self.off(tilt).norm() >= MIN_TILT_RAD && self.is_steady(tilt),
            None => {
                explains && self.differs_significantly(tilt)
                    || used.tilt.as_ref().is_some_and(|used| agrees(tilt, used))
            }
        });
        let (pairs, is_second) = (self.driven.pairs(), used.lens.is_some());
        let found = CalibrationUpdate { tilt, lens, pairs, is_second };
        self.replaces(&found).then_some(found)
    }

    /// The tilt, and the lens if it differs significantly; the tilt is the one estimated with that
    /// lens.
    fn measured(&self) -> Option<(TiltMeasurement, Option<LensMeasurement>)> {
        if !self.lens {
            return Some((self.driven.solve(&self.given, None).ok()?, None));
        }
        let found = self.driven.self_calibration(&self.given, self.in_use.lens.as_ref()).ok()?;
        Some(match found.lens {
            Some((lens, tilt)) if lens.is_significant() => (tilt, Some(lens)),
            _ => (found.tilt, None),
        })
    }

    /// Number of pairs of views so far.
    pub fn pairs(&self) -> usize {
        self.driven.pairs()
    }

    /// Whether the odometry deviates from the given height or tilt.
    fn differs(&self, pose: &GroundPose) -> bool {
        (pose.height_m / self.given.height_m - 1.0).abs() > MIN_DEVIATION
            || (pose.roll_rad - self.given.roll_rad).abs() > MIN_DEVIATION
            || (pose.pitch_rad - self.given.pitch_rad).abs() > MIN_DEVIATION
    }

    /// Whether this is to replace the estimate in use.
    fn replaces(&self, found: &CalibrationUpdate) -> bool {
        let used = &self.in_use;
        changes(&used.tilt, &found.tilt, is_better)
            || changes(&used.lens, &found.lens, |found, used| found.is_better_than(used))
    }

    /// A tilt less the given one.
    fn off(&self, found: &TiltMeasurement) -> Vector2<f64> {
        Vector2::new(found.roll_rad - self.given.roll_rad, found.pitch_rad - self.given.pitch_rad)
    }

    /// Whether a tilt differs from the given one significantly, steadily and by enough to matter.
    fn differs_significantly(&self, found: &TiltMeasurement) -> bool {
        let off = self.off(found);
        let certainty =
            found.covariance.try_inverse().map_or(0.0, |information| off.dot(&(information * off)));
        let level = self.given.roll_rad == 0.0 && self.given.pitch_rad == 0.0;
        let least_rad = if level { MIN_TILT_RAD } else { MIN_FROM_MEASURED_RAD };
        found.observability == Observability::Full
            && off.norm() >= least_rad
            && certainty >= MIN_SIGMAS * MIN_SIGMAS
            && self.is_steady(found)
    }

    /// Whether a tilt scatters little beside its difference from the given one.
    fn is_steady(&self, found: &TiltMeasurement) -> bool {
        let [roll, pitch] = found.scatter_rad;
        roll.hypot(pitch) < MAX_SCATTER * self.off(found).norm()
    }
}

/// Whether an estimate appears, disappears, or is better than the one in use.
fn changes<T>(used: &Option<T>, found: &Option<T>, is_better: impl Fn(&T, &T) -> bool) -> bool {
    match (used, found) {
        (Some(used), Some(found)) => is_better(found, used),
        _ => used.is_some() != found.is_some(),
    }
}

/// Whether a tilt does not differ significantly from the one in use.
fn agrees(found: &TiltMeasurement, used: &TiltMeasurement) -> bool {
    let off = Vector2::new(found.roll_rad - used.roll_rad, found.pitch_rad - used.pitch_rad);
    let information = (found.covariance + used.covariance).try_inverse();
    information.is_some_and(|information| off.dot(&(information * off)) < MIN_SIGMAS * MIN_SIGMAS)
}

/// Whether a tilt is clearly more precise than the one in use, and different from it.
fn is_better(found: &TiltMeasurement, used: &TiltMeasurement) -> bool {
    let off = (found.roll_rad - used.roll_rad).hypot(found.pitch_rad - used.pitch_rad);
    let worst = |tilt: &TiltMeasurement| tilt.covariance.symmetric_eigenvalues().max();
    off >= MIN_CHANGE_RAD && worst(found) < MAX_SIGMA_RATIO * MAX_SIGMA_RATIO * worst(used)
}

/// A better tilt is used if it differs by this much, radians.
const MIN_CHANGE_RAD: f64 = 5e-5;
