//! Prior of height, roll and pitch of a frame, learned from the recording. Derivation:
//! `docs/math/frame-pose.md`.

use super::correlated_noise::ResidualCorrelation;
use super::mount_tilt::{MountTilt, SharedTilt};
use super::{MotionConfig, MotionEstimate, MotionModel};
use crate::geometry::GroundPose;
use nalgebra::{Matrix2, Matrix6, Vector2, Vector3};

/// A Gaussian over height (metres), roll and pitch (radians).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigPrior {
    /// Means.
    pub mean: [f64; 3],
    /// Standard deviations.
    pub sigma: [f64; 3],
    /// Share of the mount in the means; the rest is that of the last frame.
    pub mount_share: [f64; 3],
    /// Fraction of a track's error that all tracks share, 0 to 1.
    pub shared_fraction: f64,
}

/// Where roll and pitch scatter by less than this, radians, the mount holds them: 0.1 px at usual
/// focal lengths. Measured where ground is found to be uneven: at most 1e-5 for a camera that keeps
/// its level over it, 5e-4 and more for one that rides on it.
const HELD_TILT: f64 = 2e-4;

impl RigPrior {
    /// Whether the mount holds roll and pitch, so that slopes of the ground show.
    pub fn holds_tilt(&self) -> bool {
        self.sigma[1].max(self.sigma[2]) < HELD_TILT
    }

    /// The product of this prior and the one that the last frames give.
    fn after(mut self, variations: &[Variation; 3]) -> Self {
        for (i, variation) in variations.iter().enumerate() {
            let Some((mean, variance)) = variation.prediction(if i == 0 { self.mean[0] } else { 1.0 }) else {
                continue;
            };
            let (mount_information, step_information) = (self.sigma[i].powi(-2), 1.0 / variance);
            if step_information > 0.0 && step_information.is_finite() {
                self.mount_share[i] = mount_information / (mount_information + step_information);
                self.mean[i] += (1.0 - self.mount_share[i]) * (mean - self.mean[i]);
                self.sigma[i] = (mount_information + step_information).sqrt().recip();
            }
        }
        self
    }

    /// The prior widened to include the pose of a keyframe: a keyframe that is off the mount
    /// defines a plane that is off too, and with it all frames measured against it.
    pub fn reaching(mut self, keyframe: &GroundPose) -> Self {
        let keyframe_values = [keyframe.height_m, keyframe.roll_rad, keyframe.pitch_rad];
        for ((sigma, mean), keyframe_values) in self.sigma.iter_mut().zip(self.mean).zip(keyframe_values) {
            *sigma = sigma.max((keyframe_values - mean).abs());
        }
        self
    }
}

/// How height, roll or pitch go on from frame to frame.
#[derive(Debug, Clone, Copy, Default)]
struct Variation {
    last: Option<f64>,
    /// Change at the last frame.
    change: Option<f64>,
    /// Steps from the last frame, and from the value extrapolated with the last change.
    steps: Steps,
    innovations: Steps,
}

impl Variation {
    fn learn(&mut self, current: f64) {
        if let Some(last) = self.last.replace(current) {
            let step = current - last;
            self.steps.learn(step);
            if let Some(change) = self.change.replace(step) {
                self.innovations.learn(step - change);
            }
        }
    }

    /// Mean and variance of the next value, by whichever of the two predicted better: a shaken
    /// mount varies about the last value, a hand turns steadily.
    fn prediction(&self, unit: f64) -> Option<(f64, f64)> {
        let last = self.last?;
        let lower_bound = MIN_STEP_SIGMA * unit;
        let steady = (last, self.steps.variance(lower_bound));
        let turning = (last + self.change.unwrap_or(0.0), self.innovations.variance(lower_bound));
        Some(if turning.1 < steady.1 { turning } else { steady })
    }
}

/// Mean square of steps.
#[derive(Debug, Clone, Copy, Default)]
struct Steps {
    mean_square: f64,
    count: usize,
}

impl Steps {
    fn learn(&mut self, step: f64) {
        // Outliers are clipped at three standard deviations.
        let upper_bound = if self.count < MIN_STEPS { f64::INFINITY } else { 9.0 * self.mean_square };
        let rate = LEARNING_RATE.max(1.0 / (self.count + 1) as f64);
        self.mean_square += rate * ((step * step).min(upper_bound) - self.mean_square);
        self.count += 1;
    }

    /// Prior variance of a step, wide enough to decide only what the tracks leave open.
    fn variance(&self, lower_bound: f64) -> f64 {
        let variance = (STEP_SIGMAS * STEP_SIGMAS * self.mean_square).max(lower_bound * lower_bound);
        if self.count < MIN_STEPS { f64::INFINITY } else { variance }
    }
}

/// Minimum number of steps before their mean square is used. Not derived; chosen.
const MIN_STEPS: usize = 10;

/// Prior standard deviation of a step over the root mean square of earlier ones. Not derived;
/// chosen.
const STEP_SIGMAS: f64 = 3.0;

/// Lower bound of the prior standard deviation of a step, as a fraction of the height and radians
/// (0.2°). Without it a wrong tilt that hardly changes confirms itself. Not derived; chosen.
const MIN_STEP_SIGMA: f64 = 0.0035;

/// Largest root mean square step of roll and pitch of a camera that is fixed to its carrier,
/// radians (0.1°). Not derived; chosen.
const MAX_MOUNTED_STEP: f64 = 0.5 * MIN_STEP_SIGMA;

/// Squared deviations of height, roll or pitch, and what explains them, averaged over the last
/// frames.
#[derive(Debug, Clone, Copy, Default)]
struct Deviation {
    /// From the mount.
    from_mount: f64,
    /// From the keyframe; the keyframe's own error is not part of it.
    from_keyframe: f64,
    /// Variance of the estimate from the tracks alone.
    noise: f64,
    /// Variance by the keyframe's uncertainty.
    keyframe_variance: f64,
}

impl Deviation {
    fn learn(&mut self, now: &Self) {
        let average = |mean: &mut f64, now: f64| *mean += LEARNING_RATE * (now - *mean);
        average(&mut self.from_mount, now.from_mount);
        average(&mut self.from_keyframe, now.from_keyframe);
        average(&mut self.noise, now.noise);
        average(&mut self.keyframe_variance, now.keyframe_variance);
    }

    /// Process variance of the rig: zero unless it is significant, either within a keyframe, or as
    /// a deviation from the mount that the keyframe's error does not explain.
    fn process_variance(&self, shared_fraction: f64) -> f64 {
        let threshold = SIGNIFICANT + SIGNIFICANT_PER_SHARED * shared_fraction;
        let excess = self.from_mount - threshold * self.noise;
        self.short_term_variance(shared_fraction)
            .min(excess)
            .max(excess - threshold * self.keyframe_variance)
            .max(0.0)
    }

    /// Short-term variance of the rig: within a keyframe, independent of the mount.
    fn short_term_variance(&self, shared_fraction: f64) -> f64 {
        let noise = (SIGNIFICANT + SIGNIFICANT_PER_SHARED * shared_fraction) * self.noise;
        // The difference of two frames has twice the variance; a slow variation is still close to
        // its value at the keyframe.
        (MAX_LONG_TERM_RATIO * (0.5 * self.from_keyframe - noise)).max(0.0)
    }
}

/// Largest ratio of the long-term variance to that within a keyframe. Not derived; chosen.
const MAX_LONG_TERM_RATIO: f64 = 4.0;

/// Mean squares are significant above this multiple of the noise variance: a multiple of two occurs
/// by chance, since about 20 frames against one keyframe have few independent errors. Shared errors
/// last from frame to frame: the threshold grows by [`SIGNIFICANT_PER_SHARED`] times the shared
/// fraction. See `docs/math/correlated-noise.md`.
const SIGNIFICANT: f64 = 2.0;
const SIGNIFICANT_PER_SHARED: f64 = 10.0;

/// Estimator of the rig's variation, which gives `auto` its prior.
///
/// Height, roll and pitch are normally distributed about those of the mount, with a variance that
/// is estimated from the recording (empirical Bayes; B. Efron and C. Morris, 1973): the squared
/// deviations of the estimates from the tracks alone, less what their noise and the keyframe's
/// error explain, averaged over the last frames. On a cart nothing significant remains: the prior
/// is tight and the model is rigid. With a shaking mount, a drone or a hand it opens as far as
/// necessary. The mean of roll and pitch is estimated too.
#[derive(Debug, Clone)]
pub struct RigPriorEstimator {
    nominal: [f64; 3],
    deviations: [Deviation; 3],
    mount_tilt: MountTilt,
    variations: [Variation; 3],
    /// Elevation above which the mount has its height, of this frame and of the keyframe, metres.
    ground_level_m: f64,
    keyframe_ground_level_m: f64,
    /// Variance of the level above which the mount has its height, metres²: zero on flat ground.
    unevenness_m2: f64,
    residual_correlation: ResidualCorrelation,
}

/// Weight of the newest frame in exponential averages: a memory of about 20 frames. Not derived;
/// chosen.
const LEARNING_RATE: f64 = 0.05;

/// Lower bounds of the standard deviations: fraction of the height, radians. Measured: with six
/// times these values every keyframe varies by 0.02 mm, most of the drift on a steady mount; with
/// 0.6 times, a mount that varies by 3° is followed 5 % worse.
const MIN_SIGMA: [f64; 3] = [5e-6, 5e-6, 5e-6];

impl RigPriorEstimator {
    /// Without any frame: as steady as the mount.
    pub fn new(mount: &GroundPose) -> Self {
        Self {
            nominal: [mount.height_m, mount.roll_rad, mount.pitch_rad],
            deviations: Default::default(),
            mount_tilt: MountTilt::unknown(),
            variations: Default::default(),
            ground_level_m: 0.0,
            keyframe_ground_level_m: 0.0,
            unevenness_m2: 0.0,
            residual_correlation: ResidualCorrelation::default(),
        }
    }

    /// Prior of the next frame, which is expected at `prediction`.
    pub fn prior(&self, prediction: &GroundPose, config: &MotionConfig) -> RigPrior {
        let shared_fraction = self.residual_correlation.shared_fraction();
        match config.model {
            MotionModel::Auto => {
                let min_sigma = [MIN_SIGMA[0] * self.nominal[0], MIN_SIGMA[1], MIN_SIGMA[2]];
                let process_variance = self.process_variance();
                let mut sigma = [0, 1, 2].map(|i| process_variance[i].sqrt().max(min_sigma[i]));
                sigma[0] = sigma[0].hypot(self.unevenness_m2.sqrt());
                RigPrior { mean: self.mount(), sigma, mount_share: [1.0; 3], shared_fraction }
                    .after(&self.variations)
            }
            _ => {
                // Height and tilt as they were: an extrapolated mean would let their errors grow.
                let predicted = [prediction.height_m, prediction.roll_rad, prediction.pitch_rad];
                let mean = [0, 1, 2].map(|i| {
                    let Variation { last, change, .. } = self.variations[i];
                    change.and(last).unwrap_or(predicted[i])
                });
                RigPrior {
                    mean,
                    sigma: [config.height_prior * mean[0], config.tilt_prior_rad, config.tilt_prior_rad],
                    mount_share: [0.0; 3],
                    shared_fraction,
                }
            }
        }
    }

    /// Process variances of height, roll and pitch.
    fn process_variance(&self) -> [f64; 3] {
        let shared_fraction = self.residual_correlation.shared_fraction();
        self.deviations.map(|deviation| deviation.process_variance(shared_fraction))
    }

    fn short_term_variance(&self) -> [f64; 3] {
        let shared_fraction = self.residual_correlation.shared_fraction();
        self.deviations.map(|deviation| deviation.short_term_variance(shared_fraction))
    }

    /// Variances of roll and pitch of the mount. Zero for a camera that rotates from frame to frame
    /// (hand-held or shaken), and reduced by the shared fraction of the tracks' errors, which a
    /// tilt does not explain.
    pub fn mount_tilt_variance(&self) -> [f64; 2] {
        let (process_variance, independent_fraction) =
            (self.process_variance(), 1.0 - self.residual_correlation.shared_fraction());
        let steps = self.variations.map(|variation| variation.steps.mean_square);
        let is_mounted = self.is_mounted();
        let variance =
            |i: usize| independent_fraction * (process_variance[i] - MAX_LONG_TERM_RATIO * steps[i]).max(0.0);
        [1, 2].map(|i| if is_mounted { variance(i) } else { 0.0 })
    }

    /// Whether roll and pitch hardly change from frame to frame: the camera is fixed to a carrier.
    fn is_mounted(&self) -> bool {
        let [_, roll, pitch] = self.variations.map(|variation| variation.steps.mean_square);
        roll.max(pitch) < MAX_MOUNTED_STEP * MAX_MOUNTED_STEP
    }

    /// Mean squared errors of the roll and pitch that are taken for the mount's, radians².
    pub fn mount_tilt_errors(&self) -> Matrix2<f64> {
        let [_, of_roll, of_pitch] = self.short_term_variance();
        self.mount_tilt.squared_errors([of_roll, of_pitch])
    }

    /// Covariance of the mount's roll and pitch before any keyframe, radians².
    pub fn unknown_mount_tilt() -> Matrix2<f64> {
        MountTilt::unknown_covariance()
    }

    /// Sets the standard deviations of the mount's roll and pitch, radians, where they are known.
    pub fn set_mount_tilt_deviations(&mut self, deviations: [Option<f64>; 2]) {
        self.mount_tilt.set_deviations(deviations);
    }

    /// Sets the covariance of the mount's roll and pitch, radians², where other frames showed them.
    pub fn set_mount_tilt_covariance(&mut self, covariance: &Matrix2<f64>) {
        self.mount_tilt.set_covariance(*covariance);
    }

    /// Sets the same where an earlier pass over these frames has found it.
    pub fn set_earlier_mount_tilt_covariance(&mut self, covariance: &Matrix2<f64>) {
        self.mount_tilt.set_earlier_pass(*covariance);
    }

    /// Height, roll and pitch of the mount: the rig file's, corrected.
    pub fn mount(&self) -> [f64; 3] {
        let ([height_m, roll_rad, pitch_rad], [_, of_roll, of_pitch]) =
            (self.nominal, self.short_term_variance());
        let [roll_correction, pitch_correction] = self.mount_tilt.correction([of_roll, of_pitch]);
        [height_m + self.ground_level_m, roll_rad + roll_correction, pitch_rad + pitch_correction]
    }

    /// Sets the elevation, metres, above which the mount has its height, and its variance.
    pub fn set_ground_level(&mut self, ground_level_m: f64, unevenness_m2: f64) {
        (self.ground_level_m, self.unevenness_m2) = (ground_level_m, unevenness_m2);
    }

    /// The next frame does not follow the last one: over a gap, changes do not go on.
    pub fn interrupt(&mut self) {
        self.variations.iter_mut().for_each(|variation| variation.change = None);
    }

    /// Learns from a measured frame, given the pose of its keyframe and the covariance that the
    /// keyframe's uncertainty adds to the frame's.
    pub fn learn(
        &mut self,
        estimate: &MotionEstimate,
        keyframe: &GroundPose,
        keyframe_covariance: &Matrix6<f64>,
    ) {
        self.residual_correlation.learn(&estimate.residual_correlation);
        let current = [estimate.pose.height_m, estimate.pose.roll_rad, estimate.pose.pitch_rad];
        self.variations.iter_mut().zip(current).for_each(|(variation, current)| variation.learn(current));
        let Some(evidence) = &estimate.rig_evidence else {
            return;
        };
        let ground_rise_m = self.ground_level_m - self.keyframe_ground_level_m;
        let expected = [keyframe.height_m + ground_rise_m, keyframe.roll_rad, keyframe.pitch_rad];
        let mount = self.mount();
        for (i, value) in evidence.value.iter().copied().enumerate() {
            let keyframe_variance = keyframe_covariance[(3 + i, 3 + i)];
            let now = Deviation {
                from_mount: (value - mount[i]).powi(2),
                from_keyframe: (value - expected[i]).powi(2),
                noise: evidence.covariance[(i, i)],
                keyframe_variance,
            };
            self.deviations[i].learn(&now);
        }
        let mut variances = Vector3::from(self.short_term_variance());
        variances[0] += self.unevenness_m2;
        let nominal = Vector2::new(self.nominal[1], self.nominal[2]);
        let shared = SharedTilt::new(evidence, keyframe, ground_rise_m, &nominal, &variances);
        self.mount_tilt.saw(shared);
    }

    /// A new keyframe begins.
    pub fn change_keyframe(&mut self) {
        self.mount_tilt.change_keyframe();
        self.keyframe_ground_level_m = self.ground_level_m;
    }
}
