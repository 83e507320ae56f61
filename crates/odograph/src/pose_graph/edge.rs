//! The residual of an edge in units of its standard deviations, and its Jacobians.

use super::{Heights, Node};
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::geometry::{PlaneTransform, wrap_angle};
use crate::keyframe::{EdgeKind, MapEdge};
use nalgebra::{Matrix4, Matrix4x2, Vector2, Vector4};

/// An edge with its whitening matrix.
#[derive(Debug, Clone)]
pub struct Weighted {
    pub from: usize,
    pub to: usize,
    pub kind: EdgeKind,
    motion: Vector4<f64>,
    /// Whitening matrix: the upper triangular square root of the information.
    whitening: Matrix4<f64>,
    pub covariance: Matrix4<f64>,
}

/// Minimum standard deviations: a hundredth of a millimetre, a thousandth of a degree, a
/// hundred-thousandth of the height.
const MIN_SIGMA: [f64; 4] = [1e-5, 1e-5, 2e-5, 1e-5];

impl Weighted {
    /// `None` if the covariance is not positive definite.
    pub fn new(from: usize, to: usize, edge: &MapEdge, heights: Heights) -> Option<Self> {
        let mut covariance = 0.5 * (edge.covariance + edge.covariance.transpose());
        if heights == Heights::Held {
            covariance.row_mut(3).fill(0.0);
            covariance.column_mut(3).fill(0.0);
        }
        for (i, sigma) in MIN_SIGMA.into_iter().enumerate() {
            covariance[(i, i)] += sigma * sigma;
        }
        if !edge.motion.iter().all(|value| value.is_finite()) {
            return None;
        }
        let mut whitening = covariance.cholesky()?.inverse().cholesky()?.l().transpose();
        if heights == Heights::Held {
            whitening.row_mut(3).fill(0.0);
        }
        let motion = edge.motion;
        Some(Self { from, to, kind: edge.kind, motion, whitening, covariance })
    }

    /// The keyframe at the other end.
    pub fn other(&self, at: usize) -> usize {
        if self.from == at { self.to } else { self.from }
    }

    /// Whether the mount's tilt affects it: whether it was measured, not extrapolated.
    pub fn bends(&self) -> bool {
        self.kind != EdgeKind::Gap
    }

    /// Jacobian of the motion with respect to the mount's rotation per metre forward and to the
    /// left.
    pub fn by_mount(&self) -> Matrix4x2<f64> {
        if !self.bends() {
            return Matrix4x2::zeros();
        }
        let (x, y) = (self.motion[X], self.motion[Y]);
        // A motion that rotates uniformly ends in a direction rotated by half as much.
        Matrix4x2::new(-0.5 * y * x, -0.5 * y * y, 0.5 * x * x, 0.5 * x * y, x, y, 0.0, 0.0)
    }

    /// The whitened residual at these poses.
    fn misses(&self, from: &Node, to: &Node, turn_per_m: Vector2<f64>) -> Vector4<f64> {
        let mut misses = from.seen(to) - self.motion - self.by_mount() * turn_per_m;
        misses[HEADING] = wrap_angle(misses[HEADING]);
        self.whitening * misses
    }

    /// The squared norm of the whitened residual.
    pub fn squared(&self, from: &Node, to: &Node, turn_per_m: Vector2<f64>) -> f64 {
        self.misses(from, to, turn_per_m).norm_squared()
    }

    /// The whitened residual with its Jacobians.
    pub fn linearized(&self, from: &Node, to: &Node, turn_per_m: Vector2<f64>) -> Linearized {
        let (world_from_a, world_from_b) = (from.world_from_node(), to.world_from_node());
        let by_from = world_from_a.between_by_from(&world_from_a.between(&world_from_b));
        Linearized {
            misses: self.misses(from, to, turn_per_m),
            by_from: self.whitening * by_from,
            by_to: self.whitening * world_from_a.between_by_to(),
            by_mount: self.whitening * -self.by_mount(),
        }
    }
}

/// A whitened residual with its Jacobians.
pub struct Linearized {
    pub misses: Vector4<f64>,
    pub by_from: Matrix4<f64>,
    pub by_to: Matrix4<f64>,
    pub by_mount: Matrix4x2<f64>,
}
