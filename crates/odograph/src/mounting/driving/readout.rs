//! The readout time of a rolling shutter, estimated from driving.

use super::MAX_SIGMA_RATIO;
use super::bundle::{READOUT, Solved};
use crate::numerics::Combined;

/// The readout time of the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReadoutMeasurement {
    /// The readout time, seconds; negative where the image is read from bottom to top.
    pub readout_s: f64,
    /// One standard deviation, seconds.
    pub deviation_s: f64,
    /// Standard deviation from keyframe to keyframe beyond the noise of the tracks, seconds: what
    /// is no shutter does so.
    pub scatter_s: f64,
}

impl ReadoutMeasurement {
    pub(super) fn new<const N: usize>(solved: &Solved<N>, combined: &Combined<N>, assumed_s: f64) -> Self {
        let readout_s = solved.readout_s + combined.offset[READOUT];
        let of_rates_s = RATES_ERROR * (readout_s - assumed_s).abs();
        Self {
            readout_s,
            deviation_s: combined.covariance[(READOUT, READOUT)].sqrt().hypot(of_rates_s),
            scatter_s: combined.scatter[READOUT].sqrt(),
        }
    }
}

/// Rates of poses that were measured with another readout time are wrong by this part of what they
/// are corrected by, so that the found readout time is wrong by this part of its difference from
/// the assumed one.
const RATES_ERROR: f64 = 0.01;

/// A readout time known worse than this part of itself is not a measurement yet.
const MAX_RELATIVE_SIGMA: f64 = 0.15;

/// Standard deviations by which a readout time must differ from the given one to replace it …
const MIN_SIGMAS: f64 = 5.0;

/// … and the least difference, seconds: 0.3 ms at 1 m/s and 0.75 m is 0.2 px.
const MIN_DIFFERENCE_S: f64 = 3e-4;

/// Largest scatter between keyframes, as a fraction of the difference: above it, the cause is not
/// the shutter.
const MAX_SCATTER: f64 = 0.5;

impl ReadoutMeasurement {
    /// Whether the readout time differs significantly from `given_s`; zero if none was given.
    pub fn differs_from(&self, given_s: f64) -> bool {
        let off_s = (self.readout_s - given_s).abs();
        off_s > MIN_DIFFERENCE_S.max(MIN_SIGMAS * self.deviation_s)
            && self.scatter_s < MAX_SCATTER * off_s
            && self.deviation_s < MAX_RELATIVE_SIGMA * self.readout_s.abs()
    }

    /// Whether it does not differ significantly from the one in use.
    pub(super) fn agrees_with(&self, used: &Self) -> bool {
        (self.readout_s - used.readout_s).abs() < MIN_SIGMAS * self.deviation_s.hypot(used.deviation_s)
    }

    /// Whether it is clearly more precise than an earlier estimate, and different from it.
    pub fn is_better_than(&self, before: &Self) -> bool {
        (self.readout_s - before.readout_s).abs() > MIN_CHANGE_S
            && self.deviation_s < MAX_SIGMA_RATIO * before.deviation_s
    }
}

/// A better readout time is used if it differs by this much, seconds.
const MIN_CHANGE_S: f64 = 2e-5;
