//! What is known of height, roll and pitch, and of the tracks' errors, before a frame is measured.

use super::sharing::Neighbours;
use super::steady_tilt::{MountChange, Off, SteadyTilt};
use super::{MotionConfig, MotionEstimate, MotionModel};
use crate::geometry::GroundPose;
use nalgebra::{Matrix6, Vector3};

/// A Gaussian over height (metres), roll and pitch (radians).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigPrior {
    /// What they are thought to be.
    pub mean: [f64; 3],
    /// One standard deviation.
    pub sigma: [f64; 3],
    /// The part of its error that a track shares with all the others, 0 to 1.
    pub shared_part: f64,
}

impl RigPrior {
    /// The same, wide enough to reach the pose of a keyframe: where that is off the mount so is the plane
    /// on which its points lie, and every frame measured against them.
    pub fn reaching(mut self, keyframe: &GroundPose) -> Self {
        let there = [keyframe.height_m, keyframe.roll_rad, keyframe.pitch_rad];
        for ((sigma, mean), there) in self.sigma.iter_mut().zip(self.mean).zip(there) {
            *sigma = sigma.max((there - mean).abs());
        }
        self
    }
}

/// How far height, roll or pitch is off: squares, averaged over the last frames.
#[derive(Debug, Clone, Copy, Default)]
struct Deviation {
    /// From the mount.
    from_mount: f64,
    /// From that of the keyframe, whose own error it does not hold.
    from_keyframe: f64,
    /// The variance of what the tracks say.
    noise: f64,
    /// The variance that the keyframe's own uncertainty adds.
    of_keyframe: f64,
}

impl Deviation {
    fn learn(&mut self, now: &Self) {
        let average = |mean: &mut f64, now: f64| *mean += LEARNING_RATE * (now - *mean);
        average(&mut self.from_mount, now.from_mount);
        average(&mut self.from_keyframe, now.from_keyframe);
        average(&mut self.noise, now.noise);
        average(&mut self.of_keyframe, now.of_keyframe);
    }

    /// The variance of the rig's own movement: none unless it is seen beyond doubt, either while a keyframe serves, or by how far the camera has
    /// come to be off without that being the keyframe's error.
    fn wander(&self, shared_part: f64) -> f64 {
        let beyond_doubt = BEYOND_DOUBT + BEYOND_SHARED * shared_part;
        let doubt = beyond_doubt * self.noise;
        // Between two frames a swaying rig is off by its variance twice; one that sways slowly is still near where it was at the keyframe.
        let sway = SLOWNESS * (0.5 * self.from_keyframe - doubt);
        let off = self.from_mount - doubt;
        sway.min(off).max(off - beyond_doubt * self.of_keyframe).max(0.0)
    }
}

/// At most so many times the variance that is seen while a keyframe serves is that over longer times, as far as it speaks for it.
const SLOWNESS: f64 = 4.0;

/// Squares beyond so many times their own variance are beyond doubt: twice comes by chance, since the average over twenty frames against one keyframe is
/// that of few. What all tracks share lasts from frame to frame, and the more that is, the fewer they are.
const BEYOND_DOUBT: f64 = 2.0;
const BEYOND_SHARED: f64 = 10.0;

/// How much the rig is seen to move: what `auto` decides by.
///
/// Height, roll and pitch are taken as scattered about those of the mount with a variance that the recording itself tells (empirical
/// Bayes; B. Efron and C. Morris, 1973): the squared deviations of what the tracks alone say, less what their noise and the keyframe's own error
/// explain, averaged over the last frames. On a cart nothing is left beyond doubt, the prior is tight, and the model is the rigid one; with a
/// shaking mount, a breathing drone or a hand it opens just as far as it must. What a steady tilt explains that nobody told is no movement: that tilt is
/// learned beside.
#[derive(Debug, Clone)]
pub struct RigWander {
    nominal: [f64; 3],
    deviations: [Deviation; 3],
    tilt: SteadyTilt,
    /// From the keyframe that serves to the last frame, and all the way that `tilt` was believed, metres.
    way_m: f64,
    driven_m: f64,
    neighbours: Neighbours,
}

/// Weight of the newest frame in the average: about the last twenty count.
const LEARNING_RATE: f64 = 0.05;

/// Standard deviations below these change nothing that could be measured: a part of the height, radians. (Six times as much is seen: every keyframe
/// then wavers by a fiftieth of a millimetre, which on a steady mount is most of the drift. With three fifths of it a mount that sways by 3° is followed a twentieth worse.)
const SMALLEST_SIGMA: [f64; 3] = [5e-6, 5e-6, 5e-6];

impl RigWander {
    /// Nothing seen yet: as steady as the mount says.
    pub fn new(mount: &GroundPose) -> Self {
        Self {
            nominal: [mount.height_m, mount.roll_rad, mount.pitch_rad],
            deviations: Default::default(),
            tilt: SteadyTilt::default(),
            way_m: 0.0,
            driven_m: 0.0,
            neighbours: Neighbours::default(),
        }
    }

    /// The prior for the next frame; `last` is the pose before it.
    pub fn prior(&self, last: &GroundPose, config: &MotionConfig) -> RigPrior {
        let shared_part = self.neighbours.shared_part();
        match config.model {
            MotionModel::Auto => {
                let smallest = [SMALLEST_SIGMA[0] * self.nominal[0], SMALLEST_SIGMA[1], SMALLEST_SIGMA[2]];
                let wander = self.wander();
                let sigma = [0, 1, 2].map(|i| wander[i].sqrt().max(smallest[i]));
                RigPrior { mean: self.mount(), sigma, shared_part }
            }
            _ => RigPrior {
                mean: [last.height_m, last.roll_rad, last.pitch_rad],
                sigma: [config.height_prior * last.height_m, config.tilt_prior_rad, config.tilt_prior_rad],
                shared_part,
            },
        }
    }

    /// The variances of the rig's own movement.
    fn wander(&self) -> [f64; 3] {
        let shared_part = self.neighbours.shared_part();
        self.deviations.map(|deviation| deviation.wander(shared_part))
    }

    /// Height, roll and pitch of the mount, as far as they are known.
    fn mount(&self) -> [f64; 3] {
        let (tilt, [height_m, roll_rad, pitch_rad]) = (self.tilt.found(), self.nominal);
        [height_m, roll_rad + tilt.x, pitch_rad + tilt.y]
    }

    /// Learns from a measured frame: from which pose of its keyframe that was done, and what that one's uncertainty makes of the frame's covariance.
    pub fn learn(&mut self, estimate: &MotionEstimate, keyframe: &GroundPose, carried: &Matrix6<f64>) {
        self.neighbours.learn(&estimate.neighbours);
        let Some(evidence) = &estimate.rig_evidence else {
            return;
        };
        let from = [keyframe.height_m, keyframe.roll_rad, keyframe.pitch_rad];
        let mount = self.mount();
        let of_keyframe = [3, 4, 5].map(|i| carried[(i, i)]);
        let off = Off {
            frame: Vector3::from_fn(|i, _| evidence.value[i] - self.nominal[i]),
            keyframe: Vector3::from_fn(|i, _| from[i] - self.nominal[i]),
            variances: Vector3::from_fn(|i, _| evidence.variance[i] + of_keyframe[i]),
            sway: self.wander().into(),
        };
        let explained = self.tilt.learn(evidence, &off);
        self.way_m = (estimate.pose.x_m - keyframe.x_m).hypot(estimate.pose.y_m - keyframe.y_m);
        for (i, &value) in evidence.value.iter().enumerate() {
            let unexplained = explained.map_or(f64::INFINITY, |explained| off.frame[i] - explained[i]);
            let apart = |from: f64| (value - from).powi(2).min(unexplained.powi(2));
            let now = Deviation {
                from_mount: apart(mount[i]),
                from_keyframe: apart(from[i]),
                noise: evidence.variance[i],
                of_keyframe: of_keyframe[i],
            };
            self.deviations[i].learn(&now);
        }
    }

    /// Another keyframe serves from here on. Gives what has to be set right in the poses of keyframes where the mount is now known to be otherwise.
    pub fn settle(&mut self) -> Option<MountChange> {
        let (before, wander) = (self.mount(), self.wander());
        let steady = wander.map(|wander| wander == 0.0);
        self.driven_m += std::mem::take(&mut self.way_m);
        self.tilt.settle(wander[1] + wander[2]).then(|| {
            let driven_m = std::mem::take(&mut self.driven_m);
            MountChange { before, now: self.mount(), steady, driven_m }
        })
    }
}
