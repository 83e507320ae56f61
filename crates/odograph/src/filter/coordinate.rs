//! Fixed-interval smoothing of one coordinate of a recording.
//!
//! The estimates are those of the Rauch–Tung–Striebel smoother (H. Rauch, F. Tung and C. Striebel,
//! "Maximum likelihood estimates of linear dynamic systems", 1965), computed by the modified
//! Bryson–Frazier recursion (G. Bierman, "Fixed interval smoothing with discrete measurements",
//! 1973), which inverts only the innovation variance. The process model is that of
//! [`super::ConstantAcceleration`].

use super::constant_acceleration::{
    CoordinateFilter, SMALLEST_VARIANCE, transition, unknown_motion, white_jerk,
};
use nalgebra::{Matrix3, Vector3};

/// A measured value and its variance; `None` for a missing sample.
pub(super) type Measured = Option<(f64, f64)>;

/// Smoothed value, velocity and acceleration of a coordinate, and the variance of the value.
#[derive(Debug, Clone, Copy)]
pub(super) struct Smoothed {
    pub state: Vector3<f64>,
    pub variance: f64,
}

/// Adaptive process noise: spectral density of the jerk in each step (from the previous sample to
/// this one). It is the larger of the densities that a forward and a backward filter estimate from
/// their innovations, so that the first frame of a sudden jerk is not smoothed away.
pub(super) fn adapted(times_s: &[f64], measured: &[Measured], least_density: f64) -> Vec<f64> {
    let mut densities = vec![least_density; measured.len()];
    let mut run = |order: &mut dyn Iterator<Item = usize>| {
        let mut known = order.filter_map(|i| measured[i].map(|(z, r)| (i, z, r)));
        let Some((mut before, z, r)) = known.next() else { return };
        let mut axis = CoordinateFilter::new(z, r, least_density);
        for (i, z, r) in known {
            let step_s = (times_s[i] - times_s[before]).abs();
            let density = axis.update(step_s, z, r);
            for step in &mut densities[before.min(i) + 1..=before.max(i)] {
                *step = step.max(density);
            }
            before = i;
        }
    };
    run(&mut (0..measured.len()));
    run(&mut (0..measured.len()).rev());
    densities
}

/// State of the forward filter at one sample, stored for the backward pass.
#[derive(Debug, Clone)]
struct FilterStep {
    state: Vector3<f64>,
    covariance: Matrix3<f64>,
    transition: Matrix3<f64>,
    /// Innovation, innovation variance and gain; `None` for a missing sample.
    update: Option<(f64, f64, Vector3<f64>)>,
}

impl FilterStep {
    /// Initial state; the first sample must be measured.
    fn first(measured: Measured) -> Self {
        let (value, variance) = measured.unwrap_or((0.0, 1e6));
        Self {
            state: Vector3::new(value, 0.0, 0.0),
            covariance: unknown_motion(variance),
            transition: Matrix3::identity(),
            update: None,
        }
    }

    /// Predicts over `step_s` and updates with the measurement, if there is one.
    fn next(&self, step_s: f64, density: f64, measured: Measured) -> Self {
        let t = step_s.max(0.0);
        let transition = transition(t);
        let state = transition * self.state;
        let covariance = transition * self.covariance * transition.transpose() + density * white_jerk(t);
        let Some((z, r)) = measured else { return Self { state, covariance, transition, update: None } };
        let (innovation, spread) = (z - state[0], covariance[(0, 0)] + r);
        let gain = covariance.column(0) / spread;
        let keep = Matrix3::identity() - gain * Vector3::x().transpose();
        Self {
            state: state + gain * innovation,
            covariance: keep * covariance * keep.transpose() + gain * gain.transpose() * r,
            transition,
            update: Some((innovation, spread, gain)),
        }
    }
}

/// Checkpoint interval of the forward pass, samples. The steps between checkpoints are recomputed
/// in the backward pass, because a step takes thirty times the memory of a smoothed sample.
const MADE_AGAIN: usize = 256;

/// Smooths all samples. The first one must be measured. `density` is the spectral density of the
/// jerk in the step before a sample.
pub(super) fn smooth_coordinate(
    times_s: &[f64],
    measured: &[Measured],
    density: impl Fn(usize) -> f64,
) -> Vec<Smoothed> {
    let Some(&first) = measured.first() else { return Vec::new() };
    let next = |step: &FilterStep, i: usize| step.next(times_s[i] - times_s[i - 1], density(i), measured[i]);
    let mut step = FilterStep::first(first);
    let mut kept = vec![step.clone()];
    for i in 1..measured.len() {
        step = next(&step, i);
        if i.is_multiple_of(MADE_AGAIN) {
            kept.push(step.clone());
        }
    }
    let mut smoothed = vec![Smoothed { state: Vector3::zeros(), variance: 0.0 }; measured.len()];
    let mut wayback = WayBack { adjoint: Vector3::zeros(), information: Matrix3::zeros() };
    let mut steps: Vec<FilterStep> = Vec::with_capacity(MADE_AGAIN);
    for (block, start) in kept.into_iter().enumerate().rev() {
        let from = block * MADE_AGAIN;
        steps.clear();
        steps.push(start);
        for i in from + 1..measured.len().min(from + MADE_AGAIN) {
            steps.push(next(&steps[i - from - 1], i));
        }
        for (step, smoothed) in steps.iter().zip(&mut smoothed[from..]).rev() {
            *smoothed = wayback.pass(step);
        }
    }
    smoothed
}

/// Adjoint state and information matrix of the backward recursion: the contribution of all later
/// samples.
struct WayBack {
    adjoint: Vector3<f64>,
    information: Matrix3<f64>,
}

impl WayBack {
    /// Smoothed estimate at a step; then propagates the recursion backward through that step.
    fn pass(&mut self, step: &FilterStep) -> Smoothed {
        let Self { adjoint, information } = self;
        let covariance = step.covariance - step.covariance * *information * step.covariance;
        let here = Smoothed {
            state: step.state - step.covariance * *adjoint,
            variance: covariance[(0, 0)]
                .clamp(SMALLEST_VARIANCE, step.covariance[(0, 0)].max(SMALLEST_VARIANCE)),
        };
        if let Some((innovation, spread, gain)) = step.update {
            let keep = Matrix3::identity() - gain * Vector3::x().transpose();
            *adjoint = keep.transpose() * *adjoint - Vector3::x() * (innovation / spread);
            *information = keep.transpose() * *information * keep;
            information[(0, 0)] += 1.0 / spread;
        }
        *adjoint = step.transition.transpose() * *adjoint;
        *information = step.transition.transpose() * *information * step.transition;
        here
    }
}
