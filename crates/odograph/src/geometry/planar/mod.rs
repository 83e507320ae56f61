//! Rigid and similarity transforms of the ground plane, SE(2) and Sim(2), and the propagation of
//! covariances.
//!
//! A transform is `target_from_source`; `world_from_a * a_from_b` is `world_from_b`. Headings are
//! never wrapped: a product adds them, so whole turns are kept.
//!
//! Jacobians and covariances are those of the numbers themselves: (x, y, heading) of an [`Se2`],
//! (x, y, heading, ln scale) of a [`Sim2`], position in the axes of the target. Only
//! [`PlaneTransform::adjoint`] is about the tangent space (J. Solà, J. Deray and D. Atchuthan,
//! "A micro Lie theory for state estimation in robotics", 2018), in the same order.

use super::{GroundPoint, GroundPose};
use nalgebra::{Matrix3, Matrix4, SMatrix, Vector4};
use std::ops::Mul;

/// A rigid transform of the plane: rotate by the heading, then translate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Se2 {
    /// Translation along the target's x, metres.
    pub x_m: f64,
    /// Translation along the target's y, metres.
    pub y_m: f64,
    /// Rotation, counter-clockwise, radians, any number of turns.
    pub heading_rad: f64,
}

/// A similarity transform of the plane: scale, rotate by the heading, then translate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sim2 {
    /// Translation along the target's x, metres.
    pub x_m: f64,
    /// Translation along the target's y, metres.
    pub y_m: f64,
    /// Rotation, counter-clockwise, radians, any number of turns.
    pub heading_rad: f64,
    /// Factor of lengths, positive.
    pub scale: f64,
}

/// What SE(2) and Sim(2) have in common, with their `N` numbers.
pub trait PlaneTransform<const N: usize>: Copy + Mul<Output = Self> {
    /// The transform that changes nothing.
    const IDENTITY: Self;

    /// `source_from_target`.
    fn inverse(&self) -> Self {
        self.between(&Self::IDENTITY)
    }

    /// `self⁻¹ · to`: with `self = world_from_a` and `to = world_from_b`, `a_from_b`.
    fn between(&self, to: &Self) -> Self;

    /// The matrix Ad with `self · exp(ξ) · self⁻¹ = exp(Ad ξ)`.
    fn adjoint(&self) -> SMatrix<f64, N, N>;

    /// How a pose that is fixed to a frame, (`dx_m`, `dy_m`) from its origin in the world's axes,
    /// moves in the world with the numbers of that frame.
    fn lever_arm(dx_m: f64, dy_m: f64) -> SMatrix<f64, N, N>;

    /// The Jacobian of `self · right` with respect to `self`.
    fn product_by_left(&self, right: &Self) -> SMatrix<f64, N, N>;

    /// The Jacobian of `self · right` with respect to `right`, whatever that is.
    fn product_by_right(&self) -> SMatrix<f64, N, N>;

    /// The Jacobian of `self.between(to)` with respect to `to`, whatever that is.
    fn between_by_to(&self) -> SMatrix<f64, N, N>;

    /// The Jacobian of `self.between(to)`, which is `between`, with respect to `self`.
    fn between_by_from(&self, between: &Self) -> SMatrix<f64, N, N>;
}

impl Se2 {
    /// From its three numbers, metres and radians.
    pub fn new(x_m: f64, y_m: f64, heading_rad: f64) -> Self {
        Self { x_m, y_m, heading_rad }
    }

    /// A rotation about the origin.
    pub fn rotation(heading_rad: f64) -> Self {
        Self::new(0.0, 0.0, heading_rad)
    }

    /// A point of the source in the target.
    pub fn apply(&self, point: GroundPoint) -> GroundPoint {
        let (dx, dy) = self.rotate(point.x_m, point.y_m);
        GroundPoint::new(self.x_m + dx, self.y_m + dy)
    }

    /// A vector (a difference of points, a velocity) of the source in the target.
    pub fn rotate(&self, x: f64, y: f64) -> (f64, f64) {
        let (sin, cos) = self.heading_rad.sin_cos();
        (cos * x - sin * y, sin * x + cos * y)
    }
}

impl Mul for Se2 {
    type Output = Self;

    fn mul(self, right: Self) -> Self {
        let (dx, dy) = self.rotate(right.x_m, right.y_m);
        Self::new(self.x_m + dx, self.y_m + dy, self.heading_rad + right.heading_rad)
    }
}

/// The numbers of SE(2) are the first three of Sim(2), and so are its Jacobians.
fn corner(jacobian: Matrix4<f64>) -> Matrix3<f64> {
    jacobian.fixed_view::<3, 3>(0, 0).into_owned()
}

impl PlaneTransform<3> for Se2 {
    const IDENTITY: Self = Self { x_m: 0.0, y_m: 0.0, heading_rad: 0.0 };

    fn between(&self, to: &Self) -> Self {
        let Sim2 { x_m, y_m, heading_rad, .. } = Sim2::rigid(self).between(&Sim2::rigid(to));
        Self { x_m, y_m, heading_rad }
    }

    fn adjoint(&self) -> Matrix3<f64> {
        corner(Sim2::rigid(self).adjoint())
    }

    fn lever_arm(dx_m: f64, dy_m: f64) -> Matrix3<f64> {
        corner(Sim2::lever_arm(dx_m, dy_m))
    }

    fn product_by_left(&self, right: &Self) -> Matrix3<f64> {
        corner(Sim2::rigid(self).product_by_left(&Sim2::rigid(right)))
    }

    fn product_by_right(&self) -> Matrix3<f64> {
        corner(Sim2::rigid(self).product_by_right())
    }

    fn between_by_to(&self) -> Matrix3<f64> {
        corner(Sim2::rigid(self).between_by_to())
    }

    fn between_by_from(&self, between: &Self) -> Matrix3<f64> {
        corner(Sim2::rigid(self).between_by_from(&Sim2::rigid(between)))
    }
}

impl Sim2 {
    /// A rigid transform, which keeps lengths.
    pub fn rigid(rigid: &Se2) -> Self {
        let Se2 { x_m, y_m, heading_rad } = *rigid;
        Self { x_m, y_m, heading_rad, scale: 1.0 }
    }

    /// A rotation and scaling about the origin.
    pub fn about_origin(heading_rad: f64, scale: f64) -> Self {
        Self { x_m: 0.0, y_m: 0.0, heading_rad, scale }
    }

    /// The numbers (x, y, heading, ln scale).
    pub fn to_vector(&self) -> Vector4<f64> {
        Vector4::new(self.x_m, self.y_m, self.heading_rad, self.scale.ln())
    }

    /// From the numbers of [`Sim2::to_vector`].
    pub fn from_vector(numbers: &Vector4<f64>) -> Self {
        let [x_m, y_m, heading_rad, ln_scale] = (*numbers).into();
        Self { x_m, y_m, heading_rad, scale: ln_scale.exp() }
    }

    /// A point of the source in the target.
    pub fn apply(&self, point: GroundPoint) -> GroundPoint {
        let (dx, dy) = self.rotate(point.x_m, point.y_m);
        GroundPoint::new(self.x_m + dx, self.y_m + dy)
    }

    /// A vector (a difference of points, a velocity) of the source in the target: rotated and
    /// scaled.
    pub fn rotate(&self, x: f64, y: f64) -> (f64, f64) {
        let (sin, cos) = self.heading_rad.sin_cos();
        (self.scale * (cos * x - sin * y), self.scale * (sin * x + cos * y))
    }

    /// A camera pose of the source in the target; roll and pitch stay.
    pub fn apply_to_pose(&self, pose: &GroundPose) -> GroundPose {
        let GroundPoint { x_m, y_m } = self.apply(GroundPoint::new(pose.x_m, pose.y_m));
        GroundPose {
            x_m,
            y_m,
            heading_rad: pose.heading_rad + self.heading_rad,
            height_m: pose.height_m * self.scale,
            ..*pose
        }
    }

    /// Rotates and scales positions; heading and ln scale stay.
    fn block(heading_rad: f64, scale: f64) -> Matrix4<f64> {
        let (sin, cos) = heading_rad.sin_cos();
        let (sin, cos) = (scale * sin, scale * cos);
        let mut block = Matrix4::identity();
        (block[(0, 0)], block[(0, 1)], block[(1, 0)], block[(1, 1)]) = (cos, -sin, sin, cos);
        block
    }
}

impl Mul for Sim2 {
    type Output = Self;

    fn mul(self, right: Self) -> Self {
        let (dx, dy) = self.rotate(right.x_m, right.y_m);
        Self {
            x_m: self.x_m + dx,
            y_m: self.y_m + dy,
            heading_rad: self.heading_rad + right.heading_rad,
            scale: self.scale * right.scale,
        }
    }
}

impl PlaneTransform<4> for Sim2 {
    const IDENTITY: Self = Self { x_m: 0.0, y_m: 0.0, heading_rad: 0.0, scale: 1.0 };

    fn between(&self, to: &Self) -> Self {
        let (sin, cos) = self.heading_rad.sin_cos();
        let (dx, dy) = (to.x_m - self.x_m, to.y_m - self.y_m);
        Self {
            x_m: (cos * dx + sin * dy) / self.scale,
            y_m: (cos * dy - sin * dx) / self.scale,
            heading_rad: to.heading_rad - self.heading_rad,
            scale: to.scale / self.scale,
        }
    }

    fn adjoint(&self) -> Matrix4<f64> {
        let mut adjoint = self.product_by_right();
        (adjoint[(0, 2)], adjoint[(1, 2)]) = (self.y_m, -self.x_m);
        (adjoint[(0, 3)], adjoint[(1, 3)]) = (-self.x_m, -self.y_m);
        adjoint
    }

    fn lever_arm(dx_m: f64, dy_m: f64) -> Matrix4<f64> {
        let mut arm = Matrix4::identity();
        (arm[(0, 2)], arm[(1, 2)]) = (-dy_m, dx_m);
        (arm[(0, 3)], arm[(1, 3)]) = (dx_m, dy_m);
        arm
    }

    fn product_by_left(&self, right: &Self) -> Matrix4<f64> {
        let (dx_m, dy_m) = self.rotate(right.x_m, right.y_m);
        Self::lever_arm(dx_m, dy_m)
    }

    fn product_by_right(&self) -> Matrix4<f64> {
        Self::block(self.heading_rad, self.scale)
    }

    fn between_by_to(&self) -> Matrix4<f64> {
        Self::block(-self.heading_rad, 1.0 / self.scale)
    }

    fn between_by_from(&self, between: &Self) -> Matrix4<f64> {
        // self · between = to stays: product_by_left + product_by_right · d between = 0.
        -(Self::lever_arm(between.x_m, between.y_m) * self.between_by_to())
    }
}

/// `J Σ Jᵀ`: the covariance of what depends on numbers of covariance Σ with the Jacobian J.
pub fn propagated<const R: usize, const C: usize>(
    jacobian: &SMatrix<f64, R, C>,
    covariance: &SMatrix<f64, C, C>,
) -> SMatrix<f64, R, R> {
    jacobian * covariance * jacobian.transpose()
}

/// A transform with the covariance of its numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WithCovariance<T, const N: usize> {
    /// The expected transform.
    pub transform: T,
    /// Covariance of its numbers, in the order of [`PlaneTransform`].
    pub covariance: SMatrix<f64, N, N>,
}

impl<T: PlaneTransform<N>, const N: usize> WithCovariance<T, N> {
    /// `source_from_target`.
    pub fn inverse(&self) -> Self {
        let transform = self.transform.inverse();
        let jacobian = self.transform.between_by_from(&transform);
        Self { transform, covariance: propagated(&jacobian, &self.covariance) }
    }
}

/// The product of two transforms whose errors are independent.
impl<T: PlaneTransform<N>, const N: usize> Mul for WithCovariance<T, N> {
    type Output = Self;

    fn mul(self, right: Self) -> Self {
        let by_left = self.transform.product_by_left(&right.transform);
        let by_right = self.transform.product_by_right();
        Self {
            transform: self.transform * right.transform,
            covariance: propagated(&by_left, &self.covariance) + propagated(&by_right, &right.covariance),
        }
    }
}

#[cfg(test)]
mod tests;
