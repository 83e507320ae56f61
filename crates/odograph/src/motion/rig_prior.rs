//! What is known of height, roll and pitch, and of the tracks' errors, before a frame is measured.

use super::sharing::Neighbours;
use super::{MotionConfig, MotionEstimate, MotionModel};
use crate::geometry::GroundPose;
use nalgebra::{Matrix2, Matrix6, Vector2};

/// A Gaussian over height (metres), roll and pitch (radians).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigPrior {
    /// What they are thought to be.
    pub mean: [f64; 3],
    /// One standard deviation.
    pub sigma: [f64; 3],
    /// How much of the mean is the mount's; the rest is that of the pose before.
    pub mount_share: [f64; 3],
    /// The part of its error that a track shares with all the others, 0 to 1.
    pub shared_part: f64,
}

impl RigPrior {
    /// The same for a frame after one at `last`, from where height and tilt take usual steps.
    fn after(mut self, last: Option<&[f64; 3]>, steps: &[Steps; 3]) -> Self {
        let Some(last) = last else { return self };
        let least = [LEAST_STEP * last[0], LEAST_STEP, LEAST_STEP];
        for i in 0..3 {
            let (of_mount, of_step) = (self.sigma[i].powi(-2), 1.0 / steps[i].variance(least[i]));
            if of_step > 0.0 && of_step.is_finite() {
                self.mount_share[i] = of_mount / (of_mount + of_step);
                self.mean[i] += (1.0 - self.mount_share[i]) * (last[i] - self.mean[i]);
                self.sigma[i] = (of_mount + of_step).sqrt().recip();
            }
        }
        self
    }

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

/// How far height, roll or pitch changes from frame to frame: its mean square.
#[derive(Debug, Clone, Copy, Default)]
struct Steps {
    mean_square: f64,
    seen: usize,
}

impl Steps {
    fn learn(&mut self, step: f64) {
        // One that is far off is a fault rather than the rule.
        let most = if self.seen < STEPS_BEFORE { f64::INFINITY } else { 9.0 * self.mean_square };
        let rate = LEARNING_RATE.max(1.0 / (self.seen + 1) as f64);
        self.mean_square += rate * ((step * step).min(most) - self.mean_square);
        self.seen += 1;
    }

    /// The variance that a step is expected to have, wide enough to decide only what the tracks
    /// leave open.
    fn variance(&self, least: f64) -> f64 {
        let variance = (USUAL_STEPS * USUAL_STEPS * self.mean_square).max(least * least);
        if self.seen < STEPS_BEFORE { f64::INFINITY } else { variance }
    }
}

/// Steps seen before their mean square is used, and the standard deviation of the prior over their
/// root mean square.
const STEPS_BEFORE: usize = 10;
const USUAL_STEPS: f64 = 3.0;

/// Lower bound of that standard deviation, parts of the height and radians (0.2°). Without it a
/// wrong tilt that hardly changes confirms itself.
const LEAST_STEP: f64 = 0.0035;

/// A camera that turns by more than this from frame to frame is not fixed to what carries it,
/// radians (a tenth of a degree).
const MOUNTED_STEP: f64 = 0.5 * LEAST_STEP;

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
        let off = self.from_mount - beyond_doubt * self.noise;
        self.sway(shared_part).min(off).max(off - beyond_doubt * self.of_keyframe).max(0.0)
    }

    /// The variance of the rig's movement as it is seen while a keyframe serves, wherever the mount
    /// is.
    fn sway(&self, shared_part: f64) -> f64 {
        let doubt = (BEYOND_DOUBT + BEYOND_SHARED * shared_part) * self.noise;
        // Between two frames a swaying rig is off by its variance twice; one that sways slowly is still near where it was at the keyframe.
        (SLOWNESS * (0.5 * self.from_keyframe - doubt)).max(0.0)
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
/// Height, roll and pitch are taken as scattered about those of the mount with a variance that the
/// recording itself tells (empirical Bayes; B. Efron and C. Morris, 1973): the squared deviations
/// of what the tracks alone say, less what their noise and the keyframe's own error explain,
/// averaged over the last frames. On a cart nothing is left beyond doubt, the prior is tight, and
/// the model is the rigid one; with a shaking mount, a breathing drone or a hand it opens just as
/// far as it must. About which roll and pitch they scatter is learned, too.
#[derive(Debug, Clone)]
pub struct RigWander {
    nominal: [f64; 3],
    deviations: [Deviation; 3],
    tilt: [MountTilt; 2],
    steps: [Steps; 3],
    last: Option<[f64; 3]>,
    /// Elevation of the ground in view, of this frame and of the keyframe, metres.
    level_m: f64,
    keyframe_level_m: f64,
    /// The variance of the elevations of the quarters of the view, metres².
    unevenness_m2: f64,
    neighbours: Neighbours,
}

/// Error of the roll or pitch in the rig file: a normal distribution, radians.
#[derive(Debug, Clone, Copy)]
struct MountTilt {
    mean: f64,
    variance: f64,
    keyframes: usize,
    /// What the last frame says, and its variance.
    seen: Option<(f64, f64)>,
}

impl MountTilt {
    const UNKNOWN: Self = Self { mean: 0.0, variance: USUAL_TILT * USUAL_TILT, keyframes: 0, seen: None };

    /// Learns from the last frame of a keyframe, about which the rig sways with this variance.
    fn learn(&mut self, sway: f64) {
        let Some((value, variance)) = self.seen.take() else { return };
        let gain = self.variance / (self.variance + variance + sway);
        self.mean += gain * (value - self.mean);
        self.variance *= 1.0 - gain;
        self.keyframes += 1;
    }

    /// Mean squared error of the tilt that is taken for it.
    fn squared_error(&self, sway: f64) -> f64 {
        (self.mean - self.found(sway)).powi(2) + self.variance
    }

    /// The correction that is applied: none unless the mean is significant and the sway is smaller.
    fn found(&self, sway: f64) -> f64 {
        let is_beyond_doubt =
            self.keyframes >= LEAST_KEYFRAMES && self.mean * self.mean > BEYOND_DOUBT_TILT * self.variance;
        if is_beyond_doubt && sway < STEADY * STEADY * self.mean * self.mean { self.mean } else { 0.0 }
    }
}

/// What a tilt that nobody told is before anything was seen, one standard deviation, radians:
/// larger ones are seen by whoever mounts the camera.
const USUAL_TILT: f64 = 0.05;

/// Squared standard deviations at which the mean is significant (five sigma), and keyframes that
/// must have contributed: over a single one a slow sway looks like a constant tilt.
const BEYOND_DOUBT_TILT: f64 = 25.0;
const LEAST_KEYFRAMES: usize = 3;

/// A tilt is that of the mount, and not of a hand or of a spring, where it sways by less than this
/// part of itself.
const STEADY: f64 = 1.0 / 3.0;

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
            tilt: [MountTilt::UNKNOWN; 2],
            steps: Default::default(),
            last: None,
            level_m: 0.0,
            keyframe_level_m: 0.0,
            unevenness_m2: 0.0,
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
                let mut sigma = [0, 1, 2].map(|i| wander[i].sqrt().max(smallest[i]));
                sigma[0] = sigma[0].hypot(self.unevenness_m2.sqrt());
                RigPrior { mean: self.mount(), sigma, mount_share: [1.0; 3], shared_part }
                    .after(self.last.as_ref(), &self.steps)
            }
            _ => RigPrior {
                mean: [last.height_m, last.roll_rad, last.pitch_rad],
                sigma: [config.height_prior * last.height_m, config.tilt_prior_rad, config.tilt_prior_rad],
                mount_share: [0.0; 3],
                shared_part,
            },
        }
    }

    /// The variances of the rig's own movement.
    fn wander(&self) -> [f64; 3] {
        let shared_part = self.neighbours.shared_part();
        self.deviations.map(|deviation| deviation.wander(shared_part))
    }

    fn sway(&self) -> [f64; 3] {
        let shared_part = self.neighbours.shared_part();
        self.deviations.map(|deviation| deviation.sway(shared_part))
    }

    /// Variances of roll and pitch of the mount. Zero for a camera that turns from frame to frame,
    /// which is held or shaken, and smaller where neighbouring tracks have correlated errors, which
    /// a tilt does not explain.
    pub fn mount_doubt(&self) -> [f64; 2] {
        let (wander, own_part) = (self.wander(), 1.0 - self.neighbours.shared_part());
        let steps = self.steps.map(|steps| steps.mean_square);
        let is_mounted = steps[1].max(steps[2]) < MOUNTED_STEP * MOUNTED_STEP;
        let doubt = |i: usize| own_part * (wander[i] - SLOWNESS * steps[i]).max(0.0);
        [1, 2].map(|i| if is_mounted { doubt(i) } else { 0.0 })
    }

    /// Mean squared errors of the roll and pitch that are taken for the mount's.
    pub fn tilt_errors(&self) -> Matrix2<f64> {
        let [_, of_roll, of_pitch] = self.sway();
        let [roll, pitch] = &self.tilt;
        Matrix2::from_diagonal(&Vector2::new(roll.squared_error(of_roll), pitch.squared_error(of_pitch)))
    }

    /// Takes the covariance of the mount's roll and pitch, radians², where they were measured.
    pub fn set_tilt_covariance(&mut self, covariance: &Matrix2<f64>) {
        (0..2).for_each(|i| self.tilt[i].variance = covariance[(i, i)]);
    }

    /// Height, roll and pitch of the mount, as far as they are known.
    pub fn mount(&self) -> [f64; 3] {
        let ([height_m, roll_rad, pitch_rad], [_, of_roll, of_pitch]) = (self.nominal, self.sway());
        let [roll, pitch] = &self.tilt;
        [height_m + self.level_m, roll_rad + roll.found(of_roll), pitch_rad + pitch.found(of_pitch)]
    }

    /// The camera is over ground of this elevation, metres, above which the mount has its height. As
    /// far as the ground is uneven that may be another than the level on which the wheels are.
    pub fn stand_on(&mut self, level_m: f64, unevenness_m2: f64) {
        (self.level_m, self.unevenness_m2) = (level_m, unevenness_m2);
    }

    /// Forgets how the rig was seen to move.
    pub fn forget_movement(&mut self) {
        self.deviations = Default::default();
        self.tilt = [MountTilt::UNKNOWN; 2];
        self.steps = Default::default();
        self.last = None;
    }

    /// Learns from a measured frame: from which pose of its keyframe that was done, and what that one's uncertainty makes of the frame's covariance.
    pub fn learn(&mut self, estimate: &MotionEstimate, keyframe: &GroundPose, carried: &Matrix6<f64>) {
        self.neighbours.learn(&estimate.neighbours);
        let here = [estimate.pose.height_m, estimate.pose.roll_rad, estimate.pose.pitch_rad];
        if let Some(last) = self.last.replace(here) {
            (0..3).for_each(|i| self.steps[i].learn(here[i] - last[i]));
        }
        let Some(evidence) = &estimate.rig_evidence else {
            return;
        };
        let risen_m = self.level_m - self.keyframe_level_m;
        let from = [keyframe.height_m + risen_m, keyframe.roll_rad, keyframe.pitch_rad];
        let mount = self.mount();
        for (i, &value) in evidence.value.iter().enumerate() {
            let of_keyframe = carried[(3 + i, 3 + i)];
            let now = Deviation {
                from_mount: (value - mount[i]).powi(2),
                from_keyframe: (value - from[i]).powi(2),
                noise: evidence.variance[i],
                of_keyframe,
            };
            self.deviations[i].learn(&now);
            if let Some(tilt) = i.checked_sub(1) {
                self.tilt[tilt].seen = Some((value - self.nominal[i], evidence.variance[i] + of_keyframe));
            }
        }
    }

    /// Another keyframe serves from here on.
    pub fn settle(&mut self) {
        let [_, of_roll, of_pitch] = self.sway();
        self.tilt[0].learn(of_roll);
        self.tilt[1].learn(of_pitch);
        self.keyframe_level_m = self.level_m;
    }
}
