//! How a keyframe was exposed: the rates of its pose, a state that every frame measured against it
//! refines.
//!
//! Rows determine the skew of a frame only against that of its keyframe; the motion from frame to
//! frame determines it by itself, but roughly. The difference of the two, frame after frame, is the
//! error of the keyframe's skew (a scalar Kalman filter for each of the rates).

use super::Odometry;
use super::keyframe::Keyframe;
use super::shutter::ShutterState;
use crate::camera::Camera;
use crate::geometry::GroundPose;
use crate::motion::{ImageMotion, MotionEstimate, PoseRates, RollingShutter, UNKNOWN_SLOPE};

/// Rates within the first keyframe may be anything up to this: parts of the height, and radians,
/// per second.
const FIRST_RATE: f64 = 1.0;

/// Rates by the first two steps are no better than this: parts of the height, and radians, per
/// second. Measured on flat ground: at a twentieth of it the errors of two drives were four times
/// what was stated (NEES 11 instead of 2).
const STEP_NOISE: f64 = 0.02;

/// Shift of a keyframe's corners above which they are projected onto the ground again, pixels.
const NEGLIGIBLE_PX: f64 = 0.003;

impl Odometry {
    /// The first keyframe of all: nothing is known of its rates unless they were measured.
    pub(super) fn expose_first(&self, keyframe: &mut Keyframe, time_s: f64) {
        let Some(state) = self.learned.shutter().filter(|state| !state.is_global()) else { return };
        keyframe.shutter.readout_s = state.readout().mean_s;
        if let Some(motion) = self.motion.at(time_s) {
            let ImageMotion { rates, accelerations, rate_variance, .. } = *motion;
            keyframe.rate_variance = rate_variance;
            keyframe.rates_on_slope = Some((rates, rate_variance));
            keyframe.expose(&self.camera, RollingShutter { rates, accelerations, ..keyframe.shutter });
            return;
        }
        let (shift, turn) = ((FIRST_RATE * keyframe.pose.height_m).powi(2), FIRST_RATE * FIRST_RATE);
        keyframe.rate_variance = PoseRates::new(shift, shift, turn, 0.0, 0.0, 0.0);
    }

    /// Tells a new keyframe how it was exposed, as far as it is known by now.
    pub(super) fn expose(&mut self, next: &mut Keyframe, estimate: &MotionEstimate) {
        let (Some(seen), Some(prior)) = (&estimate.shutter, &self.learned.frame_shutter) else { return };
        let readout_s = prior.readout.mean_s;
        next.shutter =
            RollingShutter { rates: seen.expected_rates, ..prior.shutter_at(&self.camera, &estimate.pose) };
        next.rate_variance = prior.expected.rate_variance;
        if let Some(motion) = self.present_motion() {
            next.rate_variance = motion.rate_variance;
        }
        next.rates_on_slope = Some((next.shutter.rates, next.rate_variance));
        let is_refined = self.present_motion().is_none() && readout_s != 0.0;
        let Some(keyframe) = self.keyframe.as_ref().filter(|_| is_refined) else {
            return;
        };
        let (_, of_slope) = self.slope_variances(estimate, &keyframe.pose, readout_s);
        for i in 0..6 {
            // The rates by the rows have the error of the keyframe, too.
            let by_rows =
                seen.evidence_variance[i] / readout_s.powi(2) + keyframe.rate_variance[i] + of_slope;
            let predicted = prior.expected.rate_variance[i];
            if by_rows.is_finite() && by_rows + predicted > 0.0 {
                let gain = predicted / (predicted + by_rows);
                next.shutter.rates[i] += gain * (seen.evidence[i] / readout_s - seen.expected_rates[i]);
                next.rate_variance[i] = (1.0 - gain) * predicted;
            }
        }
    }

    /// Refines how the present keyframe was exposed by a frame measured against it.
    pub(super) fn refine_exposure(&mut self, estimate: &MotionEstimate) {
        let are_of_plane = std::mem::take(&mut self.rates_are_of_plane);
        let (Some(seen), Some(prior)) = (&estimate.shutter, self.learned.frame_shutter) else { return };
        let readout_s = prior.readout.mean_s;
        if self.keyframes == 1 && self.motion.is_empty() {
            match self.frames - self.reference_since {
                1 => self.expose_by_first_step(seen.expected_rates),
                2 => self.expose_by_first_steps(),
                _ => {}
            }
        }
        let is_measured = self.present_motion().is_some();
        if are_of_plane || is_measured || readout_s == 0.0 {
            return;
        }
        let Some(keyframe) = &self.keyframe else { return };
        let (of_slope, unshaped) = self.slope_variances(estimate, &keyframe.pose, readout_s);
        let Some(keyframe) = &mut self.keyframe else { return };
        let mut rates = keyframe.shutter.rates;
        for i in 0..6 {
            let noise = seen.evidence_variance[i] / readout_s.powi(2) + prior.expected.rate_variance[i];
            let off = seen.expected_rates[i] - seen.evidence[i] / readout_s;
            if let Some((on_slope, variance)) = &mut keyframe.rates_on_slope {
                let off = off + rates[i] - on_slope[i];
                kalman_update(&mut on_slope[i], &mut variance[i], off, noise + of_slope);
            }
            kalman_update(&mut rates[i], &mut keyframe.rate_variance[i], off, noise + unshaped);
        }
        let moved = RollingShutter { rates: rates - keyframe.shutter.rates, readout_s, ..keyframe.shutter };
        if largest_shift_px(&self.camera, &keyframe.pose, &moved) > NEGLIGIBLE_PX {
            keyframe.expose(&self.camera, RollingShutter { rates, ..keyframe.shutter });
        } else {
            keyframe.shutter.rates = rates;
        }
    }

    /// The motion within the last frame with a pose, if an earlier pass has measured it. It is not
    /// refined: all frames of both sides have a part in it.
    fn present_motion(&self) -> Option<&ImageMotion> {
        self.motion.at(self.last.as_ref()?.time_s)
    }

    /// Sets the first keyframe's rates to those of the first step, with a standard deviation of the
    /// same size.
    fn expose_by_first_step(&mut self, rates: PoseRates) {
        let Some(keyframe) = &mut self.keyframe else { return };
        keyframe.rates_on_slope = Some((rates, keyframe.rate_variance));
        keyframe.expose(&self.camera, RollingShutter { rates, ..keyframe.shutter });
    }

    /// The first keyframe moved as the parabola through its pose and the two after it says, give or
    /// take the change of the rates; one that began at rest did not move backwards.
    fn expose_by_first_steps(&mut self) {
        let steps = self.learned.shutter().and_then(ShutterState::first_steps);
        let (Some([first, second]), Some(keyframe)) = (steps, &mut self.keyframe) else { return };
        let change = second - first;
        let rates =
            first.zip_map(&change, |first, change| first - (0.5 * change).clamp(-first.abs(), first.abs()));
        let (shift, turn) = ((STEP_NOISE * keyframe.pose.height_m).powi(2), STEP_NOISE * STEP_NOISE);
        let variance = change.component_mul(&change) + PoseRates::new(shift, shift, turn, 0.0, 0.0, 0.0);
        keyframe.rate_variance = variance;
        keyframe.rates_on_slope = Some((rates, variance));
        keyframe.expose(&self.camera, RollingShutter { rates, ..keyframe.shutter });
    }

    /// The rates of the present keyframe as they are if the ground slopes: it was taken to be flat.
    pub(super) fn expose_on_slope(&mut self) {
        let Some(keyframe) = &mut self.keyframe else { return };
        let Some((rates, variance)) = keyframe.rates_on_slope else { return };
        keyframe.rate_variance = variance;
        keyframe.expose(&self.camera, RollingShutter { rates, ..keyframe.shutter });
    }

    /// What an unknown slope of the ground does to rates that rows show, as a variance: it passes
    /// for a skew. Also what is left of it beside a fit that estimates the shape of uneven ground.
    fn slope_variances(
        &self,
        estimate: &MotionEstimate,
        keyframe: &GroundPose,
        readout_s: f64,
    ) -> (f64, f64) {
        let (dx_m, dy_m) = (estimate.pose.x_m - keyframe.x_m, estimate.pose.y_m - keyframe.y_m);
        let of_slope = (UNKNOWN_SLOPE * dx_m.hypot(dy_m) / readout_s).powi(2);
        let is_unshaped = self.learned.relief_m2() > 0.0 && estimate.shape.is_none();
        (of_slope, if is_unshaped { of_slope } else { 0.0 })
    }
}

/// A scalar Kalman filter: `value` with its `variance` is off by `off`, which has the variance
/// `noise`.
fn kalman_update(value: &mut f64, variance: &mut f64, off: f64, noise: f64) {
    if noise.is_finite() && *variance + noise > 0.0 {
        let gain = *variance / (*variance + noise);
        *value += gain * off;
        *variance *= 1.0 - gain;
    }
}

/// How far the first and the last row of an image are shifted at most, roughly.
fn largest_shift_px(camera: &Camera, pose: &GroundPose, shutter: &RollingShutter) -> f64 {
    let (focal_px, rates) = (camera.focal_px().0, &shutter.rates);
    let shift = rates[0].hypot(rates[1]) + rates[3].abs();
    let turn = rates[2].abs() + rates[4].abs() + rates[5].abs();
    0.5 * shutter.readout_s.abs() * focal_px * (shift / pose.height_m + turn)
}
