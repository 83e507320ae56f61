//! Alignment of the estimated trajectory with the ground truth.

use super::association::PosePair;
use crate::error::{Error, Result};
use nalgebra::{Isometry3, Matrix3, Matrix4, Quaternion, Translation3, UnitQuaternion, Vector3, Vector4};
use std::fmt;

/// Transformation that aligns the estimate with the ground truth before comparison.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Alignment {
    /// No alignment: both are in the same world frame.
    None,
    /// Rigid motion that maps the first compared pose to its true pose.
    Origin,
    /// Least-squares rotation about z and translation in x and y; heights are unchanged.
    Se2,
    /// Least-squares rigid motion.
    Se3,
    /// Least-squares similarity transform: rigid motion and scale.
    Sim3,
}

impl fmt::Display for Alignment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::None => "none",
            Self::Origin => "origin",
            Self::Se2 => "se2",
            Self::Se3 => "se3",
            Self::Sim3 => "sim3",
        })
    }
}

/// A similarity transform: `truth = rotation · scale · estimate + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// Scale factor, applied first.
    pub scale: f64,
    /// Rotation and translation (metres), applied after the scaling.
    pub truth_from_estimate: Isometry3<f64>,
    /// Whether the positions determine the rotation. They do not on a straight path (rotation about
    /// the path is free) or for a stationary camera (any rotation). Then, of all optimal rotations,
    /// the one that brings the first orientations closest together is used.
    pub rotation_determined: bool,
}

impl Similarity {
    /// Aligns a pose of the estimate with the ground truth.
    pub fn apply(&self, pose: &Isometry3<f64>) -> Isometry3<f64> {
        let scaled = Translation3::from(pose.translation.vector * self.scale);
        self.truth_from_estimate * Isometry3::from_parts(scaled, pose.rotation)
    }
}

/// Estimates the transformation of the given kind. Fails for [`Alignment::Sim3`] if the positions
/// do not determine a scale.
pub(super) fn fit(pairs: &[PosePair], alignment: Alignment) -> Result<Similarity> {
    let rigid = |truth_from_estimate, rotation_determined| Similarity {
        scale: 1.0,
        truth_from_estimate,
        rotation_determined,
    };
    Ok(match alignment {
        Alignment::None => rigid(Isometry3::identity(), true),
        Alignment::Origin => {
            let first =
                pairs.first().map_or(Isometry3::identity(), |pair| pair.truth * pair.estimate.inverse());
            rigid(first, true)
        }
        Alignment::Se2 => {
            let mut sums = AlignmentSums::of(pairs);
            // With zero rows and columns for z, only a rotation about z changes the objective.
            for index in 0..3 {
                sums.covariance[(2, index)] = 0.0;
                sums.covariance[(index, 2)] = 0.0;
            }
            let c = sums.covariance;
            let (along, across) = (c[(0, 0)] + c[(1, 1)], c[(1, 0)] - c[(0, 1)]);
            let determined = along.hypot(across) > DETERMINED * sums.largest();
            let first = sums.first_rotation.coords;
            let angle_rad = if determined { across.atan2(along) } else { 2.0 * first.z.atan2(first.w) };
            let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle_rad);
            let mut shift = sums.truth_mean - rotation * sums.estimate_mean;
            shift.z = 0.0;
            rigid(Isometry3::from_parts(shift.into(), rotation), determined)
        }
        Alignment::Se3 => {
            let sums = AlignmentSums::of(pairs);
            let best = sums.best_rotation();
            let shift = sums.truth_mean - best.rotation * sums.estimate_mean;
            rigid(Isometry3::from_parts(shift.into(), best.rotation), best.determined)
        }
        Alignment::Sim3 => {
            let sums = AlignmentSums::of(pairs);
            let best = sums.best_rotation();
            let scale = sums.scale(&best).ok_or_else(|| {
                Error::input(
                    "the positions do not determine a scale (one of the paths stands still, or they have nothing in common); \
                     align with se3 or origin instead",
                )
            })?;
            let shift = sums.truth_mean - best.rotation * (sums.estimate_mean * scale);
            Similarity {
                scale,
                truth_from_estimate: Isometry3::from_parts(shift.into(), best.rotation),
                rotation_determined: best.determined,
            }
        }
    })
}

/// The scale of [`Alignment::Sim3`]; `None` if the positions do not determine it.
pub(super) fn scale(pairs: &[PosePair]) -> Option<f64> {
    let sums = AlignmentSums::of(pairs);
    sums.scale(&sums.best_rotation())
}

/// Relative tolerance below which a difference is rounding.
const DETERMINED: f64 = 1e-12;

/// Sufficient statistics of the alignment.
struct AlignmentSums {
    estimate_mean: Vector3<f64>,
    truth_mean: Vector3<f64>,
    /// Sum of squared distances of the estimated positions from their mean, square metres.
    estimate_spread: f64,
    /// Sum of squared distances of the true positions from their mean, square metres.
    truth_spread: f64,
    /// Cross-covariance (not divided by the count): sum of (truth − mean)(estimate − mean)ᵀ.
    covariance: Matrix3<f64>,
    /// Rotation that maps the first estimated orientation to the true one.
    first_rotation: UnitQuaternion<f64>,
}

/// An optimal rotation and the value of its objective.
struct BestRotation {
    rotation: UnitQuaternion<f64>,
    /// Objective tr(R covarianceᵀ), Umeyama's tr(D S).
    gain: f64,
    determined: bool,
}

impl AlignmentSums {
    fn of(pairs: &[PosePair]) -> Self {
        let count = pairs.len().max(1) as f64;
        let estimate_mean =
            pairs.iter().map(|pair| pair.estimate.translation.vector).sum::<Vector3<f64>>() / count;
        let truth_mean = pairs.iter().map(|pair| pair.truth.translation.vector).sum::<Vector3<f64>>() / count;
        let mut sums = Self {
            estimate_mean,
            truth_mean,
            estimate_spread: 0.0,
            truth_spread: 0.0,
            covariance: Matrix3::zeros(),
            first_rotation: pairs.first().map_or_else(UnitQuaternion::identity, |pair| {
                pair.truth.rotation * pair.estimate.rotation.inverse()
            }),
        };
        for pair in pairs {
            let estimate = pair.estimate.translation.vector - estimate_mean;
            let truth = pair.truth.translation.vector - truth_mean;
            sums.estimate_spread += estimate.norm_squared();
            sums.truth_spread += truth.norm_squared();
            sums.covariance += truth * estimate.transpose();
        }
        sums
    }

    /// Upper bound of every element of the cross-covariance.
    fn largest(&self) -> f64 {
        (self.estimate_spread * self.truth_spread).sqrt()
    }

    /// The rotation of S. Umeyama, "Least-squares estimation of transformation parameters between
    /// two point patterns", 1991, computed by the method of B. K. P. Horn, "Closed-form solution of
    /// absolute orientation using unit quaternions", 1987: the quaternion is the eigenvector of the
    /// largest eigenvalue of a symmetric 4 × 4 matrix. It is always a rotation, never a reflection.
    ///
    /// The gap between the largest two eigenvalues is twice the sum of Umeyama's two smaller
    /// (signed) singular values. If it vanishes, the optimal rotations form an eigenspace, and the
    /// one closest to a given rotation is the projection of that rotation onto the eigenspace.
    fn best_rotation(&self) -> BestRotation {
        let c = &self.covariance;
        let (xx, yy, zz) = (c[(0, 0)], c[(1, 1)], c[(2, 2)]);
        let (x, y, z) = (c[(2, 1)] - c[(1, 2)], c[(0, 2)] - c[(2, 0)], c[(1, 0)] - c[(0, 1)]);
        let (xy, yz, zx) = (c[(0, 1)] + c[(1, 0)], c[(1, 2)] + c[(2, 1)], c[(2, 0)] + c[(0, 2)]);
        #[rustfmt::skip]
        let horn = Matrix4::new(
            xx + yy + zz, x, y, z,
            x, xx - yy - zz, xy, zx,
            y, xy, yy - xx - zz, yz,
            z, zx, yz, zz - xx - yy,
        );
        let eigen = horn.symmetric_eigen();
        let gain = eigen.eigenvalues.max();
        let rounding = DETERMINED * self.largest();
        let best: Vec<Vector4<f64>> = (0..4)
            .filter(|&index| eigen.eigenvalues[index] >= gain - rounding)
            .map(|index| eigen.eigenvectors.column(index).into_owned())
            .collect();
        let q = self.first_rotation.coords;
        let wanted = Vector4::new(q.w, q.x, q.y, q.z);
        let nearest: Vector4<f64> = best.iter().map(|axis| *axis * axis.dot(&wanted)).sum();
        let chosen = match best.as_slice() {
            [only] => *only,
            [first, ..] if nearest.norm() < 1e-6 => *first,
            _ => nearest,
        };
        let quaternion = Quaternion::new(chosen[0], chosen[1], chosen[2], chosen[3]);
        let rotation = UnitQuaternion::try_new(quaternion, 0.0).unwrap_or_else(UnitQuaternion::identity);
        BestRotation { rotation, gain, determined: best.len() == 1 }
    }

    /// Umeyama's equation 42.
    fn scale(&self, best: &BestRotation) -> Option<f64> {
        let scale = best.gain / self.estimate_spread;
        (best.gain > DETERMINED * self.largest() && scale.is_finite() && scale > 0.0).then_some(scale)
    }
}
