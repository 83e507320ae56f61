//! Prior and likelihood of height and tilt within a frame's fit.

use super::RigPrior;
use super::correlated_noise::shared_rig_variances;
use super::normal_equations::{Factor, NormalEquations};
use crate::camera::Camera;
use crate::geometry::GroundPose;
use nalgebra::{Matrix3, Vector3};

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
/// covariance. At the minimum the gradients of likelihood and prior cancel, so that one Newton step
/// against the gradient of the prior leads to the maximum of the likelihood.
pub fn evidence(
    camera: &Camera,
    tracks_alone: &Factor,
    pose: &GroundPose,
    rig_prior: &WeightedRigPrior,
    scale_px: f64,
    shared_px: f64,
) -> (Vector3<f64>, Matrix3<f64>) {
    let current = Vector3::new(pose.height_m, pose.roll_rad, pose.pitch_rad);
    let gradient = Vector3::from(rig_prior.weight).component_mul(&(current - Vector3::from(rig_prior.mean)));
    let columns = [0, 1, 2].map(|i| tracks_alone.column(3 + i));
    let inverse = Matrix3::from_fn(|k, i| columns[i][3 + k]);
    let shared = Vector3::from(shared_rig_variances(camera, pose, shared_px));
    (current + inverse * gradient, inverse * scale_px * scale_px + Matrix3::from_diagonal(&shared))
}

/// Widens the prior where the tracks alone lie more than four standard deviations from it, as at a
/// kerb or a push. Returns whether it did.
pub fn widen(prior: &mut RigPrior, (value, covariance): &(Vector3<f64>, Matrix3<f64>)) -> bool {
    let mut widened = false;
    for i in 0..3 {
        let deviation = (value[i] - prior.mean[i]).abs();
        if deviation > 4.0 * (covariance[(i, i)] + prior.sigma[i] * prior.sigma[i]).sqrt() {
            prior.sigma[i] = deviation;
            widened = true;
        }
    }
    widened
}
