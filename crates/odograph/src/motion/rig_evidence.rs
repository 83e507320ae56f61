//! Prior and likelihood of height and tilt within a frame's fit.

use super::RigPrior;
use super::correlated_noise::shared_rig_variances;
use super::normal_equations::{Factor, NormalEquations};
use crate::camera::Camera;
use crate::geometry::GroundPose;

/// Prior of height, roll and pitch with weights relative to the pixel noise: (σ/σ_i)².
#[derive(Debug, Clone, Copy)]
pub struct WeightedRigPrior {
    pub mean: [f64; 3],
    pub weight: [f64; 3],
}

impl WeightedRigPrior {
    pub fn new(prior: &RigPrior, scale_px: f64) -> Self {
        Self { mean: prior.mean, weight: prior.sigma.map(|sigma| (scale_px / sigma).powi(2)) }
    }

    pub fn add_to(&self, equations: &mut NormalEquations, pose: &GroundPose) {
        let current = [pose.height_m, pose.roll_rad, pose.pitch_rad];
        for (i, current) in current.into_iter().enumerate() {
            equations.add_prior(3 + i, current - self.mean[i], self.weight[i]);
        }
    }
}

/// Height, roll and pitch from the tracks alone (the likelihood without the prior), and their
/// variances. At the minimum the gradients of likelihood and prior cancel, so that one Newton step
/// against the gradient of the prior leads to the maximum of the likelihood.
pub fn evidence(
    camera: &Camera,
    tracks_alone: &Factor,
    pose: &GroundPose,
    rig_prior: &WeightedRigPrior,
    scale_px: f64,
    shared_px: f64,
) -> [(f64, f64); 3] {
    let current = [pose.height_m, pose.roll_rad, pose.pitch_rad];
    let gradient = [0, 1, 2].map(|i| rig_prior.weight[i] * (current[i] - rig_prior.mean[i]));
    let shared = shared_rig_variances(camera, pose, shared_px);
    [0, 1, 2].map(|i| {
        let covariance = tracks_alone.column(3 + i);
        let step: f64 = (0..3).map(|k| covariance[3 + k] * gradient[k]).sum();
        (current[i] + step, covariance[3 + i] * scale_px * scale_px + shared[i])
    })
}

/// Widens the prior where the tracks alone lie more than four standard deviations from it, as at a
/// kerb or a push. Returns whether it did.
pub fn widen(prior: &mut RigPrior, evidence: &[(f64, f64); 3]) -> bool {
    let mut widened = false;
    for (i, (value, variance)) in evidence.iter().enumerate() {
        let deviation = (value - prior.mean[i]).abs();
        if deviation > 4.0 * (variance + prior.sigma[i] * prior.sigma[i]).sqrt() {
            prior.sigma[i] = deviation;
            widened = true;
        }
    }
    widened
}
