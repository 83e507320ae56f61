//! The shutter of the camera: its readout time, and how well the rates of the pose within an image can
//! be foretold from the poses before it.

use super::last_pose::LastPose;
use crate::camera::Camera;
use crate::motion::{PoseRates, Readout, RigPrior, ShutterEstimate, ShutterPrior};

/// What is known of the shutter so far.
#[derive(Debug, Clone)]
pub struct ShutterState {
    readout: Readout,
    /// Whether the readout time was given, or found to be that of a global shutter.
    is_settled: bool,
    /// Mean squared errors of the foretold rates of x and y (m²/s², each) and of heading (rad²/s²).
    rate_errors: [f64; 2],
}

/// Standard deviation of a readout time of which nothing is known: half of a frame at 30 a second.
const UNKNOWN_READOUT_S: f64 = 0.015;

/// Rates of the first frames are foretold no better than this: parts of the height, and radians per second.
const FIRST_RATE_ERROR: f64 = 0.1;

/// Rates are never taken to be foretold better than this.
const LEAST_RATE_ERROR: f64 = 1e-4;

/// Weight of the newest frame in the mean squared errors.
const LEARNING_RATE: f64 = 0.05;

/// Frames against one keyframe share the errors of its patches: each counts as this part of one.
const INDEPENDENT: f64 = 0.2;

/// A readout time is known no better than this, seconds: a thousandth of the image at usual speeds.
const LEAST_READOUT_S: f64 = 2e-5;

/// A shutter is global where its readout time is known to this, seconds, and is zero within three times that.
const GLOBAL_WITHIN_S: f64 = 1e-4;

/// Rates of height and tilt within an image, per second, over the standard deviation of height and tilt:
/// a sway of one and a half hertz.
const SWAY_HZ: f64 = 10.0;

impl ShutterState {
    /// What the camera's file says, or nothing.
    pub fn new(camera: &Camera, height_m: f64) -> Self {
        let readout = match camera.readout_s() {
            Some(readout_s) => Readout { mean_s: readout_s, variance_s2: 0.0 },
            None => Readout { mean_s: 0.0, variance_s2: UNKNOWN_READOUT_S.powi(2) },
        };
        let first = FIRST_RATE_ERROR.powi(2);
        let is_settled = camera.readout_s().is_some();
        Self { readout, is_settled, rate_errors: [first * height_m * height_m, first] }
    }

    /// The readout time as it is known now.
    pub fn readout(&self) -> Readout {
        self.readout
    }

    /// Whether all rows are exposed at once.
    pub fn is_global(&self) -> bool {
        self.is_settled && self.readout.mean_s == 0.0
    }

    /// What is expected of the image at `time_s`; `None` where the shutter is global.
    pub fn prior(&self, last: &LastPose, time_s: f64, rig: &RigPrior) -> Option<ShutterPrior> {
        if self.is_global() {
            return None;
        }
        let step_s = time_s - last.time_s;
        if step_s <= 0.0 {
            return None;
        }
        // The slope at the end of the parabola through the last two poses and this one.
        let share = last.pose_rates.map_or(0.0, |_| step_s / (step_s + last.step_s));
        let rate_by_pose_hz = (1.0 + share) / step_s;
        let rate_offset =
            -rate_by_pose_hz * last.pose.to_vector() - share * last.pose_rates.unwrap_or_default();
        let [shift, turn] = self.rate_errors.map(f64::sqrt);
        // A rate that no earlier step confirms may be off by half of what the camera may gain in a step.
        let more = if last.pose_rates.is_some() { 1.0 } else { 3.0 };
        let [height, roll, pitch] = rig.sigma.map(|sigma| SWAY_HZ * sigma);
        let rate_sigma = PoseRates::new(more * shift, more * shift, more * turn, height, roll, pitch);
        Some(ShutterPrior { readout: self.readout, rate_by_pose_hz, rate_offset, rate_sigma })
    }

    /// Learns from a measured frame.
    pub fn learn(&mut self, seen: &ShutterEstimate, height_m: f64) {
        let off = seen.evidence - seen.expected;
        let both = [
            (0.5 * (off[0] * off[0] + off[1] * off[1]), seen.evidence_variance[0].max(seen.evidence_variance[1])),
            (off[2] * off[2], seen.evidence_variance[2]),
        ];
        let least = LEAST_RATE_ERROR.powi(2);
        for ((error, (square, variance)), unit) in
            self.rate_errors.iter_mut().zip(both).zip([height_m * height_m, 1.0])
        {
            if variance.is_finite() && square.is_finite() {
                let rate = LEARNING_RATE * *error / (*error + variance);
                // A surprise counts at once: what is foretold too well spoils the pose.
                let now = (square - variance).max(0.0);
                *error += if now > *error { 0.5 * (*error / (*error + variance)) } else { rate } * (now - *error);
                *error = error.max(least * unit);
            }
        }
        if !self.is_settled && seen.readout_information > 0.0 {
            let before = 1.0 / self.readout.variance_s2;
            let information = INDEPENDENT * seen.readout_information;
            let all = before + information;
            self.readout.mean_s = (before * self.readout.mean_s + information * seen.readout_s) / all;
            self.readout.mean_s =
                self.readout.mean_s.clamp(-Camera::LONGEST_READOUT_S, Camera::LONGEST_READOUT_S);
            self.readout.variance_s2 = (1.0 / all).max(LEAST_READOUT_S.powi(2));
            let deviation_s = self.readout.variance_s2.sqrt();
            if deviation_s < GLOBAL_WITHIN_S && self.readout.mean_s.abs() < 3.0 * GLOBAL_WITHIN_S {
                self.readout = Readout { mean_s: 0.0, variance_s2: 0.0 };
                self.is_settled = true;
            }
        }
    }
}
