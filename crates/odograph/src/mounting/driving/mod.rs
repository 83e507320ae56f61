//! Self-calibration of roll and pitch while driving over a flat floor, without a board.
//!
//! Two views of a flat floor from a camera at fixed height and tilt are related by the tilt (two
//! parameters) and a planar motion (three). Under a wrong tilt no planar motion explains the
//! optical flow; the estimate is the tilt that explains all pairs of a recording best. The plane's
//! homography, expanded for a small tilt, shows what is observable:
//!
//! * A translation determines both angles, because near ground moves faster through the image than
//!   far ground. Its information grows with the translation and with the distance from the image
//!   centre.
//! * A rotation determines both as well, because its axis is the vertical; the point where that
//!   axis meets the ground is unknown, however, so that its information grows with the angle and
//!   with the square of the distance from the centre: it needs a wide lens.
//! * Standing still determines nothing. The height is never observable: a floor twice as far below
//!   a vehicle twice as fast looks the same.
//!
//! The information matrix of all pairs shows what a recording determines, and how well. Turns and
//! translations in several directions also decorrelate the tilt from errors of the lens.

mod bundle;
mod lens;
mod online;
mod rates;
mod monitor;

use bundle::{Solved, TILT};
pub use lens::{LensCoefficient, LensMeasurement, SelfCalibration};
pub use monitor::{CalibrationMonitor, CalibrationUpdate};
pub use online::OnlineCalibration;

use crate::camera::{Camera, CameraUncertainty, Rig};
use crate::error::{Error, Result};
use crate::geometry::{GroundPose, Pixel};
use crate::keyframe::KeyframeId;
use crate::motion::PoseRates;
use crate::numerics::Combined;
use crate::odometry::tracking::track_whitenings;
use crate::odometry::{Odometry, TrackView};
use crate::trajectory::FrameEstimate;
use nalgebra::Matrix2;
use rates::{Moving, RateHistory};
use std::collections::VecDeque;

/// Selection of pairs of views.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrivingConfig {
    /// Motion of the tracks from one pair to the next, as a fraction of the shorter image side.
    pub step: f64,
    /// Largest number of tracks of a pair, evenly chosen.
    pub max_tracks: usize,
    /// Largest number of pairs; later ones are not used.
    pub max_pairs: usize,
}

impl Default for DrivingConfig {
    fn default() -> Self {
        Self { step: 0.1, max_tracks: 200, max_pairs: 4000 }
    }
}

/// Collects pairs of views while [`crate::odometry::Odometry`] tracks a recording, then solves for
/// the tilt.
#[derive(Debug, Clone)]
pub struct DrivenTilt {
    camera: Camera,
    config: DrivingConfig,
    groups: Vec<Group>,
    pairs: usize,
    /// Motion of the tracks at the last pair of the present keyframe, pixels.
    moved_px: f64,
    rates: RateHistory,
    /// Whether the ground looks uneven, and the mean squared residual of a fit with elevations if
    /// so.
    relief_seen: bool,
    relief: MeanSquare,
    /// Pairs whose frames' rates are not known yet.
    pending: VecDeque<Pending>,
    path: DrivenPath,
}

/// The pairs of one keyframe, whose errors are correlated.
#[derive(Debug, Clone, Default)]
pub(in crate::mounting) struct Group {
    pairs: Vec<ViewPair>,
}

/// A keyframe and a later frame.
#[derive(Debug, Clone)]
struct ViewPair {
    tracks: Vec<PairedTrack>,
    /// Rates of both views, where known.
    exposure: Option<PairExposure>,
}

/// A track from a keyframe to a later frame.
#[derive(Debug, Clone, Copy)]
struct PairedTrack {
    /// Its pixels in both.
    first: Pixel,
    second: Pixel,
    /// Whether the odometry took it for an inlier.
    agrees: bool,
    /// Whitening matrix of its error, relative to a median track: a track on a straight edge counts
    /// across the edge only.
    whitening: Matrix2<f64>,
}

impl PairedTrack {
    /// Of tracks from a keyframe to one frame.
    fn of(tracks: &[&TrackView]) -> Vec<Self> {
        let paired = |(track, whitening): (&&TrackView, Matrix2<f64>)| Self {
            first: track.corner,
            second: track.pixel,
            agrees: track.inlier,
            whitening,
        };
        tracks.iter().zip(track_whitenings(tracks)).map(paired).collect()
    }

    /// The number of coordinates that count: one on a straight edge, two at a corner.
    fn coordinates(&self) -> f64 {
        let information = self.whitening.transpose() * self.whitening;
        information.trace() / information.symmetric_eigenvalues().max()
    }
}

/// Rates of the pose in both views of a pair, in the axes of the first view and in units of its
/// height, per second, and the distance from the first view at that time (heights): the rates of
/// the position are wrong in the same proportion as that distance.
#[derive(Debug, Clone, Copy)]
struct PairExposure {
    rates: [PoseRates; 2],
    /// The accelerations.
    accelerations: [PoseRates; 2],
    distance: f64,
}

/// A pair without rates: its group and its index there, its keyframe, and the number of its frame.
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

/// Path of the camera over the ground, at the height that the odometry assumed.
#[derive(Debug, Clone, Default)]
struct DrivenPath {
    last: Option<GroundPose>,
    /// Last vertex of the polyline that is measured, and its length up to there.
    corner: Option<GroundPose>,
    length_m: f64,
    deviation_m: f64,
    segment: usize,
    frames: usize,
    lost: usize,
}

/// The tilt as estimated while driving.
#[derive(Debug, Clone, PartialEq)]
pub struct TiltMeasurement {
    /// Roll, radians.
    pub roll_rad: f64,
    /// Pitch, radians.
    pub pitch_rad: f64,
    /// Covariance of (roll, pitch), radians².
    pub covariance: Matrix2<f64>,
    /// Whether the motion determined both angles.
    pub observability: Observability,
    /// Standard deviation of (roll, pitch) between keyframes beyond the noise of the tracks,
    /// radians: a mount that shakes, an uneven floor.
    pub scatter_rad: [f64; 2],
    /// Number of keyframes with information.
    pub keyframes: usize,
    /// Number of pairs used.
    pub pairs: usize,
    /// Root mean square residual of the inliers, pixels.
    pub rms_px: f64,
}

/// Observability of the tilt.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Observability {
    /// Roll and pitch are both determined.
    Full,
    /// Some combination of them is not; it must not be used.
    Partial {
        /// Components of roll and pitch in the least certain combination, a unit vector.
        worst: [f64; 2],
        /// One standard deviation of that combination, radians.
        deviation_rad: f64,
    },
}

/// Least motion of the only pair of a keyframe, as a fraction of a step.
const MIN_STEP_FRACTION: f64 = 0.25;

/// Largest standard deviation of a usable estimate, degrees: a mount that is simply assumed to be
/// level is about as good.
const MAX_SIGMA_DEG: f64 = 0.25;

/// A plane explains the tracks as well as elevations do if its residual is below this multiple of
/// theirs, which lack the component along the parallax of free points: up to √2 times less. Over
/// flat ground with an unknown lens the ratio was 0.1 to 1.4; over rendered relief of all kinds it
/// was 1.5 to 14 when theirs had both components.
const MAX_RELIEF_RATIO: f64 = 1.7;

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

/// A new estimate replaces the one in use if its standard deviation is smaller by this factor.
const MAX_SIGMA_RATIO: f64 = 0.8;

/// Fewer keyframes do not determine their scatter.
const MIN_KEYFRAMES: usize = 4;

impl DrivenTilt {
    /// Starts empty.
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
            pending: VecDeque::new(),
            path: DrivenPath::default(),
        }
    }

    /// Takes the next frame, the result of [`Odometry::process`], and its tracks.
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
        // The last frame of a keyframe makes a pair too: under a very wrong tilt no keyframe lasts
        // a whole step.
        let none_yet = self.groups.last().is_none_or(|group| group.pairs.is_empty());
        let least_px = if none_yet { MIN_STEP_FRACTION * step_px } else { step_px };
        let far = far || (frame.keyframe && moved_px >= least_px);
        if far && self.pairs < self.config.max_pairs {
            let every = tracks.len().div_ceil(self.config.max_tracks.max(1));
            let tracks = PairedTrack::of(&tracks.iter().step_by(every).collect::<Vec<_>>());
            let index = self.groups.len() - 1;
            if let Some(group) = self.groups.last_mut() {
                let pair = (index, group.pairs.len());
                if self.relief_seen {
                    self.relief.add(frame.residual_px);
                }
                self.pending.extend(reference.map(|keyframe| Pending { pair, keyframe, frame: count }));
                group.pairs.push(ViewPair { tracks, exposure: None });
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

    /// Whether a plane explains the tracks, with the estimate, as well as elevations do where the
    /// ground looked uneven.
    pub(super) fn explains(&self, found: &TiltMeasurement) -> bool {
        self.relief.root().is_none_or(|relief_px| found.rms_px < MAX_RELIEF_RATIO * relief_px)
    }

    /// Number of pairs of views so far.
    pub fn pairs(&self) -> usize {
        self.pairs
    }

    /// Length of the path by the odometry and one standard deviation, metres at the assumed height.
    /// `None` if tracking was lost.
    pub fn path_length_m(&self) -> Option<(f64, f64)> {
        (self.path.segment == 0 && self.path.frames > 0)
            .then_some((self.path.length_m, self.path.deviation_m))
    }

    /// Fraction of the frames without a pose.
    pub fn lost_fraction(&self) -> f64 {
        self.path.lost as f64 / (self.path.lost + self.path.frames).max(1) as f64
    }

    /// Estimates the tilt from all pairs, starting at `start`, which may be off by ten degrees.
    ///
    /// Gauss–Newton on the re-projection error of all pairs over roll, pitch and one planar motion
    /// per pair (eliminated by Schur complements), with Tukey's biweight at the scale of each pair.
    /// The keyframes are then combined as measurements with a random effect, so that the covariance
    /// holds for a shaking mount as well.
    ///
    /// `uncertainty` is that of the camera's parameters, if known: an error of the principal point
    /// is an error of the tilt that does not average out.
    ///
    /// # Errors
    ///
    /// If there are too few pairs to solve at all; a motion that does not determine the tilt is no
    /// error but stated in [`TiltMeasurement::observability`].
    pub fn solve(&self, start: &Rig, uncertainty: Option<&CameraUncertainty>) -> Result<TiltMeasurement> {
        let solved =
            bundle::solve::<TILT>((&self.camera, &[]), self.groups.iter(), start).ok_or_else(too_few)?;
        let mut combined = solved.combined().ok_or_else(too_few)?;
        if let Some(uncertainty) = uncertainty {
            let [roll, pitch] = combined.offset.into();
            let found =
                Rig { roll_rad: solved.roll_rad + roll, pitch_rad: solved.pitch_rad + pitch, ..*start };
            combined.covariance += self.camera_covariance(&found, uncertainty).ok_or_else(|| {
                Error::input(
                    "the camera's parameters are too uncertain to determine the tilt from driving; calibrate the camera again",
                )
            })?;
        }
        self.tilt(&solved, &combined)
    }

    /// The tilt among the common unknowns.
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
        "the recording shows too little motion over the floor to determine the camera's tilt; drive at least 5 m, with turns to both sides",
    )
}

impl DrivenTilt {
    /// Covariance of the tilt due to the camera's. Some keyframes are enough for the derivative.
    fn camera_covariance(&self, found: &Rig, uncertainty: &CameraUncertainty) -> Option<Matrix2<f64>> {
        const MAX_KEYFRAMES: usize = 40;
        let every = self.groups.len().div_ceil(MAX_KEYFRAMES).max(1);
        uncertainty.propagated(&self.camera, |camera| {
            let solved = bundle::solve::<TILT>((camera, &[]), self.groups.iter().step_by(every), found)?;
            let Combined { offset, .. } = solved.combined()?;
            Some([solved.roll_rad + offset[0], solved.pitch_rad + offset[1]])
        })
    }
}

impl DrivenPath {
    /// Vertices are a twentieth of the height apart: short enough for curves, long enough that
    /// noise does not lengthen the path.
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
        let step_m = self.corner.get_or_insert(pose).distance_m(&pose);
        if step_m >= Self::STEP * pose.height_m {
            self.length_m += step_m;
            self.corner = Some(pose);
        }
        let covariance = &estimate.covariance;
        self.deviation_m = (covariance[(0, 0)] + covariance[(1, 1)]).max(0.0).sqrt();
    }
}

fn square(value: f64) -> f64 {
    value * value
}

#[cfg(test)]
mod tests;
