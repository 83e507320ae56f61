//! What is known of height, roll and pitch before a frame is measured.

use super::{MotionConfig, MotionEstimate, MotionModel};
use crate::geometry::GroundPose;

/// A Gaussian over height (metres), roll and pitch (radians).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigPrior {
    /// What they are thought to be.
    pub mean: [f64; 3],
    /// One standard deviation.
    pub sigma: [f64; 3],
}

/// How much the rig is seen to move: what `auto` decides by.
///
/// Height, roll and pitch are taken as scattered about those of the mount with a variance that the recording itself tells (empirical
/// Bayes; B. Efron and C. Morris, 1973): the squared deviations of what the tracks alone say, less what their own noise explains, averaged
/// over the last frames. On a cart nothing is left, the prior is tight, and the model is the rigid one; with a shaking mount, a
/// breathing drone or a hand it opens just as far as it must.
#[derive(Debug, Clone)]
pub struct RigWander {
    nominal: [f64; 3],
    variance: [f64; 3],
}

/// Weight of the newest frame in the average: about the last twenty count.
const LEARNING_RATE: f64 = 0.05;

/// Standard deviations below these change nothing that could be measured: a part of the height, radians. (Six times as much is seen: every keyframe
/// then wavers by a fiftieth of a millimetre, which on a steady mount is most of the drift. With three fifths of it a mount that sways by 3° is followed a twentieth worse.)
const SMALLEST_SIGMA: [f64; 3] = [5e-6, 5e-6, 5e-6];

impl RigWander {
    /// Nothing seen yet: as steady as the mount says.
    pub fn new(mount: &GroundPose) -> Self {
        Self { nominal: [mount.height_m, mount.roll_rad, mount.pitch_rad], variance: [0.0; 3] }
    }

    /// The prior for the next frame; `last` is the pose before it.
    pub fn prior(&self, last: &GroundPose, config: &MotionConfig) -> RigPrior {
        match config.model {
            MotionModel::Auto => {
                let smallest = [SMALLEST_SIGMA[0] * self.nominal[0], SMALLEST_SIGMA[1], SMALLEST_SIGMA[2]];
                let sigma = |i: usize| self.variance[i].max(0.0).sqrt().max(smallest[i]);
                RigPrior { mean: self.nominal, sigma: [0, 1, 2].map(sigma) }
            }
            _ => RigPrior {
                mean: [last.height_m, last.roll_rad, last.pitch_rad],
                sigma: [config.height_prior * last.height_m, config.tilt_prior_rad, config.tilt_prior_rad],
            },
        }
    }

    /// Learns from a measured frame.
    pub fn learn(&mut self, estimate: &MotionEstimate) {
        let Some(evidence) = estimate.rig_evidence else {
            return;
        };
        for (i, (value, variance)) in evidence.into_iter().enumerate() {
            let beyond_noise = (value - self.nominal[i]).powi(2) - variance;
            self.variance[i] += LEARNING_RATE * (beyond_noise - self.variance[i]);
        }
    }
}
