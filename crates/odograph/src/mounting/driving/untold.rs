//! A tilt of the mount that nobody told, noticed while a recording is followed.
//!
//! Ground that is laid out under a wrong tilt slopes: a camera that keeps its height over the floor seems to climb, by one part in sixty for
//! each degree, and the path is stretched with it. The floor's own movement through the image tells the tilt long before that matters much: a metre
//! and a half of driving, to a few thousandths of a degree on well-textured ground. So whoever reads a recording begins again with it, and the path
//! is that of a mount which had been told.

use super::{DrivenTilt, DrivingConfig, Revealed, TiltMeasurement};
use crate::camera::{Camera, Rig};
use crate::geometry::GroundPose;
use crate::odometry::TrackView;
use crate::trajectory::FrameEstimate;
use nalgebra::Vector2;

/// Watches a recording while [`crate::odometry::Odometry`] follows it with the motion model that chooses by evidence.
#[derive(Debug, Clone)]
pub struct UntoldTilt {
    driven: DrivenTilt,
    told: Rig,
    /// The measurement that the told tilt is, where it is one.
    measured: Option<TiltMeasurement>,
    /// Whether the odometry has found that the camera does not sit as it was told.
    doubted: bool,
    /// At so many pairs of views the tilt is looked at next.
    next_look: usize,
}

/// Pairs of views after which the tilt is looked at the first time, twice as many each time after that, and the last time. A pair is a movement by a tenth
/// of the image.
const FIRST_LOOK: usize = 8;
const LAST_LOOK: usize = 256;

/// A tilt that was measured is looked at again after so many times the pairs that it was measured from: it is known twice as well then, and to begin once more
/// costs a quarter of the way at most.
const AGAIN: usize = 4;

/// Tracks of a pair: of four hundred, these have most of what all say.
const MOST_TRACKS: usize = 80;

/// At the end of the recording twice the pairs are enough.
const AT_END: usize = 2;

/// What the odometry itself leaves as it was told while it is within this: parts of the height, radians. (On a mount that is as told it is a
/// hundredth of this.)
const DOUBTFUL: f64 = 2e-4;

/// A smaller tilt than this does not bend a path by more than the pixels do, radians.
const LEAST_RAD: f64 = 0.02 * std::f64::consts::PI / 180.0;

/// Who tells a tilt that is not straight down has measured it: what differs from it by less than this may as well be an error of the camera's calibration,
/// which looks like a tilt too, radians.
const LEAST_FROM_MEASURED_RAD: f64 = 0.5 * std::f64::consts::PI / 180.0;

/// A tilt is told apart from none where it is so many of its standard deviations off (once in some hundred thousand looks by chance, in two dimensions).
const SIGNIFICANT: f64 = 5.0;

/// A tilt is that of the mount, and not of a hand or of a spring, where it scatters from keyframe to keyframe by less than this part of itself.
const STEADY: f64 = 1.0 / 3.0;

impl UntoldTilt {
    /// Nothing seen yet of a camera that was told to sit like `told`.
    pub fn new(camera: &Camera, told: &Rig) -> Self {
        let config =
            DrivingConfig { most_tracks: MOST_TRACKS, most_pairs: LAST_LOOK, ..DrivingConfig::default() };
        let driven = DrivenTilt::new(camera, config);
        Self { driven, told: *told, measured: None, doubted: false, next_look: FIRST_LOOK }
    }

    /// The same where `told` has the tilt that was measured in an earlier part of the recording.
    pub fn measured(camera: &Camera, told: &Rig, measured: &TiltMeasurement) -> Self {
        let next_look = AGAIN * measured.pairs;
        Self { measured: Some(measured.clone()), doubted: true, next_look, ..Self::new(camera, told) }
    }

    /// Takes the next frame: what [`crate::odometry::Odometry::process`] gave, and its tracks. The tilt as it is, where by now it is sure that it is not the one
    /// that was told, or known better than the one that was measured.
    pub fn watch(&mut self, frame: &FrameEstimate, tracks: &[TrackView]) -> Option<TiltMeasurement> {
        if self.next_look > LAST_LOOK {
            return None;
        }
        self.driven.watch(frame, tracks);
        self.doubted |= frame.estimate.as_ref().is_some_and(|known| self.differs(&known.pose));
        if self.driven.pairs() < self.next_look {
            return None;
        }
        self.next_look *= if self.measured.is_some() { AGAIN } else { 2 };
        self.look()
    }

    /// The same at the end of the recording, where that is not far enough for the next look: with the tilt of all of it the short way is followed once more.
    pub fn at_end(&self) -> Option<TiltMeasurement> {
        let least = self.measured.as_ref().map_or(FIRST_LOOK, |before| AT_END * before.pairs);
        let worth = self.next_look <= LAST_LOOK && self.driven.pairs() >= least;
        worth.then(|| self.look()).flatten()
    }

    fn look(&self) -> Option<TiltMeasurement> {
        if !self.doubted {
            return None;
        }
        let found = self.driven.solve(&self.told, None).ok()?;
        let is_news = match &self.measured {
            Some(before) => self.is_better(&found, before),
            None => self.is_another(&found),
        };
        is_news.then_some(found)
    }

    /// How many pairs of views there are so far.
    pub fn pairs(&self) -> usize {
        self.driven.pairs()
    }

    /// Whether the odometry has a pose at another height or tilt than was told.
    fn differs(&self, pose: &GroundPose) -> bool {
        (pose.height_m / self.told.height_m - 1.0).abs() > DOUBTFUL
            || (pose.roll_rad - self.told.roll_rad).abs() > DOUBTFUL
            || (pose.pitch_rad - self.told.pitch_rad).abs() > DOUBTFUL
    }

    /// Whether a tilt is surely, steadily and usefully another than the one told.
    fn is_another(&self, found: &TiltMeasurement) -> bool {
        let off = Vector2::new(found.roll_rad - self.told.roll_rad, found.pitch_rad - self.told.pitch_rad);
        let [roll, pitch] = found.scatter_rad;
        let certainty =
            found.covariance.try_inverse().map_or(0.0, |information| off.dot(&(information * off)));
        let level = self.told.roll_rad == 0.0 && self.told.pitch_rad == 0.0;
        let least_rad = if level { LEAST_RAD } else { LEAST_FROM_MEASURED_RAD };
        found.revealed == Revealed::Both
            && off.norm() >= least_rad
            && certainty >= SIGNIFICANT * SIGNIFICANT
            && roll.hypot(pitch) < STEADY * off.norm()
    }

    /// Whether a tilt is known clearly better than before, and not the same for that.
    fn is_better(&self, found: &TiltMeasurement, before: &TiltMeasurement) -> bool {
        let off = (found.roll_rad - self.told.roll_rad).hypot(found.pitch_rad - self.told.pitch_rad);
        let worst = |tilt: &TiltMeasurement| tilt.covariance.symmetric_eigenvalues().max();
        off >= LEAST_BETTER_RAD && worst(found) < BETTER * BETTER * worst(before)
    }
}

/// A tilt that is known better is begun again with where it is another by this much, radians, and its deviation is so many times as large.
const LEAST_BETTER_RAD: f64 = 5e-5;
const BETTER: f64 = 0.8;
