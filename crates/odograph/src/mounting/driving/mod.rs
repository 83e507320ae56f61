//! Roll and pitch from driving about on a flat floor, without a board.
//!
//! Two views of a flat floor from a camera at a fixed height and tilt are related by the tilt and a planar movement, two numbers and three.
//! Under a wrong tilt no planar movement explains how the floor moves through the image; the tilt under which all pairs of a recording are
//! explained best is that of the camera. What each movement says, from the plane's homography expanded in a small tilt:
//!
//! * A shift says both angles, by how much faster near ground moves through the image than far ground. What it says grows with the
//!   shift and with the distance from the middle of the image.
//! * A turn says both too, because its axis is the plumb line; but where that axis meets the ground is not known, so what it says
//!   grows with the angle and with the square of the distance from the middle: it needs a wide lens.
//! * Standing still says nothing. Height is never said: a floor twice as far below a carrier twice as fast looks the same.
//!
//! Which of the two a recording determines, and how well, is read from the information matrix of all its pairs. Turns and shifts to several
//! sides do more than that: errors of the lens that look like a tilt in one direction do not in another.

mod bundle;
mod lens;
mod online;
mod rates;
mod readout;
mod monitor;

use bundle::{READOUT, Solved, TILT};
pub use lens::{LensCoefficient, LensMeasurement, SelfCalibration};
pub use monitor::{CalibrationMonitor, Found};
pub use online::OnlineCalibration;
pub use readout::ReadoutMeasurement;

use crate::camera::{Camera, CameraUncertainty, Rig};
use crate::error::{Error, Result};
use crate::geometry::{GroundPose, Pixel};
use crate::keyframe::KeyframeId;
use crate::numerics::{Combined, combine};
use crate::odometry::{Odometry, TrackView};
use crate::trajectory::FrameEstimate;
use nalgebra::Matrix2;
use rates::{Moving, PoseRates, RateHistory};
use std::collections::VecDeque;

/// How pairs of views are chosen from a recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrivingConfig {
    /// A pair is taken each time the tracks have moved by so much of the shorter side of the image since the last one.
    pub step: f64,
    /// So many tracks of a pair are kept, evenly chosen.
    pub max_tracks: usize,
    /// So many pairs are kept; what comes after them is not used.
    pub max_pairs: usize,
}

impl Default for DrivingConfig {
    fn default() -> Self {
        Self { step: 0.1, max_tracks: 200, max_pairs: 4000 }
    }
}

/// Collects pairs of views from a recording while [`crate::odometry::Odometry`] follows it, then solves for the tilt.
#[derive(Debug, Clone)]
pub struct DrivenTilt {
    camera: Camera,
    config: DrivingConfig,
    groups: Vec<Group>,
    pairs: usize,
    /// How far the tracks had moved at the last pair of the present keyframe, pixels.
    moved_px: f64,
    rates: RateHistory,
    /// Whether the ground looks uneven, and what elevations leave of the tracks where it does.
    relief_seen: bool,
    relief: MeanSquare,
    /// The readout time with which the odometry works, seconds.
    assumed_readout_s: f64,
    /// Pairs that wait for the rates of their frames.
    pending: VecDeque<Pending>,
    path: DrivenPath,
}

/// The pairs of one keyframe, whose errors are not independent.
#[derive(Debug, Clone, Default)]
pub(in crate::mounting) struct Group {
    pairs: Vec<Pair>,
}

/// Tracks from a keyframe to a later frame: where they are in both, and whether the odometry agreed with them.
#[derive(Debug, Clone)]
struct Pair {
    tracks: Vec<(Pixel, Pixel, bool)>,
    /// How the two images were exposed, where that is known.
    exposure: Option<PairExposure>,
}

/// Rates of the pose in the two views of a pair, in the axes of the first view and in units of its
/// height, per second, and how far the camera was then from the first view (heights): the rates of
/// the position are wrong in the same proportion as that.
#[derive(Debug, Clone, Copy)]
struct PairExposure {
    rates: [PoseRates; 2],
    /// The same of their derivatives.
    accelerations: [PoseRates; 2],
    distance: f64,
}

/// A pair whose exposure is not known yet: its group and its place there, its keyframe, and the count of
/// its frame.
#[derive(Debug, Clone, Copy)]
struct Pending {
    pair: (usize, usize),
    keyframe: KeyframeId,
    frame: u64,
}

impl PairExposure {
    fn new(first: &Moving, second: &Moving) -> Self {
        let (height_m, (sin, cos)) = (first.pose[3], first.pose[2].sin_cos());
        let local = |r: PoseRates| {
            let (x, y) = (cos * r[0] + sin * r[1], cos * r[1] - sin * r[0]);
            PoseRates::new(x / height_m, y / height_m, r[2], r[3] / height_m, r[4], r[5])
        };
        let both = [first, second];
        Self {
            rates: both.map(|view| local(view.rates)),
            accelerations: both.map(|view| local(view.accelerations)),
            distance: (second.pose[0] - first.pose[0]).hypot(second.pose[1] - first.pose[1]) / height_m,
        }
    }
}

/// The way of the camera over the ground, at the height that the odometry assumed.
#[derive(Debug, Clone, Default)]
struct DrivenPath {
    last: Option<GroundPose>,
    /// The last corner of the line that is measured, and how long that is up to there.
    corner: Option<GroundPose>,
    length_m: f64,
    deviation_m: f64,
    segment: usize,
    frames: usize,
    lost: usize,
}

/// The tilt as a recording of driving tells it.
#[derive(Debug, Clone, PartialEq)]
pub struct TiltMeasurement {
    /// Roll, radians.
    pub roll_rad: f64,
    /// Pitch, radians.
    pub pitch_rad: f64,
    /// Covariance of (roll, pitch), radians².
    pub covariance: Matrix2<f64>,
    /// The readout time that goes with it; `None` where it was not looked for.
    pub readout: Option<ReadoutMeasurement>,
    /// Whether the movement determined both.
    pub observability: Observability,
    /// Standard deviation of (roll, pitch) from keyframe to keyframe beyond the noise of the tracks: a mount that shakes, an uneven floor.
    pub scatter_rad: [f64; 2],
    /// Keyframes that said something.
    pub keyframes: usize,
    /// Pairs of views used.
    pub pairs: usize,
    /// Root mean square misfit of the tracks that agree, pixels.
    pub rms_px: f64,
}

/// Whether the movement determined the tilt.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Observability {
    /// Roll and pitch are both known well enough to be used.
    Full,
    /// Some combination of them is not: the measurement must not be used for it.
    Partial {
        /// The part of roll in the combination that is known worst, and the part of pitch; a unit vector.
        worst: [f64; 2],
        /// One standard deviation of it, radians.
        deviation_rad: f64,
    },
}

/// The only pair of a keyframe may be so much of a step.
const MIN_STEP_FRACTION: f64 = 0.25;

/// A tilt known worse than this is not a measurement: the level mount that people take without one is about as good, degrees.
const MAX_SIGMA_DEG: f64 = 0.25;

/// A plane explains tracks as well as elevations do if it leaves less than this multiple of what those
/// leave. Over flat ground with an unknown lens it left 0.1 to 0.5 times as much, over rendered relief
/// of all kinds 1.5 to 14 times.
const MAX_RELIEF_RATIO: f64 = 1.3;

/// A mean of squares.
#[derive(Debug, Clone, Copy, Default)]
struct MeanSquare {
    sum: f64,
    count: usize,
}

impl MeanSquare {
    fn add(&mut self, value: f64) {
        self.sum += value * value;
        self.count += 1;
    }

    /// Its root; `None` of no values.
    fn root(&self) -> Option<f64> {
        (self.count > 0).then(|| (self.sum / self.count as f64).sqrt())
    }
}

/// Fewer keyframes than this cannot tell how much they scatter.
const MIN_KEYFRAMES: usize = 4;

impl DrivenTilt {
    /// Nothing seen yet.
    pub fn new(camera: &Camera, config: DrivingConfig) -> Self {
        Self {
            camera: camera.clone(),
            config,
            groups: vec![Group::default()],
            pairs: 0,
            moved_px: 0.0,
            rates: RateHistory::default(),
            relief_seen: false,
            relief: MeanSquare::default(),
            assumed_readout_s: camera.readout_s().unwrap_or(0.0),
            pending: VecDeque::new(),
            path: DrivenPath::default(),
        }
    }

    /// Tells with which readout time the odometry works, seconds, where that of the camera is looked for.
    fn set_assumed_readout_s(&mut self, readout_s: f64) {
        self.assumed_readout_s = readout_s;
    }

    /// Takes the next frame: what [`Odometry::process`] gave, and its tracks.
    pub fn watch(&mut self, frame: &FrameEstimate, odometry: &Odometry) {
        let reference = odometry.reference().map(|reference| reference.keyframe);
        self.relief_seen = odometry.sees_relief();
        self.add_frame(frame, odometry.tracks(), reference);
    }

    fn add_frame(&mut self, frame: &FrameEstimate, tracks: &[TrackView], reference: Option<KeyframeId>) {
        self.path.add_frame(frame);
        let count = self.rates.push(frame, reference);
        self.expose_pairs();
        if frame.estimate.is_none() || tracks.is_empty() {
            return self.next_keyframe();
        }
        let squares: f64 = tracks.iter().map(|track| square(track.pixel.distance(track.corner))).sum();
        let moved_px = (squares / tracks.len() as f64).sqrt();
        let step_px = self.config.step * self.camera.width().min(self.camera.height()) as f64;
        let far = (moved_px - self.moved_px).abs() >= step_px;
        // A keyframe that is left says what it can; under a tilt that is far off none lasts a whole step.
        let none_yet = self.groups.last().is_none_or(|group| group.pairs.is_empty());
        let least_px = if none_yet { MIN_STEP_FRACTION * step_px } else { step_px };
        let far = far || (frame.keyframe && moved_px >= least_px);
        if far && self.pairs < self.config.max_pairs {
            let every = tracks.len().div_ceil(self.config.max_tracks.max(1));
            let kept = tracks.iter().step_by(every);
            let tracks = kept.map(|track| (track.corner, track.pixel, track.inlier)).collect();
            let index = self.groups.len() - 1;
            if let Some(group) = self.groups.last_mut() {
                let pair = (index, group.pairs.len());
                if self.relief_seen {
                    self.relief.add(frame.residual_px);
                }
                self.pending.extend(reference.map(|keyframe| Pending { pair, keyframe, frame: count }));
                group.pairs.push(Pair { tracks, exposure: None });
                self.pairs += 1;
            }
            self.moved_px = moved_px;
        }
        if frame.keyframe {
            self.next_keyframe();
        }
    }

    /// Assigns exposures to pairs as soon as the rates of their frames are known.
    fn expose_pairs(&mut self) {
        while let Some(&Pending { pair: (group, pair), keyframe, frame }) = self.pending.front() {
            if !self.rates.is_decided(frame) {
                break;
            }
            self.pending.pop_front();
            let views = self.rates.of_keyframe(keyframe).zip(self.rates.of_frame(frame));
            if let Some(pair) = self.groups.get_mut(group).and_then(|group| group.pairs.get_mut(pair)) {
                pair.exposure = views.map(|(first, second)| PairExposure::new(&first, &second));
            }
        }
    }

    fn next_keyframe(&mut self) {
        self.moved_px = 0.0;
        if self.groups.last().is_none_or(|group| !group.pairs.is_empty()) {
            self.groups.push(Group::default());
        }
    }

    /// Whether an image can be read out in this time: before the next one begins.
    pub(super) fn is_possible(&self, found: &ReadoutMeasurement) -> bool {
        found.readout_s.abs() <= self.rates.step_s()
    }

    /// Whether a plane explains the tracks, with what was found, as well as elevations do where the ground
    /// looked uneven.
    pub(super) fn explains(&self, found: &TiltMeasurement) -> bool {
        self.relief.root().is_none_or(|relief_px| found.rms_px < MAX_RELIEF_RATIO * relief_px)
    }

    /// How many pairs of views there are so far.
    pub fn pairs(&self) -> usize {
        self.pairs
    }

    /// How far the camera went over the ground by the odometry, and one standard deviation, both in metres at the height that it assumed.
    /// `None` where the path is broken by a loss.
    pub fn path_length_m(&self) -> Option<(f64, f64)> {
        (self.path.segment == 0 && self.path.frames > 0)
            .then_some((self.path.length_m, self.path.deviation_m))
    }

    /// The part of the frames that could not be measured.
    pub fn lost_fraction(&self) -> f64 {
        self.path.lost as f64 / (self.path.lost + self.path.frames).max(1) as f64
    }

    /// The tilt that explains all pairs best; `start` is where the search begins, ten degrees off do no harm.
    ///
    /// Gauss–Newton on the re-projection misfit of all pairs over roll, pitch and one planar movement a pair (eliminated by their Schur
    /// complements), with Tukey's biweight at the scale of each pair. The keyframes are then brought together as measurements that
    /// scatter beyond their own noise, so that the covariance also holds for a mount that shakes.
    ///
    /// `uncertainty` is that of the camera's parameters, where it is known: an error of the principal point is one of the tilt, and no
    /// amount of driving averages it out.
    ///
    /// Fails where there are too few pairs to solve at all; a movement that does not determine the tilt is told by
    /// [`TiltMeasurement::observability`].
    pub fn solve(&self, start: &Rig, uncertainty: Option<&CameraUncertainty>) -> Result<TiltMeasurement> {
        let solved = bundle::solve::<TILT>(&self.camera, self.groups.iter(), start).ok_or_else(too_few)?;
        let mut combined = combine(&solved.parts).ok_or_else(too_few)?;
        if let Some(uncertainty) = uncertainty {
            let [roll, pitch] = combined.offset.into();
            let found =
                Rig { roll_rad: solved.roll_rad + roll, pitch_rad: solved.pitch_rad + pitch, ..*start };
            combined.covariance += self.camera_covariance(&found, uncertainty).ok_or_else(|| {
                Error::input(
                    "the camera's own uncertainty is so large that driving says nothing; calibrate the camera again",
                )
            })?;
        }
        self.tilt(&solved, &combined)
    }

    /// The tilt of what the pairs have in common.
    fn tilt<const N: usize>(&self, solved: &Solved<N>, combined: &Combined<N>) -> Result<TiltMeasurement> {
        if solved.parts.len() < MIN_KEYFRAMES {
            return Err(too_few());
        }
        let covariance: Matrix2<f64> = combined.covariance.fixed_view::<TILT, TILT>(0, 0).into_owned();
        let eigen = covariance.symmetric_eigen();
        let worst = usize::from(eigen.eigenvalues[1] > eigen.eigenvalues[0]);
        let deviation_rad = eigen.eigenvalues[worst].max(0.0).sqrt();
        let observability = if deviation_rad <= MAX_SIGMA_DEG.to_radians() {
            Observability::Full
        } else {
            let direction = eigen.eigenvectors.column(worst);
            Observability::Partial { worst: [direction[0], direction[1]], deviation_rad }
        };
        Ok(TiltMeasurement {
            roll_rad: solved.roll_rad + combined.offset[0],
            pitch_rad: solved.pitch_rad + combined.offset[1],
            covariance,
            readout: (N > READOUT).then(|| ReadoutMeasurement::new(solved, combined, self.assumed_readout_s)),
            observability,
            scatter_rad: [0, 1].map(|k| combined.scatter[k].sqrt()),
            keyframes: solved.parts.len(),
            pairs: solved.pairs,
            rms_px: solved.rms_px,
        })
    }
}

fn too_few() -> Error {
    Error::input(
        "the recording does not show enough movement over the floor to tell the tilt; drive at least 5 m, with turns to both sides",
    )
}

impl DrivenTilt {
    /// The covariance that the camera's gives to the tilt. Some keyframes are enough to see how the tilt follows the camera.
    fn camera_covariance(&self, found: &Rig, uncertainty: &CameraUncertainty) -> Option<Matrix2<f64>> {
        const MAX_KEYFRAMES: usize = 40;
        let every = self.groups.len().div_ceil(MAX_KEYFRAMES).max(1);
        uncertainty.carried(&self.camera, |camera| {
            let solved = bundle::solve::<TILT>(camera, self.groups.iter().step_by(every), found)?;
            let Combined { offset, .. } = combine(&solved.parts)?;
            Some([solved.roll_rad + offset[0], solved.pitch_rad + offset[1]])
        })
    }
}

impl DrivenPath {
    /// Steps are as long as a twentieth of the height: short enough for any curve, long enough that noise does not lengthen them.
    const STEP: f64 = 0.05;

    fn add_frame(&mut self, frame: &FrameEstimate) {
        let Some(estimate) = &frame.estimate else {
            self.lost += 1;
            return;
        };
        self.frames += 1;
        self.segment = self.segment.max(frame.segment);
        let pose = estimate.pose;
        self.last = Some(pose);
        let step_m = distance_m(self.corner.get_or_insert(pose), &pose);
        if step_m >= Self::STEP * pose.height_m {
            self.length_m += step_m;
            self.corner = Some(pose);
        }
        let covariance = &estimate.covariance;
        self.deviation_m = (covariance[(0, 0)] + covariance[(1, 1)]).max(0.0).sqrt();
    }
}

fn distance_m(a: &GroundPose, b: &GroundPose) -> f64 {
    (a.x_m - b.x_m).hypot(a.y_m - b.y_m)
}

fn square(value: f64) -> f64 {
    value * value
}

#[cfg(test)]
mod tests;
