//! The rates of the pose, by Kalman filters over the poses of the frames. Derivation:
//! `docs/math/rolling-shutter.md`.
//!
//! How a camera moves is not known beforehand: a cart rolls smoothly, a motor shakes it, a hand
//! does both. Each number of the pose has a bank of filters with different models of the motion,
//! weighted by how well each has predicted the last poses (multiple-model estimation: D. Magill,
//! 1965).

use crate::geometry::pose_index::{HEADING, HEIGHT, X, Y};
use crate::motion::{ExpectedRates, PoseRates};
use nalgebra::{Matrix4, Vector4};
use std::f64::consts::TAU;

/// Filters of the six numbers of the pose, relative to the last measured pose.
#[derive(Debug, Clone)]
pub struct RateFilter {
    banks: [Bank; 6],
}

/// Spectral densities of the white jerk that drives a smooth motion: heights² or radians² per
/// second⁵. From a cart at constant speed to a hand that is jolted.
const JERKS: [f64; 7] = [1e-3, 1e-2, 1e-1, 1e0, 1e2, 1e4, 1e6];

/// Factors on the variance that a fit states: errors of successive poses against one keyframe are
/// correlated, and the white noise that slows a filter down equally is larger.
const NOISES: [f64; 3] = [1.0, 30.0, 900.0];

/// Frequencies of a vibration, hertz, and spectral densities of the white noise that drives it,
/// heights² or radians² per second³. The damping widens each of them to its neighbours.
const FREQUENCIES_HZ: [f64; 6] = [3.0, 4.5, 6.0, 8.0, 10.5, 13.0];
const SHAKES: [f64; 2] = [1e-3, 1e-1];

/// Damping ratio of a vibration. On steady motion, waves, and vibrations of 4 to 10 Hz the error of
/// the rate is 0.38 of that of a parabola at 0.02, 0.39 at 0.05 and 0.51 at 0.2.
const DAMPING: f64 = 0.05;

/// Factor on the variance that a fit states, where a camera vibrates. With 1, errors over gravel of
/// ±15 mm pass for a vibration (0.31 to 0.53 % of each metre instead of 0.23 to 0.33).
const VIBRATION_NOISE: f64 = 30.0;

/// Spectral density of the white acceleration of a camera that vibrates, heights² or radians² per
/// second³.
const DRIVE: f64 = 1e-3;

const SMOOTH: usize = JERKS.len() * NOISES.len();
const SHAKEN: usize = FREQUENCIES_HZ.len() * SHAKES.len();
const MODELS: usize = SMOOTH + SHAKEN;

/// Standard deviations of what is expected of a camera of which nothing is known, in heights or
/// radians: rate and acceleration of position and heading, and of height and tilt, per second and
/// per second²; displacement and rate of a vibration.
const FIRST_ALONG: [f64; 2] = [1.0, 1.0];
const FIRST_ACROSS: [f64; 2] = [0.01, 0.1];
const FIRST_VIBRATION: [f64; 2] = [1e-3, 0.1];

/// Forgetting factor of a model's log-likelihood, per frame.
const FORGETTING_FACTOR: f64 = 0.95;

/// No model is taken to be less likely than the best one by more than this, nats: a camera may
/// begin to shake at any time. At 16 the stated deviations of steady drives are a third, but poses
/// over undulating ground are overconfident (NEES 3600 instead of 490), and a vibration is followed
/// less well (0.44 instead of 0.34 %).
const LEAST_LIKELY: f64 = 12.0;

/// Poses are known no better than this, heights or radians.
const LEAST_NOISE: f64 = 1e-6;

impl RateFilter {
    /// Nothing is known but one pose of a camera at this height.
    pub fn new(height_m: f64) -> Self {
        Self {
            banks: std::array::from_fn(|i| {
                let unit = if matches!(i, X | Y | HEIGHT) { height_m } else { 1.0 };
                Bank::new(unit, if matches!(i, X | Y | HEADING) { FIRST_ALONG } else { FIRST_ACROSS })
            }),
        }
    }

    /// The pose `step_s` later was measured: it has changed by `change`, with these variances.
    pub fn update(&mut self, step_s: f64, change: &PoseRates, variance: &PoseRates) {
        let models = models(step_s);
        for (i, bank) in self.banks.iter_mut().enumerate() {
            bank.update(&models, change[i], variance[i]);
        }
    }

    /// What is expected of an image `step_s` after the one at `last`.
    pub fn expected(&self, step_s: f64, last: &PoseRates) -> ExpectedRates {
        let models = models(step_s);
        let mut expected = ExpectedRates::default();
        for (i, bank) in self.banks.iter().enumerate() {
            let [rate, acceleration] = bank.given_change(&models);
            expected.rate_by_pose_hz[i] = rate.slope;
            expected.rate_offset[i] = rate.offset - rate.slope * last[i];
            expected.rate_variance[i] = rate.variance;
            expected.acceleration_by_pose[i] = acceleration.slope;
            expected.acceleration_offset[i] = acceleration.offset - acceleration.slope * last[i];
        }
        expected
    }
}

/// A model of the motion over one step. States of a smooth motion are position, rate and
/// acceleration; those of a vibration are the mean position and its rate, and the deviation from
/// there and its rate.
#[derive(Debug, Clone, Copy)]
struct StepModel {
    transition: Matrix4<f64>,
    driven: Matrix4<f64>,
    /// Position, rate and acceleration are these times the state.
    position: Vector4<f64>,
    rate: Vector4<f64>,
    acceleration: Vector4<f64>,
    /// Factor on the variance of a pose.
    noise: f64,
}

/// All models, over a step.
fn models(step_s: f64) -> [StepModel; MODELS] {
    std::array::from_fn(|i| match i.checked_sub(SMOOTH) {
        None => StepModel::smooth(step_s, JERKS[i / NOISES.len()], NOISES[i % NOISES.len()]),
        Some(i) => StepModel::vibration(step_s, FREQUENCIES_HZ[i / SHAKES.len()], SHAKES[i % SHAKES.len()]),
    })
}

impl StepModel {
    /// White jerk.
    fn smooth(t: f64, jerk: f64, noise: f64) -> Self {
        let (t2, t3, t4, t5) = (t * t, t.powi(3), t.powi(4), t.powi(5));
        #[rustfmt::skip]
        let driven = jerk * Matrix4::new(
            t5 / 20.0, t4 / 8.0, t3 / 6.0, 0.0,
            t4 / 8.0, t3 / 3.0, t2 / 2.0, 0.0,
            t3 / 6.0, t2 / 2.0, t, 0.0,
            0.0, 0.0, 0.0, 0.0,
        );
        #[rustfmt::skip]
        let transition = Matrix4::new(
            1.0, t, t2 / 2.0, 0.0,
            0.0, 1.0, t, 0.0,
            0.0, 0.0, 1.0, 0.0,
            0.0, 0.0, 0.0, 0.0,
        );
        Self {
            transition,
            driven,
            position: Vector4::x(),
            rate: Vector4::y(),
            acceleration: Vector4::z(),
            noise,
        }
    }

    /// A damped oscillation about a mean that is driven by white acceleration.
    fn vibration(t: f64, frequency_hz: f64, shake: f64) -> Self {
        let natural = TAU * frequency_hz;
        let decay = DAMPING * natural;
        let damped = natural * (1.0 - DAMPING * DAMPING).sqrt();
        let (fall, (sin, cos)) = ((-decay * t).exp(), (damped * t).sin_cos());
        let (same, cross) = (fall * cos, fall * sin / damped);
        let [a, b] = [same + decay * cross, cross];
        let [c, d] = [-natural * natural * cross, same - decay * cross];
        // Process noise of a step: the stationary covariance minus its propagation.
        let rate = shake / (4.0 * decay);
        let position = rate / (natural * natural);
        let lost = [
            position * (1.0 - a * a) - rate * b * b,
            -position * a * c - rate * b * d,
            rate * (1.0 - d * d) - position * c * c,
        ];
        let (t2, t3) = (t * t, t.powi(3));
        let drive = [t3 / 3.0, t2 / 2.0, t].map(|entry| DRIVE * entry);
        #[rustfmt::skip]
        let driven = Matrix4::new(
            drive[0], drive[1], 0.0, 0.0,
            drive[1], drive[2], 0.0, 0.0,
            0.0, 0.0, lost[0], lost[1],
            0.0, 0.0, lost[1], lost[2],
        );
        #[rustfmt::skip]
        let transition = Matrix4::new(
            1.0, t, 0.0, 0.0,
            0.0, 1.0, 0.0, 0.0,
            0.0, 0.0, a, b,
            0.0, 0.0, c, d,
        );
        Self {
            transition,
            driven,
            position: Vector4::new(1.0, 0.0, 1.0, 0.0),
            rate: Vector4::new(0.0, 1.0, 0.0, 1.0),
            acceleration: Vector4::new(0.0, 0.0, -natural * natural, -2.0 * decay),
            noise: VIBRATION_NOISE,
        }
    }
}

/// The filters of one number of the pose.
#[derive(Debug, Clone)]
struct Bank {
    /// The unit of the number: a height in metres, or a radian.
    unit: f64,
    filters: [MotionFilter; MODELS],
}

/// A rate or an acceleration as a linear function of the change of the pose.
#[derive(Debug, Clone, Copy, Default)]
struct LinearInPose {
    slope: f64,
    offset: f64,
    variance: f64,
}

impl Bank {
    fn new(unit: f64, first: [f64; 2]) -> Self {
        let [rate, acceleration] = first.map(|deviation| deviation * deviation);
        let [shift, shake] = FIRST_VIBRATION.map(|deviation| deviation * deviation);
        let smooth = Vector4::new(0.0, rate, acceleration, 0.0);
        let shaken = Vector4::new(0.0, rate, shift, shake);
        let filters = std::array::from_fn(|i| MotionFilter {
            mean: Vector4::zeros(),
            covariance: Matrix4::from_diagonal(if i < SMOOTH { &smooth } else { &shaken }),
            log_likelihood: 0.0,
        });
        Self { unit, filters }
    }

    fn update(&mut self, models: &[StepModel; MODELS], change: f64, variance: f64) {
        let (change, variance) = (change / self.unit, variance / (self.unit * self.unit));
        for (filter, model) in self.filters.iter_mut().zip(models) {
            *filter = filter.predicted(model);
            filter.update(model, change, variance.max(LEAST_NOISE * LEAST_NOISE));
            filter.mean[0] -= change;
        }
        let best = self.best();
        for filter in &mut self.filters {
            filter.log_likelihood = (filter.log_likelihood - best).max(-LEAST_LIKELY);
        }
    }

    fn best(&self) -> f64 {
        self.filters.iter().map(|filter| filter.log_likelihood).fold(f64::NEG_INFINITY, f64::max)
    }

    /// Rate and acceleration a step later, given the change of the pose: the mixture of what the
    /// filters say.
    fn given_change(&self, models: &[StepModel; MODELS]) -> [LinearInPose; 2] {
        let best = self.best();
        let (mut position, mut total) = (0.0, 0.0);
        let predicted: [_; MODELS] = std::array::from_fn(|i| {
            let (filter, model) = (&self.filters[i], &models[i]);
            let weight = (filter.log_likelihood - best).exp();
            let next = filter.predicted(model);
            total += weight;
            position += weight * model.position.dot(&next.mean);
            (weight, next.given_position(model))
        });
        let position = position / total;
        [0, 1].map(|k| {
            let mean = |of: &dyn Fn(&LinearInPose) -> f64| {
                predicted.iter().map(|(weight, lines)| weight * of(&lines[k])).sum::<f64>() / total
            };
            let slope = mean(&|line| line.slope);
            let offset = mean(&|line| line.offset);
            let there = offset + slope * position;
            let spread = mean(&|line| (line.offset + line.slope * position - there).powi(2));
            let variance = (mean(&|line| line.variance) + spread) * self.unit * self.unit;
            LinearInPose { slope, offset: offset * self.unit, variance }
        })
    }
}

/// A Kalman filter with one of the models.
#[derive(Debug, Clone, Copy)]
struct MotionFilter {
    mean: Vector4<f64>,
    covariance: Matrix4<f64>,
    log_likelihood: f64,
}

impl MotionFilter {
    fn predicted(&self, model: &StepModel) -> Self {
        let StepModel { transition, driven, .. } = model;
        let covariance = transition * self.covariance * transition.transpose() + driven;
        Self { mean: transition * self.mean, covariance, ..*self }
    }

    fn update(&mut self, model: &StepModel, position: f64, variance: f64) {
        let innovation = position - model.position.dot(&self.mean);
        let by_position = self.covariance * model.position;
        let expected = model.position.dot(&by_position) + model.noise * variance;
        let gain = by_position / expected;
        self.mean += gain * innovation;
        self.covariance -= gain * by_position.transpose();
        let nats = -0.5 * (innovation * innovation / expected + expected.ln());
        self.log_likelihood = FORGETTING_FACTOR * self.log_likelihood + nats;
    }

    /// Rate and acceleration given the position.
    fn given_position(&self, model: &StepModel) -> [LinearInPose; 2] {
        let by_position = self.covariance * model.position;
        let variance = model.position.dot(&by_position);
        [model.rate, model.acceleration].map(|state| {
            let slope = if variance > 0.0 { state.dot(&by_position) / variance } else { 0.0 };
            let left = state.dot(&(self.covariance * state)) - slope * state.dot(&by_position);
            let offset = state.dot(&self.mean) - slope * model.position.dot(&self.mean);
            LinearInPose { slope, offset, variance: left.max(0.0) }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_S: f64 = 1.0 / 30.0;

    /// Root mean squares of the error of the rate of x over frames 60 to 300, of the same by the
    /// slope of the parabola through the last three poses, and of the stated standard deviation.
    fn errors(at: impl Fn(f64) -> (f64, f64)) -> [f64; 3] {
        let mut filter = RateFilter::new(1.0);
        let variance = PoseRates::repeat(1e-10);
        let pose = |k: usize| PoseRates::repeat(at(k as f64 * STEP_S).0);
        let mut squares = [0.0; 3];
        for k in 1..300 {
            let (last, now) = (pose(k - 1), pose(k));
            if k >= 60 {
                let expected = filter.expected(STEP_S, &last);
                let rate = expected.rates_at(&now)[X];
                let true_rate = at(k as f64 * STEP_S).1;
                let parabola = (1.5 * now - 2.0 * last + 0.5 * pose(k - 2))[X] / STEP_S;
                squares[0] += (rate - true_rate).powi(2);
                squares[1] += (parabola - true_rate).powi(2);
                squares[2] += expected.rate_variance[X];
            }
            filter.update(STEP_S, &(now - last), &variance);
        }
        squares.map(|sum| (sum / 240.0_f64).sqrt())
    }

    fn wave(amplitude: f64, frequency_hz: f64) -> impl Fn(f64) -> (f64, f64) {
        let rate = TAU * frequency_hz;
        move |t| {
            let (sin, cos) = (rate * t).sin_cos();
            (0.6 * t + amplitude * sin, 0.6 + amplitude * rate * cos)
        }
    }

    #[test]
    fn steady_motion_is_known_exactly() {
        let [error, _, stated] = errors(|t| (0.6 * t, 0.6));
        assert!(error < 1e-6 && stated < 0.01, "{error} {stated}");
    }

    #[test]
    fn a_vibration_is_predicted_better_than_by_a_parabola() {
        // A hand of 2 Hz, and motors between the frequencies of the models.
        for (amplitude, frequency_hz, part) in [(0.02, 2.0, 0.7), (1e-3, 7.0, 0.5), (1e-3, 9.3, 0.5)] {
            let [error, parabola, stated] = errors(wave(amplitude, frequency_hz));
            assert!(error < part * parabola, "{frequency_hz} Hz: {error} {parabola}");
            assert!(error < 1.5 * stated, "{frequency_hz} Hz: {error} {stated}");
        }
    }

    #[test]
    fn models_of_two_steps_are_those_of_one_twice() {
        for (once, twice) in models(STEP_S).iter().zip(&models(2.0 * STEP_S)) {
            let transition = once.transition * once.transition;
            let driven = once.transition * once.driven * once.transition.transpose() + once.driven;
            assert!((transition - twice.transition).norm() < 1e-9 * twice.transition.norm());
            assert!((driven - twice.driven).norm() < 1e-9 * twice.driven.norm(), "{driven} {}", twice.driven);
        }
    }
}
