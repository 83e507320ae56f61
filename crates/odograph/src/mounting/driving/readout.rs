//! The readout time of a rolling shutter, as a recording of driving tells it.

use super::bundle::{READOUT, Solved};
use crate::numerics::Combined;

/// The readout time of the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReadoutMeasurement {
    /// The readout time, seconds; negative where the image is read from bottom to top.
    pub readout_s: f64,
    /// One standard deviation, seconds.
    pub deviation_s: f64,
    /// Standard deviation from keyframe to keyframe beyond the noise of the tracks, seconds: what is
    /// no shutter does so.
    pub scatter_s: f64,
}

impl ReadoutMeasurement {
    pub(super) fn new<const N: usize>(solved: &Solved<N>, combined: &Combined<N>, assumed_s: f64) -> Self {
        let readout_s = solved.readout_s + combined.offset[READOUT];
        let of_rates_s = RATES * (readout_s - assumed_s).abs();
        Self {
            readout_s,
            deviation_s: combined.covariance[(READOUT, READOUT)].sqrt().hypot(of_rates_s),
            scatter_s: combined.scatter[READOUT].sqrt(),
        }
    }
}

/// Rates of poses that were measured with another readout time are wrong by this part of what they are
/// corrected by, so that the found readout time is wrong by this part of its difference from the assumed one.
const RATES: f64 = 0.01;

/// A readout time known worse than this part of itself is not a measurement yet.
const USEFUL: f64 = 0.15;

/// A shutter rolls where its readout time is so many standard deviations from what was given …
const SIGNIFICANT: f64 = 5.0;

/// … and by more than this, seconds: over less the fastest camera does not move by a pixel.
const LEAST_S: f64 = 3e-4;

/// What differs from keyframe to keyframe by more than this part of itself is not the shutter.
const STEADY: f64 = 1.0 / 3.0;

impl ReadoutMeasurement {
    /// Whether the readout time is surely another than `given_s`, zero where none was given.
    pub fn is_another(&self, given_s: f64) -> bool {
        let off_s = (self.readout_s - given_s).abs();
        off_s > LEAST_S.max(SIGNIFICANT * self.deviation_s)
            && self.scatter_s < STEADY * off_s
            && self.deviation_s < USEFUL * self.readout_s.abs()
    }

    /// Whether it is known clearly better than before, and not the same for that.
    pub fn is_better_than(&self, before: &Self) -> bool {
        (self.readout_s - before.readout_s).abs() > LEAST_BETTER_S
            && self.deviation_s < BETTER * before.deviation_s
    }
}

/// What is known better is used where it is another by this much, seconds, and its deviation is so
/// many times as large.
const LEAST_BETTER_S: f64 = 2e-5;
const BETTER: f64 = 0.8;
