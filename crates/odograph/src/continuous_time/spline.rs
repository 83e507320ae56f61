//! Uniform B-splines of degree five: poses with continuous jerk and bounded support.

use crate::motion::PoseRates;

/// Control points that determine the pose at any time.
pub const SUPPORT: usize = 6;

/// Weights of the control points `first .. first + SUPPORT` in the pose, its rate and its
/// acceleration at some time.
#[derive(Debug, Clone, Copy)]
pub struct Basis {
    pub first: usize,
    /// By order of the derivative.
    pub weights: [[f64; SUPPORT]; 3],
}

/// The motion of a camera at some time: pose, rates and accelerations.
pub type State = [PoseRates; 3];

/// A pose as a function of time.
#[derive(Debug, Clone)]
pub struct Spline {
    start_s: f64,
    step_s: f64,
    pub control: Vec<PoseRates>,
}

/// 120 times the coefficients of the basis polynomials of u, the time within an interval; row k
/// belongs to u^k (C. de Boor, *A Practical Guide to Splines*, 1978).
#[rustfmt::skip]
const POLYNOMIALS: [[f64; SUPPORT]; SUPPORT] = [
    [1.0, 26.0, 66.0, 26.0, 1.0, 0.0],
    [-5.0, -50.0, 0.0, 50.0, 5.0, 0.0],
    [10.0, 20.0, -60.0, 20.0, 10.0, 0.0],
    [-10.0, 20.0, 0.0, -20.0, 10.0, 0.0],
    [5.0, -20.0, 30.0, -20.0, 5.0, 0.0],
    [-1.0, 5.0, -10.0, 10.0, -5.0, 1.0],
];

impl Spline {
    /// From `start_s` to `end_s` at least, in intervals of `step_s`; the control points are those
    /// that `pose` has in the middle of their support.
    pub fn new(start_s: f64, end_s: f64, step_s: f64, pose: impl Fn(f64) -> PoseRates) -> Self {
        let intervals = ((end_s - start_s) / step_s).ceil().max(1.0) as usize;
        let control =
            (0..intervals + SUPPORT - 1).map(|i| pose(start_s + (i as f64 - 2.0) * step_s)).collect();
        Self { start_s, step_s, control }
    }

    /// The weights of the control points at a time within the spline, seconds.
    pub fn basis(&self, time_s: f64) -> Basis {
        let intervals = self.control.len() + 1 - SUPPORT;
        let along = (time_s - self.start_s) / self.step_s;
        let first = (along.max(0.0) as usize).min(intervals - 1);
        let u = along - first as f64;
        let mut weights = [[0.0; SUPPORT]; 3];
        for (power, coefficients) in POLYNOMIALS.iter().enumerate() {
            let mut factor = 1.0 / 120.0;
            for (order, weights) in weights.iter_mut().enumerate().take(power + 1) {
                let term = factor * u.powi((power - order) as i32);
                weights.iter_mut().zip(coefficients).for_each(|(weight, c)| *weight += c * term);
                factor *= (power - order) as f64 / self.step_s;
            }
        }
        Basis { first, weights }
    }

    /// The length of an interval, seconds.
    pub fn step_s(&self) -> f64 {
        self.step_s
    }

    /// Pose, rate and acceleration.
    pub fn at(&self, basis: &Basis) -> State {
        let near = &self.control[basis.first..basis.first + SUPPORT];
        basis.weights.map(|weights| near.iter().zip(weights).map(|(control, weight)| control * weight).sum())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spline_is_smooth_and_its_derivatives_are_right() {
        let wave = |t: f64| PoseRates::repeat((7.0 * t).sin());
        let spline = Spline::new(1.0, 2.0, 0.03, wave);
        let at = |t: f64| spline.at(&spline.basis(t)).map(|numbers| numbers[0]);
        for k in 0..100 {
            let (t, e) = (1.0 + 0.00997 * k as f64 + 2e-4, 1e-4);
            let [before, now, after] = [t - e, t, t + e].map(at);
            assert!((now[1] - (after[0] - before[0]) / (2.0 * e)).abs() < 1e-5, "rate at {t}");
            assert!((now[2] - (after[1] - before[1]) / (2.0 * e)).abs() < 1e-3, "acceleration at {t}");
        }
    }

    #[test]
    fn a_line_is_reproduced() {
        let spline = Spline::new(0.0, 1.0, 0.1, |t| PoseRates::repeat(3.0 - 2.0 * t));
        for t in [0.0, 0.123, 0.5, 0.999, 1.0] {
            let [pose, rate, acceleration] = spline.at(&spline.basis(t));
            assert!((pose[4] - (3.0 - 2.0 * t)).abs() < 1e-12, "{t}: {}", pose[4]);
            assert!((rate[4] + 2.0).abs() < 1e-11 && acceleration[4].abs() < 1e-9);
        }
    }
}
