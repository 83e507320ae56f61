//! Kalman filter with a constant-acceleration model for position and heading.
//!
//! Equations (4)–(6) of Perić et al., "Software system for simultaneous localization and mapping
//! based on video content analysis": the position is measured, and over a time step t the state
//! propagates as
//!
//! `p ← p + v t + a t² / 2`, `v ← v + a t`, `a ← a`.
//!
//! We differ in using the actual time step, the covariance of the motion measurement, and an
//! adaptive process noise (white jerk) estimated from the innovations (Y. Bar-Shalom et al.,
//! "Estimation with Applications to Tracking and Navigation", 2001, §6.2.3).

use super::FilterConfig;
use crate::trajectory::Velocity;
use nalgebra::{Matrix3, Vector3};

/// Filtered position, heading and velocity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Filtered {
    /// World x, metres.
    pub x_m: f64,
    /// World y, metres.
    pub y_m: f64,
    /// Heading, radians.
    pub heading_rad: f64,
    /// Velocity and heading rate.
    pub velocity: Velocity,
}

/// The filter: three independent axes for x, y and heading.
#[derive(Debug, Clone)]
pub struct ConstantAcceleration {
    axes: [CoordinateFilter; 3],
    time_s: f64,
}

impl ConstantAcceleration {
    /// Initialises the filter with a first measurement of (x, y, heading), metres and radians, and
    /// its variances. Velocity and acceleration have zero mean and a standard deviation of 10 m/s
    /// (rad/s) and 10 m/s² (rad/s²).
    pub fn new(time_s: f64, measured: [f64; 3], variances: [f64; 3], config: &FilterConfig) -> Self {
        let densities = [config.jerk_density, config.jerk_density, config.heading_jerk_density];
        let axis = |i: usize| CoordinateFilter::new(measured[i], variances[i], densities[i]);
        Self { axes: [axis(0), axis(1), axis(2)], time_s }
    }

    /// Predicts to `time_s`, updates with a measurement of (x, y, heading) and its variances, and
    /// returns the filtered state. A time at or before the last one counts as a time step of zero.
    pub fn update(&mut self, time_s: f64, measured: [f64; 3], variances: [f64; 3]) -> Filtered {
        let step_s = (time_s - self.time_s).max(0.0);
        self.time_s = self.time_s.max(time_s);
        for (i, axis) in self.axes.iter_mut().enumerate() {
            axis.update(step_s, measured[i], variances[i].max(SMALLEST_VARIANCE));
        }
        self.filtered()
    }

    /// Shifts the state by (x, y, heading) without affecting velocities: a correction of the
    /// origin, not a motion of the camera.
    pub fn shift(&mut self, by: [f64; 3]) {
        for (axis, by) in self.axes.iter_mut().zip(by) {
            axis.state[0] += by;
        }
    }

    /// The current state.
    pub fn filtered(&self) -> Filtered {
        let [x, y, heading] = &self.axes;
        Filtered {
            x_m: x.state[0],
            y_m: y.state[0],
            heading_rad: heading.state[0],
            velocity: Velocity { x_m_s: x.state[1], y_m_s: y.state[1], heading_rad_s: heading.state[1] },
        }
    }
}

/// Lower bound of measurement variances, (1 nm)² or (1 nrad)²: keeps the filter regular for
/// measurements of zero variance.
pub(super) const SMALLEST_VARIANCE: f64 = 1e-18;

/// Weight of the newest innovation in the exponential average: a memory of about ten frames.
const MATCHING_RATE: f64 = 0.1;

/// Gate on the squared normalised innovation (4 standard deviations, squared): exceeded by chance
/// once in 16,000 frames.
const OUT_OF_PROPORTION: f64 = 16.0;

/// Kalman filter of one coordinate.
#[derive(Debug, Clone)]
pub(super) struct CoordinateFilter {
    /// Position, velocity, acceleration.
    state: Vector3<f64>,
    covariance: Matrix3<f64>,
    /// Spectral density of the jerk estimated from the recent innovations; negative where they are
    /// smaller than predicted.
    matched: f64,
    least_density: f64,
}

impl CoordinateFilter {
    /// Initialises the state at a measurement, with unknown velocity and acceleration.
    pub(super) fn new(measured: f64, variance: f64, least_density: f64) -> Self {
        Self {
            state: Vector3::new(measured, 0.0, 0.0),
            covariance: unknown_motion(variance),
            matched: least_density,
            least_density,
        }
    }

    /// Predicts over `t` seconds and updates with a measurement; returns the spectral density of
    /// the jerk used in this step.
    pub(super) fn update(&mut self, t: f64, measured: f64, variance: f64) -> f64 {
        let transition = transition(t);
        let jerk = white_jerk(t);
        self.state = transition * self.state;
        let propagated = transition * self.covariance * transition.transpose();
        let innovation = measured - self.state[0];
        // Covariance matching (R. Mehra, 1970): the excess of the squared innovation over the
        // propagated variance plus the measurement variance is attributed to the jerk, and its
        // average is the density. A single innovation beyond the gate takes effect at once (strong
        // tracking filter; D. Zhou and P. Frank, 1996).
        if jerk[(0, 0)] > 0.0 {
            let excess = (innovation * innovation - propagated[(0, 0)] - variance) / jerk[(0, 0)];
            self.matched += MATCHING_RATE * (excess - self.matched);
            let expected =
                propagated[(0, 0)] + self.matched.max(self.least_density) * jerk[(0, 0)] + variance;
            if innovation * innovation > OUT_OF_PROPORTION * expected {
                self.matched = excess;
            }
        }
        let density = self.matched.max(self.least_density);
        let predicted = propagated + density * jerk;
        let gain = predicted.column(0) / (predicted[(0, 0)] + variance);
        self.state += gain * innovation;
        // Joseph form: keeps the covariance symmetric and positive semidefinite.
        let keep = Matrix3::identity() - gain * Vector3::x().transpose();
        self.covariance = keep * predicted * keep.transpose() + gain * gain.transpose() * variance;
        density
    }
}

/// Initial covariance: the position's variance, and standard deviations of 10 m/s (rad/s) and 10
/// m/s² (rad/s²).
pub(super) fn unknown_motion(variance: f64) -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::new(variance, 100.0, 100.0))
}

/// State transition matrix of position, velocity and acceleration over a time step.
pub(super) fn transition(t: f64) -> Matrix3<f64> {
    Matrix3::new(1.0, t, 0.5 * t * t, 0.0, 1.0, t, 0.0, 0.0, 1.0)
}

/// Process noise covariance of a white jerk of unit spectral density over a time step.
pub(super) fn white_jerk(t: f64) -> Matrix3<f64> {
    let (t2, t3) = (t * t, t * t * t);
    Matrix3::new(
        t3 * t2 / 20.0,
        t2 * t2 / 8.0,
        t3 / 6.0,
        t2 * t2 / 8.0,
        t3 / 3.0,
        t2 / 2.0,
        t3 / 6.0,
        t2 / 2.0,
        t,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Random;

    fn gaussian(random: &mut Random) -> f64 {
        let uniform = |r: &mut Random| ((r.bits() >> 11) as f64 + 0.5) / (1u64 << 53) as f64;
        (-2.0 * uniform(random).ln()).sqrt() * (std::f64::consts::TAU * uniform(random)).cos()
    }

    /// Root mean square errors of the measured and the filtered positions along a path x(t) sampled
    /// at irregular times.
    fn errors(path: impl Fn(f64) -> f64, sigma: f64) -> (f64, f64) {
        let mut random = Random::new(11);
        let variances = [sigma * sigma; 3];
        let mut filter =
            ConstantAcceleration::new(0.0, [path(0.0), 0.0, 0.0], variances, &FilterConfig::default());
        let (mut raw, mut improved, mut count) = (0.0, 0.0, 0.0);
        let mut time = 0.0;
        for i in 0..900 {
            time += 1.0 / 30.0 * (1.0 + 0.3 * gaussian(&mut random).clamp(-2.0, 2.0));
            let measured = path(time) + sigma * gaussian(&mut random);
            let filtered = filter.update(time, [measured, 0.0, 0.0], variances);
            if i > 60 {
                raw += (measured - path(time)).powi(2);
                improved += (filtered.x_m - path(time)).powi(2);
                count += 1.0;
            }
        }
        ((raw / count).sqrt(), (improved / count).sqrt())
    }

    #[test]
    fn filtering_reduces_noise_on_a_smooth_path() {
        let (raw, improved) = errors(|t| 0.5 * t + 0.3 * (0.5 * t).sin(), 0.01);
        // A filter tuned to this path would halve the error; the adaptive one must reduce it by at
        // least a quarter.
        assert!(improved < 0.75 * raw, "{improved} {raw}");
    }

    #[test]
    fn exact_positions_of_a_vibrating_camera_keep_their_accuracy() {
        let shaken = |t: f64| 0.5 * t + 0.003 * (55.0 * t).sin();
        let (raw, improved) = errors(shaken, 1e-4);
        assert!(improved < 1.05 * raw, "{improved} {raw}");
    }

    #[test]
    fn constant_acceleration_is_tracked_exactly() {
        let path = |t: f64| 1.0 + 2.0 * t + 0.5 * 0.7 * t * t;
        let mut filter = ConstantAcceleration::new(0.0, [1.0, 0.0, 0.0], [1e-8; 3], &FilterConfig::default());
        let mut last = filter.filtered();
        for i in 1..=300 {
            let time = i as f64 * 0.02;
            last = filter.update(time, [path(time), 0.0, 0.0], [1e-8; 3]);
        }
        assert!((last.x_m - path(6.0)).abs() < 1e-5);
        assert!((last.velocity.x_m_s - (2.0 + 0.7 * 6.0)).abs() < 1e-2, "{last:?}");
    }

    #[test]
    fn a_repeated_timestamp_keeps_the_state_finite() {
        let mut filter = ConstantAcceleration::new(0.0, [0.0; 3], [1e-6; 3], &FilterConfig::default());
        filter.update(0.1, [0.1, 0.0, 0.0], [1e-6; 3]);
        let after = filter.update(0.1, [0.1, 0.0, 0.0], [1e-6; 3]);
        assert!(after.x_m.is_finite() && (after.x_m - 0.1).abs() < 1e-3);
    }
}
